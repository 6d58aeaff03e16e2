//! Policies that were trained in Python, as files that every program takes.

use caudata_policy::{Activation, Dense, MlpSpec, PolicyError, PolicyMetadata, build_onnx};
use caudata_task::PolicyContract;
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;

/// What a policy computes: `layers(clip((obs - obs_mean) / obs_std))`.
#[derive(FromPyObject)]
#[pyo3(from_item_all)]
pub struct Network {
    /// `[D]`.
    obs_mean: Vec<f32>,
    /// `[D]`, above 0.
    obs_std: Vec<f32>,
    obs_clip: Option<f32>,
    activation: ActivationName,
    /// Weight `[out, in]` and bias `[out]` of each layer.
    layers: Vec<(Vec<Vec<f32>>, Vec<f32>)>,
    /// `[A]`, of the exploration.
    log_std: Vec<f32>,
}

/// Where a policy comes from.
#[derive(FromPyObject)]
#[pyo3(from_item_all)]
pub struct Origin {
    run_id: String,
    env_steps: u64,
    seed: u64,
}

struct ActivationName(Activation);

impl FromPyObject<'_, '_> for ActivationName {
    type Error = PyErr;

    fn extract(word: Borrowed<'_, '_, PyAny>) -> PyResult<Self> {
        let word: String = word.extract()?;
        serde_json::from_value(serde_json::Value::String(word.clone())).map(Self).map_err(|_| {
            let why = format!("`{word}` is no activation of a policy file: elu, swish, tanh, relu");
            PyValueError::new_err(why)
        })
    }
}

/// The bytes of a policy file.
pub fn policy_file(
    contract: PolicyContract,
    config_hash: String,
    network: Network,
    origin: Origin,
) -> Result<Vec<u8>, PolicyError> {
    let dense = |(weight, bias): (Vec<Vec<f32>>, Vec<f32>)| Dense {
        out: bias.len(),
        input: weight.first().map_or(0, Vec::len),
        weight: weight.concat(),
        bias,
    };
    let spec = MlpSpec {
        obs_mean: network.obs_mean,
        obs_std: network.obs_std,
        obs_clip: network.obs_clip,
        layers: network.layers.into_iter().map(dense).collect(),
        activation: network.activation.0,
    };
    let metadata = PolicyMetadata {
        contract,
        version: 1,
        run_id: origin.run_id,
        training_commit: String::new(),
        config_hash,
        env_steps: origin.env_steps,
        seed: origin.seed,
        log_std: network.log_std,
        created_unix_s: None,
        evaluation: None,
    };
    build_onnx(&spec, &metadata)
}
