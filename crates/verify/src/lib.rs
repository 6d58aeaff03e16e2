//! Ground truth for the engines: MuJoCo, closed forms, conservation laws, and each other. The table of `caudata sim verify`.
//!
//! Every check runs on every engine given, through the [`Engine`](caudata_sim::Engine) trait, and yields [`Row`]s: a figure, its
//! target, whether it is met. Rows that need MuJoCo say `skipped: …` where there is none. `docs/reference/simulation.md` says what each row means.
#![cfg_attr(test, allow(clippy::unwrap_used, clippy::expect_used, clippy::panic))]

mod accelerations;
mod drift;
mod gait;
mod ground;
mod mujoco;
mod request;
mod travel;
mod water;

use std::path::{Path, PathBuf};
use std::sync::Arc;

use caudata_model::{ModelError, RobotModel};
use caudata_sim::{EngineConfig, SimError};
use serde::Serialize;

pub use gait::Gait;
pub use mujoco::{Mujoco, Presence};
pub use request::RobotRequest;

/// Why the table could not be made.
#[derive(Debug, thiserror::Error)]
pub enum VerifyError {
    /// The robot file.
    #[error(transparent)]
    Model(#[from] ModelError),
    /// An engine refused.
    #[error(transparent)]
    Sim(#[from] SimError),
    /// The MuJoCo process failed.
    #[error("MuJoCo: {0}")]
    Mujoco(String),
    /// The robot file or its MJCF cannot be read.
    #[error("cannot read {path}: {reason}")]
    Read {
        /// Which file.
        path: PathBuf,
        /// Why.
        reason: String,
    },
}

/// The larger one; not a number wins.
fn largest(a: f64, b: f64) -> f64 {
    if a.is_nan() || b.is_nan() {
        f64::NAN
    } else {
        a.max(b)
    }
}

/// One figure.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Row {
    /// The check, one of those of `docs/reference/simulation.md`.
    pub check: &'static str,
    /// Engine and, where it matters, step.
    pub engine: String,
    /// What was measured.
    pub what: String,
    /// The figure; null where skipped.
    pub value: Option<f64>,
    /// Its unit.
    pub unit: &'static str,
    /// The figure is good up to this; null: reported only.
    pub target: Option<f64>,
    /// Whether it is met; null: skipped or reported only.
    pub pass: Option<bool>,
    /// What else is worth knowing, or why it was skipped.
    pub note: String,
}

impl Row {
    /// A figure that is good up to `target`.
    fn judged(
        check: &'static str,
        engine: &str,
        what: impl Into<String>,
        (value, unit): (f64, &'static str),
        target: f64,
        note: impl Into<String>,
    ) -> Self {
        Self {
            check,
            engine: engine.to_owned(),
            what: what.into(),
            value: value.is_finite().then_some(value),
            unit,
            target: Some(target),
            // not a number meets nothing
            pass: Some(value <= target),
            note: note.into(),
        }
    }

    /// A figure without a target.
    fn reported(
        check: &'static str,
        engine: &str,
        what: impl Into<String>,
        (value, unit): (f64, &'static str),
        note: impl Into<String>,
    ) -> Self {
        Self {
            target: None,
            pass: None,
            ..Self::judged(check, engine, what, (value, unit), 0.0, note)
        }
    }

    fn skipped(
        check: &'static str,
        engine: &str,
        what: &str,
        unit: &'static str,
        why: &str,
    ) -> Self {
        Self {
            check,
            engine: engine.to_owned(),
            what: what.to_owned(),
            value: None,
            unit,
            target: None,
            pass: None,
            note: format!("skipped: {why}"),
        }
    }
}

/// An engine to be checked.
#[derive(Clone, Debug)]
pub struct Subject {
    /// Its name in the table.
    pub name: String,
    /// Its settings; the step is varied where a check says so.
    pub config: EngineConfig,
}

/// What to check, and how long.
#[derive(Clone, Debug)]
pub struct Settings {
    /// The robot file.
    pub robot: PathBuf,
    /// The engines.
    pub subjects: Vec<Subject>,
    /// Draws states and gaits.
    pub seed: u64,
    /// How many random states.
    pub states: usize,
    /// How many random gaits.
    pub gaits: usize,
    /// Length of each, s.
    pub gait_s: f64,
    /// Threads of the engines.
    pub threads: usize,
    /// Checks to run; empty: all.
    pub only: Vec<String>,
}

/// The names of all checks, in the order of the table.
pub const CHECKS: [&str; 6] = [
    "accelerations",
    "conservation",
    "standing",
    "incline",
    "travel",
    "water",
];

/// What all checks share.
struct Bench<'a> {
    settings: &'a Settings,
    model: Arc<RobotModel>,
    robot: RobotRequest,
    mujoco: Presence,
}

impl Bench<'_> {
    /// The engine of `subject` with steps of `dt_s`, `lanes` robots, control periods of 20 ms.
    fn config(&self, subject: &Subject, dt_s: f64) -> EngineConfig {
        EngineConfig {
            dt_s,
            substeps: (0.02 / dt_s).round() as u32,
            ..subject.config.clone()
        }
    }
}

/// Runs the checks; `progress` hears which one begins.
///
/// # Errors
/// [`VerifyError`] where something cannot run at all; a figure that misses its target is a row, not an error.
pub fn run(settings: &Settings, progress: &mut dyn FnMut(&str)) -> Result<Vec<Row>, VerifyError> {
    let mut bench = Bench {
        settings,
        model: Arc::new(RobotModel::load(&settings.robot)?),
        robot: RobotRequest::read(&settings.robot)?,
        mujoco: Mujoco::start(),
    };
    type Check = fn(&mut Bench<'_>) -> Result<Vec<Row>, VerifyError>;
    let checks: [(&str, Check); 6] = [
        (CHECKS[0], accelerations::check),
        (CHECKS[1], drift::check),
        (CHECKS[2], ground::standing),
        (CHECKS[3], ground::incline),
        (CHECKS[4], travel::check),
        (CHECKS[5], water::check),
    ];
    let mut rows = Vec::new();
    for (name, check) in checks {
        if settings.only.is_empty() || settings.only.iter().any(|only| only == name) {
            progress(name);
            rows.extend(check(&mut bench)?);
        }
    }
    Ok(rows)
}

/// Reads a text file.
fn read(path: &Path) -> Result<String, VerifyError> {
    std::fs::read_to_string(path).map_err(|e| VerifyError::Read {
        path: path.to_owned(),
        reason: e.to_string(),
    })
}
