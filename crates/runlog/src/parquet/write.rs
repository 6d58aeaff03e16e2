//! Columns to Parquet: plain numbers, packed with zstd.

use super::thrift::{self, Value, put_varint};
use super::{PAR1, codec, encoding, kind};

/// Rows that are packed together.
const GROUP_ROWS: usize = 1 << 20;
/// Level of zstd.
const LEVEL: i32 = 3;

/// A file of columns that are equally long; `None` is stored as nothing.
///
/// # Errors
/// In words, where zstd fails.
pub fn write(columns: &[(String, Vec<Option<f64>>)]) -> Result<Vec<u8>, String> {
    let rows = columns.first().map_or(0, |c| c.1.len());
    let mut out = PAR1.to_vec();
    let mut groups = Vec::new();
    for first in (0..rows).step_by(GROUP_ROWS) {
        let last = rows.min(first + GROUP_ROWS);
        let (begin, mut chunks, mut size) = (out.len(), Vec::new(), 0);
        for (name, values) in columns {
            let values = values.get(first..last).unwrap_or_default();
            let at = out.len();
            let unpacked = page(&mut out, values)?;
            size += unpacked;
            chunks.push(chunk(name, values.len(), at, unpacked, out.len() - at));
        }
        groups.push(Value::Struct(vec![
            (1, Value::List(chunks)),
            (2, Value::Int(size as i64)),
            (3, Value::Int((last - first) as i64)),
            (5, Value::Int(begin as i64)),
        ]));
    }
    let mut schema = vec![Value::Struct(vec![
        (4, text("schema")),
        (5, Value::Short(columns.len() as i32)),
    ])];
    schema.extend(columns.iter().map(|(name, _)| {
        // optional
        let fields = vec![
            (1, short(kind::DOUBLE)),
            (3, Value::Short(1)),
            (4, text(name)),
        ];
        Value::Struct(fields)
    }));
    let meta = Value::Struct(vec![
        (1, Value::Short(1)),
        (2, Value::List(schema)),
        (3, Value::Int(rows as i64)),
        (4, Value::List(groups)),
        (6, text("caudata")),
    ]);
    let begin = out.len();
    thrift::write(&mut out, &meta);
    let length = (out.len() - begin) as u32;
    out.extend(length.to_le_bytes());
    out.extend(PAR1);
    Ok(out)
}

/// Appends a page with its header; how long both are unpacked.
fn page(out: &mut Vec<u8>, values: &[Option<f64>]) -> Result<usize, String> {
    // which are there: one run of bits, packed in eights
    let mut levels = Vec::new();
    put_varint(&mut levels, (values.len().div_ceil(8) as u64) << 1 | 1);
    levels.extend(values.chunks(8).map(|eight| {
        let bits = eight.iter().enumerate();
        bits.fold(0u8, |byte, (k, x)| byte | u8::from(x.is_some()) << k)
    }));
    let mut body = (levels.len() as u32).to_le_bytes().to_vec();
    body.append(&mut levels);
    body.extend(values.iter().flatten().flat_map(|x| x.to_le_bytes()));
    let packed = zstd::encode_all(body.as_slice(), LEVEL).map_err(|e| e.to_string())?;
    let about = Value::Struct(vec![
        (1, Value::Short(values.len() as i32)),
        (2, short(encoding::PLAIN)),
        (3, short(encoding::RUNS)),
        (4, short(encoding::RUNS)),
    ]);
    let header = Value::Struct(vec![
        (1, Value::Short(0)),
        (2, Value::Short(body.len() as i32)),
        (3, Value::Short(packed.len() as i32)),
        (5, about),
    ]);
    let begin = out.len();
    thrift::write(out, &header);
    let header_bytes = out.len() - begin;
    out.extend(packed);
    Ok(header_bytes + body.len())
}

/// What the description of the file says of the page at `at`.
fn chunk(name: &str, rows: usize, at: usize, unpacked: usize, packed: usize) -> Value {
    let encodings = [encoding::PLAIN, encoding::RUNS].map(short).to_vec();
    let about = Value::Struct(vec![
        (1, short(kind::DOUBLE)),
        (2, Value::List(encodings)),
        (3, Value::List(vec![text(name)])),
        (4, short(codec::ZSTD)),
        (5, Value::Int(rows as i64)),
        (6, Value::Int(unpacked as i64)),
        (7, Value::Int(packed as i64)),
        (9, Value::Int(at as i64)),
    ]);
    Value::Struct(vec![(2, Value::Int(at as i64)), (3, about)])
}

fn text(text: &str) -> Value {
    Value::Bytes(text.as_bytes().to_vec())
}

/// The codes of the format are small.
fn short(code: i64) -> Value {
    Value::Short(code as i32)
}
