//! A diagnosis from logs into an output folder.

use std::collections::BTreeSet;
use std::ffi::OsStr;
use std::path::{Path, PathBuf};
use std::time::Instant;

use caudata_gap::check::{check_dirs, run_names};
use caudata_gap::report::{DataFault, Verdict};
use caudata_gap::{
    Diagnosis, GapError, GoOn, Options, Progress, Report, Request, Role, Run, diagnose as find,
    extension, page,
};
use caudata_model::RobotModel;
use caudata_runlog::{ROWS, meta_file, names_a_robot, rows_file};
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
    /// Logs that are only judged on; default: a third of the trials is set aside
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
        "m" | "min" => 60.0,
        "h" => 3600.0,
        _ => return Err("a time is a number with s, min or h: 90s, 3min, 1h".to_owned()),
    };
    let number: f64 = digits.trim().parse().map_err(|_| format!("`{digits}` is no number"))?;
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
    let extended = extension::append(&found.extension, &String::from_utf8_lossy(&robot_toml))
        .map_err(refused)?;
    write(&plan.out, &robot, &found, &extended, (&mjcf_name, &mjcf))?;
    Ok(found.report)
}

/// The runs to use, and what a check says of them. What is held out is not fitted, also where it lies in a folder
/// of logs to fit. A log that cannot be read is a fault; with none left, an error.
fn runs(plan: &Plan, robot: &RobotModel) -> Result<(Vec<Run>, Vec<DataFault>), Failure> {
    let held_out = logs_at(&plan.holdouts)?;
    let kept: BTreeSet<PathBuf> = held_out.iter().map(|log| place(log)).collect();
    let mut fitted = logs_at(&plan.logs)?;
    fitted.retain(|log| !kept.contains(&place(log)));
    let first_held_out = fitted.len();
    let dirs = [fitted, held_out].concat();
    let names = run_names(&dirs);
    let (logs, checked) = check_dirs(&dirs, robot);
    if logs.is_empty() {
        let why = checked.faults.first().map_or("no log", |f| f.detail.as_str());
        return Err(Failure::message(ExitCode::BadInput, why));
    }
    // Logs come in the order of their folders, those that could not be read left out.
    let mut logs = logs.into_iter().peekable();
    let mut runs: Vec<Run> = Vec::new();
    for (number, (dir, name)) in dirs.iter().zip(&names).enumerate() {
        let Some((name, log)) = logs.next_if(|(read, _)| read == name) else { continue };
        let sha256 = files::sha256(&rows_file(dir))?;
        if let Some(same) = runs.iter().find(|run| run.sha256 == sha256) {
            let message = format!(
                "logs {} and {name} are the same rows, and no repeat; leave one out",
                same.name
            );
            return Err(Failure::message(ExitCode::BadInput, message));
        }
        let role = if number < first_held_out { Role::Fit } else { Role::Holdout };
        runs.push(Run { name, log, role, sha256 });
    }
    Ok((runs, checked.faults))
}

/// Where a log lies, however it was named.
fn place(log: &Path) -> PathBuf {
    log.canonicalize().unwrap_or_else(|_| log.to_owned())
}

/// Whether there is an extended robot file. Where data were refused, and where a gap has been found and no model
/// that is nearer to held-out runs than the robot as given, there is none.
pub fn carries(report: &Report) -> bool {
    let without = [Verdict::Unexplained, Verdict::InsufficientData, Verdict::DataFault];
    !report.model.is_empty() || !without.contains(&report.verdict)
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
        GapError::NoRuns
        | GapError::Run { .. }
        | GapError::UnknownEffect(_)
        | GapError::Model(_)
        | GapError::Extension(_) => ExitCode::BadInput,
        GapError::Sim(_) | GapError::Worker | GapError::Calibration(_) => ExitCode::Internal,
        GapError::Stopped => {
            return stopped(stop).hint("nothing was known yet, and nothing was written");
        }
    };
    Failure::new(code, error)
}

const OTHER_RECORDINGS: &str = "`caudata gap import` makes log folders from other recordings";

