//! The trait pair that actors and learner are written against, the values that cross it, and the factories.

use std::any::Any;
use std::sync::Arc;
use std::time::Duration;

use crate::{SendError, TransportConfig, TransportError};

/// An actor's end: rollout frames out, policies in.
///
/// Dropping a link tells the learner that it ends; frames not yet acknowledged are given up, so call
/// [`flush`](Self::flush) first when they matter.
pub trait ActorLink: Send {
    /// Hands one rollout frame over, waiting at most `timeout` for room (back-pressure).
    ///
    /// Ok: the link has taken the frame, and the learner will get it once and in order unless a side dies.
    /// Err: the frame has not been taken and will not arrive. `Full` and `Disconnected` may be tried again
    /// with the same frame.
    fn send(&mut self, frame: &[u8], timeout: Duration) -> Result<(), SendError>;

    /// Whether the learner is in this process, so that [`Self::send_value`] works.
    fn takes_values(&self) -> bool {
        false
    }

    /// As [`send`](Self::send), for a value that stays in this process: it counts as a frame, in order with the
    /// others. What was not taken comes back with the error; a link to another process takes none.
    ///
    /// # Errors
    /// As [`send`](Self::send).
    fn send_value(&mut self, value: Value, _timeout: Duration) -> Result<(), (SendError, Value)> {
        let unacknowledged = self.stats().depth;
        Err((SendError::Disconnected { unacknowledged }, value))
    }

    /// The newest policy not returned before, waiting at most `timeout` for one; older ones that were
    /// never looked at are skipped. `Ok(None)` when nothing new came, learner there or not.
    fn next_policy(&mut self, timeout: Duration) -> Result<Option<PolicyUpdate>, TransportError>;

    /// Waits until the learner's process holds every frame that `send` took, at most `timeout`.
    fn flush(&mut self, timeout: Duration) -> Result<(), SendError>;

    /// Whether the newest update known here says [`Control::Stop`]; cheap enough to ask every step.
    fn stop_requested(&self) -> bool;

    /// Whether a learner has been heard within the peer time-out.
    fn is_connected(&self) -> bool;

    /// Counters of this end.
    fn stats(&self) -> LinkStats;
}

/// The learner's end: rollout frames in, policies out.
pub trait LearnerLink: Send {
    /// The next frame of any actor, in order per actor, waiting at most `timeout` for one.
    /// No actor starves another: none may have more than `window_frames` waiting.
    fn recv(&mut self, timeout: Duration) -> Result<Option<Frame>, TransportError>;

    /// Makes `update` the newest policy for every actor, present and future. Does not wait for actors.
    ///
    /// Versions must not go back on one link; the same version may be repeated (a stop usually does).
    /// After [`Control::Stop`] nothing more can be published.
    fn publish_policy(&mut self, update: PolicyUpdate) -> Result<(), TransportError>;

    /// What actors must be given to reach this learner: the configuration it was made with, chosen port
    /// filled in.
    fn actor_config(&self) -> TransportConfig;

    /// Counters of this end.
    fn stats(&self) -> LinkStats;
}

/// One rollout frame as the actor handed it over.
#[derive(Debug)]
pub struct Frame {
    /// The bytes; none where a value came instead.
    pub bytes: Vec<u8>,
    /// What [`ActorLink::send_value`] was given.
    pub value: Option<Value>,
}

/// What an actor in the learner's process hands over without turning it into bytes.
#[derive(Debug)]
pub struct Value {
    /// The value itself, opaque as the bytes of a frame are.
    pub content: Box<dyn Any + Send>,
    /// The memory that it takes, bytes: bounded and counted as a frame of that size is.
    pub bytes: usize,
}

/// One published policy.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct PolicyUpdate {
    /// Learner iteration that made it.
    pub version: u64,
    /// SHA-256 of `bytes`, as the learner computed it. The transport carries it and does not check it.
    pub sha256: [u8; 32],
    /// The ONNX file. May be empty on a stop.
    pub bytes: Arc<[u8]>,
    /// What the actors shall do.
    pub control: Control,
}

