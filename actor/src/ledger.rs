//! How many chunks an actor has sent, on disk, so that the count survives `kill -9`.
//!
//! Eight bytes, little endian, at offset 0. They are written in place before each chunk is handed over: a
//! killed process leaves a count that is right or one too high (the chunk it was about to hand over), never
//! too low.

use std::fs::{File, OpenOptions};
use std::io;
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};

const PREFIX: &str = "actor-";
const SUFFIX: &str = ".ledger";

/// The open file. Survives the process, not a power cut: it is not synced, since it accounts for one run.
#[derive(Debug)]
pub struct Ledger {
    file: File,
}

impl Ledger {
    /// Creates the file with count 0, or takes over an existing one with its count set to 0.
    ///
    /// # Errors
    /// When the file cannot be created or written.
    pub fn create(path: &Path) -> io::Result<Self> {
        let file = OpenOptions::new().create(true).truncate(true).write(true).open(path)?;
        let ledger = Self { file };
        ledger.write(0)?;
        Ok(ledger)
    }

    /// Writes the running count.
    ///
    /// # Errors
    /// Disk full, or an I/O error.
    pub fn write(&self, sent: u64) -> io::Result<()> {
        self.file.write_all_at(&sent.to_le_bytes(), 0)
    }
}

/// The count in a ledger.
///
/// # Errors
/// When the file cannot be read or is shorter than eight bytes.
pub fn read_ledger(path: &Path) -> io::Result<u64> {
    let mut bytes = [0; 8];
    File::open(path)?.read_exact_at(&mut bytes, 0)?;
    Ok(u64::from_le_bytes(bytes))
}

/// Where the ledger of one incarnation of one actor lies in a folder of ledgers.
pub fn ledger_path(folder: &Path, actor_id: u32, incarnation: u64) -> PathBuf {
    folder.join(format!("{PREFIX}{actor_id}-{incarnation}{SUFFIX}"))
}

/// A ledger found in a folder.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct LedgerCount {
    /// Actor.
    pub actor_id: u32,
    /// How many times it was started before.
    pub incarnation: u64,
    /// Chunks that it sent; `None` where the file is torn. An empty one was just made by an actor that was
    /// killed before it sent anything.
    pub sent: Option<u64>,
}

/// All ledgers in a folder, in order; none where there is no folder.
pub fn ledgers_in(folder: &Path) -> Vec<LedgerCount> {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    let mut found: Vec<LedgerCount> = entries
        .filter_map(|entry| {
            let (actor_id, incarnation) = key_of(entry.file_name().to_str()?)?;
            let empty = entry.metadata().is_ok_and(|metadata| metadata.len() == 0);
            let sent = read_ledger(&entry.path()).ok().or(empty.then_some(0));
            Some(LedgerCount { actor_id, incarnation, sent })
        })
        .collect();
    found.sort_unstable();
    found
}

fn key_of(name: &str) -> Option<(u32, u64)> {
    let key = name.strip_prefix(PREFIX)?.strip_suffix(SUFFIX)?;
    let (actor_id, incarnation) = key.split_once('-')?;
    Some((actor_id.parse().ok()?, incarnation.parse().ok()?))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_last_count_written_is_the_one_read() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("actor-0.ledger");
        let ledger = Ledger::create(&path).unwrap();
        assert_eq!(read_ledger(&path).unwrap(), 0);
        for count in [1, 2, 0x0102_0304_0506_0708] {
            ledger.write(count).unwrap();
            assert_eq!(read_ledger(&path).unwrap(), count);
        }
        // Byte order is part of the format.
        assert_eq!(std::fs::read(&path).unwrap(), [8, 7, 6, 5, 4, 3, 2, 1]);
    }

    #[test]
    fn a_folder_of_ledgers_is_read_in_order() {
        let dir = tempfile::tempdir().unwrap();
        for (actor, incarnation, sent) in [(10, 0, 3), (2, 11, 5), (2, 9, 7)] {
            let ledger = Ledger::create(&ledger_path(dir.path(), actor, incarnation)).unwrap();
            ledger.write(sent).unwrap();
        }
        std::fs::write(ledger_path(dir.path(), 1, 0), [1, 2]).unwrap();
        std::fs::write(ledger_path(dir.path(), 1, 1), []).unwrap();
        std::fs::write(dir.path().join("actor-x-0.ledger"), [0; 8]).unwrap();
        let found: Vec<_> =
            ledgers_in(dir.path()).iter().map(|l| (l.actor_id, l.incarnation, l.sent)).collect();
        let whole = [(2, 9, 7), (2, 11, 5), (10, 0, 3)].map(|(a, i, n)| (a, i, Some(n)));
        assert_eq!(found[..2], [(1, 0, None), (1, 1, Some(0))]);
        assert_eq!(found[2..], whole);
        assert!(ledgers_in(&dir.path().join("none")).is_empty());
    }

    #[test]
    fn a_missing_and_a_short_ledger_are_errors() {
        let dir = tempfile::tempdir().unwrap();
        assert!(read_ledger(&dir.path().join("none")).is_err());
        let short = dir.path().join("short");
        std::fs::write(&short, [1, 2, 3]).unwrap();
        assert!(read_ledger(&short).is_err());
    }
}
