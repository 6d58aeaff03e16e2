//! The loss of decoupled PPO (Hilton, Cobbe, Schulman 2022, "Batch size-invariance for policy optimization")
//! and its gradient, in closed form.
//!
//! With r = π_θ/π_prox, the policy before the update π_prox, the behaviour μ and w = min(w_max, π_prox/μ):
//! `L = −E[w·min(r·A, clip(r, 1−ε, 1+ε)·A)] + c_v·¼·E[(V − target)²] − c_e·H`, and with a teacher that would have
//! done a*, `+ c_t·½·E|μ − a*|²`.
//! m rows are one shard of a minibatch of M; sums and gradients of shards add up to those of the minibatch.
//!
//! Here in operations of libtorch, for its devices; [`super::row_loss`] is the same on the host.

use std::f64::consts::PI;

use tch::{Kind, Tensor};

/// The log of the ratio is kept within ± this, so that one absurd sample cannot make the whole sum infinite;
/// PPO's clipping acts at |log r| ≈ 0.2.
pub(super) const LOG_RATIO_MAX: f64 = 20.0;

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

/// What is known of m samples before the update.
#[derive(Debug)]
pub struct Samples {
    /// `[m, A]`.
    pub actions: Tensor,
    /// Means of π_prox, `[m, A]`.
    pub prox_means: Tensor,
    /// Log-probabilities under π_prox, `[m, 1]`.
    pub prox_log_probs: Tensor,
    /// A, normalised, `[m, 1]`.
    pub advantages: Tensor,
    /// Value targets, `[m, 1]`.
    pub targets: Tensor,
    /// w, `[m, 1]`.
    pub weights: Tensor,
    /// a*, `[m, A]`, and c_t.
    pub teacher: Option<(Tensor, f64)>,
}

/// What the networks say about them now.
#[derive(Debug)]
pub struct Outputs {
    /// `[m, A]`.
    pub means: Tensor,
    /// `[m, 1]`.
    pub values: Tensor,
}

/// Gradient of the loss of a minibatch with respect to the outputs, as far as these m rows contribute.
#[derive(Debug)]
pub struct OutputGradient {
    /// `[m, A]`.
    pub means: Tensor,
    /// `[m, 1]`.
    pub values: Tensor,
    /// `[A]`.
    pub log_std: Tensor,
}

/// Indices into the sums that [`loss_and_gradient`] answers.
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

/// Sums over the m rows `[COUNT]` and the gradient of the minibatch's loss, where the minibatch has
/// `minibatch_rows` rows. `log_std` is the policy's now, `prox_log_std` before the update, both `[A]`.
pub fn loss_and_gradient(
    settings: &LossSettings,
    minibatch_rows: usize,
    outputs: &Outputs,
    log_std: &Tensor,
    prox_log_std: &Tensor,
    samples: &Samples,
) -> (Tensor, OutputGradient) {
    let rows = samples.actions.size()[0];
    let scale = 1.0 / minibatch_rows as f64;
    let (lo, hi) = (1.0 - settings.clip, 1.0 + settings.clip);
    let inverse_std = log_std.neg().exp_();

    // Policy. z = (a − μ)/σ, so d log π/dμ = z/σ and d log π/d log σ = z² − 1.
    let z = (&samples.actions - &outputs.means).g_mul_(&inverse_std);
    let z_squared = z.square();
    let log_probs = log_prob_of_squares(&z_squared, log_std);
    let ratio = (log_probs - &samples.prox_log_probs).clamp_(-LOG_RATIO_MAX, LOG_RATIO_MAX).exp_();
    let unclipped = &ratio * &samples.advantages;
    let clipped_ratio = ratio.clamp(lo, hi);
    let clipped = &clipped_ratio * &samples.advantages;
    // The minimum lets the gradient through where the unclipped term is the smaller one (or they are equal).
    let passes = unclipped.le_tensor(&clipped);
    let surrogate = unclipped.minimum(&clipped).g_mul_(&samples.weights);
    // dL/d log π = −w·A·r/M where it passes.
    let slope = (&unclipped * &samples.weights).g_mul_(&passes).g_mul_scalar_(-scale);
    let mut grad_means = (&z * &inverse_std).g_mul_(&slope);
    let mut from_teacher = Tensor::zeros([], (Kind::Float, grad_means.device()));
    if let Some((actions, weight)) = &samples.teacher {
        let off = &outputs.means - actions;
        from_teacher = off.square().sum(Kind::Float) * 0.5;
        grad_means += off * (weight * scale);
    }
    let share = rows as f64 * scale;
    let grad_log_std = (z_squared - 1.0)
        .g_mul_(&slope)
        .sum_dim_intlist([0].as_slice(), false, Kind::Float)
        // The entropy is Σ(log σ + ½ log 2πe): its derivative is 1 per action, here in proportion to the
        // rows.
        .g_sub_scalar_(settings.entropy_weight * share);

    // Value.
    let error = &outputs.values - &samples.targets;
    let grad_values = &error * (0.5 * settings.value_weight * scale);

    let kl = kl_sum(&samples.prox_means, prox_log_std, &outputs.means, log_std, rows);
    let outside = ratio.not_equal_tensor(&clipped_ratio).sum(Kind::Float);
    let value_sum = error.square().sum(Kind::Float) * 0.25;
    let surrogate_sum = surrogate.sum(Kind::Float).neg();
    let all = Tensor::stack(&[surrogate_sum, value_sum, kl, outside, from_teacher], 0);
    let gradient = OutputGradient { means: grad_means, values: grad_values, log_std: grad_log_std };
    (all, gradient)
}

fn log_prob_of_squares(z_squared: &Tensor, log_std: &Tensor) -> Tensor {
    let actions = log_std.numel() as f64;
    let constant = log_std.sum(Kind::Float) + 0.5 * actions * (2.0 * PI).ln();
    z_squared.sum_dim_intlist([1].as_slice(), true, Kind::Float) * -0.5 - constant
}

/// Σ over the rows of KL(N(μ_p, σ_p) ‖ N(μ, σ)) = Σ_j [log σ/σ_p + (σ_p² + (μ_p − μ)²)/(2σ²) − ½].
fn kl_sum(
    prox_means: &Tensor,
    prox_log_std: &Tensor,
    means: &Tensor,
    log_std: &Tensor,
    rows: i64,
) -> Tensor {
    let half_precision = (log_std * -2.0).exp_().g_mul_scalar_(0.5);
    let spread = log_std - prox_log_std + (prox_log_std * 2.0).exp_() * &half_precision - 0.5;
    let shift = (prox_means - means).square().g_mul_(&half_precision);
    shift.sum(Kind::Float) + spread.sum(Kind::Float) * rows as f64
}

#[cfg(test)]
mod tests;
