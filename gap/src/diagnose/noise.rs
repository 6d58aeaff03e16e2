//! What cannot be reproduced: noise of each channel in each run, from repeats where there are some, else from counts and jitter.

use std::collections::BTreeMap;

use caudata_model::RobotModel;

use crate::replay::{Data, Piece};
use crate::trial::{Channel, Kind};

/// Share of a signal's own size that no simulation is expected to hit.
const RELATIVE: f64 = 0.01;
/// Repeats that differ this many times more than usual in a block have been disturbed.
const DISTURBED: f64 = 6.0;

/// Noise of a set of runs.
#[derive(Debug, Clone, Default)]
pub struct Noise {
    /// Of each sample, standard deviation, SI. `[N]`
    pub sigma: Vec<f32>,
    /// Of what repeats differ by alone, by (trial, kind, index), SI.
    pub repeat: BTreeMap<(usize, Kind, usize), f64>,
    /// One run less the mean of its repeats, in units of `sigma`; 0 where there are no repeats. `[N]`
    pub difference: Vec<f32>,
    /// Whether any run has a repeat.
    pub repeated: bool,
    /// Disturbed stretches: (trial, from, to), s.
    pub disturbed: Vec<(usize, f64, f64)>,
}

impl Noise {
    /// Of `data`.
    #[must_use]
    pub fn of(model: &RobotModel, data: &Data) -> Self {
        let mut noise = Self {
            sigma: vec![1.0; data.len()],
            difference: vec![0.0; data.len()],
            ..Self::default()
        };
        for segment in &data.segments {
            for piece in &segment.pieces {
                noise.piece(model, data, segment.trial, piece);
            }
        }
        noise.find_disturbed(data);
        noise
    }

    fn piece(&mut self, model: &RobotModel, data: &Data, trial: usize, piece: &Piece) {
        let own = &data.trials[trial];
        let channel = &own.channels[piece.channel];
        let others: Vec<(f64, &Channel)> = (data.trials.iter().enumerate())
            .filter(|(k, t)| *k != trial && t.group == own.group)
            .filter_map(|(_, t)| {
                let shift = t.span_s.0 - own.span_s.0;
                t.channel(piece.kind, piece.index).map(|c| (shift, c))
            })
            .collect();
        let range = piece.range.clone();
        let values = &data.value[range.clone()];
        let floor = (quantum(model, channel) / 12.0_f64.sqrt()).max(jitter(values));
        let mut sum = 0.0;
        let mut differences = vec![0.0; values.len()];
        if !others.is_empty() {
            for (k, difference) in differences.iter_mut().enumerate() {
                let t = data.time_s[range.start + k];
                let mean = others.iter().map(|(shift, c)| interpolate(c, t + shift)).sum::<f64>()
                    / others.len() as f64;
                // own noise σ² and the mean's σ²/m
                let scale = (1.0 + 1.0 / others.len() as f64).sqrt();
                *difference = (values[k] - mean) / scale;
                sum += *difference * *difference;
            }
            self.repeated = true;
        }
        let repeat = (sum / values.len().max(1) as f64).sqrt();
        if !others.is_empty() {
            self.repeat.insert((trial, piece.kind, piece.index), repeat);
        }
        let size = spread(values);
        let sigma = (floor.max(repeat).powi(2) + (RELATIVE * size).powi(2)).sqrt();
        let sigma = sigma.max(smallest(piece.kind));
        for k in 0..values.len() {
            self.sigma[range.start + k] = sigma as f32;
            self.difference[range.start + k] = (differences[k] / sigma) as f32;
        }
    }

    /// Blocks in which one run departs from its repeats far more than blocks usually do.
    fn find_disturbed(&mut self, data: &Data) {
        if !self.repeated {
            return;
        }
        let mut energy = vec![(0.0_f64, 0usize); data.blocks];
        let mut span = vec![(f64::INFINITY, f64::NEG_INFINITY, 0usize); data.blocks];
        for segment in &data.segments {
            for piece in segment.pieces.iter().filter(|p| p.kind == Kind::Position) {
                for k in piece.range.clone() {
                    let b = data.block[k] as usize;
                    energy[b].0 += f64::from(self.difference[k]).powi(2);
                    energy[b].1 += 1;
                    span[b].0 = span[b].0.min(data.time_s[k]);
                    span[b].1 = span[b].1.max(data.time_s[k]);
                    span[b].2 = segment.trial;
                }
            }
        }
        let level = |b: &(f64, usize)| (b.0 / b.1.max(1) as f64).sqrt();
        let mut levels: Vec<f64> = energy.iter().filter(|b| b.1 > 0).map(level).collect();
        levels.sort_by(f64::total_cmp);
        let high = levels.get(levels.len() * 9 / 10).copied().unwrap_or(0.0);
        for (b, e) in energy.iter().enumerate() {
            let repeats = data.trials.iter().filter(|t| t.group == data.trials[span[b].2].group);
            // with only two runs nobody knows which of them was touched
            if e.1 > 0 && level(e) > DISTURBED * high.max(1.0) && repeats.count() >= 3 {
                let (from, to, trial) = span[b];
                self.disturbed.push((trial, from, to));
            }
        }
    }
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
        Kind::Gyro => 0.02,
        Kind::Acceleration => 0.3,
        Kind::Gravity | Kind::BaseAttitude => 0.003,
        Kind::BasePosition | Kind::Foot => 1e-3,
        Kind::BaseVelocity => 0.01,
    }
}

/// White noise by second differences: 1.4826·median|y₊ − 2y + y₋|/√6, which a smooth signal does not add to.
fn jitter(y: &[f64]) -> f64 {
    let mut second: Vec<f64> = y.windows(3).map(|w| (w[2] - 2.0 * w[1] + w[0]).abs()).collect();
    if second.is_empty() {
        return 0.0;
    }
    second.sort_by(f64::total_cmp);
    1.4826 * second[second.len() / 2] / 6.0_f64.sqrt()
}

/// Standard deviation.
fn spread(y: &[f64]) -> f64 {
    let n = y.len().max(1) as f64;
    let mean = y.iter().sum::<f64>() / n;
    (y.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / n).sqrt()
}

/// A channel's value at `t_s`, on the line between samples.
#[must_use]
pub fn interpolate(c: &Channel, t_s: f64) -> f64 {
    let k = c.time_s.partition_point(|&t| t < t_s);
    if k == 0 {
        return c.value[0];
    }
    if k >= c.value.len() {
        return c.value[c.value.len() - 1];
    }
    let (t0, t1) = (c.time_s[k - 1], c.time_s[k]);
    let share = if t1 > t0 { (t_s - t0) / (t1 - t0) } else { 0.0 };
    c.value[k - 1] + share * (c.value[k] - c.value[k - 1])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn jitter_sees_noise_and_not_motion() {
        // a parabola has the constant second difference 2·a·dt²: tiny; alternating ±1 has 4: 1.4826·4/√6
        let smooth: Vec<f64> = (0..100).map(|k| (f64::from(k) * 0.01).powi(2)).collect();
        assert!(jitter(&smooth) < 1.3e-4);
        let rough: Vec<f64> = (0..100).map(|k| f64::from(k % 2) * 2.0).collect();
        assert!((jitter(&rough) - 1.4826 * 4.0 / 6.0_f64.sqrt()).abs() < 1e-9);
    }
}
