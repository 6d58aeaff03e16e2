//! Robots, ways to train, and how much is trained.

use std::path::{Path, PathBuf};

use caudata_config::{Config, ConfigArgs};
use caudata_declare::named;
use caudata_evaluation::Suite;
use caudata_telemetry::{ExitCode, Failure, FailureExt};
use clap::Args;
use serde::Serialize;

use super::wide;
use crate::{files, flags};

/// How much is trained and tested.
#[derive(Clone, Debug, Args)]
pub struct Effort {
    /// Trainings of each kind, with seeds 1, 2, …; intervals are over them
    #[arg(long, value_name = "N", default_value_t = 3, value_parser = clap::value_parser!(u64).range(1..=100))]
    pub seeds: u64,
    /// Iterations of each training
    #[arg(long, default_value_t = 1000, value_parser = clap::value_parser!(u64).range(1..=10_000_000))]
    pub iterations: u64,
    /// Policy that every training begins with; without it, from nothing
    #[arg(long, value_name = "P.onnx")]
    pub policy: Option<PathBuf>,
    /// Suite of the evaluations: omni has commands in all directions
    #[arg(long, default_value = "omni", value_parser = flags::suite_parser())]
    pub suite: Suite,
    /// Episodes of each scenario; omni has one for each of its 75 commands at least
    #[arg(long, default_value_t = 75, value_parser = clap::value_parser!(u32).range(1..=100_000))]
    pub episodes: u32,
    /// Episodes of each policy on Rapier, a hundred times slower, with forward velocities that change
    #[arg(long, default_value_t = 8, value_parser = clap::value_parser!(u32).range(1..=10_000))]
    pub referee_episodes: u32,
    /// Trains in the true robot's model as well: what could be had
    #[arg(long)]
    pub oracle: bool,
}

/// The three robots.
#[derive(Clone, Debug, Args)]
pub struct Robots {
    /// Robot file as given, without the extension
    #[arg(id = "robot", long = "robot", value_name = "R.robot.toml")]
    pub given: PathBuf,
    /// Extended robot file (`extended.robot.toml` of a diagnosis)
    #[arg(long, value_name = "R.robot.toml")]
    pub extended: PathBuf,
    /// Robot file of the robot that the policies are for, known because it is simulated
    #[arg(long, value_name = "R.robot.toml")]
    pub truth: PathBuf,
}

named! {
    /// A way to train.
    #[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
    #[serde(rename_all = "snake_case")]
    pub enum Way {
        /// In the model as given.
        AsGiven = "as_given",
        /// In the extended model.
        Extended = "extended",
        /// In the model as given, with wide randomisation.
        Wide = "wide",
        /// In the true robot's model.
        Truth = "truth",
    }
}

impl Way {
    /// The robot that it trains in.
    pub fn robot(self, robots: &Robots) -> &Path {
        match self {
            Self::AsGiven | Self::Wide => &robots.given,
            Self::Extended => &robots.extended,
            Self::Truth => &robots.truth,
        }
    }

    /// Keys that are set for it, on top of `config`.
    pub fn set(self, config: &Config) -> Result<Vec<String>, Failure> {
        match self {
            Self::Wide => wide::keys(config),
            _ => Ok(Vec::new()),
        }
    }
}

/// What is trained with, read and checked.
pub struct Given {
    pub(super) flags: ConfigArgs,
    pub(super) config: Config,
    /// SHA-256 of the policy that every training begins with.
    pub(super) start: Option<String>,
}

impl Given {
    /// Reads what the flags name. The preset is flat without them.
    ///
    /// # Errors
    /// Where something is missing or wrong: before anything is made.
    pub fn read(effort: &Effort, config: &ConfigArgs) -> Result<Self, Failure> {
        let flags = flags::or_preset(config, "flat");
        let config = flags.load().or_exit(ExitCode::BadConfig)?;
        let start = effort.policy.clone().or_else(|| config.warm_start_path());
        let start = match start {
            Some(policy) => Some(files::policy(&policy)?.sha256_hex()),
            None => None,
        };
        Ok(Self { flags, config, start })
    }
}
