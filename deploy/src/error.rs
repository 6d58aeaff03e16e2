//! What can go wrong on the robot, and the exit code of each.

use std::io;
use std::path::PathBuf;

use caudata_durable::DurableError;
use caudata_hardware::WiringError;
use caudata_model::ModelError;
use caudata_policy::PolicyError;
use caudata_proto::registry::RegistryError;
use caudata_registry_client::ClientError;
use caudata_runlog::LogError;
use caudata_signing::SigningError;
use caudata_telemetry::{ExitCode, Failure};

use crate::bus::BusError;
use crate::guard::Fault;
use crate::state::PolicyRef;
use crate::verify::{Refusal, VerifyError};

/// Errors of this crate.
#[derive(Debug, thiserror::Error)]
#[expect(missing_docs, reason = "a message says what its fields are")]
pub enum DeployError {
    /// The robot file is missing or wrong.
    #[error("robot file: {source}")]
    Robot { source: ModelError },
    /// Nothing that was sent can have counted.
    #[error(
        "{robot} never answered: nothing was sent that counts; is it the robot's --link-addr, and is the key the same?"
    )]
    NotHeard { robot: std::net::SocketAddr },
    /// The robot is not one that the task can drive.
    #[error("robot file {}: {source}", path.display())]
    Task { path: PathBuf, source: caudata_task::TaskError },
    /// The stream's name.
    #[error("stream `{name}`: {source}")]
    Stream { name: String, source: RegistryError },
    /// The policy server.
    #[error(transparent)]
    Server(#[from] ClientError),
    /// The server has no policy in this stream.
    #[error("policy server has no policy in stream `{stream}`")]
    NoPolicy { stream: String },
    /// A policy must not run here.
    #[error("policy {policy} refused: {refusal}")]
    Refused { policy: PolicyRef, refusal: Box<Refusal> },
    /// A policy gave actions that are not finite.
    #[error(
        "policy {policy} gave {in_a_row} actions in a row that are not finite; the robot was stopped and the policy is quarantined"
    )]
    BadActions { policy: PolicyRef, in_a_row: u32 },
    /// A policy held joints at their limits in its trial.
    #[error(
        "policy {policy} wanted joints at their limits in its trial; the robot was stood down and the policy is quarantined"
    )]
    Saturated { policy: PolicyRef },
    /// Nobody says which policy runs.
    #[error("the agent did not say within {waited_s} s which policy runs")]
    NoAgent { waited_s: u64 },
    /// No policy that may run here is anywhere.
    #[error("no policy may run on this robot: {reason}")]
    NothingFits { reason: String },
    /// A second signal: the servos were let go at once.
    #[error("stopped at once by a second signal; the servos were let go where they stood")]
    Interrupted,
    /// The hardware stopped the run.
    #[error("the robot stopped by itself: {fault:?} ({detail})")]
    Stopped { fault: Fault, detail: String },
    /// The trust file.
    #[error("trust file {0}")]
    Trust(SigningError),
    /// A key file that cannot be used, or that others may use.
    #[error("key file {0}")]
    Key(#[from] SigningError),
    /// Policies would come from another computer in a way that anybody on the network can forge.
    #[error("policy server {address} is on another computer, and {missing}")]
    Insecure { address: String, missing: &'static str },
    /// The keys of a trust file were given up on this robot.
    #[error(
        "trust file {}: version {found} is in force, and on this robot version {seen} was: put the newer files back",
        path.display()
    )]
    OlderTrust { path: PathBuf, found: u64, seen: u64 },
    /// No trust file is given where one was in force.
    #[error(
        "robot state {}: trust file version {seen} was in force on this robot and none is given: give it with --trust",
        folder.display()
    )]
    TrustLeftOut { folder: PathBuf, seen: u64 },
    /// The wiring file.
    #[error(transparent)]
    Wiring(#[from] WiringError),
    /// The robot is not fit for torque.
    #[error("{wrong} of {checks} checks failed, the first: {first}")]
    Unfit { wrong: usize, checks: usize, first: String },
    /// ONNX Runtime is not there.
    #[error(transparent)]
    Runtime(PolicyError),
    /// The state file.
    #[error("{} cannot be trusted: {reason}", path.display())]
    StateDamaged { path: PathBuf, reason: String },
    /// Both copies of the state were damaged, and nobody proved yet what is too old.
    #[error(
        "this robot's state was lost; nothing is taken until a policy server that the trust file knows proves what is newest"
    )]
    StateLost,
    /// The server's word about where the label leads does not count, or does not fit.
    #[error("the server's answer about `{label}` of {stream} does not count: {reason}")]
    Stale { stream: String, label: String, reason: String },
    /// A folder or file cannot be used.
    #[error("cannot use {}: {source}", path.display())]
    Folder { path: PathBuf, source: io::Error },
    /// A folder in which only this user may write is open to others, who could command the robot.
    #[error(
        "run folder {} may be used by others (mode {mode:o}, owner {owner}): whoever writes there commands the robot; `chmod 700` it, or name another with --run-dir",
        path.display()
    )]
    Exposed { path: PathBuf, mode: u32, owner: u32 },
    /// A policy that the state names is not on the disk.
    #[error("policy file {} cannot be read: {source}", path.display())]
    BlobMissing { path: PathBuf, source: io::Error },
    /// A policy on the disk has other bytes than those that were verified.
    #[error("policy file {} is damaged: its hash differs from its name", path.display())]
    BlobDamaged { path: PathBuf },
    /// Nobody trusted announced the policy on the disk as what it is taken for.
    #[error("{} is not signed, as this policy, by enough trusted keys", path.display())]
    NotSigned { path: PathBuf },
    /// The disk refuses.
    #[error(transparent)]
    Durable(#[from] DurableError),
    /// The servo bus or the IMU.
    #[error(transparent)]
    Bus(#[from] BusError),
    /// The flight log.
    #[error("flight log: {0}")]
    Log(#[from] LogError),
    /// The command file.
    #[error("command file {}: {reason}", path.display())]
    Commands { path: PathBuf, reason: String },
    /// The key of the command link.
    #[error("key file {}: {reason}", path.display())]
    LinkKey { path: PathBuf, reason: String },
    /// Threads or sockets are refused.
    #[error("the system refuses {what}: {source}")]
    System { what: &'static str, source: io::Error },
    /// A bug.
    #[error("internal error: {what}")]
    Internal { what: String },
}

impl DeployError {
    /// [`DeployError::System`] of what the system says.
    pub(crate) fn system<E: Into<io::Error>>(what: &'static str) -> impl FnOnce(E) -> Self + Copy {
        move |source| Self::System { what, source: source.into() }
    }

    /// [`DeployError::Folder`] of what the system says.
    pub(crate) fn folder(path: impl Into<PathBuf>) -> impl FnOnce(io::Error) -> Self {
        let path = path.into();
        move |source| Self::Folder { path, source }
    }

    /// [`DeployError::Refused`] for what is wrong with `policy`.
    pub(crate) fn refused(policy: &PolicyRef, refusal: impl Into<Refusal>) -> Self {
        Self::Refused { policy: policy.clone(), refusal: Box::new(refusal.into()) }
    }

    /// What it comes to that `policy` did not pass its checks.
    pub(crate) fn unverified(policy: &PolicyRef, error: VerifyError) -> Self {
        match error {
            VerifyError::Runtime(error) => Self::Runtime(error),
            VerifyError::Refused(refusal) => Self::refused(policy, refusal),
        }
    }

    /// The exit code that the error stands for.
    pub fn exit_code(&self) -> ExitCode {
        match self {
            Self::Robot { source: ModelError::Read { .. }, .. }
            | Self::BlobMissing { .. }
            | Self::Runtime(_) => ExitCode::NoInput,
            Self::Wiring(WiringError::Read { .. })
            | Self::Trust(SigningError::File { .. })
            | Self::Key(SigningError::File { .. }) => ExitCode::NoInput,
            Self::Robot { .. }
            | Self::Wiring(_)
            | Self::Trust(_)
            | Self::Key(_)
            | Self::OlderTrust { .. }
            | Self::TrustLeftOut { .. }
            | Self::Task { .. }
            | Self::StateDamaged { .. }
            | Self::StateLost
            | Self::BlobDamaged { .. }
            | Self::NotSigned { .. }
            | Self::LinkKey { .. }
            | Self::Commands { .. } => ExitCode::BadInput,
            Self::Stream { .. }
            | Self::Insecure { .. }
            | Self::Server(ClientError::Address { .. } | ClientError::Certificates { .. }) => {
                ExitCode::BadConfig
            }
            Self::Server(ClientError::BadAnswer(_) | ClientError::OtherQuestion(_))
            | Self::Bus(BusError::Protocol { .. }) => ExitCode::Protocol,
            Self::Unfit { .. } => ExitCode::TargetMissed,
            Self::Stale { .. } | Self::NotHeard { .. } => ExitCode::Unavailable,
            // As for a run folder that another one has: starting again changes nothing.
            Self::Bus(BusError::Taken { .. }) | Self::Exposed { .. } => ExitCode::CannotCreate,
            Self::Bus(BusError::Holds { .. }) => ExitCode::TorqueOn,
            Self::Server(_) | Self::NoPolicy { .. } | Self::Bus(_) | Self::Stopped { .. } => {
                ExitCode::Unavailable
            }
            Self::Refused { .. }
            | Self::BadActions { .. }
            | Self::Saturated { .. }
            | Self::NothingFits { .. } => ExitCode::PolicyRefused,
            Self::Interrupted => ExitCode::Interrupted,
            Self::NoAgent { .. } => ExitCode::TempFail,
            Self::Durable(e) if e.is_disk_full() => ExitCode::IoError,
            Self::Folder { .. } | Self::Durable(_) => ExitCode::CannotCreate,
            Self::Log(LogError::Io { source, .. }) => ExitCode::of_io(source, true),
            Self::Log(_) => ExitCode::CannotCreate,
            Self::System { .. } => ExitCode::OsResource,
            Self::Internal { .. } => ExitCode::Internal,
        }
    }

    /// What the user can do, where that is not in the message.
    pub fn hint(&self) -> Option<&'static str> {
        match self {
            Self::StateDamaged { .. } => Some(
                "give --trust with a [[fresh_key]] of the server, or move the state folder away and give up what it knew",
            ),
            Self::TrustLeftOut { .. } => {
                Some("a robot that is to take what nobody signed needs another state folder")
            }
            Self::OlderTrust { .. } => Some(
                "keys that were given up stay given up; a robot that is to begin anew with other trust files needs another state folder",
            ),
            Self::Insecure { .. } => Some(
                "give https://HOST:PORT with --tls-dir, and --trust; docs/guide/robot-bring-up.md shows how they are made",
            ),
            Self::NoPolicy { .. } => {
                Some("`caudata policy list` shows the streams; training publishes under its run id")
            }
            Self::Refused { .. } => Some("nothing else is on this robot's disk to run instead"),
            Self::Bus(BusError::Connect { address, .. }) if address.starts_with('/') => {
                Some("`bus.port` of the wiring file, or --servo-port, is where the servos are")
            }
            Self::Bus(BusError::Connect { .. }) => {
                Some("`caudata sim robot` starts a simulated robot and prints its address")
            }
            Self::Bus(BusError::Taken { .. }) => {
                Some("`caudata-robot limp` lets the servos go whoever has the port")
            }
            Self::NothingFits { .. } => Some(
                "`caudata policy list` shows what the server has, `caudata-robot status` what this robot refused",
            ),
            Self::Unfit { .. } => Some(
                "`caudata-robot doctor` shows every check, `doctor --fix` sets registers right; what is WRONG after that is to be mended by hand, or said otherwise in the wiring file",
            ),
            _ => None,
        }
    }
}

/// The failure that ends the process.
pub fn failure(error: DeployError) -> Failure {
    let hint = error.hint();
    Failure::new(error.exit_code(), error).hint_if(hint)
}
