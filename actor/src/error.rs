//! Why an actor ends early.

use caudata_env::EnvError;
use caudata_policy::PolicyError;
use caudata_sim::SimError;
use caudata_telemetry::{ExitCode, Failure};
use caudata_transport::{SendError, TransportError};

/// Why an actor ends early.
#[derive(Debug, thiserror::Error)]
#[expect(missing_docs, reason = "a message says what its fields are")]
pub enum ActorError {
    /// The environments could not be made or stepped.
    #[error("environment: {0}")]
    Env(#[from] EnvError),
    /// The bytes that arrived are not those that were announced.
    #[error("policy version {version}: the bytes do not have the announced SHA-256")]
    PolicyHash { version: u64 },
    /// The policy does not fit this robot and task, or is no valid policy.
    #[error("policy version {version} is refused: {source}")]
    PolicyRefused { version: u64, source: PolicyError },
    /// The policy says another version than the one announced.
    #[error("policy announced as version {announced} says that it is version {found}")]
    PolicyVersion { announced: u64, found: u64 },
    /// The policy answers with something that is not a number.
    #[error("policy version {version} answers lane {lane} with a value that is not finite")]
    NotFinite { version: u64, lane: usize },
    /// No new policy, or no learner, for too long.
    #[error("{what} for {waited_s:.0} s; is the learner alive?")]
    Starved { what: &'static str, waited_s: f64 },
    /// The link refuses chunks for good.
    #[error("sending: {0}")]
    Send(SendError),
    /// The link is broken.
    #[error("transport: {0}")]
    Transport(#[from] TransportError),
    /// The ledger cannot be written.
    #[error("ledger {path}: {source}")]
    Ledger { path: String, source: std::io::Error },
    /// A saved actor does not fit this one.
    #[error("saved actor state does not fit: {0}")]
    Snapshot(String),
}

impl ActorError {
    /// The exit code of a process that ends because of it.
    pub fn exit_code(&self) -> ExitCode {
        match self {
            Self::PolicyRefused { .. } | Self::PolicyVersion { .. } => ExitCode::PolicyRefused,
            Self::PolicyHash { .. } => ExitCode::Protocol,
            Self::Starved { .. } => ExitCode::TempFail,
            Self::Send(SendError::TooLarge { .. }) => ExitCode::BadConfig,
            Self::Send(_) | Self::Transport(TransportError::Closed) => ExitCode::Unavailable,
            Self::Transport(TransportError::Config(_)) => ExitCode::BadConfig,
            Self::Transport(_) => ExitCode::OsResource,
            Self::Ledger { source, .. } => ExitCode::of_io(source, true),
            Self::Snapshot(_) => ExitCode::CheckpointDamaged,
            Self::Env(EnvError::Sim(SimError::Mujoco(_))) => ExitCode::Unavailable,
            Self::Env(EnvError::Sim(SimError::NoWater { .. } | SimError::Map { .. })) => {
                ExitCode::BadConfig
            }
            Self::Env(_) | Self::NotFinite { .. } => ExitCode::Internal,
        }
    }

    /// As the failure of a process.
    pub fn into_failure(self) -> Failure {
        let code = self.exit_code();
        let hint = match &self {
            Self::PolicyRefused { .. } => {
                Some("actor and learner must use the same robot file and [task] section")
            }
            Self::Starved { .. } => Some("the learner's log says what it was doing"),
            _ => None,
        };
        Failure::new(code, self).hint_if(hint)
    }
}
