//! The loss by hand, and its gradient against autograd.

use super::*;
use tch::Device;

/// log N(a; μ, σ) summed over the actions, `[m, 1]`, of actions and means `[m, A]`.
fn log_prob(actions: &Tensor, means: &Tensor, log_std: &Tensor) -> Tensor {
    let z_squared = ((actions - means) * (-log_std).exp()).square();
    log_prob_of_squares(&z_squared, log_std)
}

fn column(xs: &[f32]) -> Tensor {
    Tensor::from_slice(xs).view([-1, 1])
}

fn values(t: &Tensor) -> Vec<f32> {
    Vec::try_from(t.contiguous().view([-1])).unwrap()
}

const SETTINGS: LossSettings = LossSettings { clip: 0.2, value_weight: 2.0, entropy_weight: 0.01 };

/// One action, σ = 1 before and after, so that log r = ½[(a−μ_p)² − (a−μ)²].
fn one_action(means: &[f32], advantages: &[f32], weights: &[f32]) -> (Vec<f32>, OutputGradient) {
    let rows = means.len();
    let zero = vec![0.0_f32; rows];
    let ones = vec![1.0_f32; rows];
    let log_std = Tensor::from_slice(&[0.0_f32]);
    let (actions, prox_means) = (column(&ones), column(&zero));
    let samples = Samples {
        prox_log_probs: log_prob(&actions, &prox_means, &log_std),
        actions,
        prox_means,
        advantages: column(advantages),
        targets: column(&ones),
        weights: column(weights),
        teacher: None,
    };
    let outputs = Outputs { means: column(means), values: column(&vec![3.0; rows]) };
    let (sums, gradient) =
        loss_and_gradient(&SETTINGS, rows, &outputs, &log_std, &log_std, &samples);
    (values(&sums), gradient)
}

#[test]
fn nothing_has_changed_yet() {
    // r = 1: surrogate −w·A = −2·3 = −6; value ¼(3−1)² = 1; KL 0; nothing clipped.
    let (sums, gradient) = one_action(&[0.0], &[3.0], &[2.0]);
    assert_eq!(sums, [-6.0, 1.0, 0.0, 0.0, 0.0]);
    // dL/dμ = −w·A·r·(a−μ)/σ² = −6; dL/dV = c_v·½·(V − target) = 2·½·2 = 2;
    // dL/dlog σ = −6·(z² − 1) − c_e = 0 − 0.01.
    assert_eq!(values(&gradient.means), [-6.0]);
    assert_eq!(values(&gradient.values), [2.0]);
    assert_eq!(values(&gradient.log_std), [-0.01]);
}

#[test]
fn clipping_cuts_the_gradient_on_the_winning_side_only() {
    // μ = 1 at a = 1: log r = ½, r = 1.6487 > 1.2. A = +1: min(1.6487, 1.2) = 1.2, no gradient. A = −1:
    // min(−1.6487, −1.2) = −1.6487, gradient passes, but z = 0 there, so look at log σ: slope·(z² − 1) =
    // (1.6487/2)·(−1), once for the two rows, minus c_e.
    let (sums, gradient) = one_action(&[1.0, 1.0], &[1.0, -1.0], &[1.0, 1.0]);
    let r = 0.5_f32.exp();
    assert!((sums[sums::SURROGATE] - (-1.2 + r)).abs() < 1e-6);
    assert_eq!(sums[sums::CLIPPED], 2.0);
    // KL of a shift by one standard deviation: ½ each.
    assert!((sums[sums::KL] - 1.0).abs() < 1e-6);
    assert!((values(&gradient.log_std)[0] - (-r / 2.0 - 0.01)).abs() < 1e-6);
    assert_eq!(values(&gradient.means), [0.0, 0.0]);
}

fn noise(seed: usize, shape: &[i64], scale: f32) -> Tensor {
    let n = shape.iter().product::<i64>() as usize;
    let xs: Vec<f32> =
        (0..n).map(|i| scale * (((i * 53 + seed * 29) % 97) as f32 / 48.0 - 1.0)).collect();
    Tensor::from_slice(&xs).view(shape)
}

