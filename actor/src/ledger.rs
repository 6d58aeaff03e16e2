//! How many chunks an actor has sent, on disk, so that the count survives `kill -9`.
//!
//! Eight bytes, little endian, at offset 0. They are written in place before each chunk is handed over: a killed
//! process leaves a count that is right or one too high (the chunk it was about to hand over), never too low.

use std::fs::{File, OpenOptions};
use std::io;
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};

/// The open file. Survives the process, not a power cut: it is not synced, since it accounts for one run.
#[derive(Debug)]
pub struct Ledger {
    file: File,
    path: PathBuf,
}

impl Ledger {
    /// Creates the file with count 0, or takes over an existing one with its count set to 0.
    ///
    /// # Errors
    /// When the file cannot be created or written.
    pub fn create(path: &Path) -> io::Result<Self> {
        let file = OpenOptions::new()
            .create(true)
            .truncate(true)
            .write(true)
            .open(path)?;
        let ledger = Self {
            file,
            path: path.to_owned(),
        };
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

    /// Where it lies.
    pub fn path(&self) -> &Path {
        &self.path
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
    fn a_missing_and_a_short_ledger_are_errors() {
        let dir = tempfile::tempdir().unwrap();
        assert!(read_ledger(&dir.path().join("none")).is_err());
        let short = dir.path().join("short");
        std::fs::write(&short, [1, 2, 3]).unwrap();
        assert!(read_ledger(&short).is_err());
    }
}
