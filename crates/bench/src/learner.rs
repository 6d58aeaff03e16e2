//! Updates of the learner on made-up data: asks the learner's own program, the only one with libtorch.

use std::path::Path;
use std::process::{Command, Stdio};

use caudata_config::ConfigArgs;
use caudata_studies::flags;
use caudata_telemetry::{ExitCode, Failure, FailureExt};
use clap::Args;
use serde_json::Value;

use crate::parts::Time;

/// Which updates.
#[derive(Clone, Debug, Args)]
pub struct Plan {
    #[command(flatten)]
    time: Time,
    /// Networks, batch and threads; the preset `quick` without these flags
    #[command(flatten)]
    config: ConfigArgs,
}

/// What the program `learner` found, as it says it.
///
/// # Errors
/// Where it cannot be started or fails.
pub fn run(plan: &Plan, learner: &Path) -> Result<Value, Failure> {
    let output = Command::new(learner)
        .args(["bench", "--seconds", &plan.time.seconds.to_string()])
        .args(flags::as_words(&flags::or_preset(&plan.config, "quick")))
        .stderr(Stdio::inherit())
        .output()
        .or_exit(ExitCode::OsResource)?;
    if !output.status.success() {
        let message = format!("caudata-learner bench ended with {}", output.status);
        return Err(Failure::message(ExitCode::Internal, message));
    }
    serde_json::from_slice(&output.stdout).or_exit(ExitCode::Internal)
}
