//! Policies made by hand, whose verdict is known.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

use std::f64::consts::TAU;
use std::path::Path;
use std::sync::Arc;

use caudata_config::{Config, ConfigArgs};
use caudata_evaluation::{Scenario, ScenarioResult, Settings, run_scenario};
use caudata_model::RobotModel;
use caudata_policy::{Activation, Dense, MlpSpec, PolicyFile, PolicyMetadata, build_onnx};
use caudata_task::{ACT_DIM, PolicyContract, layout};

/// Episodes of each verdict, and their length.
fn settings() -> Settings {
    Settings {
        episodes: 2,
        episode_s: 6.0,
        ..Settings::default()
    }
}

fn config() -> Config {
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

fn policy(contract: &PolicyContract, layers: Vec<Dense>) -> PolicyFile {
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

fn layer(out: usize, input: usize) -> Dense {
    Dense {
        out,
        input,
        weight: vec![0.0; out * input],
        bias: vec![0.0; out],
    }
}

/// Every leg joint swings at `frequency_hz`: aₜ = tanh(g·(2·cos ω·aₜ₋₁ − aₜ₋₂)), an oscillator fed by the policy's own past actions.
fn vibrating(contract: &PolicyContract, frequency_hz: f64) -> PolicyFile {
    const GAIN: f32 = 1.3;
    let obs = contract.obs_dim();
    let mut hidden = layer(ACT_DIM, obs);
    let mut output = layer(ACT_DIM, ACT_DIM);
    let turn = (2.0 * (TAU * frequency_hz * 0.02).cos()) as f32;
    for j in 8..ACT_DIM {
        let row = &mut hidden.weight[j * obs..][..obs];
        row[layout::ACTIONS + j] = GAIN * turn;
        row[layout::ACTIONS + ACT_DIM + j] = -GAIN;
        // pairs of legs in opposition; it also starts the oscillation
        hidden.bias[j] = if (j / 2) % 2 == 0 { 0.05 } else { -0.05 };
        output.weight[j * ACT_DIM + j] = 1.0;
    }
    policy(contract, vec![hidden, output])
}

fn verdict(make: impl Fn(&PolicyContract) -> PolicyFile) -> ScenarioResult {
    let config = config();
    let robot = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../robots/polymander.robot.toml");
    let model = Arc::new(RobotModel::load(&robot).unwrap());
    let contract = PolicyContract::new(&model, &config.task).unwrap();
    let scenario = Scenario::walk("by hand", [0.3, 0.0, 0.0]);
    let policy = make(&contract);
    let outcome = run_scenario(&config, &model, &policy, &scenario, &settings(), &|| true).unwrap();
    assert_eq!(outcome.result.episodes, 2);
    outcome.result
}

#[test]
fn a_vibrating_policy_is_not_called_walking() {
    let result = verdict(|contract| vibrating(contract, 7.5));
    assert_eq!(result.walks(), Some(false));
    let missed = result.gates.as_ref().unwrap().missed();
    assert!(missed.contains(&"joint power above 6 Hz"), "{missed:?}");
    assert!(
        missed.contains(&"stride frequency off the clock"),
        "{missed:?}"
    );
    assert!(
        (result.stride_hz.mean - 7.5).abs() < 1.0,
        "{:?}",
        result.stride_hz
    );
}

#[test]
fn a_standing_policy_is_not_called_walking() {
    let result = verdict(|contract| policy(contract, vec![layer(ACT_DIM, contract.obs_dim())]));
    assert_eq!(result.walks(), Some(false));
    assert!(result.drift_mps.mean < 0.01, "{:?}", result.drift_mps);
    assert!(result.power_w.mean < 1.0, "{:?}", result.power_w);
    let missed = result.gates.as_ref().unwrap().missed();
    assert!(missed.contains(&"clearance, m"), "{missed:?}");
}

#[test]
fn the_same_seed_gives_the_same_figures() {
    let run = || verdict(|contract| vibrating(contract, 5.0));
    assert_eq!(run(), run());
}
