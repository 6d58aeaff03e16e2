//! What stands beside the versions on disk: where labels lead, what is out of use, and what robots said.

use std::collections::BTreeMap;

use caudata_proto::registry::{
    LabelName, LabelState, QuarantineState, RobotReport, RobotState, StreamName,
};
use serde::{Deserialize, Serialize};

use crate::record::{RecordError, from_hex_32};
use crate::store::hex;

/// Robots whose word about one version is kept; with more, the one that spoke first is forgotten.
pub const ROBOTS_MAX: usize = 256;

/// A label's file.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LabelFile {
    stream: String,
    label: String,
    version: u64,
    generation: u64,
    by: String,
    override_reason: Option<String>,
    unix_ms: u64,
}

impl From<&LabelState> for LabelFile {
    fn from(state: &LabelState) -> Self {
        Self {
            stream: state.stream.to_string(),
            label: state.label.to_string(),
            version: state.version,
            generation: state.generation,
            by: state.by.clone(),
            override_reason: state.override_reason.clone(),
            unix_ms: state.unix_ms,
        }
    }
}

impl TryFrom<LabelFile> for LabelState {
    type Error = RecordError;

    fn try_from(file: LabelFile) -> Result<Self, RecordError> {
        Ok(Self {
            stream: StreamName::new(&file.stream)?,
            label: LabelName::new(&file.label)?,
            version: file.version,
            generation: file.generation,
            by: file.by,
            override_reason: file.override_reason,
            unix_ms: file.unix_ms,
        })
    }
}

/// The file of a version out of use.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct QuarantineFile {
    stream: String,
    version: u64,
    reason: String,
    by: String,
    generation: u64,
    unix_ms: u64,
}

impl From<&QuarantineState> for QuarantineFile {
    fn from(state: &QuarantineState) -> Self {
        Self {
            stream: state.stream.to_string(),
            version: state.version,
            reason: state.reason.clone(),
            by: state.by.clone(),
            generation: state.generation,
            unix_ms: state.unix_ms,
        }
    }
}

impl TryFrom<QuarantineFile> for QuarantineState {
    type Error = RecordError;

    fn try_from(file: QuarantineFile) -> Result<Self, RecordError> {
        Ok(Self {
            stream: StreamName::new(&file.stream)?,
            version: file.version,
            reason: file.reason,
            by: file.by,
            generation: file.generation,
            unix_ms: file.unix_ms,
        })
    }
}

/// What robots said about one version, by their names.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Reports(pub BTreeMap<String, RobotReport>);

impl Reports {
    /// Robots that said that it went through its trial.
    #[must_use]
    pub fn good(&self) -> usize {
        let good = |report: &&RobotReport| report.state == RobotState::Good;
        self.0.values().filter(good).count()
    }

    /// These with `report` in place of the robot's last one.
    #[must_use]
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
#[serde(deny_unknown_fields)]
pub struct ReportsFile {
    reports: Vec<ReportLine>,
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct ReportLine {
    robot: String,
    stream: String,
    version: u64,
    sha256: String,
    state: String,
    reason: String,
    walked_s: f64,
    falls: u32,
    attempts: u32,
    unix_ms: u64,
}

impl From<&Reports> for ReportsFile {
    fn from(reports: &Reports) -> Self {
        let line = |report: &RobotReport| ReportLine {
            robot: report.robot.clone(),
            stream: report.stream.to_string(),
            version: report.version,
            sha256: hex(&report.sha256),
            state: report.state.word().to_owned(),
            reason: report.reason.clone(),
            walked_s: report.walked_s,
            falls: report.falls,
            attempts: report.attempts,
            unix_ms: report.unix_ms,
        };
        Self {
            reports: reports.0.values().map(line).collect(),
        }
    }
}

impl TryFrom<ReportsFile> for Reports {
    type Error = RecordError;

    fn try_from(file: ReportsFile) -> Result<Self, RecordError> {
        let report = |line: ReportLine| {
            let state = RobotState::of_word(&line.state);
            let report = RobotReport {
                stream: StreamName::new(&line.stream)?,
                version: line.version,
                sha256: from_hex_32("sha256", &line.sha256)?,
                state: state.ok_or(RecordError::Word { word: line.state })?,
                reason: line.reason,
                walked_s: line.walked_s,
                falls: line.falls,
                attempts: line.attempts,
                unix_ms: line.unix_ms,
                robot: line.robot,
            };
            Ok((report.robot.clone(), report))
        };
        let reports: Result<_, RecordError> = file.reports.into_iter().map(report).collect();
        Ok(Self(reports?))
    }
}
