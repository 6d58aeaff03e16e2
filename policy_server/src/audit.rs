//! The record of who changed what: one line of JSON per change, appended, each bound to the one before it by
//! its hash.
//!
//! A line is on the disk before the change that it announces, so that nothing changes without one. What was
//! announced and did not happen (a crash, a full disk) gets a line `undone`.

use std::collections::VecDeque;
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use caudata_durable::{Disk, DurableError};
use caudata_proto::hex::hex;
use caudata_proto::registry::AuditEntry;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use crate::error::StoreError;
use crate::files::{entries, unusable};

/// Newest entries that are kept in memory and answered with; older ones are in the file.
pub const ENTRIES_KEPT: usize = 2000;
/// A file that has grown beyond this is given another name, and a new one is begun, bytes.
pub const FILE_MAX: u64 = 16 << 20;
/// Grown files that are kept; the oldest goes. The first line of the next one holds the hash of its last.
pub const FILES_KEPT: usize = 15;
/// The file that grows.
const NAME: &str = "audit.jsonl";
/// What a line says that announces a change which did not happen.
pub const UNDONE: &str = "undone";

/// Who changes something, and when.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Origin {
    /// Role and name of a certificate, or `local`.
    pub by: String,
    /// Milliseconds since 1970-01-01 UTC.
    pub unix_ms: u64,
}

impl Origin {
    /// Somebody on this host, now.
    pub fn local() -> Self {
        Self::of("local")
    }

    /// `by`, now.
    pub fn of(by: &str) -> Self {
        Self { by: by.to_owned(), unix_ms: caudata_telemetry::unix_ms() }
    }
}

/// What is announced.
#[derive(Clone, Debug)]
pub struct Deed<'a> {
    /// `publish`, `revert`, `label`, `quarantine`, `ack`, `nack`.
    pub what: &'a str,
    /// The stream that it belongs to.
    pub stream: &'a str,
    /// Which version.
    pub version: u64,
    /// The change counter that the change gets; `None` where it counts as none.
    pub generation: Option<u64>,
    /// In words.
    pub detail: String,
}

impl<'a> Deed<'a> {
    /// What no stream's state follows from.
    pub fn of(what: &'a str, stream: &'a str, version: u64, detail: String) -> Self {
        Self { what, stream, version, generation: None, detail }
    }
}

/// One line on disk.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Line {
    number: u64,
    unix_ms: u64,
    by: String,
    what: String,
    stream: String,
    version: u64,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    generation: Option<u64>,
    detail: String,
    /// SHA-256 (hex) of the line before, without its end; empty for the first of all.
    before: String,
}

/// The open record.
#[derive(Debug)]
pub struct AuditLog {
    disk: Arc<dyn Disk>,
    root: PathBuf,
    length: u64,
    number: u64,
    /// The highest change counter that a line announces.
    generation: u64,
    last_hash: String,
    last: Option<Line>,
    entries: VecDeque<AuditEntry>,
    /// The last line announces what did not happen, and there was no space to say so; the next line says it
    /// first.
    owed: Option<String>,
    /// Half a line may be at the end of the file, and could not be cut off.
    torn: bool,
}

impl AuditLog {
    /// Reads the record of `root`; half a line at the end, which no change followed, is cut off.
    ///
    /// # Errors
    /// [`StoreError::Unusable`] where it cannot be read, [`StoreError::Durable`] where it cannot be mended.
    pub fn open(root: &Path, disk: Arc<dyn Disk>) -> Result<Self, StoreError> {
        let mut log = Self {
            disk,
            root: root.to_owned(),
            length: 0,
            number: 0,
            generation: 0,
            last_hash: String::new(),
            last: None,
            entries: VecDeque::new(),
            owed: None,
            torn: false,
        };
        // Where the newest file was just begun, the one before it says what the last line was.
        if let Some(before) = log.older_files()?.pop() {
            log.read(&before)?;
        }
        let path = log.path();
        if path.exists() {
            let whole = log.read(&path)?;
            if whole < fs::metadata(&path).map_or(0, |meta| meta.len()) {
                tracing::warn!(path = %path.display(), "half a line at the end of the record, cut off");
                log.disk
                    .cut_synced(&path, whole)
                    .map_err(|(action, e)| DurableError::from_io(action, &path, e))?;
            }
            log.length = whole;
        }
        Ok(log)
    }

