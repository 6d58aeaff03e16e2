//! Recordings of other projects, turned into log folders.
//!
//! Each format is one module that reads a file into an [`Imported`] run; from there on nothing knows where a
//! log came from. What a format leaves to the servo (a gain as a register value) is worked out with the robot
//! file, so that a rig is an ordinary robot.

pub mod bam;
pub mod csv;
pub mod draft;

use std::path::{Path, PathBuf};

use caudata_runlog::{LogError, LogMeta, LogWriter, Signal};

/// Largest recording that is read, bytes.
pub const MAX_FILE_BYTES: u64 = 256 * 1024 * 1024;

/// Why a recording could not be turned into a log. One line each.
#[derive(Debug, thiserror::Error)]
pub enum ImportError {
    /// The system refused.
    #[error("{}: {source}", path.display())]
    Io {
        /// The recording.
        path: PathBuf,
        /// The system's reason.
        source: std::io::Error,
    },
    /// The recording is not what its format says.
    #[error("{file}: {message}")]
    Format {
        /// The recording.
        file: String,
        /// What is wrong, and where.
        message: String,
    },
    /// The robot file does not fit the recording.
    #[error("{file}: does not fit the robot `{robot}`: {message}")]
    Robot {
        /// The recording.
        file: String,
        /// Name in the robot file.
        robot: String,
        /// What does not fit.
        message: String,
    },
    /// The log cannot be written.
    #[error(transparent)]
    Log(#[from] LogError),
}

/// A recording in the neutral form.
#[derive(Clone, Debug, PartialEq)]
pub struct Imported {
    /// Name for the log folder: letters, digits, `_` and `-`.
    pub name: String,
    /// Circumstances.
    pub meta: LogMeta,
    /// Columns after `t`.
    pub signals: Vec<Signal>,
    /// Time (s) and one value per signal, `None` where not sampled.
    pub rows: Vec<(f64, Vec<Option<f64>>)>,
    /// What the reader noticed, one line each.
    pub notes: Vec<String>,
}

impl Imported {
    /// Writes the log folder `dir/name` and returns its path. Nothing is overwritten.
    ///
    /// # Errors
    /// [`LogError`], among them [`LogError::Exists`].
    pub fn write(&self, dir: &Path) -> Result<PathBuf, LogError> {
        let folder = dir.join(&self.name);
        let mut log = LogWriter::create(&folder, &self.signals, &self.meta)?;
        for (t_s, row) in &self.rows {
            log.row(*t_s, row)?;
        }
        log.finish()?;
        Ok(folder)
    }
}

/// The bytes of a recording, not more than [`MAX_FILE_BYTES`].
pub(crate) fn read(path: &Path) -> Result<Vec<u8>, ImportError> {
    let failed = |source| ImportError::Io {
        path: path.to_owned(),
        source,
    };
    caudata_durable::read_at_most(path, MAX_FILE_BYTES).map_err(|error| match error.kind() {
        std::io::ErrorKind::FileTooLarge => ImportError::Format {
            file: path.display().to_string(),
            message: error.to_string(),
        },
        _ => failed(error),
    })
}
