//! The actor's end of a link between processes: the delivery protocol, a transmitting thread, the policy
//! cell. What carries the messages is behind [`Uplink`].

use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use parking_lot::{Condvar, Mutex};

use crate::crew::Crew;
use crate::policy_cell::{PolicyCell, Seen};
use crate::reliable::{Outbox, PolicyId, Status, Step, UpHead};
use crate::{ActorLink, Limits, LinkStats, PolicyUpdate, SendError, TransportError};

/// How long the transmitting thread rests when a frame could not be handed on.
const RETRY: Duration = Duration::from_millis(5);

/// Carries messages to the learner, whole and in order, or loses them.
pub(crate) trait Uplink: Send + Sync + 'static {
    /// Hands one message on. False when there is nobody or no room: it will be tried again.
    fn transmit(&self, head: &UpHead, frame: &Arc<[u8]>) -> bool;
}

/// What the threads of one actor link share.
pub(crate) struct ActorCore {
    pub(crate) limits: Limits,
    pub(crate) crew: Arc<Crew>,
    pub(crate) policy: PolicyCell,
    pub(crate) outbox: Mutex<Outbox>,
    /// For callers and the carrier's threads: an answer has come.
    changed: Condvar,
    /// For the transmitting thread: something to do.
    work: Condvar,
}

impl ActorCore {
    pub(crate) fn new(link: u64, limits: &Limits) -> Arc<Self> {
        Arc::new(Self {
            limits: limits.clone(),
            crew: Arc::default(),
            policy: PolicyCell::new(limits.max_policy_bytes),
            outbox: Mutex::new(Outbox::new(link, limits)),
            changed: Condvar::new(),
            work: Condvar::new(),
        })
    }

    /// Takes in an answer of the learner.
    pub(crate) fn on_status(&self, status: &Status) {
        if self.outbox.lock().on_status(status, Instant::now()) {
            self.changed.notify_all();
            self.work.notify_all();
        }
    }

    /// Starts a thread of the carrier, which ends when the crew is closing.
    pub(crate) fn spawn(
        self: &Arc<Self>,
        name: &'static str,
        body: impl FnOnce() + Send + 'static,
    ) -> Result<JoinHandle<()>, TransportError> {
        let core = Arc::clone(self);
        self.crew.spawn(name, move || core.wake_everyone(), body)
    }

    /// Breaks the link for good: callers get `Backend` with this text.
    pub(crate) fn fail(&self, failure: String) {
        self.crew.fail(failure);
        self.wake_everyone();
    }

    /// For a carrier's thread: rests until the learner speaks of a policy that is news to `have`, the link
    /// closes, or `time` has passed. Returns the news.
    pub(crate) fn wait_for_policy_news(
        &self,
        have: Option<PolicyId>,
        time: Duration,
    ) -> Option<PolicyId> {
        let news = |outbox: &Outbox| outbox.newest_policy().filter(|id| id.is_news_to(have));
        let nothing = |outbox: &mut Outbox| news(outbox).is_none() && !self.crew.is_closing();
        let mut outbox = self.outbox.lock();
        self.changed.wait_while_for(&mut outbox, nothing, time);
        news(&outbox)
    }

    fn wake_everyone(&self) {
        if self.crew.failure().is_some() {
            self.policy.close();
        }
        // Under the lock, so that nobody misses it between looking and waiting.
        let _outbox = self.outbox.lock();
        self.changed.notify_all();
        self.work.notify_all();
    }

    /// Body of the transmitting thread.
    fn transmit_until_closed(&self, uplink: &impl Uplink) {
        loop {
            let mut outbox = self.outbox.lock();
            if self.crew.is_closing() {
                break;
            }
            match outbox.step(Instant::now()) {
                Step::Wait(time) => {
                    self.work.wait_for(&mut outbox, time);
                }
                Step::Transmit(head, frame) => {
                    drop(outbox);
                    if !uplink.transmit(&head, &frame) {
                        self.rest_after_failure(&head);
                    }
                }
            }
        }
        let bye = self.outbox.lock().bye();
        uplink.transmit(&bye, &Arc::default());
    }

