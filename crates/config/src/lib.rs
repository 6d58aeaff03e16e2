//! The one configuration of a run: typed, checked as a whole, with presets, a file and `--set` on top of each
//! other.
//!
//! Later layers win: built-in defaults, then a preset, then a file, then overrides. A key that nothing knows
//! is an error with the nearest known key in it; so is a value outside its range. Everything is checked
//! before any process starts or any port is bound.
//!
//! *Invariant:* plain data. Neither libtorch nor a network library is linked, so that the command line can
//! check everything.

mod args;
mod asked;
mod derive;
mod error;
mod keys;
mod layers;
mod presets;
mod sections;
mod tune;
mod validate;

use std::path::PathBuf;

use caudata_declare::settings;
use caudata_sim::{EngineConfig, TerrainConfig};
use caudata_task::TaskConfig;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

pub use args::{ConfigArgs, robot_assignment};
pub use asked::{ask, asked};
pub use derive::can_walk;
pub use error::ConfigError;
pub use layers::Source;
pub use presets::{PRESETS, Preset};
pub use sections::*;
pub use tune::{CHANGES, CHANGES_MAX, Change, Changes, SETTINGS_MAX};

settings! {
    /// The whole configuration.
    #[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
    #[serde(default, deny_unknown_fields)]
    pub struct Config {
        /// Robot file (`*.robot.toml`). A relative path is looked for in the current
        /// directory, then in the folders above the executable.
        pub robot: PathBuf = "robots/polymander.robot.toml".into(),
        /// Name, seed, length.
        pub run: RunConfig,
        /// Who collects, and how much.
        pub actors: ActorsConfig,
        /// Networks and PPO.
        pub learner: LearnerConfig,
        /// Physics.
        pub engine: EngineConfig,
        /// Ground.
        pub terrain: TerrainConfig,
        /// The Markov decision process.
        pub task: TaskConfig,
        /// Between actors and learner.
        pub transport: TransportSection,
        /// The registry of policies.
        pub policy_server: PolicyServerConfig,
        /// Logs and metrics.
        pub telemetry: TelemetryConfig,
        /// What is done with the policy at the end.
        pub evaluation: EvaluationConfig,
        /// A run on several hosts.
        pub cluster: ClusterConfig,
    }
}

/// What [`Config::world`] tells apart.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct World([u8; 32]);

impl World {
    /// What rollouts from here under the policy contract with this hash are marked with. Learner and actors of one run
    /// have the same.
    pub fn seal(&self, contract: [u8; 32]) -> [u8; 32] {
        Sha256::new_with_prefix(contract).chain_update(self.0).finalize().into()
    }
}

impl Config {
    /// The whole configuration as TOML, every key with its value in effect.
    ///
    /// # Errors
    /// [`ConfigError::Unrepresentable`] when a value has no TOML form (an integer above 2⁶³ − 1).
    pub fn to_toml(&self) -> Result<String, ConfigError> {
        toml::to_string(self).map_err(|error| ConfigError::Unrepresentable(error.to_string()))
    }

    /// What the preset `walk` works out from a robot, as a TOML text with the rule of each value.
    ///
    /// # Errors
    /// [`ConfigError::Robot`] for a robot that cannot walk.
    pub fn derived(model: &caudata_model::RobotModel) -> Result<String, ConfigError> {
        derive::derived(model, false)
    }

    /// SHA-256 of what decides how training goes: seed, actors, learner, engine, terrain and task.
    ///
    /// Left out are the names of things, how long the run is, how it is watched, and the robot (which has its
    /// own hash), so that a longer or moved run keeps its hash.
    pub fn hash(&self) -> [u8; 32] {
        let decisive =
            (self.run.seed, &self.actors, &self.learner, &self.engine, &self.terrain, &self.task);
        // Plain structs always have a JSON form; the order of their fields is fixed.
        let json = serde_json::to_vec(&decisive).unwrap_or_default();
        Sha256::digest(json).into()
    }

    /// What a policy trains in: engine, terrain and task, but for what only tells machines apart. Of a map it is what
    /// stands in the file, wherever that is.
    pub fn world(&self) -> World {
        let engine = EngineConfig { lane_width: 0, ..self.engine.clone() };
        let terrain = TerrainConfig { map: PathBuf::new(), ..self.terrain.clone() };
        let map = std::fs::read(&self.terrain.map).unwrap_or_default();
        let map: [u8; 32] = Sha256::digest(map).into();
        let json = serde_json::to_vec(&(engine, terrain, map, &self.task)).unwrap_or_default();
        World(Sha256::digest(json).into())
    }

    /// [`Config::hash`] as 64 hex digits.
    pub fn hash_hex(&self) -> String {
        hex::encode(self.hash())
    }

    /// The robot file. A relative path is looked for in the current directory and then in the folders above
    /// this executable, so that a checkout's `target/release/caudata` finds `robots/` from anywhere.
    pub fn robot_path(&self) -> PathBuf {
        caudata_durable::shipped(&self.robot)
    }

    /// Identifier of the run when it is not made up for each start: `cluster.run_id`, else `run.name`.
    pub fn cluster_run_id(&self) -> &str {
        match self.cluster.run_id.as_str() {
            "" => &self.run.name,
            id => id,
        }
    }

    /// The policy to begin with, if there is one; a relative path is looked for like the robot file.
    pub fn warm_start_path(&self) -> Option<PathBuf> {
        let policy = &self.learner.warm_start.policy;
        let given = !policy.as_os_str().is_empty();
        given.then(|| caudata_durable::shipped(policy))
    }

    /// The teacher, if there is one, likewise.
    pub fn teacher_path(&self) -> Option<PathBuf> {
        let policy = &self.learner.teacher.policy;
        let given = !policy.as_os_str().is_empty();
        given.then(|| caudata_durable::shipped(policy))
    }

    /// Every key with its value in effect, in the order of the file: `("learner.ppo.gamma", "0.97")`.
    pub fn entries(&self) -> Vec<(String, String)> {
        keys::entries(&keys::table_of(self))
    }
}
