//! The store on disk: blobs named by their SHA-256, one small record per published version, and what people and robots say of it.
//!
//! ```text
//! <data>/blobs/<sha256>.onnx                 written once, never changed
//! <data>/streams/<stream>/<version>.json     makes a version visible; written after its blob is on disk
//! <data>/labels/<stream>/<label>.json        where a label leads
//! <data>/quarantine/<stream>/<version>.json  a version out of use
//! <data>/reports/<stream>/<version>.json     what robots said about it
//! <data>/audit.jsonl                         who changed what; a line is there before its change
//! <data>/damaged/                            what was found damaged, set aside for a person to look at
//! ```
//!
//! *Invariant:* a version is whole or absent, and so is every other change. The file that makes it visible is written last and
//! atomically, so a crash at any point leaves at most an unreferenced blob and an announcement, which the next start removes
//! and takes back.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use caudata_durable::{Disk, OsDisk};
use caudata_proto::registry::{LabelName, LabelState, Manifest, QuarantineState, StreamName};
use sha2::{Digest, Sha256};

use crate::audit::{AuditLog, Deed, Origin};
use crate::error::StoreError;
use crate::notes::Reports;
use crate::record::{Record, RecordError};
use crate::steps::Step;

/// Limits of the store.
#[derive(Clone, Copy, Debug)]
pub struct StoreLimits {
    /// Streams at most; protects the disk from a publisher that invents names.
    pub streams_max: usize,
    /// Versions kept per stream, newest first; older ones are removed after each publication. Too small: robots that
    /// were offline find their version gone; too large: disk (about 0.2 MB each for a 128-128 network).
    pub versions_kept: usize,
    /// Robots that must have run a version through its trial before `stable` may lead to it. 0: none. Too small: one lucky walk
    /// makes a policy everybody's; too large: a small lab never gets there without an override.
    pub stable_needs: usize,
}

impl Default for StoreLimits {
    fn default() -> Self {
        Self {
            streams_max: 256,
            versions_kept: 64,
            stable_needs: 1,
        }
    }
}

/// Labels of one stream at most.
pub const LABELS_MAX: usize = 32;

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
    streams: BTreeMap<StreamName, BTreeMap<u64, Record>>,
    pub(crate) labels: BTreeMap<(StreamName, LabelName), LabelState>,
    pub(crate) quarantined: BTreeMap<(StreamName, u64), QuarantineState>,
    pub(crate) reports: BTreeMap<(StreamName, u64), Reports>,
    audit: AuditLog,
    read_only: Option<String>,
    _lock: fs::File,
}

impl Store {
    /// Opens the store at `root`, makes it where it is absent, and repairs what a crash left: temporary files and
    /// unreferenced blobs are removed, records whose blob is missing or of another size are set aside.
    ///
    /// # Errors
    /// [`StoreError::Unusable`] where the folder cannot be made, is locked by another server, or holds a newer format.
    pub fn open(root: &Path, limits: StoreLimits) -> Result<Self, StoreError> {
        fs::create_dir_all(root).map_err(|error| unusable(root, &error.to_string()))?;
        Self::open_on(root, limits, Arc::new(OsDisk))
    }

    /// As [`Store::open`], on a disk that may be a rehearsed one. `root` must be there.
    ///
    /// # Errors
    /// As [`Store::open`].
    pub fn open_on(
        root: &Path,
        limits: StoreLimits,
        disk: Arc<dyn Disk>,
    ) -> Result<Self, StoreError> {
        for folder in FOLDERS {
            caudata_durable::make_folder_on(&*disk, &root.join(folder))
                .map_err(|error| unusable(root, &format!("cannot make {folder}/: {error}")))?;
        }
        let lock = lock(root)?;
        let mut store = Self {
            root: root.to_path_buf(),
            limits,
            audit: AuditLog::open(root, disk.clone())?,
            disk,
            generation: 0,
            streams: BTreeMap::new(),
            labels: BTreeMap::new(),
            quarantined: BTreeMap::new(),
            reports: BTreeMap::new(),
            read_only: None,
            _lock: lock,
        };
        store.load_records()?;
        store.load_notes()?;
        store.remove_unreferenced()?;
        store.take_back_what_did_not_happen()?;
        Ok(store)
    }

    /// The last line of the record may announce what a crash prevented.
    fn take_back_what_did_not_happen(&mut self) -> Result<(), StoreError> {
        let Some((_, generation)) = self.audit.announced() else {
            return Ok(());
        };
        if self
            .changes()
            .any(|change| change.generation() == generation)
        {
            return Ok(());
        }
        tracing::warn!(generation, "the last announced change did not happen");
        // A change without a trace must not give its number to another one that watchers then miss.
        self.generation = self.generation.max(generation);
        self.audit.write_undone("the server ended before")
    }

