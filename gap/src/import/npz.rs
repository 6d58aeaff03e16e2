//! Archives of NumPy (`numpy.savez`): arrays of a moment per row. A column of an array is called `q[0]`, or `q hip`
//! where an array of as many strings is beside it.
//!
//! The form of an array: NumPy Enhancement Proposal 1, versions 1 to 3.

use std::fs::File;
use std::io::{BufReader, Read};
use std::path::Path;

use zip::ZipArchive;

use super::run::{ImportError, file_stem};
use super::sheet::{MAX_COLUMNS, MAX_VALUES, Recording, Sheet};
use super::units::unit_word;
use super::words::{CLOCKS, Words};

/// What an array begins with.
const MAGIC: &[u8] = b"\x93NUMPY";
/// Longest description of an array that is read, bytes.
const MAX_HEADER: usize = 65_536;
/// Words in the names of what is no joint's.
const OF_BODY: &str =
    "gyro gyroscope acc accel acceleration imu quat quaternion gravity base mocap body com contact";
/// Largest number that is read, bytes.
const MAX_ITEM_BYTES: u64 = 8;

/// The recording in the file `path`.
///
/// # Errors
/// [`ImportError`] with file, array and reason.
pub fn open(path: &Path) -> Result<Recording, ImportError> {
    let file = File::open(path);
    let file = file.map_err(|source| ImportError::Io { path: path.to_owned(), source })?;
    let named = path.display().to_string();
    let wrong = |message: String| ImportError::Format { file: named.clone(), message };
    let mut archive = ZipArchive::new(BufReader::new(file))
        .map_err(|e| wrong(format!("is no archive that numpy.savez writes: {e}")))?;
    let (mut arrays, mut labels, mut unread) = (Vec::new(), Vec::new(), Vec::new());
    let mut left = MAX_VALUES;
    for at in 0..archive.len() {
        let mut member = archive.by_index(at).map_err(|e| wrong(e.to_string()))?;
        let name = member.name().trim_end_matches(".npy").to_owned();
        let said = |why: String| wrong(format!("`{name}`: {why}"));
        match array(&mut member, left).map_err(said)? {
            Array::Numbers { shape, values } => {
                left -= values.len();
                arrays.push((name, shape, values));
            }
            Array::Strings(words) => {
                left = left.saturating_sub(words.iter().map(|word| 1 + word.len()).sum());
                labels.push(words);
            }
            Array::Other(kind) => unread.push(format!("{name} ({kind})")),
        }
    }
    let is_clock = |(name, shape, _): &&(String, Vec<usize>, Vec<f64>)| {
        shape.len() == 1 && shape[0] > 1 && Words::of(name).has(CLOCKS)
    };
    let rows = match arrays.iter().find(is_clock) {
        Some((_, shape, _)) => shape[0],
        None => arrays.iter().filter_map(|(_, shape, _)| shape.first().copied()).max().unwrap_or(0),
    };
    let mut sheet = Arrays { file: named.clone(), rows, columns: Vec::new() };
    for (name, shape, values) in arrays {
        if !sheet.take(&name, &shape, values, &labels) {
            unread.push(format!(
                "{name} (shape {shape:?}, where {rows} rows and {MAX_COLUMNS} columns are read)"
            ));
        }
    }
    if rows == 0 || sheet.columns.is_empty() {
        let lacks = if rows == 0 { "row" } else { "column" };
        return Err(wrong(format!("has no {lacks}")));
    }
    Ok(Recording {
        file: named,
        name: file_stem(path),
        sheets: vec![Box::new(sheet)],
        clock: None,
        unread,
        notes: Vec::new(),
    })
}

/// An array, as far as a log has a use for it.
enum Array {
    /// Numbers in the order of rows.
    Numbers { shape: Vec<usize>, values: Vec<f64> },
    /// A list of strings.
    Strings(Vec<String>),
    /// What it is instead.
    Other(String),
}

