//! Trainings by the program `caudata-learner`, learner and actors in one process.

use std::ffi::OsString;
use std::path::Path;
use std::process::{Command, Stdio};

use caudata_telemetry::PARENT_PID_VAR;

/// The command of a training in `folder`; `config` are the flags that configure it.
pub fn command(learner: &Path, config: &[OsString], run_id: &str, folder: &Path) -> Command {
    let mut command = Command::new(learner);
    command
        .args(config)
        .args(["--inproc", "--log-filter", "error", "--run-id", run_id, "--run-dir"])
        .arg(folder)
        .env(PARENT_PID_VAR, std::process::id().to_string())
        .stdin(Stdio::null());
    command
}
