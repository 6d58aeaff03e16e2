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

use std::path::{Path, PathBuf};
use std::sync::OnceLock;

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
        let decisive = (
            self.run.seed,
            &self.actors,
            &self.learner,
            &self.engine,
            &self.terrain,
            &self.task,
        );
        // Plain structs always have a JSON form; the order of their fields is fixed.
        let json = serde_json::to_vec(&decisive).unwrap_or_default();
        Sha256::digest(json).into()
    }

    /// [`Config::hash`] as 64 hex digits.
    pub fn hash_hex(&self) -> String {
        self.hash()
            .iter()
            .map(|byte| format!("{byte:02x}"))
            .collect()
    }

    /// The robot file. A relative path is looked for in the current directory and then in the folders above
    /// this executable, so that a checkout's `target/release/caudata` finds `robots/` from anywhere.
    pub fn robot_path(&self) -> PathBuf {
        shipped(&self.robot)
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
        given.then(|| shipped(policy))
    }

    /// Every key with its value in effect, in the order of the file: `("learner.ppo.gamma", "0.97")`.
    pub fn entries(&self) -> Vec<(String, String)> {
        keys::entries(&keys::table_of(self))
    }
}

/// Where files that came with the program are, in a process whose executable does not lie beside them.
static HOME: OnceLock<PathBuf> = OnceLock::new();

/// Makes [`shipped`] look below `home` instead of above this executable, for a library that another program
/// loads. Only the first call counts.
pub fn set_home(home: &Path) {
    let _ = HOME.set(home.to_owned());
}

/// A file that came with the program (`robots/…`, `policies/…`): a relative path is looked for in the current
/// directory and then in the folders above this executable. What is not found stays as it is.
pub fn shipped(path: &Path) -> PathBuf {
    match HOME.get() {
        Some(home) => find_upwards(path, home),
        None => find_upwards(path, &std::env::current_exe().unwrap_or_default()),
    }
}

fn find_upwards(path: &Path, from: &Path) -> PathBuf {
    if path.is_absolute() || path.exists() {
        return path.to_owned();
    }
    from.ancestors()
        .map(|folder| folder.join(path))
        .find(|candidate| candidate.exists())
        .unwrap_or_else(|| path.to_owned())
}
