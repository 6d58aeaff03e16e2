//! A diagnosis from logs into an output folder.

use std::ffi::OsStr;
use std::path::{Path, PathBuf};
use std::time::Instant;

use caudata_gap::check::{check_dirs, run_name};
use caudata_gap::report::{DataFault, Verdict};
use caudata_gap::{
    Diagnosis, GapError, GoOn, Options, Progress, Report, Request, Role, Run, diagnose as find,
    excite, extension, page,
};
use caudata_model::RobotModel;
use caudata_runlog::{CSV_NAME, ROWS, meta_file, rows_file};
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
    /// Logs to fit to: folders, files of rows with their circumstances beside them, or folders of such
    #[arg(long = "log", value_name = "LOG", required = true, num_args = 1..)]
    pub logs: Vec<PathBuf>,
    /// Logs that are only judged on; default: every third trial is set aside
    #[arg(long = "holdout", value_name = "LOG", num_args = 1..)]
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
        dirs.extend(logs_at(given)?.into_iter().map(|d| (d, role)));
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

/// The logs that were named: each is one (a folder of `log.csv` and `log.toml`, or a file of rows that has its
/// circumstances beside it, as `caudata sim rollout` writes them), or a folder that holds some.
///
/// # Errors
/// When one is missing, has no circumstances, or holds no log.
pub fn logs_at(given: &[PathBuf]) -> Result<Vec<PathBuf>, Failure> {
    let mut out = Vec::new();
    for path in given {
        if is_log(path) {
            out.push(whole(path));
            continue;
        }
        let shown = path.display();
        if path.is_file() {
            let beside = path.with_extension("toml");
            let message = format!("log {shown}: {} is not beside it", beside.display());
            return Err(Failure::message(ExitCode::BadInput, message).hint(OTHER_RECORDINGS));
        }
        let entries = std::fs::read_dir(path).map_err(|e| {
            Failure::new(ExitCode::of_io(&e, false), e).context(format!("log {shown}"))
        })?;
        let entries = entries.filter_map(|e| Some(e.ok()?.path()));
        let mut inside: Vec<PathBuf> = entries.filter(|p| is_log(p)).collect();
        inside.sort();
        // the same run as several kinds of files is one
        inside.dedup_by_key(|p| meta_file(p));
        if inside.is_empty() {
            let message = format!(
                "{shown} is no log and holds none (folders of log.csv and log.toml, or NAME.csv with NAME.toml)"
            );
            return Err(Failure::message(ExitCode::NoInput, message).hint(OTHER_RECORDINGS));
        }
        out.extend(inside);
    }
    Ok(out)
}

fn is_log(path: &Path) -> bool {
    let rows = |x: &OsStr| ROWS.iter().any(|r| x == *r);
    (path.is_dir() || path.extension().is_some_and(rows)) && meta_file(path).is_file()
}

/// The folder whose rows were named, or `log` itself.
fn whole(log: &Path) -> PathBuf {
    let folder = log.parent().filter(|dir| !dir.as_os_str().is_empty());
    match log.file_name() == Some(OsStr::new(CSV_NAME)) {
        true => folder.unwrap_or(log).to_owned(),
        false => log.to_owned(),
    }
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
    use std::path::PathBuf;

    use super::{logs_at, seconds};

    #[test]
    fn a_log_is_a_folder_or_rows_with_their_circumstances_beside_them() {
        let dir = tempfile::tempdir().unwrap();
        let at = |name: &str| dir.path().join(name);
        for folder in ["walk", "rest", "empty"] {
            std::fs::create_dir(at(folder)).unwrap();
        }
        for file in [
            "walk/log.csv",
            "walk/log.toml",
            "rest/log.csv",
            "rest/log.toml",
        ] {
            std::fs::write(at(file), "").unwrap();
        }
        // a rollout, the same as a bag, and rows of which nothing is known
        for file in ["trot.csv", "trot.mcap", "trot.toml", "bare.csv"] {
            std::fs::write(at(file), "").unwrap();
        }
        let logs = |names: &[&str]| {
            let given: Vec<PathBuf> = names.iter().map(|name| at(name)).collect();
            logs_at(&given).map_err(|failure| failure.to_string())
        };
        let all = vec![at("rest"), at("trot.csv"), at("walk")];
        assert_eq!(logs(&[""]).unwrap(), all);
        let named = vec![at("walk"), at("trot.mcap"), at("rest")];
        assert_eq!(logs(&["walk/log.csv", "trot.mcap", "rest"]).unwrap(), named);
        let failure = logs(&["bare.csv"]).unwrap_err();
        assert!(failure.contains("bare.toml is not beside it"), "{failure}");
        let failure = logs(&["empty"]).unwrap_err();
        assert!(failure.contains("is no log and holds none"), "{failure}");
        assert!(logs(&["nowhere"]).is_err());
    }

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
