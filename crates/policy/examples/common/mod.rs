//! A policy with random weights for the Polymander, for the examples.

use std::error::Error;
use std::path::Path;

use caudata_model::RobotModel;
use caudata_policy::{Activation, Dense, MlpSpec, PolicyMetadata};
use caudata_random::{Key, Purpose, Stream};
use caudata_task::{PolicyContract, TaskConfig};

/// Metadata for the default task on the Polymander.
pub fn metadata() -> Result<PolicyMetadata, Box<dyn Error>> {
    let robot = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../robots/polymander.robot.toml");
    let contract = PolicyContract::new(&RobotModel::load(&robot)?, &TaskConfig::default())?;
    Ok(PolicyMetadata {
        contract,
        version: 1,
        run_id: "example".to_owned(),
        training_commit: String::new(),
        config_hash: String::new(),
        env_steps: 0,
        seed: 0,
        log_std: vec![-0.5; 16],
        created_unix_s: None,
        evaluation: None,
    })
}

/// Random weights from 97 observations over `hidden` to 16 actions.
pub fn network(hidden: &[usize], activation: Activation) -> MlpSpec {
    let key = Key {
        seed: 0,
        actor: 0,
        env: 0,
        episode: 0,
    };
    let mut random = Stream::new(key, Purpose::Init);
    let widths: Vec<usize> = [&[97], hidden, &[16]].concat();
    let layers = widths
        .windows(2)
        .map(|pair| {
            let (input, out) = (pair[0], pair[1]);
            let scale = (input as f32).sqrt().recip();
            Dense {
                out,
                input,
                weight: (0..out * input).map(|_| scale * random.normal()).collect(),
                bias: vec![0.01; out],
            }
        })
        .collect();
    MlpSpec {
        obs_mean: vec![0.05; 97],
        obs_std: vec![0.8; 97],
        obs_clip: Some(10.0),
        layers,
        activation,
    }
}
