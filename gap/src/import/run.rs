//! What a recording becomes, and what the readers of all forms need.

use std::path::{Path, PathBuf};

use caudata_runlog::{LogError, LogMeta, LogWriter, Signal};

/// Largest recording that is read, bytes.
pub const MAX_FILE_BYTES: u64 = 256 * 1024 * 1024;

/// Why a recording could not be turned into a log. One line each.
#[derive(Debug, thiserror::Error)]
#[expect(missing_docs, reason = "a message says what its fields are")]
pub enum ImportError {
    /// The system refused.
    #[error("{}: {source}", path.display())]
    Io { path: PathBuf, source: std::io::Error },
    /// The recording is not what its format says.
    #[error("{file}: {message}")]
    Format { file: String, message: String },
    /// The robot file does not fit the recording.
    #[error("{file}: does not fit the robot `{robot}`: {message}")]
    Robot { file: String, robot: String, message: String },
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
    /// Columns and topics that are there and were not used.
    pub unused: Vec<String>,
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

/// What a run from `path` is called: the folder's name, or the file's without its ending.
pub(super) fn file_stem(path: &Path) -> String {
    let whole = path.canonicalize().unwrap_or_else(|_| path.to_owned());
    let name = if whole.is_dir() { whole.file_name() } else { whole.file_stem() };
    name.unwrap_or_default().to_string_lossy().into_owned()
}

/// The files with this ending in `folder` and `depth` - 1 levels of folders below, by name.
pub(super) fn files_below(
    folder: &Path,
    extension: &str,
    depth: usize,
) -> Result<Vec<PathBuf>, ImportError> {
    let failed = |source| ImportError::Io { path: folder.to_owned(), source };
    let mut found = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(failed)? {
        let path = entry.map_err(failed)?.path();
        if path.is_dir() && depth > 1 {
            found.extend(files_below(&path, extension, depth - 1)?);
        } else if path.extension().is_some_and(|x| x.eq_ignore_ascii_case(extension)) {
            found.push(path);
        }
    }
    found.sort();
    Ok(found)
}

/// The bytes of a recording, not more than [`MAX_FILE_BYTES`].
pub(super) fn bytes(path: &Path) -> Result<Vec<u8>, ImportError> {
    let failed = |source| ImportError::Io { path: path.to_owned(), source };
    caudata_durable::read_at_most(path, MAX_FILE_BYTES).map_err(|error| match error.kind() {
        std::io::ErrorKind::FileTooLarge => {
            ImportError::Format { file: path.display().to_string(), message: error.to_string() }
        }
        _ => failed(error),
    })
}
