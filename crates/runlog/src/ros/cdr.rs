//! CDR, the byte form of ROS 2 messages: numbers in their natural alignment (counted from behind the 4-byte header), texts and lists with
//! their length in front. OMG DDS-XTypes, section 7.4 ("plain CDR", version 1).

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
    /// Behind the encapsulation header.
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
        Ok(Self {
            bytes: rest,
            at: 0,
            little,
        })
    }

    fn take<const N: usize>(&mut self, align: usize) -> Result<[u8; N], CdrError> {
        let start = self.at.next_multiple_of(align);
        let found = self.bytes.get(start..).and_then(<[u8]>::first_chunk::<N>);
        let mut out = *found.ok_or(CdrError::Short(self.bytes.len()))?;
        self.at = start + N;
        if !self.little {
            out.reverse();
        }
        Ok(out)
    }

    /// A byte.
    ///
    /// # Errors
    /// At the end.
    pub fn u8(&mut self) -> Result<u8, CdrError> {
        Ok(self.take::<1>(1)?[0])
    }

    /// An unsigned number of 32 bits.
    ///
    /// # Errors
    /// At the end.
    pub fn u32(&mut self) -> Result<u32, CdrError> {
        Ok(u32::from_le_bytes(self.take(4)?))
    }

    /// A signed number of 32 bits.
    ///
    /// # Errors
    /// At the end.
    pub fn i32(&mut self) -> Result<i32, CdrError> {
        Ok(i32::from_le_bytes(self.take(4)?))
    }

    /// A number of 32 bits.
    ///
    /// # Errors
    /// At the end.
    pub fn f32(&mut self) -> Result<f32, CdrError> {
        Ok(f32::from_le_bytes(self.take(4)?))
    }

    /// A number of 64 bits.
    ///
    /// # Errors
    /// At the end.
    pub fn f64(&mut self) -> Result<f64, CdrError> {
        Ok(f64::from_le_bytes(self.take(8)?))
    }

    /// `N` numbers without a length.
    ///
    /// # Errors
    /// At the end.
    pub fn f64s<const N: usize>(&mut self) -> Result<[f64; N], CdrError> {
        let mut out = [0.0; N];
        for x in &mut out {
            *x = self.f64()?;
        }
        Ok(out)
    }

    /// A text.
    ///
    /// # Errors
    /// At the end; where it is not UTF-8.
    pub fn text(&mut self) -> Result<String, CdrError> {
        let length = self.u32()? as usize;
        let end = self.at.checked_add(length);
        let bytes = end.and_then(|end| self.bytes.get(self.at..end));
        let bytes = bytes.ok_or(CdrError::Short(self.bytes.len()))?;
        self.at += length;
        // the length counts the zero at the end; some writers leave out both for an empty text
        let bytes = bytes.strip_suffix(&[0]).unwrap_or(bytes);
        String::from_utf8(bytes.to_vec()).map_err(|_| CdrError::Text)
    }

    /// A list; `one` reads an element. A length that the bytes cannot hold ends at their end, not in memory.
    ///
    /// # Errors
    /// Those of `one`.
    pub fn list<T>(
        &mut self,
        mut one: impl FnMut(&mut Self) -> Result<T, CdrError>,
    ) -> Result<Vec<T>, CdrError> {
        let length = self.u32()? as usize;
        let mut out = Vec::with_capacity(length.min(1024));
        for _ in 0..length {
            out.push(one(self)?);
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
        Self {
            bytes: vec![0, 1, 0, 0],
        }
    }
}

impl Writer {
    /// The bytes.
    #[must_use]
    pub fn finish(self) -> Vec<u8> {
        self.bytes
    }

    fn put(&mut self, align: usize, bytes: &[u8]) {
        while !(self.bytes.len() - 4).is_multiple_of(align) {
            self.bytes.push(0);
        }
        self.bytes.extend_from_slice(bytes);
    }

    /// A byte.
    pub fn u8(&mut self, x: u8) {
        self.put(1, &[x]);
    }

    /// An unsigned number of 32 bits.
    pub fn u32(&mut self, x: u32) {
        self.put(4, &x.to_le_bytes());
    }

    /// A signed number of 32 bits.
    pub fn i32(&mut self, x: i32) {
        self.put(4, &x.to_le_bytes());
    }

    /// A number of 32 bits.
    pub fn f32(&mut self, x: f32) {
        self.put(4, &x.to_le_bytes());
    }

    /// A number of 64 bits.
    pub fn f64(&mut self, x: f64) {
        self.put(8, &x.to_le_bytes());
    }

    /// Numbers without a length.
    pub fn f64s(&mut self, all: &[f64]) {
        for x in all {
            self.f64(*x);
        }
    }

    /// A text with its closing zero.
    pub fn text(&mut self, text: &str) {
        self.u32(text.len() as u32 + 1);
        self.put(1, text.as_bytes());
        self.put(1, &[0]);
    }

    /// A list.
    pub fn list<T>(&mut self, all: &[T], mut one: impl FnMut(&mut Self, &T)) {
        self.u32(all.len() as u32);
        for x in all {
            one(self, x);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn alignment_counts_from_behind_the_header() {
        let mut w = Writer::default();
        w.u8(7);
        w.u32(1);
        w.text("ab");
        w.f64(1.0);
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
            (r.u8(), r.u32(), r.text(), r.f64()),
            (Ok(7), Ok(1), Ok("ab".to_owned()), Ok(1.0))
        );
        assert_eq!(r.u8(), Err(CdrError::Short(24)));
    }

    #[test]
    fn the_other_byte_order_and_wrong_heads() {
        let mut r = Reader::new(&[0, 0, 0, 0, 0, 0, 1, 2]).unwrap();
        assert_eq!(r.u32(), Ok(0x0102));
        assert!(matches!(
            Reader::new(&[9, 9, 0, 0]),
            Err(CdrError::Encapsulation(_))
        ));
        assert!(matches!(Reader::new(&[0, 1]), Err(CdrError::Short(2))));
        // a list that claims four thousand million elements ends where the bytes end
        let mut r = Reader::new(&[0, 1, 0, 0, 255, 255, 255, 255, 0, 0]).unwrap();
        assert!(r.list(Reader::f64).is_err());
    }

    proptest! {
        #[test]
        fn what_is_written_is_read(a: u8, b: i32, c: f64, text in "[a-z é]{0,20}", list: Vec<f32>) {
            let mut w = Writer::default();
            w.u8(a);
            w.i32(b);
            w.text(&text);
            w.f64(c);
            w.list(&list, |w, x| w.f32(*x));
            w.u8(a);
            let bytes = w.finish();
            let mut r = Reader::new(&bytes).unwrap();
            prop_assert_eq!(r.u8().unwrap(), a);
            prop_assert_eq!(r.i32().unwrap(), b);
            prop_assert_eq!(r.text().unwrap(), text);
            prop_assert_eq!(r.f64().unwrap().to_bits(), c.to_bits());
            let back = r.list(Reader::f32).unwrap();
            prop_assert_eq!(back.iter().map(|x| x.to_bits()).collect::<Vec<_>>(), list.iter().map(|x| x.to_bits()).collect::<Vec<_>>());
            prop_assert_eq!(r.u8().unwrap(), a);
        }

        #[test]
        fn no_bytes_panic(bytes: Vec<u8>) {
            if let Ok(mut r) = Reader::new(&bytes) {
                while r.text().is_ok() && r.list(Reader::f64).is_ok() {}
                let _ = r.f64s::<9>();
            }
        }
    }
}