/// The array in `from`, of `most` values.
fn array(from: &mut impl Read, most: usize) -> Result<Array, String> {
    let mut start = [0; 8];
    let failed = |e: std::io::Error| e.to_string();
    from.read_exact(&mut start).map_err(failed)?;
    if !start.starts_with(MAGIC) {
        return Err("is no array of NumPy".to_owned());
    }
    let mut size = [0; 4];
    let digits = if start[6] == 1 { 2 } else { 4 };
    from.read_exact(&mut size[..digits]).map_err(failed)?;
    let size = u32::from_le_bytes(size) as usize;
    if size > MAX_HEADER {
        return Err(format!("its description takes {size} bytes, of {MAX_HEADER}"));
    }
    let mut text = vec![0; size];
    from.read_exact(&mut text).map_err(failed)?;
    let text = String::from_utf8_lossy(&text);
    let said = Description::parse(&text)
        .ok_or_else(|| format!("is described as {:?}", text.trim_end()))?;
    let count = said.shape.iter().try_fold(1usize, |all, n| all.checked_mul(*n));
    let count = count.filter(|n| *n <= most);
    let count = count.ok_or_else(|| format!("{MAX_VALUES} values are read, together"))?;
    let Some(item_bytes) = said.item_bytes().filter(|n| said.letters() || *n <= MAX_ITEM_BYTES)
    else {
        return Ok(Array::Other(said.kind));
    };
    let bytes = (count as u64).saturating_mul(item_bytes);
    if bytes > MAX_ITEM_BYTES * most as u64 {
        return Err(format!("takes {bytes} bytes"));
    }
    let mut data = Vec::new();
    from.take(bytes).read_to_end(&mut data).map_err(failed)?;
    if (data.len() as u64) < bytes {
        return Err(format!("has {} bytes of data, and should have {bytes}", data.len()));
    }
    let items = data.chunks_exact(item_bytes.max(1) as usize);
    if said.letters() {
        return Ok(Array::Strings(items.map(letters).collect()));
    }
    match items.map(|item| said.number(item)).collect::<Option<Vec<f64>>>() {
        Some(values) => Ok(Array::Numbers { values: said.by_rows(values), shape: said.shape }),
        None => Ok(Array::Other(said.kind)),
    }
}

/// What stands in front of an array: `{'descr': '<f8', 'fortran_order': False, 'shape': (100, 3), }`.
struct Description {
    /// Byte order, kind and size of an item.
    kind: String,
    /// Whether columns follow one another, and not rows.
    by_columns: bool,
    shape: Vec<usize>,
}

impl Description {
    fn parse(text: &str) -> Option<Self> {
        let behind = |key: &str| Some(text.split_once(key)?.1.trim_start_matches([':', ' ']));
        let kind = behind("'descr'")?;
        let kind = match kind.strip_prefix('\'') {
            Some(kind) => kind.split('\'').next()?,
            // the fields of a record
            None => "records",
        };
        let shape = behind("'shape'")?.strip_prefix('(')?.split(')').next()?;
        let sizes = shape.split(',').map(str::trim).filter(|n| !n.is_empty());
        Some(Self {
            kind: kind.to_owned(),
            by_columns: behind("'fortran_order'")?.starts_with("True"),
            shape: sizes.map(|n| n.parse().ok()).collect::<Option<_>>()?,
        })
    }

    /// Whether items are strings.
    fn letters(&self) -> bool {
        self.kind.starts_with("<U")
    }

    /// Bytes of an item.
    fn item_bytes(&self) -> Option<u64> {
        let size: u64 = self.kind.get(2..)?.parse().ok()?;
        if self.letters() { size.checked_mul(4) } else { Some(size) }
    }

    /// An item as a number; `None`: it is none, or the bytes of another machine.
    fn number(&self, item: &[u8]) -> Option<f64> {
        Some(match self.kind.as_str() {
            "<f8" => f64::from_le_bytes(item.try_into().ok()?),
            "<f4" => f64::from(f32::from_le_bytes(item.try_into().ok()?)),
            "<i8" => i64::from_le_bytes(item.try_into().ok()?) as f64,
            "<u8" => u64::from_le_bytes(item.try_into().ok()?) as f64,
            "<i4" => f64::from(i32::from_le_bytes(item.try_into().ok()?)),
            "<u4" => f64::from(u32::from_le_bytes(item.try_into().ok()?)),
            "<i2" => f64::from(i16::from_le_bytes(item.try_into().ok()?)),
            "<u2" => f64::from(u16::from_le_bytes(item.try_into().ok()?)),
            "|i1" => f64::from(i8::from_le_bytes(item.try_into().ok()?)),
            "|u1" | "|b1" => f64::from(*item.first()?),
            _ => return None,
        })
    }

