//! What can go wrong in the learner, and which exit code each is.

use std::path::{Path, PathBuf};

use caudata_telemetry::{ExitCode, Failure};
use caudata_transport::TransportError;

/// Why the learner cannot go on.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
#[expect(missing_docs, reason = "a message says what its fields are")]
pub enum LearnerError {
    /// Settings that do not fit each other, the task or the data.
    #[error("{0}")]
    Setting(String),
    /// libtorch refused an operation.
    #[error("libtorch: {0}")]
    Torch(#[from] tch::TchError),
    /// CUDA was asked for and is not there.
    #[error(
        "learner.device is cuda, but this libtorch finds no CUDA device; take cpu or auto, or preload libtorch_cuda.so"
    )]
    NoCuda,
    /// A thread of the update has died.
    #[error("a learner thread has died; its message is above")]
    Worker,
    /// The operating system refuses a thread.
    #[error("cannot start a thread: {0}")]
    Thread(std::io::Error),
    /// A file or folder cannot be written.
    #[error("cannot write {path}: {source}")]
    Write { path: PathBuf, source: std::io::Error },
    /// A file that must survive a crash cannot be written.
    #[error(transparent)]
    Durable(#[from] caudata_durable::DurableError),
    /// The run folder is another process's.
    #[error(transparent)]
    Owner(#[from] caudata_durable::OwnerError),
    /// A run is to go on from a checkpoint that it does not have.
    #[error("the run has no checkpoint {name}")]
    NoSuchCheckpoint {
        /// What was asked for.
        name: String,
        /// Those that it has.
        there: Vec<String>,
    },
    /// A run is to go on, and what it would go on from is gone.
    #[error("{path} holds no checkpoint, though this run has got further than its start")]
    CheckpointsGone { path: PathBuf },
    /// The policy cannot become a file.
    #[error("policy: {0}")]
    Policy(#[from] caudata_policy::PolicyError),
    /// The policy server cannot be addressed.
    #[error(transparent)]
    Registry(#[from] caudata_registry_client::ClientError),
    /// The link to the actors failed.
    #[error("transport: {0}")]
    Transport(#[from] caudata_transport::TransportError),
    /// The robot file cannot be used.
    #[error("robot file: {source}")]
    Robot { source: caudata_model::ModelError },
    /// The task does not fit the robot.
    #[error("task: {0}")]
    Task(#[from] caudata_task::TaskError),
    /// An actor of this process failed.
    #[error("actor {id}: {source}")]
    Actor { id: u32, source: caudata_actor::ActorError },
    /// An actor of this process is gone, or cannot be saved.
    #[error("actor {id} {reason}")]
    ActorLost { id: u32, reason: String },
    /// Too few rollouts for too long.
    #[error("only {chunks} chunks came within {waited_s:.0} s; are the actors alive?")]
    Starved { waited_s: f64, chunks: usize },
    /// Nothing could be learnt for many iterations.
    #[error(
        "{iterations} iterations in a row had no finite update; the weights are those of before"
    )]
    NotFinite { iterations: u32 },
    /// A checkpoint of another configuration.
    #[error(
        "{path} was written under another configuration, or by a version of this program with other keys; resume with the run's own config.toml and that version"
    )]
    CheckpointConfig { path: String },
    /// A checkpoint of another task or robot.
    #[error("{path} was written for another robot or task")]
    CheckpointContract { path: String },
    /// A file cannot be read.
    #[error("cannot read {path}: {source}")]
    Read { path: PathBuf, source: std::io::Error },
    /// A policy cannot be begun with, or learnt from.
    #[error("learner.{role}.policy {path}: {reason}")]
    Unfit { role: &'static str, path: PathBuf, reason: String },
    /// A checkpoint cannot be used.
    #[error("checkpoint {path} is damaged: {reason}")]
    CheckpointDamaged {
        /// Its folder.
        path: PathBuf,
        /// What is wrong with it.
        reason: String,
        /// Name of the newest good one, if there is one.
        good: Option<String>,
    },
}

impl LearnerError {
    /// Settings that cannot work.
    pub fn setting(message: impl Into<String>) -> Self {
        Self::Setting(message.into())
    }

    /// A failed write.
    pub fn write(path: &Path, source: std::io::Error) -> Self {
        Self::Write { path: path.to_owned(), source }
    }

    /// The exit code of a process that ends with this error.
    pub fn exit_code(&self) -> ExitCode {
        match self {
            Self::Setting(_) | Self::NoCuda | Self::Registry(_) | Self::CheckpointConfig { .. } => {
                ExitCode::BadConfig
            }
            Self::Owner(caudata_durable::OwnerError::Taken { .. }) => ExitCode::InUse,
            Self::Owner(caudata_durable::OwnerError::Io { source, .. })
            | Self::Write { source, .. } => ExitCode::of_io(source, true),
            Self::Read { source, .. } => ExitCode::of_io(source, false),
            Self::Unfit { .. } => ExitCode::PolicyRefused,
            Self::Durable(caudata_durable::DurableError::Io { source, .. }) => {
                ExitCode::of_io(source, true)
            }
            Self::Durable(_) => ExitCode::IoError,
            Self::Torch(_) | Self::Worker | Self::Policy(_) => ExitCode::Internal,
            Self::Thread(_) => ExitCode::OsResource,
            Self::Transport(TransportError::Config(_) | TransportError::PolicyTooLarge { .. }) => {
                ExitCode::BadConfig
            }
            Self::Transport(_) => ExitCode::OsResource,
            Self::Robot { .. } | Self::Task(_) => ExitCode::BadInput,
            Self::Actor { source, .. } => source.exit_code(),
            Self::ActorLost { .. } | Self::NotFinite { .. } => ExitCode::Internal,
            Self::Starved { .. } => ExitCode::TempFail,
            Self::CheckpointContract { .. } => ExitCode::PolicyRefused,
            Self::NoSuchCheckpoint { .. } => ExitCode::NoInput,
            Self::CheckpointDamaged { .. } | Self::CheckpointsGone { .. } => {
                ExitCode::CheckpointDamaged
            }
        }
    }

    /// As the failure of a process, with what the user can do about it.
    pub fn into_failure(self) -> Failure {
        let hint = match &self {
            Self::CheckpointDamaged { good: Some(good), .. } => Some(format!(
                "{good} is whole: resume with --resume-from {good}; what was learnt after it is learnt again"
            )),
            Self::CheckpointDamaged { good: None, .. } => {
                Some("no other checkpoint is whole; start a new run".to_owned())
            }
            Self::Durable(error) if error.is_disk_full() => Some(
                "free some space and resume; the checkpoints saved before are whole".to_owned(),
            ),
            Self::Owner(_) => Some(
                "wait until that process has ended, or stop it; kill -9 where it stands still"
                    .to_owned(),
            ),
            Self::NoSuchCheckpoint { there, .. } if !there.is_empty() => {
                Some(format!("it has {}", there.join(", ")))
            }
            Self::CheckpointsGone { .. } => {
                Some("put the checkpoints back, or begin a new run in another folder".to_owned())
            }
            Self::Starved { .. } => {
                Some("the logs of the actors say what they were doing".to_owned())
            }
            _ => None,
        };
        Failure::new(self.exit_code(), self).hint_if(hint)
    }
}
