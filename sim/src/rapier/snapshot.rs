//! Snapshots: every lane's world and memory as bytes.
//!
//! Rapier's sets are written whole (contact warm start, islands and the broad phase's tree included):
//! continuing from anything less is not bit-exact. A height field inside a lane's collider set would repeat
//! the terrain once per lane, so its bytes are cut out of each lane and put back on reading.

use rapier3d::prelude::PhysicsWorld;
use serde::{Deserialize, Serialize};

use super::lane::{Lane, Memory};
use super::shared::Shared;
use crate::snapshot::{Owner, decode, encode, refused};
use crate::{InitialState, LaneParams, SimError};

/// Changes whenever the layout below or Rapier's own layout does.
const RAPIER_FORMAT: &str = "caudata-rapier-10 rapier-0.36.1";

fn owner(shared: &Shared) -> Owner<'_> {
    Owner {
        format: RAPIER_FORMAT,
        model_hash: shared.rig.model.hash(),
        config: &shared.rig.config,
        terrain: shared.rig.terrain.fingerprint(),
        lanes: shared.rig.params.len(),
    }
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

/// All lanes as bytes. The parameters of `stale` ones wait for them in the rig.
pub(super) fn save(shared: &Shared, lanes: &[Lane], stale: &[bool]) -> Result<Vec<u8>, SimError> {
    let terrain = terrain_bytes(shared)?;
    let pending = stale.iter().zip(&shared.rig.params).map(|(stale, p)| stale.then(|| p.clone()));
    let saved = (lanes.iter().zip(pending))
        .map(|(lane, pending)| save_lane(lane, pending, &terrain))
        .collect::<Result<Vec<_>, _>>()?;
    owner(shared).save(&saved)
}

/// Lanes, the parameters of each, and whether these still wait for it.
type Loaded = (Vec<Lane>, Vec<LaneParams>, Vec<bool>);

/// What is in `bytes`.
pub(super) fn load(shared: &Shared, bytes: &[u8]) -> Result<Loaded, SimError> {
    let saved: Vec<SavedLane> = owner(shared).load(bytes)?;
    if saved.len() != shared.rig.params.len() {
        return Err(refused("it has another number of lanes"));
    }
    let terrain = terrain_bytes(shared)?;
    let load = |mut saved: SavedLane| {
        let (pending, own) = (saved.pending.take(), saved.params.clone());
        let stale = pending.is_some();
        Ok((load_lane(shared, saved, &terrain)?, pending.unwrap_or(own), stale))
    };
    let loaded = saved.into_iter().map(load).collect::<Result<Vec<_>, SimError>>()?;
    Ok(loaded.into_iter().collect())
}

fn save_lane(
    lane: &Lane,
    pending: Option<LaneParams>,
    terrain: &[u8],
) -> Result<SavedLane, SimError> {
    let mut world = encode(&lane.robot.world)?;
    let terrain_at = if terrain.is_empty() { None } else { find(&world, terrain) };
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
    let SavedLane { params, memory, mut world, terrain_at, .. } = saved;
    params.validate(&shared.rig.model, 0)?;
    if let Some(at) = terrain_at {
        if at > world.len() {
            return Err(refused("its terrain does not fit"));
        }
        world.splice(at..at, terrain.iter().copied());
    }
    // Building is deterministic, so the fresh lane's handles are valid in the restored world.
    let mut lane = Lane::new(shared, params, &InitialState::nominal(&shared.rig.model))?;
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

fn find(haystack: &[u8], needle: &[u8]) -> Option<usize> {
    haystack.windows(needle.len()).position(|w| w == needle)
}
