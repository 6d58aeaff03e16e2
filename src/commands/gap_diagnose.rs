//! `caudata gap diagnose`: from logs and a robot file to causes, an extended robot file, and a page.

use std::io::IsTerminal;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use caudata_gap::check::{check_dirs, run_name};
use caudata_gap::report::{DataFault, Report, Verdict};
use caudata_gap::{
    Diagnosis, GapError, GoOn, Options, Progress, Request, Role, Run, diagnose, excite, extension,
    page,
};
use caudata_model::RobotModel;
use caudata_telemetry::{ExitCode, Failure, FailureExt, Process, StopFlag};
use clap::Args;
use indicatif::{ProgressBar, ProgressStyle};
use serde_json::json;

use super::gap::{file_sha256, log_folders, robot_files};
use super::out_folder::write_whole;
use super::steps::stopped;
use super::{gap_report, robot_model};
use crate::say;

#[derive(Debug, Args)]
pub struct DiagnoseArgs {
    /// Robot file
    #[arg(long, value_name = "R.robot.toml")]
    robot: PathBuf,
    /// Log folder, or a folder of log folders, to fit to; may be given several times
    #[arg(long = "log", value_name = "DIR", required = true)]
    logs: Vec<PathBuf>,
    /// Log folder that is only judged on; default: every third trial is set aside
    #[arg(long = "holdout", value_name = "DIR")]
    holdouts: Vec<PathBuf>,
    /// Folder for report.json, report.html and extended.robot.toml
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Effects that are not tried, by id
    #[arg(long, value_name = "ID")]
    without: Vec<String>,
    /// Only these effects are tried, by id
    #[arg(long, value_name = "ID")]
    only: Vec<String>,
    /// Threads; the result does not depend on it. Default: as many as the machine has
    #[arg(long, value_name = "N")]
    threads: Option<usize>,
    /// Seed of resampling
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// One JSON object on the last line, one per step before it
    #[arg(long)]
    json: bool,
}

pub fn run(args: &DiagnoseArgs, process: &Process) -> Result<(), Failure> {
    let robot = robot_model::load(&args.robot)?;
    let (robot_toml, mjcf_name, mjcf) = robot_files(&args.robot)?;
    let (runs, data_faults) = runs(args, &robot)?;
    std::fs::create_dir_all(&args.out).or_exit_with(ExitCode::CannotCreate, || {
        format!("folder {}", args.out.display())
    })?;
    let stop = process.stop.clone();
    let request = Request {
        robot_toml: robot_toml.clone(),
        mjcf: mjcf.clone(),
        label: args.robot.display().to_string(),
        runs,
        data_faults,
        options: Options {
            threads: args
                .threads
                .unwrap_or_else(|| std::thread::available_parallelism().map_or(1, usize::from))
                .max(1),
            seed: args.seed,
            without: args.without.clone(),
            only: args.only.clone(),
            go_on: GoOn::as_long_as(move || !stop.is_set()),
        },
    };
    let started = Instant::now();
    let mut view = View::new(args.json, started);
    let found = diagnose(&request, &mut |p| view.show(&p));
    view.end();
    let refused = |error| refused(error, &process.stop);
    let mut found = found.map_err(refused)?;
    found.report.compute.seconds = started.elapsed().as_secs_f64();
    name_the_trial(&robot, &mut found.report);
    let extended = extension::append(&found.extension, &String::from_utf8_lossy(&robot_toml))
        .map_err(refused)?;
    write(&args.out, &robot, &found, &extended, &mjcf_name, &mjcf)?;
    if args.json {
        say::json(&found.report)?;
    } else {
        gap_report::print(&found.report);
        say::line(format!(
            "\nreport.html, report.json and extended.robot.toml are in {}",
            args.out.display()
        ));
    }
    verdict(&found.report)
}

/// The runs to use, and what a check says of them. A log that cannot be read is a fault; with none left, an error.
fn runs(args: &DiagnoseArgs, robot: &RobotModel) -> Result<(Vec<Run>, Vec<DataFault>), Failure> {
    let mut dirs = Vec::new();
    for (given, role) in [(&args.logs, Role::Fit), (&args.holdouts, Role::Holdout)] {
        dirs.extend(log_folders(given)?.into_iter().map(|d| (d, role)));
    }
    let folders: Vec<&PathBuf> = dirs.iter().map(|(d, _)| d).collect();
    let (logs, checked) = check_dirs(&folders, robot);
    if logs.is_empty() {
        let why = checked
            .faults
            .first()
            .map_or("no log", |f| f.detail.as_str());
        return Err(Failure::message(ExitCode::BadInput, why));
    }
    // Logs come in the order of their folders, those that could not be read left out.
    let mut logs = logs.into_iter().peekable();
    let mut runs = Vec::new();
    for (dir, role) in dirs {
        if let Some((name, log)) = logs.next_if(|(name, _)| *name == run_name(&dir)) {
            runs.push(Run {
                name,
                log,
                role,
                sha256: file_sha256(&caudata_runlog::rows_file(&dir))?,
            });
        }
    }
    Ok((runs, checked.faults))
}

