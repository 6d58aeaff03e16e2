//! V-trace by hand, and against a naive GAE.

use super::*;
use proptest::prelude::*;

const SETTINGS: VtraceSettings =
    VtraceSettings { gamma: 0.5, lambda: 0.5, rho_max: 1.0, c_max: 1.0 };

fn run(settings: &VtraceSettings, chunk: &Trajectories) -> (Vec<f32>, Vec<f32>) {
    let mut advantages = vec![0.0; chunk.rewards.len()];
    let mut targets = advantages.clone();
    vtrace(settings, chunk, &mut advantages, &mut targets);
    (advantages, targets)
}

#[test]
fn three_steps_of_one_lane_by_hand() {
    let chunk = Trajectories {
        lanes: 1,
        rewards: &[1.0, 2.0, 3.0],
        terminated: &[false; 3],
        truncated: &[false; 3],
        values: &[10.0, 20.0, 30.0],
        bootstrap_values: &[40.0],
        final_values: &[],
        ratios: None,
    };
    // δ2 = 3 + 0.5·40 − 30 = −7          A2 = −7
    // δ1 = 2 + 0.5·30 − 20 = −3          A1 = −3 + 0.25·(−7) = −4.75
    // δ0 = 1 + 0.5·20 − 10 = 1           A0 = 1 + 0.25·(−4.75) = −0.1875
    let (advantages, targets) = run(&SETTINGS, &chunk);
    assert_eq!(advantages, [-0.1875, -4.75, -7.0]);
    assert_eq!(targets, [9.8125, 15.25, 23.0]);
}

#[test]
fn a_failure_has_no_future_and_a_time_limit_has_the_final_observations() {
    // Two lanes, two steps; lane 0 fails at step 0, lane 1 is cut off at step 0 with final value 8.
    let chunk = Trajectories {
        lanes: 2,
        rewards: &[1.0, 1.0, 2.0, 2.0],
        terminated: &[true, false, false, false],
        truncated: &[false, true, false, false],
        values: &[4.0, 4.0, 6.0, 6.0],
        bootstrap_values: &[10.0, 10.0],
        final_values: &[8.0],
        ratios: None,
    };
    // Step 1, both: 2 + 5 − 6 = 1. Step 0: 1 + 0 − 4 = −3 and 1 + 4 − 4 = 1, no trace across the end.
    let (advantages, _) = run(&SETTINGS, &chunk);
    assert_eq!(advantages, [-3.0, 1.0, 1.0, 1.0]);
}

#[test]
fn final_values_belong_to_their_own_step_and_lane() {
    // Both lanes are cut off at both steps, final values 2, 4, 6, 8 in order of step, then lane.
    let chunk = Trajectories {
        lanes: 2,
        rewards: &[0.0; 4],
        terminated: &[false; 4],
        truncated: &[true; 4],
        values: &[0.0; 4],
        bootstrap_values: &[100.0, 100.0],
        final_values: &[2.0, 4.0, 6.0, 8.0],
        ratios: None,
    };
    assert_eq!(run(&SETTINGS, &chunk).0, [1.0, 2.0, 3.0, 4.0]);
}

#[test]
fn old_data_is_capped_by_hand() {
    let chunk = Trajectories {
        lanes: 1,
        rewards: &[1.0, 1.0],
        terminated: &[false; 2],
        truncated: &[false; 2],
        values: &[0.0, 0.0],
        bootstrap_values: &[0.0],
        final_values: &[],
        ratios: Some(&[0.5, 4.0]),
    };
    // Both δ are 1. Step 1: A = 1, ρ = min(1, 4) = 1, D = 1. Step 0: A = 1 + 0.5·0.5·1 = 1.25; ρ = 0.5, trace
    // λ·0.5 = 0.25, D = 0.5 + 0.5·0.25·1 = 0.625.
    let (advantages, targets) = run(&SETTINGS, &chunk);
    assert_eq!(advantages, [1.25, 1.0]);
    assert_eq!(targets, [0.625, 1.0]);
    // With ρ̄ = 2: step 1 gives D = 2, step 0 A = 1 + 0.25·2 = 1.5 and D = 0.5 + 0.125·2 = 0.75.
    let wide = VtraceSettings { rho_max: 2.0, ..SETTINGS };
    let (advantages, targets) = run(&wide, &chunk);
    assert_eq!(advantages, [1.5, 1.0]);
    assert_eq!(targets, [0.75, 2.0]);
}

