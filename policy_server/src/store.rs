//! The store on disk: blobs named by their SHA-256, one small record per published version, and what people
//! and robots say of it.
//!
//! ```text
//! <data>/blobs/<sha256>.onnx                 written once, never changed
//! <data>/streams/<stream>/<version>.json     makes a version visible; written after its blob is on disk
//! <data>/labels/<stream>/<label>.json        where a label leads
//! <data>/quarantine/<stream>/<version>.json  a version out of use, kept for good
//! <data>/reports/<stream>/<version>.json     what robots said about it
//! <data>/used_up/<stream>.json               numbers that no version may bear again
//! <data>/audit.jsonl                         who changed what; a line is there before its change
//! <data>/damaged/                            what was found damaged, set aside for a person to look at
//! ```
//!
//! *Invariant:* a version is whole or absent, and so is every other change. The file that makes it visible is
//! written last and atomically, so a crash at any point leaves at most an unreferenced blob and an
//! announcement, which the next start removes and takes back.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Weak};

use caudata_declare::settings;
use caudata_durable::{Disk, Owner};
use caudata_proto::hex::hex;
use caudata_proto::registry::{LabelName, LabelState, Manifest, StreamName};
use serde::Serialize;
use sha2::{Digest, Sha256};

use crate::audit::{AuditLog, Deed, Origin};
use crate::checks::{BYTES, PUBLICATION, Publication};
use crate::error::StoreError;
use crate::files::{clipped, seal, stream_folder, unusable};
use crate::notes::{Hash, Quarantined, Reports, UsedUp, UsedUpFile};
use crate::quota::Quota;
use crate::record::Record;

settings! {
    /// Limits of the store.
    #[derive(Clone, Copy, Debug)]
    pub struct StoreLimits {
        /// Streams at most; protects the disk from a publisher that invents names.
        pub streams_max: usize = 256,
        /// Versions kept per stream, newest first; older ones are removed after each publication. Too small:
        /// robots that were offline find their version gone; too large: disk (about 0.2 MB each for a 128-128
        /// network).
        pub versions_kept: usize = 64,
        /// Robots that must have run a version through its trial before `stable` may lead to it. 0: none. Too
        /// small: one lucky walk makes a policy everybody's; too large: a small lab never gets there without
        /// an override.
        pub stable_needs: usize = 1,
    }
}

/// What a publication did.
#[derive(Clone, Debug, PartialEq)]
pub struct Published {
    /// The record, new or found.
    pub record: Record,
    /// True where the very same version was there already.
    pub already_present: bool,
}

/// The store. One process at a time owns a data folder (it holds a lock file).
#[derive(Debug)]
pub struct Store {
    pub(crate) root: PathBuf,
    pub(crate) limits: StoreLimits,
    pub(crate) disk: Arc<dyn Disk>,
    pub(crate) generation: u64,
    pub(crate) streams: BTreeMap<StreamName, BTreeMap<u64, Record>>,
    pub(crate) labels: BTreeMap<(StreamName, LabelName), LabelState>,
    pub(crate) quarantined: BTreeMap<(StreamName, u64), Quarantined>,
    pub(crate) used_up: BTreeMap<StreamName, UsedUp>,
    pub(crate) reports: BTreeMap<(StreamName, u64), Reports>,
    pub(crate) quota: Quota,
    pub(crate) audit: AuditLog,
    pub(crate) trouble: Option<Trouble>,
    /// Bytes that somebody holds at present, so that all who ask for them share them.
    pub(crate) held: BTreeMap<Hash, Weak<[u8]>>,
    pub(crate) lock: Arc<Owner>,
}

/// Why the store cannot be changed.
#[derive(Clone, Debug)]
pub(crate) struct Trouble {
    pub(crate) reason: String,
    /// After a failed sync nobody knows what is on the disk: nothing is changed until it was made certain
    /// again.
    pub(crate) read_only: bool,
}

