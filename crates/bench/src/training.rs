//! Trainings in a folder of their own, which are listened to.

use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{ExitStatus, Stdio};

use caudata_config::ConfigArgs;
use caudata_studies::{flags, training};
use caudata_telemetry::progress::Event;
use caudata_telemetry::{ExitCode, Failure, FailureExt};

/// Trains with the program `learner`: the preset `quick` where `config` names nothing, and `sets` above it.
/// `hear` is told the process and what it says.
///
/// # Errors
/// Where the training cannot be started.
pub fn run(
    learner: &Path,
    config: &ConfigArgs,
    sets: &[String],
    run_id: &str,
    mut hear: impl FnMut(u32, Event),
) -> Result<ExitStatus, Failure> {
    let folder = tempfile::tempdir().or_exit(ExitCode::CannotCreate)?;
    let mut words = flags::as_words(&flags::or_preset(config, "quick"));
    for set in sets {
        words.extend(["--set".into(), set.into()]);
    }
    let mut child = training::command(learner, &words, run_id, folder.path())
        .stdout(Stdio::piped())
        .spawn()
        .or_exit(ExitCode::OsResource)?;
    let process = child.id();
    if let Some(stdout) = child.stdout.take() {
        for line in BufReader::new(stdout).lines() {
            // What later versions may say is none of these.
            if let Ok(event) = serde_json::from_str(&line.or_exit(ExitCode::Internal)?) {
                hear(process, event);
            }
        }
    }
    child.wait().or_exit(ExitCode::OsResource)
}