/// The logs that were named, each once: each is one (a folder of `log.csv` and `log.toml`, or a file of rows that
/// has its circumstances beside it, as `caudata sim rollout` writes them), or a folder that holds some.
///
/// # Errors
/// When one is missing, has no circumstances, or holds no log.
pub fn logs_at(given: &[PathBuf]) -> Result<Vec<PathBuf>, Failure> {
    let mut out = Vec::new();
    for path in given {
        match log_of(path) {
            Some(log) => out.push(log),
            None if path.is_dir() => out.extend(logs_in(path)?),
            // of a pair, whose rows are named too
            None if ROWS.iter().any(|x| path.with_extension(x).is_file()) && !is_of_rows(path) => {}
            None => return Err(no_log(path)),
        }
    }
    if let (Some(first), true) = (given.first(), out.is_empty()) {
        return Err(no_log(first));
    }
    let mut seen = BTreeSet::new();
    out.retain(|log| seen.insert(place(log)));
    Ok(out)
}

/// The logs in a folder. Files whose circumstances name no robot are passed over: a recording lies beside its map.
fn logs_in(folder: &Path) -> Result<Vec<PathBuf>, Failure> {
    let shown = folder.display();
    let entries = folder.read_dir().or_exit_with(ExitCode::NoInput, || format!("log {shown}"))?;
    let entries = entries.filter_map(|e| Some(e.ok()?.path()));
    let known = |log: &PathBuf| log.is_dir() || names_a_robot(&meta_file(log));
    let mut logs: Vec<PathBuf> = entries.filter_map(|p| log_of(&p).filter(known)).collect();
    logs.sort();
    // the same run as several kinds of files is one
    logs.dedup_by_key(|log| meta_file(log));
    if logs.is_empty() {
        let message = format!(
            "{shown} is no log and holds none (folders of log.csv and log.toml, or NAME.csv with NAME.toml)"
        );
        return Err(Failure::message(ExitCode::NoInput, message).hint(OTHER_RECORDINGS));
    }
    Ok(logs)
}

/// Why a path that is no folder is no log.
fn no_log(path: &Path) -> Failure {
    let (code, why) = if !path.exists() {
        (ExitCode::NoInput, "there is no such file or folder".to_owned())
    } else if is_of_rows(path) {
        let beside = path.with_extension("toml");
        (ExitCode::BadInput, format!("{} is not beside it", beside.display()))
    } else {
        (ExitCode::BadInput, format!("is no file of rows (.{})", ROWS.join(", .")))
    };
    let message = format!("log {}: {why}", path.display());
    Failure::message(code, message).hint(OTHER_RECORDINGS)
}

/// The log that a path names: itself, or the folder whose rows it is.
fn log_of(path: &Path) -> Option<PathBuf> {
    if path.is_dir() {
        return meta_file(path).is_file().then(|| path.to_owned());
    }
    if !is_of_rows(path) {
        return None;
    }
    let folder = match path.parent() {
        Some(folder) if !folder.as_os_str().is_empty() => folder,
        _ => Path::new("."),
    };
    let is_whole = meta_file(folder).is_file() && rows_file(folder).file_name() == path.file_name();
    match is_whole {
        true => Some(folder.to_owned()),
        false => meta_file(path).is_file().then(|| path.to_owned()),
    }
}

