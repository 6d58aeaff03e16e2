//! What stands beside the versions on disk: what is out of use, which numbers are used up, and what robots
//! said.

use std::collections::BTreeMap;

use caudata_proto::hex;
use caudata_proto::registry::{QuarantineState, RobotReport, RobotState, StreamName};
use caudata_proto::wire::registry as wire;
use serde::{Deserialize, Serialize};

use crate::error::RecordError;

/// Robots whose word about one version is kept; with more, the one that spoke first is forgotten.
pub const ROBOTS_MAX: usize = 256;
/// Damaged versions of one stream whose numbers are kept one by one; with more, all numbers up to the lowest
/// are used up.
const DAMAGED_MAX: usize = 256;

/// A SHA-256.
pub type Hash = [u8; 32];

/// A version out of use, and the bytes that are out of use with it: kept for good, also when the version
/// itself is gone.
#[derive(Clone, Debug, PartialEq)]
pub struct Quarantined {
    /// What is told of it.
    pub state: QuarantineState,
    /// Its bytes; `None` where the file is damaged.
    pub sha256: Option<Hash>,
}

/// Its file.
#[derive(Serialize, Deserialize)]
pub struct QuarantineFile {
    #[serde(flatten)]
    state: wire::QuarantineState,
    #[serde(default)]
    sha256: Option<String>,
}

impl From<&Quarantined> for QuarantineFile {
    fn from(quarantined: &Quarantined) -> Self {
        Self {
            state: quarantined.state.clone().into(),
            sha256: quarantined.sha256.map(|hash| hex::hex(&hash)),
        }
    }
}

impl TryFrom<QuarantineFile> for Quarantined {
    type Error = RecordError;

    fn try_from(file: QuarantineFile) -> Result<Self, RecordError> {
        Ok(Self {
            state: file.state.try_into()?,
            sha256: file.sha256.map(|text| hash(&text)).transpose()?,
        })
    }
}

fn hash(text: &str) -> Result<Hash, RecordError> {
    let bytes = hex::from_hex(text).and_then(|bytes| bytes.try_into().ok());
    bytes.ok_or(RecordError::Hash)
}

/// Numbers of a stream that are used up although no version stands under them.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct UsedUp {
    /// All below this one: their versions retired.
    pub below: u64,
    /// Those whose record or file was found damaged, with the bytes they stood for, where those are known.
    pub damaged: BTreeMap<u64, Option<Hash>>,
}

impl UsedUp {
    /// Why `version` cannot be published with these bytes; `None`: it can.
    pub fn objection(&self, version: u64, sha256: &Hash) -> Option<String> {
        match self.damaged.get(&version) {
            Some(Some(known)) if known == sha256 => None,
            Some(_) => Some("what stood there was found damaged".to_owned()),
            None if version < self.below => Some("older versions were retired".to_owned()),
            None => None,
        }
    }

    /// Whether a version may have stood under this number.
    pub fn stood(&self, version: u64) -> bool {
        version < self.below || self.damaged.contains_key(&version)
    }

    /// Versions up to `version` retire.
    pub fn retire(&mut self, version: u64) {
        self.below = self.below.max(version.saturating_add(1));
    }

    /// What stood under `version` was found damaged.
    pub fn damage(&mut self, version: u64, sha256: Option<Hash>) {
        let known = self.damaged.entry(version).or_default();
        *known = known.or(sha256);
        while self.damaged.len() > DAMAGED_MAX {
            if let Some((lowest, _)) = self.damaged.pop_first() {
                self.retire(lowest);
            }
        }
    }
}

/// The file of them.
#[derive(Serialize, Deserialize)]
pub struct UsedUpFile {
    stream: String,
    below: u64,
    damaged: Vec<(u64, Option<String>)>,
}

impl UsedUpFile {
    /// Those of `stream`.
    pub fn new(stream: &StreamName, used_up: &UsedUp) -> Self {
        let line =
            |(version, known): (&u64, &Option<Hash>)| (*version, known.map(|h| hex::hex(&h)));
        Self {
            stream: stream.to_string(),
            below: used_up.below,
            damaged: used_up.damaged.iter().map(line).collect(),
        }
    }
}

impl TryFrom<UsedUpFile> for (StreamName, UsedUp) {
    type Error = RecordError;

    fn try_from(file: UsedUpFile) -> Result<Self, RecordError> {
        let line = |(version, known): (u64, Option<String>)| {
            Ok((version, known.map(|text| hash(&text)).transpose()?))
        };
        let used_up = UsedUp {
            below: file.below,
            damaged: file.damaged.into_iter().map(line).collect::<Result<_, RecordError>>()?,
        };
        Ok((StreamName::new(&file.stream)?, used_up))
    }
}

/// What robots said about one version, by their names.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Reports(pub BTreeMap<String, RobotReport>);

impl Reports {
    /// Robots that said that it went through its trial.
    pub fn good(&self) -> usize {
        let good = |report: &&RobotReport| report.state == RobotState::Good;
        self.0.values().filter(good).count()
    }

    /// These with `report` in place of the robot's last one.
    pub fn with(&self, report: RobotReport) -> Self {
        let mut next = self.clone();
        if next.0.len() >= ROBOTS_MAX && !next.0.contains_key(&report.robot) {
            let oldest = next.0.values().min_by_key(|report| report.unix_ms);
            if let Some(robot) = oldest.map(|report| report.robot.clone()) {
                next.0.remove(&robot);
            }
        }
        next.0.insert(report.robot.clone(), report);
        next
    }
}

/// The file of them.
#[derive(Serialize, Deserialize)]
pub struct ReportsFile {
    reports: Vec<wire::RobotReport>,
}

impl From<&Reports> for ReportsFile {
    fn from(reports: &Reports) -> Self {
        Self { reports: reports.0.values().cloned().map(Into::into).collect() }
    }
}

impl TryFrom<ReportsFile> for Reports {
    type Error = RecordError;

    fn try_from(file: ReportsFile) -> Result<Self, RecordError> {
        // One that could not be said today, such as `good` without a step, is left out.
        let reports = file.reports.into_iter().map(RobotReport::try_from);
        let reports = reports.flatten();
        Ok(Self(reports.map(|report| (report.robot.clone(), report)).collect()))
    }
}
