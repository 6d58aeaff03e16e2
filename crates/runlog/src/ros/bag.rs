//! The messages of a recording, whichever of its two forms a bag has: MCAP or SQLite (`.db3`).

use std::collections::BTreeMap;
use std::ffi::OsStr;
use std::io::{Cursor, ErrorKind, Read};
use std::path::{Path, PathBuf};

use caudata_durable::read_at_most;

use super::container::{ContainerError, Record, Records};
use crate::error::{LogError, io_error};
use crate::python::{Script, ScriptError};

/// Largest MCAP file that is read, bytes.
const MAX_MCAP_BYTES: u64 = 1024 * 1024 * 1024;
/// How zstd's frames begin: a bag whose messages are packed one by one.
const ZSTD: &[u8] = &[0x28, 0xb5, 0x2f, 0xfd];
/// Prints the messages of a file of SQLite.
const READER: &str = include_str!("bag.py");
/// Largest message of such a bag, unpacked, bytes.
const MAX_MESSAGE_BYTES: u64 = 16 * 1024 * 1024;

/// A message of a recording.
#[derive(Clone, Debug, PartialEq)]
pub struct Recorded<'a> {
    /// `/joint_states`.
    pub topic: &'a str,
    /// `sensor_msgs/msg/JointState`.
    pub kind: &'a str,
    /// When it was received, nanoseconds.
    pub received_ns: i64,
    /// Its CDR form; empty where its kind was not asked for.
    pub data: Vec<u8>,
}

