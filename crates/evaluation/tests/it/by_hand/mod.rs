//! Policies made by hand.

use std::f64::consts::TAU;
use std::path::Path;
use std::sync::Arc;

use caudata_config::{Config, ConfigArgs};
use caudata_model::RobotModel;
use caudata_policy::{Activation, Dense, MlpSpec, PolicyFile, PolicyMetadata, build_onnx};
use caudata_task::PolicyContract;
use caudata_task::layout::Part;

const ACT_DIM: usize = 16;

pub fn config() -> Config {
    let args = ConfigArgs {
        preset: Some("quick".into()),
        overrides: vec![
            // lets fast motion through, as in the paper's unstated defaults
            "task.action.filter_alpha=0.5".into(),
            "task.action.scale=0.5".into(),
            "task.noise.enabled=false".into(),
        ],
        ..ConfigArgs::default()
    };
    args.load().unwrap()
}

pub fn policy(contract: &PolicyContract, layers: Vec<Dense>) -> PolicyFile {
    let obs = contract.obs_dim();
    let spec = MlpSpec {
        obs_mean: vec![0.0; obs],
        obs_std: vec![1.0; obs],
        obs_clip: None,
        layers,
        activation: Activation::Tanh,
    };
    let metadata = PolicyMetadata {
        contract: contract.clone(),
        version: 1,
        run_id: "by-hand".into(),
        training_commit: String::new(),
        config_hash: String::new(),
        env_steps: 0,
        seed: 1,
        log_std: vec![0.0; ACT_DIM],
        created_unix_s: None,
        evaluation: None,
    };
    PolicyFile::parse(Arc::from(build_onnx(&spec, &metadata).unwrap())).unwrap()
}

pub fn layer(out: usize, input: usize) -> Dense {
    Dense { out, input, weight: vec![0.0; out * input], bias: vec![0.0; out] }
}

/// Every leg joint swings at `frequency_hz`: aₜ = tanh(g·(2·cos ω·aₜ₋₁ − aₜ₋₂)), an oscillator fed by the
/// policy's own past actions.
pub fn vibrating(contract: &PolicyContract, frequency_hz: f64) -> PolicyFile {
    const GAIN: f32 = 1.3;
    let obs = contract.obs_dim();
    let actions = contract.observation.range(Part::Actions).start;
    let mut hidden = layer(ACT_DIM, obs);
    let mut output = layer(ACT_DIM, ACT_DIM);
    let turn = (2.0 * (TAU * frequency_hz * 0.02).cos()) as f32;
    for j in 8..ACT_DIM {
        let row = &mut hidden.weight[j * obs..][..obs];
        row[actions + j] = GAIN * turn;
        row[actions + ACT_DIM + j] = -GAIN;
        // pairs of legs in opposition; it also starts the oscillation
        hidden.bias[j] = if (j / 2) % 2 == 0 { 0.05 } else { -0.05 };
        output.weight[j * ACT_DIM + j] = 1.0;
    }
    policy(contract, vec![hidden, output])
}

/// Swims: yaw joint j follows the gait clock `lag_rad`·j late, with an amplitude that grows from 0.1 to 0.5
/// rad towards the tail; legs folded back.
pub fn swimming(contract: &PolicyContract, lag_rad: f32) -> PolicyFile {
    const YAW_JOINTS: usize = 8;
    let model = robot();
    let scale = contract.action.scale;
    let mut output = layer(ACT_DIM, contract.obs_dim());
    let phase = contract.observation.range(Part::Phase).start;
    for j in 0..YAW_JOINTS {
        let amplitude = (0.1 + 0.4 * j as f32 / 7.0) / scale;
        let (sin, cos) = (lag_rad * j as f32).sin_cos();
        let row = &mut output.weight[j * contract.obs_dim()..];
        // cos(φ − lag) from the clock of the first foot
        row[phase] = amplitude * cos;
        row[phase + 1] = amplitude * sin;
    }
    let folded = model.swimming_pos_rad().unwrap();
    for j in YAW_JOINTS..ACT_DIM {
        output.bias[j] = (folded[j] as f32 - contract.nominal_pos_rad[j]) / scale;
    }
    policy(contract, vec![output])
}

/// The robot that this project is about.
pub fn robot() -> Arc<RobotModel> {
    let robot = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../robots/polymander.robot.toml");
    Arc::new(RobotModel::load(&robot).unwrap())
}
