//! Parquet to columns.

use super::pages::{Leaf, Pages};
use super::thrift::{self, Value};
use super::{Column, PAR1, kind};

/// Largest description of a file, bytes.
const MAX_FOOTER_BYTES: usize = 16 * 1024 * 1024;
/// Deepest nesting of fields.
const MAX_NESTING: usize = 32;
/// What lists call their insides.
const INSIDES: [&str; 5] = ["list", "element", "item", "array", "bag"];
/// How often a field is there in the one around it.
const OPTIONAL: i64 = 1;
const REPEATED: i64 = 2;

/// Why a file cannot be read.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ParquetError {
    /// Another kind of file.
    #[error("is not a whole Parquet file: it does not begin and end with PAR1")]
    Magic,
    /// What it says of itself cannot be.
    #[error("is damaged: {0}")]
    Damaged(&'static str),
    /// A column that cannot be read.
    #[error("column `{0}`: {1}")]
    Column(String, String),
    /// More values than the caller takes.
    #[error("has more than {0} values: split it")]
    Many(usize),
}

use ParquetError::{Damaged, Many};

/// The columns of numbers that are `wanted` by name, `most` values and rows of them together at most.
///
/// # Errors
/// [`ParquetError`].
pub fn read(
    bytes: &[u8],
    wanted: &dyn Fn(&str) -> bool,
    most: usize,
) -> Result<Vec<Column>, ParquetError> {
    let meta = footer(bytes)?;
    let schema = meta.list(2).ok_or(Damaged("it has no schema"))?;
    let (mut leaves, mut at) = (Vec::new(), 0);
    fields(schema, &mut at, &[], [0, 0], &mut leaves)?;
    let mut columns: Vec<Option<Column>> = leaves
        .iter()
        .map(|leaf: &Leaf| {
            let name = leaf.name.clone();
            let read = leaf.kind.is_some() && wanted(&name);
            read.then(|| Column {
                name,
                ..Column::default()
            })
        })
        .collect();
    let mut left = most;
    for group in meta.list(4).unwrap_or_default() {
        let chunks = group.list(1).unwrap_or_default();
        if chunks.len() != leaves.len() {
            return Err(Damaged("a row group has other columns than the schema"));
        }
        for ((leaf, column), chunk) in leaves.iter().zip(&mut columns).zip(chunks) {
            let Some(column) = column else { continue };
            let about = chunk
                .field(3)
                .ok_or(Damaged("a column says nothing of itself"))?;
            left = read_chunk(bytes, about, leaf, column, left).map_err(|e| match e {
                Some(why) => ParquetError::Column(leaf.name.clone(), why),
                None => Many(most),
            })?;
        }
    }
    Ok(columns.into_iter().flatten().collect())
}

fn footer(bytes: &[u8]) -> Result<Value, ParquetError> {
    let inside = bytes.strip_prefix(PAR1).and_then(|b| b.strip_suffix(PAR1));
    let (rest, length) = inside
        .and_then(|b| b.split_last_chunk())
        .ok_or(ParquetError::Magic)?;
    let length = u32::from_le_bytes(*length) as usize;
    let begin = rest
        .len()
        .checked_sub(length)
        .filter(|_| length <= MAX_FOOTER_BYTES);
    let begin = begin.ok_or(Damaged("its description is longer than the file"))?;
    thrift::read(&mut &rest[begin..]).ok_or(Damaged("its description cannot be read"))
}

/// The leaves below the schema's element `at`, which is moved on behind them; `levels` are those around it.
fn fields(
    schema: &[Value],
    at: &mut usize,
    path: &[&str],
    [mut present, mut repeat]: [u32; 2],
    leaves: &mut Vec<Leaf>,
) -> Result<(), ParquetError> {
    let element = schema
        .get(*at)
        .ok_or(Damaged("its schema ends too early"))?;
    let is_root = *at == 0;
    *at += 1;
    if path.len() > MAX_NESTING {
        return Err(Damaged("its schema is nested too deeply"));
    }
    let mut path = path.to_vec();
    if !is_root {
        path.push(element.text(4).ok_or(Damaged("a field has no name"))?);
        match element.int(3) {
            Some(OPTIONAL) => present += 1,
            Some(REPEATED) => (present, repeat) = (present + 1, repeat + 1),
            _ => {}
        }
    }
    let children = element.int(5).unwrap_or(0);
    if children == 0 && !is_root {
        let numbers = [
            kind::BOOLEAN,
            kind::INT32,
            kind::INT64,
            kind::FLOAT,
            kind::DOUBLE,
        ];
        let outside = path[..1].iter();
        let inside = path[1..].iter().filter(|part| !INSIDES.contains(part));
        leaves.push(Leaf {
            name: outside.chain(inside).copied().collect::<Vec<_>>().join("."),
            kind: element.int(1).filter(|kind| numbers.contains(kind)),
            most_levels: [present, repeat],
        });
    }
    for _ in 0..children {
        fields(schema, at, &path, [present, repeat], leaves)?;
    }
    Ok(())
}

/// Adds the values of a row group to their column; how many more values may come. `None`: they were too many.
fn read_chunk(
    bytes: &[u8],
    about: &Value,
    leaf: &Leaf,
    column: &mut Column,
    mut left: usize,
) -> Result<usize, Option<String>> {
    let wrong = |what: &str| Some(what.to_owned());
    let number = |field| about.int(field).and_then(|n| usize::try_from(n).ok());
    let dictionary = number(11).filter(|at| *at > 0);
    let begin = number(9).map(|data| dictionary.map_or(data, |at| at.min(data)));
    let end = begin
        .zip(number(7))
        .and_then(|(begin, length)| begin.checked_add(length));
    let pages = begin
        .zip(end)
        .and_then(|(begin, end)| bytes.get(begin..end));
    let mut pages = Pages {
        leaf,
        codec: about.int(4).unwrap_or(-1),
        bytes: pages.ok_or_else(|| wrong("its values are beyond the end of the file"))?,
        dictionary: Vec::new(),
    };
    let mut awaited = number(5).ok_or_else(|| wrong("it does not say how many values it has"))?;
    if awaited > left {
        return Err(None);
    }
    while awaited > 0 {
        let entries = pages.next(awaited).map_err(Some)?;
        if entries.is_empty() {
            return Err(wrong("a page is empty"));
        }
        awaited -= entries.len();
        left -= entries.len();
        for entry in entries {
            if entry.begins {
                column.ends.push(column.values.len());
            }
            if let (Some(value), Some(end)) = (entry.value, column.ends.last_mut()) {
                column.values.push(value);
                *end = column.values.len();
            }
        }
    }
    Ok(left)
}
