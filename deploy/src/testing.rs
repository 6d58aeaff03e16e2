//! What the tests of this crate share: small but real policy files for the real robot.

use std::path::Path;
use std::sync::{Arc, LazyLock};

use caudata_model::RobotModel;
use caudata_policy::{Activation, Dense, MlpSpec, PolicyMetadata, build_onnx};
use caudata_task::{PolicyContract, TaskConfig};

/// The robot file of the repository; crates of several depths take this module in.
pub static ROBOT_FILE: LazyLock<String> = LazyLock::new(|| {
    let roots = Path::new(env!("CARGO_MANIFEST_DIR")).ancestors();
    let mut files = roots.map(|root| root.join("robots/polymander.robot.toml"));
    let file = files.find(|file| file.exists()).unwrap();
    file.to_str().unwrap().to_owned()
});

/// The real robot.
pub fn model() -> Arc<RobotModel> {
    Arc::new(RobotModel::load(Path::new(ROBOT_FILE.as_str())).unwrap())
}

/// A policy file of one layer: every action is `0.01 · version` of the sum of the observation, plus 0.1.
/// `change` makes it what a test needs.
pub fn policy_file(
    version: u64,
    change: impl FnOnce(&mut MlpSpec, &mut PolicyMetadata),
) -> Vec<u8> {
    let contract = PolicyContract::new(&model(), &TaskConfig::default()).unwrap();
    let (obs, act) = (contract.obs_dim(), contract.act_dim());
    let mut spec = MlpSpec {
        obs_mean: vec![0.0; obs],
        obs_std: vec![1.0; obs],
        obs_clip: None,
        layers: vec![Dense {
            out: act,
            input: obs,
            weight: vec![0.01 * version as f32; act * obs],
            bias: vec![0.1; act],
        }],
        activation: Activation::Elu,
    };
    let mut metadata = PolicyMetadata {
        contract,
        version,
        run_id: "run-1".into(),
        training_commit: String::new(),
        config_hash: String::new(),
        env_steps: 10 * version,
        seed: 1,
        log_std: vec![0.0; act],
        created_unix_s: None,
        evaluation: None,
    };
    change(&mut spec, &mut metadata);
    build_onnx(&spec, &metadata).unwrap()
}

/// A policy that stands: zero weights, zero bias.
pub fn standing(version: u64) -> Vec<u8> {
    policy_file(version, |spec, _| {
        spec.layers[0].weight.fill(0.0);
        spec.layers[0].bias.fill(0.0);
    })
}

/// A policy whose joints all swing as one with the gait's phase: it goes nowhere.
pub fn swinging(version: u64) -> Vec<u8> {
    following_the_phase(version, |_, _| Some((0, 0.5)))
}

/// A policy that trots on ideal servos: each leg comes forward in the air and goes back on the ground.
pub fn stepping(version: u64) -> Vec<u8> {
    following_the_phase(version, |leg, joint| {
        let sin_or_cos = match joint {
            "hip" => 0,
            "knee" => 1,
            _ => return None,
        };
        // of its diagonal: cos and sin of the one, then of the other
        let diagonal = usize::from(matches!(leg, "FR" | "HL"));
        Some((2 * diagonal + sin_or_cos, 0.4))
    })
}

/// One layer that takes of the gait's phase, for the joint of a leg, a number and its weight.
fn following_the_phase(
    version: u64,
    column: impl Fn(&str, &str) -> Option<(usize, f32)>,
) -> Vec<u8> {
    policy_file(version, |spec, metadata| {
        let phase = metadata.contract.observation.slice("phase").unwrap();
        let input = spec.layers[0].input;
        spec.layers[0].weight.fill(0.0);
        spec.layers[0].bias.fill(0.0);
        let rows = spec.layers[0].weight.chunks_mut(input);
        for (row, name) in rows.zip(model().actuated_names()) {
            let (leg, joint) = name.split_once('_').unwrap();
            if let Some((number, weight)) = column(leg, joint) {
                row[phase.start + number] = weight;
            }
        }
    })
}
