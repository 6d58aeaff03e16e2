//! Tables of an SQLite file (sqlite.org/fileformat2.html), row by row: as much as a bag of ROS 2 needs. No
//! indices, no write-ahead log, nothing is written.
//!
//! Files come from anywhere: a page, a cell and a length are believed only as far as the file holds them, and
//! a tree that goes through more pages than there are ends there.

use std::io::{self, Read, Seek, SeekFrom};
use std::ops::Range;

const FORMAT: &[u8; 16] = b"SQLite format 3\0";
/// Bytes of the file's header, which stand on the first page.
const HEADER_BYTES: usize = 100;
/// Kinds of pages of a table.
const INTERIOR: u8 = 5;
const LEAF: u8 = 13;
/// Largest row that is read, bytes.
const MAX_ROW_BYTES: u64 = 64 * 1024 * 1024;

/// Why a file cannot be read.
#[derive(Debug, thiserror::Error)]
pub enum SqliteError {
    /// The system refused.
    #[error(transparent)]
    Io(#[from] io::Error),
    /// Another kind of file.
    #[error("is not an SQLite file: it does not begin with `SQLite format 3`")]
    Magic,
    /// What it says of itself cannot be.
    #[error("is damaged: {0}")]
    Damaged(&'static str),
    /// Texts in UTF-16.
    #[error("holds texts that are not UTF-8")]
    Encoding,
}

use SqliteError::Damaged;

/// A value of a row: a number, or where its bytes stand in the row.
#[derive(Clone, Debug, PartialEq)]
pub enum Value {
    /// Nothing; a row's number is stored so.
    Null,
    /// A whole number.
    Int(i64),
    /// Any other number, a text or bytes.
    Bytes(Range<usize>),
}

/// A table that the file has.
#[derive(Clone, Debug, PartialEq)]
pub struct Table {
    /// Its name.
    pub name: String,
    /// Names of its columns, in the order of a row's values.
    pub columns: Vec<String>,
    root: u32,
}

/// A row: the values, and those of its bytes that stand in the tree. The others are fetched by
/// [`Database::whole`].
#[derive(Clone, Debug, PartialEq)]
pub struct Row {
    /// Its number.
    pub id: i64,
    /// In the order of the columns.
    pub values: Vec<Value>,
    local: Vec<u8>,
    total: usize,
    overflow: u32,
}

/// An open file.
pub struct Database<F> {
    file: F,
    page_bytes: usize,
    /// Without what is reserved at a page's end.
    usable: usize,
    pages: u32,
}

impl<F: Read + Seek> Database<F> {
    /// Reads the header.
    ///
    /// # Errors
    /// [`SqliteError`].
    pub fn open(mut file: F) -> Result<Self, SqliteError> {
        let length = file.seek(SeekFrom::End(0))?;
        file.rewind()?;
        let mut header = [0; HEADER_BYTES];
        if length < HEADER_BYTES as u64 {
            return Err(SqliteError::Magic);
        }
        file.read_exact(&mut header)?;
        if !header.starts_with(FORMAT) {
            return Err(SqliteError::Magic);
        }
        let page_bytes = match u16::from_be_bytes([header[16], header[17]]) {
            1 => 65_536,
            n if n >= 512 && n.is_power_of_two() => usize::from(n),
            _ => return Err(Damaged("its page size is none")),
        };
        if header[59] != 1 {
            return Err(SqliteError::Encoding);
        }
        Ok(Self {
            file,
            page_bytes,
            // the header allows 255 bytes at most, and a page has 512
            usable: page_bytes - usize::from(header[20]),
            pages: u32::try_from(length / page_bytes as u64).unwrap_or(u32::MAX),
        })
    }

    /// The tables of the file.
    ///
    /// # Errors
    /// [`SqliteError`].
    pub fn tables(&mut self) -> Result<Vec<Table>, SqliteError> {
        let mut rows = Vec::new();
        self.rows::<SqliteError>(1, &mut |_, row| {
            rows.push(row);
            Ok(rows.len() < 1000)
        })?;
        let mut tables = Vec::new();
        for row in rows {
            let bytes = self.whole(&row)?;
            let text = |k: usize| row.text(k, &bytes);
            let (Some("table"), Some(name), Some(Value::Int(root)), Some(sql)) =
                (text(0), text(1), row.values.get(3), text(4))
            else {
                continue;
            };
            let listed = sql.split_once('(').map_or("", |(_, rest)| rest);
            let named = listed
                .split(',')
                .filter_map(|c| c.split_whitespace().next());
            tables.push(Table {
                name: name.to_owned(),
                columns: named
                    .map(|c| c.trim_matches(['"', '`', '[', ']']).to_owned())
                    .collect(),
                root: u32::try_from(*root).map_err(|_| Damaged("a table begins nowhere"))?,
            });
        }
        Ok(tables)
    }

    /// Calls `each` with the rows of `table`, in the order of their numbers, until it answers `false`.
    ///
    /// # Errors
    /// [`SqliteError`], and what `each` returns.
    pub fn each<E: From<SqliteError>>(
        &mut self,
        table: &Table,
        each: &mut dyn FnMut(&mut Self, Row) -> Result<bool, E>,
    ) -> Result<(), E> {
        self.rows(table.root, each)
    }

    fn rows<E: From<SqliteError>>(
        &mut self,
        root: u32,
        each: &mut dyn FnMut(&mut Self, Row) -> Result<bool, E>,
    ) -> Result<(), E> {
        let mut left = self.pages;
        // the pages on the way down, and how many of their cells have been gone through
        let mut open = vec![(self.page(root)?, 0)];
        while let Some((page, done)) = open.last_mut() {
            let Some(cell) = page.cell(*done)? else {
                open.pop();
                continue;
            };
            *done += 1;
            if page.kind == LEAF {
                let row = page.row(cell, self.usable)?;
                if !each(self, row)? {
                    return Ok(());
                }
                continue;
            }
            let below = u32_at(&page.bytes, cell).ok_or(Damaged("a page ends in a cell"))?;
            left = left
                .checked_sub(1)
                .ok_or(Damaged("its pages go round in a circle"))?;
            let page = self.page(below)?;
            open.push((page, 0));
        }
        Ok(())
    }

    fn page(&mut self, number: u32) -> Result<Page, SqliteError> {
        let bytes = self.bytes_of(number)?;
        let head = if number == 1 { HEADER_BYTES } else { 0 };
        match bytes[head] {
            kind @ (INTERIOR | LEAF) => Ok(Page { bytes, head, kind }),
            _ => Err(Damaged("a page is none of a table")),
        }
    }

    fn bytes_of(&mut self, number: u32) -> Result<Vec<u8>, SqliteError> {
        if number == 0 || number > self.pages {
            return Err(Damaged("it ends before a page that it names"));
        }
        let at = u64::from(number - 1) * self.page_bytes as u64;
        self.file.seek(SeekFrom::Start(at))?;
        let mut bytes = vec![0; self.page_bytes];
        self.file.read_exact(&mut bytes)?;
        Ok(bytes)
    }

    /// All bytes of a row, the places of its values are in it.
    ///
    /// # Errors
    /// [`SqliteError`].
    pub fn whole(&mut self, row: &Row) -> Result<Vec<u8>, SqliteError> {
        let mut out = row.local.clone();
        let mut next = row.overflow;
        let held = u64::from(self.pages) * self.page_bytes as u64;
        if row.total as u64 > held.min(MAX_ROW_BYTES) {
            return Err(Damaged("a row is longer than is read, or than the file"));
        }
        while out.len() < row.total {
            let page = self.bytes_of(next)?;
            next = u32_at(&page, 0).unwrap_or(0);
            let wanted = (row.total - out.len()).min(self.usable - 4);
            out.extend_from_slice(&page[4..4 + wanted]);
        }
        Ok(out)
    }
}

impl Row {
    /// A text; `bytes` are those of the whole row.
    pub fn text<'a>(&self, column: usize, bytes: &'a [u8]) -> Option<&'a str> {
        match self.values.get(column)? {
            Value::Bytes(place) => std::str::from_utf8(bytes.get(place.clone())?).ok(),
            _ => None,
        }
    }
}

