//! Environment steps per second, and what several benchmarks need.

use std::sync::Arc;

use caudata_actor::build_env;
use caudata_config::{Config, ConfigArgs};
use caudata_policy::{Activation, Dense, MlpSpec, PolicyMetadata, build_onnx};
use caudata_studies::{files, flags};
use caudata_task::{PerJoint, PolicyContract};
use caudata_telemetry::{ExitCode, Failure, FailureExt};
use clap::Args;
use serde_json::json;

use crate::measure::{Rate, rate};

/// How long to measure.
#[derive(Clone, Copy, Debug, Args)]
pub struct Time {
    /// How long to measure, s
    #[arg(long, default_value_t = 3.0, value_parser = seconds)]
    pub seconds: f64,
}

fn seconds(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(seconds) if (0.0..=86_400.0).contains(&seconds) => Ok(seconds),
        _ => Err("must be 0 to 86400 s".to_owned()),
    }
}

/// What the flags say; the preset `quick` where they name nothing.
///
/// # Errors
/// Exit code 64 where they are wrong.
pub fn config(flags: &ConfigArgs) -> Result<Config, Failure> {
    flags::or_preset(flags, "quick").load().or_exit(ExitCode::BadConfig)
}

/// Environment steps per second of this configuration: physics, task and resets.
///
/// # Errors
/// Where the environments cannot be built or stepped.
pub fn environment_steps(seconds: f64, config: &Config) -> Result<Rate, Failure> {
    let (lanes, threads) = (config.actors.lanes, config.actors.threads);
    let model = Arc::new(files::robot(&config.robot_path())?);
    let mut env = build_env(config, model, 0).map_err(|error| error.into_failure())?;
    env.reset_all().or_exit(ExitCode::Internal)?;
    // A gait-like motion, so that contacts come and go.
    let width = env.act_dim();
    let mut actions = vec![0.0f32; lanes as usize * width];
    let mut step = 0u32;
    let settings = json!({
        "engine": config.engine.kind, "lanes": lanes, "threads": threads,
        "dt_s": config.engine.dt_s, "substeps": config.engine.substeps,
    });
    rate("sim", ("environment steps", lanes), seconds, settings, || {
        // Once for all lanes: a sine per lane and joint would be a fortieth of what is measured.
        let action: PerJoint =
            PerJoint::from_fn(width, |i| 0.5 * (step as f32 * 0.16 + i as f32).sin());
        for lane in actions.chunks_exact_mut(width) {
            lane.copy_from_slice(&action);
        }
        step += 1;
        env.step(&actions).map(|_| ()).or_exit(ExitCode::Internal)
    })
}

/// A policy file with made-up weights: only its size matters.
///
/// # Errors
/// Where it cannot be written as ONNX.
pub fn example_policy(
    contract: &PolicyContract,
    hidden: &[u32],
    run_id: &str,
    version: u64,
) -> Result<Vec<u8>, Failure> {
    let sizes: Vec<usize> = std::iter::once(contract.obs_dim())
        .chain(hidden.iter().map(|&n| n as usize))
        .chain([contract.act_dim()])
        .collect();
    let layers = sizes
        .windows(2)
        .map(|pair| Dense {
            input: pair[0],
            out: pair[1],
            weight: (0..pair[0] * pair[1]).map(|i| 0.05 * (i as f32).sin()).collect(),
            bias: vec![0.0; pair[1]],
        })
        .collect();
    let spec = MlpSpec {
        obs_mean: vec![0.0; contract.obs_dim()],
        obs_std: vec![1.0; contract.obs_dim()],
        obs_clip: Some(10.0),
        layers,
        activation: Activation::Elu,
    };
    let metadata = PolicyMetadata {
        contract: contract.clone(),
        version,
        run_id: run_id.into(),
        training_commit: String::new(),
        config_hash: String::new(),
        env_steps: 0,
        seed: 0,
        log_std: vec![0.0; contract.act_dim()],
        created_unix_s: None,
        evaluation: None,
    };
    build_onnx(&spec, &metadata).or_exit(ExitCode::Internal)
}
