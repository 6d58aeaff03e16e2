//! Between the generated messages and the checked values.

use serde::de::IgnoredAny;

use super::error::{
    FETCH_CHUNK_BYTES, MAX_EVALUATION_BYTES, MAX_POLICY_BYTES, MAX_REASON, MAX_SIGNATURES,
    NONCE_BYTES, RegistryError,
};
use super::field::{Field, both_ways, read_all};
use super::messages::*;
use super::names::{LabelName, StreamName};
use crate::wire::registry as pb;

both_ways!(Manifest = Manifest, check_manifest, {
    stream, version, sha256, size, created_unix_ms, run_id: ascii::<1, 128>, contract_hash,
    robot_name: ascii::<1, 64>, robot_hash, env_steps, training_commit: ascii::<0, 64>,
    config_hash: ascii::<0, 64>, evaluation_json: evaluation, reverts_to; signatures
});
both_ways!(Signature = Signature, |s| range("signature", s.signature.len() as u64, 1, 512), {
    key_id: ascii::<1, 64>, signature
});
both_ways!(Published = PublishResponse, |_| Ok(()), { manifest, generation, already_present });
both_ways!(ListRequest = ListRequest, |_| Ok(()), { stream, limit, below_version });
both_ways!(ListPage = ListResponse, |_| Ok(()), { generation, more; manifests });
both_ways!(ManifestRequest = GetManifestRequest, check_one_question, { stream, version, label });
both_ways!(FetchRequest = FetchRequest, |r| range("offset", r.offset, 0, MAX_POLICY_BYTES), {
    sha256, offset, if_none_match
});
both_ways!(WatchRequest = WatchRequest, |_| Ok(()), { stream, since_generation });
both_ways!(LabelState = LabelState, |_| Ok(()), {
    stream, label, version, generation, by: words, override_reason: maybe, unix_ms
});
both_ways!(SetLabel = SetLabelRequest, |_| Ok(()), {
    stream, label, version, expected_generation, override_reason: maybe
});
both_ways!(QuarantineState = QuarantineState, |_| Ok(()), {
    stream, version, reason: reason, by: words, generation, unix_ms
});
both_ways!(RobotReport = RobotReport, check_report, {
    robot: ascii::<1, 64>, stream, version, sha256, state, reason: words, walked_s, falls, attempts,
    unix_ms
});
both_ways!(Overview = OverviewResponse, |_| Ok(()), {
    generation, read_only: maybe; labels, quarantined, reports
});
both_ways!(AuditEntry = AuditEntry, |_| Ok(()), {
    number, unix_ms, by: words, what: ascii::<1, 32>, stream, version, detail: words
});

fn check_manifest(m: &pb::Manifest) -> Result<(), RegistryError> {
    range("size", m.size, 1, MAX_POLICY_BYTES)?;
    let most = MAX_SIGNATURES as u64;
    range("signatures", m.signatures.len() as u64, 0, most)?;
    if m.reverts_to.is_some_and(|old| old >= m.version) {
        return Err(RegistryError::Together("`reverts_to` must be below `version`"));
    }
    Ok(())
}

fn check_one_question(r: &pb::GetManifestRequest) -> Result<(), RegistryError> {
    if !r.label.is_empty() && r.version.is_some() {
        return Err(RegistryError::Together("a version or a label, not both"));
    }
    Ok(())
}

fn check_report(r: &pb::RobotReport) -> Result<(), RegistryError> {
    let state = RobotState::read("state", r.state)?;
    if !(0.0..=WALKED_MAX_S).contains(&r.walked_s) {
        return Err(RegistryError::Together(
            "`walked_s` must be a number of seconds, up to ten years",
        ));
    }
    // `stable` would follow a robot that never went through its trial.
    if state == RobotState::Good && r.walked_s < TRIAL_S {
        return Err(RegistryError::Together(
            "`good` needs the ten seconds of walking of a trial: `walked_s` is less",
        ));
    }
    let least = u64::from(!state.went_well());
    range("reason", r.reason.len() as u64, least, MAX_REASON as u64)
}

impl Field<i32> for RobotState {
    fn read(name: &'static str, wire: i32) -> Result<Self, RegistryError> {
        Self::of_number(wire).ok_or(RegistryError::Missing { field: name })
    }
    fn write(self) -> i32 {
        self.number()
    }
}

/// What to publish again, and why.
impl TryFrom<pb::RevertRequest> for (Manifest, String) {
    type Error = RegistryError;

    fn try_from(r: pb::RevertRequest) -> Result<Self, RegistryError> {
        let manifest: Manifest = Field::read("manifest", r.manifest)?;
        if manifest.reverts_to.is_none() {
            return Err(RegistryError::Missing { field: "reverts_to" });
        }
        Ok((manifest, reason("reason", r.reason)?))
    }
}

impl TryFrom<pb::QuarantineRequest> for QuarantineState {
    type Error = RegistryError;

    fn try_from(r: pb::QuarantineRequest) -> Result<Self, RegistryError> {
        Ok(Self {
            stream: StreamName::new(&r.stream)?,
            version: r.version,
            reason: reason("reason", r.reason)?,
            by: String::new(),
            generation: 0,
            unix_ms: 0,
        })
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
        Ok((nonce(r.nonce)?, StreamName::new(&r.stream)?, label))
    }
}

impl TryFrom<pb::FreshnessResponse> for SignedFreshness {
    type Error = RegistryError;

