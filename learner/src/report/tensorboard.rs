//! TensorBoard event files: TFRecord frames around protobuf events, scalars only.
//!
//! Formats: TensorFlow `core/util/event.proto`, `core/framework/summary.proto`,
//! `core/lib/io/record_writer.h`.

use std::fs::{File, OpenOptions};
use std::io::{self, BufWriter, Write};
use std::path::Path;

use prost::Message;

/// First event of every file; readers refuse files without it.
const FILE_VERSION: &str = "brain.Event:2";

/// An event file that is being written. Scalars reach the disk with [`EventFile::flush`].
#[derive(Debug)]
pub struct EventFile {
    out: BufWriter<File>,
}

impl EventFile {
    /// Creates `events.out.tfevents.<seconds>.<host>.<process id>` in `folder`. TensorBoard shows all such
    /// files of a folder as one run, so each start of the learner has its own.
    ///
    /// # Errors
    /// When the file cannot be created or written.
    pub fn create(folder: &Path, wall_time_s: f64) -> io::Result<Self> {
        let host = std::fs::read_to_string("/proc/sys/kernel/hostname").unwrap_or_default();
        let host = Some(host.trim())
            .filter(|host| !host.is_empty())
            .unwrap_or("localhost");
        let name = format!(
            "events.out.tfevents.{}.{host}.{}",
            wall_time_s as u64,
            std::process::id()
        );
        let mut options = OpenOptions::new();
        let file = options.create(true).append(true).open(folder.join(name))?;
        let mut events = Self {
            out: BufWriter::new(file),
        };
        events.write(&Event {
            wall_time: wall_time_s,
            step: 0,
            file_version: Some(FILE_VERSION.to_owned()),
            summary: None,
        })?;
        events.flush()?;
        Ok(events)
    }

    /// Adds scalars, tag and value, at `step`.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn scalars(
        &mut self,
        wall_time_s: f64,
        step: u64,
        scalars: &[(String, f64)],
    ) -> io::Result<()> {
        let value = |(tag, value): &(String, f64)| Value {
            tag: tag.clone(),
            simple_value: Some(*value as f32),
        };
        self.write(&Event {
            wall_time: wall_time_s,
            step: i64::try_from(step).unwrap_or(i64::MAX),
            file_version: None,
            summary: Some(Summary {
                value: scalars.iter().map(value).collect(),
            }),
        })
    }

    /// Hands everything to the operating system, so that a TensorBoard that watches sees it.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn flush(&mut self) -> io::Result<()> {
        self.out.flush()
    }

    fn write(&mut self, event: &Event) -> io::Result<()> {
        self.out.write_all(&record(&event.encode_to_vec()))
    }
}

/// `Event`, the parts that are used.
#[derive(Clone, PartialEq, Message)]
struct Event {
    #[prost(double, tag = "1")]
    wall_time: f64,
    #[prost(int64, tag = "2")]
    step: i64,
    #[prost(string, optional, tag = "3")]
    file_version: Option<String>,
    #[prost(message, optional, tag = "5")]
    summary: Option<Summary>,
}

#[derive(Clone, PartialEq, Message)]
struct Summary {
    #[prost(message, repeated, tag = "1")]
    value: Vec<Value>,
}

#[derive(Clone, PartialEq, Message)]
struct Value {
    #[prost(string, tag = "1")]
    tag: String,
    /// A member of a oneof: present even when zero.
    #[prost(float, optional, tag = "2")]
    simple_value: Option<f32>,
}

/// A TFRecord: length, its checksum, data, its checksum; little endian.
fn record(data: &[u8]) -> Vec<u8> {
    let length = (data.len() as u64).to_le_bytes();
    let mut out = Vec::with_capacity(data.len() + 16);
    out.extend(length);
    out.extend(masked_crc(&length).to_le_bytes());
    out.extend(data);
    out.extend(masked_crc(data).to_le_bytes());
    out
}

/// CRC-32C, rotated and shifted so that the checksum of data which holds checksums stays good.
fn masked_crc(data: &[u8]) -> u32 {
    crc32c::crc32c(data)
        .rotate_right(15)
        .wrapping_add(0xa282_ead8)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn hex(bytes: &[u8]) -> String {
        bytes.iter().map(|byte| format!("{byte:02x}")).collect()
    }

    #[test]
    fn the_bytes_are_those_that_tensorflow_writes() {
        let dir = tempfile::tempdir().unwrap();
        let mut events = EventFile::create(dir.path(), 2.0).unwrap();
        events
            .scalars(3.0, 7, &[("a/b".into(), 0.5), ("z".into(), 0.0)])
            .unwrap();
        events.flush().unwrap();
        let file = std::fs::read_dir(dir.path()).unwrap().next().unwrap();
        let bytes = std::fs::read(file.unwrap().path()).unwrap();
        // Event 1: field 1 double 2.0, field 3 "brain.Event:2"; step 0 is proto3's default and left out. 24
        // bytes.
        let version = "090000000000000040".to_owned() + "1a0d" + &hex(b"brain.Event:2");
        // Event 2: double 3.0, step 7, summary { value { tag "a/b" simple 0.5 } value { tag "z" simple 0.0 }
        // }.
        let first = "0a0a".to_owned() + "0a03" + &hex(b"a/b") + "150000003f";
        let second = "0a08".to_owned() + "0a01" + &hex(b"z") + "1500000000";
        let scalars = "090000000000000840".to_owned() + "1007" + "2a16" + &first + &second;
        let length_1 = "1800000000000000".to_owned() + "a37f4b22";
        let at = |from: usize, to: usize| hex(&bytes[from..to]);
        assert_eq!(at(0, 12), length_1, "length 24 and its checksum");
        assert_eq!(at(12, 36), version);
        assert_eq!(at(40, 48), "2300000000000000", "length 35");
        assert_eq!(at(52, 87), scalars);
        assert_eq!(bytes.len(), 12 + 24 + 4 + 12 + 35 + 4);
    }

    #[test]
    fn the_checksum_is_crc32c_masked() {
        // CRC-32C of "123456789" is 0xe3069283 (RFC 3720, B.4's polynomial; the usual check value).
        assert_eq!(crc32c::crc32c(b"123456789"), 0xe306_9283);
        assert_eq!(
            masked_crc(b"123456789"),
            0xe306_9283_u32.rotate_right(15).wrapping_add(0xa282_ead8)
        );
    }
}
