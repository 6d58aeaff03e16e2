//! Whose chunk a frame is that does not decode, so that the refusal is put down to the right actor.

use prost::Message;

/// The head of a chunk: run, actor, incarnation, sequence.
#[derive(Clone, PartialEq, Eq, Hash, Message)]
pub(super) struct Identity {
    #[prost(string, tag = "1")]
    pub run_id: String,
    #[prost(uint32, tag = "2")]
    pub actor_id: u32,
    #[prost(uint64, tag = "3")]
    pub incarnation: u64,
    #[prost(uint64, tag = "4")]
    pub sequence: u64,
}

/// `Envelope` of `proto/rollout.proto` with all but the head of a chunk left out; unknown fields are skipped
/// without being copied.
#[derive(Clone, PartialEq, Eq, Hash, Message)]
struct Head {
    #[prost(message, tag = "3")]
    chunk: Option<Identity>,
}

/// The head of the chunk in `frame`; `None` for anything else. Nothing else about the frame may be trusted.
pub(super) fn identity_of(frame: &[u8]) -> Option<Identity> {
    Head::decode(frame).ok()?.chunk
}
