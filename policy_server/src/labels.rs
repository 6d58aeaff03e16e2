//! Labels, quarantine, reverts and reports of the store.

use std::fs;
use std::path::{Path, PathBuf};

use caudata_proto::registry::{
    LabelName, LabelState, Manifest, QuarantineState, RobotReport, SetLabel, StreamName,
};
use serde::Serialize;
use serde::de::DeserializeOwned;

use crate::audit::{Deed, Origin};
use crate::error::StoreError;
use crate::notes::{LabelFile, QuarantineFile, Reports, ReportsFile};
use crate::record::{Record, RecordError};
use crate::steps::Step;
use crate::store::{LABELS_MAX, Published, Store, entries, stream_folder, unusable};

/// One change that counts, of those that still show.
#[derive(Clone, Debug)]
pub enum Change {
    /// A version was published.
    Published(Record),
    /// A label was moved.
    Label(LabelState),
    /// A version was taken out of use.
    Quarantined(QuarantineState),
}

impl Change {
    /// The change counter that it got.
    #[must_use]
    pub fn generation(&self) -> u64 {
        match self {
            Self::Published(record) => record.generation,
            Self::Label(label) => label.generation,
            Self::Quarantined(state) => state.generation,
        }
    }

    /// Its stream.
    #[must_use]
    pub fn stream(&self) -> &StreamName {
        match self {
            Self::Published(record) => &record.manifest.stream,
            Self::Label(label) => &label.stream,
            Self::Quarantined(state) => &state.stream,
        }
    }
}

