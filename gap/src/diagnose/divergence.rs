//! The divergence map: joint × signal × regime, each with the probability that nothing is wrong.

use std::collections::BTreeMap;

use caudata_model::RobotModel;
use caudata_random::{Key, Purpose, Stream};

use super::gates;
use super::motion::Motion;
use super::state::{Context, On};
use crate::report::Divergence;
use crate::trial::{Channel, Kind, Steps, Trial};

/// Cells that are reported.
const MOST_CELLS: usize = 400;
/// Resamplings of the null.
const CELL_RESAMPLES: usize = 300;
/// Slow: below this, rad/s; of a slide, so many of what counts as a radian.
const SLOW_RADPS: f64 = 0.3;
/// A joint turns round from this speed to the other way, likewise.
const TURNS_RADPS: f64 = 0.05;
/// Fast: above this share of the joint's 95th percentile.
const FAST_SHARE: f64 = 0.6;
/// A reversal lasts this long to each side, s.
const REVERSAL_S: f64 = 0.08;

/// Regimes of a joint's samples.
const REGIMES: [&str; 5] = ["all", "slow", "fast", "reversal", "loaded"];

/// What a cell has gathered: per block, sum of squares of the null and count.
#[derive(Default)]
struct Cell {
    squares: f64,
    raw: f64,
    sigma: f64,
    count: usize,
    blocks: BTreeMap<u32, (f64, usize)>,
}

/// The map of `on`, which are predictions of the held-out runs, worst first.
pub fn divergence(context: &Context, on: &On) -> Vec<Divergence> {
    let (model, judge) = (context.replayer.model(), &context.holdout);
    let data = &judge.data;
    let motion: Vec<Vec<Option<Regimes<'_>>>> = (data.trials.iter())
        .map(|t| (0..t.commands.len()).map(|a| Regimes::of(model, t, a)).collect())
        .collect();
    let noise = judge.repeat_noise();
    let mut cells: BTreeMap<(Kind, String, usize), Cell> = BTreeMap::new();
    for (segment, piece) in data.parts() {
        let name = &data.trials[segment.trial].channels[piece.channel].name;
        let joint = piece.kind.of_joint().then(|| &motion[segment.trial][piece.index]);
        for k in piece.range.clone() {
            let joint = joint.and_then(Option::as_ref);
            let regimes =
                joint.map_or([true, false, false, false, false], |m| m.at(data.time_s[k]));
            let raw = data.value[k] - f64::from(on.prediction[k]);
            let sigma = f64::from(judge.noise.sigma[k]);
            let w = f64::from(on.residual[k]);
            let null = noise.get(k).map_or(1.0, |n| f64::from(*n));
            for (r, _) in regimes.iter().enumerate().filter(|(_, within)| **within) {
                let cell = cells.entry((piece.kind, name.clone(), r)).or_default();
                cell.squares += w * w;
                cell.raw += raw * raw;
                cell.sigma += sigma * sigma;
                cell.count += 1;
                let block = cell.blocks.entry(data.block[k]).or_default();
                block.0 += null * null;
                block.1 += 1;
            }
        }
    }
    cells.retain(|_, c| c.count >= 20);
    let p = family_wise(&cells, context.seed);
    let mut out: Vec<Divergence> = cells
        .iter()
        .zip(p)
        .map(|(((kind, joint, r), c), p)| {
            let n = c.count as f64;
            let (rmse, floor) = ((c.raw / n).sqrt(), (c.sigma / n).sqrt());
            Divergence {
                signal: kind.name().to_owned(),
                joint: joint.clone(),
                regime: REGIMES[*r].to_owned(),
                rmse,
                noise_floor: floor,
                ratio: rmse / floor.max(1e-12),
                p,
            }
        })
        .collect();
    out.sort_by(|a, b| b.ratio.total_cmp(&a.ratio));
    out.truncate(MOST_CELLS);
    out
}