fn samples(rows: i64, actions: i64, prox_log_std: &Tensor) -> Samples {
    let (taken, prox_means) = (noise(1, &[rows, actions], 1.0), noise(2, &[rows, actions], 0.5));
    Samples {
        prox_log_probs: log_prob(&taken, &prox_means, prox_log_std),
        actions: taken,
        prox_means,
        advantages: noise(3, &[rows, 1], 1.5),
        targets: noise(4, &[rows, 1], 2.0),
        weights: noise(5, &[rows, 1], 0.5) + 1.0,
        teacher: Some((noise(8, &[rows, actions], 1.0), 0.7)),
    }
}

/// The loss as one would write it, for autograd.
fn plain_loss(s: &Samples, means: &Tensor, values: &Tensor, log_std: &Tensor) -> Tensor {
    let ratio = (log_prob(&s.actions, means, log_std) - &s.prox_log_probs).exp();
    let clipped = ratio.clamp(0.8, 1.2);
    let objective = (&ratio * &s.advantages).minimum(&(clipped * &s.advantages)) * &s.weights;
    let value = (values - &s.targets).square().mean(Kind::Float) * (0.25 * SETTINGS.value_weight);
    let (lessons, weight) = s.teacher.as_ref().unwrap();
    let off = (means - lessons).square().sum_dim_intlist([1].as_slice(), false, Kind::Float);
    let lesson = off.mean(Kind::Float) * (0.5 * weight);
    objective.mean(Kind::Float).neg() + value + lesson
        - log_std.sum(Kind::Float) * SETTINGS.entropy_weight
}

#[test]
fn the_gradient_is_autograds_and_shards_add_up() {
    let (rows, actions) = (40, 3);
    let prox_log_std = Tensor::from_slice(&[-0.5_f32, 0.0, 0.2]);
    let log_std = (&prox_log_std + 0.05).set_requires_grad(true);
    let s = samples(rows, actions, &prox_log_std);
    let means = (&s.prox_means + noise(6, &[rows, actions], 0.2)).set_requires_grad(true);
    let value = noise(7, &[rows, 1], 1.0).set_requires_grad(true);
    plain_loss(&s, &means, &value, &log_std).backward();

    let _guard = tch::no_grad_guard();
    let mut grads = (Vec::new(), Vec::new(), Tensor::zeros([actions], (Kind::Float, Device::Cpu)));
    for (start, len) in [(0, 16), (16, 24)] {
        let cut = |t: &Tensor| t.narrow(0, start, len);
        let outputs = Outputs { means: cut(&means), values: cut(&value) };
        let part = Samples {
            actions: cut(&s.actions),
            prox_means: cut(&s.prox_means),
            prox_log_probs: cut(&s.prox_log_probs),
            advantages: cut(&s.advantages),
            targets: cut(&s.targets),
            weights: cut(&s.weights),
            teacher: s.teacher.as_ref().map(|(actions, weight)| (cut(actions), *weight)),
        };
        let (_, g) =
            loss_and_gradient(&SETTINGS, rows as usize, &outputs, &log_std, &prox_log_std, &part);
        grads.0.push(g.means);
        grads.1.push(g.values);
        grads.2 += g.log_std;
    }
    let off = |a: &Tensor, b: &Tensor| (a - b).abs().max().double_value(&[]);
    assert!(off(&Tensor::cat(&grads.0, 0), &means.grad()) < 1e-6);
    assert!(off(&Tensor::cat(&grads.1, 0), &value.grad()) < 1e-6);
    assert!(off(&grads.2, &log_std.grad()) < 1e-5);
}

#[test]
fn an_absurd_ratio_stays_finite() {
    let (sums, gradient) = one_action(&[-1e4], &[1.0], &[1.0]);
    assert!(sums[sums::SURROGATE].is_finite());
    assert!(values(&gradient.means)[0].is_finite());
    let (sums, _) = one_action(&[f32::NAN], &[1.0], &[1.0]);
    assert!(sums[sums::SURROGATE].is_nan(), "not-a-number is passed on, for the guard to see");
}
