//! CDR, the byte form of ROS 2 messages: numbers in their natural alignment (counted from behind the 4-byte
//! header), texts and lists with their length in front. OMG DDS-XTypes, section 7.4 ("plain CDR", version 1).

/// Why bytes are not the message that they should be.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum CdrError {
    /// The bytes end too early.
    #[error("ends after {0} bytes, in the middle of a value")]
    Short(usize),
    /// Not plain CDR.
    #[error("begins with {0:02x?}; plain CDR begins with 00 00 or 00 01")]
    Encapsulation([u8; 4]),
    /// A text is not UTF-8 or has no end.
    #[error("holds a text that is not UTF-8")]
    Text,
}

/// Reads plain CDR of either byte order.
pub struct Reader<'a> {
    bytes: &'a [u8],
    at: usize,
    little: bool,
}

impl<'a> Reader<'a> {
    /// Begins behind the encapsulation header.
    ///
    /// # Errors
    /// [`CdrError`] where there is none.
    pub fn new(bytes: &'a [u8]) -> Result<Self, CdrError> {
        let Some((head, rest)) = bytes.split_first_chunk::<4>() else {
            return Err(CdrError::Short(bytes.len()));
        };
        let little = match head {
            [0, 1, ..] => true,
            [0, 0, ..] => false,
            _ => return Err(CdrError::Encapsulation(*head)),
        };
        Ok(Self { bytes: rest, at: 0, little })
    }

    /// The next value.
    ///
    /// # Errors
    /// Where the bytes end before it does; a text that is not UTF-8.
    pub fn get<T: Cdr>(&mut self) -> Result<T, CdrError> {
        T::read(self)
    }

    /// The bytes of a number, which is aligned to its own size, little end first.
    fn number<const N: usize>(&mut self) -> Result<[u8; N], CdrError> {
        let start = self.at.next_multiple_of(N);
        let found = self.bytes.get(start..).and_then(<[u8]>::first_chunk::<N>);
        let mut out = *found.ok_or(CdrError::Short(self.bytes.len()))?;
        self.at = start + N;
        if !self.little {
            out.reverse();
        }
        Ok(out)
    }
}

/// Writes little-endian plain CDR.
pub struct Writer {
    bytes: Vec<u8>,
}

impl Default for Writer {
    fn default() -> Self {
        Self { bytes: vec![0, 1, 0, 0] }
    }
}

impl Writer {
    /// The bytes.
    pub fn finish(self) -> Vec<u8> {
        self.bytes
    }

    /// Appends a value.
    pub fn put<T: Cdr>(&mut self, value: &T) -> &mut Self {
        value.write(self);
        self
    }
}

/// A value that stands in a message.
pub trait Cdr: Sized {
    /// From where the reader stands.
    ///
    /// # Errors
    /// Where the bytes end before the value does; a text that is not UTF-8.
    fn read(r: &mut Reader<'_>) -> Result<Self, CdrError>;

    /// To the end of what is written.
    fn write(&self, w: &mut Writer);
}

macro_rules! numbers {
    ($($number:ty),*) => {$(
        impl Cdr for $number {
            fn read(r: &mut Reader<'_>) -> Result<Self, CdrError> {
                Ok(Self::from_le_bytes(r.number()?))
            }

            fn write(&self, w: &mut Writer) {
                let bytes = self.to_le_bytes();
                let aligned = (w.bytes.len() - 4).next_multiple_of(bytes.len()) + 4;
                w.bytes.resize(aligned, 0);
                w.bytes.extend_from_slice(&bytes);
            }
        }
    )*};
}
numbers!(u8, u32, i32, f32, f64);

/// Numbers without a length.
impl<const N: usize> Cdr for [f64; N] {
    fn read(r: &mut Reader<'_>) -> Result<Self, CdrError> {
        let mut out = [0.0; N];
        for x in &mut out {
            *x = r.get()?;
        }
        Ok(out)
    }

    fn write(&self, w: &mut Writer) {
        for x in self {
            w.put(x);
        }
    }
}

/// Its length, with the zero at its end, and its bytes.
impl Cdr for String {
    fn read(r: &mut Reader<'_>) -> Result<Self, CdrError> {
        let length = u32::read(r)? as usize;
        let end = r.at.checked_add(length);
        let bytes = end.and_then(|end| r.bytes.get(r.at..end));
        let bytes = bytes.ok_or(CdrError::Short(r.bytes.len()))?;
        r.at += length;
        // the length counts the zero at the end; some writers leave out both for an empty text
        let bytes = bytes.strip_suffix(&[0]).unwrap_or(bytes);
        Self::from_utf8(bytes.to_vec()).map_err(|_| CdrError::Text)
    }

