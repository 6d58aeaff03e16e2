//! `caudata config`: the configuration in effect.

use std::path::Path;

use caudata_config::{Config, ConfigArgs, PRESETS, TransportKind, can_walk};
use caudata_model::BaseKind;
use caudata_signing::pki::CERTIFICATE_FILE;
use caudata_sim::{EngineKind, Terrain};
use caudata_studies::{files, flags};
use caudata_task::{Critic, Mirror, PolicyContract};
use caudata_telemetry::{ExitCode, Failure, FailureExt};
use clap::{Args, Subcommand};

use crate::commands::robot;
use crate::say;

#[derive(Debug, Subcommand)]
pub enum ConfigCommand {
    /// Print every key with its value in effect, as TOML
    Show(ShowArgs),
    /// Check a configuration against its robot, as a training would, and say only that it is good
    Check(ConfigArgs),
    /// List the presets
    Presets,
}

#[derive(Debug, Args)]
pub struct ShowArgs {
    #[command(flatten)]
    config: ConfigArgs,
    /// One JSON object instead of TOML
    #[arg(long)]
    json: bool,
}

pub fn run(command: &ConfigCommand) -> Result<(), Failure> {
    match command {
        ConfigCommand::Show(args) => show(args),
        ConfigCommand::Check(args) => {
            let config = (flags::of_robot(args).load()).or_exit(ExitCode::BadConfig)?;
            fits(&config)?;
            say::line(format!("good; hash {}", config.hash_hex()));
            note_certificates(&config);
            Ok(())
        }
        ConfigCommand::Presets => {
            let rows = PRESETS.iter().map(|preset| vec![preset.name.into(), preset.about.into()]);
            say::table(&[], rows);
            Ok(())
        }
    }
}

/// Refuses what only shows with the robot, the ground and the policy to begin with at hand; a training asks
/// before it begins.
pub fn fits(config: &Config) -> Result<(), Failure> {
    let model = robot::load(&config.robot_path())?;
    if model.base() == BaseKind::Fixed {
        can_walk(&model).or_exit(ExitCode::BadConfig)?;
    }
    let contract = PolicyContract::new(&model, &config.task).or_exit(ExitCode::BadConfig)?;
    Critic::new(&config.task.critic, contract.names()).or_exit(ExitCode::BadConfig)?;
    if config.learner.network.symmetric {
        Mirror::new(&model, &contract.observation).or_exit(ExitCode::BadConfig)?;
    }
    Terrain::generate(&config.terrain, config.run.seed)
        .and_then(|terrain| terrain.check_robot(&model))
        .or_exit(ExitCode::BadConfig)?;
    if config.engine.kind == EngineKind::Mujoco && config.transport.kind == TransportKind::Inproc {
        let message = "engine.kind = mujoco: it does not go on from a checkpoint";
        return Err(Failure::message(ExitCode::BadConfig, message)
            .hint("train on batch; `caudata eval --engine mujoco` measures the policy there"));
    }
    config.warm_start_path().map_or(Ok(()), |path| begins_with(&path, &contract))
}

/// The learner compares layers, too.
fn begins_with(path: &Path, contract: &PolicyContract) -> Result<(), Failure> {
    let policy = files::policy(path)?;
    let theirs = &policy.metadata().contract;
    let what = match contract.observation.begins_with(&theirs.observation) {
        _ if theirs.joint_names != contract.joint_names => {
            "is for other joints, or another order of them"
        }
        false => "has an observation that is no beginning of this task's",
        true => return Ok(()),
    };
    let message = format!("learner.warm_start.policy: {} {what}", path.display());
    Err(Failure::message(ExitCode::PolicyRefused, message))
}

/// A cluster's file is also checked where none of its processes runs.
fn note_certificates(config: &Config) {
    if config.transport.kind != TransportKind::Zenoh {
        return;
    }
    for role in ["server", "learner", "actor"] {
        let folder = config.cluster.certificates(role).unwrap_or_default();
        if folder != Path::new("") && !folder.join(CERTIFICATE_FILE).is_file() {
            let folder = folder.display();
            say::line(format!("note: no certificate in {folder}: no {role} starts on this host"));
        }
    }
}

fn show(args: &ShowArgs) -> Result<(), Failure> {
    let config = (flags::of_robot(&args.config).load()).or_exit(ExitCode::BadConfig)?;
    if args.json {
        return say::json(&config);
    }
    say::line(config.to_toml().or_exit(ExitCode::BadConfig)?.trim_end());
    Ok(())
}
