//! The messages of a recording, whichever of its two forms a bag has: MCAP or SQLite (`.db3`).

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{Cursor, ErrorKind, Read, Seek};
use std::path::{Path, PathBuf};

use caudata_durable::read_at_most;

use super::container::{ContainerError, Record, Records};
use super::sqlite::{Database, Row, SqliteError, Value};
use crate::error::{LogError, io_error};

/// Largest MCAP file that is read, bytes.
const MAX_MCAP_BYTES: u64 = 1024 * 1024 * 1024;
/// How zstd's frames begin: a bag whose messages are packed one by one.
const ZSTD: &[u8] = &[0x28, 0xb5, 0x2f, 0xfd];
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
pub fn messages(
    path: &Path,
    wanted: &dyn Fn(&str) -> bool,
    each: Each<'_>,
) -> Result<Vec<String>, LogError> {
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
        let log = path.with_extension("db3-wal");
        if std::fs::metadata(&log).is_ok_and(|m| m.len() > 0) {
            let log = log.display();
            return Err(wrong(format!(
                "its last messages are still in {log}: `sqlite3 {file} 'PRAGMA wal_checkpoint'` puts them in"
            )));
        }
        let open = File::open(path).map_err(io_error(path))?;
        return of_sqlite(open, wanted, each)
            .map(|()| Vec::new())
            .map_err(wrong);
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
            Ok(Record::Message {
                channel,
                log_time_ns,
                data,
            }) => {
                messages += 1;
                let (topic, kind) = channels.get(&channel).ok_or_else(|| {
                    format!("message {messages} is on channel {channel}, which was not announced")
                })?;
                let received_ns = i64::try_from(log_time_ns).unwrap_or(i64::MAX);
                let data = unpacked(data)?;
                let message = Recorded {
                    topic,
                    kind,
                    received_ns,
                    data,
                };
                each(&message)
                    .map_err(|e| format!("message {messages} on {topic} ({kind}): {e}"))?;
            }
            Err(e @ ContainerError::Torn) if messages > 0 => {
                return Ok(Some(format!(
                    "dropped what follows message {messages}: {e}"
                )));
            }
            Err(e) => return Err(e.to_string()),
        }
    }
    Ok(None)
}

/// What stops the reading of a database.
enum Stop {
    File(SqliteError),
    Told(String),
}

impl From<SqliteError> for Stop {
    fn from(error: SqliteError) -> Self {
        Self::File(error)
    }
}

/// The messages of an SQLite file as `rosbag2_storage_sqlite3` lays them out.
///
/// # Errors
/// In words, those of `each` among them.
pub fn of_sqlite<F: Read + Seek>(
    file: F,
    wanted: &dyn Fn(&str) -> bool,
    each: Each<'_>,
) -> Result<(), String> {
    let told = |stop| match stop {
        Stop::File(error) => SqliteError::to_string(&error),
        Stop::Told(message) => message,
    };
    sqlite(file, wanted, each).map_err(told)
}

fn sqlite<F: Read + Seek>(
    file: F,
    wanted: &dyn Fn(&str) -> bool,
    each: Each<'_>,
) -> Result<(), Stop> {
    let mut database = Database::open(file)?;
    let tables = database.tables()?;
    let table = |name: &str, columns: &[&str]| {
        let found = tables.iter().find(|t| t.name == name);
        let places = found.and_then(|t| {
            let place = |c: &&str| t.columns.iter().position(|have| have == c);
            Some((t, columns.iter().map(place).collect::<Option<Vec<_>>>()?))
        });
        let columns = columns.join(", ");
        places.ok_or(Stop::Told(format!(
            "is no bag: it has no table `{name}` with columns {columns}"
        )))
    };
    let (topics, of_topic) = table("topics", &["id", "name", "type"])?;
    let (messages, of_message) = table("messages", &["topic_id", "timestamp", "data"])?;
    let mut names: BTreeMap<i64, (String, String)> = BTreeMap::new();
    database.each(topics, &mut |file, row| {
        let bytes = file.whole(&row)?;
        let text = |k: usize| row.text(of_topic[k], &bytes).unwrap_or_default().to_owned();
        let id = match row.values.get(of_topic[0]) {
            Some(Value::Int(id)) => *id,
            _ => row.id,
        };
        names.insert(id, (text(1), text(2)));
        Ok::<_, Stop>(names.len() < 100_000)
    })?;
    database.each(messages, &mut |file, row: Row| {
        let value = |k: usize| row.values.get(of_message[k]);
        let wrong = |what: &str| Stop::Told(format!("message {}: {what}", row.id));
        let (Some(Value::Int(topic)), Some(Value::Int(received_ns))) = (value(0), value(1)) else {
            return Err(wrong("has no topic or no time"));
        };
        let (topic, kind) = names
            .get(topic)
            .ok_or_else(|| wrong("is on a topic that is not listed"))?;
        let data = match value(2) {
            Some(Value::Bytes(place)) if wanted(kind) => {
                let mut bytes = file.whole(&row)?;
                bytes.truncate(place.end);
                bytes.split_off(place.start.min(bytes.len()))
            }
            _ => Vec::new(),
        };
        let data = unpacked(data).map_err(|e| wrong(&e))?;
        let message = Recorded {
            topic,
            kind,
            received_ns: *received_ns,
            data,
        };
        let told = |e| Stop::Told(format!("message {} on {topic} ({kind}): {e}", row.id));
        each(&message).map_err(told)?;
        Ok(true)
    })
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

    fn all(path: &Path, wanted: &dyn Fn(&str) -> bool) -> Result<Seen, LogError> {
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
        let seen = all(&fixture(), &|kind| kind == "std_msgs/msg/String").unwrap();
        assert_eq!(seen.len(), 24);
        // header of 4, length of 4, 1200 letters, a zero
        let want = (
            "/rosout".to_owned(),
            1_700_000_000_142_000_000,
            4 + 4 + 1201,
        );
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
            let error = all(&path, &|_| true).unwrap_err().to_string();
            assert!(error.contains(want) && !error.contains('\n'), "{error}");
        };
        let whole = std::fs::read(fixture()).unwrap();
        says("a.db3", b"PK", "is not an SQLite file");
        says(
            "b.db3",
            &whole[..4096],
            "it ends before a page that it names",
        );
        says("c.mcap", b"PK", "is not an MCAP file");
        says("d.db3.zstd", b"", "unpack it first");
        std::fs::write(dir.path().join("f.db3-wal"), b"x").unwrap();
        says("f.db3", &whole, "its last messages are still in");
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

    proptest::proptest! {
        /// A file with any damage is messages or an error, never a panic.
        #[test]
        fn no_damage_panics(at in 0usize..14_848, with: u8, cut in 0usize..14_848) {
            let mut bytes = std::fs::read(fixture()).unwrap();
            bytes[at] = with;
            let _ = of_sqlite(Cursor::new(&bytes), &|_| true, &mut |_| Ok(()));
            bytes.truncate(cut);
            let _ = of_sqlite(Cursor::new(&bytes), &|_| true, &mut |_| Ok(()));
        }
    }
}
