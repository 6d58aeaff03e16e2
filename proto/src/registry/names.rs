//! Names of streams and labels, safe as paths.

use std::fmt;

use super::error::{MAX_STREAM_NAME, RegistryError};

/// Name of a line of policies, such as `polymander/flat`. Safe as a relative path.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct StreamName(pub(super) String);

impl StreamName {
    /// A checked name.
    ///
    /// # Errors
    /// [`RegistryError::StreamName`] says what a name may look like.
    pub fn new(name: &str) -> Result<Self, RegistryError> {
        let letter = |b: u8| matches!(b, b'a'..=b'z' | b'0'..=b'9' | b'-' | b'_' | b'.');
        let part = |p: &str| !p.is_empty() && !p.starts_with('.') && p.bytes().all(letter);
        if name.len() <= MAX_STREAM_NAME && name.split('/').all(part) {
            return Ok(Self(name.to_owned()));
        }
        Err(RegistryError::StreamName)
    }

    /// The name.
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

impl fmt::Display for StreamName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

/// A label such as `stable`. Safe as a file name.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct LabelName(pub(super) String);

impl LabelName {
    /// The newest version that is not quarantined; moves by itself.
    pub const LATEST: &str = "latest";
    /// Needs robots that say that it went well.
    pub const STABLE: &str = "stable";

    /// A checked name.
    ///
    /// # Errors
    /// [`RegistryError::Label`].
    pub fn new(name: &str) -> Result<Self, RegistryError> {
        let letter = |b: u8| matches!(b, b'a'..=b'z' | b'0'..=b'9' | b'-');
        if (1..=32).contains(&name.len()) && name.bytes().all(letter) {
            return Ok(Self(name.to_owned()));
        }
        Err(RegistryError::Label)
    }

    /// [`LabelName::LATEST`].
    pub fn latest() -> Self {
        Self(Self::LATEST.to_owned())
    }

    /// Whether it moves by itself.
    pub fn is_latest(&self) -> bool {
        self.0 == Self::LATEST
    }

    /// Whether robots must have said that the version went well.
    pub fn needs_proof(&self) -> bool {
        self.0 == Self::STABLE
    }

    /// The name.
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

impl fmt::Display for LabelName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

impl std::str::FromStr for LabelName {
    type Err = RegistryError;

    fn from_str(text: &str) -> Result<Self, RegistryError> {
        Self::new(text)
    }
}
