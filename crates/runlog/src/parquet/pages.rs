//! What stands in the pages of a column.

use std::borrow::Cow;
use std::io::Read as _;

use super::thrift::{self, Value};
use super::{codec, encoding, kind};

/// Largest page, unpacked, bytes.
const MAX_PAGE_BYTES: usize = 64 * 1024 * 1024;
/// Most values of one page.
const MAX_PAGE_VALUES: usize = 1 << 22;
/// Kinds of pages.
const DATA: i64 = 0;
const DICTIONARY: i64 = 2;
const DATA_V2: i64 = 3;

/// What the schema says of a column.
#[derive(Clone, Debug)]
pub struct Leaf {
    /// Its name.
    pub name: String,
    /// Kind of its values; `None` where they are no numbers.
    pub kind: Option<i64>,
    /// Level at which a value is there, and level of repetition within lists.
    pub most_levels: [u32; 2],
}

/// A value of a page.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Entry {
    /// Whether it begins a row.
    pub begins: bool,
    /// Nothing: none is stored.
    pub value: Option<f64>,
}

/// Reads the pages of one column of one row group, one after another.
pub struct Pages<'a> {
    pub leaf: &'a Leaf,
    pub codec: i64,
    pub bytes: &'a [u8],
    pub dictionary: Vec<f64>,
}

