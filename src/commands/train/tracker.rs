//! A tracker beside a training: the Python package `caudata` reads the run folder, the tracker's own package sends it
//! on. A training never waits for it, and never fails with it.

use std::ffi::OsStr;
use std::process::Command;
use std::thread::JoinHandle;
use std::time::Duration;

use caudata_telemetry::{ExitCode, Failure, FailureExt};
use clap::ValueEnum;
use crossbeam_channel::{Receiver, RecvTimeoutError, Sender, bounded};
use nix::sys::signal::Signal;

use super::children::{LineSink, Process, describe};
use super::folder::RunFolder;
use super::view::View;

/// Names the Python that trackers run in.
const PYTHON: &str = "CAUDATA_PYTHON";
/// How often the tracker is looked at.
const TRACKER_LOOK_EVERY: Duration = Duration::from_millis(100);
/// How long it may take to hand over what is left once the run is over.
const TRACKER_END_MAX: Duration = Duration::from_secs(60);
/// How long it waits for an iteration, s: the longest that one left alone lives.
const TRACKER_PATIENCE_S: &str = "3600";

/// Where curves are looked at.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Logger {
    /// Files in the run folder, which are always written
    Tensorboard,
    /// Weights & Biases
    Wandb,
    /// MLflow
    Mlflow,
}

/// Dropped, it is told that the run is over, and has a minute to end.
pub struct Tracker {
    over: Option<Sender<()>>,
    watch: Option<JoinHandle<()>>,
}

impl Tracker {
    /// Starts `logger` on a run. What goes wrong with it is said in one line on `view`.
    pub fn beside(folder: &RunFolder, logger: Logger, view: &View) -> Option<Self> {
        let to = match logger {
            Logger::Tensorboard => {
                let folder = folder.root().display();
                view.note(&format!("curves: tensorboard --logdir {folder}"));
                return None;
            }
            Logger::Wandb => "wandb",
            Logger::Mlflow => "mlflow",
        };
        let python = std::env::var_os(PYTHON).unwrap_or_else(|| "python3".into());
        Self::start(&python, folder, to, view)
            .inspect_err(|why| {
                view.warn(&format!("there is no tracker: {why}; {PYTHON} names its Python"))
            })
            .ok()
    }

    fn start(python: &OsStr, folder: &RunFolder, to: &str, view: &View) -> Result<Self, Failure> {
        let process = process(python, folder, to, view)?;
        let (over, is_over) = bounded(0);
        let (python, view) = (python.to_owned(), view.clone());
        let watch = std::thread::Builder::new()
            .name("tracker".into())
            .spawn(move || {
                if let Some(why) = watch(process, &python, &is_over) {
                    view.warn(&why);
                }
            })
            .or_exit(ExitCode::OsResource)?;
        Ok(Self { over: Some(over), watch: Some(watch) })
    }
}

/// Starts the tracker; what it prints goes to `view`.
fn process(python: &OsStr, folder: &RunFolder, to: &str, view: &View) -> Result<Process, Failure> {
    let mut command = Command::new(python);
    command.args(["-m", "caudata.track", "--to", to, "--patience", TRACKER_PATIENCE_S]);
    command.arg(folder.root()).arg("--until-told");
    let view = view.clone();
    let sink: LineSink = Box::new(move |line| view.note(&line));
    let log = folder.logs().join("tracker.log");
    Process::start(&python.display().to_string(), command, &log, Some(sink))
}

impl Drop for Tracker {
    fn drop(&mut self) {
        drop(self.over.take());
        if let Some(watch) = self.watch.take() {
            let _ = watch.join();
        }
    }
}

/// Waits for the tracker's end, or for that of the run and then a minute at most; answers how it failed.
fn watch(mut process: Process, python: &OsStr, is_over: &Receiver<()>) -> Option<String> {
    while process.ended().is_none() {
        if is_over.recv_timeout(TRACKER_LOOK_EVERY) == Err(RecvTimeoutError::Disconnected) {
            process.signal(Signal::SIGTERM);
            process.finish(TRACKER_END_MAX);
        }
    }
    let status = process.ended().filter(|status| !status.success())?;
    Some(match process.last_error() {
        Some(words) => format!("the tracker: {}", words.error),
        None => format!(
            "the tracker, {} -m caudata.track, {}: `pip install caudata` there, or let {PYTHON} name a Python that has it; its log is {}",
            python.display(),
            describe(status),
            process.log().display()
        ),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::path::Path;

    /// A run folder, and a Python that is a shell script. `$RUN` is the folder, `$TO` the tracker.
    fn stage(script: &str) -> (tempfile::TempDir, RunFolder, String) {
        let dir = tempfile::tempdir().unwrap();
        let folder = RunFolder::create(Some(&dir.path().join("run")), dir.path(), "t").unwrap();
        let python = dir.path().join("python");
        let text = format!("TO=$4 RUN=$7\n{script}");
        crate::commands::train::supervise::tests::write_program(&python, &text);
        (dir, folder, python.display().to_string())
    }

    const VIEW: View = View::Plain { last: None };

    fn read(path: &Path) -> String {
        std::fs::read_to_string(path).unwrap()
    }

    #[test]
    fn a_tracker_is_told_that_the_run_is_over_and_waited_for() {
        let until = "while :; do sleep 0.02; done";
        let script =
            format!("trap 'sleep 0.2; echo $TO > $RUN/over; exit' TERM; touch $RUN/is_on; {until}");
        let (_dir, folder, python) = stage(&script);
        let tracker = Tracker::start(python.as_ref(), &folder, "wandb", &VIEW).unwrap();
        while !folder.root().join("is_on").exists() {
            std::thread::sleep(TRACKER_LOOK_EVERY);
        }
        drop(tracker);
        assert_eq!(read(&folder.root().join("over")), "wandb\n");
    }

    #[test]
    fn one_that_fails_says_why_and_a_run_goes_on() {
        for (script, said) in [
            (
                "echo \"error: No module named 'wandb'\" >&2; exit 69",
                "the tracker: No module named 'wandb'",
            ),
            ("echo 'no module caudata' >&2; exit 1", "exit code 1: `pip install caudata` there"),
        ] {
            let (_dir, folder, python) = stage(script);
            let process = process(python.as_ref(), &folder, "wandb", &VIEW).unwrap();
            let (_over, is_over) = bounded(0);
            let why = watch(process, python.as_ref(), &is_over).unwrap();
            assert!(why.contains(said), "{why}");
        }
        let (_dir, folder, _) = stage("");
        assert!(Tracker::start("/no/python".as_ref(), &folder, "wandb", &VIEW).is_err());
    }
}
