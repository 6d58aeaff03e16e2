//! What cannot be reproduced: noise of each channel in each run, from repeats where there are some, else from
//! counts, jitter, and what the joint's own motion does not explain.

use std::collections::BTreeMap;
use std::ops::Range;

use caudata_model::RobotModel;
use caudata_runlog::BaseHold;

use super::unexplained::unexplained;
use crate::check::series::median;
use crate::replay::{Data, Piece};
use crate::trial::{Channel, Kind, Trial};

/// Share of a signal's own size that no simulation is expected to hit. Speeds come from a servo's own
/// estimator, currents from its driver.
fn relative(kind: Kind) -> f64 {
    match kind {
        Kind::Velocity | Kind::Gyro => 0.03,
        Kind::Acceleration => 0.1,
        Kind::Current | Kind::Torque => 0.02,
        _ => 0.01,
    }
}

/// A servo that gives next to no torque reads its idle current, one way or the other: up to so many times
/// that, a reading tells no more than that.
const IDLE: f64 = 1.3;
/// Repeats that differ this many times more than usual in a block have been disturbed.
const DISTURBED: f64 = 10.0;
/// So many samples are the beginning of a stretch.
const BEGINS: usize = 5;
/// Repeats are not expected to agree better than this, rad.
const LEAST_RAD: f64 = 0.004;

/// Noise of a set of runs.
#[derive(Debug, Clone, Default)]
pub struct Noise {
    /// Standard deviation of each sample, SI. `[N]`
    pub sigma: Vec<f32>,
    /// Standard deviation of what repeats differ by alone, by (trial, kind, index), SI.
    pub repeat: BTreeMap<(usize, Kind, usize), f64>,
    /// Standard deviation of what a sensor adds from one sample to the next alone, by (trial, kind, index),
    /// SI: counts and jitter.
    pub white: BTreeMap<(usize, Kind, usize), f64>,
    /// One run less the mean of its repeats, in units of `sigma`; 0 where there are no repeats. `[N]`
    pub difference: Vec<f32>,
    /// Whether any run has a repeat.
    pub repeated: bool,
    /// White noise of each sample, of the mean of repeats where there are some, SI: what every model leaves. `[N]`
    pub left: Vec<f32>,
}

impl Noise {
    /// Measures the noise of `data`.
    pub fn of(model: &RobotModel, data: &Data) -> Self {
        let mut noise = Self {
            sigma: vec![1.0; data.len()],
            difference: vec![0.0; data.len()],
            left: vec![0.0; data.len()],
            ..Self::default()
        };
        // a run in stretches has one noise of repeats: sum of squares and samples of each channel
        let mut repeats = BTreeMap::new();
        for (segment, piece) in data.parts() {
            noise.piece(model, data, segment.trial, piece, &mut repeats);
        }
        noise.repeat = (repeats.into_iter())
            .map(|(channel, (square, n))| (channel, (square / n).sqrt()))
            .collect();
        noise
    }

    /// Makes the noise of these samples `factor` times what it was.
    pub fn grow(&mut self, samples: Range<usize>, factor: f32) {
        self.sigma[samples.clone()].iter_mut().for_each(|x| *x *= factor);
        self.difference[samples].iter_mut().for_each(|x| *x /= factor);
    }

    fn piece(
        &mut self,
        model: &RobotModel,
        data: &Data,
        trial: usize,
        piece: &Piece,
        repeats: &mut BTreeMap<(usize, Kind, usize), (f64, f64)>,
    ) {
        let own = &data.trials[trial];
        let channel = &own.channels[piece.channel];
        let range = piece.range.clone();
        let values = &data.value[range.clone()];
        let counts = quantum(model, channel) / 12.0_f64.sqrt();
        let floor = counts.max(white(piece.kind, values));
        let least = (self.white.entry((trial, piece.kind, piece.index))).or_insert(floor);
        *least = least.min(floor);
        let members: Vec<(f64, &Channel)> = (own.members.iter())
            .filter_map(|m| Some((m.span_s.0 - own.span_s.0, m.channel(piece.kind, piece.index)?)))
            .collect();
        // where a swimmer was when the stretch began is known of each run: repeats differ by where it goes
        // from there
        let swims = own.base == BaseHold::Water && piece.kind.of_place(piece.index);
        let began: Vec<f64> = (members.iter())
            .map(|(shift, c)| if swims { began_at(data, piece, *shift, c) } else { 0.0 })
            .collect();
        let (m, mut sum) = (members.len() as f64, 0.0);
        let mut differences = vec![0.0; values.len()];
        if members.len() > 1 {
            for (k, difference) in differences.iter_mut().enumerate() {
                let t = data.time_s[range.start + k];
                let all: Vec<f64> = (members.iter().zip(&began))
                    .map(|((shift, c), from)| c.at(t + shift) - from)
                    .collect();
                let mean = all.iter().sum::<f64>() / m;
                sum += all.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / (m - 1.0);
                // one member against the mean of all: σ²·(1 − 1/m)
                *difference = (all[0] - mean) / (1.0 - 1.0 / m).sqrt();
            }
            self.repeated = true;
        }
        let apart = (sum / values.len().max(1) as f64).sqrt();
        let left = white_left(values, (m > 1.0).then(|| counts.max(apart / m.sqrt())));
        self.left[range.clone()].fill(left as f32);
        let time_s = &data.time_s[range.clone()];
        // what the guess holds besides noise is what its law lacks: where repeats show the noise, none is made
        let shown = |t: &Trial| t.members.len() > 1 && t.channel(piece.kind, piece.index).is_some();
        let repeat = match members.len() > 1 || data.trials.iter().any(shown) {
            true => apart,
            false => unexplained(own, piece.kind, piece.index, time_s, values),
        };
        if members.len() > 1 && !values.is_empty() {
            let all = repeats.entry((trial, piece.kind, piece.index)).or_default();
            all.0 += sum;
            all.1 += values.len() as f64;
        }
        // stretches of a swing that dies away are measured by the whole of it, as a run in one piece is
        let size = match own.base {
            BaseHold::Fixed => spread(&in_all_stretches(data, trial, piece)),
            _ => spread(values),
        };
        let sigma = (floor.max(repeat).powi(2) + (relative(piece.kind) * size).powi(2)).sqrt();
        let sigma = sigma.max(smallest(piece.kind));
        let idle_a = match piece.kind {
            Kind::Current => model.servo(piece.index).current_dead_band_a,
            _ => 0.0,
        };
        for k in 0..values.len() {
            let sigma = or_idle(sigma, values[k], idle_a);
            self.sigma[range.start + k] = sigma as f32;
            self.difference[range.start + k] = (differences[k] / sigma) as f32;
        }
    }
}

