//! What an evaluation comes to, in a small file beside the policy.
//!
//! A policy's bytes are named by their SHA-256, and the evaluation comes after them: it cannot be inside
//! without making another policy. So it lies beside (`policy.onnx` → `policy.evaluation.json`) and names the
//! bytes that it is about; a summary of other bytes is refused.

use std::path::{Path, PathBuf};

use caudata_policy::PolicyFile;
use serde::{Deserialize, Serialize};

use crate::result::{ScenarioResult, SuiteResult};

/// Value of [`Summary::format`].
pub const FORMAT: &str = "caudata.evaluation.v1";
/// Largest summary that is read, bytes: what the policy server takes.
pub const MAX_BYTES: usize = 64 * 1024;

/// Why a summary is refused.
#[derive(Debug, thiserror::Error)]
#[expect(missing_docs, reason = "a message says what its fields are")]
pub enum SummaryError {
    /// It cannot be read.
    #[error("cannot read {path}: {source}")]
    Read { path: PathBuf, source: std::io::Error },
    /// It is no summary.
    #[error(
        "{path} is not an evaluation summary: {reason}; write it anew with `caudata eval --write-summary`"
    )]
    Invalid { path: PathBuf, reason: String },
    /// It is about another policy.
    #[error(
        "{path} is about policy {found}, not {expected}; write it anew with `caudata eval --write-summary`"
    )]
    OtherPolicy { path: PathBuf, found: String, expected: String },
}

/// The summary.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Summary {
    /// [`FORMAT`].
    pub format: String,
    /// SHA-256 of the policy's bytes, hex.
    pub policy_sha256: String,
    /// Version of the policy.
    pub policy_version: u64,
    /// SHA-256 of the robot's files, hex.
    pub robot_hash: String,
    /// Suite and engine.
    pub suite: String,
    /// See `suite`.
    pub engine: String,
    /// Seed of the episodes.
    pub seed: u64,
    /// One line per scenario.
    pub scenarios: Vec<Line>,
    /// Rows of the table of targets that are met, and how many there are; null for other suites than
    /// `acceptance`.
    pub targets_met: Option<[usize; 2]>,
}

/// One scenario.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Line {
    /// Its name.
    pub name: String,
    /// Episodes.
    pub episodes: usize,
    /// Mean command: vx, vy (m/s), yaw rate (rad/s).
    pub command: [f64; 3],
    /// Mean of what was achieved, likewise.
    pub achieved: [f64; 3],
    /// Share of episodes that fell.
    pub fall_share: f64,
    /// Mean power, W.
    pub power_w: f64,
    /// Whether it walks by the gates; null where the scenario is not about walking.
    pub walks: Option<bool>,
    /// Gates that are missed.
    pub missed: Vec<String>,
    /// Share of the episodes that got where they were to go; null where there was no such place.
    pub reached: Option<f64>,
}

impl Line {
    fn of(s: &ScenarioResult) -> Self {
        let missed = s.gates.as_ref().map_or_else(Vec::new, |g| g.missed());
        Self {
            name: s.name.clone(),
            episodes: s.episodes,
            command: s.command,
            achieved: [s.vx_mps.mean, s.vy_mps.mean, s.yaw_rate_radps.mean],
            fall_share: s.fall_share.mean,
            power_w: s.power_w.mean,
            walks: s.walks(),
            missed: missed.into_iter().map(str::to_owned).collect(),
            reached: s.transition.as_ref().map(|t| t.reached.mean),
        }
    }
}

impl Summary {
    /// Summarises a result for a robot whose files have this SHA-256.
    pub fn of(result: &SuiteResult, robot_hash: String, seed: u64) -> Self {
        let rows = &result.acceptance;
        let met = rows.iter().filter(|r| r.met).count();
        Self {
            format: FORMAT.to_owned(),
            policy_sha256: result.policy_sha256.clone(),
            policy_version: result.policy_version,
            robot_hash,
            suite: result.suite.name().to_owned(),
            engine: result.engine.to_string(),
            seed,
            scenarios: result.scenarios.iter().map(Line::of).collect(),
            targets_met: (!rows.is_empty()).then_some([met, rows.len()]),
        }
    }

