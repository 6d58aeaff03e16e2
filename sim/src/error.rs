//! What can go wrong in an engine.

use thiserror::Error;

/// Why an engine refused.
#[derive(Debug, Error)]
#[expect(missing_docs, reason = "a message says what its fields are")]
pub enum SimError {
    /// A configuration value is out of its range.
    #[error("{table}.{field} = {value}: {reason}")]
    Config { table: &'static str, field: &'static str, value: String, reason: &'static str },
    /// A height map that is not one.
    #[error("terrain.map: {file} {reason}")]
    Map { file: String, reason: String },
    /// There is water, and the robot file does not say how that acts on the robot.
    #[error(
        "there is water here, and the file of robot '{robot}' does not say how it acts: give it a table [water] (docs/guide/your-robot.md)"
    )]
    NoWater { robot: String },
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
    Extension { path: String },
    /// An array has the wrong length.
    #[error("{what} has {got} values, expected {expected}")]
    Shape { what: &'static str, got: usize, expected: usize },
    /// A number is NaN, infinite or outside its physical range.
    #[error("{what} is {value} in lane {lane}, must be {low} to {high}")]
    Value { what: &'static str, value: f32, lane: usize, low: f32, high: f32 },
    /// A lane index is out of range.
    #[error("lane {lane} does not exist, the engine has {lanes}")]
    Lane { lane: usize, lanes: usize },
    /// A snapshot could not be written or read.
    #[error("snapshot cannot be {action}: {reason}")]
    Snapshot { action: &'static str, reason: String },
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
