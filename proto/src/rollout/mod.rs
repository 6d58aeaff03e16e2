//! Rollouts: the frames that actors send and the learner reads.
//!
//! T = steps, N = lanes (environments), D = observation size, A = action size; tensors are
//! row-major. [`encode`] writes a frame, [`decode`] reads one and refuses, with a named reason,
//! whatever is not exactly right: a frame that decodes is safe to learn from.

mod check;
mod codec;
mod error;
mod history;
mod identity;
mod messages;
mod tensors;
#[cfg(test)]
mod tests;
mod trace;

pub use codec::{decode, encode};
pub use error::DecodeError;
pub use identity::{ChunkIdentity, chunk_identity};
pub use messages::{
    ActionHistory, ActorBye, ActorHello, DecodeLimits, Envelope, EpisodeSummary, FinalObservation,
    Moments, ROLLOUT_PROTOCOL, RolloutChunk,
};
pub use trace::TraceContext;
