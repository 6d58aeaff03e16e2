//! What is asked and answered: versions, and what people and robots say about them.

use caudata_declare::named;
use prost::Message;
use serde::Serialize;

use super::error::{NONCE_BYTES, RegistryError};
use super::names::{LabelName, StreamName};

/// What the registry knows about one published policy file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Manifest {
    /// Line of policies that a robot follows.
    pub stream: StreamName,
    /// Grows along the stream.
    pub version: u64,
    /// SHA-256 of the file, its name in the store.
    pub sha256: [u8; 32],
    /// Bytes of the file, 1 to [`MAX_POLICY_BYTES`].
    pub size: u64,
    /// Milliseconds since 1970-01-01 UTC, by the publisher's clock.
    pub created_unix_ms: u64,
    /// The training run.
    pub run_id: String,
    /// SHA-256 of the policy contract.
    pub contract_hash: [u8; 32],
    /// Name of the robot model.
    pub robot_name: String,
    /// SHA-256 over the robot file and its model.
    pub robot_hash: [u8; 32],
    /// Environment steps that training had seen.
    pub env_steps: u64,
    /// Commit of the program that trained it; empty where unknown.
    pub training_commit: String,
    /// Hash of the training configuration; empty where unknown.
    pub config_hash: String,
    /// Summary of an evaluation as one JSON object; `None` where there was none.
    pub evaluation_json: Option<String>,
    /// The version whose bytes these are, where an older one is published again; always below `version`.
    pub reverts_to: Option<u64>,
    /// Detached signatures; empty until policies are signed.
    pub signatures: Vec<Signature>,
}

impl Manifest {
    /// As it goes over the network, for a file.
    pub fn to_bytes(&self) -> Vec<u8> {
        crate::wire::registry::Manifest::from(self.clone()).encode_to_vec()
    }

    /// Reads it back, with the same checks as one from the network.
    pub fn from_bytes(bytes: &[u8]) -> Result<Self, RegistryError> {
        let decoded = crate::wire::registry::Manifest::decode(bytes);
        decoded.map_err(|_| RegistryError::Encoding)?.try_into()
    }
}

/// A detached signature over a manifest.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Signature {
    /// Which key; 1 to 64 characters.
    pub key_id: String,
    /// 1 to 512 bytes.
    pub signature: Vec<u8>,
}

/// What a publication came to.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Published {
    /// The manifest as stored.
    pub manifest: Manifest,
    /// The registry's change counter after this publication.
    pub generation: u64,
    /// The very same file was there already.
    pub already_present: bool,
}

/// Asks for manifests, newest first.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ListRequest {
    /// `None`: all streams.
    pub stream: Option<StreamName>,
    /// At most this many; 0: the server's limit.
    pub limit: u32,
    /// Only versions below this one.
    pub below_version: Option<u64>,
}

/// A page of manifests, newest first.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ListPage {
    /// The manifests.
    pub manifests: Vec<Manifest>,
    /// The registry's change counter.
    pub generation: u64,
    /// Older versions were left off.
    pub more: bool,
}

/// Asks for one manifest.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ManifestRequest {
    /// Which stream.
    pub stream: StreamName,
    /// `None`: the newest, or the label's.
    pub version: Option<u64>,
    /// The version that this label leads to; not together with `version`.
    pub label: Option<LabelName>,
}

/// Asks for a file's bytes.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FetchRequest {
    /// Which file.
    pub sha256: [u8; 32],
    /// Where to start.
    pub offset: u64,
    /// What the caller holds already.
    pub if_none_match: Option<[u8; 32]>,
}

/// One message of the answer to a Fetch.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum FetchPart {
    /// First message where bytes follow.
    Info(FetchInfo),
    /// First and only message where the caller holds the file already.
    NotModified,
    /// The next bytes, at most [`FETCH_CHUNK_BYTES`].
    Data(Vec<u8>),
}

/// What follows in a Fetch.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FetchInfo {
    /// Which file.
    pub sha256: [u8; 32],
    /// Bytes of the whole file, 1 to [`MAX_POLICY_BYTES`].
    pub size: u64,
    /// Where the bytes that follow begin; at most `size`.
    pub offset: u64,
}

/// Asks to be told of changes.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct WatchRequest {
    /// `None`: all streams.
    pub stream: Option<StreamName>,
    /// Generation seen last; 0: begin with a snapshot.
    pub since_generation: u64,
}

/// One message of the answer to a Watch.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct WatchEvent {
    /// The registry's change counter at this event.
    pub generation: u64,
    /// What happened.
    pub change: WatchChange,
}

/// What a [`WatchEvent`] tells.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum WatchChange {
    /// The newest manifest of each stream asked for.
    Snapshot(Vec<Manifest>),
    /// One new version.
    Published(Box<Manifest>),
    /// Nothing new; the server is alive.
    Progress,
    /// A label moved.
    LabelMoved(Box<LabelState>),
    /// A version is out of use.
    Quarantined(Box<QuarantineState>),
}

