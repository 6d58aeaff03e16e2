//! The one who is examined: a process that is given a case folder and nothing else, and writes `report.json`.

use std::path::{Path, PathBuf};

use caudata_gap::check;
use caudata_gap::report::DataFault;
use caudata_gap::{GapError, Options, Report, Request, Role, Run};
use caudata_model::{ModelError, RobotModel};
use caudata_runlog::{LogError, RunLog};

use crate::file::{FileError, at};

/// Runs whose folder begins so are held out.
const HOLDOUT: &str = "holdout";

/// Why a case cannot be diagnosed at all.
#[derive(Debug, thiserror::Error)]
pub enum ExamineeError {
    /// A file cannot be read or written.
    #[error(transparent)]
    File(#[from] FileError),
    /// Something is not there.
    #[error("{} holds no {what}", folder.display())]
    Missing {
        /// The folder.
        folder: PathBuf,
        /// What.
        what: &'static str,
    },
    /// A log that is there.
    #[error("{} cannot be read: {reason}", run.display())]
    Unread {
        /// The run's folder.
        run: PathBuf,
        /// Why not.
        reason: LogError,
    },
    /// The robot file.
    #[error("{0}")]
    Model(#[from] ModelError),
    /// The diagnosis.
    #[error("{0}")]
    Gap(#[from] GapError),
    /// The report.
    #[error("report: {0}")]
    Report(#[from] serde_json::Error),
}

/// A case folder, read and checked.
pub(crate) struct Read {
    robot: PathBuf,
    mjcf: PathBuf,
    pub model: RobotModel,
    pub runs: Vec<Run>,
    faults: Vec<DataFault>,
}

/// Reads the case in `folder`, all of whose logs can be read: what a decoy does to one can.
pub(crate) fn read(folder: &Path) -> Result<Read, ExamineeError> {
    let missing = |what| ExamineeError::Missing { folder: folder.to_owned(), what };
    let entries = std::fs::read_dir(folder).map_err(at(folder))?;
    let paths = entries.map(|e| e.map(|e| e.path()));
    let mut entries: Vec<PathBuf> = paths.collect::<Result<_, _>>().map_err(at(folder))?;
    entries.sort();
    let named = |end: &str| entries.iter().find(|p| p.to_string_lossy().ends_with(end)).cloned();
    let robot = named(".robot.toml").ok_or_else(|| missing("robot file"))?;
    let mjcf = named(".xml").ok_or_else(|| missing("MJCF"))?;
    let model = RobotModel::load(&robot)?;
    let dirs: Vec<&PathBuf> = entries.iter().filter(|p| p.is_dir()).collect();
    let log = |(dir, name): (&&PathBuf, String)| match RunLog::read(dir) {
        Ok(log) => Ok((name, log)),
        Err(reason) => Err(ExamineeError::Unread { run: dir.to_path_buf(), reason }),
    };
    let names = check::run_names(&dirs);
    let logs = dirs.iter().zip(names).map(log).collect::<Result<Vec<_>, _>>()?;
    let named: Vec<(&str, &RunLog)> = logs.iter().map(|(n, l)| (n.as_str(), l)).collect();
    let faults = check::check(&named, &model).faults;
    let run = |(name, log): (String, _)| Run {
        role: if name.starts_with(HOLDOUT) { Role::Holdout } else { Role::Fit },
        name,
        log,
        sha256: String::new(),
    };
    let runs = logs.into_iter().map(run).collect();
    Ok(Read { robot, mjcf, model, runs, faults })
}

/// Checks and diagnoses the case in `folder`, as the command line does with a robot file, runs and held-out
/// runs.
pub fn diagnose(folder: &Path, options: Options) -> Result<Report, ExamineeError> {
    let case = read(folder)?;
    let bytes = |path: &Path| std::fs::read(path).map_err(at(path));
    let request = Request {
        robot_toml: bytes(&case.robot)?,
        mjcf: bytes(&case.mjcf)?,
        label: case.robot.display().to_string(),
        runs: case.runs,
        data_faults: case.faults,
        options,
    };
    Ok(caudata_gap::diagnose(&request, &mut |_| ())?.report)
}

/// As [`diagnose`], and writes `report.json` into the current folder.
pub fn write_report(folder: &Path, options: Options) -> Result<(), ExamineeError> {
    let text = serde_json::to_vec(&diagnose(folder, options)?)?;
    let path = Path::new("report.json");
    Ok(std::fs::write(path, text).map_err(at(path))?)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_log_that_cannot_be_read_is_an_error_and_not_left_out() {
        let rigs = Path::new(env!("CARGO_MANIFEST_DIR")).join("rigs");
        let folder = tempfile::tempdir().unwrap();
        for name in ["pendulum.robot.toml", "pendulum.xml"] {
            std::fs::copy(rigs.join(name), folder.path().join(name)).unwrap();
        }
        let run = folder.path().join("fit_0");
        std::fs::create_dir(&run).unwrap();
        std::fs::write(run.join("log.toml"), "robot = \"pendulum\"\nbase = \"fixed\"\n").unwrap();
        std::fs::write(run.join("log.csv"), "t,cmd.swing\n0,none\n").unwrap();
        let why = read(folder.path()).err().unwrap();
        assert!(matches!(&why, ExamineeError::Unread { run: of, .. } if *of == run), "{why}");
    }
}
