//! A log, read whole.

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
/// Extensions of files of rows.
pub const ROWS: [&str; 3] = ["csv", MCAP, "parquet"];

/// A run: circumstances and rows.
#[derive(Clone, Debug, PartialEq)]
pub struct RunLog {
    /// `log.toml`, or what stands beside the rows.
    pub meta: LogMeta,
    /// `log.csv`, or what else holds the rows.
    pub table: Table,
    /// Name of the file of the rows, for messages.
    pub rows_name: String,
    /// Name of the file of the circumstances, for messages.
    pub meta_name: String,
}

impl RunLog {
    /// A log that is in no file; messages call its files as those of a log folder.
    pub fn new(meta: LogMeta, table: Table) -> Self {
        let (rows_name, meta_name) = (CSV_NAME.to_owned(), META_NAME.to_owned());
        Self { meta, table, rows_name, meta_name }
    }

    /// Reads and checks a log: a folder, or a file of rows that has its circumstances beside it.
    ///
    /// # Errors
    /// [`LogError`] with file, line and reason.
    pub fn read(log: &Path) -> Result<Self, LogError> {
        let path = meta_file(log);
        let text = read_text_at_most(&path, MAX_META_BYTES).map_err(io_error(&path))?;
        let meta = LogMeta::parse(&path.display().to_string(), &text)?;
        let rows = rows_file(log);
        let table = read_rows(&rows)?;
        let name =
            |path: &Path| path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let (rows_name, meta_name) = (name(&rows), name(&path));
        Ok(Self { meta, table, rows_name, meta_name })
    }
}

/// Reads a file of rows as what its name ends with: an MCAP or a Parquet file, else CSV.
///
/// # Errors
/// [`LogError`] with file, line and reason.
pub fn read_rows(path: &Path) -> Result<Table, LogError> {
    match path.extension().and_then(|x| x.to_str()) {
        Some(MCAP) => parse_mcap(&path.display().to_string(), &read_whole(path)?),
        Some("parquet") => Table::from_parquet(path),
        _ => Table::read(path),
    }
}

/// Whether a file of circumstances says of which robot it is, as that of every log does; one that is wrong counts
/// as that of a log, which then says what is wrong.
pub fn names_a_robot(meta: &Path) -> bool {
    let text = read_text_at_most(meta, MAX_META_BYTES);
    text.is_ok_and(|text| {
        let table = text.parse::<toml::Table>();
        table.map_or(true, |table| table.contains_key("robot"))
    })
}

/// The file of a log's circumstances: `log.toml` of a folder; `NAME.toml` beside a file of rows, `NAME.csv`.
pub fn meta_file(log: &Path) -> PathBuf {
    if log.is_file() { log.with_extension("toml") } else { log.join(META_NAME) }
}

/// The file of a log's rows: of a folder `log.csv`, else the first MCAP by name; else the file itself.
pub fn rows_file(log: &Path) -> PathBuf {
    if log.is_file() {
        return log.to_owned();
    }
    let csv = log.join(CSV_NAME);
    match mcap_in(log) {
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
