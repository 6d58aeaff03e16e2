//! `caudata gap diagnose`: from logs and a robot file to causes, an extended robot file, and a page.

use std::io::IsTerminal;
use std::time::{Duration, Instant};

use caudata_gap::Progress;
use caudata_gap::excite;
use caudata_gap::report::{Report, Verdict};
use caudata_studies::{News, Steps, diagnosis};
use caudata_telemetry::{ExitCode, Failure, FailureExt, Process};
use indicatif::ProgressBar;
use serde_json::json;

use super::gap_report;
use crate::say::{self, WithJson};

pub fn run(args: &WithJson<diagnosis::Plan>, process: &Process) -> Result<(), Failure> {
    let WithJson { plan, json } = args;
    if plan.out.join(diagnosis::REPORT).exists() {
        let message = format!("{} holds a diagnosis already", plan.out.display());
        return Err(Failure::message(ExitCode::CannotCreate, message)
            .hint("give another --out, or remove it"));
    }
    let mut view = View::new(*json);
    let report = diagnosis::diagnose(plan, &process.stop, &mut |progress| view.show(progress));
    view.end();
    let report = report?;
    say::either(*json, &report, |report| {
        gap_report::print(report);
        let files = match diagnosis::carries(report) {
            true => "report.html, report.json and extended.robot.toml are",
            false => {
                "take the robot as given: there is no extended file; report.html and report.json are"
            }
        };
        say::line(format!("\n{files} in {}", plan.out.display()));
    })?;
    verdict(&report)
}

/// The steps of a study that prints as it goes; with `quiet` its last line only.
pub fn steps(quiet: bool, process: &Process, after_stop: &str) -> Result<Steps<'static>, Failure> {
    let program = std::env::current_exe().or_exit(ExitCode::Internal)?;
    let mut view = View::new(false);
    Ok(Steps::new(program, quiet, &process.stop, after_stop, move |news| match news {
        _ if quiet => {}
        News::Step { name, what } => {
            view.end();
            say::line(format_args!("── {name}: {what}"));
        }
        News::Diagnosis(progress) => view.show(progress),
    }))
}

/// The exit code of a verdict; [`ExitCode::Ok`] for a complete answer.
pub fn code(verdict: Verdict) -> ExitCode {
    match verdict {
        Verdict::NoGap | Verdict::Explained => ExitCode::Ok,
        Verdict::Ambiguous => ExitCode::Ambiguous,
        Verdict::PartlyExplained => ExitCode::PartlyExplained,
        Verdict::Unexplained => ExitCode::Unexplained,
        Verdict::InsufficientData => ExitCode::InsufficientData,
        Verdict::DataFault => ExitCode::DataFault,
    }
}

/// A complete answer ends with 0; every other verdict has its own code.
fn verdict(report: &Report) -> Result<(), Failure> {
    let code = code(report.verdict);
    if code == ExitCode::Ok {
        return Ok(());
    }
    let failure = Failure::outcome(code, &report.summary);
    Err(match &report.next_experiment {
        Some(next) => failure.hint(match excite::names_in(&next.trial) {
            Some(trial) => {
                format!(
                    "record the trial {trial} (`caudata gap excite --robot R.robot.toml --trial {trial} --out DIR`)"
                )
            }
            // a run of the user's own
            None => format!("record {} once more", next.trial),
        }),
        None if report.unfinished => {
            failure.hint("give it more time, and another --out: --budget 10min")
        }
        None => failure,
    })
}

/// Where progress of a diagnosis goes: a line that changes on a terminal, lines elsewhere, JSON with
/// `--json`.
struct View {
    started: Instant,
    json: bool,
    spinner: Option<ProgressBar>,
}

impl View {
    fn new(json: bool) -> Self {
        Self { started: Instant::now(), json, spinner: None }
    }

    fn show(&mut self, p: &Progress) {
        let stage = format!("{:?}", p.stage).to_lowercase();
        let elapsed_s = self.started.elapsed().as_secs_f64();
        if self.json {
            say::line(json!({
                "event": "progress", "stage": stage, "round": p.round, "model": p.model, "elapsed_s": elapsed_s,
            }));
        } else if std::io::stderr().is_terminal() {
            let bar = self.spinner.get_or_insert_with(spinner);
            bar.set_message(format!("{stage}: {}", p.model));
        } else {
            say::line(format!("{elapsed_s:6.1} s  {stage}: {}", p.model));
        }
    }

    fn end(&mut self) {
        if let Some(bar) = self.spinner.take() {
            bar.finish_and_clear();
        }
    }
}

fn spinner() -> ProgressBar {
    let bar = say::laid_out(ProgressBar::new_spinner(), "{spinner} {elapsed}  {msg}");
    bar.enable_steady_tick(Duration::from_millis(120));
    bar
}