    /// Its folder.
    #[must_use]
    pub fn root(&self) -> &Path {
        &self.root
    }

    /// Why nothing can be changed at present; `None`: it can.
    #[must_use]
    pub fn read_only(&self) -> Option<&str> {
        self.read_only.as_deref()
    }

    pub(crate) fn check_writable(&self) -> Result<(), StoreError> {
        match &self.read_only {
            None => Ok(()),
            Some(reason) => Err(StoreError::ReadOnly {
                reason: reason.clone(),
            }),
        }
    }

    /// After a failed sync nobody knows what is on the disk: nothing is changed any more, and nothing is tried again.
    pub(crate) fn heed<T>(&mut self, result: Result<T, StoreError>) -> Result<T, StoreError> {
        if let Err(StoreError::Durable(error)) = &result
            && error.is_sync_failure()
        {
            tracing::error!(%error, "the store is read-only from now on");
            self.read_only.get_or_insert(error.to_string());
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
        if let Err(error) = &result
            && self.read_only.is_none()
        {
            // The next start does it otherwise.
            let undone = self.audit.write_undone(&first_words(&error.to_string()));
            if let Err(error) = self.heed(undone) {
                tracing::error!(%error, "the record says more than happened until it can be written again");
            }
        }
        result
    }

    /// The record of changes.
    pub(crate) fn audit(&self) -> &AuditLog {
        &self.audit
    }

    /// Publishes `bytes` as `manifest.stream` version `manifest.version`.
    ///
    /// Idempotent: the same version with the same bytes answers with the record that is there.
    ///
    /// # Errors
    /// [`StoreError::VersionTaken`], [`StoreError::HashMismatch`], [`StoreError::ContractMismatch`],
    /// [`StoreError::TooManyStreams`], or [`StoreError::Durable`] (disk full); nothing becomes visible then.
    pub fn publish(&mut self, manifest: Manifest, bytes: &[u8]) -> Result<Published, StoreError> {
        self.publish_by(&Origin::local(), "publish", "", manifest, bytes)
    }

    /// As [`Store::publish`], for the record: by whom, as what (`publish`, `revert`), with which words.
    ///
    /// # Errors
    /// As [`Store::publish`]; [`StoreError::NotAllowed`] for bytes that are quarantined, [`StoreError::ReadOnly`].
    pub fn publish_by(
        &mut self,
        origin: &Origin,
        what: &str,
        words: &str,
        manifest: Manifest,
        bytes: &[u8],
    ) -> Result<Published, StoreError> {
        let actual: [u8; 32] = Sha256::digest(bytes).into();
        if Step::Hash.on() && actual != manifest.sha256 {
            return Err(StoreError::HashMismatch {
                announced: hex(&manifest.sha256),
                actual: hex(&actual),
            });
        }
        if let Some(record) = self.find(&manifest.stream, manifest.version) {
            return if record.manifest.sha256 == manifest.sha256 {
                Ok(Published {
                    record: record.clone(),
                    already_present: true,
                })
            } else {
                Err(StoreError::VersionTaken {
                    stored: hex(&record.manifest.sha256),
                    stream: manifest.stream.to_string(),
                    version: manifest.version,
                })
            };
        }
        self.check_stream(&manifest)?;
        self.check_not_quarantined(&manifest)?;
        let record = Record {
            generation: self.generation + 1,
            manifest,
        };
        let stream = record.manifest.stream.clone();
        let deed = Deed {
            what,
            stream: stream.as_str(),
            version: record.manifest.version,
            generation: Some(record.generation),
            detail: format!("sha256 {} {words}", hex(&actual))
                .trim_end()
                .to_owned(),
        };
        self.announced(origin, &deed, |store| {
            store.write_blob(&actual, bytes)?;
            store.write_record(&record).inspect_err(|_| {
                if !store.references(&actual) {
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
        Ok(Published {
            record,
            already_present: false,
        })
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
    #[must_use]
    pub fn newest(&self, stream: &StreamName) -> Option<&Record> {
        self.streams.get(stream)?.values().next_back()
    }

    /// The newest version of a stream that is not quarantined; where `latest` leads.
    #[must_use]
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
    #[must_use]
    pub fn generation(&self) -> u64 {
        self.generation
    }

    /// The bytes under a hash, verified. A file that no longer matches its name is set aside.
    ///
    /// # Errors
    /// [`StoreError::NotFound`], [`StoreError::Damaged`].
    pub fn read_blob(&mut self, sha256: &[u8; 32]) -> Result<Vec<u8>, StoreError> {
        let path = self.blob_path(sha256);
        let referenced = self.references(sha256);
        let bytes = match fs::read(&path) {
            Ok(bytes) if referenced => bytes,
            _ => {
                return Err(StoreError::NotFound {
                    what: format!("blob {}", hex(sha256)),
                });
            }
        };
        if !Step::StoredHash.on() || <[u8; 32]>::from(Sha256::digest(&bytes)) == *sha256 {
            return Ok(bytes);
        }
        self.set_aside(&path);
        self.forget_blob(sha256);
        Err(StoreError::Damaged { path })
    }

    fn references(&self, sha256: &[u8; 32]) -> bool {
        self.streams
            .values()
            .flat_map(BTreeMap::values)
            .any(|record| record.manifest.sha256 == *sha256)
    }

    pub(crate) fn find(&self, stream: &StreamName, version: u64) -> Option<&Record> {
        self.streams.get(stream)?.get(&version)
    }

    fn check_stream(&self, manifest: &Manifest) -> Result<(), StoreError> {
        match self.newest(&manifest.stream) {
            Some(newest)
                if Step::Contract.on()
                    && newest.manifest.contract_hash != manifest.contract_hash =>
            {
                Err(StoreError::ContractMismatch {
                    stream: manifest.stream.to_string(),
                    expected: hex(&newest.manifest.contract_hash),
                    actual: hex(&manifest.contract_hash),
                })
            }
            None if self.streams.len() >= self.limits.streams_max => {
                Err(StoreError::TooManyStreams {
                    limit: self.limits.streams_max,
                })
            }
            _ => Ok(()),
        }
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
        let text = record
            .to_json()
            .map_err(|error| unusable(&path, &error.to_string()))?;
        Ok(caudata_durable::create_new_on(&*self.disk, &path, &text)?)
    }

    pub(crate) fn make_folder_of(&self, path: &Path) -> Result<(), StoreError> {
        let folder = path.parent().unwrap_or(&self.root);
        Ok(caudata_durable::make_folder_on(&*self.disk, folder)?)
    }

    fn load_records(&mut self) -> Result<(), StoreError> {
        let streams = self.root.join("streams");
        for folder in entries(&streams)? {
            if !folder.is_dir() {
                continue;
            }
            caudata_durable::remove_leftovers(&folder)?;
            for path in entries(&folder)? {
                self.load_record(&path)?;
            }
        }
        Ok(())
    }

    fn load_record(&mut self, path: &Path) -> Result<(), StoreError> {
        let bytes = fs::read(path).map_err(|error| unusable(path, &error.to_string()))?;
        let record = match Record::from_json(&bytes) {
            Ok(record) => record,
            Err(error @ RecordError::Format { .. }) => {
                return Err(unusable(path, &error.to_string()));
            }
            Err(error) => {
                tracing::warn!(path = %path.display(), %error, "record unreadable, set aside");
                self.set_aside(path);
                return Ok(());
            }
        };
        self.generation = self.generation.max(record.generation);
        let blob = self.blob_path(&record.manifest.sha256);
        let size = fs::metadata(&blob).map(|meta| meta.len()).ok();
        if size != Some(record.manifest.size) {
            tracing::warn!(path = %path.display(), "blob missing or of another size, version set aside");
            self.set_aside(path);
            return Ok(());
        }
        self.streams
            .entry(record.manifest.stream.clone())
            .or_default()
            .insert(record.manifest.version, record);
        Ok(())
    }

    /// Removes temporary files and blobs that no record names (a crash between blob and record).
    fn remove_unreferenced(&mut self) -> Result<(), StoreError> {
        let folder = self.root.join("blobs");
        caudata_durable::remove_leftovers(&folder)?;
        let named: BTreeSet<PathBuf> = self
            .records(None)
            .map(|record| self.blob_path(&record.manifest.sha256))
            .collect();
        for path in entries(&folder)? {
            if !named.contains(&path) {
                let _ = self.disk.remove(&path);
            }
        }
        Ok(())
    }

    /// Removes versions beyond the limit, unless a label leads there: the record first, so that no visible version ever lacks its blob.
    fn retire_old(&mut self, stream: &StreamName) {
        let held: BTreeSet<u64> = self
            .labels
            .values()
            .filter(|label| label.stream == *stream)
            .map(|label| label.version)
            .collect();
        let Some(versions) = self.streams.get_mut(stream) else {
            return;
        };
        let beyond = versions
            .len()
            .saturating_sub(self.limits.versions_kept.max(1));
        // What a label leads to stays, however old.
        let old: Vec<u64> = versions.keys().copied().take(beyond).collect();
        let old = old.into_iter().filter(|version| !held.contains(version));
        let retired: Vec<Record> = old
            .filter_map(|version| versions.remove(&version))
            .collect();
        for record in retired {
            let version = record.manifest.version;
            let _ = self.disk.remove(&self.record_path(stream, version));
            if !self.references(&record.manifest.sha256) {
                let _ = self.disk.remove(&self.blob_path(&record.manifest.sha256));
            }
            self.forget_notes(stream, version);
        }
    }

    fn forget_blob(&mut self, sha256: &[u8; 32]) {
        let mut lost = Vec::new();
        for versions in self.streams.values_mut() {
            versions.retain(|_, record| {
                let keep = record.manifest.sha256 != *sha256;
                if !keep {
                    lost.push((record.manifest.stream.clone(), record.manifest.version));
                }
                keep
            });
        }
        self.streams.retain(|_, versions| !versions.is_empty());
        for (stream, version) in lost {
            tracing::error!(%stream, version, "blob damaged, version withdrawn");
            self.set_aside(&self.record_path(&stream, version));
        }
    }

    pub(crate) fn set_aside(&self, path: &Path) {
        let name = path
            .components()
            .rev()
            .take(2)
            .map(|part| part.as_os_str().to_string_lossy().into_owned())
            .collect::<Vec<_>>();
        let name = name.into_iter().rev().collect::<Vec<_>>().join("_");
        let _ = self
            .disk
            .rename(path, &self.root.join("damaged").join(name));
    }

    fn blob_path(&self, sha256: &[u8; 32]) -> PathBuf {
        self.root
            .join("blobs")
            .join(format!("{}.onnx", hex(sha256)))
    }

    fn record_path(&self, stream: &StreamName, version: u64) -> PathBuf {
        self.root
            .join("streams")
            .join(stream_folder(stream))
            .join(format!("{version:020}.json"))
    }
}

const FOLDERS: [&str; 6] = [
    "blobs",
    "streams",
    "labels",
    "quarantine",
    "reports",
    "damaged",
];

/// What fits into a line of the record.
fn first_words(text: &str) -> String {
    text.chars().filter(|c| !c.is_control()).take(200).collect()
}

/// Stream names may hold `/`; on disk that is `@`, which no stream name may hold.
pub(crate) fn stream_folder(stream: &StreamName) -> String {
    stream.as_str().replace('/', "@")
}

fn lock(root: &Path) -> Result<fs::File, StoreError> {
    let path = root.join("lock");
    let file = fs::File::create(&path).map_err(|error| unusable(root, &error.to_string()))?;
    file.try_lock().map_err(|_| {
        unusable(
            root,
            "another policy server holds its lock; stop it or choose another --data",
        )
    })?;
    Ok(file)
}

pub(crate) fn entries(folder: &Path) -> Result<Vec<PathBuf>, StoreError> {
    let listed = fs::read_dir(folder).map_err(|error| unusable(folder, &error.to_string()))?;
    let mut paths: Vec<PathBuf> = listed.flatten().map(|entry| entry.path()).collect();
    paths.sort();
    Ok(paths)
}

pub(crate) fn unusable(path: &Path, reason: &str) -> StoreError {
    StoreError::Unusable {
        path: path.to_path_buf(),
        reason: reason.to_owned(),
    }
}

/// Lower-case hexadecimal.
#[must_use]
pub fn hex(bytes: &[u8]) -> String {
    use std::fmt::Write;
    bytes.iter().fold(String::new(), |mut text, byte| {
        let _ = write!(text, "{byte:02x}");
        text
    })
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
        entries(folder)
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
        assert_eq!(bytes, 3u64.to_le_bytes());
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
        let error = store
            .publish(manifest("s", 1, b"one"), b"other")
            .unwrap_err();
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
        assert_eq!(store.read_blob(&good).unwrap(), b"one");
        assert_eq!(files_below(&folder.path().join("damaged")), 2);
        drop(store);
        assert_eq!(open(&folder).records(None).count(), 1);
    }

    #[test]
    fn old_versions_retire_and_shared_blobs_stay() {
        let folder = tempfile::tempdir().unwrap();
        let limits = StoreLimits {
            versions_kept: 2,
            ..StoreLimits::default()
        };
        let mut store = Store::open(folder.path(), limits).unwrap();
        for (version, bytes) in [(1, b"aaa"), (2, b"bbb"), (3, b"aaa")] {
            store.publish(manifest("s", version, bytes), bytes).unwrap();
        }
        let versions: Vec<u64> = store.records(None).map(|r| r.manifest.version).collect();
        assert_eq!(versions, [3, 2]);
        assert_eq!(
            store.read_blob(&manifest("s", 3, b"aaa").sha256).unwrap(),
            b"aaa"
        );
    }

    #[test]
    fn two_servers_cannot_share_a_folder() {
        let folder = tempfile::tempdir().unwrap();
        let _first = open(&folder);
        let error = Store::open(folder.path(), StoreLimits::default()).unwrap_err();
        assert!(
            error.to_string().contains("another policy server"),
            "{error}"
        );
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
