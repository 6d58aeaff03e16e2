//! Opening a store, what a crash or damage left of it, and how it comes back after the disk failed.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use caudata_durable::{Disk, OsDisk, Owner, OwnerError};
use caudata_proto::registry::{LabelState, QuarantineState};
use caudata_proto::wire::registry as wire;

use crate::audit::AuditLog;
use crate::damage::Damage;
use crate::error::{RecordError, StoreError};
use crate::files::{entries, files_below, read, unusable, version_of};
use crate::labels::Change;
use crate::notes::{QuarantineFile, Quarantined, Reports, ReportsFile, UsedUpFile};
use crate::record::Record;
use crate::store::{Store, StoreLimits};

const FOLDERS: [&str; 7] =
    ["blobs", "streams", "labels", "quarantine", "reports", "used_up", "damaged"];

impl Store {
    /// Opens the store at `root`, makes it where it is absent, and repairs what a crash left: temporary files
    /// and unreferenced blobs are removed, damaged records and those whose blob is missing or of another size
    /// are set aside.
    ///
    /// # Errors
    /// [`StoreError::Unusable`] where the folder cannot be made, is locked by another server, or holds a
    /// newer format.
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
        let lock = Arc::new(lock(root)?);
        Self::load(root, limits, disk, lock)
    }

    fn load(
        root: &Path,
        limits: StoreLimits,
        disk: Arc<dyn Disk>,
        lock: Arc<Owner>,
    ) -> Result<Self, StoreError> {
        caudata_durable::remove_leftovers(root)?;
        let mut store = Self {
            root: root.to_path_buf(),
            limits,
            audit: AuditLog::open(root, disk.clone())?,
            disk,
            generation: 0,
            streams: Default::default(),
            labels: Default::default(),
            quarantined: Default::default(),
            used_up: Default::default(),
            reports: Default::default(),
            quota: Default::default(),
            trouble: None,
            held: Default::default(),
            lock,
        };
        store.generation = store.audit.generation();
        let mut damaged = Vec::new();
        store.load_used_up(&mut damaged)?;
        for path in files_below(&store.root.join("streams"))? {
            store.load_record(&path, &mut damaged)?;
        }
        store.load_notes(&mut damaged)?;
        store.guess_used_up(&damaged);
        store.remove_unreferenced()?;
        store.take_back_what_did_not_happen(&damaged)?;
        store.write_down_damage(&damaged);
        Ok(store)
    }

    /// Looks whether the disk takes changes again after it refused one, and goes on if so; answers the
    /// changes that show by now although their makers were told that they failed.
    ///
    /// After a failed sync nobody knows what is on the disk. So it is made certain: the record is written
    /// anew, every folder is synced, and the store is read from the disk, as a restart would do it.
    ///
    /// # Errors
    /// What the disk says now.
    pub fn recover(&mut self) -> Result<Vec<Change>, StoreError> {
        let probe = self.root.join("probe");
        caudata_durable::replace_on(&*self.disk, &probe, b"can be written\n")?;
        let _ = self.disk.remove(&probe);
        if self.read_only().is_some() {
            self.audit.write_anew()?;
            for folder in FOLDERS {
                let folder = self.root.join(folder);
                for inner in entries(&folder)?.iter().filter(|path| path.is_dir()) {
                    caudata_durable::sync_folder_on(&*self.disk, inner)?;
                }
                caudata_durable::sync_folder_on(&*self.disk, &folder)?;
            }
            let (disk, lock) = (self.disk.clone(), self.lock.clone());
            let fresh = Self::load(&self.root, self.limits, disk, lock)?;
            let before = std::mem::replace(self, fresh);
            self.quota = before.quota;
            self.generation = self.generation.max(before.generation);
            tracing::info!("the store takes changes again");
            let new = |change: &Change| change.generation() > before.generation;
            return Ok(self.changes().filter(new).collect());
        }
        self.trouble = None;
        Ok(Vec::new())
    }

    /// The last line of the record may announce what a crash prevented.
    fn take_back_what_did_not_happen(&mut self, damaged: &[Damage]) -> Result<(), StoreError> {
        let Some((stream, generation)) = self.audit.announced() else { return Ok(()) };
        if self.changes().any(|c| c.generation() == generation) {
            return Ok(());
        }
        // It may well have happened: its file is among the damaged ones.
        if damaged.iter().any(|damage| damage.stream.as_str() == stream) {
            return Ok(());
        }
        tracing::warn!(generation, "the last announced change did not happen");
        self.audit.write_undone("the server ended before")
    }

    fn load_used_up(&mut self, damaged: &mut Vec<Damage>) -> Result<(), StoreError> {
        let folder = self.root.join("used_up");
        caudata_durable::remove_leftovers(&folder)?;
        for path in entries(&folder)? {
            match read::<UsedUpFile, _>(&path)? {
                Ok((stream, used_up)) => {
                    self.used_up.insert(stream, used_up);
                }
                Err(error) => damaged.extend(self.note_damage(&path, &error)),
            }
        }
        Ok(())
    }

    fn load_record(&mut self, path: &Path, damaged: &mut Vec<Damage>) -> Result<(), StoreError> {
        let bytes = fs::read(path).map_err(|error| unusable(path, &error.to_string()))?;
        let record = match Record::from_json(&bytes) {
            Ok(read) => read,
            Err(error @ RecordError::Format { .. }) => {
                return Err(unusable(path, &error.to_string()));
            }
            Err(error) => {
                damaged.extend(self.damaged_version(path, None, &error));
                return Ok(());
            }
        };
        self.generation = self.generation.max(record.generation);
        let manifest = &record.manifest;
        let blob = self.blob_path(&manifest.sha256);
        let size = match fs::metadata(&blob) {
            Ok(meta) => Some(meta.len()),
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => None,
            Err(error) => return Err(unusable(&blob, &error.to_string())),
        };
        if size != Some(manifest.size) {
            let why = "its blob is missing or of another size";
            let sha256 = Some(manifest.sha256);
            damaged.extend(self.damaged_version(path, sha256, &why));
            if size.is_some() {
                self.set_aside(&blob);
            }
            return Ok(());
        }
        self.streams.entry(manifest.stream.clone()).or_default().insert(manifest.version, record);
        Ok(())
    }

    /// Reads labels, quarantine and reports; a damaged file is set aside, but a damaged quarantine file still
    /// keeps its version out of use.
    fn load_notes(&mut self, damaged: &mut Vec<Damage>) -> Result<(), StoreError> {
        for path in files_below(&self.root.join("labels"))? {
            match read::<wire::LabelState, LabelState>(&path)? {
                Ok(state) => {
                    self.generation = self.generation.max(state.generation);
                    let key = (state.stream.clone(), state.label.clone());
                    self.labels.insert(key, state);
                }
                Err(error) => damaged.extend(self.note_damage(&path, &error)),
            }
        }
        for path in files_below(&self.root.join("quarantine"))? {
            self.load_quarantine(&path)?;
        }
        for path in files_below(&self.root.join("reports"))? {
            match read::<ReportsFile, Reports>(&path)? {
                Ok(reports) => {
                    if let Some(key) = version_of(&path) {
                        self.reports.insert(key, reports);
                    }
                }
                Err(error) => damaged.extend(self.note_damage(&path, &error)),
            }
        }
        Ok(())
    }

    fn load_quarantine(&mut self, path: &Path) -> Result<(), StoreError> {
        let mut quarantined = match read::<QuarantineFile, Quarantined>(path)? {
            Ok(read) => read,
            Err(error) => {
                // To forget it would let the version loose: the file's name says enough.
                tracing::error!(path = %path.display(), %error, "unreadable; its version stays out of use");
                let Some((stream, version)) = version_of(path) else { return Ok(()) };
                let state = QuarantineState {
                    stream,
                    version,
                    reason: "its quarantine file is damaged".to_owned(),
                    by: String::new(),
                    generation: 0,
                    unix_ms: 0,
                };
                let sha256 = None;
                Quarantined { state, sha256 }
            }
        };
        let state = &quarantined.state;
        let key = (state.stream.clone(), state.version);
        let record = self.find(&key.0, key.1);
        quarantined.sha256 = quarantined.sha256.or(record.map(|r| r.manifest.sha256));
        self.generation = self.generation.max(quarantined.state.generation);
        self.quarantined.insert(key, quarantined);
        Ok(())
    }

    /// Removes temporary files and blobs that no record names (a crash between blob and record). Where a
    /// record was found damaged, nobody knows whose blob it is: then all stay.
    fn remove_unreferenced(&mut self) -> Result<(), StoreError> {
        let folder = self.root.join("blobs");
        caudata_durable::remove_leftovers(&folder)?;
        let unknown = |used: &crate::notes::UsedUp| used.damaged.values().any(Option::is_none);
        if self.used_up.values().any(unknown) {
            return Ok(());
        }
        let named: BTreeSet<PathBuf> =
            self.records(None).map(|record| self.blob_path(&record.manifest.sha256)).collect();
        for path in entries(&folder)? {
            if !named.contains(&path) {
                let _ = self.disk.remove(&path);
            }
        }
        Ok(())
    }
}

fn lock(root: &Path) -> Result<Owner, StoreError> {
    Owner::now(&root.join("lock")).map_err(|error| match error {
        OwnerError::Taken { .. } => {
            unusable(root, "another policy server holds its lock; stop it or choose another --data")
        }
        OwnerError::Io { source, .. } => unusable(root, &source.to_string()),
    })
}
