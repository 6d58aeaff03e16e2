//! Saving and restoring environments, exactly.

use caudata_task::TaskConfig;
use serde::{Deserialize, Serialize};

use crate::lane::Lane;
use crate::{EnvError, VecEnv};

/// Raise when what a snapshot holds changes.
const FORMAT: u32 = 5;

#[derive(Serialize, Deserialize)]
struct Saved {
    format: u32,
    contract_hash: [u8; 32],
    task: TaskConfig,
    seed: u64,
    actor: u64,
    progress: u64,
    lanes: Vec<Lane>,
    observations: Vec<f32>,
    memories: Vec<f32>,
    privileged: Vec<f32>,
    engine: Vec<u8>,
}

impl VecEnv {
    /// Everything that the next steps depend on: streams, episodes, the engine with its contact memory. An
    /// environment of the same robot, task, lanes, seed and actor that restores it goes on with the same
    /// bits.
    ///
    /// # Errors
    /// When the engine cannot save itself.
    pub fn snapshot(&self) -> Result<Vec<u8>, EnvError> {
        let saved = Saved {
            format: FORMAT,
            contract_hash: self.contract.hash(),
            task: self.task.clone(),
            seed: self.seed,
            actor: self.actor,
            progress: self.progress,
            lanes: self.lanes.clone(),
            observations: self.observations.clone(),
            memories: self.memories.clone(),
            privileged: self.privileged.clone(),
            engine: self.engine.snapshot()?,
        };
        postcard::to_stdvec(&saved).map_err(|error| EnvError::Snapshot(error.to_string()))
    }

    /// Goes back to a [`Self::snapshot`]. On an error nothing has changed.
    ///
    /// # Errors
    /// When the bytes are damaged, or were saved from another robot, task, seed, actor or number of lanes.
    pub fn restore(&mut self, bytes: &[u8]) -> Result<(), EnvError> {
        let refuse = |reason: String| Err(EnvError::Snapshot(reason));
        let saved: Saved = match postcard::from_bytes(bytes) {
            Ok(saved) => saved,
            Err(error) => return refuse(format!("cannot be read: {error}")),
        };
        if saved.format != FORMAT {
            return refuse(format!("has format {}, this version reads {FORMAT}", saved.format));
        }
        if saved.contract_hash != self.contract.hash() {
            return refuse("is of another robot or policy contract".to_owned());
        }
        if saved.task != self.task {
            return refuse("is of another [task] configuration".to_owned());
        }
        if (saved.seed, saved.actor) != (self.seed, self.actor) {
            return refuse(format!(
                "is of seed {} and actor {}, expected {} and {}",
                saved.seed, saved.actor, self.seed, self.actor
            ));
        }
        if saved.lanes.len() != self.lanes.len() {
            return refuse(format!(
                "has {} lanes, expected {}",
                saved.lanes.len(),
                self.lanes.len()
            ));
        }
        let sizes = |all: [&Vec<f32>; 3]| all.map(Vec::len);
        let found = sizes([&saved.observations, &saved.memories, &saved.privileged]);
        let expected = sizes([&self.observations, &self.memories, &self.privileged]);
        if found != expected {
            return refuse(format!(
                "has {found:?} values that policy, memory and value function have, expected {expected:?}"
            ));
        }
        self.engine.restore(&saved.engine)?;
        self.progress = saved.progress;
        self.lanes = saved.lanes;
        self.observations = saved.observations;
        self.memories = saved.memories;
        self.privileged = saved.privileged;
        Ok(())
    }
}