impl Pages<'_> {
    /// The entries of the next data page, `most` at most; what is wrong with it in words.
    pub fn next(&mut self, most: usize) -> Result<Vec<Entry>, String> {
        loop {
            let header = thrift::read(&mut self.bytes).ok_or("the header of a page is damaged")?;
            let size = |field| {
                let size = header.int(field).and_then(|n| usize::try_from(n).ok());
                size.filter(|n| *n <= MAX_PAGE_BYTES).ok_or(format!(
                    "a page is longer than {MAX_PAGE_BYTES} bytes, or shorter than none"
                ))
            };
            let (unpacked, packed) = (size(2)?, size(3)?);
            let (page, rest) = self
                .bytes
                .split_at_checked(packed)
                .ok_or("a page is cut off")?;
            self.bytes = rest;
            match header.int(1) {
                Some(DICTIONARY) => {
                    let about = header
                        .field(7)
                        .ok_or("a dictionary says nothing of itself")?;
                    let page = unpack(self.codec, page, unpacked)?;
                    self.dictionary = plain(self.kind()?, &page, count(about, most)?)?;
                }
                Some(DATA) => {
                    let about = header.field(5).ok_or("a page says nothing of itself")?;
                    let page = unpack(self.codec, page, unpacked)?;
                    return self.first_version(about, &page, count(about, most)?);
                }
                Some(DATA_V2) => {
                    let about = header.field(8).ok_or("a page says nothing of itself")?;
                    return self.second_version(about, page, unpacked, count(about, most)?);
                }
                _ => {}
            }
        }
    }

    fn kind(&self) -> Result<i64, String> {
        self.leaf
            .kind
            .ok_or_else(|| "is no column of numbers".to_owned())
    }

    /// Levels in front of the values, each with its length, all packed together.
    fn first_version(
        &self,
        about: &Value,
        mut page: &[u8],
        n: usize,
    ) -> Result<Vec<Entry>, String> {
        let mut levels = |most: u32| -> Result<Vec<u32>, String> {
            if most == 0 {
                return Ok(vec![0; n]);
            }
            let bytes = with_length(&mut page)?;
            runs(bytes, width(most), n)
        };
        let [present, repeats] = self.leaf.most_levels;
        let (repeats, presents) = (levels(repeats)?, levels(present)?);
        self.entries(about.int(2), page, &repeats, &presents)
    }

    /// Levels in front, not packed; their lengths are in the header.
    fn second_version(
        &self,
        about: &Value,
        page: &[u8],
        unpacked: usize,
        n: usize,
    ) -> Result<Vec<Entry>, String> {
        let length = |field| about.int(field).and_then(|n| usize::try_from(n).ok());
        let cut = || "the levels of a page are cut off".to_owned();
        let (of_repeats, of_presents) = (length(6).ok_or_else(cut)?, length(5).ok_or_else(cut)?);
        let (repeats, rest) = page.split_at_checked(of_repeats).ok_or_else(cut)?;
        let (presents, rest) = rest.split_at_checked(of_presents).ok_or_else(cut)?;
        let unpacked = unpacked
            .checked_sub(of_repeats + of_presents)
            .ok_or_else(cut)?;
        let codec = if about.int(7) == Some(0) {
            codec::NONE
        } else {
            self.codec
        };
        let values = unpack(codec, rest, unpacked)?;
        let levels = |bytes, most| match most {
            0 => Ok(vec![0; n]),
            most => runs(bytes, width(most), n),
        };
        let [present, repeat] = self.leaf.most_levels;
        let (repeats, presents) = (levels(repeats, repeat)?, levels(presents, present)?);
        self.entries(about.int(4), &values, &repeats, &presents)
    }

    fn entries(
        &self,
        written: Option<i64>,
        mut bytes: &[u8],
        repeats: &[u32],
        presents: &[u32],
    ) -> Result<Vec<Entry>, String> {
        let here = self.leaf.most_levels[0];
        let n = presents.iter().filter(|p| **p == here).count();
        let kind = self.kind()?;
        let values = match written {
            Some(encoding::PLAIN) => plain(kind, bytes, n)?,
            Some(encoding::RUNS) if kind == kind::BOOLEAN => {
                let runs = runs(with_length(&mut bytes)?, 1, n)?;
                runs.into_iter().map(f64::from).collect()
            }
            Some(encoding::PLAIN_DICTIONARY | encoding::RUNS_OF_DICTIONARY) if n == 0 => Vec::new(),
            Some(encoding::PLAIN_DICTIONARY | encoding::RUNS_OF_DICTIONARY) => {
                let (width, bytes) = bytes.split_first().ok_or("a page is empty")?;
                let places = runs(bytes, u32::from(*width), n)?;
                let value = |place: &u32| self.dictionary.get(*place as usize).copied();
                let values = places.iter().map(value).collect::<Option<Vec<f64>>>();
                values.ok_or("a value is not in its dictionary")?
            }
            other => {
                return Err(format!(
                    "is written in a way that is not read (encoding {}): write it plain or with a dictionary",
                    other.unwrap_or(-1)
                ));
            }
        };
        let mut values = values.into_iter();
        let entries = repeats.iter().zip(presents).map(|(repeat, present)| Entry {
            begins: *repeat == 0,
            value: if *present == here {
                values.next()
            } else {
                None
            },
        });
        Ok(entries.collect())
    }
}

/// How many values a page says that it has.
fn count(about: &Value, most: usize) -> Result<usize, String> {
    let n = about.int(1).and_then(|n| usize::try_from(n).ok());
    let n = n.ok_or("a page does not say how many values it has")?;
    match n > most.min(MAX_PAGE_VALUES) {
        true => Err("has more values than are read".to_owned()),
        false => Ok(n),
    }
}

fn with_length<'a>(bytes: &mut &'a [u8]) -> Result<&'a [u8], String> {
    let cut = || "the levels of a page are cut off".to_owned();
    let (length, rest) = bytes.split_first_chunk().ok_or_else(cut)?;
    let length = u32::from_le_bytes(*length) as usize;
    let (levels, rest) = rest.split_at_checked(length).ok_or_else(cut)?;
    *bytes = rest;
    Ok(levels)
}

/// Bits that hold the numbers up to `most`.
fn width(most: u32) -> u32 {
    u32::BITS - most.leading_zeros()
}

