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

/// Share of what a servo does that no simulation is expected to hit: of how far a held joint is from its command, rms,
/// if that is finer than the share of its motion.
const OF_ERROR: f64 = 0.05;
/// A servo that gives next to no torque reads its idle current, one way or the other: up to so many times
/// that, a reading tells no more than that.
const IDLE: f64 = 1.3;
/// So many samples are the beginning of a stretch.
const BEGINS: usize = 5;

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
        let mut repeats: BTreeMap<_, (f64, f64)> = BTreeMap::new();
        let apart: Vec<Option<Apart>> =
            data.parts().map(|(s, p)| Apart::of(data, s.trial, p)).collect();
        let rough: Vec<_> = (data.parts())
            .map(|(s, p)| {
                let of = (data.trials[s.trial].base, p.kind, p.index);
                (of, rough(&data.value[p.range.clone()]))
            })
            .collect();
        for ((segment, piece), own) in data.parts().zip(&apart) {
            if let Some(own) = own {
                let all = repeats.entry((segment.trial, piece.kind, piece.index)).or_default();
                all.0 += own.sum;
                all.1 += own.differences.len() as f64;
            }
            noise.piece(model, data, segment.trial, piece, own.as_ref(), (&apart, &rough));
        }
        noise.repeated = !repeats.is_empty();
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
        apart: Option<&Apart>,
        (all, rough): (&[Option<Apart>], &[(Of, f64)]),
    ) {
        let own = &data.trials[trial];
        let channel = &own.channels[piece.channel];
        let range = piece.range.clone();
        let values = &data.value[range.clone()];
        let counts = quantum(model, channel) / 12.0_f64.sqrt();
        let floor = counts.max(white(piece.kind, values));
        let least = (self.white.entry((trial, piece.kind, piece.index))).or_insert(floor);
        *least = least.min(floor);
        // a run without a repeat has what repeats of others show of the channel, if their base is held alike
        let of = (own.base, piece.kind, piece.index);
        let shown = apart.map(Apart::sd).or_else(|| typical(repeated(all, Apart::sd), of));
        // where none has a repeat, what is rough in all runs: counts come seldom in a slow one, and its own median
        // sees none
        let most = || {
            let shown = typical(repeated(all, |a| a.white), of);
            shown.or_else(|| typical(rough.iter().copied(), of)).unwrap_or(0.0)
        };
        let left = match apart {
            Some(apart) => apart.white / (own.members.len() as f64).sqrt(),
            None => spread(&unforetold(values)).min(most()),
        };
        self.left[range.clone()].fill(left as f32);
        let time_s = &data.time_s[range.clone()];
        // what the guess holds besides noise is what its law lacks: where repeats show the noise, none is made
        let guess = || unexplained(model, own, (piece.kind, piece.index), time_s, values);
        let repeat = shown.unwrap_or_else(|| guess().max(most()));
        // stretches of a swing that dies away are measured by the whole of it, as a run in one piece is
        let size = match own.base {
            BaseHold::Fixed => spread(&in_all_stretches(data, trial, piece)),
            _ => spread(values),
        };
        let mut share = relative(piece.kind) * size;
        if let (Kind::Position, BaseHold::Fixed) = (piece.kind, own.base) {
            share = share.min(OF_ERROR * behind(own, piece.index, time_s, values));
        }
        let sigma = floor.max(repeat).hypot(share);
        let sigma = sigma.max(smallest(model, piece.kind, piece.index));
        let idle_a = match piece.kind {
            Kind::Current => model.servo(piece.index).current_dead_band_a,
            _ => 0.0,
        };
        for k in 0..values.len() {
            let sigma = or_idle(sigma, values[k], idle_a);
            self.sigma[range.start + k] = sigma as f32;
            let difference = apart.map_or(0.0, |a| a.differences[k]);
            self.difference[range.start + k] = (difference / sigma) as f32;
        }
    }
}

/// How the base is held, and which channel it is.
type Of = (BaseHold, Kind, usize);

/// What repeats of a run differ by in one piece of it.
struct Apart {
    of: Of,
    /// The first less the mean of all, times √(m/(m − 1)) of m repeats: as large as the noise of one. `[N]`
    differences: Vec<f64>,
    /// Variance of a sample among the repeats, summed.
    sum: f64,
    /// White noise of one of them, standard deviation: what comes again in all, steps and shocks too, is none of it.
    white: f64,
}

