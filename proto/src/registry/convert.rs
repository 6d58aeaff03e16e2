//! Between the generated messages and the checked values.

use serde::de::IgnoredAny;

use super::{
    FETCH_CHUNK_BYTES, FetchInfo, FetchPart, FetchRequest, LabelName, ListPage, ListRequest,
    MAX_EVALUATION_BYTES, MAX_POLICY_BYTES, MAX_SIGNATURES, Manifest, ManifestRequest, Published,
    RegistryError, Signature, StreamName, WatchChange, WatchEvent, WatchRequest,
};
use crate::wire::registry as pb;

impl TryFrom<pb::Manifest> for Manifest {
    type Error = RegistryError;

    fn try_from(m: pb::Manifest) -> Result<Self, RegistryError> {
        range("size", m.size, 1, MAX_POLICY_BYTES)?;
        range(
            "signatures",
            m.signatures.len() as u64,
            0,
            MAX_SIGNATURES as u64,
        )?;
        if m.reverts_to.is_some_and(|old| old >= m.version) {
            return Err(RegistryError::Together(
                "`reverts_to` must be below `version`",
            ));
        }
        Ok(Self {
            stream: StreamName::new(&m.stream)?,
            version: m.version,
            sha256: hash("sha256", &m.sha256)?,
            size: m.size,
            created_unix_ms: m.created_unix_ms,
            run_id: text("run_id", m.run_id, 1, 128)?,
            contract_hash: hash("contract_hash", &m.contract_hash)?,
            robot_name: text("robot_name", m.robot_name, 1, 64)?,
            robot_hash: hash("robot_hash", &m.robot_hash)?,
            env_steps: m.env_steps,
            training_commit: text("training_commit", m.training_commit, 0, 64)?,
            config_hash: text("config_hash", m.config_hash, 0, 64)?,
            evaluation_json: evaluation(m.evaluation_json)?,
            reverts_to: m.reverts_to,
            signatures: m
                .signatures
                .into_iter()
                .map(Signature::try_from)
                .collect::<Result<_, _>>()?,
        })
    }
}

impl From<Manifest> for pb::Manifest {
    fn from(m: Manifest) -> Self {
        Self {
            stream: m.stream.0,
            version: m.version,
            sha256: m.sha256.to_vec(),
            size: m.size,
            created_unix_ms: m.created_unix_ms,
            run_id: m.run_id,
            contract_hash: m.contract_hash.to_vec(),
            robot_name: m.robot_name,
            robot_hash: m.robot_hash.to_vec(),
            env_steps: m.env_steps,
            training_commit: m.training_commit,
            config_hash: m.config_hash,
            evaluation_json: m.evaluation_json.unwrap_or_default(),
            reverts_to: m.reverts_to,
            signatures: m
                .signatures
                .into_iter()
                .map(|s| pb::Signature {
                    key_id: s.key_id,
                    signature: s.signature,
                })
                .collect(),
        }
    }
}

impl TryFrom<pb::Signature> for Signature {
    type Error = RegistryError;

    fn try_from(s: pb::Signature) -> Result<Self, RegistryError> {
        range("signature", s.signature.len() as u64, 1, 512)?;
        Ok(Self {
            key_id: text("key_id", s.key_id, 1, 64)?,
            signature: s.signature,
        })
    }
}

impl TryFrom<pb::PublishResponse> for Published {
    type Error = RegistryError;

    fn try_from(p: pb::PublishResponse) -> Result<Self, RegistryError> {
        Ok(Self {
            manifest: manifest(p.manifest)?,
            generation: p.generation,
            already_present: p.already_present,
        })
    }
}

impl From<Published> for pb::PublishResponse {
    fn from(p: Published) -> Self {
        Self {
            manifest: Some(p.manifest.into()),
            generation: p.generation,
            already_present: p.already_present,
        }
    }
}

impl TryFrom<pb::ListRequest> for ListRequest {
    type Error = RegistryError;

    fn try_from(r: pb::ListRequest) -> Result<Self, RegistryError> {
        Ok(Self {
            stream: optional_stream(&r.stream)?,
            limit: r.limit,
            below_version: r.below_version,
        })
    }
}

impl From<ListRequest> for pb::ListRequest {
    fn from(r: ListRequest) -> Self {
        Self {
            stream: r.stream.map(|s| s.0).unwrap_or_default(),
            limit: r.limit,
            below_version: r.below_version,
        }
    }
}

impl TryFrom<pb::ListResponse> for ListPage {
    type Error = RegistryError;

    fn try_from(r: pb::ListResponse) -> Result<Self, RegistryError> {
        Ok(Self {
            manifests: manifests(r.manifests)?,
            generation: r.generation,
            more: r.more,
        })
    }
}

impl From<ListPage> for pb::ListResponse {
    fn from(p: ListPage) -> Self {
        Self {
            manifests: p.manifests.into_iter().map(Into::into).collect(),
            generation: p.generation,
            more: p.more,
        }
    }
}

impl TryFrom<pb::GetManifestRequest> for ManifestRequest {
    type Error = RegistryError;

    fn try_from(r: pb::GetManifestRequest) -> Result<Self, RegistryError> {
        let label = match r.label.as_str() {
            "" => None,
            name => Some(LabelName::new(name)?),
        };
        if label.is_some() && r.version.is_some() {
            return Err(RegistryError::Together("a version or a label, not both"));
        }
        Ok(Self {
            stream: StreamName::new(&r.stream)?,
            version: r.version,
            label,
        })
    }
}

impl From<ManifestRequest> for pb::GetManifestRequest {
    fn from(r: ManifestRequest) -> Self {
        Self {
            stream: r.stream.0,
            version: r.version,
            label: r.label.map(|label| label.0).unwrap_or_default(),
        }
    }
}