/// What the learner asks of its actors.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Control {
    /// Collect rollouts with this policy.
    Run,
    /// Finish and leave. Final: every present and future actor sees it.
    Stop,
}

/// Counters of one end of a link, all since the link was made except `depth` and `peers`, which are current.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct LinkStats {
    /// Frames: taken by `send` (actor), handed out by `recv` (learner).
    pub frames: u64,
    /// Actor: `send` calls that did not take their frame. Learner: arrivals turned away because they were
    /// malformed, too large, beyond the window, or from one actor too many.
    pub refused: u64,
    /// Actor: frames transmitted again because the learner did not have them.
    pub retransmits: u64,
    /// Learner: arrivals recognised as repeated and not handed out again.
    pub duplicates: u64,
    /// Frames waiting now. Actor: taken, not yet known to be in the learner's process (in-process: always 0).
    /// Learner: in its process, not yet handed out.
    pub depth: usize,
    /// Other ends heard within the peer time-out.
    pub peers: usize,
}

/// The learner's end of run `run_id`. Run ids are 1 to 64 of `A-Z a-z 0-9 _ - .`.
///
/// # Errors
/// The configuration does not work, another learner of this run is alive, stale files are in the way, or
/// there is no room in shared memory. In-process links come from [`InprocHub`](crate::InprocHub) instead.
pub fn learner_link(
    config: &TransportConfig,
    run_id: &str,
) -> Result<Box<dyn LearnerLink>, TransportError> {
    check(config, run_id)?;
    match config {
        TransportConfig::Inproc(_) => Err(not_from_here()),
        TransportConfig::Zenoh(config) => crate::zenoh_link::learner(config, run_id),
        TransportConfig::Iceoryx2(config) => crate::iceoryx2_link::learner(config, run_id),
    }
}

/// An actor's end of run `run_id`. Succeeds whether or not the learner is there yet: the link connects,
/// and reconnects, by itself.
///
/// # Errors
/// As [`learner_link`], except that no learner is looked for.
pub fn actor_link(
    config: &TransportConfig,
    run_id: &str,
    actor_id: u32,
) -> Result<Box<dyn ActorLink>, TransportError> {
    check(config, run_id)?;
    tracing::debug!(run_id, actor_id, "making an actor's link");
    match config {
        TransportConfig::Inproc(_) => Err(not_from_here()),
        TransportConfig::Zenoh(config) => crate::zenoh_link::actor(config, run_id),
        TransportConfig::Iceoryx2(config) => crate::iceoryx2_link::actor(config, run_id),
    }
}

/// Removes what a run left behind on this host when its learner was killed; nothing when it is alive or was
/// tidy. For supervisors; a new learner of the same run does it by itself.
///
/// # Errors
/// [`TransportError::AlreadyRunning`] while the learner lives, [`TransportError::Stale`] for foreign files.
pub fn clean_up(config: &TransportConfig, run_id: &str) -> Result<(), TransportError> {
    check(config, run_id)?;
    match config {
        TransportConfig::Iceoryx2(config) => crate::iceoryx2_link::clean_up(config, run_id),
        TransportConfig::Inproc(_) | TransportConfig::Zenoh(_) => Ok(()),
    }
}

fn check(config: &TransportConfig, run_id: &str) -> Result<(), TransportError> {
    config.limits().check()?;
    let letter = |c: char| c.is_ascii_alphanumeric() || matches!(c, '_' | '-' | '.');
    if run_id.is_empty()
        || run_id.len() > 64
        || !run_id.chars().all(letter)
        || run_id.starts_with('.')
    {
        return Err(TransportError::Config(format!(
            "run id {run_id:?} must be 1 to 64 of A-Z a-z 0-9 _ - . and not start with a dot"
        )));
    }
    Ok(())
}

fn not_from_here() -> TransportError {
    TransportError::Config(
        "in-process links come from InprocHub; between processes use iceoryx2 or zenoh".to_owned(),
    )
}