impl Store {
    /// The changes that still show: a label shows its last one only.
    pub fn changes(&self) -> impl Iterator<Item = Change> + '_ {
        self.records(None)
            .cloned()
            .map(Change::Published)
            .chain(self.labels.values().cloned().map(Change::Label))
            .chain(self.quarantined.values().cloned().map(Change::Quarantined))
    }

    /// Whether a version is out of use.
    #[must_use]
    pub fn is_quarantined(&self, stream: &StreamName, version: u64) -> bool {
        self.quarantined.contains_key(&(stream.clone(), version))
    }

    /// Where `label` leads.
    ///
    /// # Errors
    /// [`StoreError::NotFound`] where it leads nowhere, or to a version that is out of use.
    pub fn labelled(&self, stream: &StreamName, label: &LabelName) -> Result<&Record, StoreError> {
        let found = if label.is_latest() {
            self.newest_usable(stream)
        } else {
            let state = self.labels.get(&(stream.clone(), label.clone()));
            state
                .filter(|state| !self.is_quarantined(stream, state.version))
                .and_then(|state| self.find(stream, state.version))
        };
        found.ok_or_else(|| StoreError::NotFound {
            what: format!("a version of {stream} under the label {label}"),
        })
    }

    /// All labels of `stream` (`None`: of all), `latest` first of each. One whose version is out of use is among them.
    #[must_use]
    pub fn labels(&self, stream: Option<&StreamName>) -> Vec<LabelState> {
        let wanted = |name: &&StreamName| stream.is_none_or(|s| s == *name);
        self.stream_names()
            .filter(wanted)
            .flat_map(|name| {
                let latest = self.newest_usable(name).map(|record| LabelState {
                    stream: name.clone(),
                    label: LabelName::latest(),
                    version: record.manifest.version,
                    generation: 0,
                    by: String::new(),
                    override_reason: None,
                    unix_ms: record.manifest.created_unix_ms,
                });
                let own = self.labels.values().filter(move |l| l.stream == *name);
                latest.into_iter().chain(own.cloned())
            })
            .collect()
    }

    /// Moves a label, where it is still as the caller knows it.
    ///
    /// # Errors
    /// [`StoreError::LabelMoved`], [`StoreError::NotAllowed`], [`StoreError::TooManyLabels`], [`StoreError::ReadOnly`]; what the disk says.
    pub fn set_label(
        &mut self,
        origin: &Origin,
        wanted: SetLabel,
    ) -> Result<LabelState, StoreError> {
        let key = (wanted.stream.clone(), wanted.label.clone());
        let before = self.labels.get(&key);
        let found = before.map_or(0, |state| state.generation);
        if Step::LabelMoved.on() && found != wanted.expected_generation {
            return Err(StoreError::LabelMoved {
                stream: wanted.stream.to_string(),
                label: wanted.label.to_string(),
                found,
                expected: wanted.expected_generation,
            });
        }
        let from = before.map(|state| state.version);
        self.check_label(&wanted, from)?;
        let state = LabelState {
            generation: self.generation + 1,
            by: origin.by.clone(),
            unix_ms: origin.unix_ms,
            override_reason: wanted.override_reason,
            stream: wanted.stream,
            label: wanted.label,
            version: wanted.version,
        };
        let from = from.map_or("nothing".to_owned(), |version| version.to_string());
        let mut detail = format!("{} from {from} to {}", state.label, state.version);
        if let Some(reason) = &state.override_reason {
            detail = format!("{detail}, overridden: {reason}");
        }
        let deed = Deed {
            what: "label",
            stream: state.stream.as_str(),
            version: state.version,
            generation: Some(state.generation),
            detail: clipped(detail),
        };
        let path = self.label_path(&state.stream, &state.label);
        self.announced(origin, &deed, |store| {
            store.write_note(&path, &LabelFile::from(&state))
        })?;
        self.generation = state.generation;
        self.labels.insert(key, state.clone());
        Ok(state)
    }

    fn check_label(&self, wanted: &SetLabel, from: Option<u64>) -> Result<(), StoreError> {
        let (stream, label, version) = (&wanted.stream, &wanted.label, wanted.version);
        let refused = |reason: String| Err(StoreError::NotAllowed { reason });
        if label.is_latest() {
            return refused(
                "`latest` moves by itself; publish, or quarantine what is newest".into(),
            );
        }
        if Step::LabelKnown.on() && self.find(stream, version).is_none() {
            return refused(format!(
                "{stream} has no version {version} that a label could lead to"
            ));
        }
        if Step::LabelUsable.on() && self.is_quarantined(stream, version) {
            return refused(format!("{stream} version {version} is quarantined"));
        }
        if let Some(from) = from.filter(|from| Step::LabelUp.on() && *from > version) {
            return refused(format!(
                "{label} leads to version {from}, and robots never go back to a lower one; `caudata policy revert` publishes \
                 version {version} again under a higher number"
            ));
        }
        let good = self.good_reports(stream, version);
        let needed = self.limits.stable_needs;
        let unproved = label.needs_proof() && good < needed && wanted.override_reason.is_none();
        if Step::LabelProof.on() && unproved {
            return refused(format!(
                "{good} robots ran {stream} version {version} through its trial, {label} needs {needed}; let robots follow another \
                 label first, or give a reason to override"
            ));
        }
        let labels = self.labels.keys().filter(|(of, _)| of == stream).count();
        if from.is_none() && labels >= LABELS_MAX {
            return Err(StoreError::TooManyLabels {
                stream: stream.to_string(),
                limit: LABELS_MAX,
            });
        }
        Ok(())
    }

    /// Robots that said that a version went through its trial.
    #[must_use]
    pub fn good_reports(&self, stream: &StreamName, version: u64) -> usize {
        let reports = self.reports.get(&(stream.clone(), version));
        reports.map_or(0, Reports::good)
    }

    /// Takes a version out of use for good. Answers what stands there where it is out of use already.
    ///
    /// # Errors
    /// [`StoreError::NotFound`], [`StoreError::ReadOnly`]; what the disk says.
    pub fn quarantine(
        &mut self,
        origin: &Origin,
        mut state: QuarantineState,
    ) -> Result<QuarantineState, StoreError> {
        let key = (state.stream.clone(), state.version);
        if let Some(known) = self.quarantined.get(&key) {
            return Ok(known.clone());
        }
        self.manifest(&state.stream, Some(state.version))?;
        state.by = origin.by.clone();
        state.unix_ms = origin.unix_ms;
        state.generation = self.generation + 1;
        let deed = Deed {
            what: "quarantine",
            stream: state.stream.as_str(),
            version: state.version,
            generation: Some(state.generation),
            detail: clipped(state.reason.clone()),
        };
        let path = self.note_path("quarantine", &state.stream, state.version);
        self.announced(origin, &deed, |store| {
            store.write_note(&path, &QuarantineFile::from(&state))
        })?;
        self.generation = state.generation;
        self.quarantined.insert(key, state.clone());
        Ok(state)
    }

    /// Bytes that are out of use under one number must not come back under another.
    pub(crate) fn check_not_quarantined(&self, manifest: &Manifest) -> Result<(), StoreError> {
        let same = |state: &&QuarantineState| {
            let record = self.find(&manifest.stream, state.version);
            state.stream == manifest.stream
                && record.is_some_and(|r| r.manifest.sha256 == manifest.sha256)
        };
        let found = self.quarantined.values().find(same);
        match found.filter(|_| Step::QuarantinedBytes.on()) {
            None => Ok(()),
            Some(state) => Err(StoreError::NotAllowed {
                reason: format!(
                    "these bytes are version {} of {}, which is quarantined: {}",
                    state.version, state.stream, state.reason
                ),
            }),
        }
    }

    /// Publishes the bytes of an older version again, as `manifest` says.
    ///
    /// # Errors
    /// As [`Store::publish_by`]; [`StoreError::NotFound`] where the old version is gone, [`StoreError::NotAllowed`] where the manifest is not
    /// one of it or the number not the highest.
    pub fn revert(
        &mut self,
        origin: &Origin,
        manifest: Manifest,
        reason: &str,
    ) -> Result<Published, StoreError> {
        let refused = |reason: String| Err(StoreError::NotAllowed { reason });
        let stream = manifest.stream.clone();
        let old = manifest.reverts_to.unwrap_or_default();
        let same = |record: &&Record| {
            let known = &record.manifest;
            known.sha256 == manifest.sha256 && known.reverts_to.unwrap_or(known.version) == old
        };
        let Some(known) = self.records(Some(&stream)).find(same) else {
            return Err(StoreError::NotFound {
                what: format!("{stream} version {old} with these bytes"),
            });
        };
        if known.manifest.contract_hash != manifest.contract_hash
            || known.manifest.robot_hash != manifest.robot_hash
        {
            return refused(format!(
                "the announcement is not one of {stream} version {old}"
            ));
        }
        let newest = self.newest(&stream).map_or(0, |r| r.manifest.version);
        let again = self.find(&stream, manifest.version).is_some();
        if manifest.version <= newest && !again {
            return refused(format!(
                "version {} is not above {newest}, the newest of {stream}",
                manifest.version
            ));
        }
        let bytes = self.read_blob(&manifest.sha256)?;
        let words = clipped(format!("version {old} again: {reason}"));
        self.publish_by(origin, "revert", &words, manifest, &bytes)
    }

    /// Keeps what a robot says about a version. True where it is news.
    ///
    /// # Errors
    /// [`StoreError::NotFound`] for a version that is not here, or has other bytes; [`StoreError::ReadOnly`]; what the disk says.
    pub fn report(&mut self, origin: &Origin, mut report: RobotReport) -> Result<bool, StoreError> {
        let record = self.manifest(&report.stream, Some(report.version))?;
        if record.manifest.sha256 != report.sha256 {
            return Err(StoreError::NotFound {
                what: format!(
                    "{} version {} with these bytes",
                    report.stream, report.version
                ),
            });
        }
        let key = (report.stream.clone(), report.version);
        let before = self.reports.get(&key).cloned().unwrap_or_default();
        let known = before.0.get(&report.robot);
        let same = |known: &RobotReport| {
            let (a, b) = (known, &report);
            a.state == b.state
                && a.reason == b.reason
                && a.attempts == b.attempts
                && a.falls == b.falls
        };
        if known.is_some_and(same) {
            return Ok(false);
        }
        report.unix_ms = origin.unix_ms;
        let what = if report.state.went_well() {
            "ack"
        } else {
            "nack"
        };
        let words = format!("{} {} {}", report.robot, report.state.word(), report.reason);
        let deed = Deed {
            what,
            stream: report.stream.as_str(),
            version: report.version,
            generation: None,
            detail: clipped(words.trim_end().to_owned()),
        };
        let path = self.note_path("reports", &report.stream, report.version);
        let next = before.with(report.clone());
        self.announced(origin, &deed, |store| {
            store.write_note(&path, &ReportsFile::from(&next))
        })?;
        self.reports.insert(key, next);
        Ok(true)
    }

    fn write_note(&self, path: &Path, note: &impl Serialize) -> Result<(), StoreError> {
        self.make_folder_of(path)?;
        let text =
            serde_json::to_vec_pretty(note).map_err(|error| unusable(path, &error.to_string()))?;
        Ok(caudata_durable::replace_on(&*self.disk, path, &text)?)
    }

    fn label_path(&self, stream: &StreamName, label: &LabelName) -> PathBuf {
        let folder = self.root.join("labels").join(stream_folder(stream));
        folder.join(format!("{label}.json"))
    }

    fn note_path(&self, kind: &str, stream: &StreamName, version: u64) -> PathBuf {
        let folder = self.root.join(kind).join(stream_folder(stream));
        folder.join(format!("{version:020}.json"))
    }

    /// Forgets what was said about a version that is gone.
    pub(crate) fn forget_notes(&mut self, stream: &StreamName, version: u64) {
        let key = (stream.clone(), version);
        for (kind, known) in [
            ("quarantine", self.quarantined.remove(&key).is_some()),
            ("reports", self.reports.remove(&key).is_some()),
        ] {
            if known {
                let _ = self.disk.remove(&self.note_path(kind, stream, version));
            }
        }
    }

    /// Reads labels, quarantine and reports; a damaged file is set aside, but a damaged quarantine file still keeps its version
    /// out of use.
    pub(crate) fn load_notes(&mut self) -> Result<(), StoreError> {
        for path in self.note_files("labels")? {
            if let Some(state) = self.note_or_aside::<LabelFile, LabelState>(&path)? {
                self.generation = self.generation.max(state.generation);
                self.labels
                    .insert((state.stream.clone(), state.label.clone()), state);
            }
        }
        for path in self.note_files("quarantine")? {
            let read = read_note::<QuarantineFile, QuarantineState>(&path)?;
            let state = match read {
                Ok(state) => Some(state),
                // To forget it would let the version loose: the file's name says enough.
                Err(error) => quarantine_of_name(&path, &error),
            };
            if let Some(state) = state {
                self.generation = self.generation.max(state.generation);
                self.quarantined
                    .insert((state.stream.clone(), state.version), state);
            }
        }
        for path in self.note_files("reports")? {
            if let Some(reports) = self.note_or_aside::<ReportsFile, Reports>(&path)? {
                let first = reports.0.values().next();
                if let Some(key) = first.map(|r| (r.stream.clone(), r.version)) {
                    self.reports.insert(key, reports);
                }
            }
        }
        Ok(())
    }

    fn note_files(&self, kind: &str) -> Result<Vec<PathBuf>, StoreError> {
        let mut files = Vec::new();
        for folder in entries(&self.root.join(kind))? {
            if folder.is_dir() {
                caudata_durable::remove_leftovers(&folder)?;
                files.extend(entries(&folder)?);
            }
        }
        Ok(files)
    }

    fn note_or_aside<F, T>(&self, path: &Path) -> Result<Option<T>, StoreError>
    where
        F: DeserializeOwned,
        T: TryFrom<F, Error = RecordError>,
    {
        match read_note::<F, T>(path)? {
            Ok(note) => Ok(Some(note)),
            Err(error) => {
                tracing::error!(path = %path.display(), %error, "unreadable, set aside");
                self.set_aside(path);
                Ok(None)
            }
        }
    }
}

