//! Snapshots: every lane's world and memory as bytes.
//!
//! Rapier's sets are written whole (contact warm start, islands and the broad phase's tree included): continuing from
//! anything less is not bit-exact. A height field inside a lane's collider set would repeat the terrain once per lane, so its bytes
//! are cut out of each lane and put back on reading.

use rapier3d::prelude::PhysicsWorld;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

use super::lane::{Lane, Memory, Shared};
use crate::{InitialState, LaneParams, SimError};

/// Changes whenever the layout below or Rapier's own layout does.
const FORMAT: &str = "caudata-rapier-6 rapier-0.36.1";

/// What a snapshot must match to be restored, and what it holds.
#[derive(Serialize, Deserialize)]
struct Snapshot {
    format: String,
    model_hash: [u8; 32],
    config: String,
    terrain: u64,
    lanes: Vec<SavedLane>,
}

#[derive(Serialize, Deserialize)]
struct SavedLane {
    params: LaneParams,
    /// Parameters set since the last step or reset.
    pending: Option<LaneParams>,
    memory: Memory,
    /// The Rapier world, without the terrain.
    world: Vec<u8>,
    /// Where in `world` the terrain's bytes go.
    terrain_at: Option<usize>,
}

/// All lanes as bytes, the last eight of them a check sum.
pub(super) fn save(
    shared: &Shared,
    lanes: &[Lane],
    pending: &[Option<LaneParams>],
) -> Result<Vec<u8>, SimError> {
    let terrain = terrain_bytes(shared)?;
    let lanes = lanes
        .iter()
        .zip(pending)
        .map(|(lane, pending)| save_lane(lane, pending.clone(), &terrain))
        .collect::<Result<_, _>>()?;
    let mut bytes = encode(&Snapshot {
        format: FORMAT.to_owned(),
        model_hash: shared.model.hash(),
        config: config_text(shared),
        terrain: shared.terrain.fingerprint(),
        lanes,
    })?;
    let sum = fingerprint(&bytes);
    bytes.extend_from_slice(&sum.to_le_bytes());
    Ok(bytes)
}

/// The lanes in `bytes`, of which there must be `expected`, and the parameters that wait for each of them.
pub(super) fn load(
    shared: &Shared,
    bytes: &[u8],
    expected: usize,
) -> Result<(Vec<Lane>, Vec<Option<LaneParams>>), SimError> {
    let (body, sum) = bytes
        .split_last_chunk::<8>()
        .ok_or_else(|| refused("it is too short"))?;
    if fingerprint(body) != u64::from_le_bytes(*sum) {
        return Err(refused(
            "its check sum is wrong; it is damaged or not a snapshot",
        ));
    }
    let snapshot: Snapshot = decode(body)?;
    let terrain = terrain_bytes(shared)?;
    let matches = [
        (
            snapshot.format == FORMAT,
            "it was written by another version",
        ),
        (
            snapshot.model_hash == shared.model.hash(),
            "it belongs to another robot model",
        ),
        (
            snapshot.config == config_text(shared),
            "it was taken with another engine configuration",
        ),
        (
            snapshot.terrain == shared.terrain.fingerprint(),
            "it was taken on another terrain",
        ),
        (
            snapshot.lanes.len() == expected,
            "it has another number of lanes",
        ),
    ];
    if let Some((_, reason)) = matches.iter().find(|(ok, _)| !ok) {
        return Err(refused(reason));
    }
    let mut pending = Vec::with_capacity(expected);
    let mut lanes = Vec::with_capacity(expected);
    for mut saved in snapshot.lanes {
        pending.push(saved.pending.take());
        lanes.push(load_lane(shared, saved, &terrain)?);
    }
    Ok((lanes, pending))
}

fn save_lane(
    lane: &Lane,
    pending: Option<LaneParams>,
    terrain: &[u8],
) -> Result<SavedLane, SimError> {
    let mut world = encode(&lane.robot.world)?;
    let terrain_at = if terrain.is_empty() {
        None
    } else {
        find(&world, terrain)
    };
    if let Some(at) = terrain_at {
        world.drain(at..at + terrain.len());
    }
    Ok(SavedLane {
        params: lane.params.clone(),
        pending,
        memory: lane.memory.clone(),
        world,
        terrain_at,
    })
}

fn load_lane(shared: &Shared, saved: SavedLane, terrain: &[u8]) -> Result<Lane, SimError> {
    let SavedLane {
        params,
        memory,
        mut world,
        terrain_at,
        ..
    } = saved;
    params.validate(&shared.model, 0)?;
    if let Some(at) = terrain_at {
        if at > world.len() {
            return Err(refused("its terrain does not fit"));
        }
        world.splice(at..at, terrain.iter().copied());
    }
    // Building is deterministic, so the fresh lane's handles are valid in the restored world.
    let mut lane = Lane::new(shared, params, &InitialState::nominal(&shared.model))?;
    lane.robot.world = decode::<PhysicsWorld>(&world)?;
    lane.memory = memory;
    Ok(lane)
}

/// The height field as it stands in a serialised collider set; empty on flat ground.
fn terrain_bytes(shared: &Shared) -> Result<Vec<u8>, SimError> {
    match &shared.ground {
        Some(shape) => shape.as_heightfield().map_or(Ok(Vec::new()), encode),
        None => Ok(Vec::new()),
    }
}

fn config_text(shared: &Shared) -> String {
    format!("{:?}", shared.config)
}

fn find(haystack: &[u8], needle: &[u8]) -> Option<usize> {
    haystack.windows(needle.len()).position(|w| w == needle)
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

fn encode<T: Serialize + ?Sized>(value: &T) -> Result<Vec<u8>, SimError> {
    postcard::to_stdvec(value).map_err(|e| SimError::Snapshot {
        action: "written",
        reason: e.to_string(),
    })
}

fn decode<T: DeserializeOwned>(bytes: &[u8]) -> Result<T, SimError> {
    postcard::from_bytes(bytes).map_err(|e| refused(&e.to_string()))
}

fn refused(reason: &str) -> SimError {
    SimError::Snapshot {
        action: "restored",
        reason: reason.to_owned(),
    }
}