/// `n` numbers of `width` bits, as runs of one number and as packed eights.
fn runs(mut bytes: &[u8], width: u32, n: usize) -> Result<Vec<u32>, String> {
    let cut = || "a page ends in the middle of its values".to_owned();
    if width > 32 {
        return Err("numbers of more than 32 bits".to_owned());
    }
    let mut out = Vec::new();
    while out.len() < n {
        let head = thrift::varint(&mut bytes).ok_or_else(cut)?;
        let left = n - out.len();
        let count = usize::try_from(head >> 1).unwrap_or(usize::MAX);
        if count == 0 {
            return Err("a run of none".to_owned());
        }
        if head & 1 == 0 {
            let (value, rest) = bytes
                .split_at_checked(width.div_ceil(8) as usize)
                .ok_or_else(cut)?;
            bytes = rest;
            let value = value.iter().rev().fold(0u32, |x, b| x << 8 | u32::from(*b));
            out.resize(out.len() + count.min(left), value);
            continue;
        }
        // the last eight may be cut short
        let length = count.saturating_mul(width as usize).min(bytes.len());
        let (packed, rest) = bytes.split_at(length);
        bytes = rest;
        let held = if width == 0 {
            usize::MAX
        } else {
            packed.len() * 8 / width as usize
        };
        let here = count.saturating_mul(8).min(left);
        if held < here {
            return Err(cut());
        }
        let bit = |at: usize| u32::from(packed[at / 8] >> (at % 8) & 1);
        let number =
            |k: usize| (0..width as usize).fold(0, |x, b| x | bit(k * width as usize + b) << b);
        out.extend((0..here).map(number));
    }
    Ok(out)
}

/// `n` numbers one behind another.
fn plain(kind: i64, bytes: &[u8], n: usize) -> Result<Vec<f64>, String> {
    fn each<const N: usize>(
        bytes: &[u8],
        n: usize,
        number: fn([u8; N]) -> f64,
    ) -> Option<Vec<f64>> {
        let (numbers, _) = bytes.as_chunks::<N>();
        Some(numbers.get(..n)?.iter().map(|b| number(*b)).collect())
    }
    let values = match kind {
        kind::INT32 => each(bytes, n, |b| f64::from(i32::from_le_bytes(b))),
        kind::INT64 => each(bytes, n, |b| i64::from_le_bytes(b) as f64),
        kind::FLOAT => each(bytes, n, |b| f64::from(f32::from_le_bytes(b))),
        kind::DOUBLE => each(bytes, n, f64::from_le_bytes),
        _ => {
            let bit = |k: usize| Some(f64::from(bytes.get(k / 8)? >> (k % 8) & 1));
            (0..n).map(bit).collect()
        }
    };
    values.ok_or_else(|| "a page ends in the middle of its values".to_owned())
}

fn unpack(codec: i64, bytes: &[u8], size: usize) -> Result<Cow<'_, [u8]>, String> {
    let text = |e: &dyn std::fmt::Display| format!("a page cannot be unpacked: {e}");
    let out = match codec {
        codec::NONE => Cow::Borrowed(bytes),
        codec::SNAPPY => {
            let says = snap::raw::decompress_len(bytes).map_err(|e| text(&e))?;
            if says != size {
                return Err("a page has another length than it says".to_owned());
            }
            let out = snap::raw::Decoder::new().decompress_vec(bytes);
            Cow::Owned(out.map_err(|e| text(&e))?)
        }
        codec::ZSTD => {
            let mut reader = zstd::Decoder::with_buffer(bytes).map_err(|e| text(&e))?;
            reader.window_log_max(26).map_err(|e| text(&e))?;
            let mut out = Vec::new();
            let read = reader.take(size as u64 + 1).read_to_end(&mut out);
            read.map_err(|e| text(&e))?;
            Cow::Owned(out)
        }
        _ => {
            return Err(format!(
                "is packed in a way that is not read (codec {codec}): write it with Snappy, zstd or nothing"
            ));
        }
    };
    match out.len() == size {
        true => Ok(out),
        false => Err("a page has another length than it says".to_owned()),
    }
}