/// The outer error: the file cannot be read at all.
fn read_note<F, T>(path: &Path) -> Result<Result<T, RecordError>, StoreError>
where
    F: DeserializeOwned,
    T: TryFrom<F, Error = RecordError>,
{
    let bytes = fs::read(path).map_err(|error| unusable(path, &error.to_string()))?;
    let file = serde_json::from_slice::<F>(&bytes).map_err(RecordError::from);
    Ok(file.and_then(T::try_from))
}

/// What the name of a damaged quarantine file says.
fn quarantine_of_name(path: &Path, error: &RecordError) -> Option<QuarantineState> {
    tracing::error!(path = %path.display(), %error, "unreadable; its version stays out of use");
    let folder = path.parent()?.file_name()?.to_str()?.replace('@', "/");
    Some(QuarantineState {
        stream: StreamName::new(&folder).ok()?,
        version: path.file_stem()?.to_str()?.parse().ok()?,
        reason: "its quarantine file is damaged".to_owned(),
        by: String::new(),
        generation: 0,
        unix_ms: 0,
    })
}

/// What fits into a line of the record.
fn clipped(mut words: String) -> String {
    let mut end = words.len().min(300);
    while !words.is_char_boundary(end) {
        end -= 1;
    }
    words.truncate(end);
    words
}
