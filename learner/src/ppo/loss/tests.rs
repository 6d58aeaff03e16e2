//! The loss by hand, and its gradient against autograd.

use super::*;
use crate::ppo::minibatch::LossSettings;
use tch::{Kind, Tensor};

const SETTINGS: LossSettings = LossSettings { clip: 0.2, value_weight: 2.0, entropy_weight: 0.01 };

/// What the networks say of some samples `[M, A]`, `[M]`.
struct Outputs {
    means: Vec<f32>,
    values: Vec<f32>,
}

/// Gradients with respect to means `[M, A]`, values `[M]` and log-std `[A]`.
#[derive(Default)]
struct Gradient {
    means: Vec<f32>,
    values: Vec<f32>,
    log_std: Vec<f32>,
}

/// Sums and gradient of the rows `part` (first, number) of a minibatch that is the whole of `samples`.
fn of_part(
    (samples, log_std): (&Samples, &[f32]),
    actions: &[f32],
    outputs: &Outputs,
    part: (usize, usize),
) -> ([f64; sums::COUNT], Gradient) {
    let (rows, width) = (outputs.values.len(), log_std.len());
    let minibatch = Minibatch {
        order: (0..rows as u32).collect(),
        part: (0, rows),
        loss: SETTINGS,
        advantage_scale: (0.0, 1.0),
        value_only: false,
    };
    let mut loss = Loss::new(&minibatch, log_std, samples);
    let mut gradient = Gradient::default();
    for row in part.0..part.0 + part.1 {
        let cells = row * width..(row + 1) * width;
        let mut means = vec![0.0; width];
        let (action, mean) = (&actions[cells.clone()], &outputs.means[cells]);
        gradient.values.push(loss.add(row, action, mean, outputs.values[row], &mut means));
        gradient.means.extend(means);
    }
    gradient.log_std = loss.log_std_gradient(part.1);
    (loss.sums(), gradient)
}

/// One action, σ = 1 before and after, so that log r = ½[(a−μ_p)² − (a−μ)²] with a = 1, μ_p = 0.
fn one_action(
    means: &[f32],
    advantages: &[f32],
    weights: &[f32],
) -> ([f64; sums::COUNT], Gradient) {
    let rows = means.len();
    let (zero, ones) = (vec![0.0_f32; rows], vec![1.0_f32; rows]);
    let samples = Samples {
        prox_log_probs: log_probs(&ones, &zero, &[0.0]),
        prox_means: zero,
        prox_log_std: vec![0.0],
        advantages: advantages.to_vec(),
        targets: ones.clone(),
        weights: weights.to_vec(),
        teacher: None,
    };
    let outputs = Outputs { means: means.to_vec(), values: vec![3.0; rows] };
    of_part((&samples, &[0.0]), &ones, &outputs, (0, rows))
}

#[test]
fn log_probability_and_entropy_of_known_gaussians() {
    // N(0, 1) at 0 and N(0, 2) at 2: −½ln2π − 0 and −½ln2π − ln2 − ½; sum −2·0.918939 − 0.693147 − 0.5 =
    // −3.031024.
    let log_std = [0.0, 2.0_f32.ln()];
    assert!((log_probs(&[0.0, 2.0], &[0.0, 0.0], &log_std)[0] + 3.031024).abs() < 1e-5);
    // 2·½ln(2πe) + ln 2 = 2.837877 + 0.693147.
    assert!((entropy(&log_std) - 3.531024).abs() < 1e-5);
}

#[test]
fn nothing_has_changed_yet() {
    // r = 1: surrogate −w·A = −2·3 = −6; value ¼(3−1)² = 1; KL 0; nothing clipped.
    let (sums, gradient) = one_action(&[0.0], &[3.0], &[2.0]);
    assert_eq!(sums, [-6.0, 1.0, 0.0, 0.0, 0.0]);
    // dL/dμ = −w·A·r·(a−μ)/σ² = −6; dL/dV = c_v·½·(V − target) = 2·½·2 = 2;
    // dL/dlog σ = −6·(z² − 1) − c_e = 0 − 0.01.
    assert_eq!(gradient.means, [-6.0]);
    assert_eq!(gradient.values, [2.0]);
    assert_eq!(gradient.log_std, [-0.01]);
}

#[test]
fn clipping_cuts_the_gradient_on_the_winning_side_only() {
    // μ = 1 at a = 1: log r = ½, r = 1.6487 > 1.2. A = +1: min(1.6487, 1.2) = 1.2, no gradient. A = −1:
    // min(−1.6487, −1.2) = −1.6487, gradient passes, but z = 0 there, so look at log σ: slope·(z² − 1) =
    // (1.6487/2)·(−1), once for the two rows, minus c_e.
    let (sums, gradient) = one_action(&[1.0, 1.0], &[1.0, -1.0], &[1.0, 1.0]);
    let r = 0.5_f32.exp();
    assert!((sums[sums::SURROGATE] - f64::from(-1.2 + r)).abs() < 1e-6);
    assert_eq!(sums[sums::CLIPPED], 2.0);
    // KL of a shift by one standard deviation: ½ each.
    assert!((sums[sums::KL] - 1.0).abs() < 1e-6);
    assert!((gradient.log_std[0] - (-r / 2.0 - 0.01)).abs() < 1e-6);
    assert_eq!(gradient.means, [0.0, 0.0]);
}

