//! What can go wrong in the store, each case with the answer a caller needs.

use std::path::PathBuf;

use caudata_durable::DurableError;

/// Why the store refused or failed. A refusal leaves everything that was stored before untouched.
#[derive(Debug, thiserror::Error)]
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
    /// The bytes are not those that the header announced.
    #[error("uploaded bytes hash to {actual}, the header says {announced}; send the file again")]
    HashMismatch {
        /// SHA-256 (hex) in the header.
        announced: String,
        /// SHA-256 (hex) of what arrived.
        actual: String,
    },
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
    HeaderMismatch {
        /// Which field.
        field: &'static str,
        /// Value in the header.
        header: String,
        /// Value in the file.
        file: String,
    },
    /// Nothing is stored under this name.
    #[error("{what} is not in the store")]
    NotFound {
        /// What was asked for.
        what: String,
    },
    /// Stored bytes no longer match their name.
    #[error("{path} is damaged on disk and was set aside; publish it again")]
    Damaged {
        /// The damaged file.
        path: PathBuf,
    },
    /// Somebody else moved the label.
    #[error(
        "label {label} of {stream} was moved meanwhile (change {found}, expected {expected}); look again and decide anew"
    )]
    LabelMoved {
        /// Stream in question.
        stream: String,
        /// Label in question.
        label: String,
        /// The label's generation.
        found: u64,
        /// What the caller expected.
        expected: u64,
    },
    /// A label must not lead there, or a version must not be published so.
    #[error("{reason}")]
    NotAllowed {
        /// What speaks against it, and what to do.
        reason: String,
    },
    /// Nothing is changed any more until a person has looked at the disk.
    #[error(
        "the store is read-only since {reason}; what it holds is still served. Look at the disk, then start the server again"
    )]
    ReadOnly {
        /// What happened.
        reason: String,
    },
    /// Too many labels.
    #[error("{stream} has its limit of {limit} labels; use one of them")]
    TooManyLabels {
        /// Stream in question.
        stream: String,
        /// The limit.
        limit: usize,
    },
    /// Too many streams.
    #[error("the store holds its limit of {limit} streams; remove one or raise the limit")]
    TooManyStreams {
        /// The limit.
        limit: usize,
    },
    /// The data folder cannot be used at all.
    #[error("cannot use {path} as the store: {reason}")]
    Unusable {
        /// The data folder.
        path: PathBuf,
        /// Why.
        reason: String,
    },
    /// Writing failed.
    #[error(transparent)]
    Durable(#[from] DurableError),
}
