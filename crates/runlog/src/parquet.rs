//! Tables of numbers as Parquet files, by `pyarrow` in the Python that `CAUDATA_PYTHON` names, else `python3`.

use std::ffi::OsStr;
use std::path::Path;

use crate::error::LogError;
use crate::python::{Script, ScriptError};
use crate::signal::Signal;
use crate::table::{MAX_COLUMNS, MAX_ROWS, Table, check_time, check_value};

const CONVERTER: &str = include_str!("parquet.py");
/// The column of times.
const TIME: &str = "t";
/// Most values that are read: half a gigabyte.
const MAX_VALUES: usize = 64 * 1024 * 1024;

/// A column of numbers, or of lists of them.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Column {
    /// As the file calls it; parts of structures behind a point.
    pub name: String,
    values: Vec<f64>,
    /// Where the values of each row end.
    ends: Vec<usize>,
}

impl Column {
    /// How many rows there are.
    pub fn rows(&self) -> usize {
        self.ends.len()
    }

    /// The values of a row: one, those of a list, or none.
    pub fn row(&self, row: usize) -> &[f64] {
        let before = row.checked_sub(1).and_then(|k| self.ends.get(k));
        let begin = before.copied().unwrap_or(0);
        let end = self.ends.get(row).copied().unwrap_or(begin);
        self.values.get(begin..end).unwrap_or_default()
    }

    /// The next that the script prints; `None` where there is no whole one.
    fn take(script: &mut Script) -> Option<Self> {
        let count = |script: &mut Script| Some(u64::from_le_bytes(script.take()?) as usize);
        let length = count(script)?;
        let name = String::from_utf8(script.bytes(length)?).ok()?;
        let (rows, values) = (count(script)?, count(script)?);
        let sizes = script.bytes(rows.checked_mul(8)?)?;
        let values = script.bytes(values.checked_mul(8)?)?;
        let sizes = sizes.as_chunks::<8>().0.iter();
        let ends = sizes.scan(0usize, |end, size| {
            *end = end.saturating_add(u64::from_le_bytes(*size) as usize);
            Some(*end)
        });
        let values = values.as_chunks::<8>().0.iter();
        Some(Self {
            name,
            ends: ends.collect(),
            values: values.map(|x| f64::from_le_bytes(*x)).collect(),
        })
    }
}

/// The columns of numbers of a file that are called so, or all of them.
///
/// # Errors
/// [`LogError::Python`] where there is no such Python; [`LogError::Recording`] where the file is damaged or has
/// more than `most` values.
pub fn read(path: &Path, wanted: &[&str], most: usize) -> Result<Vec<Column>, LogError> {
    let most = most.to_string();
    let mut arguments = [OsStr::new("read"), path.as_os_str(), OsStr::new(&most)].to_vec();
    arguments.extend(wanted.iter().map(OsStr::new));
    let failed = |error: ScriptError| error.of(path);
    let mut script = Script::start(CONVERTER, &arguments, &[]).map_err(failed)?;
    let columns = std::iter::from_fn(|| Column::take(&mut script)).collect();
    script.finish().map(|()| columns).map_err(failed)
}

impl Table {
    /// Makes the file that [`Self::from_parquet`] reads: a column `t`, s, and one per signal.
    ///
    /// # Errors
    /// [`LogError::Python`] where there is no such Python; [`LogError::Recording`] where the file cannot be written.
    pub fn to_parquet(&self, path: &Path) -> Result<(), LogError> {
        let names: Vec<String> = self.signals().iter().map(ToString::to_string).collect();
        let mut arguments = [OsStr::new("write"), path.as_os_str(), OsStr::new(TIME)].to_vec();
        arguments.extend(names.iter().map(OsStr::new));
        let cells = self.signals().iter().flat_map(|s| self.column(s).unwrap_or_default());
        let cells = cells.map(|x| x.unwrap_or(f64::NAN));
        let values = self.time_s().iter().copied().chain(cells);
        let input: Vec<u8> = values.flat_map(f64::to_le_bytes).collect();
        let written = Script::start(CONVERTER, &arguments, &input).and_then(Script::finish);
        written.map_err(|error| error.of(path))
    }

    /// Reads a Parquet file whose columns are called as those of `log.csv`. Others are left out with a note.
    ///
    /// # Errors
    /// [`LogError`] with file, column and reason.
    pub fn from_parquet(path: &Path) -> Result<Self, LogError> {
        let wrong = |message: String| wrong(path, message);
        let columns = read(path, &[], MAX_VALUES)?;
        let mut time = None;
        let mut found: Vec<(Signal, Column)> = Vec::new();
        let mut notes = Vec::new();
        for column in columns {
            match column.name.parse::<Signal>() {
                _ if column.name == TIME => time = Some(column),
                Ok(signal) if found.iter().all(|(s, _)| *s != signal) => {
                    found.push((signal, column))
                }
                _ => {
                    notes.push(format!("{}: column `{}` is not read", path.display(), column.name))
                }
            }
        }
        let time = time.ok_or_else(|| wrong(format!("has no column `{TIME}` of times, s")))?;
        if time.rows() > MAX_ROWS || found.len() >= MAX_COLUMNS {
            let message = format!("has more than {MAX_ROWS} rows or {MAX_COLUMNS} columns");
            return Err(wrong(message));
        }
        let one = |column: &Column, row: usize| {
            column.row(row).first().copied().filter(|x| x.is_finite())
        };
        let mut time_s: Vec<f64> = Vec::with_capacity(time.rows());
        for row in 0..time.rows() {
            let t =
                one(&time, row).ok_or_else(|| wrong(format!("row {row}: `{TIME}` is empty")))?;
            check_time(time_s.last().copied(), t).map_err(|e| wrong(format!("row {row}: {e}")))?;
            time_s.push(t);
        }
        let mut cells = Vec::new();
        for (signal, column) in &found {
            let values: Vec<Option<f64>> = (0..time_s.len()).map(|row| one(column, row)).collect();
            for value in values.iter().flatten() {
                check_value(signal, *value).map_err(wrong)?;
            }
            cells.push(values);
        }
        let signals = found.into_iter().map(|(signal, _)| signal).collect();
        Ok(Self::from_columns(signals, time_s, cells, notes))
    }
}

fn wrong(path: &Path, message: String) -> LogError {
    LogError::Recording { file: path.display().to_string(), message }
}
