//! The MCAP container (mcap.dev/spec): records of an opcode, a length and fields, between two magic words. Only what a log needs: schemas,
//! channels and messages, also inside chunks that are not compressed. Everything else is passed over.

/// First and last bytes of a file.
const MAGIC: &[u8] = b"\x89MCAP0\r\n";

/// Opcodes.
const HEADER: u8 = 0x01;
const FOOTER: u8 = 0x02;
const SCHEMA: u8 = 0x03;
const CHANNEL: u8 = 0x04;
const MESSAGE: u8 = 0x05;
const CHUNK: u8 = 0x06;
const DATA_END: u8 = 0x0f;

/// What a reader meets.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Record<'a> {
    /// A message type.
    Schema {
        /// Number that channels refer to.
        id: u16,
        /// `sensor_msgs/msg/Imu`.
        name: String,
    },
    /// A topic.
    Channel {
        /// Number that messages refer to.
        id: u16,
        /// Number of its schema; 0: none.
        schema: u16,
        /// `/imu/data`.
        topic: String,
    },
    /// A message.
    Message {
        /// Number of its channel.
        channel: u16,
        /// When it was recorded, nanoseconds.
        log_time_ns: u64,
        /// Its bytes.
        data: &'a [u8],
    },
}

/// Why a file cannot be read on.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ContainerError {
    /// Another kind of file.
    #[error("is not an MCAP file: it does not begin with its magic word")]
    Magic,
    /// It ends in the middle of a record.
    #[error("ends in the middle of a record, {0} bytes from its beginning")]
    Torn(usize),
    /// A record's fields go beyond its length.
    #[error("has a damaged record {0} bytes from its beginning")]
    Damaged(usize),
    /// A chunk that needs a decompressor.
    #[error("is compressed with {0}; write it again without (`mcap compress --compression none`)")]
    Compressed(String),
}

/// Goes through the records of a file.
pub struct Records<'a> {
    bytes: &'a [u8],
    at: usize,
    /// End of the chunk that is being read.
    chunk_end: Option<usize>,
    done: bool,
}

impl<'a> Records<'a> {
    /// From the magic word on.
    ///
    /// # Errors
    /// [`ContainerError::Magic`].
    pub fn new(bytes: &'a [u8]) -> Result<Self, ContainerError> {
        if !bytes.starts_with(MAGIC) {
            return Err(ContainerError::Magic);
        }
        Ok(Self {
            bytes,
            at: MAGIC.len(),
            chunk_end: None,
            done: false,
        })
    }

    /// The next schema, channel or message; `None` at the end of the data.
    fn step(&mut self) -> Result<Option<Record<'a>>, ContainerError> {
        loop {
            if self.chunk_end.is_some_and(|end| self.at >= end) {
                self.chunk_end = None;
            }
            let start = self.at;
            let Some(head) = self.bytes.get(start..start + 9) else {
                // a recorder that was killed leaves a file without an end: that is as good as one
                return if start >= self.bytes.len() {
                    Ok(None)
                } else {
                    Err(ContainerError::Torn(start))
                };
            };
            let mut length = [0; 8];
            length.copy_from_slice(&head[1..]);
            let end = usize::try_from(u64::from_le_bytes(length))
                .ok()
                .and_then(|n| n.checked_add(start + 9));
            let body = end.and_then(|end| self.bytes.get(start + 9..end));
            let (Some(end), Some(body)) = (end, body) else {
                return Err(ContainerError::Torn(start));
            };
            if self.chunk_end.is_some_and(|chunk| end > chunk) {
                return Err(ContainerError::Damaged(start));
            }
            let damaged = || ContainerError::Damaged(start);
            let mut fields = Fields(body);
            self.at = end;
            match head[0] {
                SCHEMA => {
                    let id = fields.u16().ok_or_else(damaged)?;
                    let name = fields.text().ok_or_else(damaged)?;
                    return Ok(Some(Record::Schema { id, name }));
                }
                CHANNEL => {
                    let id = fields.u16().ok_or_else(damaged)?;
                    let schema = fields.u16().ok_or_else(damaged)?;
                    let topic = fields.text().ok_or_else(damaged)?;
                    return Ok(Some(Record::Channel { id, schema, topic }));
                }
                MESSAGE => {
                    let channel = fields.u16().ok_or_else(damaged)?;
                    fields.u32().ok_or_else(damaged)?; // sequence
                    let log_time_ns = fields.u64().ok_or_else(damaged)?;
                    fields.u64().ok_or_else(damaged)?; // publish time
                    return Ok(Some(Record::Message {
                        channel,
                        log_time_ns,
                        data: fields.0,
                    }));
                }
                CHUNK if self.chunk_end.is_none() => {
                    for _ in 0..3 {
                        fields.u64().ok_or_else(damaged)?; // start and end time, uncompressed size
                    }
                    fields.u32().ok_or_else(damaged)?; // checksum
                    let compression = fields.text().ok_or_else(damaged)?;
                    if !compression.is_empty() {
                        return Err(ContainerError::Compressed(compression));
                    }
                    let size = fields
                        .u64()
                        .and_then(|n| usize::try_from(n).ok())
                        .ok_or_else(damaged)?;
                    if size > fields.0.len() {
                        return Err(damaged());
                    }
                    let inside = end - fields.0.len();
                    // go through what the chunk holds as if it lay in the file itself
                    self.at = inside;
                    self.chunk_end = Some(inside + size);
                    if fields.0.len() != size {
                        return Err(damaged());
                    }
                }
                DATA_END | FOOTER => return Ok(None),
                _ => {}
            }
        }
    }
}