/// The catalogue names kinds of trials; the report names one of the battery.
fn name_the_trial(robot: &RobotModel, report: &mut Report) {
    if let Some(next) = &mut report.next_experiment {
        let separates: Vec<&str> = next.separates.iter().map(String::as_str).collect();
        if let Some(trial) = excite::canonical(&next.trial) {
            next.trial = trial.to_owned();
        } else if let Some(best) = excite::next(robot, &separates, &next.joints) {
            next.trial = best.trial;
        }
    }
}

/// Each file whole, the report last: in a new folder the others are there where it is.
fn write(
    out: &Path,
    robot: &RobotModel,
    found: &Diagnosis,
    extended: &str,
    mjcf_name: &str,
    mjcf: &[u8],
) -> Result<(), Failure> {
    let put = |name: &str, bytes: &[u8]| write_whole(&out.join(name), bytes);
    let json = |value: serde_json::Result<Vec<u8>>| value.or_exit(ExitCode::Internal);
    put("plots.json", &json(serde_json::to_vec(&found.plots))?)?;
    put(
        "report.html",
        page::render(robot.name(), &found.report, Some(&found.plots)).as_bytes(),
    )?;
    put("extended.robot.toml", extended.as_bytes())?;
    // the extended file names its MJCF, which must lie beside it
    put(mjcf_name, mjcf)?;
    put(
        "report.json",
        &json(serde_json::to_vec_pretty(&found.report))?,
    )
}

/// A complete answer ends with 0; every other verdict has its own code.
pub fn verdict(report: &Report) -> Result<(), Failure> {
    let code = match report.verdict {
        Verdict::NoGap | Verdict::Explained => return Ok(()),
        Verdict::Ambiguous => ExitCode::Ambiguous,
        Verdict::PartlyExplained => ExitCode::PartlyExplained,
        Verdict::Unexplained => ExitCode::Unexplained,
        Verdict::InsufficientData => ExitCode::InsufficientData,
        Verdict::DataFault => ExitCode::DataFault,
    };
    let failure = Failure::outcome(code, &report.summary);
    Err(match &report.next_experiment {
        Some(next) => failure.hint(format!(
            "record the trial {} (`caudata gap excite --trial {}`)",
            next.trial, next.trial
        )),
        None => failure,
    })
}

fn refused(error: GapError, stop: &StopFlag) -> Failure {
    let code = match &error {
        GapError::NoRuns | GapError::Run { .. } | GapError::Model(_) | GapError::Extension(_) => {
            ExitCode::BadInput
        }
        GapError::Sim(_) | GapError::Worker => ExitCode::Internal,
        GapError::Stopped => return stopped(stop).hint("nothing was written"),
    };
    Failure::new(code, error)
}

/// Where progress goes: a line that changes on a terminal, lines elsewhere, JSON with `--json`.
enum View {
    Spinner(ProgressBar),
    Plain(Instant),
    Json(Instant),
}

impl View {
    fn new(json: bool, started: Instant) -> Self {
        if json {
            return View::Json(started);
        }
        if !std::io::stderr().is_terminal() {
            return View::Plain(started);
        }
        let bar = ProgressBar::new_spinner();
        // The template is a constant; a wrong one would only lose the layout.
        if let Ok(style) = ProgressStyle::with_template("{spinner} {elapsed}  {msg}") {
            bar.set_style(style);
        }
        bar.enable_steady_tick(Duration::from_millis(120));
        View::Spinner(bar)
    }

    fn show(&mut self, p: &Progress) {
        let stage = format!("{:?}", p.stage).to_lowercase();
        match self {
            View::Spinner(bar) => bar.set_message(format!("{stage}: {}", p.model)),
            View::Plain(started) => say::line(format!(
                "{:6.1} s  {stage}: {}",
                started.elapsed().as_secs_f64(),
                p.model
            )),
            View::Json(started) => {
                let event = json!({ "event": "progress", "stage": stage, "round": p.round, "model": p.model, "elapsed_s": started.elapsed().as_secs_f64() });
                say::line(event);
            }
        }
    }

    fn end(&self) {
        if let View::Spinner(bar) = self {
            bar.finish_and_clear();
        }
    }
}
