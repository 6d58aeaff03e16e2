//! Same seed, same bits: across lanes, episodes, and saving and restoring.

use std::sync::Arc;

use crate::support::{FakeEngine, calm_task, env, model, wiggle};
use caudata_env::{StepOutput, VecEnv};
use caudata_task::TaskConfig;

/// Everything random that a task has.
fn busy_task() -> TaskConfig {
    let mut task = TaskConfig { episode_steps: 30, ..TaskConfig::default() };
    task.critic.sees = ["velocity", "friction", "push"].map(str::to_owned).into();
    task.observation.past = vec![1, 4];
    task.command.resample_s = [0.1, 0.3];
    task.command.course_share = 0.5;
    task.push.interval_s = [0.1, 0.2];
    task.push.full_after_env_steps = 1000;
    task
}

/// Steps with actions that use the exploration streams, and notes all there is to see.
fn run(env: &mut VecEnv, steps: std::ops::Range<usize>) -> Vec<(StepOutput, Vec<f32>)> {
    let lanes = env.lanes();
    steps
        .map(|step| {
            let mut actions = wiggle(lanes, step);
            for (i, action) in actions.iter_mut().enumerate() {
                *action += 0.1 * env.action_stream(i / 16).normal();
            }
            env.set_progress(10 * step as u64);
            let output = env.step(&actions).unwrap().clone();
            (output, [env.observations(), env.privileged()].concat())
        })
        .collect()
}

#[test]
fn the_same_seed_gives_the_same_bits() {
    let task = busy_task();
    let (mut a, mut b) = (env(&task, 3, 7), env(&task, 3, 7));
    assert_eq!(run(&mut a, 0..100), run(&mut b, 0..100));
    assert_eq!(a.snapshot().unwrap(), b.snapshot().unwrap());
}

#[test]
fn seeds_actors_and_lanes_differ() {
    let task = busy_task();
    let first = |seed, actor| {
        let model = model();
        let engine = FakeEngine::new(Arc::clone(&model), 2);
        let env = VecEnv::new(model, task.clone(), Box::new(engine), seed, actor).unwrap();
        env.observations().to_vec()
    };
    let base = first(1, 0);
    assert_ne!(base, first(2, 0));
    assert_ne!(base, first(1, 1));
    let (one, other) = base.split_at(base.len() / 2);
    assert_ne!(one, other);
}

#[test]
fn a_lane_does_not_depend_on_the_others() {
    let task = busy_task();
    let (mut alone, mut among) = (env(&task, 1, 7), env(&task, 4, 7));
    let alone = run(&mut alone, 0..100);
    let among = run(&mut among, 0..100);
    for ((a, a_obs), (b, b_obs)) in alone.iter().zip(&among) {
        assert_eq!(a.rewards[0], b.rewards[0]);
        assert_eq!(a_obs[..97], b_obs[..97]);
        assert_eq!(a.truncated[0], b.truncated[0]);
    }
}

#[test]
fn restored_at_any_step_it_goes_on_with_the_same_bits() {
    let task = busy_task();
    for at in [0, 1, 17, 30, 45] {
        let mut original = env(&task, 3, 5);
        run(&mut original, 0..at);
        let saved = original.snapshot().unwrap();
        let mut resumed = env(&task, 3, 5);
        run(&mut resumed, 0..7);
        resumed.restore(&saved).unwrap();
        assert_eq!(resumed.observations(), original.observations());
        assert_eq!(resumed.snapshot().unwrap(), saved);
        assert_eq!(run(&mut resumed, at..at + 70), run(&mut original, at..at + 70), "at {at}");
    }
}

#[test]
fn foreign_and_damaged_snapshots_are_refused_and_change_nothing() {
    let task = busy_task();
    let mut original = env(&task, 2, 5);
    run(&mut original, 0..5);
    let saved = original.snapshot().unwrap();
    let refused = |env: &mut VecEnv, bytes: &[u8], why: &str| {
        let before = env.snapshot().unwrap();
        let message = env.restore(bytes).unwrap_err().to_string();
        assert!(message.contains(why), "{message}");
        assert_eq!(env.snapshot().unwrap(), before);
    };
    refused(&mut env(&task, 3, 5), &saved, "has 2 lanes, expected 3");
    refused(&mut env(&task, 2, 6), &saved, "seed 5");
    let mut other = task.clone();
    other.reward.weights.power = -1.0;
    refused(&mut env(&other, 2, 5), &saved, "[task] configuration");
    other = task.clone();
    other.action.scale = 1.0;
    refused(&mut env(&other, 2, 5), &saved, "contract");
    refused(&mut original, &[], "cannot be read");
    for cut in (1..saved.len()).step_by(97) {
        refused(&mut original, &saved[..cut], "");
    }
}

#[test]
fn turning_sensor_noise_off_leaves_commands_starts_and_pushes_alone() {
    let noisy = busy_task();
    let mut clean = noisy.clone();
    clean.noise.enabled = false;
    let (mut noisy, mut clean) = (env(&noisy, 1, 9), env(&clean, 1, 9));
    for step in 0..80 {
        noisy.step(&wiggle(1, step)).unwrap();
        clean.step(&wiggle(1, step)).unwrap();
        assert_eq!(noisy.command(0), clean.command(0));
        assert_eq!(noisy.state(), clean.state());
    }
    assert_ne!(noisy.observations(), clean.observations());
}

#[test]
fn progress_makes_pushes_grow() {
    let mut task = calm_task();
    task.push.enabled = true;
    task.push.interval_s = [0.02, 0.04];
    task.push.force_n = [5.0, 5.0];
    task.push.full_after_env_steps = 100;
    let moved = |progress| {
        let mut env = env(&task, 1, 3);
        env.set_progress(progress);
        for _ in 0..15 {
            env.step(&[0.0; 16]).unwrap();
        }
        [env.state().base_vel_mps[0], env.state().base_vel_mps[1]]
    };
    let start = moved(0);
    let change = |progress| {
        let v = moved(progress);
        (v[0] - start[0]).hypot(v[1] - start[1])
    };
    assert!(change(100) > 0.01);
    assert!((change(50) / change(100) - 0.5).abs() < 1e-3);
    assert_eq!(change(100), change(100_000));
}

#[test]
fn environments_can_move_between_threads() {
    let mut env = env(&calm_task(), 2, 1);
    let expected = run(&mut env, 0..3);
    let moved = std::thread::spawn(|| {
        let mut env = crate::support::env(&calm_task(), 2, 1);
        let output = run(&mut env, 0..3);
        (env, output)
    });
    let (mut moved, found) = moved.join().unwrap();
    assert_eq!(found, expected);
    assert_eq!(run(&mut moved, 3..6), run(&mut env, 3..6));
}
