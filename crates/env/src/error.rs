//! Why an environment refuses.

use caudata_model::ModelError;
use caudata_sim::SimError;
use caudata_task::TaskError;

/// Everything that [`crate::VecEnv`] can refuse.
#[derive(Debug, thiserror::Error)]
#[expect(missing_docs, reason = "a message says what its fields are")]
pub enum EnvError {
    /// The task's configuration is invalid, or the robot is not one that it can drive.
    #[error(transparent)]
    Task(#[from] TaskError),
    /// The engine refused.
    #[error(transparent)]
    Sim(#[from] SimError),
    /// The robot's geometry cannot be worked out.
    #[error(transparent)]
    Model(#[from] ModelError),
    /// The engine steps at another rate than the task.
    #[error(
        "task.control_period_s is {task_s} s but the engine's dt_s times substeps is {engine_s} s; make them equal"
    )]
    ControlPeriod { task_s: f64, engine_s: f64 },
    /// The engine simulates another robot than the task was given.
    #[error("the engine holds robot '{engine}' with other files than the task's robot '{task}'")]
    OtherRobot { task: String, engine: String },
    /// The engine has no lanes.
    #[error("the engine has no lanes, at least one is needed")]
    NoLanes,
    /// An array has the wrong length.
    #[error("{what} has {found} values, expected {expected}")]
    Shape { what: &'static str, found: usize, expected: usize },
    /// An action is not a finite number: the policy is broken, stepping on would hide it.
    #[error("action {action} of lane {lane} is {value}, it must be finite; check the policy")]
    Action { lane: usize, action: usize, value: f32 },
    /// A snapshot could not be written, or does not belong here.
    #[error("environment snapshot: {0}")]
    Snapshot(String),
}
