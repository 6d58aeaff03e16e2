//! What can go wrong on a link, and what the caller should do about it.

use std::path::PathBuf;

/// Why [`ActorLink::send`](crate::ActorLink::send) or [`flush`](crate::ActorLink::flush) did not succeed.
/// In every case the frame handed to `send` has not been taken and will not arrive.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[expect(missing_docs, reason = "a message says what its fields are")]
pub enum SendError {
    /// The learner is alive but behind; the same frame may be tried again.
    #[error("the learner is behind: {unacknowledged} frames wait for it; try the same frame again")]
    Full {
        /// Frames taken from this link that the learner has not acknowledged yet.
        unacknowledged: usize,
    },
    /// No learner has been heard within the peer time-out; the link keeps trying to reach one.
    #[error(
        "no learner heard from; {unacknowledged} frames wait for it; try again, the link reconnects by itself"
    )]
    Disconnected {
        /// Frames taken from this link that the learner has not acknowledged yet.
        unacknowledged: usize,
    },
    /// The frame is over the configured limit and will never be taken.
    #[error(
        "frame of {size} bytes is over the limit of {max} bytes; raise limits.max_frame_bytes or send smaller chunks"
    )]
    TooLarge { size: usize, max: usize },
    /// The other side has ended for good (in-process only), or this link has been shut down.
    #[error("the link is closed")]
    Closed,
    /// The library below failed in a way that trying again does not cure.
    #[error("{0}")]
    Backend(String),
}

/// Why a link could not be set up, received from or published on.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[expect(missing_docs, reason = "a message says what its fields are")]
pub enum TransportError {
    /// The configuration cannot work.
    #[error("transport configuration: {0}")]
    Config(String),
    /// A policy is over the configured limit.
    #[error(
        "policy of {size} bytes is over the limit of {max} bytes; raise limits.max_policy_bytes"
    )]
    PolicyTooLarge { size: usize, max: usize },
    /// A policy older than the last one was published.
    #[error("policy version {version} is older than version {last} published before")]
    VersionWentBack { version: u64, last: u64 },
    /// Something was published after the stop signal.
    #[error("the run has been told to stop; nothing can be published after that")]
    Stopped,
    /// Another learner of the same run is alive.
    #[error(
        "another learner of run {run_id} is alive ({detail}); stop it or choose another run id"
    )]
    AlreadyRunning { run_id: String, detail: String },
    /// Files of another version, user or kind are where the run's own should be; they are not opened.
    #[error("{path}: {reason}; remove it or choose another run id")]
    Stale { path: PathBuf, reason: String },
    /// Not enough room for the shared-memory segments.
    #[error(
        "{path}: {available} bytes free, {needed} bytes needed for shared memory; free some, mount it larger, or lower limits.*"
    )]
    NoSpace { path: PathBuf, needed: u64, available: u64 },
    /// An address could not be listened on or understood.
    #[error("endpoint {endpoint}: {reason}")]
    Endpoint { endpoint: String, reason: String },
    /// The other side has ended for good (in-process only), or this link has been shut down.
    #[error("the link is closed")]
    Closed,
    /// The library below failed in a way that trying again does not cure.
    #[error("{0}")]
    Backend(String),
}