impl<'a> Iterator for Records<'a> {
    type Item = Result<Record<'a>, ContainerError>;

    fn next(&mut self) -> Option<Self::Item> {
        if self.done {
            return None;
        }
        let step = self.step().transpose();
        // nothing can be trusted behind an error
        self.done = !matches!(step, Some(Ok(_)));
        step
    }
}

/// The fields of a record, little-endian, from the front.
struct Fields<'a>(&'a [u8]);

impl<'a> Fields<'a> {
    fn take(&mut self, n: usize) -> Option<&'a [u8]> {
        let (head, rest) = self.0.split_at_checked(n)?;
        self.0 = rest;
        Some(head)
    }

    fn u16(&mut self) -> Option<u16> {
        Some(u16::from_le_bytes(self.take(2)?.try_into().ok()?))
    }

    fn u32(&mut self) -> Option<u32> {
        Some(u32::from_le_bytes(self.take(4)?.try_into().ok()?))
    }

    fn u64(&mut self) -> Option<u64> {
        Some(u64::from_le_bytes(self.take(8)?.try_into().ok()?))
    }

    fn text(&mut self) -> Option<String> {
        let n = self.u32()? as usize;
        String::from_utf8(self.take(n)?.to_vec()).ok()
    }
}

/// Writes a file record by record, without chunks: valid as far as it was written, readable by every MCAP reader.
pub struct Writer {
    out: Vec<u8>,
}

impl Writer {
    /// With the magic word and a header of this profile (`ros2`).
    #[must_use]
    pub fn new(profile: &str) -> Self {
        let mut writer = Self {
            out: MAGIC.to_vec(),
        };
        let mut body = Vec::new();
        text(&mut body, profile);
        text(&mut body, "caudata");
        writer.record(HEADER, &body);
        writer
    }

    fn record(&mut self, opcode: u8, body: &[u8]) {
        self.out.push(opcode);
        self.out
            .extend_from_slice(&(body.len() as u64).to_le_bytes());
        self.out.extend_from_slice(body);
    }

    /// A message type with its definition.
    pub fn schema(&mut self, id: u16, name: &str, encoding: &str, definition: &str) {
        let mut body = id.to_le_bytes().to_vec();
        text(&mut body, name);
        text(&mut body, encoding);
        text(&mut body, definition);
        self.record(SCHEMA, &body);
    }

    /// A topic.
    pub fn channel(&mut self, id: u16, schema: u16, topic: &str, encoding: &str) {
        let mut body = id.to_le_bytes().to_vec();
        body.extend_from_slice(&schema.to_le_bytes());
        text(&mut body, topic);
        text(&mut body, encoding);
        body.extend_from_slice(&0u32.to_le_bytes()); // no metadata
        self.record(CHANNEL, &body);
    }

