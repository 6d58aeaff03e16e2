//! What is wrong with a file of keys, and reading such files.

use std::io::ErrorKind;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use caudata_durable::read_text_at_most;

/// Largest trust file, and largest file of signatures, bytes.
const FILE_MAX: u64 = 64 << 10;

/// What is wrong with a key or trust file.
#[derive(Debug, thiserror::Error)]
#[expect(missing_docs, reason = "a message says what its fields are")]
pub enum SigningError {
    /// It cannot be read or written.
    #[error("{}: {source}", path.display())]
    File { path: PathBuf, source: std::io::Error },
    /// It holds a secret, and others may use it.
    #[error("{}: others may use this secret (mode {mode:o}); `chmod 600` it", path.display())]
    Exposed { path: PathBuf, mode: u32 },
    /// Its content is not what it must be.
    #[error("{}: {reason}", path.display())]
    Content { path: PathBuf, reason: String },
}

impl SigningError {
    /// Whether the file cannot be read or written, and not what it holds is wrong.
    pub fn is_of_reading(&self) -> bool {
        matches!(self, Self::File { .. })
    }
}

/// Refuses a file with a secret that others than its owner and its group may read, or others than its owner
/// may write.
///
/// # Errors
/// [`SigningError::Exposed`]; [`SigningError::File`] where it is not there.
pub fn check_private(path: &Path) -> Result<(), SigningError> {
    let mode = std::fs::metadata(path).map_err(file_error(path))?.mode() & 0o777;
    if mode & 0o027 == 0 {
        return Ok(());
    }
    Err(SigningError::Exposed { path: path.to_owned(), mode })
}

/// Refuses a file that anybody may write: whoever adds a key to a trust file has the robot.
pub(crate) fn check_kept(path: &Path) -> Result<(), SigningError> {
    let mode = std::fs::metadata(path).map_err(file_error(path))?.mode() & 0o777;
    if mode & 0o002 == 0 {
        return Ok(());
    }
    let reason =
        format!("anybody may write it (mode {mode:o}); `chmod o-w` it, and look at its keys");
    Err(content(path, reason))
}

/// What is in a file, or beside it, cannot be used.
pub(crate) fn content(path: &Path, reason: impl ToString) -> SigningError {
    SigningError::Content { path: path.to_owned(), reason: reason.to_string() }
}

pub(crate) fn file_error(path: &Path) -> impl FnOnce(std::io::Error) -> SigningError + '_ {
    move |source| SigningError::File { path: path.to_owned(), source }
}

pub(crate) fn read_small(path: &Path) -> Result<String, SigningError> {
    read_text_at_most(path, FILE_MAX).map_err(|error| match error.kind() {
        ErrorKind::FileTooLarge | ErrorKind::InvalidData => content(path, error),
        _ => file_error(path)(error),
    })
}

/// 64 hexadecimal digits.
pub(crate) fn from_hex(text: &str) -> Option<[u8; 32]> {
    caudata_proto::hex::from_hex(text)?.try_into().ok()
}
