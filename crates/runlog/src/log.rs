//! A log folder, read whole.

use std::fs;
use std::path::Path;

use crate::error::LogError;
use crate::meta::LogMeta;
use crate::table::Table;

/// Name of the rows' file in a log folder.
pub const CSV_NAME: &str = "log.csv";
/// Name of the circumstances' file in a log folder.
pub const META_NAME: &str = "log.toml";

/// A run: circumstances and rows.
#[derive(Clone, Debug, PartialEq)]
pub struct RunLog {
    /// `log.toml`.
    pub meta: LogMeta,
    /// `log.csv`.
    pub table: Table,
}

impl RunLog {
    /// Reads and checks a log folder.
    ///
    /// # Errors
    /// [`LogError`] with file, line and reason.
    pub fn read(dir: &Path) -> Result<Self, LogError> {
        let path = dir.join(META_NAME);
        let text = fs::read_to_string(&path).map_err(|source| LogError::Io {
            path: path.clone(),
            source,
        })?;
        let meta = LogMeta::parse(&path.display().to_string(), &text)?;
        let table = Table::read(&dir.join(CSV_NAME))?;
        Ok(Self { meta, table })
    }
}