impl Store {
    /// Why the last change failed on the disk; `None`: it did not.
    pub fn trouble(&self) -> Option<&str> {
        self.trouble.as_ref().map(|trouble| trouble.reason.as_str())
    }

    /// Why nothing can be changed at present; `None`: it can.
    pub fn read_only(&self) -> Option<&str> {
        let trouble = self.trouble.as_ref().filter(|trouble| trouble.read_only);
        trouble.map(|trouble| trouble.reason.as_str())
    }

    fn check_writable(&self) -> Result<(), StoreError> {
        match self.read_only() {
            None => Ok(()),
            Some(reason) => Err(StoreError::ReadOnly { reason: reason.to_owned() }),
        }
    }

    /// Remembers what the disk refuses. After a failed sync nothing is changed any more ([`Store::recover`]).
    fn heed<T>(&mut self, result: Result<T, StoreError>) -> Result<T, StoreError> {
        if let Err(StoreError::Durable(error)) = &result {
            let read_only = error.is_sync_failure() || self.read_only().is_some();
            tracing::error!(%error, read_only, "the store cannot write");
            self.trouble = Some(Trouble { reason: error.to_string(), read_only });
        }
        result
    }

    /// Announces a change, makes it, and takes the announcement back where that fails.
    pub(crate) fn announced<T>(
        &mut self,
        origin: &Origin,
        deed: &Deed<'_>,
        change: impl FnOnce(&mut Self) -> Result<T, StoreError>,
    ) -> Result<T, StoreError> {
        self.check_writable()?;
        let written = self.audit.write(origin, deed);
        self.heed(written)?;
        let result = change(self);
        let result = self.heed(result);
        match &result {
            Ok(_) => self.trouble = None,
            // The next start does it otherwise.
            Err(_) if self.read_only().is_some() => {}
            Err(error) => {
                let undone = self.audit.write_undone(&clipped(&error.to_string()));
                if let Err(error) = self.heed(undone) {
                    tracing::error!(%error, "the record says more than happened until it can be written again");
                }
            }
        }
        result
    }

    /// Publishes `bytes` as `manifest.stream` version `manifest.version`.
    ///
    /// Idempotent: the same version with the same bytes answers with the record that is there.
    ///
    /// # Errors
    /// [`StoreError::VersionTaken`], [`StoreError::UsedUp`], [`StoreError::HashMismatch`],
    /// [`StoreError::ContractMismatch`], [`StoreError::Full`], or [`StoreError::Durable`] (disk full);
    /// nothing becomes visible then.
    pub fn publish(&mut self, manifest: Manifest, bytes: &[u8]) -> Result<Published, StoreError> {
        self.publish_by(&Origin::local(), "publish", "", manifest, bytes)
    }