    /// Values in the order of rows.
    fn by_rows(&self, values: Vec<f64>) -> Vec<f64> {
        match self.shape[..] {
            [rows, columns] if self.by_columns && !values.is_empty() => {
                transposed(&values, columns, rows)
            }
            _ => values,
        }
    }
}

/// Whether no two of these words are the same, and not all are units: a joint may be called `a`.
fn are_names(words: &[String]) -> bool {
    let unit = |word: &str| unit_word(word.trim().to_lowercase().as_str()).is_some();
    let again = |k: usize| words[..k].contains(&words[k]);
    !(0..words.len()).any(again) && !words.iter().all(|word| unit(word))
}

/// Rows and columns of `values`, `[rows][columns]`, the other way round.
fn transposed(values: &[f64], rows: usize, columns: usize) -> Vec<f64> {
    let column = |c: usize| (0..rows).map(move |r| values[r * columns + c]);
    (0..columns).flat_map(column).collect()
}

/// Letters of four bytes, up to the first that is none.
fn letters(item: &[u8]) -> String {
    let code = |four: &[u8]| char::from_u32(u32::from_le_bytes(four.try_into().ok()?));
    let all = item.chunks_exact(4).map_while(code);
    all.take_while(|letter| *letter != '\0').collect()
}

/// Arrays of as many rows.
struct Arrays {
    file: String,
    rows: usize,
    columns: Vec<(String, Vec<f64>)>,
}

impl Arrays {
    /// Takes an array with as many rows as there are, or with as many columns and no such rows.
    fn take(
        &mut self,
        name: &str,
        shape: &[usize],
        mut values: Vec<f64>,
        labels: &[Vec<String>],
    ) -> bool {
        let columns = match *shape {
            [rows] if rows == self.rows => 1,
            [rows, columns] if rows == self.rows => columns,
            [columns, rows] if rows == self.rows => {
                values = transposed(&values, columns, rows);
                columns
            }
            _ => return false,
        };
        // an array without a row may have any number of columns
        if columns > MAX_COLUMNS - self.columns.len() {
            return false;
        }
        // names of joints, and none of what has axes of its own
        let words = labels.iter().filter(|_| !Words::of(name).has(OF_BODY));
        let words = words.into_iter().find(|words| words.len() == columns && are_names(words));
        for at in 0..columns {
            let called = match (columns, words) {
                (1, _) => name.to_owned(),
                (_, Some(words)) => format!("{name} {}", words[at]),
                (_, None) => format!("{name}[{at}]"),
            };
            let column = values.iter().skip(at).step_by(columns);
            self.columns.push((called, column.copied().collect()));
        }
        true
    }
}

impl Sheet for Arrays {
    fn name(&self) -> &str {
        &self.file
    }

    fn header(&self) -> Vec<&str> {
        self.columns.iter().map(|c| c.0.as_str()).collect()
    }

