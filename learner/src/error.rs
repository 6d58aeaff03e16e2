//! What can go wrong in the learner, and which exit code each is.

use std::path::{Path, PathBuf};

use caudata_telemetry::ExitCode;

/// Why the learner cannot go on.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
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
    Write {
        /// The file or folder.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// A file that must survive a crash cannot be written.
    #[error(transparent)]
    Durable(#[from] caudata_durable::DurableError),
    /// The policy cannot become a file.
    #[error("policy: {0}")]
    Policy(#[from] caudata_policy::PolicyError),
    /// The policy server cannot be addressed.
    #[error(transparent)]
    Registry(#[from] caudata_registry_client::ClientError),
    /// A picture cannot be drawn.
    #[error("cannot draw a curve: {0}")]
    Picture(String),
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
        Self::Write {
            path: path.to_owned(),
            source,
        }
    }

    /// The exit code of a process that ends with this error.
    pub fn exit_code(&self) -> ExitCode {
        match self {
            Self::Setting(_) | Self::NoCuda | Self::Registry(_) => ExitCode::BadConfig,
            Self::Write { source, .. } => ExitCode::of_io(source, true),
            Self::Durable(caudata_durable::DurableError::Io { source, .. }) => {
                ExitCode::of_io(source, true)
            }
            Self::Durable(_) => ExitCode::IoError,
            Self::Torch(_) | Self::Worker | Self::Picture(_) | Self::Policy(_) => {
                ExitCode::Internal
            }
            Self::Thread(_) => ExitCode::OsResource,
            Self::CheckpointDamaged { .. } => ExitCode::CheckpointDamaged,
        }
    }
}
