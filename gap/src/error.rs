//! What can go wrong before a verdict: one line each, with what to do.

use thiserror::Error;

/// Why a diagnosis could not be made.
#[derive(Debug, Error)]
#[expect(missing_docs, reason = "a message says what its fields are")]
pub enum GapError {
    /// No run to fit to.
    #[error("no run to diagnose; give at least one --log")]
    NoRuns,
    /// A run lacks what diagnosis needs.
    #[error("run {run}: {message}")]
    Run { run: String, message: String },
    /// The robot file.
    #[error(transparent)]
    Model(#[from] caudata_model::ModelError),
    /// The simulator refused.
    #[error("simulation: {0}")]
    Sim(#[from] caudata_sim::SimError),
    /// The extension of a robot file.
    #[error("extension: {0}")]
    Extension(String),
    /// An effect that is asked for or left out.
    #[error("there is no effect `{0}`; {meant}", meant = crate::effects::meant(.0))]
    UnknownEffect(String),
    /// The map from evidence to confidence.
    #[error("calibration: {0}; make one with caudata bench calibrate")]
    Calibration(String),
    /// Whoever started it asked it to end.
    #[error("stopped")]
    Stopped,
    /// A worker thread died.
    #[error("a worker thread of the replay died; this is a fault of the program")]
    Worker,
}
