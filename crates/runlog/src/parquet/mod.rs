//! Numbers out of Parquet files and into them (parquet.apache.org/docs/file-format): columns of booleans,
//! integers and floats, alone or in lists, as pyarrow, pandas, Polars and DuckDB write them.
//!
//! Packed with nothing, Snappy or zstd; plain or with a dictionary. What else there is (texts, images, maps) is
//! passed over. Nothing is believed of lengths: what a file says of itself is held to what it has, and a caller
//! says how many values it takes.

mod pages;
mod read;
mod table;
mod thrift;
mod write;

pub use read::{ParquetError, read};
pub use write::write;

/// Around a file.
const PAR1: &[u8] = b"PAR1";

/// Kinds of stored values.
mod kind {
    pub const BOOLEAN: i64 = 0;
    pub const INT32: i64 = 1;
    pub const INT64: i64 = 2;
    pub const FLOAT: i64 = 4;
    pub const DOUBLE: i64 = 5;
}

/// How pages are packed.
mod codec {
    pub const NONE: i64 = 0;
    pub const SNAPPY: i64 = 1;
    pub const ZSTD: i64 = 6;
}

/// How values are written.
mod encoding {
    pub const PLAIN: i64 = 0;
    pub const PLAIN_DICTIONARY: i64 = 2;
    pub const RUNS: i64 = 3;
    pub const RUNS_OF_DICTIONARY: i64 = 8;
}

/// A column: of each row no, one or several numbers.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Column {
    /// The name of the outermost field.
    pub name: String,
    values: Vec<f64>,
    /// Where each row ends in the values.
    ends: Vec<usize>,
}

impl Column {
    /// How many rows it has.
    pub fn rows(&self) -> usize {
        self.ends.len()
    }

    /// The numbers of a row; none where nothing is stored, and beyond the last.
    pub fn row(&self, row: usize) -> &[f64] {
        let begin = row
            .checked_sub(1)
            .and_then(|k| self.ends.get(k))
            .copied()
            .unwrap_or(0);
        let end = self.ends.get(row).copied().unwrap_or(begin);
        self.values.get(begin..end).unwrap_or_default()
    }
}

#[cfg(test)]
mod tests;