/// Probability, per cell, that the worst cell of the family is as bad where only repeats differ. Blocks of
/// the null are drawn with replacement; a cell's statistic is its mean square, in standard deviations of that
/// under the null.
fn family_wise(cells: &BTreeMap<(Kind, String, usize), Cell>, seed: u64) -> Vec<f64> {
    let mut stream = Stream::new(Key::for_run(seed), Purpose::Sensor);
    let mut worst = vec![f64::NEG_INFINITY; CELL_RESAMPLES];
    let mut scores = Vec::with_capacity(cells.len());
    for cell in cells.values() {
        let blocks: Vec<&(f64, usize)> = cell.blocks.values().collect();
        let mut means = Vec::with_capacity(CELL_RESAMPLES);
        for _ in 0..CELL_RESAMPLES {
            let drawn =
                (0..blocks.len()).map(|_| blocks[stream.below(blocks.len() as u64) as usize]);
            let (sum, count) = drawn.fold((0.0, 0), |(sum, n), b| (sum + b.0, n + b.1));
            means.push(sum / count.max(1) as f64);
        }
        let n = means.len() as f64;
        let mean = means.iter().sum::<f64>() / n;
        let sd = (means.iter().map(|m| (m - mean).powi(2)).sum::<f64>() / n).sqrt();
        // the floor itself is only known to about a fifth
        let sd = sd.max(0.2 * mean.max(1.0));
        for (w, m) in worst.iter_mut().zip(&means) {
            *w = w.max((m - mean) / sd);
        }
        scores.push((cell.squares / cell.count as f64 - mean.max(1.0)) / sd);
    }
    scores
        .into_iter()
        .map(|s| {
            let above = worst.iter().filter(|w| **w >= s).count();
            (above as f64 + 1.0) / (CELL_RESAMPLES as f64 + 1.0)
        })
        .collect()
}

/// What a joint does in a run, and what of it is much there.
struct Regimes<'a> {
    position: &'a Channel,
    command: Option<&'a Steps>,
    slow_radps: f64,
    fast_radps: f64,
    heavy_rad: f64,
    reversals_s: Vec<f64>,
}

impl<'a> Regimes<'a> {
    /// None where a joint has no angle.
    fn of(model: &RobotModel, trial: &'a Trial, joint: usize) -> Option<Self> {
        let per_radian = model.per_radian(joint);
        let position = trial.channel(Kind::Position, joint)?;
        let command = trial.commands.get(joint);
        let all = position.time_s.iter().map(|&t| Motion::at(position, command, t));
        let all: Vec<Motion> = all.collect();
        let below = |share: f64, of: fn(&Motion) -> f64| {
            let mut sorted: Vec<f64> = all.iter().map(|m| of(m).abs()).collect();
            sorted.sort_by(f64::total_cmp);
            gates::at(&sorted, share)
        };
        let slow_radps = SLOW_RADPS * per_radian;
        let mut reversals_s = Vec::new();
        let mut last = 0.0_f64;
        for (m, t) in all
            .iter()
            .zip(&position.time_s)
            .filter(|(m, _)| m.qd_radps.abs() > TURNS_RADPS * per_radian)
        {
            if last * m.qd_radps < 0.0 {
                reversals_s.push(*t);
            }
            last = m.qd_radps;
        }
        Some(Self {
            fast_radps: (FAST_SHARE * below(0.95, |m| m.qd_radps)).max(slow_radps),
            slow_radps,
            heavy_rad: below(0.75, |m| m.error_rad),
            position,
            command,
            reversals_s,
        })
    }

    /// Which of [`REGIMES`] it is in.
    fn at(&self, t_s: f64) -> [bool; 5] {
        let m = Motion::at(self.position, self.command, t_s);
        let speed = m.qd_radps.abs();
        let near = self.reversals_s.partition_point(|&t| t < t_s - REVERSAL_S);
        let reversal = self.reversals_s.get(near).is_some_and(|&t| t <= t_s + REVERSAL_S);
        let loaded = m.error_rad.abs() > self.heavy_rad;
        [true, speed < self.slow_radps, speed > self.fast_radps, reversal, loaded]
    }
}
