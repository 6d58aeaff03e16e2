//! What both ends call things: keys, and the questions for pieces of a policy.

/// Bytes of a policy in one reply. A stopped actor cannot hold more than this of the learner's connection.
pub(super) const PIECE_BYTES: usize = 256 << 10;

/// What an actor asks of the policy queryable: a piece of this policy, or the start of a newer one.
pub(super) struct PieceRequest {
    pub generation: u64,
    pub offset: u64,
}

impl PieceRequest {
    pub fn encode(&self) -> Vec<u8> {
        [self.generation.to_le_bytes(), self.offset.to_le_bytes()].concat()
    }

    pub fn decode(bytes: &[u8]) -> Option<Self> {
        let (generation, offset) = bytes.split_first_chunk::<8>()?;
        Some(Self {
            generation: u64::from_le_bytes(*generation),
            offset: u64::from_le_bytes(offset.try_into().ok()?),
        })
    }
}

pub(super) fn up_key(run_id: &str, link: &str) -> String {
    format!("caudata/{run_id}/up/{link}")
}

pub(super) fn down_key(run_id: &str, link: u64) -> String {
    format!("caudata/{run_id}/down/{link:x}")
}

pub(super) fn policy_key(run_id: &str) -> String {
    format!("caudata/{run_id}/policy")
}
