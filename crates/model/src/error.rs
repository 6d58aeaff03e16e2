//! Everything that can be wrong with a robot's files.

use std::fmt;
use std::path::PathBuf;

/// Something to say about one place of a file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Remark {
    /// File in which it stands.
    pub file: String,
    /// Line, counted from 1; 0: of no line in particular.
    pub line: u32,
    /// What is the matter and what to do, or what was done.
    pub message: String,
}

impl fmt::Display for Remark {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.line {
            0 => write!(f, "{}: {}", self.file, self.message),
            line => write!(f, "{}:{line}: {}", self.file, self.message),
        }
    }
}

/// Why a robot could not be loaded. Each message is one line that says what is wrong, where, and what to do.
#[derive(Debug, thiserror::Error)]
#[expect(missing_docs, reason = "a message says what its fields are")]
pub enum ModelError {
    /// A file could not be read: `of` says which file names it.
    #[error("cannot read {}{}: {source}", path.display(), of.as_deref().unwrap_or_default())]
    Read { path: PathBuf, of: Option<String>, source: std::io::Error },
    /// A file is larger than any robot description.
    #[error("{file} has more than {limit} bytes; is it the right file?")]
    TooLarge { file: String, limit: u64 },
    /// The robot file is not valid TOML, has an unknown or missing key, or a value of the wrong type.
    #[error("{file}:{line}: {message}")]
    RobotFile { file: String, line: usize, message: String },
    /// The MJCF is not well-formed XML.
    #[error("{0}")]
    Xml(Remark),
    /// The MJCF uses something outside the supported subset, or a value is wrong.
    #[error("{0}")]
    Mjcf(Remark),
    /// The two files do not describe one valid robot.
    #[error("{file}: {at}: {message}")]
    Invalid { file: String, at: String, message: String },
    /// An argument has the wrong length.
    #[error("{what} has {got} values where this robot needs {need}")]
    Length { what: &'static str, got: usize, need: usize },
}
