//! What people and robots say about versions: labels, quarantine, reports, freshness, and the record of who
//! changed what.

use super::{Manifest, RegistryError, Signature, StreamName};

/// Longest reason that is kept, bytes.
pub const MAX_REASON: usize = 400;
/// Bytes of a nonce.
pub const NONCE_BYTES: usize = 32;

/// A label such as `stable`. Safe as a file name.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct LabelName(pub(super) String);

impl LabelName {
    /// The newest version that is not quarantined; moves by itself.
    pub const LATEST: &str = "latest";
    /// Needs robots that say that it went well.
    pub const STABLE: &str = "stable";

    /// A checked name.
    ///
    /// # Errors
    /// [`RegistryError::Label`].
    pub fn new(name: &str) -> Result<Self, RegistryError> {
        let letter = |b: u8| matches!(b, b'a'..=b'z' | b'0'..=b'9' | b'-');
        if (1..=32).contains(&name.len()) && name.bytes().all(letter) {
            return Ok(Self(name.to_owned()));
        }
        Err(RegistryError::Label)
    }

    /// [`LabelName::LATEST`].
    #[must_use]
    pub fn latest() -> Self {
        Self(Self::LATEST.to_owned())
    }

    /// Whether it moves by itself.
    #[must_use]
    pub fn is_latest(&self) -> bool {
        self.0 == Self::LATEST
    }

    /// Whether robots must have said that the version went well.
    #[must_use]
    pub fn needs_proof(&self) -> bool {
        self.0 == Self::STABLE
    }

    /// The name.
    #[must_use]
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

impl std::fmt::Display for LabelName {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(&self.0)
    }
}

impl std::str::FromStr for LabelName {
    type Err = RegistryError;

    fn from_str(text: &str) -> Result<Self, RegistryError> {
        Self::new(text)
    }
}

/// Where a label leads.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LabelState {
    /// Of which stream.
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
    /// Of which stream.
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
    /// Of which stream.
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

/// What became of a version on a robot.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RobotState {
    /// Checked, waits for a safe moment.
    Armed,
    /// Drives the robot, on trial.
    Trial,
    /// Went through its trial.
    Good,
    /// A check refused it.
    Refused,
    /// It ran and failed.
    Failed,
}

impl RobotState {
    /// Whether it is one of an Ack.
    #[must_use]
    pub fn went_well(self) -> bool {
        matches!(self, Self::Armed | Self::Trial | Self::Good)
    }

    /// Its word, as in files and pages.
    #[must_use]
    pub fn word(self) -> &'static str {
        match self {
            Self::Armed => "armed",
            Self::Trial => "trial",
            Self::Good => "good",
            Self::Refused => "refused",
            Self::Failed => "failed",
        }
    }

    /// The state of a word.
    #[must_use]
    pub fn of_word(word: &str) -> Option<Self> {
        [
            Self::Armed,
            Self::Trial,
            Self::Good,
            Self::Refused,
            Self::Failed,
        ]
        .into_iter()
        .find(|state| state.word() == word)
    }
}

/// What a robot says about a version.
#[derive(Debug, Clone, PartialEq)]
pub struct RobotReport {
    /// Name of the robot.
    pub robot: String,
    /// Of which stream.
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
    /// Of which stream.
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
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct AuditEntry {
    /// Counts from 1.
    pub number: u64,
    /// When, by the server's clock.
    pub unix_ms: u64,
    /// Who.
    pub by: String,
    /// What kind of change.
    pub what: String,
    /// Of which stream.
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
#[must_use]
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
