//! Links over zenoh: actors anywhere that reaches the learner, or a common router, by TCP on one host, by QUIC between hosts.
//!
//! Keys, with the run id and the link's number in hexadecimal:
//! - `caudata/<run>/up/<link>`: messages of an actor, the head as attachment, the frame as payload.
//! - `caudata/<run>/down/<link>`: the learner's answers to it.
//! - `caudata/<run>/policy`: a queryable; actors pull the newest policy piece by piece.
//!
//! zenoh's own delivery is not relied on: a put without a route or over a broken connection vanishes, and the
//! protocol in [`reliable`](crate::reliable) notices. Nothing here blocks a zenoh thread: a learner that does
//! not read lets no grants go out, and so nothing comes in.

mod access;
mod actor;
mod learner;
mod reconnect;
mod session;

pub(crate) use actor::actor;
pub(crate) use learner::learner;

/// Bytes of a policy in one reply. A stopped actor cannot hold more than this of the learner's connection.
const PIECE_BYTES: usize = 256 << 10;

/// What an actor asks of the policy queryable: a piece of this policy, or the start of a newer one.
struct PieceRequest {
    generation: u64,
    offset: u64,
}

impl PieceRequest {
    fn encode(&self) -> Vec<u8> {
        [self.generation.to_le_bytes(), self.offset.to_le_bytes()].concat()
    }

    fn decode(bytes: &[u8]) -> Option<Self> {
        let (generation, offset) = bytes.split_first_chunk::<8>()?;
        Some(Self {
            generation: u64::from_le_bytes(*generation),
            offset: u64::from_le_bytes(offset.try_into().ok()?),
        })
    }
}

fn up_key(run_id: &str, link: &str) -> String {
    format!("caudata/{run_id}/up/{link}")
}

fn down_key(run_id: &str, link: u64) -> String {
    format!("caudata/{run_id}/down/{link:x}")
}

fn policy_key(run_id: &str) -> String {
    format!("caudata/{run_id}/policy")
}
