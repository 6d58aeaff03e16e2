//! Why ground truth cannot be had.

use std::path::{Path, PathBuf};

use caudata_model::ModelError;
use caudata_sim::SimError;

/// Why the table could not be made.
#[derive(Debug, thiserror::Error)]
#[expect(missing_docs, reason = "a message says what its fields are")]
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
    Read { path: PathBuf, reason: String },
}

/// Reads a text file.
pub(super) fn read(path: &Path) -> Result<String, VerifyError> {
    std::fs::read_to_string(path)
        .map_err(|e| VerifyError::Read { path: path.to_owned(), reason: e.to_string() })
}
