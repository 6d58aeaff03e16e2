//! What is commanded: trials to fit on, trials held out, and poor trials that leave effects in the dark.

use caudata_model::RobotModel;
use caudata_random::Stream;

/// Rows per second of every log.
pub const RATE_HZ: f64 = 100.0;

/// A trial: a command for every joint at every row.
#[derive(Clone, Debug)]
pub struct Trial {
    /// Name; logs of one trial are repeats of each other.
    pub name: String,
    /// `[rows][A]`, rad.
    pub rows_rad: Vec<Vec<f64>>,
}

impl Trial {
    /// s.
    pub fn duration_s(&self) -> f64 {
        (self.rows_rad.len().saturating_sub(1)) as f64 / RATE_HZ
    }
}

/// How much is recorded.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Amount {
    /// Half as long, two repeats: for quick sets.
    Short,
    /// About two minutes per joint with its three repeats.
    Full,
}

/// A joint's command being written.
struct Track {
    rad: Vec<f64>,
    low: f64,
    high: f64,
    pace: f64,
}

impl Track {
    fn new(range: (f64, f64), pace: f64) -> Self {
        Self { rad: vec![0.0f64.clamp(range.0, range.1)], low: range.0, high: range.1, pace }
    }

    fn now(&self) -> f64 {
        self.rad.last().copied().unwrap_or(0.0)
    }

    fn put(&mut self, x: f64) {
        self.rad.push(x.clamp(self.low, self.high));
    }

    fn rows(&self, s: f64) -> usize {
        (s * self.pace * RATE_HZ).round() as usize
    }

    fn hold(&mut self, s: f64) {
        let x = self.now();
        for _ in 0..self.rows(s) {
            self.put(x);
        }
    }

    fn step(&mut self, to: f64, s: f64) {
        self.put(to);
        self.hold(s);
    }

    /// Smoothly to `to`.
    fn ramp(&mut self, to: f64, s: f64) {
        let (from, n) = (self.now(), self.rows(s).max(1));
        for k in 1..=n {
            let x = k as f64 / n as f64;
            self.put(from + (to - from) * 0.5 * (1.0 - (std::f64::consts::PI * x).cos()));
        }
    }

    /// Up and down around `centre` at constant speed.
    fn triangle(&mut self, centre: f64, size: f64, speed: f64, cycles: f64) {
        self.ramp(centre, 0.5);
        let quarter = size / speed;
        let n = (4.0 * quarter * cycles * RATE_HZ).round() as usize;
        for k in 1..=n {
            let x = k as f64 / RATE_HZ / quarter;
            let p = x.rem_euclid(4.0);
            let y = if p < 1.0 {
                p
            } else if p < 3.0 {
                2.0 - p
            } else {
                p - 4.0
            };
            self.put(centre + size * y);
        }
    }

    /// Frequency from `f0` to `f1` in proportion to time's exponential; amplitude falls with it above
    /// `f_knee`.
    fn chirp(&mut self, centre: f64, size: f64, f0: f64, f1: f64, f_knee: f64, s: f64) {
        self.ramp(centre, 0.4);
        let n = self.rows(s);
        let mut phase = 0.0;
        for k in 1..=n {
            let x = k as f64 / n as f64;
            let f = f0 * (f1 / f0).powf(x);
            phase += std::f64::consts::TAU * f / RATE_HZ;
            let amplitude = size * (f_knee / f).min(1.0);
            self.put(centre + amplitude * phase.sin());
        }
    }
}

fn trial(name: &str, tracks: Vec<Track>) -> Trial {
    let rows = tracks.iter().map(|t| t.rad.len()).max().unwrap_or(0);
    let rows_rad = (0..rows)
        .map(|k| tracks.iter().map(|t| t.rad.get(k).copied().unwrap_or(t.now())).collect())
        .collect();
    Trial { name: name.to_owned(), rows_rad }
}

/// What a joint may be sent to: its range less a margin.
fn ranges(model: &RobotModel) -> Vec<(f64, f64)> {
    model.joint_limits_rad().iter().map(|&(low, high)| (low + 0.15, high - 0.15)).collect()
}