/// What the repeat `channel`, `shift_s` later, reads where the stretch of `piece` begins: the mean of a few
/// samples.
fn began_at(data: &Data, piece: &Piece, shift_s: f64, channel: &Channel) -> f64 {
    let stamps = &data.time_s[piece.range.clone()];
    let few = &stamps[..stamps.len().min(BEGINS)];
    few.iter().map(|t| channel.at(t + shift_s)).sum::<f64>() / few.len().max(1) as f64
}

/// All samples of the channel of `piece` in `trial`.
fn in_all_stretches(data: &Data, trial: usize, piece: &Piece) -> Vec<f64> {
    let stretches = data.segments.iter().filter(|s| s.trial == trial);
    let same = stretches.flat_map(|s| &s.pieces).filter(|p| p.channel == piece.channel);
    same.flat_map(|p| &data.value[p.range.clone()]).copied().collect()
}

/// Stretches in which one of at least three repeats departs from the others far more than usual: (trial,
/// from, to), s.
pub fn disturbed(trials: &[Trial]) -> Vec<(usize, f64, f64)> {
    let mut levels: Vec<(f64, usize, f64, f64)> = Vec::new();
    for (number, trial) in trials.iter().enumerate() {
        let others: Vec<&Trial> = (trials.iter().enumerate())
            .filter(|(k, t)| *k != number && t.group == trial.group)
            .map(|(_, t)| t)
            .collect();
        // with only two runs nobody knows which of them was touched
        if others.len() < 2 {
            continue;
        }
        for block in 0..trial.duration_s().floor() as usize {
            let from = trial.span_s.0 + block as f64;
            let mut sum = (0.0, 0.0);
            for c in trial.channels.iter().filter(|c| c.kind == Kind::Position) {
                let same: Vec<(f64, &Channel)> = (others.iter())
                    .filter_map(|o| {
                        Some((o.span_s.0 - trial.span_s.0, o.channel(c.kind, c.index)?))
                    })
                    .collect();
                if same.len() < 2 {
                    continue;
                }
                let low = c.time_s.partition_point(|&t| t < from);
                let high = c.time_s.partition_point(|&t| t < from + 1.0);
                for k in low..high {
                    let mut all: Vec<f64> =
                        same.iter().map(|(s, o)| o.at(c.time_s[k] + s)).collect();
                    all.push(c.value[k]);
                    all.sort_by(f64::total_cmp);
                    let median = all[all.len() / 2];
                    sum.0 += (c.value[k] - median).powi(2);
                    sum.1 += 1.0;
                }
            }
            if sum.1 > 0.0 {
                let level: f64 = sum.0 / sum.1;
                levels.push((level.sqrt(), number, from, from + 1.0));
            }
        }
    }
    let mut sorted: Vec<f64> = levels.iter().map(|l| l.0).collect();
    sorted.sort_by(f64::total_cmp);
    let usual = sorted.get(sorted.len() * 9 / 10).copied().unwrap_or(0.0).max(LEAST_RAD);
    levels
        .into_iter()
        .filter(|l| l.0 > DISTURBED * usual)
        .map(|(_, trial, from, to)| (trial, from, to))
        .collect()
}

/// Noise of a reading, SI: where it may be idle current (A; 0: the servo shows none), all of that.
fn or_idle(sigma: f64, read: f64, idle_a: f64) -> f64 {
    if read.abs() < IDLE * idle_a { sigma.max(idle_a) } else { sigma }
}