    fn values(&self, column: &str, item: Option<usize>) -> Result<Vec<Option<f64>>, ImportError> {
        let wrong = |message| ImportError::Format { file: self.file.clone(), message };
        let Some((_, values)) = self.columns.iter().find(|c| c.0 == column) else {
            let has = self.header().join(", ");
            return Err(wrong(format!("has no column `{column}`; it has {has}")));
        };
        match item {
            Some(_) => Err(wrong(format!("`{column}` holds no lists: leave `item` out"))),
            None => Ok(values.iter().map(|x| x.is_finite().then_some(*x)).collect()),
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use std::io::Write;

    use super::*;

    fn npy(kind: &str, by_columns: bool, shape: &str, data: &[u8]) -> Vec<u8> {
        let order = if by_columns { "True" } else { "False" };
        let text = format!("{{'descr': '{kind}', 'fortran_order': {order}, 'shape': {shape}, }}\n");
        let size = u16::try_from(text.len()).unwrap().to_le_bytes();
        [MAGIC, &[1, 0], &size[..], text.as_bytes(), data].concat()
    }

    fn f8(values: &[f64]) -> Vec<u8> {
        values.iter().flat_map(|x| x.to_le_bytes()).collect()
    }

    fn read(arrays: &[(&str, Vec<u8>)]) -> Result<Recording, ImportError> {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("walk.npz");
        let mut archive = zip::ZipWriter::new(File::create(&path).unwrap());
        for (name, data) in arrays {
            archive.start_file(format!("{name}.npy"), zip::write::FileOptions::default()).unwrap();
            archive.write_all(data).unwrap();
        }
        archive.finish().unwrap();
        open(&path)
    }

    #[test]
    fn arrays_of_a_row_per_moment_are_columns() {
        let letters: Vec<u8> =
            "hip\0knee".chars().flat_map(|c| u32::from(c).to_le_bytes()).collect();
        let recording = read(&[
            ("time", npy("<f8", false, "(3,)", &f8(&[0.0, 0.5, 1.0]))),
            ("q", npy("<f8", false, "(3, 2)", &f8(&[1.0, 2.0, 3.0, 4.0, f64::NAN, 6.0]))),
            ("cmd", npy("<f8", true, "(3, 2)", &f8(&[1.0, 2.0, 3.0, 4.0, 5.0, 6.0]))),
            ("moved", npy("|b1", false, "(3, 1)", &[0, 1, 1])),
            ("gyro", npy("|i1", false, "(4, 3)", &[1, 2, 3, 4, 5, 6, 7, 8, 9, 255, 11, 12])),
            ("joints", npy("<U4", false, "(2,)", &letters)),
            ("kp", npy("<f8", false, "()", &f8(&[16.0]))),
            ("what", npy("|O", false, "(3,)", b"")),
            ("imu", npy("<f8", false, "(3, 2)", &[0; 48])),
        ])
        .unwrap();
        assert_eq!(recording.name, "walk");
        assert_eq!(
            recording.unread,
            ["what (|O)", "kp (shape [], where 3 rows and 4096 columns are read)"]
        );
        let sheet = &recording.sheets[0];
        let gyro = [0, 1, 2, 3].map(|k| format!("gyro[{k}]"));
        let named = ["time", "q hip", "q knee", "cmd hip", "cmd knee", "moved"];
        assert_eq!(sheet.header()[..6], named);
        assert_eq!(sheet.header()[6..10], gyro);
        // names of joints are none of its axes, and units are no names
        assert_eq!(sheet.header()[10..], ["imu[0]", "imu[1]"]);
        let words = |words: [&str; 2]| are_names(&words.map(str::to_owned));
        assert!(words(["hip", "knee"]) && !words(["hip", "hip"]) && !words(["rad", "m/s"]));
        assert!(words(["a", "hip"]));
        let values = |column: &str| sheet.values(column, None).unwrap();
        assert_eq!(values("q hip"), [Some(1.0), Some(3.0), None]);
        assert_eq!(values("cmd knee"), [4.0, 5.0, 6.0].map(Some));
        assert_eq!(values("moved"), [0.0, 1.0, 1.0].map(Some));
        // a moment per column
        assert_eq!(values("gyro[3]"), [-1.0, 11.0, 12.0].map(Some));
    }

    #[test]
    fn what_is_no_archive_of_arrays_is_said_in_one_line() {
        let says = |array: Vec<u8>, want: &str| {
            let error = read(&[("q", array)]).err().unwrap().to_string();
            assert!(error.contains(want) && !error.contains('\n'), "{error}");
        };
        says(b"PK".to_vec(), "`q`: ");
        says(b"no array at all".to_vec(), "`q`: is no array of NumPy");
        says(
            npy("<f8", false, "(3, 2)", &[0; 40]),
            "`q`: has 40 bytes of data, and should have 48",
        );
        says(npy("<f8", false, "(99999999999, 2)", &[]), "50000000 values are read, together");
        says(npy("<U999999999", false, "(9999,)", &[]), "`q`: takes 39995999960004 bytes");
        says(npy("<f8", false, "(3, -2)", &[]), "`q`: is described as \"{'descr'");
        says(npy("<f8", false, "(0, 2)", &[]), "has no row");
        says(npy("<f8", false, "(0, 9999999999999)", &[]), "has no row");
        says(npy("<f8", true, "(9999999999999, 0)", &[]), "has no column");
        says(npy("<f8", false, "()", &f8(&[1.0])), "has no row");
    }
}
