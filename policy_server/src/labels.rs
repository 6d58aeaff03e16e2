//! Labels, quarantine, reverts and reports of the store.

use std::path::PathBuf;
use std::time::Instant;

use caudata_proto::registry::{
    LabelName, LabelState, Manifest, Overview, QuarantineState, RobotReport, SetLabel, StreamName,
};
use caudata_proto::wire::registry as wire;

use crate::audit::{Deed, Origin};
use crate::checks::{MOVE, Move};
use crate::error::StoreError;
use crate::files::{clipped, stream_folder};
use crate::notes::{QuarantineFile, Quarantined, Reports, ReportsFile};
use crate::record::Record;
use crate::store::{Published, Store};

/// Labels of one stream at most.
pub const LABELS_MAX: usize = 32;
/// Versions out of use of one stream at most: they are kept for good.
pub const QUARANTINED_MAX: usize = 1024;
/// Reports in an overview at most, the newest.
const REPORTS_MAX: usize = 1000;
/// Versions out of use in an overview at most, the newest.
const SHOWN_MAX: usize = 1000;

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
    pub fn generation(&self) -> u64 {
        match self {
            Self::Published(record) => record.generation,
            Self::Label(label) => label.generation,
            Self::Quarantined(state) => state.generation,
        }
    }

    /// Its stream.
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
            .chain(self.quarantines().cloned().map(Change::Quarantined))
    }

    /// What is out of use.
    pub fn quarantines(&self) -> impl Iterator<Item = &QuarantineState> {
        self.quarantined.values().map(|quarantined| &quarantined.state)
    }

    /// Whether a version is out of use.
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

    /// All labels of `stream` (`None`: of all), `latest` first of each. One whose version is out of use is
    /// among them.
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
    /// [`StoreError::LabelMoved`], [`StoreError::NotAllowed`], [`StoreError::Full`],
    /// [`StoreError::ReadOnly`]; what the disk says.
    pub fn set_label(
        &mut self,
        origin: &Origin,
        wanted: SetLabel,
    ) -> Result<LabelState, StoreError> {
        let key = (wanted.stream.clone(), wanted.label.clone());
        let before = self.labels.get(&key);
        if wanted.label.is_latest() {
            return Err(StoreError::NotAllowed {
                reason: "`latest` moves by itself; publish, or quarantine what is newest".into(),
            });
        }
        self.moving(&wanted, before).check(MOVE)?;
        let of_stream = |(of, _): &&(StreamName, LabelName)| *of == wanted.stream;
        if before.is_none() && self.labels.keys().filter(of_stream).count() >= LABELS_MAX {
            let stream = &wanted.stream;
            return Err(StoreError::Full {
                reason: format!("{stream} has its limit of {LABELS_MAX} labels; use one of them"),
            });
        }
        let from = before.map(|state| state.version);
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
            generation: Some(state.generation),
            ..Deed::of("label", state.stream.as_str(), state.version, clipped(&detail))
        };
        let path = self.label_path(&state.stream, &state.label);
        self.announced(origin, &deed, |store| {
            store.write_note(&path, &wire::LabelState::from(state.clone()))
        })?;
        self.generation = state.generation;
        self.labels.insert(key, state.clone());
        Ok(state)
    }

    /// What the checks of a label that is to be moved look at.
    pub(crate) fn moving<'a>(
        &self,
        wanted: &'a SetLabel,
        before: Option<&'a LabelState>,
    ) -> Move<'a> {
        let (stream, version) = (&wanted.stream, wanted.version);
        Move {
            known: self.find(stream, version).is_some(),
            quarantined: self.is_quarantined(stream, version),
            good: (self.good_reports(stream, version), self.limits.stable_needs),
            wanted,
            before,
        }
    }

    /// Robots that said that a version went through its trial.
    pub fn good_reports(&self, stream: &StreamName, version: u64) -> usize {
        let reports = self.reports.get(&(stream.clone(), version));
        reports.map_or(0, Reports::good)
    }

    /// Takes a version out of use for good, one that retired too, and with it whatever else of its stream has the same
    /// bytes: a revert gives them another number. Answers what stands there where it is out of use already.
    ///
    /// # Errors
    /// [`StoreError::NotFound`], [`StoreError::ReadOnly`]; what the disk says.
    pub fn quarantine(
        &mut self,
        origin: &Origin,
        state: QuarantineState,
    ) -> Result<QuarantineState, StoreError> {
        let done = self.quarantine_one(origin, state)?;
        let key = (done.stream.clone(), done.version);
        let sha256 = self.quarantined.get(&key).and_then(|known| known.sha256);
        let twin =
            |r: &&Record| Some(r.manifest.sha256) == sha256 && r.manifest.version != done.version;
        let twins = self.records(Some(&done.stream)).filter(twin);
        let twins: Vec<u64> = twins.map(|r| r.manifest.version).collect();
        for version in twins {
            let reason = format!("the bytes of version {}: {}", done.version, done.reason);
            self.quarantine_one(origin, QuarantineState { version, reason, ..done.clone() })?;
        }
        Ok(done)
    }

    /// The same of this version alone.
    fn quarantine_one(
        &mut self,
        origin: &Origin,
        mut state: QuarantineState,
    ) -> Result<QuarantineState, StoreError> {
        let key = (state.stream.clone(), state.version);
        if let Some(known) = self.quarantined.get(&key) {
            return Ok(known.state.clone());
        }
        let used_up = self.used_up.get(&state.stream);
        let sha256 = match self.manifest(&state.stream, Some(state.version)) {
            Ok(record) => Some(record.manifest.sha256),
            // What is gone from here a robot may still hold.
            Err(_) if used_up.is_some_and(|used| used.stood(state.version)) => {
                used_up.and_then(|used| used.damaged.get(&state.version).copied().flatten())
            }
            Err(error) => return Err(error),
        };
        let of_stream = self.quarantines().filter(|q| q.stream == state.stream);
        if of_stream.count() >= QUARANTINED_MAX {
            return Err(StoreError::Full {
                reason: format!(
                    "{} has its limit of {QUARANTINED_MAX} versions out of use; use another stream",
                    state.stream
                ),
            });
        }
        state.by = origin.by.clone();
        state.unix_ms = origin.unix_ms;
        state.generation = self.generation + 1;
        let deed = Deed {
            generation: Some(state.generation),
            ..Deed::of("quarantine", state.stream.as_str(), state.version, clipped(&state.reason))
        };
        let path = self.note_path("quarantine", &state.stream, state.version);
        let quarantined = Quarantined { state: state.clone(), sha256 };
        self.announced(origin, &deed, |store| {
            store.write_note(&path, &QuarantineFile::from(&quarantined))
        })?;
        self.generation = state.generation;
        self.quarantined.insert(key, quarantined);
        Ok(state)
    }

    /// Publishes the bytes of an older version again, as `manifest` says.
    ///
    /// # Errors
    /// As [`Store::publish_by`]; [`StoreError::NotFound`] where the old version is gone,
    /// [`StoreError::NotAllowed`] where the manifest is not one of it or the number not the highest.
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
            return refused(format!("the announcement is not one of {stream} version {old}"));
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
        let words = clipped(&format!("version {old} again: {reason}"));
        self.publish_by(origin, "revert", &words, manifest, &bytes)
    }

    /// Keeps what a robot says about a version. True where it is news.
    ///
    /// # Errors
    /// [`StoreError::NotFound`] for a version that is not here, or has other bytes; [`StoreError::Full`] for
    /// a robot that says too much; [`StoreError::ReadOnly`]; what the disk says.
    pub fn report(&mut self, origin: &Origin, mut report: RobotReport) -> Result<bool, StoreError> {
        let record = self.manifest(&report.stream, Some(report.version))?;
        if record.manifest.sha256 != report.sha256 {
            return Err(StoreError::NotFound {
                what: format!("{} version {} with these bytes", report.stream, report.version),
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
        if !self.quota.take(&report.robot, Instant::now()) {
            return Err(StoreError::Full {
                reason: format!(
                    "robot `{}` says more than is written down; say less, or again in a while",
                    report.robot
                ),
            });
        }
        report.unix_ms = origin.unix_ms;
        let what = if report.state.went_well() { "ack" } else { "nack" };
        let words = format!("{} {} {}", report.robot, report.state.name(), report.reason);
        let words = clipped(words.trim_end());
        let deed = Deed::of(what, report.stream.as_str(), report.version, words);
        let path = self.note_path("reports", &report.stream, report.version);
        let next = before.with(report.clone());
        self.announced(origin, &deed, |store| store.write_note(&path, &ReportsFile::from(&next)))?;
        self.reports.insert(key, next);
        Ok(true)
    }

    fn label_path(&self, stream: &StreamName, label: &LabelName) -> PathBuf {
        let folder = self.root.join("labels").join(stream_folder(stream));
        folder.join(format!("{label}.json"))
    }

    fn note_path(&self, kind: &str, stream: &StreamName, version: u64) -> PathBuf {
        let folder = self.root.join(kind).join(stream_folder(stream));
        folder.join(format!("{version:020}.json"))
    }

    /// Forgets what was said about a version that is gone. Its quarantine stays: neither its number nor its
    /// bytes come back.
    pub(crate) fn forget_reports(&mut self, stream: &StreamName, version: u64) {
        if self.reports.remove(&(stream.clone(), version)).is_some() {
            let _ = self.disk.remove(&self.note_path("reports", stream, version));
        }
    }

    /// Labels, quarantine and reports of `stream` (`None`: of all), the newest reports first.
    pub fn overview(&self, stream: Option<&StreamName>) -> Overview {
        let wanted = |name: &StreamName| stream.is_none_or(|s| s == name);
        let said = self.reports.values().flat_map(|reports| reports.0.values());
        let mut reports: Vec<RobotReport> = said.filter(|r| wanted(&r.stream)).cloned().collect();
        reports.sort_by_key(|report| std::cmp::Reverse(report.unix_ms));
        reports.truncate(REPORTS_MAX);
        let out = self.quarantines().filter(|state| wanted(&state.stream));
        let mut quarantined: Vec<QuarantineState> = out.cloned().collect();
        quarantined.sort_by_key(|state| std::cmp::Reverse(state.generation));
        quarantined.truncate(SHOWN_MAX);
        Overview {
            labels: self.labels(stream),
            quarantined,
            reports,
            generation: self.generation(),
            read_only: self.trouble().map(clipped),
        }
    }
}
