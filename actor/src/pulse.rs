//! The pulse of an actor: every time that its loop turns to the link, it is alive. The learner says so in the
//! same word.

use std::io::Write;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use caudata_telemetry::{Pulse, StopFlag};
use caudata_transport::{ActorLink, LinkStats, PolicyUpdate, SendError, TransportError, Value};

/// What a process that is watched says on a line of its own.
pub const ALIVE: &str = "alive";
/// How often it does.
const BEAT_EVERY: Duration = Duration::from_millis(500);
/// What an actor says once, when it has had its first policy from the learner.
pub const JOINED: &str = "joined";

/// A link that beats with each use. The loop of an actor asks it at every control step, and at least every 20
/// ms while it waits.
pub struct PulsedLink {
    inner: Box<dyn ActorLink>,
    pulse: Pulse,
    joined: Arc<AtomicBool>,
}

impl PulsedLink {
    /// `inner`, with `pulse` beating, and `joined` raised by the first policy.
    pub fn new(inner: Box<dyn ActorLink>, pulse: Pulse, joined: Arc<AtomicBool>) -> Self {
        Self { inner, pulse, joined }
    }
}

impl ActorLink for PulsedLink {
    fn send(&mut self, frame: &[u8], timeout: Duration) -> Result<(), SendError> {
        self.pulse.beat();
        self.inner.send(frame, timeout)
    }

    fn takes_values(&self) -> bool {
        self.inner.takes_values()
    }

    fn send_value(&mut self, value: Value, timeout: Duration) -> Result<(), (SendError, Value)> {
        self.pulse.beat();
        self.inner.send_value(value, timeout)
    }

    fn next_policy(&mut self, timeout: Duration) -> Result<Option<PolicyUpdate>, TransportError> {
        self.pulse.beat();
        let update = self.inner.next_policy(timeout)?;
        if update.is_some() {
            self.joined.store(true, Ordering::Relaxed);
        }
        Ok(update)
    }

    fn flush(&mut self, timeout: Duration) -> Result<(), SendError> {
        self.pulse.beat();
        self.inner.flush(timeout)
    }

    fn stop_requested(&self) -> bool {
        self.pulse.beat();
        self.inner.stop_requested()
    }

    fn is_connected(&self) -> bool {
        self.inner.is_connected()
    }

    fn stats(&self) -> LinkStats {
        self.inner.stats()
    }
}

/// Says [`ALIVE`] on `out` twice a second while the loop beats, and [`JOINED`] once, when that is raised,
/// until `stop` is raised or nobody reads. Runs on a thread of its own; a process that stands still (SIGSTOP,
/// swapping) says nothing either.
pub fn say_alive(pulse: &Pulse, joined: &AtomicBool, stop: &StopFlag, mut out: impl Write) {
    let mut told = false;
    loop {
        if !told && joined.load(Ordering::Relaxed) {
            told = true;
            if writeln!(out, "{JOINED}").is_err() {
                return;
            }
        }
        if pulse.silent_for() < 2 * BEAT_EVERY && out.write_all(b"alive\n").is_err() {
            return;
        }
        if stop.wait(BEAT_EVERY) {
            return;
        }
    }
}