/// Trials to fit on: holds under load, chirps, triangles at three speeds, steps of three sizes.
pub fn fit(model: &RobotModel, amount: Amount) -> Vec<Trial> {
    let pace = match amount {
        Amount::Short => 0.6,
        Amount::Full => 1.0,
    };
    let ranges = ranges(model);
    let per_joint = |write: &dyn Fn(&mut Track, f64, f64)| -> Vec<Track> {
        ranges
            .iter()
            .enumerate()
            .map(|(a, &range)| {
                let mut track = Track::new(range, pace);
                // joints do different things at one time, so that they can be told apart
                let sign = if a % 2 == 0 { 1.0 } else { -1.0 };
                track.hold(0.3 + 0.17 * (a % 5) as f64);
                write(&mut track, sign, 1.0 + 0.07 * (a % 5) as f64);
                track.ramp(0.0, 0.4);
                track.hold(0.2);
                track
            })
            .collect()
    };
    vec![
        trial(
            "holds",
            per_joint(&|t, s, _| {
                for x in [0.5, 1.0, 1.57, 2.0, 0.8, -0.5, -1.0, -1.57, -2.0] {
                    t.ramp(s * x, 0.45);
                    t.hold(0.6);
                }
            }),
        ),
        trial(
            "chirp",
            per_joint(&|t, s, f| {
                t.chirp(0.0, 0.35, 0.4 * f, 6.0 * f, 1.0, 7.0);
                t.chirp(s * 0.8, 0.25, 0.5 * f, 3.0 * f, 1.0, 3.0);
            }),
        ),
        trial(
            "triangles",
            per_joint(&|t, s, f| {
                t.triangle(0.0, 0.9, 2.0 * f, 1.5);
                t.triangle(s * 0.6, 0.3, 0.4 * f, 1.0);
                t.triangle(s * 1.1, 0.05, 0.06 * f, 1.0);
                t.triangle(0.0, 0.02, 0.04 * f, 1.0);
            }),
        ),
        trial(
            "steps",
            per_joint(&|t, s, _| {
                for x in [0.05, 0.0, 0.3, 0.0, 1.2, -1.2, 0.0] {
                    t.step(s * x, 0.75);
                }
            }),
        ),
    ]
}

/// Held-out trials: other commands, the same regimes (all speeds, the whole range, loads both ways).
pub fn holdout(model: &RobotModel, amount: Amount, stream: &mut Stream) -> Vec<Trial> {
    let pace = match amount {
        Amount::Short => 0.6,
        Amount::Full => 1.0,
    };
    let ranges = ranges(model);
    let tracks = ranges
        .iter()
        .map(|&range| {
            let mut t = Track::new(range, pace);
            t.hold(0.3);
            let sines: Vec<(f64, f64, f64)> = (0..5)
                .map(|i| {
                    let f = 0.4 * 1.8f64.powi(i) * stream.uniform_f64(0.9, 1.1);
                    (0.3 / (1.0 + f), f, stream.uniform_f64(0.0, std::f64::consts::TAU))
                })
                .collect();
            let n = t.rows(7.0);
            let fade = RATE_HZ;
            for k in 1..=n {
                let time = k as f64 / RATE_HZ;
                let x: f64 = sines
                    .iter()
                    .map(|(a, f, p)| a * (std::f64::consts::TAU * f * time + p).sin())
                    .sum();
                t.put(x * (k as f64 / fade).min(1.0));
            }
            for _ in 0..4 {
                t.step(stream.uniform_f64(-1.3, 1.3), 0.7);
            }
            for x in [2.0, 1.3, -0.7, -2.0] {
                t.ramp(x * stream.uniform_f64(0.96, 1.0), 0.7);
                t.hold(0.4);
            }
            let centre = stream.uniform_f64(-0.9, 0.9);
            t.triangle(centre, 0.04, 0.05, 1.0);
            t.triangle(centre, 0.3, 0.6, 1.0);
            t.ramp(0.0, 0.4);
            t
        })
        .collect();
    vec![trial("mixed", tracks)]
}

/// Too little to tell look-alikes apart: a slow gait at one amplitude, no holds, no steps.
pub fn starved(model: &RobotModel) -> Vec<Trial> {
    let tracks = ranges(model)
        .iter()
        .enumerate()
        .map(|(a, &range)| {
            let mut t = Track::new(range, 1.0);
            t.hold(0.3);
            let n = t.rows(12.0);
            for k in 1..=n {
                let time = k as f64 / RATE_HZ;
                let grow = time.min(1.0);
                t.put(0.35 * grow * (std::f64::consts::TAU * 0.8 * time + 0.9 * a as f64).sin());
            }
            t
        })
        .collect();
    vec![trial("gait", tracks)]
}