    fn path(&self) -> PathBuf {
        self.root.join(NAME)
    }

    fn older_files(&self) -> Result<Vec<PathBuf>, StoreError> {
        let mut files = entries(&self.root)?;
        files.retain(|path| {
            let name = path.file_name().and_then(|name| name.to_str());
            name.is_some_and(|n| n.starts_with("audit-") && n.ends_with(".jsonl"))
        });
        Ok(files)
    }

    /// Writes the file anew, so that all of it is on the disk for certain: what a failed sync left of it
    /// nobody knows.
    pub fn write_anew(&self) -> Result<(), StoreError> {
        let path = self.path();
        if !path.exists() {
            return Ok(());
        }
        let bytes = fs::read(&path).map_err(|error| unusable(&path, &error.to_string()))?;
        Ok(caudata_durable::replace_on(&*self.disk, &path, &bytes)?)
    }

    /// Takes over the whole lines of a file; answers their length.
    fn read(&mut self, path: &Path) -> Result<u64, StoreError> {
        let bytes = fs::read(path).map_err(|error| unusable(path, &error.to_string()))?;
        let mut whole = 0;
        for line in bytes.split_inclusive(|b| *b == b'\n') {
            let Some(text) = line.strip_suffix(b"\n") else { break };
            whole += line.len() as u64;
            match serde_json::from_slice::<Line>(text) {
                Ok(line) => self.take(line, text, path),
                Err(error) => {
                    tracing::error!(path = %path.display(), %error, "a line of the record is damaged");
                }
            }
        }
        Ok(whole)
    }

    fn take(&mut self, line: Line, text: &[u8], path: &Path) {
        if line.before != self.last_hash && self.last.is_some() {
            let number = line.number;
            tracing::error!(path = %path.display(), number, "the record does not follow from the line before: it was changed");
        }
        self.number = line.number;
        self.generation = self.generation.max(line.generation.unwrap_or(0));
        self.last_hash = hex(&Sha256::digest(text));
        self.keep(&line);
        self.last = Some(line);
    }

    fn keep(&mut self, line: &Line) {
        if self.entries.len() == ENTRIES_KEPT {
            self.entries.pop_front();
        }
        self.entries.push_back(AuditEntry {
            number: line.number,
            unix_ms: line.unix_ms,
            by: line.by.clone(),
            what: line.what.clone(),
            stream: line.stream.clone(),
            version: line.version,
            detail: line.detail.clone(),
        });
    }

    /// Writes a line and waits until it is on the disk.
    ///
    /// # Errors
    /// [`StoreError::Durable`]; the record is then as it was, as far as the disk lets it.
    pub fn write(&mut self, origin: &Origin, deed: &Deed<'_>) -> Result<(), StoreError> {
        if let Some(why) = self.owed.clone() {
            self.append_undone(&why)?;
            self.owed = None;
        }
        self.append(origin, deed)
    }

