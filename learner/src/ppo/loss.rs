//! The loss of decoupled PPO (Hilton, Cobbe, Schulman 2022, "Batch size-invariance for policy optimization")
//! and its gradient with respect to the networks' outputs, in closed form, sample after sample on the host.
//!
//! With r = π_θ/π_prox, the policy before the update π_prox, the behaviour μ and w = min(w_max, π_prox/μ):
//! `L = −E[w·min(r·A, clip(r, 1−ε, 1+ε)·A)] + c_v·¼·E[(V − target)²] − c_e·H`, and with a teacher that would have
//! done a*, `+ c_t·½·E|μ − a*|²`.
//! m rows are one shard of a minibatch of M; sums and gradients of shards add up to those of the minibatch.

use std::f64::consts::PI;

use super::minibatch::{Minibatch, Samples, sums};

/// The log of the ratio is kept within ± this, so that one absurd sample cannot make the whole sum infinite;
/// PPO's clipping acts at |log r| ≈ 0.2.
const LOG_RATIO_MAX: f32 = 20.0;

/// Sums over the samples of one shard of a minibatch, and what all of them need.
#[derive(Debug)]
pub struct Loss<'a> {
    minibatch: &'a Minibatch,
    samples: &'a Samples,
    /// 1/σ, `[A]`.
    inverse_std: Vec<f32>,
    /// 1/(2σ²), `[A]`.
    half_precision: Vec<f32>,
    /// Σ log σ + ½·A·log 2π.
    constant: f32,
    /// What the KL divergence of a sample owes to the spreads alone.
    spread_kl: f64,
    /// 1/M.
    scale: f32,
    /// (a − μ)/σ of a sample, `[A]`.
    z: Vec<f32>,
    log_std_gradient: Vec<f32>,
    sums: [f64; sums::COUNT],
}

impl<'a> Loss<'a> {
    /// Before the first sample. `log_std` `[A]` is the policy's now.
    pub fn new(minibatch: &'a Minibatch, log_std: &[f32], samples: &'a Samples) -> Self {
        let half_precision = |x: &f32| 0.5 * (-2.0 * x).exp();
        let spread_kl = log_std.iter().zip(&samples.prox_log_std).map(|(now, prox)| {
            let (now, prox) = (f64::from(*now), f64::from(*prox));
            now - prox + 0.5 * (2.0 * (prox - now)).exp() - 0.5
        });
        Self {
            minibatch,
            samples,
            inverse_std: log_std.iter().map(|x| (-x).exp()).collect(),
            half_precision: log_std.iter().map(half_precision).collect(),
            constant: log_prob_constant(log_std),
            spread_kl: spread_kl.sum(),
            scale: 1.0 / minibatch.part.1 as f32,
            z: vec![0.0; log_std.len()],
            log_std_gradient: vec![0.0; log_std.len()],
            sums: [0.0; sums::COUNT],
        }
    }

