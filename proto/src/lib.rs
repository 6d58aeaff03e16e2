//! Wire formats: protobuf messages, generated code and the checked conversions to domain types.
//!
//! *Invariant*: what comes from outside becomes a domain type here, once and completely checked;
//! the generated types in [`wire`] are for encoders, decoders and gRPC services only.

pub mod checks;
mod disk;
pub mod framing;
pub mod hex;
pub mod registry;
pub mod robot_link;
pub mod rollout;
pub mod wire;

pub use rollout::{
    ActionHistory, ActorBye, ActorHello, ChunkIdentity, DecodeError, DecodeLimits, Envelope,
    EpisodeSummary, FinalObservation, Moments, RolloutChunk, TraceContext, chunk_identity, decode,
    encode,
};
