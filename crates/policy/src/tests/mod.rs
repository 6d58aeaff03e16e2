//! Tests of the policy file as a whole, and the policies that they share.

mod averaging;
mod files;
mod hostile;
mod joining;
mod running;

use std::sync::Arc;

use caudata_random::{Key, Purpose, Stream};
use caudata_task::contract::{CommandContract, PhaseContract};
use caudata_task::{ObservationLayout, PolicyContract, TaskConfig};

use crate::{Activation, Dense, MlpSpec, PolicyFile, PolicyMetadata, build_onnx};

const FEET: [&str; 4] = ["FL", "FR", "HL", "HR"];

/// The contract of the default task on a made-up robot: 97 observations, 16 actions.
fn contract() -> PolicyContract {
    let task = TaskConfig::default();
    PolicyContract {
        robot: "newt".to_owned(),
        robot_hash: "ab".repeat(32),
        joint_names: (0..16).map(|i| format!("joint_{i}")).collect(),
        nominal_pos_rad: (0..16).map(|i| i as f32 / 7.0).collect(),
        lower_limit_rad: vec![-1.274_090_3; 16],
        upper_limit_rad: vec![3.0; 16],
        kp_nm_per_rad: vec![15.0; 16],
        kd_nm_s_per_rad: vec![0.15; 16],
        control_period_s: 0.02,
        action: task.action,
        observation: ObservationLayout::new(16, &FEET.map(str::to_owned), false),
        imu: None,
        phase: PhaseContract {
            feet: FEET.map(str::to_owned).to_vec(),
            offsets_rad: vec![0.0, 3.0, 3.0, 0.0],
            frequency_hz: [1.25, 1.5],
            swing_height_m: 0.05,
            stand_command_norm: 0.01,
        },
        command: CommandContract {
            vx_mps: [-0.2, 0.5],
            vy_mps: [-0.1, 0.1],
            yaw_rate_radps: [-0.5, 0.5],
        },
        afloat_above_m: None,
    }
}

fn metadata() -> PolicyMetadata {
    PolicyMetadata {
        contract: contract(),
        version: 41,
        run_id: "2026-01-01_quick".to_owned(),
        training_commit: "abc123".to_owned(),
        config_hash: "def456".to_owned(),
        env_steps: u64::MAX,
        seed: 7,
        log_std: (0..16).map(|i| -0.1 * i as f32).collect(),
        created_unix_s: Some(1_770_000_000),
        evaluation: Some(serde_json::json!({ "speed_mps": 0.1 + 0.2, "falls": 0 })),
    }
}

fn stream(seed: u64) -> Stream {
    Stream::new(Key { seed, actor: 0, env: 0, episode: 0 }, Purpose::Init)
}

fn normals(stream: &mut Stream, count: usize, scale: f32) -> Vec<f32> {
    (0..count).map(|_| scale * stream.normal()).collect()
}

/// A random network from 97 observations over `hidden` to 16 actions.
fn network(hidden: &[usize], activation: Activation, obs_clip: Option<f32>) -> MlpSpec {
    let mut random = stream(1);
    let widths: Vec<usize> = [&[97], hidden, &[16]].concat();
    let layers = widths
        .windows(2)
        .map(|pair| {
            let (input, out) = (pair[0], pair[1]);
            Dense {
                out,
                input,
                weight: normals(&mut random, out * input, (input as f32).sqrt().recip()),
                bias: normals(&mut random, out, 0.1),
            }
        })
        .collect();
    MlpSpec {
        obs_mean: normals(&mut random, 97, 1.0),
        obs_std: normals(&mut random, 97, 1.0).iter().map(|x| x.abs() + 0.1).collect(),
        obs_clip,
        layers,
        activation,
    }
}

/// A file small enough to tamper with each of its bits.
fn small() -> MlpSpec {
    network(&[2], Activation::Swish, Some(5.0))
}

fn bytes(spec: &MlpSpec) -> Arc<[u8]> {
    build_onnx(spec, &metadata()).unwrap().into()
}

fn file(spec: &MlpSpec) -> PolicyFile {
    PolicyFile::parse(bytes(spec)).unwrap()
}
