//! The divergence map: joint × signal × regime, each with the probability that nothing is wrong.

use std::collections::BTreeMap;

use caudata_random::{Key, Purpose, Stream};

use super::judge::Judge;
use super::state::On;
use crate::report::Divergence;
use crate::trial::{Channel, Kind, Trial};

/// Cells that are reported.
const MOST_CELLS: usize = 400;
/// Resamplings of the null.
const CELL_RESAMPLES: usize = 300;
/// Slow: below this, rad/s.
const SLOW_RADPS: f64 = 0.3;
/// Fast: above this share of the joint's 95th percentile.
const FAST_SHARE: f64 = 0.6;
/// A reversal lasts this long to each side, s.
const REVERSAL_S: f64 = 0.08;

/// Regimes of a joint's samples.
const REGIMES: [&str; 5] = ["all", "slow", "fast", "reversal", "loaded"];

/// What a cell has gathered: per block, sum of squares and count.
#[derive(Default)]
struct Cell {
    squares: f64,
    raw: f64,
    sigma: f64,
    count: usize,
    blocks: BTreeMap<u32, (f64, f64, usize)>,
}

/// The map of `on`, worst first.
#[must_use]
pub fn divergence(judge: &Judge, on: &On, seed: u64) -> Vec<Divergence> {
    let data = &judge.data;
    let motion: Vec<Vec<Motion>> = data.trials.iter().map(motions).collect();
    let noise = judge.repeat_noise();
    let mut cells: BTreeMap<(Kind, String, usize), Cell> = BTreeMap::new();
    for segment in &data.segments {
        let trial = &data.trials[segment.trial];
        for piece in &segment.pieces {
            let name = &trial.channels[piece.channel].name;
            for k in piece.range.clone() {
                let regimes = if piece.kind.of_joint() {
                    motion[segment.trial][piece.index].regimes(data.time_s[k])
                } else {
                    [true, false, false, false, false]
                };
                let raw = data.value[k] - f64::from(on.prediction[k]);
                let sigma = f64::from(judge.noise.sigma[k]);
                let w = f64::from(on.residual[k]);
                let null = noise.get(k).map_or(1.0, |n| f64::from(*n));
                for (r, within) in regimes.iter().enumerate() {
                    if !within {
                        continue;
                    }
                    let cell = cells.entry((piece.kind, name.clone(), r)).or_default();
                    cell.squares += w * w;
                    cell.raw += raw * raw;
                    cell.sigma += sigma * sigma;
                    cell.count += 1;
                    let block = cell.blocks.entry(data.block[k]).or_default();
                    block.0 += w * w;
                    block.1 += null * null;
                    block.2 += 1;
                }
            }
        }
    }
    cells.retain(|_, c| c.count >= 20);
    let p = family_wise(&cells, seed);
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
        let blocks: Vec<&(f64, f64, usize)> = cell.blocks.values().collect();
        let mut means = Vec::with_capacity(CELL_RESAMPLES);
        for _ in 0..CELL_RESAMPLES {
            let (mut sum, mut count) = (0.0, 0);
            for _ in 0..blocks.len() {
                let k = (f64::from(stream.uniform(0.0, 1.0)) * blocks.len() as f64) as usize;
                let b = blocks[k.min(blocks.len() - 1)];
                sum += b.1;
                count += b.2;
            }
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

/// A joint's measured motion, for regimes.
struct Motion {
    time_s: Vec<f64>,
    speed_radps: Vec<f64>,
    load: Vec<f64>,
    reversals_s: Vec<f64>,
    fast_radps: f64,
    heavy: f64,
}

fn motions(trial: &Trial) -> Vec<Motion> {
    (0..trial.commands.len())
        .map(|a| match trial.channel(Kind::Position, a) {
            Some(c) => Motion::new(trial, a, c),
            None => Motion {
                time_s: Vec::new(),
                speed_radps: Vec::new(),
                load: Vec::new(),
                reversals_s: Vec::new(),
                fast_radps: f64::INFINITY,
                heavy: f64::INFINITY,
            },
        })
        .collect()
}

impl Motion {
    fn new(trial: &Trial, joint: usize, c: &Channel) -> Self {
        let n = c.value.len();
        let speed_radps: Vec<f64> = (0..n)
            .map(|k| {
                let (a, b) = (k.saturating_sub(3), (k + 3).min(n - 1));
                let dt = c.time_s[b] - c.time_s[a];
                if dt > 0.0 { (c.value[b] - c.value[a]) / dt } else { 0.0 }
            })
            .collect();
        let load = (0..n)
            .map(|k| (trial.commands[joint].at(c.time_s[k]) - c.value[k]).abs())
            .collect::<Vec<_>>();
        let mut reversals_s = Vec::new();
        let mut last = 0.0_f64;
        for (k, v) in speed_radps.iter().enumerate() {
            if v.abs() > 0.05 {
                if last * v < 0.0 {
                    reversals_s.push(c.time_s[k]);
                }
                last = *v;
            }
        }
        let at = |values: &[f64], share: f64| {
            let mut sorted: Vec<f64> = values.iter().map(|v| v.abs()).collect();
            sorted.sort_by(f64::total_cmp);
            sorted[((sorted.len() - 1) as f64 * share) as usize]
        };
        Self {
            fast_radps: (FAST_SHARE * at(&speed_radps, 0.95)).max(SLOW_RADPS),
            heavy: at(&load, 0.75),
            time_s: c.time_s.clone(),
            speed_radps,
            load,
            reversals_s,
        }
    }

    fn regimes(&self, t_s: f64) -> [bool; 5] {
        let k = self.time_s.partition_point(|&t| t < t_s);
        let Some(speed) = self.speed_radps.get(k.min(self.time_s.len().saturating_sub(1))) else {
            return [true, false, false, false, false];
        };
        let speed = speed.abs();
        let near = self.reversals_s.partition_point(|&t| t < t_s - REVERSAL_S);
        let reversal = self.reversals_s.get(near).is_some_and(|&t| t <= t_s + REVERSAL_S);
        let load = self.load.get(k).copied().unwrap_or(0.0);
        [true, speed < SLOW_RADPS, speed > self.fast_radps, reversal, load > self.heavy]
    }
}
