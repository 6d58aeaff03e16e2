//! What is checked, and what was found.

use std::path::PathBuf;
use std::sync::Arc;

use caudata_model::RobotModel;
use caudata_sim::EngineConfig;
use serde::Serialize;

use super::mujoco::Presence;
use super::request::RobotRequest;

/// The larger one; not a number wins.
pub(super) fn largest(a: f64, b: f64) -> f64 {
    if a.is_nan() || b.is_nan() { f64::NAN } else { a.max(b) }
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
    pub(super) fn judged(
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
    pub(super) fn reported(
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

    pub(super) fn skipped(
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

/// What all checks share.
pub(super) struct Bench<'a> {
    pub settings: &'a Settings,
    pub model: Arc<RobotModel>,
    pub robot: RobotRequest,
    pub mujoco: Presence,
}

impl Bench<'_> {
    /// The engine of `subject` with steps of `dt_s`, `lanes` robots, control periods of 20 ms.
    pub fn config(&self, subject: &Subject, dt_s: f64) -> EngineConfig {
        EngineConfig { dt_s, substeps: (0.02 / dt_s).round() as u32, ..subject.config.clone() }
    }
}
