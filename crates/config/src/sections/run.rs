//! `[run]` and `[evaluation]`: what is trained, for how long, and how the result is looked at.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

/// `[run]`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct RunConfig {
    /// Name of the run, the end of its folder's name. Letters, digits, `-` and `_`, 1 to 40 of them.
    pub name: String,
    /// Seed of everything random. 0 to 2⁶³ − 1. Same seed, same build, same machine type: same run.
    pub seed: u64,
    /// PPO iterations at which the run ends. 1 to 10,000,000.
    pub iterations: u64,
    /// Folder under which run folders are made.
    pub out_dir: PathBuf,
}

impl Default for RunConfig {
    fn default() -> Self {
        Self {
            name: "caudata".into(),
            seed: 1,
            iterations: 500,
            out_dir: "runs".into(),
        }
    }
}

/// `[evaluation]`: what `caudata train` does with the policy at the end.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct EvaluationConfig {
    /// Episodes of the deterministic policy in the environment. 0 to 10,000; 0 leaves the evaluation out.
    /// Fewer: a wider standard error.
    pub episodes: u32,
    /// Seconds that the robot client runs the pulled policy on the simulated robot. 0 to 600; 0 leaves it
    /// out.
    pub robot_run_s: f64,
    /// Forward velocity that the robot client is told to walk with, m/s. −1 to 1.
    pub robot_command_mps: f64,
}

impl Default for EvaluationConfig {
    fn default() -> Self {
        Self {
            episodes: 16,
            robot_run_s: 10.0,
            robot_command_mps: 0.2,
        }
    }
}