fn is_of_rows(path: &Path) -> bool {
    let is = |x: &OsStr| ROWS.iter().any(|rows| x == *rows);
    path.extension().is_some_and(is)
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
    use std::path::{Path, PathBuf};

    use caudata_gap::Role;
    use caudata_model::RobotModel;
    use clap::Parser;

    use super::{Plan, logs_at, runs, seconds};

    #[derive(Parser)]
    struct Command {
        #[command(flatten)]
        plan: Plan,
    }

    #[test]
    fn what_is_held_out_is_not_fitted_and_the_same_rows_are_no_repeat() {
        let dir = tempfile::tempdir().unwrap();
        let robot =
            Path::new(env!("CARGO_MANIFEST_DIR")).join("../../robots/xl330_pendulum.robot.toml");
        let model = RobotModel::load(&robot).unwrap();
        let put = |name: &str, angle_rad: f64| {
            let rows: String =
                (0..200).map(|k| format!("{:.2},0,{angle_rad}\n", 0.01 * f64::from(k))).collect();
            let path = dir.path().join(name);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::fs::write(&path, format!("t,cmd.swing,pos.swing\n{rows}")).unwrap();
            let about = "robot = \"xl330_pendulum\"\nbase = \"fixed\"\nterrain = \"flat\"\nrate_hz = 100.0\n";
            std::fs::write(path.with_extension("toml"), about).unwrap();
        };
        let of = |line: &str| {
            let at = |word: &str| match word.strip_prefix("--") {
                Some(_) => word.to_owned(),
                None => dir.path().join(word).display().to_string(),
            };
            let mut words =
                vec!["diagnose".to_owned(), "--robot".to_owned(), robot.display().to_string()];
            words.extend(line.split(' ').chain(["--out", "out"]).map(at));
            runs(&Command::parse_from(words).plan, &model)
        };
        put("day1/s.csv", 0.01);
        put("day1/t.csv", 0.02);
        put("day2/s.csv", 0.03);
        let (found, _) = of("--log day1 day2 --holdout day1/t.csv").unwrap();
        let named: Vec<(&str, bool)> =
            (found.iter()).map(|run| (run.name.as_str(), run.role == Role::Holdout)).collect();
        let path = |name: &str| dir.path().join(name).display().to_string();
        let (first, second) = (path("day1/s.csv"), path("day2/s.csv"));
        assert_eq!(named, [(first.as_str(), false), (second.as_str(), false), ("t", true)]);
        put("day2/u.csv", 0.02);
        let failure = of("--log day1 day2").map(|_| ()).unwrap_err().to_string();
        assert!(failure.contains("logs t and u are the same rows"), "{failure}");
    }

    #[test]
    fn a_log_is_a_folder_or_rows_with_their_circumstances_beside_them() {
        let dir = tempfile::tempdir().unwrap();
        let at = |name: &str| dir.path().join(name);
        for folder in ["walk", "rest", "empty"] {
            std::fs::create_dir(at(folder)).unwrap();
        }
        for file in ["walk/log.csv", "walk/log.toml", "rest/log.csv", "rest/log.toml"] {
            std::fs::write(at(file), "").unwrap();
        }
        // a rollout, the same as a bag, rows of which nothing is known, and a recording beside its map
        for file in ["trot.csv", "trot.mcap", "bare.csv", "bench.csv", "notes"] {
            std::fs::write(at(file), "").unwrap();
        }
        std::fs::write(at("trot.toml"), "robot = \"r.robot.toml\"").unwrap();
        std::fs::write(at("bench.toml"), "[[signal]]").unwrap();
        let logs = |names: &[&str]| {
            let given: Vec<PathBuf> = names.iter().map(|name| at(name)).collect();
            logs_at(&given).map_err(|failure| failure.to_string())
        };
        let all = vec![at("rest"), at("trot.csv"), at("walk")];
        assert_eq!(logs(&[""]).unwrap(), all);
        let named = vec![at("walk"), at("trot.mcap"), at("rest")];
        assert_eq!(
            logs(&["walk/log.csv", "trot.mcap", "trot.toml", "rest", "walk"]).unwrap(),
            named
        );
        for (name, why) in [
            ("bare.csv", "bare.toml is not beside it"),
            ("notes", "is no file of rows (.csv, .mcap, .parquet)"),
            ("trot.toml", "is no file of rows"),
            ("empty", "is no log and holds none"),
            ("nowhere", "there is no such file"),
        ] {
            let failure = logs(&[name]).unwrap_err();
            assert!(failure.contains(why), "{failure}");
        }
    }

    #[test]
    fn a_time_has_a_unit() {
        assert_eq!(seconds("90s"), Ok(90.0));
        assert_eq!(seconds("3min"), Ok(180.0));
        assert_eq!(seconds("3m"), Ok(180.0));
        assert_eq!(seconds("0.5 h"), Ok(1800.0));
        for wrong in ["3", "min", "-1s", "0s", "3 weeks"] {
            assert!(seconds(wrong).is_err(), "{wrong}");
        }
    }
}