    fn rest_after_failure(&self, head: &UpHead) {
        let mut outbox = self.outbox.lock();
        outbox.failed(head);
        if !self.crew.is_closing() {
            self.work.wait_for(&mut outbox, RETRY);
        }
    }

    /// Waits until `attempt` gives something other than "not yet", at most `timeout`.
    fn wait_for(
        &self,
        timeout: Duration,
        mut attempt: impl FnMut(&mut Outbox, Instant) -> Result<(), SendError>,
    ) -> Result<(), SendError> {
        let deadline = Instant::now() + timeout;
        let mut outbox = self.outbox.lock();
        loop {
            if let Some(failure) = self.crew.failure() {
                return Err(SendError::Backend(failure));
            }
            let now = Instant::now();
            let result = attempt(&mut outbox, now);
            let not_yet =
                matches!(result, Err(SendError::Full { .. } | SendError::Disconnected { .. }));
            if !not_yet || now >= deadline {
                return result;
            }
            // The learner's falling silent is not an event: look again every heartbeat.
            let nap = (deadline - now).min(self.limits.heartbeat());
            self.changed.wait_for(&mut outbox, nap);
        }
    }
}

/// [`ActorLink`] over any [`Uplink`].
pub(crate) struct RemoteActor<U: Uplink> {
    core: Arc<ActorCore>,
    threads: Vec<JoinHandle<()>>,
    seen: Seen,
    stats: LinkStats,
    /// Last, so that what it holds goes after the threads have ended.
    _uplink: Arc<U>,
}

impl<U: Uplink> RemoteActor<U> {
    /// Starts transmitting. `threads` are those of the carrier.
    pub(crate) fn start(
        core: Arc<ActorCore>,
        uplink: Arc<U>,
        threads: Vec<JoinHandle<()>>,
    ) -> Result<Self, TransportError> {
        let mut link = Self {
            core: Arc::clone(&core),
            threads,
            seen: Seen::default(),
            stats: LinkStats::default(),
            _uplink: Arc::clone(&uplink),
        };
        let transmitter = link.core.spawn("caudata-send", move || {
            core.transmit_until_closed(&*uplink);
        })?;
        link.threads.push(transmitter);
        Ok(link)
    }
}

impl<U: Uplink> ActorLink for RemoteActor<U> {
    fn send(&mut self, frame: &[u8], timeout: Duration) -> Result<(), SendError> {
        let take = |outbox: &mut Outbox, now| outbox.take(frame, now);
        let result = self.core.wait_for(timeout, take);
        match result {
            Ok(()) => {
                self.core.work.notify_all();
                self.stats.frames += 1;
            }
            Err(_) => self.stats.refused += 1,
        }
        result
    }

    fn next_policy(&mut self, timeout: Duration) -> Result<Option<PolicyUpdate>, TransportError> {
        let next = self.core.policy.next(&mut self.seen, timeout);
        next.map_err(|error| match self.core.crew.failure() {
            Some(failure) => TransportError::Backend(failure),
            None => error,
        })
    }

    fn flush(&mut self, timeout: Duration) -> Result<(), SendError> {
        let flushed = |outbox: &mut Outbox, now| outbox.flushed(now);
        self.core.wait_for(timeout, flushed)
    }

    fn stop_requested(&self) -> bool {
        self.core.outbox.lock().stop()
    }

    fn is_connected(&self) -> bool {
        self.core.outbox.lock().is_connected(Instant::now())
    }

    fn stats(&self) -> LinkStats {
        let outbox = self.core.outbox.lock();
        LinkStats {
            retransmits: outbox.retransmits,
            depth: outbox.depth(),
            peers: usize::from(outbox.is_connected(Instant::now())),
            ..self.stats
        }
    }
}

impl<U: Uplink> Drop for RemoteActor<U> {
    fn drop(&mut self) {
        self.core.crew.close();
        self.core.wake_everyone();
        for thread in self.threads.drain(..) {
            // A thread that panicked has been reported by the crew.
            let _ = thread.join();
        }
    }
}
