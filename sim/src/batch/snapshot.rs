//! Snapshots: every lane's parameters and state as bytes, the same whatever the width of the groups.

use serde::{Deserialize, Serialize};

use super::core::LaneState;
use crate::{EngineConfig, LaneParams, SimError, State};

/// Changes whenever the layout below does.
const FORMAT: &str = "caudata-batch-3";

/// What a snapshot must match to be restored, and what it holds.
#[derive(Serialize, Deserialize)]
struct Snapshot {
    format: String,
    model_hash: [u8; 32],
    config: String,
    terrain: u64,
    params: Vec<LaneParams>,
    lanes: Vec<LaneState>,
    state: State,
}

/// What a snapshot belongs to.
pub(super) struct Owner<'a> {
    pub model_hash: [u8; 32],
    pub config: &'a EngineConfig,
    pub terrain: u64,
}

/// All lanes as bytes, the last eight of them a check sum.
pub(super) fn save(
    owner: &Owner<'_>,
    params: &[LaneParams],
    lanes: Vec<LaneState>,
    state: &State,
) -> Result<Vec<u8>, SimError> {
    let snapshot = Snapshot {
        format: FORMAT.to_owned(),
        model_hash: owner.model_hash,
        config: format!("{:?}", owner.config),
        terrain: owner.terrain,
        params: params.to_vec(),
        lanes,
        state: state.clone(),
    };
    let mut bytes = postcard::to_stdvec(&snapshot).map_err(|e| SimError::Snapshot {
        action: "written",
        reason: e.to_string(),
    })?;
    let sum = fingerprint(&bytes);
    bytes.extend_from_slice(&sum.to_le_bytes());
    Ok(bytes)
}

/// What is in `bytes`, checked against the owner and the number of lanes.
pub(super) fn load(
    owner: &Owner<'_>,
    bytes: &[u8],
    lanes: usize,
) -> Result<(Vec<LaneParams>, Vec<LaneState>, State), SimError> {
    let (body, sum) = bytes
        .split_last_chunk::<8>()
        .ok_or_else(|| refused("it is too short"))?;
    if fingerprint(body) != u64::from_le_bytes(*sum) {
        return Err(refused(
            "its check sum is wrong; it is damaged or not a snapshot",
        ));
    }
    let s: Snapshot = postcard::from_bytes(body).map_err(|e| refused(&e.to_string()))?;
    let matches = [
        (s.format == FORMAT, "it was written by another version"),
        (
            s.model_hash == owner.model_hash,
            "it belongs to another robot model",
        ),
        (
            s.config == format!("{:?}", owner.config),
            "it was taken with another engine configuration",
        ),
        (
            s.terrain == owner.terrain,
            "it was taken on another terrain",
        ),
        (
            s.lanes.len() == lanes && s.params.len() == lanes && s.state.lanes == lanes,
            "it has another number of lanes",
        ),
    ];
    if let Some((_, reason)) = matches.iter().find(|(ok, _)| !ok) {
        return Err(refused(reason));
    }
    Ok((s.params, s.lanes, s.state))
}

/// FNV-1a over 64-bit words and the remaining bytes: finds damage, not malice.
fn fingerprint(bytes: &[u8]) -> u64 {
    const PRIME: u64 = 0x0000_0100_0000_01b3;
    let (words, rest) = bytes.as_chunks::<8>();
    let mut hash = 0xcbf2_9ce4_8422_2325_u64;
    for word in words {
        hash = (hash ^ u64::from_le_bytes(*word)).wrapping_mul(PRIME);
        hash ^= hash >> 32;
    }
    for byte in rest {
        hash = (hash ^ u64::from(*byte)).wrapping_mul(PRIME);
    }
    hash
}

pub(super) fn refused(reason: &str) -> SimError {
    SimError::Snapshot {
        action: "restored",
        reason: reason.to_owned(),
    }
}
