//! `caudata tune`: settings of a training that runs.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use caudata_config::{Changes, Config, Source};
use caudata_durable::{Owner, OwnerError};
use caudata_studies::files;
use caudata_telemetry::{ExitCode, Failure, FailureExt, Process};
use clap::Args;
use serde_json::json;

use crate::commands::train::desk::Desk;
use crate::say;

/// How long the learner may take to the end of its iteration.
const TAKEN_WITHIN: Duration = Duration::from_secs(120);
/// Pause between two looks.
const LOOK_EVERY: Duration = Duration::from_millis(50);

#[derive(Debug, Args)]
pub struct Wish {
    /// Its run folder
    #[arg(value_name = "RUN")]
    run: PathBuf,
    /// What shall change, for instance task.reward.weights.bend=-1.0; without any, what may change is listed
    #[arg(value_name = "KEY=VALUE")]
    set: Vec<String>,
}

pub fn run(wish: &Wish, as_json: bool, process: &Process) -> Result<(), Failure> {
    let folder = &wish.run;
    files::run_folder(folder)?;
    let file = folder.join("config.toml");
    let first = Config::load(&Source::file(&file)).or_exit(ExitCode::NoInput)?;
    let desk = Desk::open(folder, &first)?;
    if wish.set.is_empty() {
        let settings = desk.settings();
        return say::either(as_json, &settings, |settings| {
            for (key, value) in &settings.values {
                say::line(format!("{key} = {value}"));
            }
            for change in &settings.made {
                let (at, set) = (change.iteration, change.set.join(", "));
                say::line(format!("recorded, after iteration {at}: {set}"));
            }
        });
    }
    if !is_trained(folder)? {
        let message = format!("no training runs in {}", folder.display());
        return Err(Failure::message(ExitCode::NoInput, message)
            .hint("to begin with other settings: caudata train --set KEY=VALUE"));
    }
    let before = Changes::of_run(folder, &first).or_exit(ExitCode::BadInput)?;
    let request = desk.ask(&wish.set).or_exit(ExitCode::BadConfig)?;
    let began = Instant::now();
    while request.exists() {
        let stopped = process.stop.wait(LOOK_EVERY);
        let trained = is_trained(folder)?;
        if stopped || !trained || began.elapsed() > TAKEN_WITHIN {
            let _ = std::fs::remove_file(&request);
            let (code, message) = match trained {
                true => (ExitCode::TempFail, "the learner has not taken the change"),
                false => (ExitCode::Unavailable, "the training has ended"),
            };
            return Err(Failure::message(code, format!("{message}; it is withdrawn")));
        }
    }
    let after = Changes::of_run(folder, &first).or_exit(ExitCode::BadInput)?;
    let more = after.change.len() > before.change.len();
    let made = after.change.iter().rfind(|change| change.set == wish.set);
    let Some(made) = made.filter(|_| more) else {
        let message = "the learner refused the change, or has ended";
        return Err(Failure::message(ExitCode::Unavailable, message)
            .hint("the training's own output says why"));
    };
    let iteration = made.iteration;
    say::either(as_json, &json!({ "iteration": iteration, "set": wish.set }), |_| {
        say::line(format!("changed after iteration {iteration}"));
    })
}

/// Whether a learner works in `folder`.
fn is_trained(folder: &Path) -> Result<bool, Failure> {
    match Owner::now(&folder.join(caudata_actor::LEARNER_LOCK)) {
        Err(OwnerError::Taken { .. }) => Ok(true),
        Err(error) => Err(error).or_exit(ExitCode::NoInput),
        Ok(_) => Ok(false),
    }
}
