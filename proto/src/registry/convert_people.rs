//! Between the messages about labels, quarantine and reports and their checked values.

use super::convert::{hash, optional_stream, range, text};
use super::{
    AuditEntry, AuditPage, Freshness, LabelName, LabelState, MAX_REASON, Manifest, NONCE_BYTES,
    Overview, QuarantineState, RegistryError, RobotReport, RobotState, SetLabel, Signature,
    SignedFreshness, StreamName,
};
use crate::wire::registry as pb;

impl TryFrom<pb::LabelState> for LabelState {
    type Error = RegistryError;

    fn try_from(s: pb::LabelState) -> Result<Self, RegistryError> {
        Ok(Self {
            stream: StreamName::new(&s.stream)?,
            label: LabelName::new(&s.label)?,
            version: s.version,
            generation: s.generation,
            by: words("by", s.by, 0)?,
            override_reason: reason(s.override_reason)?,
            unix_ms: s.unix_ms,
        })
    }
}

impl From<LabelState> for pb::LabelState {
    fn from(s: LabelState) -> Self {
        Self {
            stream: s.stream.0,
            label: s.label.0,
            version: s.version,
            generation: s.generation,
            by: s.by,
            override_reason: s.override_reason.unwrap_or_default(),
            unix_ms: s.unix_ms,
        }
    }
}

impl TryFrom<pb::SetLabelRequest> for SetLabel {
    type Error = RegistryError;

    fn try_from(r: pb::SetLabelRequest) -> Result<Self, RegistryError> {
        Ok(Self {
            stream: StreamName::new(&r.stream)?,
            label: LabelName::new(&r.label)?,
            version: r.version,
            expected_generation: r.expected_generation,
            override_reason: reason(r.override_reason)?,
        })
    }
}

impl From<SetLabel> for pb::SetLabelRequest {
    fn from(r: SetLabel) -> Self {
        Self {
            stream: r.stream.0,
            label: r.label.0,
            version: r.version,
            expected_generation: r.expected_generation,
            override_reason: r.override_reason.unwrap_or_default(),
        }
    }
}

/// What to publish again, and why.
impl TryFrom<pb::RevertRequest> for (Manifest, String) {
    type Error = RegistryError;

    fn try_from(r: pb::RevertRequest) -> Result<Self, RegistryError> {
        let manifest = r
            .manifest
            .ok_or(RegistryError::Missing { field: "manifest" })?;
        let manifest = Manifest::try_from(manifest)?;
        if manifest.reverts_to.is_none() {
            return Err(RegistryError::Missing {
                field: "reverts_to",
            });
        }
        Ok((manifest, words("reason", r.reason, 1)?))
    }
}

impl TryFrom<pb::QuarantineRequest> for QuarantineState {
    type Error = RegistryError;

    fn try_from(r: pb::QuarantineRequest) -> Result<Self, RegistryError> {
        Ok(Self {
            stream: StreamName::new(&r.stream)?,
            version: r.version,
            reason: words("reason", r.reason, 1)?,
            by: String::new(),
            generation: 0,
            unix_ms: 0,
        })
    }
}

impl TryFrom<pb::QuarantineState> for QuarantineState {
    type Error = RegistryError;

    fn try_from(s: pb::QuarantineState) -> Result<Self, RegistryError> {
        Ok(Self {
            stream: StreamName::new(&s.stream)?,
            version: s.version,
            reason: words("reason", s.reason, 1)?,
            by: words("by", s.by, 0)?,
            generation: s.generation,
            unix_ms: s.unix_ms,
        })
    }
}

impl From<QuarantineState> for pb::QuarantineState {
    fn from(s: QuarantineState) -> Self {
        Self {
            stream: s.stream.0,
            version: s.version,
            reason: s.reason,
            by: s.by,
            generation: s.generation,
            unix_ms: s.unix_ms,
        }
    }
}

/// Both ways between a report's state and its number on the wire.
macro_rules! states {
    ($($state:ident),*) => {
        impl TryFrom<pb::robot_report::State> for RobotState {
            type Error = RegistryError;

            fn try_from(state: pb::robot_report::State) -> Result<Self, RegistryError> {
                match state {
                    $(pb::robot_report::State::$state => Ok(Self::$state),)*
                    pb::robot_report::State::Unspecified => {
                        Err(RegistryError::Missing { field: "state" })
                    }
                }
            }
        }

        impl From<RobotState> for pb::robot_report::State {
            fn from(state: RobotState) -> Self {
                match state {
                    $(RobotState::$state => Self::$state,)*
                }
            }
        }
    };
}
states!(Armed, Trial, Good, Refused, Failed);

impl TryFrom<pb::RobotReport> for RobotReport {
    type Error = RegistryError;

    fn try_from(r: pb::RobotReport) -> Result<Self, RegistryError> {
        let state = RobotState::try_from(r.state())?;
        if !(r.walked_s.is_finite() && r.walked_s >= 0.0) {
            return Err(RegistryError::Together(
                "`walked_s` must be a number of seconds",
            ));
        }
        // Standing still is no trial: `stable` would follow a robot that never moved.
        if state == RobotState::Good && r.walked_s == 0.0 {
            return Err(RegistryError::Together(
                "`good` needs seconds walked: `walked_s` is 0",
            ));
        }
        let least = usize::from(!state.went_well());
        Ok(Self {
            robot: text("robot", r.robot, 1, 64)?,
            stream: StreamName::new(&r.stream)?,
            version: r.version,
            sha256: hash("sha256", &r.sha256)?,
            state,
            reason: words("reason", r.reason, least)?,
            walked_s: r.walked_s,
            falls: r.falls,
            attempts: r.attempts,
            unix_ms: r.unix_ms,
        })
    }
}