    /// A message, recorded when it was published.
    pub fn message(&mut self, channel: u16, sequence: u32, time_ns: u64, data: &[u8]) {
        let mut body = channel.to_le_bytes().to_vec();
        body.extend_from_slice(&sequence.to_le_bytes());
        body.extend_from_slice(&time_ns.to_le_bytes());
        body.extend_from_slice(&time_ns.to_le_bytes());
        body.extend_from_slice(data);
        self.record(MESSAGE, &body);
    }

    /// The whole file: end of data, a footer without a summary, the magic word.
    #[must_use]
    pub fn finish(mut self) -> Vec<u8> {
        self.record(DATA_END, &[0; 4]); // no checksum
        self.record(FOOTER, &[0; 20]);
        self.out.extend_from_slice(MAGIC);
        self.out
    }
}

fn text(out: &mut Vec<u8>, text: &str) {
    out.extend_from_slice(&(text.len() as u32).to_le_bytes());
    out.extend_from_slice(text.as_bytes());
}

#[cfg(test)]
mod tests {
    use super::*;

    fn file() -> Vec<u8> {
        let mut w = Writer::new("ros2");
        w.schema(1, "a/msg/B", "ros2msg", "float64 x");
        w.channel(3, 1, "/b", "cdr");
        w.message(3, 0, 17, &[1, 2, 3]);
        w.finish()
    }

    fn want() -> Vec<Record<'static>> {
        vec![
            Record::Schema {
                id: 1,
                name: "a/msg/B".to_owned(),
            },
            Record::Channel {
                id: 3,
                schema: 1,
                topic: "/b".to_owned(),
            },
            Record::Message {
                channel: 3,
                log_time_ns: 17,
                data: &[1, 2, 3],
            },
        ]
    }

    /// Laid out by hand after the specification.
    #[test]
    fn golden_bytes() {
        let bytes = file();
        assert_eq!(&bytes[..8], b"\x89MCAP0\r\n");
        // header: opcode, 19 bytes, "ros2", "caudata"
        assert_eq!(&bytes[8..17], &[1, 19, 0, 0, 0, 0, 0, 0, 0]);
        assert_eq!(&bytes[17..36], b"\x04\0\0\0ros2\x07\0\0\0caudata");
        let message =
            b"\x05\x19\0\0\0\0\0\0\0\x03\0\0\0\0\0\x11\0\0\0\0\0\0\0\x11\0\0\0\0\0\0\0\x01\x02\x03";
        assert!(bytes.windows(message.len()).any(|w| w == message));
        assert!(bytes.ends_with(
            b"\x02\x14\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\x89MCAP0\r\n"
        ));
        assert_eq!(
            Records::new(&bytes)
                .unwrap()
                .collect::<Result<Vec<_>, _>>()
                .unwrap(),
            want()
        );
    }

    #[test]
    fn chunks_are_entered_and_compressed_ones_named() {
        let plain = file();
        let inner = &plain[36..plain.len() - 8 - 29 - 13]; // without magic, header, end of data (13), footer (29), magic
        let chunk = |compression: &str| {
            let mut body = vec![0; 28];
            text(&mut body, compression);
            body.extend_from_slice(&(inner.len() as u64).to_le_bytes());
            body.extend_from_slice(inner);
            let mut w = Writer::new("ros2");
            w.record(CHUNK, &body);
            w.finish()
        };
        assert_eq!(
            Records::new(&chunk(""))
                .unwrap()
                .collect::<Result<Vec<_>, _>>()
                .unwrap(),
            want()
        );
        let zipped = chunk("zstd");
        let error = Records::new(&zipped).unwrap().next().unwrap().unwrap_err();
        assert!(error.to_string().contains("compressed with zstd"));
    }

    #[test]
    fn torn_files_give_what_they_have() {
        let bytes = file();
        for cut in 8..bytes.len() {
            let all: Vec<_> = Records::new(&bytes[..cut]).unwrap().collect();
            assert!(
                all.len() <= 4 && all.iter().rev().skip(1).all(Result::is_ok),
                "{cut}"
            );
        }
        assert!(matches!(Records::new(b"PK"), Err(ContainerError::Magic)));
    }
}
