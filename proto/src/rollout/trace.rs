//! Where something belongs in a trace: the identifiers that travel with a chunk.

use super::error::DecodeError;

/// Bytes on the wire.
const LEN: usize = 24;

/// A span of a trace.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TraceContext {
    /// Identifier of the trace.
    pub trace: [u8; 16],
    /// Identifier of the span.
    pub span: [u8; 8],
}

impl TraceContext {
    /// The root span of the trace of one policy version: whoever has the policy's SHA-256 finds its trace,
    /// which is the first 16 bytes of it; the next 8 are the root span.
    pub fn of_policy(sha256: &[u8; 32]) -> Self {
        let (mut trace, mut span) = ([0; 16], [0; 8]);
        trace.copy_from_slice(&sha256[..16]);
        span.copy_from_slice(&sha256[16..24]);
        Self { trace, span }
    }

    pub(super) fn to_wire(self) -> Vec<u8> {
        [&self.trace[..], &self.span[..]].concat()
    }

    /// `None` where nothing is traced.
    pub(super) fn from_wire(bytes: &[u8]) -> Result<Option<Self>, DecodeError> {
        if bytes.is_empty() {
            return Ok(None);
        }
        let whole: [u8; LEN] = bytes.try_into().map_err(|_| DecodeError::Length {
            field: "trace",
            found: bytes.len(),
            expected: LEN,
        })?;
        let (mut trace, mut span) = ([0; 16], [0; 8]);
        trace.copy_from_slice(&whole[..16]);
        span.copy_from_slice(&whole[16..]);
        Ok(Some(Self { trace, span }))
    }
}