    /// Adds sample number `sample` of the batch, whose action was `action` `[A]`, while the networks say `mean`
    /// (`[A]` and more) and `value`. Writes the gradient with respect to the mean, and answers the one with
    /// respect to the value.
    pub fn add(
        &mut self,
        sample: usize,
        action: &[f32],
        mean: &[f32],
        value: f32,
        mean_gradient: &mut [f32],
    ) -> f32 {
        let (width, settings) = (action.len(), &self.minibatch.loss);
        let prox_mean = &self.samples.prox_means[sample * width..][..width];
        let (mut squares, mut shift) = (0.0, 0.0);
        for j in 0..width {
            // z = (a − μ)/σ, so d log π/dμ = z/σ and d log π/d log σ = z² − 1.
            let z = (action[j] - mean[j]) * self.inverse_std[j];
            self.z[j] = z;
            squares += z * z;
            shift += (prox_mean[j] - mean[j]).powi(2) * self.half_precision[j];
        }
        let log_prob = -0.5 * squares - self.constant;
        let log_ratio = log_prob - self.samples.prox_log_probs[sample];
        let ratio = log_ratio.clamp(-LOG_RATIO_MAX, LOG_RATIO_MAX).exp();
        let (centre, spread) = self.minibatch.advantage_scale;
        let advantage = (self.samples.advantages[sample] - centre) / spread;
        let weight = self.samples.weights[sample];
        let clip = settings.clip as f32;
        let clipped_ratio = ratio.clamp(1.0 - clip, 1.0 + clip);
        let (unclipped, clipped) = (ratio * advantage, clipped_ratio * advantage);
        // The minimum lets the gradient through where the unclipped term is the smaller one (or they are equal):
        // dL/d log π = −w·A·r/M there.
        let slope = if unclipped <= clipped { -unclipped * weight * self.scale } else { 0.0 };
        for j in 0..width {
            let z = self.z[j];
            mean_gradient[j] = z * self.inverse_std[j] * slope;
            self.log_std_gradient[j] += (z * z - 1.0) * slope;
        }
        if let Some((actions, weight)) = &self.samples.teacher {
            for (j, theirs) in actions[sample * width..][..width].iter().enumerate() {
                let off = mean[j] - theirs;
                mean_gradient[j] += weight * self.scale * off;
                self.sums[sums::TEACHER] += f64::from(0.5 * off * off);
            }
        }
        let error = value - self.samples.targets[sample];
        self.sums[sums::SURROGATE] -= f64::from(unclipped.min(clipped) * weight);
        self.sums[sums::VALUE] += f64::from(0.25 * error * error);
        self.sums[sums::KL] += f64::from(shift) + self.spread_kl;
        self.sums[sums::CLIPPED] += f64::from(u8::from(ratio != clipped_ratio));
        0.5 * settings.value_weight as f32 * self.scale * error
    }

    /// Gradient with respect to the log-std, `[A]`, after all `rows` samples of the shard. The entropy is
    /// Σ(log σ + ½ log 2πe): its derivative is 1 per action, here in proportion to the rows.
    pub fn log_std_gradient(&self, rows: usize) -> Vec<f32> {
        let entropy = self.minibatch.loss.entropy_weight as f32 * rows as f32 * self.scale;
        self.log_std_gradient.iter().map(|g| g - entropy).collect()
    }

    /// In the order of [`sums`].
    pub fn sums(&self) -> [f64; sums::COUNT] {
        self.sums
    }
}

fn log_prob_constant(log_std: &[f32]) -> f32 {
    let sum: f64 = log_std.iter().map(|&x| f64::from(x)).sum();
    (sum + 0.5 * log_std.len() as f64 * (2.0 * PI).ln()) as f32
}

/// log N(a; μ, σ) of each of `[B, A]` actions and means, with the sums of [`Loss::add`].
pub fn log_probs(actions: &[f32], means: &[f32], log_std: &[f32]) -> Vec<f32> {
    let inverse_std: Vec<f32> = log_std.iter().map(|x| (-x).exp()).collect();
    let (width, constant) = (log_std.len(), log_prob_constant(log_std));
    let rows = actions.chunks_exact(width).zip(means.chunks_exact(width));
    let log_prob = |(action, mean): (&[f32], &[f32])| {
        let mut squares = 0.0;
        for j in 0..width {
            let z = (action[j] - mean[j]) * inverse_std[j];
            squares += z * z;
        }
        -0.5 * squares - constant
    };
    rows.map(log_prob).collect()
}

/// Entropy of the policy, nats: Σ(log σ + ½ log 2πe).
pub fn entropy(log_std: &[f32]) -> f64 {
    let sum: f64 = log_std.iter().map(|&x| f64::from(x)).sum();
    sum + 0.5 * log_std.len() as f64 * (1.0 + (2.0 * PI).ln())
}

#[cfg(test)]
mod tests;
