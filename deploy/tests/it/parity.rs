//! The robot's observation is the trainer's: the same states give the same numbers, over two hundred control
//! periods of motion.

use crate::common::policies::{model, policy_file};
use caudata_deploy::bus::ServoReadings;
use caudata_deploy::runner::{PolicyRunner, View};
use caudata_deploy::state::{PolicyRef, Sha256Digest};
use caudata_deploy::verify::verify;
use caudata_env::VecEnv;
use caudata_policy::evaluate_mlp;
use caudata_task::phase::PhaseClock;
use caudata_task::{PerJoint, TaskConfig};
use sha2::{Digest, Sha256};

/// How far two observations may be apart.
const SAME: f32 = 1e-6;

#[test]
fn the_robot_observes_what_training_observed() {
    assert_eq!(compared(&[]) % 97, 0);
    // 97, and three times 3 · 16 + 6
    assert_eq!(compared(&[2, 4, 6]) % 259, 0);
}

/// Compares all that a policy sees which looks back so many steps, and tells how many numbers that were.
fn compared(past: &[u32]) -> usize {
    let mut task = TaskConfig { stagger_first_episode: false, ..TaskConfig::default() };
    task.noise.enabled = false;
    task.randomisation.enabled = false;
    task.push.enabled = false;
    task.command.zero_share = 0.0;
    // One frequency, so that the robot, which takes the middle of the range, has the same clock.
    task.phase.frequency_hz = [1.375, 1.375];
    task.observation.past = past.to_vec();
    let bytes = policy_file(1, |spec, metadata| {
        // Every joint moves its own way, also with what it sees.
        for (index, weight) in spec.layers[0].weight.iter_mut().enumerate() {
            *weight = 0.05 * (index as f32 * 0.7).sin();
        }
        metadata.contract = caudata_task::PolicyContract::new(&model(), &task).unwrap();
        *spec = spec.widened(metadata.contract.obs_dim());
    });
    let policy = PolicyRef {
        stream: "s".to_owned(),
        version: 1,
        sha256: Sha256Digest(Sha256::digest(&bytes).into()),
        reverts_to: None,
    };
    let verified = verify(bytes.into(), &policy, &model()).unwrap();
    let spec = verified.file.spec().clone();

    let config = caudata_sim::EngineConfig::default();
    let terrain = caudata_sim::TerrainConfig::default();
    let engine = caudata_sim::build(model(), 1, &config, &terrain, 1, 1).unwrap();
    let mut env = VecEnv::new(model(), task, engine, 1, 0).unwrap();
    let clock = PhaseClock::new(env.phases_rad(0)[0], env.stride_frequency_hz(0));
    let mut runner = PolicyRunner::new(verified, Some(&clock)).unwrap();

    let (mut compared, mut moved) = (0, 0.0_f32);
    let look = |env: &VecEnv, runner: &mut PolicyRunner, tick: i32| {
        let truth = env.truth(0);
        let servos = ServoReadings {
            time_s: 0.02 * f64::from(tick),
            pos_rad: truth.joint_pos_rad,
            vel_radps: truth.joint_vel_radps,
            current_a: PerJoint::filled(16, 0.0),
            supply_v: 12.0,
        };
        runner.act(&View {
            servos: &servos,
            gyro_radps: truth.gyro_radps,
            gravity: truth.gravity,
            command: env.command(0),
            in_water: None,
        });
        truth.joint_vel_radps.iter().fold(0.0_f32, |m, v| m.max(v.abs()))
    };
    for tick in 0..200 {
        if tick > 0 {
            runner.advance(1);
        }
        moved = moved.max(look(&env, &mut runner, tick));
        let seen = env.observations();
        for (index, (robot, trainer)) in runner.observation().iter().zip(seen).enumerate() {
            assert!(
                (robot - trainer).abs() <= SAME,
                "tick {tick}, value {index}: {robot} against {trainer}"
            );
            compared += 1;
        }
        let mut action = [0.0; 16];
        evaluate_mlp(&spec, seen, 1, &mut action).unwrap();
        let output = env.step(&action).unwrap();
        if output.terminated[0] || output.truncated[0] {
            break;
        }
    }
    assert!(compared >= 97 * 20, "it fell too soon: {compared}");
    assert!(moved > 0.5, "it hardly moved: {moved}");
    // After a fault, or when it walks again, it begins as an episode does.
    runner.forget();
    look(&env, &mut runner, 200);
    let layout = &env.contract().observation;
    let now: Vec<f32> = layout.recalled().flatten().map(|i| runner.observation()[i]).collect();
    assert_eq!(runner.observation()[97..], now.repeat(past.len()));
    compared
}
