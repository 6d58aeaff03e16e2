//! Why the task refuses a configuration, a robot or a value.

/// Everything that `caudata-task` can refuse.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[expect(missing_docs, reason = "a message says what its fields are")]
pub enum TaskError {
    /// A configuration value is outside what makes sense.
    #[error("task.{field} is {value}: {reason}")]
    Config { field: &'static str, value: String, reason: &'static str },
    /// The robot is not one that this task can drive.
    #[error(
        "robot '{robot}' has {found} {what}, the task takes {least} to {most}; its file lists them (`actuated`, `[[feet]]`)"
    )]
    Robot { robot: String, what: &'static str, found: usize, least: usize, most: usize },
    /// The gait clock names a foot that the robot does not have.
    #[error("task.phase.offset_cycles names the foot '{foot}'; the robot has: {known}")]
    UnknownFoot { foot: String, known: String },
    /// A term of the task file is wrong.
    #[error("{table} '{name}' {reason}")]
    Term { table: &'static str, name: String, reason: String },
    /// Left and right of the robot differ.
    #[error(
        "robot '{robot}' is not its own mirror image: '{part}' has no counterpart on the other side in the nominal pose; \
         set learner.network.symmetric = false"
    )]
    NotSymmetric { robot: String, part: String },
    /// An array has the wrong length.
    #[error("{what} has {found} values, expected {expected}")]
    Shape { what: &'static str, found: usize, expected: usize },
    /// A policy contract does not describe a valid policy.
    #[error("policy contract: {what} {reason}")]
    Contract { what: &'static str, reason: String },
}

impl TaskError {
    pub(crate) fn term(table: &'static str, name: &str, reason: String) -> Self {
        Self::Term { table, name: name.to_owned(), reason }
    }
}

/// Whether a value is right, its field, the value, and what would be right.
pub(crate) type Check<'a> = (bool, &'static str, &'a dyn std::fmt::Debug, &'static str);

/// Refuses the first value that is not right.
pub(crate) fn require_all(checks: &[Check<'_>]) -> Result<(), TaskError> {
    match checks.iter().find(|check| !check.0) {
        Some((_, field, value, reason)) => {
            Err(TaskError::Config { field, value: format!("{value:?}"), reason })
        }
        None => Ok(()),
    }
}

/// Whether a `[min, max]` range is finite, not reversed, and within `lowest..=highest`.
pub(crate) fn within([lo, hi]: [f32; 2], lowest: f32, highest: f32) -> bool {
    lo.is_finite() && hi.is_finite() && lo <= hi && lo >= lowest && hi <= highest
}

/// Refuses the first field of a table of the configuration that is not right: field, whether it is, what
/// would be right.
macro_rules! checks {
    ($config:ident, $table:literal; $($field:ident: $right:expr, $reason:expr;)+) => {
        $crate::error::require_all(&[
            $(($right, concat!($table, stringify!($field)), &$config.$field, $reason),)+
        ])
    };
}
pub(crate) use checks;
