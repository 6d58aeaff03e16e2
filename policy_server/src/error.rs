//! What can go wrong in the store, each case with the answer a caller needs.

use std::path::PathBuf;

use caudata_durable::DurableError;
use caudata_proto::registry::RegistryError;
use tonic::Status;

/// Why the store refused or failed. A refusal leaves everything that was stored before untouched.
#[derive(Debug, thiserror::Error)]
#[expect(missing_docs, reason = "a message says what its fields are")]
pub enum StoreError {
    /// The same version was published before with other bytes.
    #[error(
        "{stream} version {version} exists with other bytes ({stored}); publish a higher version instead"
    )]
    VersionTaken {
        /// Stream in question.
        stream: String,
        /// Version in question.
        version: u64,
        /// SHA-256 (hex) of the bytes that hold the version.
        stored: String,
    },
    /// A number that no version bears any more, and none may bear again.
    #[error("{stream} version {version} is used up: {why}; publish a higher version instead")]
    UsedUp { stream: String, version: u64, why: String },
    /// The bytes are not those that the header announced.
    #[error("uploaded bytes hash to {actual}, the header says {announced}; send the file again")]
    HashMismatch { announced: String, actual: String },
    /// The stream's robots expect another contract.
    #[error(
        "contract {actual} does not fit stream {stream}, which holds {expected}; use another stream"
    )]
    ContractMismatch {
        /// Stream in question.
        stream: String,
        /// Contract hash (hex) of the stream's newest version.
        expected: String,
        /// Contract hash (hex) of the refused file.
        actual: String,
    },
    /// The header and the file's own metadata disagree.
    #[error("header and policy file disagree on {field}: {header} against {file}")]
    HeaderMismatch { field: &'static str, header: String, file: String },
    /// Nothing is stored under this name.
    #[error("{what} is not in the store")]
    NotFound { what: String },
    /// Stored bytes no longer match their name.
    #[error("{path} is damaged on disk and was set aside; publish it again")]
    Damaged { path: PathBuf },
    /// Somebody else moved the label.
    #[error(
        "label {label} of {stream} was moved meanwhile (change {found}, expected {expected}); look again and decide anew"
    )]
    LabelMoved { stream: String, label: String, found: u64, expected: u64 },
    /// A label must not lead there, or a version must not be published so.
    #[error("{reason}")]
    NotAllowed {
        /// What speaks against it, and what to do.
        reason: String,
    },
    /// Nothing is changed until the disk takes it again.
    #[error(
        "the store is read-only since {reason}; what it holds is still served, and it looks by itself whether the disk works again"
    )]
    ReadOnly { reason: String },
    /// There are as many of something as may be.
    #[error("{reason}")]
    Full {
        /// What there is too much of, and what to do.
        reason: String,
    },
    /// A stored file is there and cannot be read now.
    #[error("cannot read {path} now: {source}; try again in a moment")]
    Unreadable {
        /// The file.
        path: PathBuf,
        /// What the system says, for instance that the process has too many files open.
        source: std::io::Error,
    },
    /// The data folder cannot be used at all.
    #[error("cannot use {path} as the store: {reason}")]
    Unusable { path: PathBuf, reason: String },
    /// Writing failed.
    #[error(transparent)]
    Durable(#[from] DurableError),
}

/// Why a file of the store could not be read.
#[derive(Debug, thiserror::Error)]
#[expect(missing_docs, reason = "a message says what its fields are")]
pub enum RecordError {
    /// Not the JSON this server writes.
    #[error("not a record: {0}")]
    Json(#[from] serde_json::Error),
    /// The content is not what was written.
    #[error("it has no checksum, or not that of its content")]
    Checksum,
    /// Written by another version of the server.
    #[error("record format {found} is unknown; use a newer server")]
    Format { found: u32 },
    /// A hash that is not 64 hexadecimal digits.
    #[error("a hash is not 64 hexadecimal digits")]
    Hash,
    /// A value that nothing published can have.
    #[error(transparent)]
    Message(#[from] RegistryError),
}

impl From<&StoreError> for Status {
    fn from(error: &StoreError) -> Self {
        let message = error.to_string();
        match error {
            StoreError::VersionTaken { .. } | StoreError::UsedUp { .. } => {
                Self::already_exists(message)
            }
            StoreError::HashMismatch { .. } | StoreError::HeaderMismatch { .. } => {
                Self::invalid_argument(message)
            }
            StoreError::ContractMismatch { .. } | StoreError::NotAllowed { .. } => {
                Self::failed_precondition(message)
            }
            StoreError::LabelMoved { .. } => Self::aborted(message),
            StoreError::NotFound { .. } => Self::not_found(message),
            StoreError::Damaged { .. } => Self::data_loss(message),
            StoreError::Full { .. } => Self::resource_exhausted(message),
            StoreError::Durable(durable) if durable.is_disk_full() => {
                Self::resource_exhausted(message)
            }
            StoreError::ReadOnly { .. }
            | StoreError::Unreadable { .. }
            | StoreError::Durable(_) => Self::unavailable(message),
            StoreError::Unusable { .. } => Self::internal(message),
        }
    }
}
