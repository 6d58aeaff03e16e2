//! The task on the Rapier engine: the same promises as on the toy, and a robot that stands.

use std::sync::Arc;

use crate::support::{model, wiggle};
use caudata_env::VecEnv;
use caudata_sim::{EngineConfig, TerrainConfig};
use caudata_task::TaskConfig;

const ACT_DIM: usize = 16;

fn env(task: &TaskConfig, lanes: usize, threads: usize) -> VecEnv {
    let model = model();
    let engine = caudata_sim::build(
        Arc::clone(&model),
        lanes,
        &EngineConfig::rapier(),
        &TerrainConfig::default(),
        1,
        threads,
    )
    .unwrap();
    VecEnv::new(model, task.clone(), engine, 1, 0).unwrap()
}

/// Everything random, short episodes.
fn busy_task() -> TaskConfig {
    let mut task = TaskConfig { episode_steps: 12, ..TaskConfig::default() };
    task.push.interval_s = [0.05, 0.1];
    task.command.resample_s = [0.05, 0.1];
    task
}

type Trace = Vec<(Vec<f32>, Vec<bool>, Vec<f32>)>;

fn run(env: &mut VecEnv, steps: std::ops::Range<usize>) -> Trace {
    steps
        .map(|step| {
            let output = env.step(&wiggle(env.lanes(), step)).unwrap();
            let (rewards, truncated) = (output.rewards.clone(), output.truncated.clone());
            (rewards, truncated, env.observations().to_vec())
        })
        .collect()
}

#[test]
fn the_same_bits_on_any_number_of_threads_and_after_restoring() {
    let task = busy_task();
    let (mut one, mut two) = (env(&task, 3, 1), env(&task, 3, 2));
    let expected = run(&mut one, 0..15);
    assert_eq!(run(&mut two, 0..15), expected);
    assert!(expected.iter().any(|(_, truncated, _)| truncated.contains(&true)));
    assert!(
        expected
            .iter()
            .all(|(rewards, _, obs)| { rewards.iter().chain(obs).all(|value| value.is_finite()) })
    );
    let saved = one.snapshot().unwrap();
    let mut resumed = env(&task, 3, 1);
    resumed.restore(&saved).unwrap();
    assert_eq!(run(&mut resumed, 15..30), run(&mut one, 15..30));
    assert_eq!(resumed.snapshot().unwrap(), one.snapshot().unwrap());
}

#[test]
fn a_robot_told_to_stand_stands() {
    let mut task = crate::support::calm_task();
    task.episode_steps = 100;
    task.command.zero_share = 1.0;
    task.reset.joint_pos_noise_rad = 0.0;
    task.reset.base_vel_noise_mps = 0.0;
    let mut env = env(&task, 1, 1);
    let mut last = Vec::new();
    for _ in 0..100 {
        let output = env.step(&[0.0; ACT_DIM]).unwrap();
        assert!(!output.terminated[0]);
        last.extend(output.episodes.clone());
    }
    let [episode] = &last[..] else { panic!("one episode, found {}", last.len()) };
    // Nothing is asked for and nothing moves: all three rewarding terms are near their most, 2.5·0.02·100 =
    // 5.
    assert!(episode.return_sum > 4.5, "{episode:?}");
    assert!(episode.duty_factor > 0.9 && episode.mean_speed_mps < 0.05, "{episode:?}");
    assert!(episode.mean_power_w < 2.0, "{episode:?}");
    let gravity = &env.observations()[35..38];
    assert!(gravity[2] < -0.99, "{gravity:?}");
}