    /// As [`Store::publish`], for the record: by whom, as what (`publish`, `revert`), with which words.
    ///
    /// # Errors
    /// As [`Store::publish`]; [`StoreError::NotAllowed`] for bytes that are quarantined,
    /// [`StoreError::ReadOnly`].
    pub fn publish_by(
        &mut self,
        origin: &Origin,
        what: &str,
        words: &str,
        manifest: Manifest,
        bytes: &[u8],
    ) -> Result<Published, StoreError> {
        let actual: [u8; 32] = Sha256::digest(bytes).into();
        if BYTES.iter().any(|c| (c.refuse)(&manifest.sha256, &actual)) {
            return Err(StoreError::HashMismatch {
                announced: hex(&manifest.sha256),
                actual: hex(&actual),
            });
        }
        if let Some(record) = self.find(&manifest.stream, manifest.version) {
            return if record.manifest.sha256 == manifest.sha256 {
                // What is out of use does not come back by being published once more.
                let key = (manifest.stream.clone(), manifest.version);
                if let Some(known) = self.quarantined.get(&key) {
                    let (stream, version, why) = (key.0, key.1, &known.state.reason);
                    let reason = format!("{stream} version {version} is quarantined: {why}");
                    return Err(StoreError::NotAllowed { reason });
                }
                Ok(Published { record: record.clone(), already_present: true })
            } else {
                Err(StoreError::VersionTaken {
                    stored: hex(&record.manifest.sha256),
                    stream: manifest.stream.to_string(),
                    version: manifest.version,
                })
            };
        }
        self.publication(&manifest).check(PUBLICATION)?;
        self.check_room(&manifest.stream)?;
        let record = Record { generation: self.generation + 1, manifest };
        let stream = record.manifest.stream.clone();
        let deed = Deed {
            what,
            stream: stream.as_str(),
            version: record.manifest.version,
            generation: Some(record.generation),
            detail: format!("sha256 {} {words}", hex(&actual)).trim_end().to_owned(),
        };
        self.announced(origin, &deed, |store| {
            store.write_blob(&actual, bytes)?;
            store.write_record(&record).inspect_err(|error| {
                // After a failed sync the record may be on the disk, and its blob must be there with it.
                let known = !matches!(error, StoreError::Durable(e) if e.is_sync_failure());
                if known && !store.references(&actual) {
                    let _ = store.disk.remove(&store.blob_path(&actual));
                }
            })
        })?;
        self.generation = record.generation;
        self.streams
            .entry(stream.clone())
            .or_default()
            .insert(record.manifest.version, record.clone());
        self.retire_old(&stream);
        Ok(Published { record, already_present: false })
    }

    /// One version; `None` for `version` means the newest that is not quarantined.
    ///
    /// # Errors
    /// [`StoreError::NotFound`].
    pub fn manifest(
        &self,
        stream: &StreamName,
        version: Option<u64>,
    ) -> Result<&Record, StoreError> {
        let found = match version {
            Some(version) => self.find(stream, version),
            None => self.newest_usable(stream),
        };
        found.ok_or_else(|| StoreError::NotFound {
            what: match version {
                Some(version) => format!("{stream} version {version}"),
                None => format!("stream {stream}"),
            },
        })
    }

    /// The newest version of a stream.
    pub fn newest(&self, stream: &StreamName) -> Option<&Record> {
        self.streams.get(stream)?.values().next_back()
    }

    /// The newest version of a stream that is not quarantined; where `latest` leads.
    pub fn newest_usable(&self, stream: &StreamName) -> Option<&Record> {
        let usable = |record: &&Record| !self.is_quarantined(stream, record.manifest.version);
        self.streams.get(stream)?.values().rev().find(usable)
    }

