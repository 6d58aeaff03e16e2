//! The policy registry's messages as checked values.
//!
//! The gRPC service and client are generated ([`crate::wire::registry`]); a server turns each
//! request into a type of this module before it looks at it, a client does so with each answer.

mod convert;
mod convert_people;
mod people;
pub mod question;
#[cfg(test)]
mod tests;

pub use people::{
    AuditEntry, AuditPage, Freshness, LabelName, LabelState, MAX_REASON, NONCE_BYTES, Overview,
    QuarantineState, RobotReport, RobotState, SetLabel, SignedFreshness, reverting,
};

use prost::Message;
use thiserror::Error;

/// Largest policy file that may be published, bytes.
pub const MAX_POLICY_BYTES: u64 = 8 << 20;
/// Bytes in one piece of a Fetch.
pub const FETCH_CHUNK_BYTES: usize = 64 << 10;
/// Largest piece of a Publish, bytes.
pub const MAX_PUBLISH_CHUNK_BYTES: usize = 128 << 10;
/// Longest stream name, bytes.
pub const MAX_STREAM_NAME: usize = 64;
/// Longest evaluation summary, bytes.
pub const MAX_EVALUATION_BYTES: usize = 64 << 10;
/// Most signatures on a manifest.
pub const MAX_SIGNATURES: usize = 16;

/// Why a message was refused.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
#[non_exhaustive]
pub enum RegistryError {
    /// A part that must be there is not.
    #[error("message lacks `{field}`")]
    Missing {
        /// Which part.
        field: &'static str,
    },
    /// A stream name that could not be told from a path trick.
    #[error(
        "stream name must be 1 to 64 characters of a-z, 0-9, `-`, `_`, `.` in parts separated by `/`, none of them starting with a dot"
    )]
    StreamName,
    /// Text that is empty, too long or not printable.
    #[error("`{field}` must be {min} to {max} printable ASCII characters")]
    Text {
        /// Which text.
        field: &'static str,
        /// Fewest characters.
        min: usize,
        /// Most characters.
        max: usize,
    },
    /// A hash that is not 32 bytes long.
    #[error("`{field}` has {found} bytes, a SHA-256 has 32")]
    HashLength {
        /// Which hash.
        field: &'static str,
        /// Its length.
        found: usize,
    },
    /// A number out of its range.
    #[error("`{field}` is {found}, must be {min} to {max}")]
    Range {
        /// Which number.
        field: &'static str,
        /// Its value.
        found: u64,
        /// Smallest value allowed.
        min: u64,
        /// Largest value allowed.
        max: u64,
    },
    /// Bytes that are no message.
    #[error("these bytes are no manifest")]
    Encoding,
    /// A label that is not one.
    #[error("a label is 1 to 32 characters of a-z, 0-9 and `-`")]
    Label,
    /// Words that are too long or hold control characters.
    #[error("`{field}` must be {min} to {max} bytes in one line")]
    Words {
        /// Which words.
        field: &'static str,
        /// Fewest bytes.
        min: usize,
        /// Most bytes.
        max: usize,
    },
    /// Things that do not go together.
    #[error("{0}")]
    Together(&'static str),
    /// An evaluation summary that is too long or not one JSON object.
    #[error("`evaluation_json` must be one JSON object of at most 65536 bytes")]
    Evaluation,
}

/// Name of a line of policies, such as `polymander/flat`. Safe as a relative path.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct StreamName(String);

impl StreamName {
    /// A checked name.
    ///
    /// # Errors
    /// [`RegistryError::StreamName`] says what a name may look like.
    pub fn new(name: &str) -> Result<Self, RegistryError> {
        let letter = |b: u8| matches!(b, b'a'..=b'z' | b'0'..=b'9' | b'-' | b'_' | b'.');
        let part = |p: &str| !p.is_empty() && !p.starts_with('.') && p.bytes().all(letter);
        if name.len() <= MAX_STREAM_NAME && name.split('/').all(part) {
            return Ok(Self(name.to_owned()));
        }
        Err(RegistryError::StreamName)
    }

    /// The name.
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

impl std::fmt::Display for StreamName {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(&self.0)
    }
}

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
    ///
    /// # Errors
    /// [`RegistryError`].
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
