//! TensorBoard event files: TFRecord frames around protobuf events, scalars and the settings of a run.
//!
//! Formats: TensorFlow `core/util/event.proto`, `core/framework/summary.proto`, `core/framework/tensor.proto`,
//! `core/lib/io/record_writer.h`; TensorBoard `plugins/hparams/plugin_data.proto`.

use std::collections::BTreeMap;
use std::fs::{File, OpenOptions};
use std::io::{self, BufWriter, Write};
use std::path::Path;

use prost::Message;
use serde_json::Value as Json;

/// First event of every file; readers refuse files without it.
const FILE_VERSION: &str = "brain.Event:2";
/// `DT_STRING` of TensorFlow's `types.proto`.
const STRING: i32 = 7;

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
        let host = Some(host.trim()).filter(|host| !host.is_empty()).unwrap_or("localhost");
        let name =
            format!("events.out.tfevents.{}.{host}.{}", wall_time_s as u64, std::process::id());
        let mut options = OpenOptions::new();
        let file = options.create(true).append(true).open(folder.join(name))?;
        let mut events = Self { out: BufWriter::new(file) };
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
            ..Value::default()
        };
        let step = i64::try_from(step).unwrap_or(i64::MAX);
        self.summary(wall_time_s, step, scalars.iter().map(value).collect())
    }

    /// Adds the settings of a run: each as a hyperparameter, all as `text`.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn settings(&mut self, wall_time_s: f64, settings: &Json, text: &str) -> io::Result<()> {
        let mut start = SessionStart { hparams: BTreeMap::new(), start_time_s: wall_time_s };
        start.add("", settings);
        let start = Hparams { start: Some(start) };
        let hparams = Value {
            metadata: Metadata::of("hparams", start.encode_to_vec()),
            ..Value::tagged("_hparams_/session_start_info")
        };
        // What is indented is shown as it is.
        let lines: String = text.lines().map(|line| format!("    {line}\n")).collect();
        self.summary(wall_time_s, 0, vec![hparams])?;
        self.text(wall_time_s, 0, "settings", lines)
    }

    /// Adds a text in Markdown.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn text(&mut self, wall_time_s: f64, step: u64, tag: &str, text: String) -> io::Result<()> {
        let value = Value {
            metadata: Metadata::of("text", Vec::new()),
            tensor: Some(Tensor { dtype: STRING, strings: vec![text.into_bytes()] }),
            ..Value::tagged(&format!("{tag}/text_summary"))
        };
        let step = i64::try_from(step).unwrap_or(i64::MAX);
        self.summary(wall_time_s, step, vec![value])
    }

    fn summary(&mut self, wall_time: f64, step: i64, value: Vec<Value>) -> io::Result<()> {
        self.write(&Event { wall_time, step, file_version: None, summary: Some(Summary { value }) })
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
    #[prost(message, optional, tag = "8")]
    tensor: Option<Tensor>,
    #[prost(message, optional, tag = "9")]
    metadata: Option<Metadata>,
}

impl Value {
    fn tagged(tag: &str) -> Self {
        Self { tag: tag.to_owned(), ..Self::default() }
    }
}

/// `TensorProto` without a shape: a scalar.
#[derive(Clone, PartialEq, Message)]
struct Tensor {
    #[prost(int32, tag = "1")]
    dtype: i32,
    #[prost(bytes = "vec", repeated, tag = "8")]
    strings: Vec<Vec<u8>>,
}

/// `SummaryMetadata`: which dashboard a value is for.
#[derive(Clone, PartialEq, Message)]
struct Metadata {
    #[prost(message, optional, tag = "1")]
    plugin: Option<Plugin>,
}

#[derive(Clone, PartialEq, Message)]
struct Plugin {
    #[prost(string, tag = "1")]
    name: String,
    #[prost(bytes = "vec", tag = "2")]
    content: Vec<u8>,
}

impl Metadata {
    fn of(name: &str, content: Vec<u8>) -> Option<Self> {
        let name = name.to_owned();
        let plugin = Some(Plugin { name, content });
        Some(Self { plugin })
    }
}

/// `HParamsPluginData`.
#[derive(Clone, PartialEq, Message)]
struct Hparams {
    #[prost(message, optional, tag = "3")]
    start: Option<SessionStart>,
}

/// `SessionStartInfo`.
#[derive(Clone, PartialEq, Message)]
struct SessionStart {
    #[prost(btree_map = "string, message", tag = "1")]
    hparams: BTreeMap<String, Setting>,
    #[prost(double, tag = "5")]
    start_time_s: f64,
}

/// `google.protobuf.Value`, the members of its oneof that are used.
#[derive(Clone, PartialEq, Message)]
struct Setting {
    #[prost(double, optional, tag = "2")]
    number: Option<f64>,
    #[prost(string, optional, tag = "3")]
    text: Option<String>,
    #[prost(bool, optional, tag = "4")]
    switch: Option<bool>,
}

impl SessionStart {
    /// Adds a setting, or those of a table, whose name is `key`.
    fn add(&mut self, key: &str, value: &Json) {
        if let Json::Object(table) = value {
            for (name, value) in table {
                let dot = if key.is_empty() { "" } else { "." };
                self.add(&format!("{key}{dot}{name}"), value);
            }
            return;
        }
        let mut setting = Setting::default();
        match value {
            Json::Number(number) => setting.number = number.as_f64(),
            Json::Bool(switch) => setting.switch = Some(*switch),
            Json::String(text) => setting.text = Some(text.clone()),
            other => setting.text = Some(other.to_string()),
        }
        self.hparams.insert(key.to_owned(), setting);
    }
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
    crc32c::crc32c(data).rotate_right(15).wrapping_add(0xa282_ead8)
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
        events.scalars(3.0, 7, &[("a/b".into(), 0.5), ("z".into(), 0.0)]).unwrap();
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
    fn settings_are_hyperparameters_and_a_text() {
        let dir = tempfile::tempdir().unwrap();
        let mut events = EventFile::create(dir.path(), 2.0).unwrap();
        let settings = serde_json::json!({ "run": { "seed": 3, "on": true }, "kind": [0.5] });
        events.settings(4.0, &settings, "a = 1\n").unwrap();
        events.flush().unwrap();
        let file = std::fs::read_dir(dir.path()).unwrap().next().unwrap();
        let bytes = hex(&std::fs::read(file.unwrap().path()).unwrap());
        // field 1, length; key "run.seed" (8 bytes), value { number 3.0 }; likewise the others
        let number = "0a15".to_owned() + "0a08" + &hex(b"run.seed") + "1209" + "110000000000000840";
        let switch = "0a0c".to_owned() + "0a06" + &hex(b"run.on") + "1202" + "2001";
        let list = "0a0f".to_owned() + "0a04" + &hex(b"kind") + "1207" + "1a05" + &hex(b"[0.5]");
        let start = list + &switch + &number + "29" + "0000000000001040";
        assert!(bytes.contains(&start), "{bytes}");
        // tensor { dtype 7, string "    a = 1\n" }, metadata { plugin { name "text" } }
        let tensor = "420e".to_owned() + "0807" + "420a" + &hex(b"    a = 1\n");
        assert!(bytes.contains(&(tensor + "4a08" + "0a06" + "0a04" + &hex(b"text"))), "{bytes}");
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