/// Takes a message; what is wrong with it in words, else.
pub type Each<'a> = &'a mut dyn FnMut(&Recorded<'_>) -> Result<(), String>;

/// The recordings in the folder of a bag, or the one file, in the order of their numbers.
///
/// # Errors
/// [`LogError::Io`] where the folder cannot be read.
pub fn files(path: &Path) -> Result<Vec<PathBuf>, LogError> {
    if !path.is_dir() {
        return Ok(vec![path.to_owned()]);
    }
    let entries = std::fs::read_dir(path).map_err(io_error(path))?;
    let mut found: Vec<PathBuf> = entries
        .filter_map(|entry| Some(entry.ok()?.path()))
        .filter(|path| is_recording(path))
        .collect();
    // `run_10.db3` comes behind `run_9.db3`
    found.sort_by_key(|path| (path.as_os_str().len(), path.clone()));
    Ok(found)
}

/// Whether a file is called as recordings are.
pub fn is_recording(path: &Path) -> bool {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    let name = name.trim_end_matches(".zstd");
    name.ends_with(".mcap") || name.ends_with(".db3")
}

/// Calls `each` with the messages of a file, in the order in which they were written; what was left out is
/// returned, one line each. The bytes of kinds that are not `wanted` need not be read.
///
/// # Errors
/// [`LogError`] with file and reason, those of `each` among them.
pub fn messages(path: &Path, wanted: &[&str], each: Each<'_>) -> Result<Vec<String>, LogError> {
    let file = path.display().to_string();
    let wrong = |message: String| LogError::Recording {
        file: file.clone(),
        message: message.replace('\n', " "),
    };
    if path.extension().is_some_and(|x| x == "zstd") {
        let hint = "is packed as a whole: unpack it first (`zstd -d`)".to_owned();
        return Err(wrong(hint));
    }
    if path.extension().is_some_and(|x| x == "db3") {
        let read = of_sqlite(path, wanted, each);
        return read.map(|()| Vec::new()).map_err(|error| error.of(path));
    }
    of_mcap(&read_whole(path)?, each)
        .map_err(wrong)
        .map(|torn| torn.into_iter().map(|t| format!("{file}: {t}")).collect())
}

/// The bytes of an MCAP file.
pub(crate) fn read_whole(path: &Path) -> Result<Vec<u8>, LogError> {
    read_at_most(path, MAX_MCAP_BYTES).map_err(|error| match error.kind() {
        ErrorKind::FileTooLarge => LogError::Recording {
            file: path.display().to_string(),
            message: format!("{error}: split it or leave out camera topics"),
        },
        _ => io_error(path)(error),
    })
}

/// The messages of an MCAP file; what a file that ends in the middle lacks, in words.
pub(super) fn of_mcap(bytes: &[u8], each: Each<'_>) -> Result<Option<String>, String> {
    let mut types: BTreeMap<u16, String> = BTreeMap::new();
    let mut channels: BTreeMap<u16, (String, String)> = BTreeMap::new();
    let mut messages = 0usize;
    for record in Records::new(bytes).map_err(|e| e.to_string())? {
        match record {
            Ok(Record::Schema { id, name }) => {
                types.insert(id, name);
            }
            Ok(Record::Channel { id, schema, topic }) => {
                let kind = types.get(&schema).cloned().unwrap_or_default();
                channels.insert(id, (topic, kind));
            }
            Ok(Record::Message { channel, log_time_ns, data }) => {
                messages += 1;
                let (topic, kind) = channels.get(&channel).ok_or_else(|| {
                    format!("message {messages} is on channel {channel}, which was not announced")
                })?;
                let received_ns = i64::try_from(log_time_ns).unwrap_or(i64::MAX);
                let data = unpacked(data)?;
                let message = Recorded { topic, kind, received_ns, data };
                each(&message)
                    .map_err(|e| format!("message {messages} on {topic} ({kind}): {e}"))?;
            }
            Err(e @ ContainerError::Torn) if messages > 0 => {
                return Ok(Some(format!("dropped what follows message {messages}: {e}")));
            }
            Err(e) => return Err(e.to_string()),
        }
    }
    Ok(None)
}

/// The messages of an SQLite file as `rosbag2_storage_sqlite3` lays them out, by Python's `sqlite3`.
fn of_sqlite(path: &Path, wanted: &[&str], each: Each<'_>) -> Result<(), ScriptError> {
    let arguments = std::iter::once(path.as_os_str()).chain(wanted.iter().map(OsStr::new));
    let mut script = Script::start(READER, &arguments.collect::<Vec<_>>(), &[])?;
    let mut number = 0usize;
    while let Some((topic, kind, received_ns, data)) = sqlite_message(&mut script) {
        number += 1;
        let wrong = |why: String| ScriptError::Wrong(why.replace('\n', " "));
        let message = Recorded {
            topic: &topic,
            kind: &kind,
            received_ns,
            data: unpacked(data).map_err(|e| wrong(format!("message {number}: {e}")))?,
        };
        let of = |e| wrong(format!("message {number} on {topic} ({kind}): {e}"));
        each(&message).map_err(of)?;
    }
    script.finish()
}

/// The next message that the script prints: topic, type, when it was received, bytes.
fn sqlite_message(script: &mut Script) -> Option<(String, String, i64, Vec<u8>)> {
    let lengths = [script.take()?, script.take()?].map(u16::from_le_bytes);
    let length = u32::from_le_bytes(script.take()?) as usize;
    let received_ns = i64::from_le_bytes(script.take()?);
    let mut text = |n: u16| String::from_utf8(script.bytes(n.into())?).ok();
    let (topic, kind) = (text(lengths[0])?, text(lengths[1])?);
    Some((topic, kind, received_ns, script.bytes(length)?))
}

/// A message of a bag that packs each by itself.
fn unpacked(data: Vec<u8>) -> Result<Vec<u8>, String> {
    if !data.starts_with(ZSTD) {
        return Ok(data);
    }
    let mut out = Vec::new();
    let mut reader = zstd::Decoder::with_buffer(Cursor::new(data)).map_err(|e| e.to_string())?;
    reader.window_log_max(24).map_err(|e| e.to_string())?;
    let read = reader.take(MAX_MESSAGE_BYTES).read_to_end(&mut out);
    read.map_err(|e| e.to_string()).map(|_| out)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn fixture() -> PathBuf {
        Path::new(env!("CARGO_MANIFEST_DIR")).join("../../gap/tests/fixtures/bag.db3")
    }

    type Seen = Vec<(String, i64, usize)>;

    fn all(path: &Path, wanted: &[&str]) -> Result<Seen, LogError> {
        let mut seen = Seen::new();
        messages(path, wanted, &mut |m| {
            seen.push((m.topic.to_owned(), m.received_ns, m.data.len()));
            Ok(())
        })?;
        Ok(seen)
    }

    /// Written by SQLite itself, in pages of 512 bytes: 24 messages, a third of them longer than a page.
    #[test]
    fn a_database_gives_its_messages_in_order() {
        let seen = all(&fixture(), &["std_msgs/msg/String"]).unwrap();
        assert_eq!(seen.len(), 24);
        // header of 4, length of 4, 1200 letters, a zero
        let want = ("/rosout".to_owned(), 1_700_000_000_142_000_000, 4 + 4 + 1201);
        assert_eq!(seen[23], want);
        // what is not wanted is there without its bytes
        assert_eq!((seen[0].0.as_str(), seen[0].2), ("/joint_states", 0));
    }

    #[test]
    fn what_is_no_bag_says_so() {
        let dir = tempfile::tempdir().unwrap();
        let says = |name: &str, bytes: &[u8], want: &str| {
            let path = dir.path().join(name);
            std::fs::write(&path, bytes).unwrap();
            let error = all(&path, &[]).unwrap_err().to_string();
            assert!(error.contains(want) && !error.contains('\n'), "{error}");
        };
        let whole = std::fs::read(fixture()).unwrap();
        says("a.db3", b"PK", "file is not a database");
        says("b.db3", &whole[..4096], "database disk image is malformed");
        says("c.mcap", b"PK", "is not an MCAP file");
        says("d.db3.zstd", b"", "unpack it first");
    }

    #[test]
    fn the_files_of_a_bag_come_in_the_order_of_their_numbers() {
        let dir = tempfile::tempdir().unwrap();
        for name in ["run_10.db3", "run_9.db3", "metadata.yaml"] {
            std::fs::write(dir.path().join(name), b"").unwrap();
        }
        let files = files(dir.path()).unwrap();
        let names: Vec<_> = files.iter().map(|f| f.file_name().unwrap()).collect();
        assert_eq!(names, ["run_9.db3", "run_10.db3"]);
    }
}