/// Step of a channel's numbers, SI.
fn quantum(model: &RobotModel, channel: &Channel) -> f64 {
    match channel.kind {
        Kind::Position => model.servo(channel.index).encoder_lsb_rad(),
        Kind::Velocity => model.servo(channel.index).velocity_lsb_radps,
        Kind::Current => model.servo(channel.index).current_lsb_a,
        _ => {
            let steps = channel.value.windows(2).map(|w| (w[1] - w[0]).abs());
            let least = steps.filter(|s| *s > 1e-9).fold(f64::INFINITY, f64::min);
            if least.is_finite() { least } else { 0.0 }
        }
    }
}

/// Noise finer than this is not believed, SI.
fn smallest(kind: Kind) -> f64 {
    match kind {
        Kind::Position => 5e-4,
        Kind::Velocity => 0.01,
        Kind::Current => 0.005,
        Kind::Torque => 0.005,
        Kind::Voltage => 0.05,
        Kind::Gyro => 0.05,
        Kind::Acceleration => 0.5,
        Kind::Gravity | Kind::BaseAttitude => 0.003,
        Kind::BasePosition | Kind::Foot => 1e-3,
        Kind::BaseVelocity => 0.01,
    }
}

/// White noise of a channel.
fn white(kind: Kind, y: &[f64]) -> f64 {
    match kind {
        // read now and then in the middle of a bridge's pulse: rare and large
        Kind::Voltage => spikes(y),
        _ => jitter(y),
    }
}

/// White noise by second differences: 1.4826·median|y₊ − 2y + y₋|/√6, which a smooth signal does not add to.
fn jitter(y: &[f64]) -> f64 {
    let second = y.windows(3).map(|w| (w[2] - 2.0 * w[1] + w[0]).abs());
    1.4826 * median(second.collect()).unwrap_or(0.0) / 6.0_f64.sqrt()
}

/// White noise that every model leaves of a channel, no more than the mean of repeats shows: a vibration that comes
/// again in all of them is none, however fast it is.
fn white_left(y: &[f64], of_mean: Option<f64>) -> f64 {
    rough(y).min(of_mean.unwrap_or(f64::INFINITY))
}

/// White noise by fourth differences, 1.4826·median|Δ⁴y|/√70: motion adds next to nothing to it. (At 100 Hz a swing of
/// 0.3 rad at 2.5 Hz is 3 mrad of noise by second differences, and 0.02 mrad by these.)
fn rough(y: &[f64]) -> f64 {
    let fourth = |w: &[f64]| (w[0] - 4.0 * w[1] + 6.0 * w[2] - 4.0 * w[3] + w[4]).abs();
    1.4826 * median(y.windows(5).map(fourth).collect()).unwrap_or(0.0) / 70.0_f64.sqrt()
}

/// The same by the mean square, which outliers add to: √(Σ(y₊ − 2y + y₋)²/6n).
fn spikes(y: &[f64]) -> f64 {
    let square: f64 = y.windows(3).map(|w| (w[2] - 2.0 * w[1] + w[0]).powi(2)).sum();
    (square / (6.0 * y.len().saturating_sub(2).max(1) as f64)).sqrt()
}

/// Standard deviation.
fn spread(y: &[f64]) -> f64 {
    let n = y.len().max(1) as f64;
    let mean = y.iter().sum::<f64>() / n;
    (y.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / n).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_idle_current_has_no_sign() {
        // 1.3·0.15 = 0.195
        assert_eq!(or_idle(0.01, -0.19, 0.15), 0.15);
        assert_eq!(or_idle(0.01, 0.2, 0.15), 0.01);
        assert_eq!(or_idle(0.2, 0.0, 0.15), 0.2);
        assert_eq!(or_idle(0.01, 0.0, 0.0), 0.01);
    }

    #[test]
    fn jitter_sees_noise_and_not_motion() {
        // a parabola has the constant second difference 2·a·dt²: tiny; alternating ±1 has 4: 1.4826·4/√6
        let smooth: Vec<f64> = (0..100).map(|k| (f64::from(k) * 0.01).powi(2)).collect();
        assert!(jitter(&smooth) < 1.3e-4);
        let rough_rows: Vec<f64> = (0..100).map(|k| f64::from(k % 2) * 2.0).collect();
        assert!((jitter(&rough_rows) - 1.4826 * 4.0 / 6.0_f64.sqrt()).abs() < 1e-9);
        // a cube has no fourth difference; ±1 has 16
        let cube: Vec<f64> = (0..100).map(|k| (f64::from(k) * 0.01).powi(3)).collect();
        assert!(rough(&cube) < 1e-12);
        assert!((rough(&rough_rows) - 1.4826 * 16.0 / 70.0_f64.sqrt()).abs() < 1e-9);
        assert_eq!(white_left(&rough_rows, Some(0.1)), 0.1);
        assert_eq!(white_left(&rough_rows, None), rough(&rough_rows));
        // one spike of 3 in 102 rows: second differences 3, −6, 3: √(54/600) where the median sees nothing
        let mut rare = vec![7.0; 102];
        rare[50] = 4.0;
        assert_eq!(jitter(&rare), 0.0);
        assert!((spikes(&rare) - 0.3).abs() < 1e-9);
    }
}
