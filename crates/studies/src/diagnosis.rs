//! A diagnosis from log folders into an output folder.

use std::path::{Path, PathBuf};
use std::time::Instant;

use caudata_gap::check::{check_dirs, run_name};
use caudata_gap::report::{DataFault, Verdict};
use caudata_gap::{
    Diagnosis, GapError, GoOn, Options, Progress, Report, Request, Role, Run, diagnose as find,
    excite, extension, page,
};
use caudata_model::RobotModel;
use caudata_runlog::{META_NAME, rows_file};
use caudata_telemetry::{ExitCode, Failure, FailureExt, StopFlag};
use clap::Args;

use crate::failures::stopped;
use crate::files::{self, write_json, write_whole};
use crate::flags;

/// The report, written last: in a new folder everything is there where it is.
pub const REPORT: &str = "report.json";
/// The extended robot file.
pub const EXTENDED: &str = "extended.robot.toml";
/// Curves of the report's page.
pub const PLOTS: &str = "plots.json";

/// What to diagnose.
#[derive(Clone, Debug, Args)]
pub struct Plan {
    /// Robot file
    #[arg(long, value_name = "R.robot.toml")]
    pub robot: PathBuf,
    /// Log folder, or a folder of log folders, to fit to; may be given several times
    #[arg(long = "log", value_name = "DIR", required = true)]
    pub logs: Vec<PathBuf>,
    /// Log folder that is only judged on; default: every third trial is set aside
    #[arg(long = "holdout", value_name = "DIR")]
    pub holdouts: Vec<PathBuf>,
    /// Folder for report.json, report.html and extended.robot.toml
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Effects that are not tried, by id
    #[arg(long, value_name = "ID")]
    pub without: Vec<String>,
    /// Only these effects are tried, by id
    #[arg(long, value_name = "ID")]
    pub only: Vec<String>,
    /// Threads; the result does not depend on it. Default: as many as the machine has
    #[arg(long, value_name = "N")]
    pub threads: Option<usize>,
    /// Seed of resampling
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
    /// Report the best so far after about so long (90s, 3min, 1h). Default: when everything was tried
    #[arg(long, value_name = "TIME", value_parser = seconds)]
    pub budget: Option<f64>,
}

/// A time with its unit, s.
pub(crate) fn seconds(text: &str) -> Result<f64, String> {
    let digits = text.trim_end_matches(|c: char| c.is_ascii_alphabetic());
    let unit_s = match text[digits.len()..].trim() {
        "s" => 1.0,
        "min" => 60.0,
        "h" => 3600.0,
        _ => return Err("a time is a number with s, min or h: 90s, 3min, 1h".to_owned()),
    };
    let number: f64 = digits
        .trim()
        .parse()
        .map_err(|_| format!("`{digits}` is no number"))?;
    match number.is_finite() && number > 0.0 {
        true => Ok(number * unit_s),
        false => Err("a time is above zero".to_owned()),
    }
}

/// Diagnoses, and leaves the report, its page and the extended robot file in the output folder.
///
/// # Errors
/// Where a file cannot be read or written, nothing can be simulated, or `stop` is raised before there is
/// anything to tell; a verdict is none. Raised later, it ends the search, and the best so far is written.
pub fn diagnose(
    plan: &Plan,
    stop: &StopFlag,
    tell: &mut dyn FnMut(&Progress),
) -> Result<Report, Failure> {
    let robot = files::robot(&plan.robot)?;
    let (robot_toml, mjcf_name, mjcf) = robot_files(&plan.robot)?;
    let written = plan.out.join(EXTENDED).canonicalize();
    if written.is_ok_and(|path| plan.robot.canonicalize().is_ok_and(|robot| robot == path)) {
        let message = format!("--out {} would overwrite --robot", plan.out.display());
        return Err(Failure::message(ExitCode::BadConfig, message).hint("give another folder"));
    }
    let (runs, data_faults) = runs(plan, &robot)?;
    files::make_folder(&plan.out)?;
    let until = stop.clone();
    let request = Request {
        robot_toml: robot_toml.clone(),
        mjcf: mjcf.clone(),
        label: plan.robot.display().to_string(),
        runs,
        data_faults,
        options: Options {
            threads: plan.threads.unwrap_or_else(flags::cores).max(1),
            seed: plan.seed,
            without: plan.without.clone(),
            only: plan.only.clone(),
            go_on: GoOn::as_long_as(move || !until.is_set()),
            budget_s: plan.budget,
        },
    };
    let started = Instant::now();
    let refused = |error| refused(error, stop);
    let mut found = find(&request, &mut |progress| tell(&progress)).map_err(refused)?;
    found.report.compute.seconds = started.elapsed().as_secs_f64();
    name_the_trial(&robot, &mut found.report);
    let extended = extension::append(&found.extension, &String::from_utf8_lossy(&robot_toml))
        .map_err(refused)?;
    write(&plan.out, &robot, &found, &extended, (&mjcf_name, &mjcf))?;
    Ok(found.report)
}

