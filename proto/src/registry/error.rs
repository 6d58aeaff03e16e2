//! The limits of the registry's messages, and why one is refused.

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

/// Longest reason that is kept, bytes.
pub const MAX_REASON: usize = 400;
/// Bytes of a nonce.
pub const NONCE_BYTES: usize = 32;

/// Why a message was refused.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
#[non_exhaustive]
#[expect(missing_docs, reason = "a message says what its fields are")]
pub enum RegistryError {
    /// A part that must be there is not.
    #[error("message lacks `{field}`")]
    Missing { field: &'static str },
    /// A stream name that could not be told from a path trick.
    #[error(
        "stream name must be 1 to 64 characters of a-z, 0-9, `-`, `_`, `.` in parts separated by `/`, none of them starting with a dot"
    )]
    StreamName,
    /// Text that is empty, too long or not printable.
    #[error("`{field}` must be {min} to {max} printable ASCII characters")]
    Text { field: &'static str, min: usize, max: usize },
    /// A hash that is not 32 bytes long.
    #[error("`{field}` has {found} bytes, a SHA-256 has 32")]
    HashLength { field: &'static str, found: usize },
    /// A number out of its range.
    #[error("`{field}` is {found}, must be {min} to {max}")]
    Range { field: &'static str, found: u64, min: u64, max: u64 },
    /// Bytes that are no message.
    #[error("these bytes are no manifest")]
    Encoding,
    /// A label that is not one.
    #[error("a label is 1 to 32 characters of a-z, 0-9 and `-`")]
    Label,
    /// Words that are too long or hold control characters.
    #[error("`{field}` must be {min} to {max} bytes in one line")]
    Words { field: &'static str, min: usize, max: usize },
    /// Things that do not go together.
    #[error("{0}")]
    Together(&'static str),
    /// An evaluation summary that is too long or not one JSON object.
    #[error("`evaluation_json` must be one JSON object of at most 65536 bytes")]
    Evaluation,
}
