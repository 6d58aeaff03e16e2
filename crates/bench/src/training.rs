//! Trainings by the program `caudata-learner`, in one process.

use std::path::Path;
use std::process::Command;

use caudata_config::ConfigArgs;
use caudata_studies::flags;
use caudata_telemetry::PARENT_PID_VAR;

/// The command of a training in `folder`; the preset `quick` where `config` names nothing, and `sets` above it.
pub fn command(
    learner: &Path,
    config: &ConfigArgs,
    sets: &[String],
    run_id: &str,
    folder: &Path,
) -> Command {
    let mut command = Command::new(learner);
    command
        .args(flags::as_words(&flags::or_preset(config, "quick")))
        .args([
            "--inproc",
            "--log-filter",
            "error",
            "--run-id",
            run_id,
            "--run-dir",
        ])
        .arg(folder)
        .env(PARENT_PID_VAR, std::process::id().to_string());
    for set in sets {
        command.args(["--set", set]);
    }
    command
}
