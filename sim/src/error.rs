//! What can go wrong in an engine.

use thiserror::Error;

/// Why an engine refused.
#[derive(Debug, Error)]
pub enum SimError {
    /// A configuration value is out of its range.
    #[error("{table}.{field} = {value}: {reason}")]
    Config {
        /// TOML table, `engine` or `terrain`.
        table: &'static str,
        /// Field in that table.
        field: &'static str,
        /// The value as given.
        value: String,
        /// What would be accepted.
        reason: &'static str,
    },
    /// A height map that is not one.
    #[error("terrain.map: {file} {reason}")]
    Map {
        /// The file.
        file: String,
        /// What is wrong with it.
        reason: String,
    },
    /// The robot model has something this engine cannot simulate.
    #[error("robot model cannot be simulated: {0}")]
    Model(String),
    /// MuJoCo, in its process, is missing, has ended, or does not simulate this.
    #[error("engine mujoco: {0}")]
    Mujoco(String),
    /// The robot file's extension names a parameter that does not exist.
    #[error(
        "robot file: extension.lane.`{path}` is no parameter of this robot; if a diagnosis of an earlier version wrote it, diagnose its logs again"
    )]
    Extension {
        /// The path as written.
        path: String,
    },
    /// An array has the wrong length.
    #[error("{what} has {got} values, expected {expected}")]
    Shape {
        /// Which array.
        what: &'static str,
        /// Its length.
        got: usize,
        /// The length this engine needs.
        expected: usize,
    },
    /// A number is NaN, infinite or outside its physical range.
    #[error("{what} is {value} in lane {lane}, must be {low} to {high}")]
    Value {
        /// Which quantity.
        what: &'static str,
        /// The value.
        value: f32,
        /// The lane it was given for.
        lane: usize,
        /// Smallest value accepted.
        low: f32,
        /// Largest value accepted.
        high: f32,
    },
    /// A lane index is out of range.
    #[error("lane {lane} does not exist, the engine has {lanes}")]
    Lane {
        /// The lane asked for.
        lane: usize,
        /// How many there are.
        lanes: usize,
    },
    /// A snapshot could not be written or read.
    #[error("snapshot cannot be {action}: {reason}")]
    Snapshot {
        /// `written` or `restored`.
        action: &'static str,
        /// What was wrong with it.
        reason: String,
    },
}

pub(crate) fn check_len(what: &'static str, got: usize, expected: usize) -> Result<(), SimError> {
    if got == expected {
        return Ok(());
    }
    Err(SimError::Shape { what, got, expected })
}

pub(crate) fn check_lane(lane: usize, lanes: usize) -> Result<(), SimError> {
    if lane < lanes {
        return Ok(());
    }
    Err(SimError::Lane { lane, lanes })
}