#[test]
fn the_policys_step_is_that_of_fresh_data_in_the_mean() {
    // One state, two actions with rewards 1 and 0, V = 0. μ takes them 3 : 1, π half and half: π/μ is 2/3 and
    // 2. Weighted by π/μ, μ's advantages must have the mean that π's own have: 3/4·2/3·A(1) + 1/4·2·A(0) =
    // 1/2·1 + 1/2·0.
    let advantage = |reward: f32, ratio: f32| {
        let chunk = Trajectories {
            lanes: 1,
            rewards: &[reward],
            terminated: &[true],
            truncated: &[false],
            values: &[0.0],
            bootstrap_values: &[0.0],
            final_values: &[],
            ratios: Some(&[ratio]),
        };
        run(&SETTINGS, &chunk).0[0]
    };
    let (first, second) = (2.0 / 3.0, 2.0);
    let mean = 0.75 * first * advantage(1.0, first) + 0.25 * second * advantage(0.0, second);
    assert!((mean - 0.5).abs() < 1e-6, "{mean}");
}

#[test]
fn weights_count_samples_several_times() {
    // {1, 4, 4}: mean 3, variance (4 + 1 + 1)/3 = 2.
    let (mean, std) = weighted_mean_and_std(&[1.0, 4.0], &[1.0, 2.0]);
    assert_eq!((mean, std), (3.0, 2.0_f64.sqrt()));
    let xs = [0.1, -3.0, 7.5];
    assert_eq!(weighted_mean_and_std(&xs, &[1.0; 3]), mean_and_std(&xs));
    assert_eq!(weighted_mean_and_std(&xs, &[0.0; 3]), (0.0, 0.0));
}

/// GAE as a double sum, straight from the definition: A_t = Σ_k (γλ)^k δ_{t+k}, stopping at an episode's end.
fn naive_gae(gamma: f64, lambda: f64, c: &Trajectories) -> Vec<f64> {
    let steps = c.rewards.len() / c.lanes;
    let mut finals = vec![0.0; c.rewards.len()];
    let mut given = c.final_values.iter();
    for i in 0..c.rewards.len() {
        if c.truncated[i] {
            finals[i] = f64::from(*given.next().unwrap());
        }
    }
    let delta = |t: usize, n: usize| {
        let i = t * c.lanes + n;
        let next = match (c.terminated[i], c.truncated[i]) {
            (true, _) => 0.0,
            (_, true) => finals[i],
            _ if t + 1 == steps => f64::from(c.bootstrap_values[n]),
            _ => f64::from(c.values[i + c.lanes]),
        };
        f64::from(c.rewards[i]) + gamma * next - f64::from(c.values[i])
    };
    let advantage = |t: usize, n: usize| {
        let mut sum = 0.0;
        for k in t..steps {
            sum += (gamma * lambda).powi((k - t) as i32) * delta(k, n);
            if c.terminated[k * c.lanes + n] || c.truncated[k * c.lanes + n] {
                break;
            }
        }
        sum
    };
    (0..c.rewards.len()).map(|i| advantage(i / c.lanes, i % c.lanes)).collect()
}

proptest! {
    #[test]
    fn at_zero_lag_it_is_gae(
        lanes in 1_usize..4,
        steps in 1_usize..12,
        gamma in 0.5_f32..0.999,
        lambda in 0.0_f32..1.0,
        noise in prop::collection::vec(-2.0_f32..2.0, 300),
        ends in prop::collection::vec(0_u8..10, 48),
    ) {
        let cells = lanes * steps;
        let truncated: Vec<bool> = ends[..cells].iter().map(|&e| e == 1).collect();
        let terminated: Vec<bool> = ends[..cells].iter().map(|&e| e == 2).collect();
        let chunk = Trajectories {
            lanes,
            rewards: &noise[..cells],
            terminated: &terminated,
            truncated: &truncated,
            values: &noise[50..50 + cells],
            bootstrap_values: &noise[100..100 + lanes],
            final_values: &noise[150..150 + truncated.iter().filter(|&&t| t).count()],
            ratios: None,
        };
        let settings = VtraceSettings { gamma, lambda, rho_max: 1.0, c_max: 1.0 };
        let (advantages, targets) = run(&settings, &chunk);
        let expected = naive_gae(f64::from(gamma), f64::from(lambda), &chunk);
        for i in 0..cells {
            prop_assert!((f64::from(advantages[i]) - expected[i]).abs() < 1e-4, "{} {}", advantages[i], expected[i]);
            prop_assert_eq!(targets[i], chunk.values[i] + advantages[i]);
        }
        // Ratios of one are the same thing, bit for bit.
        let ones = vec![1.0; cells];
        prop_assert_eq!(run(&settings, &Trajectories { ratios: Some(&ones), ..chunk }).0, advantages);
    }
}