impl Apart {
    /// What the repeats of a run differ by; `None` where it has none.
    fn of(data: &Data, trial: usize, piece: &Piece) -> Option<Self> {
        let own = &data.trials[trial];
        let members: Vec<(f64, &Channel)> = (own.members.iter())
            .filter_map(|m| Some((m.span_s.0 - own.span_s.0, m.channel(piece.kind, piece.index)?)))
            .collect();
        if members.len() < 2 || piece.range.is_empty() {
            return None;
        }
        // where a free robot was when the stretch began is known of each run: repeats differ by where it goes
        // from there
        let roams = own.base != BaseHold::Fixed && piece.kind.of_place(piece.index);
        let began: Vec<f64> = (members.iter())
            .map(|(shift, c)| if roams { began_at(data, piece, *shift, c) } else { 0.0 })
            .collect();
        let (m, mut sum) = (members.len() as f64, 0.0);
        let of_sample = |t: &f64| {
            let all: Vec<f64> = (members.iter().zip(&began))
                .map(|((shift, c), from)| c.at(t + shift) - from)
                .collect();
            let mean = all.iter().sum::<f64>() / m;
            sum += all.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / (m - 1.0);
            // one member against the mean of all: σ²·(1 − 1/m)
            (all[0] - mean) / (1.0 - 1.0 / m).sqrt()
        };
        let differences: Vec<f64> =
            data.time_s[piece.range.clone()].iter().map(of_sample).collect();
        let white = spread(&unforetold(&differences));
        Some(Self { of: (own.base, piece.kind, piece.index), differences, sum, white })
    }

    /// Standard deviation of one of them.
    fn sd(&self) -> f64 {
        (self.sum / self.differences.len() as f64).sqrt()
    }
}

/// `sd` of those that have repeats.
fn repeated(all: &[Option<Apart>], sd: fn(&Apart) -> f64) -> impl Iterator<Item = (Of, f64)> {
    all.iter().flatten().map(move |a| (a.of, sd(a)))
}

