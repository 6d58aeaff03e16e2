//! The one who is examined: a process that is given a case folder and nothing else, and writes `report.json`.

use std::path::{Path, PathBuf};

use caudata_gap::check;
use caudata_gap::report::DataFault;
use caudata_gap::{GapError, Options, Report, Request, Role, Run};
use caudata_model::{ModelError, RobotModel};

/// Runs whose folder begins so are held out.
const HOLDOUT: &str = "holdout";

/// Why a case cannot be diagnosed at all.
#[derive(Debug, thiserror::Error)]
pub enum ExamineeError {
    /// A file cannot be read or written.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// The reason given by the system.
        source: std::io::Error,
    },
    /// Something is not there.
    #[error("{} holds no {what}", folder.display())]
    Missing {
        /// The folder.
        folder: PathBuf,
        /// What.
        what: &'static str,
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

/// Reads the case in `folder`.
pub(crate) fn read(folder: &Path) -> Result<Read, ExamineeError> {
    let missing = |what| ExamineeError::Missing { folder: folder.to_owned(), what };
    let mut entries: Vec<PathBuf> = std::fs::read_dir(folder)
        .map_err(failed(folder))?
        .filter_map(|e| Some(e.ok()?.path()))
        .collect();
    entries.sort();
    let named = |end: &str| entries.iter().find(|p| p.to_string_lossy().ends_with(end)).cloned();
    let robot = named(".robot.toml").ok_or_else(|| missing("robot file"))?;
    let mjcf = named(".xml").ok_or_else(|| missing("MJCF"))?;
    let model = RobotModel::load(&robot)?;
    let dirs: Vec<&PathBuf> = entries.iter().filter(|p| p.is_dir()).collect();
    let (logs, checked) = check::check_dirs(&dirs, &model);
    let run = |(name, log): (String, _)| Run {
        role: if name.starts_with(HOLDOUT) { Role::Holdout } else { Role::Fit },
        name,
        log,
        sha256: String::new(),
    };
    let runs = logs.into_iter().map(run).collect();
    Ok(Read { robot, mjcf, model, runs, faults: checked.faults })
}

fn failed(path: &Path) -> impl FnOnce(std::io::Error) -> ExamineeError + use<> {
    let path = path.to_owned();
    move |source| ExamineeError::Io { path, source }
}

/// Checks and diagnoses the case in `folder`, as the command line does with a robot file, runs and held-out
/// runs.
pub fn diagnose(folder: &Path, options: Options) -> Result<Report, ExamineeError> {
    let case = read(folder)?;
    let bytes = |path: &Path| std::fs::read(path).map_err(failed(path));
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
    std::fs::write(path, text).map_err(failed(path))
}
