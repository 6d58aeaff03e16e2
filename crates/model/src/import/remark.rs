//! What is said of a file.

use std::fmt;

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