    /// Reads the summary beside a policy file; `None` where there is none.
    ///
    /// # Errors
    /// When it cannot be read, is no summary, or is about other bytes than the policy's.
    pub fn beside(policy: &Path, file: &PolicyFile) -> Result<Option<Self>, SummaryError> {
        let path = summary_path(policy);
        match std::fs::read(&path) {
            Ok(bytes) => Self::parse(&path, &bytes, &file.sha256_hex()).map(Some),
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => Ok(None),
            Err(source) => Err(SummaryError::Read { path, source }),
        }
    }

    fn parse(path: &Path, bytes: &[u8], policy_sha256: &str) -> Result<Self, SummaryError> {
        let path = path.to_owned();
        let invalid = |reason: String| SummaryError::Invalid { path: path.clone(), reason };
        if bytes.len() > MAX_BYTES {
            let reason = format!("{} bytes, at most {MAX_BYTES} are allowed", bytes.len());
            return Err(invalid(reason));
        }
        let summary: Self = serde_json::from_slice(bytes).map_err(|e| invalid(e.to_string()))?;
        if summary.format != FORMAT {
            return Err(invalid(format!("its format is `{}`", summary.format)));
        }
        if summary.policy_sha256 != policy_sha256 {
            return Err(SummaryError::OtherPolicy {
                path,
                found: summary.policy_sha256,
                expected: policy_sha256.to_owned(),
            });
        }
        Ok(summary)
    }
}

/// Where the summary of a policy file lies: `policy.onnx` → `policy.evaluation.json`.
pub fn summary_path(policy: &Path) -> PathBuf {
    policy.with_extension("evaluation.json")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Estimate, Suite};

    fn summary() -> Summary {
        let result = SuiteResult {
            suite: Suite::Flat,
            engine: "batch".into(),
            policy_version: 7,
            policy_sha256: "ab".repeat(32),
            scenarios: vec![ScenarioResult {
                name: "flat 0.3 m/s".to_owned(),
                episodes: 256,
                command: [0.3, 0.0, 0.0],
                vx_mps: Estimate::of(&[0.29]),
                ..ScenarioResult::default()
            }],
            referee: None,
            acceptance: Vec::new(),
            animal: Vec::new(),
        };
        Summary::of(&result, "cd".repeat(32), 1)
    }

    #[test]
    fn lies_beside_its_policy() {
        assert_eq!(
            summary_path(Path::new("runs/a/policy.onnx")),
            Path::new("runs/a/policy.evaluation.json")
        );
    }

    #[test]
    fn is_bound_to_the_bytes_of_its_policy() {
        let bytes = serde_json::to_vec(&summary()).unwrap();
        let parse = |sha: &str| Summary::parse(Path::new("x"), &bytes, sha);
        let read = parse(&"ab".repeat(32)).unwrap();
        assert_eq!(read, summary());
        assert_eq!(read.scenarios[0].achieved[0], 0.29);
        let other = parse(&"00".repeat(32)).unwrap_err().to_string();
        assert!(other.contains("is about policy abab"), "{other}");
    }

    #[test]
    fn what_is_no_summary_is_refused() {
        let refused = |bytes: &[u8]| {
            let error = Summary::parse(Path::new("x.json"), bytes, "").unwrap_err();
            assert!(matches!(error, SummaryError::Invalid { .. }), "{error}");
        };
        refused(b"");
        refused(b"{}");
        refused(&vec![b' '; MAX_BYTES + 1]);
        let mut value = serde_json::to_value(summary()).unwrap();
        value["format"] = "caudata.evaluation.v9".into();
        refused(&serde_json::to_vec(&value).unwrap());
        value["format"] = FORMAT.into();
        value["extra"] = 1.into();
        refused(&serde_json::to_vec(&value).unwrap());
    }
}
