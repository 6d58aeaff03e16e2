//! Episodes: how they end, what is reported, how the next one starts.

use std::sync::Arc;

use crate::support::{Breakdown, FakeEngine, calm_task, env, model, wiggle};
use caudata_env::{EnvError, VecEnv};
use caudata_task::ContractDifference;
use caudata_task::reward::{RewardWeights, TERM_COUNT};
use caudata_task::termination::TerminationReason;

const ACT_DIM: usize = 16;

const DIM: usize = 97;

#[test]
fn the_time_limit_truncates_and_does_not_terminate() {
    let mut env = env(&calm_task(), 2, 1);
    for step in 1..=60 {
        let output = env.step(&wiggle(2, step)).unwrap();
        let at_limit = step % 20 == 0;
        assert_eq!(output.truncated, [at_limit; 2], "step {step}");
        assert_eq!(output.terminated, [false; 2]);
        assert_eq!(output.final_observations.len(), if at_limit { 2 } else { 0 });
        for episode in &output.episodes {
            assert_eq!((episode.steps, episode.terminated, episode.reason), (20, false, None));
            assert_eq!(episode.episode, step as u64 / 20 - 1);
        }
    }
}

/// Drives the first spine joint of lane 1, with which the toy's base rolls, and gives the reason of the first
/// end.
#[track_caller]
fn first_failure(spine_action: f32) -> TerminationReason {
    let mut task = calm_task();
    task.reset.joint_pos_noise_rad = 0.0;
    let mut env = env(&task, 3, 1);
    let mut actions = vec![0.0; 3 * ACT_DIM];
    actions[ACT_DIM] = spine_action;
    for _ in 0..18 {
        let output = env.step(&actions).unwrap();
        assert_eq!(output.truncated, [false; 3]);
        assert!(!output.terminated[0] && !output.terminated[2]);
        if let Some(episode) = output.episodes.first() {
            assert!(output.terminated[1] && episode.terminated);
            assert_eq!(episode.lane, 1);
            return episode.reason.unwrap();
        }
    }
    panic!("no episode ended");
}

#[test]
fn rolling_over_terminates_only_that_lane() {
    // Offset 0.5·0.6 = 0.3 rad in the end, the base rolls to 4·0.3 = 1.2 rad: beyond the limit of 1, short of
    // 90°.
    assert_eq!(first_failure(0.6), TerminationReason::Tilted);
    // Filtered 2.5, target 1.25 rad, the joint goes half of the way, the base rolls to 2.5 rad: past 90° at
    // once.
    assert_eq!(first_failure(5.0), TerminationReason::UpsideDown);
}

#[test]
fn the_final_observation_is_the_one_before_the_reset() {
    let mut task = calm_task();
    task.reset.joint_pos_noise_rad = 0.0;
    task.reset.base_vel_noise_mps = 0.0;
    let mut env = env(&task, 1, 1);
    let hold = vec![0.4; ACT_DIM];
    for _ in 0..19 {
        env.step(&hold).unwrap();
    }
    let before = env.observations().to_vec();
    let output = env.step(&hold).unwrap().clone();
    let (lane, last) = &output.final_observations[0];
    assert_eq!((*lane, last.len()), (0, DIM));
    // Held for 20 steps, joints are at their targets: scale 0.5 · 0.4 = 0.2 rad from nominal, as one step
    // before.
    for i in 16..32 {
        assert!((last[i] - 0.2).abs() < 1e-3 && (last[i] - before[i]).abs() < 1e-3);
    }
    assert_eq!(last[49..97], [0.4; 48]);
    // The next episode starts in the nominal pose, at rest, with no past actions.
    let first = env.observations();
    assert_eq!(first[..32], [0.0; 32]);
    assert_eq!(first[49..97], [0.0; 48]);
}

#[test]
fn sums_of_an_episode_equal_its_steps() {
    let mut task = calm_task();
    task.reward.weights.action_rate = -0.1;
    let mut env = env(&task, 2, 3);
    let mut sums = [0.0f64; 2];
    for step in 1..=40 {
        let output = env.step(&wiggle(2, step)).unwrap();
        for (sum, reward) in sums.iter_mut().zip(&output.rewards) {
            *sum += f64::from(*reward);
        }
        for episode in &output.episodes {
            let sum = std::mem::take(&mut sums[episode.lane as usize]);
            assert_eq!(episode.return_sum, sum as f32);
            assert_eq!(episode.terms.len(), TERM_COUNT);
            let by_term: f32 = episode.terms.iter().sum();
            assert!((by_term - episode.return_sum).abs() < 1e-5);
            assert!(episode.terms.iter().any(|term| *term < 0.0));
            // The toy's feet are always in contact and move with the base, at 0.1 m/s and less per axis.
            assert_eq!(episode.duty_factor, 1.0);
            assert_eq!(episode.trunk_contact_share, 0.0);
            assert!(episode.mean_speed_mps > 0.0 && episode.mean_speed_mps < 0.142);
            assert!((episode.mean_slip_mps - episode.mean_speed_mps).abs() < 1e-6);
            assert!(episode.mean_power_w > 0.0);
        }
    }
}