    fn append(&mut self, origin: &Origin, deed: &Deed<'_>) -> Result<(), StoreError> {
        let line = Line {
            number: self.number + 1,
            unix_ms: origin.unix_ms,
            by: origin.by.clone(),
            what: deed.what.to_owned(),
            stream: deed.stream.to_owned(),
            version: deed.version,
            generation: deed.generation,
            detail: deed.detail.clone(),
            before: self.last_hash.clone(),
        };
        let path = self.path();
        let mut text =
            serde_json::to_vec(&line).map_err(|error| unusable(&path, &error.to_string()))?;
        let hash = hex(&Sha256::digest(&text));
        text.push(b'\n');
        let failed = |(action, error)| DurableError::from_io(action, &path, error);
        if self.torn {
            self.disk.cut_synced(&path, self.length).map_err(failed)?;
            self.torn = false;
        }
        let begins = self.length == 0;
        // Opened before anything is written: a name that cannot be synced is no line.
        let root = if begins { Some(self.disk.open_folder(&self.root)) } else { None };
        let root = root.transpose().map_err(|e| DurableError::from_io("open", &self.root, e))?;
        if let Err(fault) = self.disk.append_synced(&path, &text) {
            // Half a line would end up in front of the next one.
            self.torn = fault.0 != "open" && path.exists();
            if self.torn {
                match self.disk.cut_synced(&path, self.length) {
                    Ok(()) => self.torn = false,
                    Err(("open", _)) => {}
                    Err((_, error)) => return Err(failed(("sync", error)).into()),
                }
            }
            return Err(failed(fault).into());
        }
        if let Some(root) = root {
            let synced = self.disk.sync_folder(&root);
            synced.map_err(|e| DurableError::from_io("sync", &self.root, e))?;
        }
        self.length += text.len() as u64;
        self.number = line.number;
        self.last_hash = hash;
        self.keep(&line);
        self.last = Some(line);
        if self.length >= FILE_MAX {
            self.begin_another();
        }
        Ok(())
    }

    /// The grown file gets the number of its last line as its name. Failing is harmless: it grows on.
    fn begin_another(&mut self) {
        let name = format!("audit-{:020}.jsonl", self.number);
        if self.disk.rename(&self.path(), &self.root.join(name)).is_ok() {
            self.length = 0;
        }
        let old = self.older_files().unwrap_or_default();
        for path in old.iter().take(old.len().saturating_sub(FILES_KEPT)) {
            tracing::info!(path = %path.display(), "the oldest part of the record goes");
            let _ = self.disk.remove(path);
        }
    }

    /// The highest change counter that was announced before this start: no other change may get it, or
    /// watchers miss that one.
    pub fn generation(&self) -> u64 {
        self.generation
    }

    /// What the last line announces: the stream of the change and its generation.
    pub fn announced(&self) -> Option<(&str, u64)> {
        let line = self.last.as_ref()?;
        Some((&line.stream, line.generation?))
    }

    /// Writes that what the last line announces did not happen; where that fails, the next line is written
    /// only after it.
    ///
    /// # Errors
    /// As [`AuditLog::write`].
    pub fn write_undone(&mut self, why: &str) -> Result<(), StoreError> {
        let written = self.append_undone(why);
        if written.is_err() {
            self.owed = Some(why.to_owned());
        }
        written
    }

    fn append_undone(&mut self, why: &str) -> Result<(), StoreError> {
        let Some(line) = self.last.clone() else { return Ok(()) };
        let detail = format!("entry {} did not happen: {why}", line.number);
        let deed = Deed::of(UNDONE, &line.stream, line.version, detail);
        self.append(&Origin::of("server"), &deed)
    }

    /// Entries before number `before` (0: all), newest first.
    pub fn newest(&self, before: u64) -> impl Iterator<Item = &AuditEntry> {
        let wanted = move |entry: &&AuditEntry| before == 0 || entry.number < before;
        self.entries.iter().rev().filter(wanted)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use caudata_durable::OsDisk;

    fn deed(version: u64) -> Deed<'static> {
        Deed {
            what: "label",
            stream: "s",
            version,
            generation: Some(version),
            detail: "stable".into(),
        }
    }

    fn open(root: &Path) -> AuditLog {
        AuditLog::open(root, Arc::new(OsDisk)).unwrap()
    }