    /// All records of `stream` (`None`: of every stream), newest first within each stream.
    pub fn records<'a>(
        &'a self,
        stream: Option<&'a StreamName>,
    ) -> impl Iterator<Item = &'a Record> + 'a {
        self.streams
            .iter()
            .filter(move |(name, _)| stream.is_none_or(|wanted| *name == wanted))
            .flat_map(|(_, versions)| versions.values().rev())
    }

    /// Names of the streams, sorted.
    pub fn stream_names(&self) -> impl Iterator<Item = &StreamName> {
        self.streams.keys()
    }

    /// Grows by one with each publication, label and quarantine, over all streams, and survives restarts.
    pub fn generation(&self) -> u64 {
        self.generation
    }

    /// The bytes under a hash, verified; whoever asks while others hold them shares theirs. A file that no
    /// longer matches its name is set aside.
    ///
    /// # Errors
    /// [`StoreError::NotFound`], [`StoreError::Damaged`], [`StoreError::Unreadable`].
    pub fn read_blob(&mut self, sha256: &Hash) -> Result<Arc<[u8]>, StoreError> {
        let path = self.blob_path(sha256);
        let missing = || StoreError::NotFound { what: format!("blob {}", hex(sha256)) };
        if !self.references(sha256) {
            return Err(missing());
        }
        if let Some(bytes) = self.held.get(sha256).and_then(Weak::upgrade) {
            return Ok(bytes);
        }
        let bytes: Arc<[u8]> = match fs::read(&path) {
            Ok(bytes) => bytes.into(),
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Err(missing()),
            Err(source) => return Err(StoreError::Unreadable { path, source }),
        };
        let actual = Hash::from(Sha256::digest(&bytes));
        if !BYTES.iter().any(|c| (c.refuse)(sha256, &actual)) {
            self.held.retain(|_, held| held.strong_count() > 0);
            self.held.insert(*sha256, Arc::downgrade(&bytes));
            return Ok(bytes);
        }
        self.withdraw(sha256);
        self.set_aside(&path);
        Err(StoreError::Damaged { path })
    }

    /// What the checks of a new version look at.
    pub(crate) fn publication<'a>(&'a self, manifest: &'a Manifest) -> Publication<'a> {
        let stream = &manifest.stream;
        let quarantined = self.quarantined.values();
        Publication {
            used_up: self.used_up.get(stream),
            newest: self.newest(stream).map(|newest| &newest.manifest),
            quarantined: quarantined.filter(|q| q.state.stream == *stream).collect(),
            manifest,
        }
    }

    pub(crate) fn references(&self, sha256: &[u8; 32]) -> bool {
        self.streams
            .values()
            .flat_map(BTreeMap::values)
            .any(|record| record.manifest.sha256 == *sha256)
    }

    pub(crate) fn find(&self, stream: &StreamName, version: u64) -> Option<&Record> {
        self.streams.get(stream)?.get(&version)
    }

    fn check_room(&self, stream: &StreamName) -> Result<(), StoreError> {
        let limit = self.limits.streams_max;
        if self.streams.contains_key(stream) || self.streams.len() < limit {
            return Ok(());
        }
        Err(StoreError::Full {
            reason: format!("the store holds its limit of {limit} streams; use one of them"),
        })
    }

    fn write_blob(&self, sha256: &[u8; 32], bytes: &[u8]) -> Result<(), StoreError> {
        let path = self.blob_path(sha256);
        match caudata_durable::create_new_on(&*self.disk, &path, bytes) {
            // The same bytes under another version: the blob is shared.
            Err(caudata_durable::DurableError::Exists { .. }) => Ok(()),
            other => Ok(other?),
        }
    }

    fn write_record(&self, record: &Record) -> Result<(), StoreError> {
        let path = self.record_path(&record.manifest.stream, record.manifest.version);
        self.make_folder_of(&path)?;
        let text = record.to_json().map_err(|error| unusable(&path, &error.to_string()))?;
        Ok(caudata_durable::create_new_on(&*self.disk, &path, &text)?)
    }

    pub(crate) fn make_folder_of(&self, path: &Path) -> Result<(), StoreError> {
        let folder = path.parent().unwrap_or(&self.root);
        Ok(caudata_durable::make_folder_on(&*self.disk, folder)?)
    }

    pub(crate) fn write_note(&self, path: &Path, note: &impl Serialize) -> Result<(), StoreError> {
        self.make_folder_of(path)?;
        let text = seal(note).map_err(|error| unusable(path, &error.to_string()))?;
        Ok(caudata_durable::replace_on(&*self.disk, path, &text)?)
    }

    /// Changes which numbers of a stream are used up, on the disk first.
    pub(crate) fn use_up(
        &mut self,
        stream: &StreamName,
        change: impl FnOnce(&mut UsedUp),
    ) -> Result<(), StoreError> {
        let mut next = self.used_up.get(stream).cloned().unwrap_or_default();
        change(&mut next);
        let file = format!("{}.json", stream_folder(stream));
        let path = self.root.join("used_up").join(file);
        let written = self.write_note(&path, &UsedUpFile::new(stream, &next));
        self.heed(written)?;
        self.used_up.insert(stream.clone(), next);
        Ok(())
    }

    /// Removes versions beyond the limit, unless a label leads there: first their numbers are used up, then
    /// the records go, so that no visible version ever lacks its blob.
    fn retire_old(&mut self, stream: &StreamName) {
        let held: BTreeSet<u64> = self
            .labels
            .values()
            .filter(|label| label.stream == *stream)
            .map(|label| label.version)
            .collect();
        let Some(versions) = self.streams.get(stream) else { return };
        let kept = self.limits.versions_kept.max(1);
        let beyond = versions.len().saturating_sub(kept);
        // What a label leads to stays, however old.
        let old = versions.keys().copied().take(beyond);
        let old: Vec<u64> = old.filter(|version| !held.contains(version)).collect();
        let Some(last) = old.last().copied() else { return };
        // Where that fails, they retire another time.
        if let Err(error) = self.use_up(stream, |used| used.retire(last)) {
            tracing::warn!(%error, %stream, "old versions stay for now");
            return;
        }
        for version in old {
            let versions = self.streams.get_mut(stream);
            let Some(record) = versions.and_then(|versions| versions.remove(&version)) else {
                continue;
            };
            let _ = self.disk.remove(&self.record_path(stream, version));
            if !self.references(&record.manifest.sha256) {
                let _ = self.disk.remove(&self.blob_path(&record.manifest.sha256));
            }
            self.forget_reports(stream, version);
        }
    }

    pub(crate) fn blob_path(&self, sha256: &[u8; 32]) -> PathBuf {
        self.root.join("blobs").join(format!("{}.onnx", hex(sha256)))
    }

    pub(crate) fn record_path(&self, stream: &StreamName, version: u64) -> PathBuf {
        self.root.join("streams").join(stream_folder(stream)).join(format!("{version:020}.json"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::manifest;

    fn open(folder: &tempfile::TempDir) -> Store {
        Store::open(folder.path(), StoreLimits::default()).unwrap()
    }

    fn name(stream: &str) -> StreamName {
        StreamName::new(stream).unwrap()
    }

    fn files_below(folder: &Path) -> usize {
        crate::files::entries(folder)
            .unwrap()
            .iter()
            .map(|path| if path.is_dir() { files_below(path) } else { 1 })
            .sum()
    }

    #[test]
    fn what_was_published_is_there_after_a_restart() {
        let folder = tempfile::tempdir().unwrap();
        let mut store = open(&folder);
        for version in 1..=3u64 {
            let bytes = version.to_le_bytes();
            let published = store.publish(manifest("polymander/flat", version, &bytes), &bytes);
            assert!(!published.unwrap().already_present);
        }
        drop(store);
        let mut store = open(&folder);
        assert_eq!(store.generation(), 3);
        let newest = store.newest(&name("polymander/flat")).unwrap().clone();
        assert_eq!(newest.manifest.version, 3);
        let bytes = store.read_blob(&newest.manifest.sha256).unwrap();
        assert_eq!(*bytes, 3u64.to_le_bytes());
    }

    #[test]
    fn publishing_again_is_idempotent_and_other_bytes_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        let mut store = open(&folder);
        let first = store.publish(manifest("s", 1, b"one"), b"one").unwrap();
        let again = store.publish(manifest("s", 1, b"one"), b"one").unwrap();
        assert!(again.already_present);
        assert_eq!(again.record, first.record);
        assert_eq!(store.generation(), 1);
        let error = store.publish(manifest("s", 1, b"two"), b"two").unwrap_err();
        assert!(matches!(error, StoreError::VersionTaken { .. }), "{error}");
        assert_eq!(files_below(&folder.path().join("blobs")), 1);
    }

    #[test]
    fn bytes_that_do_not_match_the_header_leave_no_trace() {
        let folder = tempfile::tempdir().unwrap();
        let mut store = open(&folder);
        let error = store.publish(manifest("s", 1, b"one"), b"other").unwrap_err();
        assert!(matches!(error, StoreError::HashMismatch { .. }));
        assert_eq!(files_below(&folder.path().join("blobs")), 0);
        assert_eq!(files_below(&folder.path().join("streams")), 0);
    }

    #[test]
    fn another_contract_is_refused_on_the_same_stream_only() {
        let folder = tempfile::tempdir().unwrap();
        let mut store = open(&folder);
        store.publish(manifest("s", 1, b"one"), b"one").unwrap();
        let mut other = manifest("s", 2, b"two");
        other.contract_hash = [8; 32];
        let error = store.publish(other.clone(), b"two").unwrap_err();
        assert!(matches!(error, StoreError::ContractMismatch { .. }));
        other.stream = name("t");
        store.publish(other, b"two").unwrap();
    }

    #[test]
    fn a_crash_between_blob_and_record_leaves_nothing_visible_and_no_residue() {
        let folder = tempfile::tempdir().unwrap();
        let store = open(&folder);
        let blob = store.blob_path(&[1; 32]);
        fs::write(&blob, b"blob whose record was never written").unwrap();
        fs::write(blob.with_extension("onnx.1.partial"), b"torn").unwrap();
        drop(store);
        let store = open(&folder);
        assert_eq!(store.records(None).count(), 0);
        assert_eq!(files_below(&folder.path().join("blobs")), 0);
    }

    #[test]
    fn a_flipped_bit_is_found_and_only_that_version_goes() {
        let folder = tempfile::tempdir().unwrap();
        let mut store = open(&folder);
        for (version, bytes) in [(1, b"one"), (2, b"two")] {
            store.publish(manifest("s", version, bytes), bytes).unwrap();
        }
        let damaged = manifest("s", 2, b"two").sha256;
        fs::write(store.blob_path(&damaged), b"twp").unwrap();
        let error = store.read_blob(&damaged).unwrap_err();
        assert!(matches!(error, StoreError::Damaged { .. }), "{error}");
        assert_eq!(store.newest(&name("s")).unwrap().manifest.version, 1);
        let good = manifest("s", 1, b"one").sha256;
        assert_eq!(&*store.read_blob(&good).unwrap(), b"one");
        assert_eq!(files_below(&folder.path().join("damaged")), 2);
        drop(store);
        assert_eq!(open(&folder).records(None).count(), 1);
    }

    #[test]
    fn old_versions_retire_and_shared_blobs_stay() {
        let folder = tempfile::tempdir().unwrap();
        let limits = StoreLimits { versions_kept: 2, ..StoreLimits::default() };
        let mut store = Store::open(folder.path(), limits).unwrap();
        for (version, bytes) in [(1, b"aaa"), (2, b"bbb"), (3, b"aaa")] {
            store.publish(manifest("s", version, bytes), bytes).unwrap();
        }
        let versions: Vec<u64> = store.records(None).map(|r| r.manifest.version).collect();
        assert_eq!(versions, [3, 2]);
        assert_eq!(&*store.read_blob(&manifest("s", 3, b"aaa").sha256).unwrap(), b"aaa");
    }

    #[test]
    fn two_servers_cannot_share_a_folder() {
        let folder = tempfile::tempdir().unwrap();
        let _first = open(&folder);
        let error = Store::open(folder.path(), StoreLimits::default()).unwrap_err();
        assert!(error.to_string().contains("another policy server"), "{error}");
    }

    #[test]
    fn a_flipped_bit_in_a_record_takes_neither_its_blob_nor_its_number() {
        let folder = tempfile::tempdir().unwrap();
        let mut store = open(&folder);
        for (version, bytes) in [(1, b"one"), (2, b"two")] {
            store.publish(manifest("s", version, bytes), bytes).unwrap();
        }
        let path = store.record_path(&name("s"), 2);
        let blob = store.blob_path(&manifest("s", 2, b"two").sha256);
        drop(store);
        let mut text = fs::read(&path).unwrap();
        // A digit of its version: still JSON, and still a manifest that could be.
        let text_of = String::from_utf8(text.clone()).unwrap();
        text[text_of.find("\"version\": 2").unwrap() + 11] ^= 1;
        fs::write(&path, text).unwrap();
        for start in 0..2 {
            let mut store = open(&folder);
            assert_eq!(store.newest(&name("s")).unwrap().manifest.version, 1);
            assert!(blob.exists(), "start {start}");
            assert_eq!(store.damaged_files(), 1);
            let said: Vec<&str> = store.audit.newest(0).map(|e| e.what.as_str()).collect();
            assert_eq!(said, ["damaged", "publish", "publish"], "start {start}");
            for bytes in [b"two", b"six"] {
                let error = store.publish(manifest("s", 2, bytes), bytes).unwrap_err();
                assert!(matches!(error, StoreError::UsedUp { .. }), "{error}");
            }
            assert_eq!(store.generation(), 2);
        }
        open(&folder).publish(manifest("s", 3, b"six"), b"six").unwrap();
    }

    #[test]
    fn a_damaged_blob_comes_back_under_its_number_and_no_other_bytes_do() {
        let folder = tempfile::tempdir().unwrap();
        let mut store = open(&folder);
        store.publish(manifest("s", 1, b"one"), b"one").unwrap();
        fs::write(store.blob_path(&manifest("s", 1, b"one").sha256), b"on").unwrap();
        drop(store);
        let mut store = open(&folder);
        assert_eq!(store.records(None).count(), 0);
        let error = store.publish(manifest("s", 1, b"two"), b"two").unwrap_err();
        assert!(matches!(error, StoreError::UsedUp { .. }), "{error}");
        store.publish(manifest("s", 1, b"one"), b"one").unwrap();
        drop(store);
        assert_eq!(open(&folder).records(None).count(), 1);
    }

    #[test]
    fn a_second_damaged_file_does_not_take_the_place_of_the_first() {
        let folder = tempfile::tempdir().unwrap();
        let store = open(&folder);
        let path = folder.path().join("labels/s/stable.json");
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        for text in ["first", "second", "third"] {
            fs::write(&path, text).unwrap();
            store.set_aside(&path);
        }
        assert_eq!(store.damaged_files(), 3);
    }

    #[test]
    fn a_quarantine_takes_the_same_bytes_under_other_numbers_with_it() {
        let folder = tempfile::tempdir().unwrap();
        let mut store = Store::open(folder.path(), StoreLimits::default()).unwrap();
        // 3 is what a revert to 1 makes
        for (version, bytes) in [(1, b"bad"), (2, b"own"), (3, b"bad")] {
            store.publish(manifest("s", version, bytes), bytes).unwrap();
        }
        let out = caudata_proto::registry::QuarantineState {
            stream: name("s"),
            version: 1,
            reason: "falls".into(),
            by: String::new(),
            generation: 0,
            unix_ms: 0,
        };
        let said = store.quarantine(&Origin::local(), out).unwrap();
        assert_eq!((said.version, said.reason.as_str()), (1, "falls"));
        for _start in 0..2 {
            let gone = [1, 2, 3].map(|version| store.is_quarantined(&name("s"), version));
            assert_eq!(gone, [true, false, true]);
            assert_eq!(store.newest_usable(&name("s")).map(|r| r.manifest.version), Some(2));
            let why = store.quarantines().find(|q| q.version == 3).unwrap().reason.clone();
            assert_eq!(why, "the bytes of version 1: falls");
            drop(store);
            store = Store::open(folder.path(), StoreLimits::default()).unwrap();
        }
    }

    #[test]
    fn numbers_of_retired_versions_and_quarantined_bytes_never_come_back() {
        let folder = tempfile::tempdir().unwrap();
        let limits = StoreLimits { versions_kept: 2, ..StoreLimits::default() };
        let mut store = Store::open(folder.path(), limits).unwrap();
        store.publish(manifest("s", 1, b"bad"), b"bad").unwrap();
        let out = |version| caudata_proto::registry::QuarantineState {
            stream: name("s"),
            version,
            reason: "falls".into(),
            by: String::new(),
            generation: 0,
            unix_ms: 0,
        };
        store.quarantine(&Origin::local(), out(1)).unwrap();
        let error = store.publish(manifest("s", 1, b"bad"), b"bad").unwrap_err();
        assert!(matches!(error, StoreError::NotAllowed { .. }), "{error}");
        for (version, bytes) in [(2, b"two"), (3, b"thr"), (4, b"fou")] {
            store.publish(manifest("s", version, bytes), bytes).unwrap();
        }
        assert!(store.find(&name("s"), 1).is_none(), "it retired");
        for start in 0..2 {
            assert!(store.is_quarantined(&name("s"), 1), "start {start}");
            for (version, bytes) in [(1, b"bad"), (5, b"bad"), (1, b"new"), (2, b"new")] {
                let error = store.publish(manifest("s", version, bytes), bytes);
                let error = error.unwrap_err();
                assert!(
                    matches!(error, StoreError::UsedUp { .. } | StoreError::NotAllowed { .. }),
                    "{version} {error}"
                );
            }
            drop(store);
            store = Store::open(folder.path(), limits).unwrap();
        }
        // A robot may still hold what retired, and hears that it is out of use; what never was is no version.
        store.quarantine(&Origin::local(), out(2)).unwrap();
        let error = store.quarantine(&Origin::local(), out(9)).unwrap_err();
        assert!(matches!(error, StoreError::NotFound { .. }), "{error}");
        drop(store);
        let store = Store::open(folder.path(), limits).unwrap();
        assert!(store.is_quarantined(&name("s"), 2));
        // Nor where the file that says so is damaged.
        drop(store);
        fs::write(folder.path().join("used_up/s.json"), "{").unwrap();
        let mut store = Store::open(folder.path(), limits).unwrap();
        let error = store.publish(manifest("s", 2, b"new"), b"new").unwrap_err();
        assert!(matches!(error, StoreError::UsedUp { .. }), "{error}");
        store.publish(manifest("s", 5, b"new"), b"new").unwrap();
    }

    #[test]
    fn who_fetches_at_the_same_time_shares_the_bytes() {
        let folder = tempfile::tempdir().unwrap();
        let mut store = open(&folder);
        store.publish(manifest("s", 1, b"one"), b"one").unwrap();
        let sha256 = manifest("s", 1, b"one").sha256;
        let (a, b) = (store.read_blob(&sha256).unwrap(), store.read_blob(&sha256));
        assert!(Arc::ptr_eq(&a, &b.unwrap()));
    }

    #[test]
    fn a_robot_that_says_too_much_does_not_fill_the_record() {
        use caudata_proto::registry::{RobotReport, RobotState};
        let folder = tempfile::tempdir().unwrap();
        let mut store = open(&folder);
        store.publish(manifest("s", 1, b"one"), b"one").unwrap();
        let mut written = 0;
        for attempts in 0..500 {
            let report = RobotReport {
                robot: "robot-1".into(),
                stream: name("s"),
                version: 1,
                sha256: manifest("s", 1, b"one").sha256,
                state: RobotState::Trial,
                reason: String::new(),
                walked_s: 1.0,
                falls: 0,
                attempts,
                unix_ms: 0,
            };
            match store.report(&Origin::local(), report) {
                Ok(_) => written += 1,
                Err(error) => assert!(matches!(error, StoreError::Full { .. }), "{error}"),
            }
        }
        // A few more where the machine takes seconds for this.
        assert!((60..200).contains(&written), "{written}");
    }

    #[test]
    fn a_damaged_record_is_set_aside_and_the_rest_served() {
        let folder = tempfile::tempdir().unwrap();
        let mut store = open(&folder);
        for (version, bytes) in [(1, b"one"), (2, b"two")] {
            store.publish(manifest("s", version, bytes), bytes).unwrap();
        }
        let path = store.record_path(&name("s"), 2);
        drop(store);
        fs::write(&path, b"{ torn").unwrap();
        let store = open(&folder);
        assert_eq!(store.newest(&name("s")).unwrap().manifest.version, 1);
        assert_eq!(files_below(&folder.path().join("damaged")), 1);
    }
}