    fn try_from(r: pb::FreshnessResponse) -> Result<Self, RegistryError> {
        let signature = r.signature.ok_or(RegistryError::Missing { field: "signature" })?;
        Ok(Self {
            said: Freshness {
                nonce: nonce(r.nonce)?,
                stream: StreamName::new(&r.stream)?,
                label: LabelName::new(&r.label)?,
                version: r.version,
                sha256: Field::read("sha256", r.sha256)?,
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
            signature: Some(f.signature.into()),
        }
    }
}

/// `None`: all streams.
impl TryFrom<pb::OverviewRequest> for Option<StreamName> {
    type Error = RegistryError;

    fn try_from(r: pb::OverviewRequest) -> Result<Self, RegistryError> {
        Field::read("stream", r.stream)
    }
}

/// The manifest that was asked for.
impl TryFrom<pb::GetManifestResponse> for Manifest {
    type Error = RegistryError;

    fn try_from(r: pb::GetManifestResponse) -> Result<Self, RegistryError> {
        Field::read("manifest", r.manifest)
    }
}

impl TryFrom<pb::FetchResponse> for FetchPart {
    type Error = RegistryError;

    fn try_from(r: pb::FetchResponse) -> Result<Self, RegistryError> {
        match r.part.ok_or(RegistryError::Missing { field: "part" })? {
            pb::fetch_response::Part::Data(data) => {
                range("data", data.len() as u64, 1, FETCH_CHUNK_BYTES as u64)?;
                Ok(Self::Data(data.into()))
            }
            pb::fetch_response::Part::Info(info) => match info.status() {
                pb::fetch_info::Status::NotModified => Ok(Self::NotModified),
                pb::fetch_info::Status::ContentFollows => {
                    range("size", info.size, 1, MAX_POLICY_BYTES)?;
                    range("offset", info.offset, 0, info.size)?;
                    let sha256 = Field::read("sha256", info.sha256)?;
                    Ok(Self::Info(FetchInfo { sha256, size: info.size, offset: info.offset }))
                }
                pb::fetch_info::Status::Unspecified => {
                    Err(RegistryError::Missing { field: "status" })
                }
            },
        }
    }
}

impl TryFrom<pb::WatchEvent> for WatchEvent {
    type Error = RegistryError;

    fn try_from(e: pb::WatchEvent) -> Result<Self, RegistryError> {
        let change = match e.event.ok_or(RegistryError::Missing { field: "event" })? {
            pb::watch_event::Event::Snapshot(s) => WatchChange::Snapshot(read_all(s.manifests)?),
            pb::watch_event::Event::Published(m) => {
                WatchChange::Published(Box::new(Manifest::try_from(m)?))
            }
            pb::watch_event::Event::Progress(pb::Progress {}) => WatchChange::Progress,
            pb::watch_event::Event::LabelMoved(s) => {
                WatchChange::LabelMoved(Box::new(s.try_into()?))
            }
            pb::watch_event::Event::Quarantined(s) => {
                WatchChange::Quarantined(Box::new(s.try_into()?))
            }
        };
        Ok(Self { generation: e.generation, change })
    }
}

impl TryFrom<pb::AuditResponse> for AuditPage {
    type Error = RegistryError;

    fn try_from(r: pb::AuditResponse) -> Result<Self, RegistryError> {
        read_all(r.entries)
    }
}

fn nonce(bytes: Vec<u8>) -> Result<[u8; NONCE_BYTES], RegistryError> {
    let exactly = NONCE_BYTES as u64;
    range("nonce", bytes.len() as u64, exactly, exactly)?;
    Field::read("nonce", bytes)
}

/// Text of so many characters.
fn ascii<const MIN: usize, const MAX: usize>(
    field: &'static str,
    text: String,
) -> Result<String, RegistryError> {
    if (MIN..=MAX).contains(&text.len()) && text.bytes().all(|b| b.is_ascii_graphic()) {
        return Ok(text);
    }
    let (min, max) = (MIN, MAX);
    Err(RegistryError::Text { field, min, max })
}

/// One line of any language, which may be empty.
fn words(field: &'static str, words: String) -> Result<String, RegistryError> {
    line(field, words, 0)
}

/// The same, not empty.
fn reason(field: &'static str, words: String) -> Result<String, RegistryError> {
    line(field, words, 1)
}

/// The same, or nothing.
fn maybe(field: &'static str, words: String) -> Result<Option<String>, RegistryError> {
    let words = line(field, words, 0)?;
    Ok(Some(words).filter(|words| !words.is_empty()))
}

fn line(field: &'static str, words: String, min: usize) -> Result<String, RegistryError> {
    if (min..=MAX_REASON).contains(&words.len()) && !words.chars().any(char::is_control) {
        return Ok(words);
    }
    let max = MAX_REASON;
    Err(RegistryError::Words { field, min, max })
}

fn range(field: &'static str, found: u64, min: u64, max: u64) -> Result<(), RegistryError> {
    if (min..=max).contains(&found) {
        return Ok(());
    }
    Err(RegistryError::Range { field, found, min, max })
}

/// Empty, or the text of one JSON object.
fn evaluation(_: &'static str, json: String) -> Result<Option<String>, RegistryError> {
    if json.is_empty() {
        return Ok(None);
    }
    let object = json.trim_start().starts_with('{');
    if json.len() > MAX_EVALUATION_BYTES
        || !object
        || serde_json::from_str::<IgnoredAny>(&json).is_err()
    {
        return Err(RegistryError::Evaluation);
    }
    Ok(Some(json))
}
