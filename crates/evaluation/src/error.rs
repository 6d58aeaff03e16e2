//! Why an evaluation cannot run.

use caudata_actor::ActorError;
use caudata_env::EnvError;
use caudata_policy::PolicyError;

/// Everything that an evaluation can refuse.
#[derive(Debug, thiserror::Error)]
pub enum EvaluationError {
    /// The environments cannot be built from the configuration.
    #[error(transparent)]
    Build(#[from] ActorError),
    /// The environments refused a step.
    #[error(transparent)]
    Env(#[from] EnvError),
    /// The policy is for another robot or task.
    #[error(transparent)]
    Refused(PolicyError),
    /// The policy cannot be run.
    #[error(transparent)]
    Inference(PolicyError),
    /// The caller asked to stop.
    #[error("the evaluation was stopped")]
    Stopped,
}
