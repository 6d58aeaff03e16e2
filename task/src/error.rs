//! Why the task refuses a configuration, a robot or a value.

/// Everything that `caudata-task` can refuse.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum TaskError {
    /// A configuration value is outside what makes sense.
    #[error("task.{field} is {value}: {reason}")]
    Config {
        /// Field, as written in the configuration file below `[task]`.
        field: &'static str,
        /// The value found.
        value: String,
        /// What would be right.
        reason: &'static str,
    },
    /// The robot is not one that this task can drive.
    #[error(
        "robot '{robot}' has {found} {what}, the walking task needs {expected}; choose another robot file"
    )]
    Robot {
        /// Name of the robot.
        robot: String,
        /// What was counted.
        what: &'static str,
        /// How many there are.
        found: usize,
        /// How many there must be.
        expected: usize,
    },
    /// Left and right of the robot differ.
    #[error(
        "robot '{robot}' is not its own mirror image: joint '{joint}' {reason}; set learner.ppo.mirror = false"
    )]
    NotSymmetric {
        /// Name of the robot.
        robot: String,
        /// Name of the joint.
        joint: String,
        /// What is missing.
        reason: &'static str,
    },
    /// An array has the wrong length.
    #[error("{what} has {found} values, expected {expected}")]
    Shape {
        /// Which array.
        what: &'static str,
        /// Its length.
        found: usize,
        /// The length needed.
        expected: usize,
    },
    /// A policy contract does not describe a valid policy.
    #[error("policy contract: {what} {reason}")]
    Contract {
        /// Field of the contract.
        what: &'static str,
        /// What is wrong with it.
        reason: String,
    },
}

/// Refuses `value` of `field` unless `ok`.
pub(crate) fn require(
    ok: bool,
    field: &'static str,
    value: impl std::fmt::Debug,
    reason: &'static str,
) -> Result<(), TaskError> {
    if ok {
        return Ok(());
    }
    Err(TaskError::Config {
        field,
        value: format!("{value:?}"),
        reason,
    })
}

/// Refuses a `[min, max]` range that is not finite, is reversed, or leaves `lowest..=highest`.
pub(crate) fn require_range(
    range: [f32; 2],
    lowest: f32,
    highest: f32,
    field: &'static str,
    reason: &'static str,
) -> Result<(), TaskError> {
    let [lo, hi] = range;
    require(
        lo.is_finite() && hi.is_finite() && lo <= hi && lo >= lowest && hi <= highest,
        field,
        range,
        reason,
    )
}
