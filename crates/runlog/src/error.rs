//! What can be wrong with a log.

use std::io;
use std::path::{Path, PathBuf};

/// Why a log could not be read or written. One line each: what, where, what to do.
#[derive(Debug, thiserror::Error)]
#[expect(missing_docs, reason = "a message says what its fields are")]
pub enum LogError {
    /// The system refused.
    #[error("{}: {source}", path.display())]
    Io { path: PathBuf, source: io::Error },
    /// There is a log already; nothing is overwritten.
    #[error("{} exists already; choose another folder or move it away", path.display())]
    Exists { path: PathBuf },
    /// `log.toml` is wrong.
    #[error("{file}:{line}: {message}")]
    Meta { file: String, line: usize, message: String },
    /// The header line is wrong.
    #[error("{file}:1: column {column}: {message}")]
    Header { file: String, column: usize, message: String },
    /// A row is wrong.
    #[error("{file}:{line}: {message}")]
    Row { file: String, line: usize, message: String },
    /// An MCAP, SQLite or Parquet file is wrong.
    #[error("{file}: {message}")]
    Recording { file: String, message: String },
    /// The Python that reads or writes such a file is not there, or lacks a library.
    #[error("{file}: {message}")]
    Python { file: String, message: String },
    /// A row handed to the writer cannot be part of a log; nothing of it was written.
    #[error("row refused: {0}")]
    Refused(String),
}

/// The system's error at a file or folder.
pub(crate) fn io_error(path: &Path) -> impl FnOnce(io::Error) -> LogError + use<> {
    let path = path.to_owned();
    |source| LogError::Io { path, source }
}
