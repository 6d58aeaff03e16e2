//! The MCAP container (mcap.dev/spec): the schemas, channels and messages of a file, also those inside
//! chunks.
//!
//! The `mcap` crate cuts a file into records and unpacks chunks. Files come from anywhere, so what they say
//! of lengths is held to bounds here: a chunk is gone through record by record, never unpacked at once.

use std::borrow::Cow;

use mcap::records::op;
use mcap::sans_io::{LinearReadEvent, LinearReader, LinearReaderOptions};
use mcap::{MAGIC, McapError};

/// Largest record inside a compressed chunk, bytes.
const MAX_RECORD_BYTES: usize = 64 * 1024 * 1024;
/// Most that the compressed chunks of one file may hold together, bytes.
const MAX_UNPACKED_BYTES: u64 = 4 * 1024 * 1024 * 1024;

/// What a reader meets.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Record {
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
        data: Vec<u8>,
    },
}

/// Why a file cannot be read on.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ContainerError {
    /// Another kind of file.
    #[error("is not an MCAP file: it does not begin with its magic word")]
    Magic,
    /// A recorder was killed while it wrote.
    #[error("the file ends in the middle of a record")]
    Torn,
    /// What it says of itself cannot be.
    #[error("is damaged: {0}")]
    Damaged(String),
    /// Its chunks hold more than is unpacked.
    #[error("unpacks to {0} bytes; at most {MAX_UNPACKED_BYTES} are read: leave out camera topics")]
    Large(u64),
}

/// Goes through the records of a file.
pub struct Records<'a> {
    file: Source<'a>,
    /// The chunk that is being read.
    chunk: Option<Source<'static>>,
    /// What the compressed chunks so far hold, bytes.
    unpacked: u64,
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
        let options = LinearReaderOptions::default().with_emit_chunks(true);
        Ok(Self {
            file: Source::new(Cow::Borrowed(&bytes[MAGIC.len()..]), options, bytes.len()),
            chunk: None,
            unpacked: 0,
            done: false,
        })
    }

    /// The next schema, channel or message; `None` at the end of the data.
    fn step(&mut self) -> Result<Option<Record>, ContainerError> {
        loop {
            let inside = self.chunk.is_some();
            let next = match &mut self.chunk {
                Some(chunk) => chunk.next().map_err(|e| damaged(&e)),
                None => self.file.next().map_err(|e| match e {
                    McapError::UnexpectedEof | McapError::RecordTooLarge { .. } => {
                        ContainerError::Torn
                    }
                    other => damaged(&other),
                }),
            };
            match next? {
                Some((op::CHUNK, _)) if inside => return Err(damaged(&"a chunk inside a chunk")),
                Some((op::CHUNK, body)) => self.chunk = Some(self.enter(&body)?),
                Some((op::DATA_END | op::FOOTER, _)) if !inside => return Ok(None),
                Some((opcode, body)) => {
                    let record = parse(opcode, &body).ok_or(damaged(&"a record is too short"))?;
                    if record.is_some() {
                        return Ok(record);
                    }
                }
                None if inside => self.chunk = None,
                None => return Ok(None),
            }
        }
    }

    /// The records of a chunk.
    fn enter(&mut self, body: &[u8]) -> Result<Source<'static>, ContainerError> {
        let mut fields = Fields(body);
        let head = fields.chunk_head();
        let (unpacked, compression, packed) = head.ok_or(damaged(&"a chunk is too short"))?;
        if compression.is_empty() {
            if packed != fields.0.len() as u64 {
                return Err(damaged(&"a chunk has another length than it says"));
            }
            let options = LinearReaderOptions::default().with_emit_chunks(true);
            let records = Cow::Owned(fields.0.to_vec());
            return Ok(Source::new(records, options, packed as usize));
        }
        self.unpacked = self.unpacked.saturating_add(unpacked);
        if self.unpacked > MAX_UNPACKED_BYTES {
            return Err(ContainerError::Large(self.unpacked));
        }
        let options = LinearReaderOptions::default().with_validate_chunk_crcs(true);
        let mut framed = vec![op::CHUNK];
        framed.extend_from_slice(&(body.len() as u64).to_le_bytes());
        framed.extend_from_slice(body);
        Ok(Source::new(Cow::Owned(framed), options, MAX_RECORD_BYTES))
    }
}

impl Iterator for Records<'_> {
    type Item = Result<Record, ContainerError>;

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