impl From<RobotReport> for pb::RobotReport {
    fn from(r: RobotReport) -> Self {
        Self {
            robot: r.robot,
            stream: r.stream.0,
            version: r.version,
            sha256: r.sha256.to_vec(),
            state: pb::robot_report::State::from(r.state).into(),
            reason: r.reason,
            walked_s: r.walked_s,
            falls: r.falls,
            attempts: r.attempts,
            unix_ms: r.unix_ms,
        }
    }
}

/// The nonce, the stream and the label that are asked for.
impl TryFrom<pb::FreshnessRequest> for ([u8; NONCE_BYTES], StreamName, LabelName) {
    type Error = RegistryError;

    fn try_from(r: pb::FreshnessRequest) -> Result<Self, RegistryError> {
        let label = match r.label.as_str() {
            "" => LabelName::latest(),
            name => LabelName::new(name)?,
        };
        Ok((nonce(&r.nonce)?, StreamName::new(&r.stream)?, label))
    }
}

impl TryFrom<pb::FreshnessResponse> for SignedFreshness {
    type Error = RegistryError;

    fn try_from(r: pb::FreshnessResponse) -> Result<Self, RegistryError> {
        let signature = r
            .signature
            .ok_or(RegistryError::Missing { field: "signature" })?;
        Ok(Self {
            said: Freshness {
                nonce: nonce(&r.nonce)?,
                stream: StreamName::new(&r.stream)?,
                label: LabelName::new(&r.label)?,
                version: r.version,
                sha256: hash("sha256", &r.sha256)?,
            },
            signature: Signature::try_from(signature)?,
        })
    }
}

impl From<SignedFreshness> for pb::FreshnessResponse {
    fn from(f: SignedFreshness) -> Self {
        Self {
            nonce: f.said.nonce.to_vec(),
            stream: f.said.stream.0,
            label: f.said.label.0,
            version: f.said.version,
            sha256: f.said.sha256.to_vec(),
            signature: Some(pb::Signature {
                key_id: f.signature.key_id,
                signature: f.signature.signature,
            }),
        }
    }
}

/// `None`: all streams.
impl TryFrom<pb::OverviewRequest> for Option<StreamName> {
    type Error = RegistryError;

    fn try_from(r: pb::OverviewRequest) -> Result<Self, RegistryError> {
        optional_stream(&r.stream)
    }
}

impl TryFrom<pb::OverviewResponse> for Overview {
    type Error = RegistryError;

    fn try_from(r: pb::OverviewResponse) -> Result<Self, RegistryError> {
        Ok(Self {
            labels: r
                .labels
                .into_iter()
                .map(LabelState::try_from)
                .collect::<Result<_, _>>()?,
            quarantined: r
                .quarantined
                .into_iter()
                .map(QuarantineState::try_from)
                .collect::<Result<_, _>>()?,
            reports: r
                .reports
                .into_iter()
                .map(RobotReport::try_from)
                .collect::<Result<_, _>>()?,
            generation: r.generation,
            read_only: reason(r.read_only)?,
        })
    }
}

impl From<Overview> for pb::OverviewResponse {
    fn from(o: Overview) -> Self {
        Self {
            labels: o.labels.into_iter().map(Into::into).collect(),
            quarantined: o.quarantined.into_iter().map(Into::into).collect(),
            reports: o.reports.into_iter().map(Into::into).collect(),
            generation: o.generation,
            read_only: o.read_only.unwrap_or_default(),
        }
    }
}

impl TryFrom<pb::AuditResponse> for AuditPage {
    type Error = RegistryError;

    fn try_from(r: pb::AuditResponse) -> Result<Self, RegistryError> {
        r.entries
            .into_iter()
            .map(|e| {
                Ok(AuditEntry {
                    number: e.number,
                    unix_ms: e.unix_ms,
                    by: words("by", e.by, 0)?,
                    what: text("what", e.what, 1, 32)?,
                    stream: e.stream,
                    version: e.version,
                    detail: words("detail", e.detail, 0)?,
                })
            })
            .collect()
    }
}

impl From<AuditEntry> for pb::AuditEntry {
    fn from(e: AuditEntry) -> Self {
        Self {
            number: e.number,
            unix_ms: e.unix_ms,
            by: e.by,
            what: e.what,
            stream: e.stream,
            version: e.version,
            detail: e.detail,
        }
    }
}

fn nonce(bytes: &[u8]) -> Result<[u8; NONCE_BYTES], RegistryError> {
    range(
        "nonce",
        bytes.len() as u64,
        NONCE_BYTES as u64,
        NONCE_BYTES as u64,
    )?;
    hash("nonce", bytes)
}

/// One line of any language.
fn words(field: &'static str, words: String, min: usize) -> Result<String, RegistryError> {
    if (min..=MAX_REASON).contains(&words.len()) && !words.chars().any(char::is_control) {
        return Ok(words);
    }
    Err(RegistryError::Words {
        field,
        min,
        max: MAX_REASON,
    })
}

fn reason(text: String) -> Result<Option<String>, RegistryError> {
    if text.is_empty() {
        return Ok(None);
    }
    words("reason", text, 1).map(Some)
}