/// Where a label leads.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LabelState {
    /// The stream that it belongs to.
    pub stream: StreamName,
    /// Which label.
    pub label: LabelName,
    /// Where to.
    pub version: u64,
    /// The registry's change counter when it was moved there; 0 for `latest`.
    pub generation: u64,
    /// Who moved it; empty for `latest`.
    pub by: String,
    /// Why without the robots' reports; `None`: with them, or they were not needed.
    pub override_reason: Option<String>,
    /// When, by the server's clock; milliseconds since 1970-01-01 UTC.
    pub unix_ms: u64,
}

/// Asks to move a label.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SetLabel {
    /// The stream that it belongs to.
    pub stream: StreamName,
    /// Which label.
    pub label: LabelName,
    /// Where to.
    pub version: u64,
    /// The label's generation as the caller knows it; 0: there is none yet.
    pub expected_generation: u64,
    /// Moves `stable` without the robots' reports.
    pub override_reason: Option<String>,
}

/// A version out of use.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct QuarantineState {
    /// The stream that it belongs to.
    pub stream: StreamName,
    /// Which version.
    pub version: u64,
    /// Why.
    pub reason: String,
    /// Who said so; filled in by the server.
    pub by: String,
    /// The registry's change counter then; filled in by the server.
    pub generation: u64,
    /// When, by the server's clock.
    pub unix_ms: u64,
}

named! {
    /// What became of a version on a robot.
    #[derive(Debug, Clone, Copy, PartialEq, Eq)]
    pub enum RobotState {
        /// Checked, waits for a safe moment.
        Armed = "armed",
        /// Drives the robot, on trial.
        Trial = "trial",
        /// Went through its trial.
        Good = "good",
        /// A check refused it.
        Refused = "refused",
        /// It ran and failed.
        Failed = "failed",
    }
}

impl RobotState {
    /// Whether it is one of an Ack.
    pub fn went_well(self) -> bool {
        matches!(self, Self::Armed | Self::Trial | Self::Good)
    }

    /// Its number on the wire; they count from 1.
    pub(crate) fn number(self) -> i32 {
        self as i32 + 1
    }

    /// The state with this number.
    pub(crate) fn of_number(number: i32) -> Option<Self> {
        Self::ALL.into_iter().find(|state| state.number() == number)
    }
}

/// Walking after which a policy that never gave a bad action counts as good, s.
pub const TRIAL_S: f64 = 10.0;
/// Most walking that a report may tell of, s: ten years.
pub(super) const WALKED_MAX_S: f64 = 3.2e8;

/// What a robot says about a version.
#[derive(Debug, Clone, PartialEq)]
pub struct RobotReport {
    /// Name of the robot.
    pub robot: String,
    /// The stream that it belongs to.
    pub stream: StreamName,
    /// Which version.
    pub version: u64,
    /// Which bytes.
    pub sha256: [u8; 32],
    /// What became of it.
    pub state: RobotState,
    /// Why, where it did not go well.
    pub reason: String,
    /// Seconds that it drove the robot so far.
    pub walked_s: f64,
    /// Falls in its trial.
    pub falls: u32,
    /// Times that it was begun with.
    pub attempts: u32,
    /// When, by the server's clock; 0 from a robot.
    pub unix_ms: u64,
}

/// Where a label leads, bound to a nonce.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Freshness {
    /// What the asking side made up.
    pub nonce: [u8; NONCE_BYTES],
    /// The stream that it belongs to.
    pub stream: StreamName,
    /// Which label.
    pub label: LabelName,
    /// Where to.
    pub version: u64,
    /// Which bytes.
    pub sha256: [u8; 32],
}

/// The same with a signature.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SignedFreshness {
    /// What is said.
    pub said: Freshness,
    /// By whom.
    pub signature: Signature,
}

/// Labels, quarantine and reports.
#[derive(Debug, Clone, PartialEq)]
pub struct Overview {
    /// Labels, `latest` among them.
    pub labels: Vec<LabelState>,
    /// Versions out of use.
    pub quarantined: Vec<QuarantineState>,
    /// What robots said last about each version.
    pub reports: Vec<RobotReport>,
    /// The registry's change counter.
    pub generation: u64,
    /// Why nothing can be changed at present.
    pub read_only: Option<String>,
}

/// One line of the record of changes.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct AuditEntry {
    /// Counts from 1.
    pub number: u64,
    /// When, by the server's clock.
    pub unix_ms: u64,
    /// Who.
    pub by: String,
    /// What kind of change.
    pub what: String,
    /// The stream that it belongs to.
    pub stream: String,
    /// Which version.
    pub version: u64,
    /// Details.
    pub detail: String,
}

/// Some lines of it, newest first.
pub type AuditPage = Vec<AuditEntry>;

/// What a revert announces: the manifest of the new version, from the old one's.
///
/// `version` is the new, higher number. Signatures are left off: they covered the old number.
pub fn reverting(old: &Manifest, version: u64, created_unix_ms: u64) -> Manifest {
    Manifest {
        version,
        created_unix_ms,
        // A version that was itself a revert leads to the first one, whose number the file bears.
        reverts_to: Some(old.reverts_to.unwrap_or(old.version)),
        signatures: Vec::new(),
        ..old.clone()
    }
}