fn damaged(why: &dyn std::fmt::Display) -> ContainerError {
    ContainerError::Damaged(why.to_string())
}

/// Bytes, and the reader that they are fed to.
struct Source<'a> {
    reader: LinearReader,
    bytes: Cow<'a, [u8]>,
    at: usize,
}

impl<'a> Source<'a> {
    /// Records without magic words around them, none longer than `longest`.
    fn new(bytes: Cow<'a, [u8]>, options: LinearReaderOptions, longest: usize) -> Self {
        let options = options
            .with_skip_start_magic(true)
            .with_skip_end_magic(true)
            .with_record_length_limit(longest);
        Self { reader: LinearReader::new_with_options(options), bytes, at: 0 }
    }

    fn next(&mut self) -> Result<Option<(u8, Vec<u8>)>, McapError> {
        while let Some(event) = self.reader.next_event() {
            match event? {
                LinearReadEvent::ReadRequest(wanted) => {
                    let rest = &self.bytes[self.at..];
                    let n = wanted.min(rest.len());
                    self.reader.insert(n).copy_from_slice(&rest[..n]);
                    self.reader.notify_read(n);
                    self.at += n;
                }
                LinearReadEvent::Record { opcode, data } => {
                    return Ok(Some((opcode, data.to_vec())));
                }
            }
        }
        Ok(None)
    }
}

/// `None` for a record whose fields go beyond its end, `Some(None)` for one that a log does not need.
fn parse(opcode: u8, body: &[u8]) -> Option<Option<Record>> {
    let mut fields = Fields(body);
    Some(Some(match opcode {
        op::SCHEMA => Record::Schema { id: fields.u16()?, name: fields.text()? },
        op::CHANNEL => {
            Record::Channel { id: fields.u16()?, schema: fields.u16()?, topic: fields.text()? }
        }
        op::MESSAGE => {
            let channel = fields.u16()?;
            fields.u32()?; // sequence
            let log_time_ns = fields.u64()?;
            fields.u64()?; // publish time
            Record::Message { channel, log_time_ns, data: fields.0.to_vec() }
        }
        _ => return Some(None),
    }))
}

/// The fields of a record, little-endian, from the front. The crate's own parser makes room for a text before
/// it looks whether there is one of that length.
struct Fields<'a>(&'a [u8]);