fn noise(seed: usize, n: usize, scale: f32) -> Vec<f32> {
    (0..n).map(|i| scale * (((i * 53 + seed * 29) % 97) as f32 / 48.0 - 1.0)).collect()
}

/// log N(a; μ, σ) summed over the actions, `[M, 1]`, for autograd.
fn log_prob(actions: &Tensor, means: &Tensor, log_std: &Tensor) -> Tensor {
    let z_squared = ((actions - means) * (-log_std).exp()).square();
    let constant = log_std.sum(Kind::Float) + 0.5 * log_std.numel() as f64 * (2.0 * PI).ln();
    z_squared.sum_dim_intlist([1].as_slice(), true, Kind::Float) * -0.5 - constant
}

/// The loss as one would write it, for autograd. Means `[M, A]`, values `[M, 1]`, log-std `[A]`.
fn plain_loss(s: &Samples, actions: &[f32], [means, values, log_std]: &[Tensor; 3]) -> Tensor {
    let wide = log_std.numel() as i64;
    let of = |values: &[f32], wide: i64| Tensor::from_slice(values).view([-1, wide]);
    let ratio = (log_prob(&of(actions, wide), means, log_std) - of(&s.prox_log_probs, 1)).exp();
    let (clipped, advantages) = (ratio.clamp(0.8, 1.2), of(&s.advantages, 1));
    let objective = (&ratio * &advantages).minimum(&(clipped * &advantages)) * of(&s.weights, 1);
    let error = values - of(&s.targets, 1);
    let value = error.square().mean(Kind::Float) * (0.25 * SETTINGS.value_weight);
    let (lessons, weight) = s.teacher.as_ref().unwrap();
    let off = (means - of(lessons, wide)).square();
    let off = off.sum_dim_intlist([1].as_slice(), false, Kind::Float);
    let lesson = off.mean(Kind::Float) * (0.5 * f64::from(*weight));
    objective.mean(Kind::Float).neg() + value + lesson
        - log_std.sum(Kind::Float) * SETTINGS.entropy_weight
}

#[test]
fn the_gradient_is_autograds_and_shards_add_up() {
    let (rows, width) = (40, 3);
    let (actions, prox_means) = (noise(1, rows * width, 1.0), noise(2, rows * width, 0.5));
    let prox_log_std = vec![-0.5_f32, 0.0, 0.2];
    let log_std: Vec<f32> = prox_log_std.iter().map(|x| x + 0.05).collect();
    let means = prox_means.iter().zip(noise(6, rows * width, 0.2)).map(|(a, b)| a + b).collect();
    let outputs = Outputs { means, values: noise(7, rows, 1.0) };
    let samples = Samples {
        prox_log_probs: log_probs(&actions, &prox_means, &prox_log_std),
        prox_means,
        prox_log_std,
        advantages: noise(3, rows, 1.5),
        targets: noise(4, rows, 2.0),
        weights: noise(5, rows, 0.5).iter().map(|x| x + 1.0).collect(),
        teacher: Some((noise(8, rows * width, 1.0), 0.7)),
    };
    let leaf = |values: &[f32], wide: i64| {
        Tensor::from_slice(values).view([-1, wide]).set_requires_grad(true)
    };
    let raw = Tensor::from_slice(&log_std).set_requires_grad(true);
    let leaves = [leaf(&outputs.means, width as i64), leaf(&outputs.values, 1), raw];
    plain_loss(&samples, &actions, &leaves).backward();

    let mut all = Gradient { log_std: vec![0.0; width], ..Gradient::default() };
    for part in [(0, 16), (16, 24)] {
        let (_, found) = of_part((&samples, &log_std), &actions, &outputs, part);
        all.means.extend(found.means);
        all.values.extend(found.values);
        all.log_std.iter_mut().zip(found.log_std).for_each(|(total, g)| *total += g);
    }
    let all = [(all.means, 1e-6), (all.values, 1e-6), (all.log_std, 1e-5)];
    for ((found, most), leaf) in all.iter().zip(&leaves) {
        let off = (Tensor::from_slice(found) - leaf.grad().view([-1])).abs().max();
        assert!(off.double_value(&[]) < *most, "{off:?}");
    }
}

#[test]
fn an_absurd_ratio_stays_finite() {
    let (sums, gradient) = one_action(&[-1e4], &[1.0], &[1.0]);
    assert!(sums[sums::SURROGATE].is_finite());
    assert!(gradient.means[0].is_finite());
    let (sums, _) = one_action(&[f32::NAN], &[1.0], &[1.0]);
    assert!(sums[sums::SURROGATE].is_nan(), "not-a-number is passed on, for the guard to see");
}
