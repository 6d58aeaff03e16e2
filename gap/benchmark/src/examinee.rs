//! The one who is examined: a process that is given a case folder and nothing else, and writes `report.json`.

use std::path::{Path, PathBuf};

use caudata_gap::check;
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

/// Checks and diagnoses the case in `folder`, as the command line does with a robot file, runs and held-out
/// runs.
pub fn diagnose(folder: &Path, options: Options) -> Result<Report, ExamineeError> {
    let failed = |path: &Path| {
        let path = path.to_owned();
        move |source| ExamineeError::Io { path, source }
    };
    let missing = |what| ExamineeError::Missing { folder: folder.to_owned(), what };
    let mut entries: Vec<PathBuf> = std::fs::read_dir(folder)
        .map_err(failed(folder))?
        .filter_map(|e| Some(e.ok()?.path()))
        .collect();
    entries.sort();
    let named = |end: &str| entries.iter().find(|p| p.to_string_lossy().ends_with(end));
    let robot = named(".robot.toml").ok_or_else(|| missing("robot file"))?;
    let mjcf = named(".xml").ok_or_else(|| missing("MJCF"))?;
    let model = RobotModel::load(robot)?;
    let dirs: Vec<&PathBuf> = entries.iter().filter(|p| p.is_dir()).collect();
    let (logs, checked) = check::check_dirs(&dirs, &model);
    let runs = logs
        .into_iter()
        .map(|(name, log)| Run {
            role: if name.starts_with(HOLDOUT) { Role::Holdout } else { Role::Fit },
            name,
            log,
            sha256: String::new(),
        })
        .collect();
    let request = Request {
        robot_toml: std::fs::read(robot).map_err(failed(robot))?,
        mjcf: std::fs::read(mjcf).map_err(failed(mjcf))?,
        label: robot.display().to_string(),
        runs,
        data_faults: checked.faults,
        options,
    };
    Ok(caudata_gap::diagnose(&request, &mut |_| ())?.report)
}

/// As [`diagnose`], and writes `report.json` into the current folder.
pub fn write_report(folder: &Path, options: Options) -> Result<(), ExamineeError> {
    let text = serde_json::to_vec(&diagnose(folder, options)?)?;
    let path = PathBuf::from("report.json");
    std::fs::write(&path, text).map_err(|source| ExamineeError::Io { path, source })
}