impl Fields<'_> {
    fn take<const N: usize>(&mut self) -> Option<[u8; N]> {
        let (head, rest) = self.0.split_first_chunk()?;
        self.0 = rest;
        Some(*head)
    }

    fn u16(&mut self) -> Option<u16> {
        self.take().map(u16::from_le_bytes)
    }

    fn u32(&mut self) -> Option<u32> {
        self.take().map(u32::from_le_bytes)
    }

    fn u64(&mut self) -> Option<u64> {
        self.take().map(u64::from_le_bytes)
    }

    fn text(&mut self) -> Option<String> {
        let n = self.u32()? as usize;
        let (text, rest) = self.0.split_at_checked(n)?;
        self.0 = rest;
        String::from_utf8(text.to_vec()).ok()
    }

    /// Length unpacked, compression, length packed; what is left are the records.
    fn chunk_head(&mut self) -> Option<(u64, String, u64)> {
        let [_first_ns, _last_ns, unpacked] = [self.u64()?, self.u64()?, self.u64()?];
        self.u32()?; // checksum
        Some((unpacked, self.text()?, self.u64()?))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use mcap::{Compression, WriteOptions};
    use std::io::Cursor;

    fn file(compression: Option<Compression>, chunks: bool) -> Vec<u8> {
        let options = WriteOptions::new().compression(compression).use_chunks(chunks);
        let mut w = options.create(Cursor::new(Vec::new())).unwrap();
        let schema = w.add_schema("a/msg/B", "ros2msg", b"float64 x").unwrap();
        let channel = w.add_channel(schema, "/b", "cdr", &Default::default()).unwrap();
        for log_time in 17..20 {
            let header = mcap::records::MessageHeader {
                channel_id: channel,
                sequence: 0,
                log_time,
                publish_time: log_time,
            };
            w.write_to_known_channel(&header, &[1, 2, 3]).unwrap();
        }
        w.finish().unwrap();
        w.into_inner().into_inner()
    }

    fn all(bytes: &[u8]) -> Result<Vec<Record>, ContainerError> {
        Records::new(bytes)?.collect()
    }

    fn want() -> Vec<Record> {
        let (name, topic) = ("a/msg/B".to_owned(), "/b".to_owned());
        let mut records =
            vec![Record::Schema { id: 1, name }, Record::Channel { id: 1, schema: 1, topic }];
        records.extend((17..20).map(|log_time_ns| Record::Message {
            channel: 1,
            log_time_ns,
            data: vec![1, 2, 3],
        }));
        records
    }

    /// A file of one chunk, with what it says of itself.
    fn chunk(unpacked: u64, compression: &str, records: &[u8]) -> Vec<u8> {
        let mut body = vec![0; 16];
        body.extend(unpacked.to_le_bytes());
        body.extend([0; 4]);
        body.extend((compression.len() as u32).to_le_bytes());
        body.extend(compression.as_bytes());
        body.extend((records.len() as u64).to_le_bytes());
        body.extend(records);
        let mut out = MAGIC.to_vec();
        out.push(op::CHUNK);
        out.extend((body.len() as u64).to_le_bytes());
        out.extend(body);
        out
    }

    #[test]
    fn files_are_read_however_they_are_packed() {
        for compression in [None, Some(Compression::Zstd), Some(Compression::Lz4)] {
            assert_eq!(all(&file(compression, true)).unwrap(), want());
        }
        assert_eq!(all(&file(None, false)).unwrap(), want());
        let strange = all(&chunk(9, "brotli", &[0; 9])).unwrap_err();
        assert!(strange.to_string().contains("brotli"), "{strange}");
    }

    #[test]
    fn torn_files_give_what_they_have() {
        for chunks in [false, true] {
            let bytes = file(Some(Compression::Zstd), chunks);
            for cut in MAGIC.len()..bytes.len() {
                let all: Vec<_> = Records::new(&bytes[..cut]).unwrap().collect();
                let good = all.iter().take_while(|r| r.is_ok()).count();
                assert!(good <= 5 && all.len() <= good + 1, "{cut}");
                assert!(all[good..].iter().all(|r| *r == Err(ContainerError::Torn)));
            }
        }
        assert_eq!(all(b"PK"), Err(ContainerError::Magic));
    }

    #[test]
    fn nothing_is_believed_of_lengths() {
        // a chunk that says that it holds ten gigabytes
        let ten = 10_000_000_000;
        let zipped = chunk(ten, "zstd", &[0; 40]);
        assert_eq!(all(&zipped), Err(ContainerError::Large(ten)));
        assert!(matches!(all(&chunk(u64::MAX, "lz4", &[0; 40])), Err(ContainerError::Large(_))));
        // a message that says so, in a plain chunk: it ends beyond it
        let mut message = vec![op::MESSAGE];
        message.extend(ten.to_le_bytes());
        message.extend([0; 40]);
        let plain = chunk(message.len() as u64, "", &message);
        assert!(matches!(all(&plain), Err(ContainerError::Damaged(_))));
        // a text of four gigabytes
        let mut schema = vec![op::SCHEMA, 10, 0, 0, 0, 0, 0, 0, 0, 1, 0];
        schema.extend([255; 4]);
        schema.extend([0; 4]);
        let plain = chunk(schema.len() as u64, "", &schema);
        assert!(matches!(all(&plain), Err(ContainerError::Damaged(_))));
        // a chunk in a chunk
        let nested = chunk(9, "", &chunk(0, "", &[])[MAGIC.len()..]);
        assert!(all(&nested).unwrap_err().to_string().contains("inside"));
    }

    #[test]
    fn a_long_message_in_a_small_chunk_is_refused() {
        // 70 MB of zeros: some kilobytes as zstd
        let mut w = WriteOptions::new()
            .compression(Some(Compression::Zstd))
            .create(Cursor::new(Vec::new()))
            .unwrap();
        let channel = w.add_channel(0, "/b", "cdr", &Default::default()).unwrap();
        let header = mcap::records::MessageHeader {
            channel_id: channel,
            sequence: 0,
            log_time: 1,
            publish_time: 1,
        };
        w.write_to_known_channel(&header, &vec![0; MAX_RECORD_BYTES + 1]).unwrap();
        w.finish().unwrap();
        let bytes = w.into_inner().into_inner();
        assert!(bytes.len() < 100_000);
        assert!(matches!(all(&bytes), Err(ContainerError::Damaged(_))));
    }
}
