//! A log folder, read whole.

use std::fs;
use std::path::{Path, PathBuf};

use caudata_durable::read_text_at_most;

use crate::error::{LogError, io_error};
use crate::meta::LogMeta;
use crate::ros::bag::read_whole;
use crate::ros::parse_mcap;
use crate::table::Table;

/// Name of the rows' file in a log folder.
pub const CSV_NAME: &str = "log.csv";
/// Name of the circumstances' file in a log folder.
pub const META_NAME: &str = "log.toml";
/// Largest `log.toml` that is read.
const MAX_META_BYTES: u64 = 1 << 20;
/// Extension of a recording of ROS 2.
const MCAP: &str = "mcap";

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
        let text = read_text_at_most(&path, MAX_META_BYTES).map_err(io_error(&path))?;
        let meta = LogMeta::parse(&path.display().to_string(), &text)?;
        let rows = rows_file(dir);
        let table = match rows.extension().is_some_and(|x| x == MCAP) {
            true => parse_mcap(&rows.display().to_string(), &read_whole(&rows)?)?,
            false => Table::read(&rows)?,
        };
        Ok(Self { meta, table })
    }
}

/// The file of a log folder that its rows are read from: `log.csv`, else the first MCAP by name.
pub fn rows_file(dir: &Path) -> PathBuf {
    let csv = dir.join(CSV_NAME);
    match mcap_in(dir) {
        Some(mcap) if !csv.is_file() => mcap,
        _ => csv,
    }
}

/// The first MCAP file of the folder, by name.
fn mcap_in(dir: &Path) -> Option<PathBuf> {
    let entries = fs::read_dir(dir).ok()?;
    let mut found: Vec<PathBuf> = entries
        .filter_map(|e| Some(e.ok()?.path()))
        .filter(|p| p.extension().is_some_and(|x| x == MCAP))
        .collect();
    found.sort();
    found.into_iter().next()
}
