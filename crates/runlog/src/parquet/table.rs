//! A log's rows as Parquet: a column `t`, s, and one per signal.

use super::{Column, read, write};
use crate::error::LogError;
use crate::signal::Signal;
use crate::table::{MAX_COLUMNS, MAX_ROWS, Table, check_time, check_value};

/// The column of times.
const TIME: &str = "t";
/// Most values that are read: half a gigabyte.
const MAX_VALUES: usize = 64 * 1024 * 1024;

impl Table {
    /// The file that [`Self::from_parquet`] reads.
    ///
    /// # Errors
    /// [`LogError::Refused`] where it cannot be packed.
    pub fn to_parquet(&self) -> Result<Vec<u8>, LogError> {
        let time = self.time_s().iter().map(|t| Some(*t)).collect();
        let signals = self.signals().iter();
        let signals = signals.map(|s| (s.to_string(), self.column(s).unwrap_or_default().to_vec()));
        let columns: Vec<(String, Vec<Option<f64>>)> = std::iter::once((TIME.to_owned(), time))
            .chain(signals)
            .collect();
        write(&columns).map_err(LogError::Refused)
    }

    /// Reads a Parquet file whose columns are called as those of `log.csv`; `file` names it in errors and notes.
    /// Others are left out with a note.
    ///
    /// # Errors
    /// [`LogError`] with file, column and reason.
    pub fn from_parquet(file: &str, bytes: &[u8]) -> Result<Self, LogError> {
        let wrong = |message: String| LogError::Recording {
            file: file.to_owned(),
            message,
        };
        let columns = read(bytes, &|_| true, MAX_VALUES).map_err(|e| wrong(e.to_string()))?;
        let mut time = None;
        let mut found: Vec<(Signal, Column)> = Vec::new();
        let mut notes = Vec::new();
        for column in columns {
            match column.name.parse::<Signal>() {
                _ if column.name == TIME => time = Some(column),
                Ok(signal) if found.iter().all(|(s, _)| *s != signal) => {
                    found.push((signal, column))
                }
                _ => notes.push(format!("{file}: column `{}` is not read", column.name)),
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
