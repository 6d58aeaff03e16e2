//! Thrift's compact protocol, as far as Parquet's headers are written in it.

/// Deepest nesting that is read.
const MAX_DEPTH: usize = 16;

/// A value of a header.
#[derive(Clone, Debug, PartialEq)]
pub enum Value {
    /// Numbers and switches; written, a number of 64 bits.
    Int(i64),
    /// Written, a number of 32 bits; read, it is an `Int`.
    Short(i32),
    /// Texts and bytes.
    Bytes(Vec<u8>),
    /// Lists.
    List(Vec<Value>),
    /// Fields with their numbers.
    Struct(Vec<(i16, Value)>),
}

impl Value {
    /// A field of a struct.
    pub fn field(&self, number: i16) -> Option<&Self> {
        match self {
            Self::Struct(fields) => fields.iter().find(|f| f.0 == number).map(|f| &f.1),
            _ => None,
        }
    }

    /// A field that is a number.
    pub fn int(&self, number: i16) -> Option<i64> {
        match self.field(number)? {
            Self::Int(x) => Some(*x),
            _ => None,
        }
    }

    /// A field that is a list.
    pub fn list(&self, number: i16) -> Option<&[Self]> {
        match self.field(number)? {
            Self::List(all) => Some(all),
            _ => None,
        }
    }

    /// A field that is a text.
    pub fn text(&self, number: i16) -> Option<&str> {
        self.field(number)?.as_text()
    }

    /// A text.
    pub fn as_text(&self) -> Option<&str> {
        match self {
            Self::Bytes(bytes) => std::str::from_utf8(bytes).ok(),
            _ => None,
        }
    }
}

/// The struct at the front of `bytes`, which are moved on behind it; `None` where there is none.
pub fn read(bytes: &mut &[u8]) -> Option<Value> {
    structure(bytes, MAX_DEPTH)
}

fn structure(bytes: &mut &[u8], depth: usize) -> Option<Value> {
    let depth = depth.checked_sub(1)?;
    let (mut fields, mut number) = (Vec::new(), 0i16);
    loop {
        let head = byte(bytes)?;
        if head == 0 {
            return Some(Value::Struct(fields));
        }
        number = match head >> 4 {
            0 => i16::try_from(signed(bytes)?).ok()?,
            step => number.checked_add(i16::from(step))?,
        };
        let value = match head & 0x0f {
            switch @ (1 | 2) => Value::Int(i64::from(switch == 1)),
            kind => value(bytes, kind, depth)?,
        };
        fields.push((number, value));
    }
}

fn value(bytes: &mut &[u8], kind: u8, depth: usize) -> Option<Value> {
    Some(match kind {
        1 | 2 => Value::Int(i64::from(byte(bytes)? == 1)),
        3 => Value::Int(i64::from(byte(bytes)? as i8)),
        4..=6 => Value::Int(signed(bytes)?),
        // nothing that is needed is a double
        7 => Value::Bytes(take(bytes, 8)?.to_vec()),
        8 => {
            let length = usize::try_from(varint(bytes)?).ok()?;
            Value::Bytes(take(bytes, length)?.to_vec())
        }
        9 | 10 => {
            let head = byte(bytes)?;
            let count = match head >> 4 {
                15 => usize::try_from(varint(bytes)?).ok()?,
                few => usize::from(few),
            };
            // whatever it is takes a byte
            if count > bytes.len() {
                return None;
            }
            let depth = depth.checked_sub(1)?;
            let all = (0..count).map(|_| value(bytes, head & 0x0f, depth));
            Value::List(all.collect::<Option<_>>()?)
        }
        12 => structure(bytes, depth)?,
        _ => return None,
    })
}

fn byte(bytes: &mut &[u8]) -> Option<u8> {
    take(bytes, 1).map(|b| b[0])
}

fn take<'a>(bytes: &mut &'a [u8], n: usize) -> Option<&'a [u8]> {
    let (head, rest) = bytes.split_at_checked(n)?;
    *bytes = rest;
    Some(head)
}

/// A number of 7 bits a byte, the small end first.
pub fn varint(bytes: &mut &[u8]) -> Option<u64> {
    let mut x = 0u64;
    for shift in (0..64).step_by(7) {
        let b = byte(bytes)?;
        x |= u64::from(b & 0x7f) << shift;
        if b & 0x80 == 0 {
            return Some(x);
        }
    }
    None
}

/// The same with its sign in the last bit.
fn signed(bytes: &mut &[u8]) -> Option<i64> {
    let x = varint(bytes)?;
    Some((x >> 1) as i64 ^ -((x & 1) as i64))
}

/// Appends `x` as [`varint`] reads it.
pub fn put_varint(out: &mut Vec<u8>, mut x: u64) {
    while x >= 0x80 {
        out.push(x as u8 | 0x80);
        x >>= 7;
    }
    out.push(x as u8);
}

/// Appends a value without its kind.
pub fn write(out: &mut Vec<u8>, value: &Value) {
    let whole = |out: &mut Vec<u8>, x: i64| put_varint(out, ((x << 1) ^ (x >> 63)) as u64);
    match value {
        Value::Int(x) => whole(out, *x),
        Value::Short(x) => whole(out, i64::from(*x)),
        Value::Bytes(bytes) => {
            put_varint(out, bytes.len() as u64);
            out.extend_from_slice(bytes);
        }
        Value::List(all) => {
            let kind = all.first().map_or(5, kind_of);
            match all.len() {
                n if n < 15 => out.push((n as u8) << 4 | kind),
                n => {
                    out.push(0xf0 | kind);
                    put_varint(out, n as u64);
                }
            }
            all.iter().for_each(|value| write(out, value));
        }
        Value::Struct(fields) => {
            for (number, value) in fields {
                out.push(kind_of(value));
                whole(out, i64::from(*number));
                write(out, value);
            }
            out.push(0);
        }
    }
}

fn kind_of(value: &Value) -> u8 {
    match value {
        Value::Short(_) => 5,
        Value::Int(_) => 6,
        Value::Bytes(_) => 8,
        Value::List(_) => 9,
        Value::Struct(_) => 12,
    }
}