    fn write(&self, w: &mut Writer) {
        w.put(&(self.len() as u32 + 1));
        w.bytes.extend_from_slice(self.as_bytes());
        w.bytes.push(0);
    }
}

/// A list with its length in front. A length that the bytes cannot hold ends at their end, not in memory.
impl<T: Cdr> Cdr for Vec<T> {
    fn read(r: &mut Reader<'_>) -> Result<Self, CdrError> {
        let length = u32::read(r)? as usize;
        let mut out = Self::with_capacity(length.min(1024));
        for _ in 0..length {
            out.push(r.get()?);
        }
        Ok(out)
    }

    fn write(&self, w: &mut Writer) {
        w.put(&(self.len() as u32));
        for x in self {
            w.put(x);
        }
    }
}

impl<A: Cdr, B: Cdr> Cdr for (A, B) {
    fn read(r: &mut Reader<'_>) -> Result<Self, CdrError> {
        Ok((r.get()?, r.get()?))
    }

    fn write(&self, w: &mut Writer) {
        w.put(&self.0).put(&self.1);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn alignment_counts_from_behind_the_header() {
        let mut w = Writer::default();
        w.put(&7u8).put(&1u32).put(&"ab".to_owned()).put(&1.0);
        // header, 7, three of padding, 1, length 3, "ab\0", five of padding to 16, 1.0
        #[rustfmt::skip]
        let want = [
            0, 1, 0, 0,
            7, 0, 0, 0,  1, 0, 0, 0,
            3, 0, 0, 0,  b'a', b'b', 0, 0,
            0, 0, 0, 0, 0, 0, 0xf0, 0x3f,
        ];
        // 4+4+4+3 = 15 bytes behind the header: one of padding to 16
        assert_eq!(w.finish(), want);
        let mut r = Reader::new(&want).unwrap();
        assert_eq!(
            (r.get::<u8>(), r.get::<u32>(), r.get(), r.get()),
            (Ok(7), Ok(1), Ok("ab".to_owned()), Ok(1.0f64))
        );
        assert_eq!(r.get::<u8>(), Err(CdrError::Short(24)));
    }

    #[test]
    fn the_other_byte_order_and_wrong_heads() {
        let mut r = Reader::new(&[0, 0, 0, 0, 0, 0, 1, 2]).unwrap();
        assert_eq!(r.get(), Ok(0x0102u32));
        assert!(matches!(Reader::new(&[9, 9, 0, 0]), Err(CdrError::Encapsulation(_))));
        assert!(matches!(Reader::new(&[0, 1]), Err(CdrError::Short(2))));
        // a list that claims four thousand million elements ends where the bytes end
        let mut r = Reader::new(&[0, 1, 0, 0, 255, 255, 255, 255, 0, 0]).unwrap();
        assert!(r.get::<Vec<f64>>().is_err());
    }

    proptest! {
        #[test]
        fn what_is_written_is_read(a: u8, b: i32, c: f64, text in "[a-z é]{0,20}", list: Vec<f32>) {
            let mut w = Writer::default();
            w.put(&a).put(&b).put(&text).put(&c).put(&list).put(&a);
            let bytes = w.finish();
            let mut r = Reader::new(&bytes).unwrap();
            prop_assert_eq!(r.get::<u8>().unwrap(), a);
            prop_assert_eq!(r.get::<i32>().unwrap(), b);
            prop_assert_eq!(r.get::<String>().unwrap(), text);
            prop_assert_eq!(r.get::<f64>().unwrap().to_bits(), c.to_bits());
            let back = r.get::<Vec<f32>>().unwrap();
            prop_assert_eq!(back.iter().map(|x| x.to_bits()).collect::<Vec<_>>(), list.iter().map(|x| x.to_bits()).collect::<Vec<_>>());
            prop_assert_eq!(r.get::<u8>().unwrap(), a);
        }

        #[test]
        fn no_bytes_panic(bytes: Vec<u8>) {
            if let Ok(mut r) = Reader::new(&bytes) {
                while r.get::<String>().is_ok() && r.get::<Vec<f64>>().is_ok() {}
                let _ = r.get::<[f64; 9]>();
            }
        }
    }
}
