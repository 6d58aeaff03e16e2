//! What can be wrong with a log.

use std::io;
use std::path::{Path, PathBuf};

/// Why a log could not be read or written. One line each: what, where, what to do.
#[derive(Debug, thiserror::Error)]
pub enum LogError {
    /// The system refused.
    #[error("{}: {source}", path.display())]
    Io {
        /// File or folder.
        path: PathBuf,
        /// The reason given by the system.
        source: io::Error,
    },
    /// There is a log already; nothing is overwritten.
    #[error("{} exists already; choose another folder or move it away", path.display())]
    Exists {
        /// The file in the way.
        path: PathBuf,
    },
    /// `log.toml` is wrong.
    #[error("{file}:{line}: {message}")]
    Meta {
        /// The file.
        file: String,
        /// Line, counted from 1.
        line: usize,
        /// What is wrong.
        message: String,
    },
    /// The header line is wrong.
    #[error("{file}:1: column {column}: {message}")]
    Header {
        /// The file.
        file: String,
        /// Column, counted from 1.
        column: usize,
        /// What is wrong.
        message: String,
    },
    /// A row is wrong.
    #[error("{file}:{line}: {message}")]
    Row {
        /// The file.
        file: String,
        /// Line, counted from 1.
        line: usize,
        /// What is wrong.
        message: String,
    },
    /// An MCAP, SQLite or Parquet file is wrong.
    #[error("{file}: {message}")]
    Recording {
        /// The file.
        file: String,
        /// What is wrong.
        message: String,
    },
    /// The Python that reads or writes such a file is not there, or lacks a library.
    #[error("{file}: {message}")]
    Python {
        /// The file.
        file: String,
        /// What is missing.
        message: String,
    },
    /// A row handed to the writer cannot be part of a log; nothing of it was written.
    #[error("row refused: {0}")]
    Refused(String),
}

/// The system's error at a file or folder.
pub(crate) fn io_error(path: &Path) -> impl FnOnce(io::Error) -> LogError + use<> {
    let path = path.to_owned();
    |source| LogError::Io { path, source }
}