#[test]
fn a_diverged_lane_is_counted_reset_and_stays_finite() {
    let cases = [(1, Breakdown::Flagged), (5, Breakdown::Flagged), (5, Breakdown::Unnoticed)];
    for (last, how) in cases {
        let model = model();
        let mut engine = FakeEngine::new(Arc::clone(&model), 2);
        engine.breakdown = Some((1, last as u32, how));
        let mut env = VecEnv::new(model, calm_task(), Box::new(engine), 1, 0).unwrap();
        for step in 1..=30 {
            let before = env.observations()[DIM..].to_vec();
            let output = env.step(&wiggle(2, step)).unwrap().clone();
            assert!(output.rewards.iter().all(|r| r.is_finite()));
            assert_eq!(output.terminated, [false, step == last]);
            if step == last {
                assert_eq!(output.rewards[1], 0.0);
                assert_eq!(output.episodes[0].reason, Some(TerminationReason::Diverged));
                assert_eq!(output.episodes[0].steps, last as u32);
                assert_eq!(output.episodes[0].terms.len(), TERM_COUNT);
                // The last observation that can be trusted.
                assert_eq!(output.final_observations, [(1, before)]);
            }
            assert!(env.observations().iter().all(|o| o.is_finite()), "{how:?} {step}");
            for episode in &output.episodes {
                assert!(episode.return_sum.is_finite() && episode.mean_speed_mps.is_finite());
            }
        }
    }
}

#[test]
fn staggered_first_episodes_do_not_end_together() {
    let mut task = calm_task();
    task.stagger_first_episode = true;
    task.episode_steps = 50;
    let mut env = env(&task, 64, 1);
    let mut first_lengths = vec![None; 64];
    let mut most_at_once = 0;
    for step in 0..200 {
        let output = env.step(&wiggle(64, step)).unwrap();
        most_at_once = most_at_once.max(output.episodes.len());
        for episode in &output.episodes {
            let first = &mut first_lengths[episode.lane as usize];
            match first {
                None => *first = Some(episode.steps),
                Some(_) => assert_eq!(episode.steps, 50),
            }
        }
    }
    let mut lengths: Vec<u32> = first_lengths.into_iter().flatten().collect();
    assert_eq!(lengths.len(), 64);
    lengths.sort_unstable();
    assert!(lengths[0] <= 5 && lengths[63] >= 45, "{lengths:?}");
    assert!(most_at_once <= 8);
}

#[test]
fn reset_all_starts_new_episodes_once() {
    let mut env = env(&calm_task(), 2, 1);
    let first = env.observations().to_vec();
    env.reset_all().unwrap();
    assert_eq!(env.observations(), first, "already at a start");
    env.step(&wiggle(2, 0)).unwrap();
    env.reset_all().unwrap();
    assert_ne!(env.observations(), first, "another episode");
    let second = env.observations().to_vec();
    env.reset_all().unwrap();
    assert_eq!(env.observations(), second);
}

#[test]
fn bad_actions_are_refused_and_change_nothing() {
    let mut env = env(&calm_task(), 2, 1);
    let before = env.snapshot().unwrap();
    assert!(matches!(
        env.step(&[0.0; 31]).unwrap_err(),
        EnvError::Shape { found: 31, expected: 32, .. }
    ));
    let mut actions = vec![0.0; 32];
    actions[18] = f32::NAN;
    assert!(matches!(env.step(&actions).unwrap_err(), EnvError::Action { lane: 1, action: 2, .. }));
    assert_eq!(env.snapshot().unwrap(), before);
}

#[test]
fn engines_that_do_not_fit_are_refused() {
    let model = model();
    let build = |task, lanes| {
        let engine = FakeEngine::new(Arc::clone(&model), lanes);
        VecEnv::new(Arc::clone(&model), task, Box::new(engine), 0, 0).err().unwrap()
    };
    let mut task = calm_task();
    assert!(matches!(build(task.clone(), 0), EnvError::NoLanes));
    task.control_period_s = 0.01;
    let error = build(task.clone(), 1);
    assert_eq!(
        error.to_string(),
        "task.control_period_s is 0.01 s but the engine's dt_s times substeps is 0.02 s; make them equal"
    );
    task = calm_task();
    task.episode_steps = 0;
    assert!(matches!(build(task, 1), EnvError::Task(_)));
}