/// A page of a table's tree.
struct Page {
    bytes: Vec<u8>,
    /// Where its own header begins.
    head: usize,
    kind: u8,
}

impl Page {
    /// Where its `k`-th cell begins, counted from 0; of the pages below an interior one the last is named in the
    /// header. `None` behind the last.
    fn cell(&self, k: usize) -> Result<Option<usize>, SqliteError> {
        let count = self.u16(self.head + 3)?;
        let (header, beyond) = match self.kind {
            LEAF => (8, None),
            _ => (12, Some(self.head + 8)),
        };
        Ok(match k.cmp(&count) {
            std::cmp::Ordering::Less => Some(self.u16(self.head + header + 2 * k)?),
            std::cmp::Ordering::Equal => beyond,
            std::cmp::Ordering::Greater => None,
        })
    }

    fn u16(&self, at: usize) -> Result<usize, SqliteError> {
        let bytes = self.bytes.get(at..).and_then(<[u8]>::first_chunk);
        let bytes = bytes.ok_or(Damaged("a page ends in its list of cells"))?;
        Ok(usize::from(u16::from_be_bytes(*bytes)))
    }

    /// The row whose cell begins at `at`.
    fn row(&self, at: usize, usable: usize) -> Result<Row, SqliteError> {
        let ends = Damaged("a page ends in a cell");
        let cell = self
            .bytes
            .get(at..usable)
            .ok_or(Damaged("a cell begins beyond its page"))?;
        let mut rest = cell;
        let (Some(total), Some(id)) = (varint(&mut rest), varint(&mut rest)) else {
            return Err(ends);
        };
        let total = usize::try_from(total).map_err(|_| Damaged("a row is longer than none"))?;
        let here = local_bytes(total, usable);
        let (Some(local), next) = (rest.get(..here), u32_at(rest, here)) else {
            return Err(ends);
        };
        let overflow = match here < total {
            true => next.ok_or(ends)?,
            false => 0,
        };
        let values = values(local).ok_or(Damaged("a row is shorter than its header says"))?;
        let local = local.to_vec();
        Ok(Row {
            id,
            values,
            local,
            total,
            overflow,
        })
    }
}