/// The middle one of `all` that are of one channel.
fn typical(all: impl Iterator<Item = (Of, f64)>, of: Of) -> Option<f64> {
    median(all.filter(|a| a.0 == of).map(|a| a.1).collect())
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

/// How far joint `index`, which is at `values` at `time_s`, is from its command, rms.
fn behind(trial: &Trial, index: usize, time_s: &[f64], values: &[f64]) -> f64 {
    let Some(command) = trial.commands.get(index) else { return f64::INFINITY };
    let off = |(t, y): (&f64, &f64)| (command.at(*t) - y).powi(2);
    let square: f64 = time_s.iter().zip(values).map(off).sum();
    (square / values.len().max(1) as f64).sqrt()
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
fn smallest(model: &RobotModel, kind: Kind, index: usize) -> f64 {
    match kind {
        Kind::Position | Kind::SecondPosition => 5e-4 * model.per_radian(index),
        Kind::Velocity => 0.01 * model.per_radian(index),
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

/// White noise: 1.4826·median of what is not foretold.
fn rough(y: &[f64]) -> f64 {
    1.4826 * median(unforetold(y).into_iter().map(f64::abs).collect()).unwrap_or(0.0)
}

/// What the three samples on either side of one do not foretell, over what their weights add to white noise. The weights
/// are those that foretell most and hand a constant on (w = ½ − a, a − b, b of each pair), so that neither motion nor
/// a vibration of one frequency, however fast, is noise.
fn unforetold(y: &[f64]) -> Vec<f64> {
    let pair = |w: &[f64], k: usize| w[3 - k] + w[3 + k];
    let of =
        |w: &[f64]| [w[3] - 0.5 * pair(w, 1), pair(w, 2) - pair(w, 1), pair(w, 3) - pair(w, 2)];
    let column = |i: usize| -> Vec<f64> { y.windows(7).map(|w| of(w)[i]).collect() };
    let [mut left, one, mut two] = [0, 1, 2].map(column);
    let sum = |x: &[f64], y: &[f64]| x.iter().zip(y).map(|(x, y)| x * y).sum::<f64>();
    let take_off = |x: &mut [f64], y: &[f64]| {
        let share = sum(x, y) / sum(y, y).max(f64::MIN_POSITIVE);
        x.iter_mut().zip(y).for_each(|(x, y)| *x -= share * y);
        share
    };
    let whole = sum(&two, &two);
    let c = take_off(&mut two, &one);
    // the two are the same where all is of one frequency
    if sum(&two, &two) < 1e-10 * whole {
        two.fill(0.0);
    }
    let a = take_off(&mut left, &one);
    let b = take_off(&mut left, &two);
    let a = a - b * c;
    let added: f64 = [0.5 - a, a - b, b].iter().map(|w| 2.0 * w * w).sum();
    left.iter().map(|x| x / (1.0 + added).sqrt()).collect()
}

/// White noise by the mean square of second differences, which outliers add to: √(Σ(y₊ − 2y + y₋)²/6n).
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
    use caudata_random::{Key, Purpose, Stream};

    use super::*;
    use crate::replay::SegmentOptions;

    #[test]
    fn an_idle_current_has_no_sign() {
        // 1.3·0.15 = 0.195
        assert_eq!(or_idle(0.01, -0.19, 0.15), 0.15);
        assert_eq!(or_idle(0.01, 0.2, 0.15), 0.01);
        assert_eq!(or_idle(0.2, 0.0, 0.15), 0.2);
        assert_eq!(or_idle(0.01, 0.0, 0.0), 0.01);
    }

    #[test]
    fn a_run_without_a_repeat_has_what_the_middle_one_of_the_others_shows() {
        let with = |index, sum| {
            let of = (BaseHold::Fixed, Kind::Velocity, index);
            Some(Apart { of, differences: vec![0.0; 4], sum, white: 0.1 * sum })
        };
        // √(0.04/4) = 0.1, √(0.16/4) = 0.2, √(3.24/4) = 0.9
        let all = [with(1, 0.04), None, with(1, 3.24), with(0, 9.0), with(1, 0.16)];
        let of = |base, index| (base, Kind::Velocity, index);
        let typical = |of| typical(repeated(&all, Apart::sd), of);
        assert_eq!(typical(of(BaseHold::Fixed, 1)), Some(0.2));
        assert_eq!(typical(of(BaseHold::Fixed, 2)), None);
        assert_eq!(typical(of(BaseHold::Water, 1)), None);
    }

    /// Two walks along x that part by 4 cm/s: by 40 cm after 10 s, within a stretch of 0.7 s by 2.8 cm at most. Where a
    /// joint is, is compared as it is.
    #[test]
    fn repeats_of_a_walk_differ_by_where_they_go_from_where_a_stretch_began() {
        let file = concat!(env!("CARGO_MANIFEST_DIR"), "/../robots/polymander.robot.toml");
        let model = RobotModel::load(file.as_ref()).unwrap();
        let time_s: Vec<f64> = (0..=500).map(|k| f64::from(k) * 0.02).collect();
        let walk = |kind: Kind, drift: f64| Channel {
            kind,
            index: 0,
            name: "x".into(),
            time_s: time_s.clone(),
            value: time_s.iter().map(|t| (0.1 + drift) * t).collect(),
        };
        let run = |drift| {
            let channels = [Kind::BasePosition, Kind::Position].map(|kind| walk(kind, drift));
            Trial::bare(BaseHold::Free, 10.0, channels.to_vec())
        };
        let both = Trial { members: vec![run(0.0), run(0.04)], ..run(0.02) };
        let data = Data::new(&model, vec![both], SegmentOptions::default());
        let most = |kind: Kind| {
            let parts = data.parts().filter(|(_, p)| p.kind == kind);
            parts.map(|(_, p)| Apart::of(&data, 0, p).unwrap().sd()).fold(0.0, f64::max)
        };
        assert!(most(Kind::BasePosition) < 0.03, "{}", most(Kind::BasePosition));
        assert!(most(Kind::Position) > 0.2, "{}", most(Kind::Position));
    }

    #[test]
    fn noise_that_comes_with_motion_is_seen_and_steps_are_not() {
        // still for two thirds of the time, then 0.05·N(0, 1): 0.05/√3, and a median of nothing
        let mut noise = Stream::new(Key::for_run(7), Purpose::Sensor);
        let mut reads = |k: usize| if k < 2000 { 0.0 } else { 0.05 * noise.normal_f64() };
        let moves: Vec<f64> = (0..3000).map(&mut reads).collect();
        assert_eq!(rough(&moves), 0.0);
        let all = spread(&unforetold(&moves));
        assert!((all - 0.05 / 3.0_f64.sqrt()).abs() < 0.003, "{all}");
        // a step of 2 every 100 samples comes again in all repeats: it is unforetold in each, and others know no more
        let steps: Vec<f64> =
            moves.iter().zip(0..).map(|(y, k)| y + f64::from(k / 100 % 2 * 2)).collect();
        assert!(spread(&unforetold(&steps)) > 2.0 * all);
    }

    #[test]
    fn jitter_sees_noise_and_not_motion() {
        // a parabola has the constant second difference 2·a·dt²: tiny; alternating ±1 has 4: 1.4826·4/√6
        let smooth: Vec<f64> = (0..100).map(|k| (f64::from(k) * 0.01).powi(2)).collect();
        assert!(jitter(&smooth) < 1.3e-4);
        let rough_rows: Vec<f64> = (0..100).map(|k| f64::from(k % 2) * 2.0).collect();
        assert!((jitter(&rough_rows) - 1.4826 * 4.0 / 6.0_f64.sqrt()).abs() < 1e-9);
        // nor is a cube noise, nor what comes again every other row, or at a third of the rate beside a swing
        let cube: Vec<f64> = (0..100).map(|k| (f64::from(k) * 0.01).powi(3)).collect();
        assert!(rough(&cube) < 1e-12);
        assert!(rough(&rough_rows) < 1e-8);
        let swing = |t: f64| (0.1 * t).sin() + 0.2 * (2.1 * t).sin();
        let swings: Vec<f64> = (0..2000).map(|k| swing(f64::from(k))).collect();
        assert!(rough(&swings) < 1e-4, "{}", rough(&swings));
        // 0.05·N(0, 1) on top of it
        let mut noise = Stream::new(Key::for_run(5), Purpose::Sensor);
        let noisy: Vec<f64> = swings.iter().map(|y| y + 0.05 * noise.normal_f64()).collect();
        assert!((rough(&noisy) - 0.05).abs() < 0.01, "{}", rough(&noisy));
        // one spike of 3 in 102 rows: second differences 3, −6, 3: √(54/600) where the median sees nothing
        let mut rare = vec![7.0; 102];
        rare[50] = 4.0;
        assert_eq!(jitter(&rare), 0.0);
        assert!((spikes(&rare) - 0.3).abs() < 1e-9);
    }
}