/// The runs to use, and what a check says of them. A log that cannot be read is a fault; with none left, an
/// error.
fn runs(plan: &Plan, robot: &RobotModel) -> Result<(Vec<Run>, Vec<DataFault>), Failure> {
    let mut dirs = Vec::new();
    for (given, role) in [(&plan.logs, Role::Fit), (&plan.holdouts, Role::Holdout)] {
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
                sha256: files::sha256(&rows_file(&dir))?,
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

/// Whether there is an extended robot file. Where a gap has been found and no model that is nearer to held-out
/// runs than the robot as given, there is none.
#[must_use]
pub fn carries(report: &Report) -> bool {
    let gap = [Verdict::Unexplained, Verdict::InsufficientData];
    !report.model.is_empty() || !gap.contains(&report.verdict)
}

/// Each file whole.
fn write(
    out: &Path,
    robot: &RobotModel,
    found: &Diagnosis,
    extended: &str,
    (mjcf_name, mjcf): (&str, &[u8]),
) -> Result<(), Failure> {
    let plots = serde_json::to_vec(&found.plots).or_exit(ExitCode::Internal)?;
    write_whole(&out.join(PLOTS), &plots)?;
    let html = page::render(robot.name(), &found.report, Some(&found.plots));
    write_whole(&out.join("report.html"), html.as_bytes())?;
    if carries(&found.report) {
        write_whole(&out.join(EXTENDED), extended.as_bytes())?;
        // it names its MJCF, which must lie beside it
        write_whole(&out.join(mjcf_name), mjcf)?;
    } else {
        // that of an earlier diagnosis is none of this one
        let stale = out.join(EXTENDED);
        if stale.is_file() {
            std::fs::remove_file(&stale).or_exit(ExitCode::CannotCreate)?;
        }
    }
    write_json(&out.join(REPORT), &found.report)
}

fn refused(error: GapError, stop: &StopFlag) -> Failure {
    let code = match &error {
        GapError::NoRuns | GapError::Run { .. } | GapError::Model(_) | GapError::Extension(_) => {
            ExitCode::BadInput
        }
        GapError::Sim(_) | GapError::Worker | GapError::Calibration(_) => ExitCode::Internal,
        GapError::Stopped => {
            return stopped(stop).hint("nothing was known yet, and nothing was written");
        }
    };
    Failure::new(code, error)
}

const OTHER_RECORDINGS: &str = "`caudata gap import` makes log folders from other recordings";

/// The log folders that were named: each is one, or holds some (a folder of repeats).
///
/// # Errors
/// When a folder is missing or holds no log.
pub fn log_folders(given: &[PathBuf]) -> Result<Vec<PathBuf>, Failure> {
    let is_log = |dir: &Path| dir.join(META_NAME).is_file();
    let mut out = Vec::new();
    for dir in given {
        if is_log(dir) {
            out.push(dir.clone());
            continue;
        }
        if dir.is_file() {
            let message = format!("log {}: is a file, and a log is a folder", dir.display());
            return Err(Failure::message(ExitCode::BadInput, message).hint(OTHER_RECORDINGS));
        }
        let entries = std::fs::read_dir(dir).map_err(|e| {
            Failure::new(ExitCode::of_io(&e, false), e).context(format!("log {}", dir.display()))
        })?;
        let mut inside: Vec<PathBuf> = entries
            .filter_map(|e| Some(e.ok()?.path()))
            .filter(|p| is_log(p))
            .collect();
        inside.sort();
        if inside.is_empty() {
            let dir = dir.display();
            let message = format!("{dir} is no log folder and holds none (log.csv and log.toml)");
            return Err(Failure::message(ExitCode::NoInput, message).hint(OTHER_RECORDINGS));
        }
        out.extend(inside);
    }
    Ok(out)
}

/// The bytes of a robot file, and name and bytes of the MJCF beside it.
///
/// # Errors
/// When one cannot be read.
pub fn robot_files(path: &Path) -> Result<(Vec<u8>, String, Vec<u8>), Failure> {
    let path = &caudata_durable::shipped(path);
    let robot_toml = files::read(path)?;
    let mjcf_name = caudata_gap::mjcf_name(&String::from_utf8_lossy(&robot_toml))
        .or_exit(ExitCode::BadInput)?;
    let mjcf = files::read(&path.with_file_name(&mjcf_name))?;
    Ok((robot_toml, mjcf_name, mjcf))
}

#[cfg(test)]
mod tests {
    use super::seconds;

    #[test]
    fn a_time_has_a_unit() {
        assert_eq!(seconds("90s"), Ok(90.0));
        assert_eq!(seconds("3min"), Ok(180.0));
        assert_eq!(seconds("0.5 h"), Ok(1800.0));
        for wrong in ["3", "min", "-1s", "0s", "3 weeks"] {
            assert!(seconds(wrong).is_err(), "{wrong}");
        }
    }
}
