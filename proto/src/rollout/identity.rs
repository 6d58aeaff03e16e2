//! Whose chunk a frame is that was refused, so that the refusal is put down to the right actor.

use prost::Message;

use super::check;
use super::messages::RolloutChunk;
use super::trace::TraceContext;

/// Which chunk of which actor a frame says it is.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ChunkIdentity {
    /// The training run.
    pub run_id: String,
    /// Number of the actor within the run.
    pub actor_id: u32,
    /// Which start of the actor.
    pub incarnation: u64,
    /// Which chunk of that incarnation.
    pub sequence: u64,
    /// Where it belongs in a trace, if it is traced.
    pub trace: Option<TraceContext>,
}

impl RolloutChunk {
    /// Which one it is.
    pub fn identity(&self) -> ChunkIdentity {
        ChunkIdentity {
            run_id: self.run_id.clone(),
            actor_id: self.actor_id,
            incarnation: self.incarnation,
            sequence: self.sequence,
            trace: self.trace,
        }
    }
}

/// Says whose chunk a frame is without decoding the rest, for a frame that [`super::decode`]
/// refused; `None` where it is no chunk or does not even say that. Nothing else about such a frame
/// may be trusted, and this only as far as the transport vouches for its sender.
pub fn chunk_identity(frame: &[u8]) -> Option<ChunkIdentity> {
    let head = Envelope::decode(frame).ok()?.chunk?;
    check::run_id(&head.run_id).ok()?;
    Some(ChunkIdentity {
        run_id: head.run_id,
        actor_id: head.actor_id,
        incarnation: head.incarnation,
        sequence: head.sequence,
        // What is no trace is none: nothing depends on it.
        trace: TraceContext::from_wire(&head.trace).ok().flatten(),
    })
}

/// `Envelope` of `rollout.proto` with everything left out but the head of a chunk: prost skips
/// fields that it does not know without copying them.
#[derive(Clone, PartialEq, Message)]
struct Envelope {
    #[prost(message, optional, tag = "3")]
    chunk: Option<Head>,
}

#[derive(Clone, PartialEq, Message)]
struct Head {
    #[prost(string, tag = "1")]
    run_id: String,
    #[prost(uint32, tag = "2")]
    actor_id: u32,
    #[prost(uint64, tag = "3")]
    incarnation: u64,
    #[prost(uint64, tag = "4")]
    sequence: u64,
    #[prost(bytes = "vec", tag = "23")]
    trace: Vec<u8>,
}