/// How many of a row's bytes stand in its leaf, by the rule of the format.
fn local_bytes(total: usize, usable: usize) -> usize {
    let most = usable - 35;
    if total <= most {
        return total;
    }
    let least = (usable - 12) * 32 / 255 - 23;
    let wanted = least + (total - least) % (usable - 4);
    if wanted <= most { wanted } else { least }
}

/// The values of a row by its header; numbers that stand beyond what is here are none.
fn values(local: &[u8]) -> Option<Vec<Value>> {
    let mut rest = local;
    let header = usize::try_from(varint(&mut rest)?).ok()?;
    let mut kinds = local.get(local.len() - rest.len()..header)?;
    let mut at = header;
    let mut out = Vec::new();
    while !kinds.is_empty() {
        let kind = varint(&mut kinds)?;
        let length = match kind {
            0 | 8 | 9 => 0,
            1..=4 => usize::try_from(kind).ok()?,
            5 => 6,
            6 | 7 => 8,
            12.. => usize::try_from((kind - 12) / 2).ok()?,
            _ => return None,
        };
        let end = at.checked_add(length)?;
        out.push(match kind {
            0 => Value::Null,
            8 | 9 => Value::Int(kind - 8),
            1..=6 => Value::Int(signed(local.get(at..end)?)),
            _ => Value::Bytes(at..end),
        });
        at = end;
    }
    Some(out)
}

/// A number of 1 to 8 bytes, the great end first.
fn signed(bytes: &[u8]) -> i64 {
    let first = bytes.first().map_or(0, |b| i64::from(*b as i8));
    let rest = bytes.iter().skip(1);
    rest.fold(first, |x, b| (x << 8) | i64::from(*b))
}

/// A number of 7 bits a byte, the great end first; the ninth byte has 8.
fn varint(bytes: &mut &[u8]) -> Option<i64> {
    let mut x: u64 = 0;
    for k in 0..9 {
        let (b, rest) = bytes.split_first()?;
        *bytes = rest;
        if k == 8 {
            return Some(((x << 8) | u64::from(*b)) as i64);
        }
        x = (x << 7) | u64::from(b & 0x7f);
        if b & 0x80 == 0 {
            return Some(x as i64);
        }
    }
    None
}

fn u32_at(bytes: &[u8], at: usize) -> Option<u32> {
    let found = bytes.get(at..)?.first_chunk()?;
    Some(u32::from_be_bytes(*found))
}