#[test]
fn the_contract_is_the_robots_and_the_tasks() {
    let task = calm_task();
    let env = env(&task, 1, 1);
    let contract = env.contract();
    contract.validate().unwrap();
    assert_eq!(contract.robot_hash, model().hash_hex());
    assert_eq!(contract.joint_names[8], "FL_hip");
    assert_eq!(contract.phase.feet, ["FL", "FR", "HL", "HR"]);
    assert_eq!((env.obs_dim(), env.act_dim(), env.lanes()), (97, 16, 1));
    let mut other = task.clone();
    other.action.scale = 1.0;
    let other = crate::support::env(&other, 1, 1);
    assert_eq!(contract.differences(other.contract()), [ContractDifference::Action]);
}

/// What is seen of earlier steps is what was seen then; of before a start, what is seen at it.
#[test]
fn the_past_is_what_was_seen() {
    let mut task = calm_task();
    task.noise.enabled = true; // seen once, it stays
    task.observation.past = vec![2, 3];
    let mut env = env(&task, 2, 3);
    let layout = env.contract().observation.clone();
    let dim = 97 + 2 * (3 * 16 + 6);
    assert_eq!(env.obs_dim(), dim);
    let mut shown: Vec<Vec<Vec<f32>>> = vec![Vec::new(); 2];
    let mut starts = 0;
    for step in 0..50 {
        for (lane, row) in env.observations().chunks(dim).enumerate() {
            let newest: Vec<f32> = layout.recalled().flatten().map(|i| row[i]).collect();
            let shown = &mut shown[lane];
            if step % 20 == 0 {
                shown.clear(); // an episode has 20 steps
                starts += 1;
            }
            shown.push(newest);
            let ago = |age: usize| &shown[shown.len().saturating_sub(age + 1)][..];
            assert_eq!(row[97..], [ago(2), ago(3)].concat(), "step {step}, lane {lane}");
        }
        env.step(&wiggle(2, step)).unwrap();
    }
    assert_eq!(starts, 6);
}

/// Weights of which those that are not 0 by default are 0.
fn no_weights() -> RewardWeights {
    RewardWeights {
        tracking_lin_vel: 0.0,
        tracking_yaw_rate: 0.0,
        phase: 0.0,
        power: 0.0,
        ..RewardWeights::default()
    }
}

#[test]
fn a_course_is_steered_for_observed_and_judged_along() {
    let mut task = calm_task();
    task.command.zero_share = 0.0;
    task.command.course_share = 1.0;
    task.command.course_within_rad = 0.8;
    task.command.yaw_rate_radps = [-5.0, 5.0];
    task.reset.base_vel_noise_mps = 0.3;
    task.reward.weights = no_weights();
    task.reward.weights.tracking_lin_vel = 1.0;
    let lanes = 8;
    let mut env = env(&task, lanes, 11);
    let commands: Vec<[f32; 3]> = (0..lanes).map(|lane| env.command(lane)).collect();
    assert!(commands.iter().any(|c| c[2] > 0.1) && commands.iter().any(|c| c[2] < -0.1));
    let heading_rad = env.state().heading_rad.clone();
    let output = env.step(&vec![0.0; lanes * 16]).unwrap().clone();
    for (lane, command) in commands.iter().enumerate() {
        // This engine keeps headings: what is asked for stays, 1/s times the missing angle.
        assert_eq!(env.state().heading_rad[lane], heading_rad[lane]);
        assert!((env.command(lane)[2] - command[2]).abs() < 1e-5);
        let seen = env.observations()[lane * 97 + 46 + 2];
        assert!((seen - command[2]).abs() < 1e-5);
        let course_rad = heading_rad[lane] + command[2];
        let (sin, cos) = course_rad.sin_cos();
        let [x, y] = [0, 1].map(|i| env.state().com_vel_mps[3 * lane + i]);
        let along = [cos * x + sin * y, cos * y - sin * x];
        let error = (command[0] - along[0]).powi(2) + (command[1] - along[1]).powi(2);
        let expected = 0.02 * (-error / task.reward.lin_vel_sigma).exp();
        assert!(
            (output.rewards[lane] - expected).abs() < 1e-6,
            "{} {expected}",
            output.rewards[lane]
        );
    }
    // A command that is set takes the place of the course.
    env.set_command(0, [0.1, 0.0, 0.3]);
    env.step(&vec![0.0; lanes * 16]).unwrap();
    assert_eq!(env.command(0), [0.1, 0.0, 0.3]);
}

#[test]
fn targets_beyond_the_limits_are_counted_before_they_are_cut_off() {
    let mut task = calm_task();
    task.action.scale = 1.0;
    task.action.filter_alpha = 1.0;
    task.action.clip = 4.0;
    task.reward.weights = no_weights();
    task.reward.weights.target_limits = -1.0;
    let mut env = env(&task, 1, 3);
    // The first knee (joint 9): 4 beyond its nominal 0.628319 is 2.795719 beyond its limit of 1.8326; all
    // others rest.
    let mut action = [0.0; 16];
    action[9] = 9.0;
    let reward = env.step(&action).unwrap().rewards[0];
    assert!((reward + 0.02 * 2.795_719).abs() < 1e-4, "{reward}");
}
