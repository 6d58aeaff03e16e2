//! What every form of recording is read into: sheets of named columns whose rows share stamps.

use std::collections::BTreeMap;
use std::path::Path;

use super::run::ImportError;

/// Most values of one recording, together.
pub const MAX_VALUES: usize = 50_000_000;
/// As many values as a column takes that has none.
const NEW_COLUMN: usize = 32;
/// Most columns of one sheet.
pub const MAX_COLUMNS: usize = 4096;

/// One run as it was recorded.
pub struct Recording {
    /// Where it comes from, for messages.
    pub file: String,
    /// Name of the run.
    pub name: String,
    /// A CSV file, a topic, an episode each.
    pub sheets: Vec<Box<dyn Sheet>>,
    /// The clock that the sheets share, where the form has one.
    pub clock: Option<Clock>,
    /// What is there and cannot be read, by name.
    pub unread: Vec<String>,
    /// What the reader noticed, one line each.
    pub notes: Vec<String>,
}

impl Recording {
    /// The name of the file that a sheet is, where there are several.
    pub(super) fn file_of<'a>(&self, sheet: &'a dyn Sheet) -> Option<&'a str> {
        let name = Path::new(sheet.name()).file_name().and_then(|name| name.to_str());
        name.filter(|_| self.sheets.len() > 1)
    }
}

/// A column of times.
#[derive(Clone, Debug, PartialEq)]
pub struct Clock {
    /// The column's name, in every sheet.
    pub column: String,
    /// Its unit, as a map has it.
    pub unit: &'static str,
    /// What has to be known of it.
    pub remark: String,
}

/// What the form of a recording tells of a column.
#[derive(Clone, Debug, PartialEq)]
pub struct Hint {
    /// Kind of signal (`pos`), or the signal (`imu.gyro.x`); empty: none that a log has.
    pub kind: &'static str,
    /// The joint as the recording calls it, where the signal is one of a joint.
    pub joint: Option<Joint>,
    /// Its unit, where the form says so.
    pub unit: Option<&'static str>,
}

/// A joint of a recording.
#[derive(Clone, Debug, PartialEq)]
pub enum Joint {
    /// By its name.
    Named(String),
    /// By its place (from 0) among so many.
    Numbered(usize, usize),
}

/// Rows that share stamps.
pub trait Sheet {
    /// What it is called: a file, a topic.
    fn name(&self) -> &str;

    /// Its columns, clocks among them.
    fn header(&self) -> Vec<&str>;

    /// The values of a column, one per row and in its own unit; of lists, the one at `item`. `None`: not
    /// sampled.
    ///
    /// # Errors
    /// [`ImportError`] where there is no such column, or a value is no number.
    fn values(&self, column: &str, item: Option<usize>) -> Result<Vec<Option<f64>>, ImportError>;

    /// What the form tells of a column; `None`: nothing but its name.
    fn hint(&self, _column: &str) -> Option<&Hint> {
        None
    }
}

/// A sheet of numbers; columns may begin at any row.
#[derive(Clone, Debug, Default)]
pub struct Numbers {
    name: String,
    /// NaN: not sampled. Shorter than `rows`: not sampled from there on.
    columns: Vec<(String, Hint, Vec<f64>)>,
    places: BTreeMap<String, usize>,
    rows: usize,
}

impl Numbers {
    /// Without rows.
    pub fn new(name: impl Into<String>) -> Self {
        let name = name.into();
        Self { name, ..Self::default() }
    }

    /// How many rows there are.
    pub fn rows(&self) -> usize {
        self.rows
    }

    /// A further row of values; `hint` is asked where a column is new. Returns how many values its columns now
    /// take.
    ///
    /// # Errors
    /// Of more than [`MAX_COLUMNS`] columns.
    pub fn push(
        &mut self,
        row: impl Iterator<Item = (String, f64)>,
        hint: &dyn Fn(&str) -> Hint,
    ) -> Result<usize, String> {
        let mut added = 0;
        for (column, value) in row {
            let place = match self.places.get(&column) {
                Some(place) => *place,
                None if self.columns.len() >= MAX_COLUMNS => {
                    return Err(format!("has more than {MAX_COLUMNS} columns"));
                }
                None => {
                    let place = self.columns.len();
                    self.columns.push((column.clone(), hint(&column), Vec::new()));
                    self.places.insert(column, place);
                    added += NEW_COLUMN;
                    place
                }
            };
            let values = &mut self.columns[place].2;
            let before = values.len();
            values.resize(self.rows, f64::NAN);
            values.push(value);
            added += values.len().saturating_sub(before);
        }
        self.rows += 1;
        Ok(added)
    }

    /// A column of as many values as there are rows, in front of the others.
    pub fn put_first(&mut self, column: &str, values: Vec<f64>) {
        let hint = Hint { kind: "", joint: None, unit: None };
        self.columns.insert(0, (column.to_owned(), hint, values));
        let names = self.columns.iter().enumerate();
        self.places = names.map(|(place, (name, ..))| (name.clone(), place)).collect();
    }
}

impl Sheet for Numbers {
    fn name(&self) -> &str {
        &self.name
    }

    fn header(&self) -> Vec<&str> {
        self.columns.iter().map(|c| c.0.as_str()).collect()
    }

    fn values(&self, column: &str, item: Option<usize>) -> Result<Vec<Option<f64>>, ImportError> {
        let wrong = |message| ImportError::Format { file: self.name.clone(), message };
        let Some(place) = self.places.get(column) else {
            let has = self.header().join(", ");
            return Err(wrong(format!("has no column `{column}`; it has {has}")));
        };
        if item.is_some() {
            return Err(wrong(format!("`{column}` holds no lists: leave `item` out")));
        }
        let values = self.columns[*place].2.iter().map(|x| x.is_finite().then_some(*x));
        let missing = std::iter::repeat(None);
        Ok(values.chain(missing).take(self.rows).collect())
    }

    fn hint(&self, column: &str) -> Option<&Hint> {
        self.places.get(column).map(|place| &self.columns[*place].1)
    }
}