/// The manifest and the registry's change counter.
impl TryFrom<pb::GetManifestResponse> for (Manifest, u64) {
    type Error = RegistryError;

    fn try_from(r: pb::GetManifestResponse) -> Result<Self, RegistryError> {
        Ok((manifest(r.manifest)?, r.generation))
    }
}

impl TryFrom<pb::FetchRequest> for FetchRequest {
    type Error = RegistryError;

    fn try_from(r: pb::FetchRequest) -> Result<Self, RegistryError> {
        range("offset", r.offset, 0, MAX_POLICY_BYTES)?;
        let held = &r.if_none_match;
        let if_none_match = if held.is_empty() {
            None
        } else {
            Some(hash("if_none_match", held)?)
        };
        Ok(Self {
            sha256: hash("sha256", &r.sha256)?,
            offset: r.offset,
            if_none_match,
        })
    }
}

impl From<FetchRequest> for pb::FetchRequest {
    fn from(r: FetchRequest) -> Self {
        Self {
            sha256: r.sha256.to_vec(),
            offset: r.offset,
            if_none_match: r.if_none_match.map(|h| h.to_vec()).unwrap_or_default(),
        }
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
                    let sha256 = hash("sha256", &info.sha256)?;
                    Ok(Self::Info(FetchInfo {
                        sha256,
                        size: info.size,
                        offset: info.offset,
                    }))
                }
                pb::fetch_info::Status::Unspecified => {
                    Err(RegistryError::Missing { field: "status" })
                }
            },
        }
    }
}

impl From<FetchPart> for pb::FetchResponse {
    fn from(part: FetchPart) -> Self {
        let info = |status, i: Option<FetchInfo>| {
            pb::fetch_response::Part::Info(pb::FetchInfo {
                status: i32::from(status),
                sha256: i.as_ref().map(|i| i.sha256.to_vec()).unwrap_or_default(),
                size: i.as_ref().map_or(0, |i| i.size),
                offset: i.as_ref().map_or(0, |i| i.offset),
            })
        };
        let part = match part {
            FetchPart::Data(data) => pb::fetch_response::Part::Data(data.into()),
            FetchPart::NotModified => info(pb::fetch_info::Status::NotModified, None),
            FetchPart::Info(i) => info(pb::fetch_info::Status::ContentFollows, Some(i)),
        };
        Self { part: Some(part) }
    }
}

impl TryFrom<pb::WatchRequest> for WatchRequest {
    type Error = RegistryError;

    fn try_from(r: pb::WatchRequest) -> Result<Self, RegistryError> {
        Ok(Self {
            stream: optional_stream(&r.stream)?,
            since_generation: r.since_generation,
        })
    }
}

impl From<WatchRequest> for pb::WatchRequest {
    fn from(r: WatchRequest) -> Self {
        Self {
            stream: r.stream.map(|s| s.0).unwrap_or_default(),
            since_generation: r.since_generation,
        }
    }
}

impl TryFrom<pb::WatchEvent> for WatchEvent {
    type Error = RegistryError;

    fn try_from(e: pb::WatchEvent) -> Result<Self, RegistryError> {
        let change = match e.event.ok_or(RegistryError::Missing { field: "event" })? {
            pb::watch_event::Event::Snapshot(s) => WatchChange::Snapshot(manifests(s.manifests)?),
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
        Ok(Self {
            generation: e.generation,
            change,
        })
    }
}

impl From<WatchEvent> for pb::WatchEvent {
    fn from(e: WatchEvent) -> Self {
        let event = match e.change {
            WatchChange::Snapshot(manifests) => pb::watch_event::Event::Snapshot(pb::Snapshot {
                manifests: manifests.into_iter().map(Into::into).collect(),
            }),
            WatchChange::Published(m) => pb::watch_event::Event::Published((*m).into()),
            WatchChange::Progress => pb::watch_event::Event::Progress(pb::Progress {}),
            WatchChange::LabelMoved(s) => pb::watch_event::Event::LabelMoved((*s).into()),
            WatchChange::Quarantined(s) => pb::watch_event::Event::Quarantined((*s).into()),
        };
        Self {
            generation: e.generation,
            event: Some(event),
        }
    }
}

fn manifest(m: Option<pb::Manifest>) -> Result<Manifest, RegistryError> {
    Manifest::try_from(m.ok_or(RegistryError::Missing { field: "manifest" })?)
}

fn manifests(list: Vec<pb::Manifest>) -> Result<Vec<Manifest>, RegistryError> {
    list.into_iter().map(Manifest::try_from).collect()
}

/// An empty name means all streams.
pub(super) fn optional_stream(name: &str) -> Result<Option<StreamName>, RegistryError> {
    if name.is_empty() {
        Ok(None)
    } else {
        StreamName::new(name).map(Some)
    }
}

pub(super) fn hash(field: &'static str, bytes: &[u8]) -> Result<[u8; 32], RegistryError> {
    bytes.try_into().map_err(|_| RegistryError::HashLength {
        field,
        found: bytes.len(),
    })
}

pub(super) fn text(
    field: &'static str,
    text: String,
    min: usize,
    max: usize,
) -> Result<String, RegistryError> {
    if (min..=max).contains(&text.len()) && text.bytes().all(|b| b.is_ascii_graphic()) {
        return Ok(text);
    }
    Err(RegistryError::Text { field, min, max })
}

pub(super) fn range(
    field: &'static str,
    found: u64,
    min: u64,
    max: u64,
) -> Result<(), RegistryError> {
    if (min..=max).contains(&found) {
        return Ok(());
    }
    Err(RegistryError::Range {
        field,
        found,
        min,
        max,
    })
}

/// Empty, or the text of one JSON object.
fn evaluation(json: String) -> Result<Option<String>, RegistryError> {
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