    #[test]
    fn lines_are_there_after_a_restart_and_half_a_line_is_cut_off() {
        let folder = tempfile::tempdir().unwrap();
        let mut log = open(folder.path());
        for version in 1..=3 {
            log.write(&Origin::local(), &deed(version)).unwrap();
        }
        let path = log.path();
        drop(log);
        let whole = fs::read(&path).unwrap();
        fs::write(&path, [&whole[..], b"{\"number\":4,"].concat()).unwrap();
        let mut log = open(folder.path());
        assert_eq!(fs::read(&path).unwrap(), whole);
        assert_eq!(log.announced(), Some(("s", 3)));
        log.write_undone("crash").unwrap();
        let numbers: Vec<u64> = log.newest(0).map(|e| e.number).collect();
        assert_eq!(numbers, [4, 3, 2, 1]);
        assert_eq!(log.newest(3).count(), 2);
        assert_eq!(log.announced(), None, "undone announces nothing");
    }

    #[test]
    fn every_line_holds_the_hash_of_the_one_before() {
        let folder = tempfile::tempdir().unwrap();
        let mut log = open(folder.path());
        log.write(&Origin::local(), &deed(1)).unwrap();
        drop(log);
        let mut log = open(folder.path());
        log.write(&Origin::local(), &deed(2)).unwrap();
        let text = fs::read_to_string(log.path()).unwrap();
        let lines: Vec<&str> = text.lines().collect();
        let second: Line = serde_json::from_str(lines[1]).unwrap();
        assert_eq!(second.before, hex(&Sha256::digest(lines[0])));
    }

    #[test]
    fn a_grown_file_is_put_aside_and_numbers_go_on() {
        let folder = tempfile::tempdir().unwrap();
        let mut log = open(folder.path());
        log.write(&Origin::local(), &deed(1)).unwrap();
        log.begin_another();
        drop(log);
        let mut log = open(folder.path());
        log.write(&Origin::local(), &deed(2)).unwrap();
        let numbers: Vec<u64> = log.newest(0).map(|e| e.number).collect();
        assert_eq!(numbers, [2, 1]);
        assert_eq!(log.older_files().unwrap().len(), 1);
    }

    #[test]
    fn grown_files_are_bounded_and_the_chain_goes_on_from_the_oldest_that_is_left() {
        let folder = tempfile::tempdir().unwrap();
        let mut log = open(folder.path());
        for version in 1..=40 {
            log.write(&Origin::local(), &deed(version)).unwrap();
            log.begin_another();
        }
        let files = log.older_files().unwrap();
        assert_eq!(files.len(), FILES_KEPT);
        let lines: Vec<String> = files.iter().map(|f| fs::read_to_string(f).unwrap()).collect();
        for (before, line) in lines.iter().zip(&lines[1..]) {
            let line: Line = serde_json::from_str(line).unwrap();
            assert_eq!(line.before, hex(&Sha256::digest(before.trim_end())));
        }
        let mut log = open(folder.path());
        log.write(&Origin::local(), &deed(41)).unwrap();
        assert_eq!(log.newest(0).next().unwrap().number, 41);
    }

    #[test]
    fn without_a_file_handle_a_line_is_not_written_and_the_next_one_follows_whole() {
        use caudata_rehearsal::Rehearsal;
        let folder = tempfile::tempdir().unwrap();
        let disk = Arc::new(Rehearsal::new(folder.path()).unwrap());
        let mut log = AuditLog::open(folder.path(), disk.clone()).unwrap();
        for version in 1..=2 {
            disk.fail_opens_at(0, 24);
            let error = log.write(&Origin::local(), &deed(version)).unwrap_err();
            let StoreError::Durable(error) = error else { panic!("{error}") };
            assert!(!error.is_sync_failure(), "{error}");
            disk.heal();
            log.write(&Origin::local(), &deed(version)).unwrap();
        }
        drop(log);
        let numbers: Vec<u64> = open(folder.path()).newest(0).map(|e| e.number).collect();
        assert_eq!(numbers, [2, 1]);
    }
}
