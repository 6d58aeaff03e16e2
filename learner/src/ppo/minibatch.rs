//! What an update and the networks tell each other.
//!
//! B samples are learnt from, D observations and A actions each; P parameters.

use std::sync::Arc;

use caudata_config::AdvantageScale;

/// Keeps a division by a spread finite.
const SPREAD_MIN: f64 = 1e-8;

/// Weights and ranges of the loss.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LossSettings {
    /// ε.
    pub clip: f64,
    /// c_v.
    pub value_weight: f64,
    /// c_e.
    pub entropy_weight: f64,
}

/// Indices into the sums over the samples of a minibatch.
pub mod sums {
    /// Sum of −w·min(r·A, clip(r)·A).
    pub const SURROGATE: usize = 0;
    /// Sum of ¼(V − target)².
    pub const VALUE: usize = 1;
    /// Sum of KL(π_prox ‖ π_θ), nats.
    pub const KL: usize = 2;
    /// Samples whose ratio lies outside 1 ± ε.
    pub const CLIPPED: usize = 3;
    /// Sum of ½|μ − a*|².
    pub const TEACHER: usize = 4;
    /// Number of sums.
    pub const COUNT: usize = 5;
}

/// What the samples of a batch are learnt with besides their observations and actions.
#[derive(Debug)]
pub struct Samples {
    /// Means of π_prox, `[B, A]`.
    pub prox_means: Vec<f32>,
    /// Logarithm of the standard deviation of π_prox, `[A]`.
    pub prox_log_std: Vec<f32>,
    /// log π_prox(a), `[B]`.
    pub prox_log_probs: Vec<f32>,
    /// Advantages, `[B]`.
    pub advantages: Vec<f32>,
    /// Value targets, `[B]`.
    pub targets: Vec<f32>,
    /// Importance weights, `[B]`.
    pub weights: Vec<f32>,
    /// What a teacher would have done `[B, A]`, and its weight in the loss.
    pub teacher: Option<(Vec<f32>, f32)>,
}

/// One minibatch.
#[derive(Clone, Debug)]
pub struct Minibatch {
    /// Numbers of the samples of the batch in the order of this epoch, `[B]`.
    pub order: Arc<[u32]>,
    /// First of the minibatch's samples in that order, and how many.
    pub part: (usize, usize),
    /// Weights and ranges of the loss.
    pub loss: LossSettings,
    /// What is taken off advantages, and by what they are then divided.
    pub advantage_scale: (f32, f32),
    /// Whether the policy has no gradient.
    pub value_only: bool,
}

impl Minibatch {
    /// Numbers of its samples within the batch.
    pub fn samples(&self) -> &[u32] {
        let (first, rows) = self.part;
        &self.order[first..][..rows]
    }
}

/// What the networks say of a batch before an update.
#[derive(Debug)]
pub struct Before {
    /// Values of all observations, of those whose value alone is wanted too.
    pub values: Vec<f32>,
    /// Means of the actions, `[B, A]`; empty unless asked for.
    pub means: Vec<f32>,
}

/// What a minibatch came to.
#[derive(Debug)]
pub struct Total {
    /// In the order of [`sums`].
    pub sums: [f64; sums::COUNT],
    /// Euclidean norm of the gradient of the loss, `[P]`.
    pub norm: f64,
}

/// A step of Adam along a gradient.
#[derive(Clone, Copy, Debug)]
pub struct Step {
    /// By what the gradient is multiplied.
    pub scale: f64,
    /// Number of parameters and their learning rate: the policy's, the value function's.
    pub rates: [(usize, f64); 2],
}

/// As [`Minibatch::advantage_scale`], for the samples `order` of a batch.
pub fn advantage_scale(scale: AdvantageScale, advantages: &[f32], order: &[u32]) -> (f32, f32) {
    if scale != AdvantageScale::Minibatch {
        return (0.0, 1.0);
    }
    let own: Vec<f32> = order.iter().map(|&i| advantages[i as usize]).collect();
    let (mean, std) = crate::returns::mean_and_std(&own);
    (mean as f32, (std + SPREAD_MIN) as f32)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn advantages_of_a_minibatch_are_shifted_and_scaled_by_its_own() {
        // Of 1, 2 and 6: mean 3, variance (4 + 1 + 9)/3.
        let advantages = [1.0, 100.0, 2.0, 6.0];
        let (shift, scale) = advantage_scale(AdvantageScale::Minibatch, &advantages, &[3, 0, 2]);
        assert_eq!(shift, 3.0);
        assert!((scale - (14.0_f32 / 3.0).sqrt()).abs() < 1e-6);
        let whole = advantage_scale(AdvantageScale::Batch, &advantages, &[1]);
        assert_eq!(whole, (0.0, 1.0));
    }
}
