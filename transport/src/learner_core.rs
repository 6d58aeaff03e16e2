//! The learner's end of a link between processes: the inbox, the policy cell, and the counters.
//! What carries the messages is behind [`Downlink`].

use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use parking_lot::{Condvar, Mutex};

use crate::crew::Crew;
use crate::policy_cell::PolicyCell;
use crate::reliable::{Inbox, Status, UpHead};
use crate::{
    Control, Frame, LearnerLink, Limits, LinkStats, PolicyUpdate, TransportConfig, TransportError,
};

/// Carries answers and policies to the actors, on threads of its own.
pub(crate) trait Downlink: Send + 'static {
    /// Tells the carrier's thread that answers are owed or a policy has been published.
    fn wake(&self);

    /// Ends the carrier's threads; called once, after the crew has been told to close.
    fn close(&mut self);
}

/// What the threads of the learner's end share.
pub(crate) struct LearnerCore {
    pub(crate) limits: Limits,
    pub(crate) epoch: u64,
    pub(crate) crew: Arc<Crew>,
    pub(crate) policy: PolicyCell,
    inbox: Mutex<Inbox>,
    arrived: Condvar,
}

impl LearnerCore {
    pub(crate) fn new(epoch: u64, limits: &Limits) -> Arc<Self> {
        Arc::new(Self {
            limits: limits.clone(),
            epoch,
            crew: Arc::default(),
            policy: PolicyCell::new(limits.max_policy_bytes),
            inbox: Mutex::new(Inbox::new(epoch, limits)),
            arrived: Condvar::new(),
        })
    }

    /// Takes in one message of an actor.
    pub(crate) fn on_message(&self, head: &[u8], frame: Vec<u8>) {
        let Some(head) = UpHead::decode(head) else {
            self.inbox.lock().refused += 1;
            return;
        };
        if self.inbox.lock().on_message(&head, frame, Instant::now()) {
            self.arrived.notify_one();
        }
    }

    /// The answers owed, or one for every actor that is there.
    pub(crate) fn answers(&self, everyone: bool) -> Vec<Status> {
        self.inbox.lock().answers(everyone, Instant::now())
    }

    /// Whether some answer is owed before the next heartbeat.
    pub(crate) fn owes_answers(&self) -> bool {
        self.inbox.lock().owes_answers()
    }

    /// Starts a thread of the carrier, which ends when the crew is closing.
    pub(crate) fn spawn(
        self: &Arc<Self>,
        name: &'static str,
        body: impl FnOnce() + Send + 'static,
    ) -> Result<JoinHandle<()>, TransportError> {
        let core = Arc::clone(self);
        let alarm = move || {
            let _inbox = core.inbox.lock();
            core.arrived.notify_all();
        };
        self.crew.spawn(name, alarm, body)
    }
}

/// [`LearnerLink`] over any [`Downlink`].
pub(crate) struct RemoteLearner<D: Downlink> {
    core: Arc<LearnerCore>,
    downlink: D,
    actor_config: TransportConfig,
    stats: LinkStats,
}

impl<D: Downlink> RemoteLearner<D> {
    pub(crate) fn new(core: Arc<LearnerCore>, downlink: D, actor_config: TransportConfig) -> Self {
        Self { core, downlink, actor_config, stats: LinkStats::default() }
    }
}

impl<D: Downlink> LearnerLink for RemoteLearner<D> {
    fn recv(&mut self, timeout: Duration) -> Result<Option<Frame>, TransportError> {
        let nothing = |inbox: &mut Inbox| inbox.depth() == 0 && self.core.crew.failure().is_none();
        let mut inbox = self.core.inbox.lock();
        self.core.arrived.wait_while_for(&mut inbox, nothing, timeout);
        let Some(bytes) = inbox.pop() else {
            let failure = self.core.crew.failure();
            return failure.map_or(Ok(None), |failure| Err(TransportError::Backend(failure)));
        };
        drop(inbox);
        self.downlink.wake();
        self.stats.frames += 1;
        Ok(Some(Frame { bytes, value: None }))
    }

    fn publish_policy(&mut self, update: PolicyUpdate) -> Result<(), TransportError> {
        if let Some(failure) = self.core.crew.failure() {
            return Err(TransportError::Backend(failure));
        }
        let stop = update.control == Control::Stop;
        let generation = self.core.policy.publish(update)?;
        self.core.inbox.lock().announce(generation, stop);
        self.downlink.wake();
        Ok(())
    }

    fn actor_config(&self) -> TransportConfig {
        self.actor_config.clone()
    }

    fn stats(&self) -> LinkStats {
        let inbox = self.core.inbox.lock();
        LinkStats {
            refused: inbox.refused,
            duplicates: inbox.duplicates,
            depth: inbox.depth(),
            peers: inbox.peers(Instant::now()),
            ..self.stats
        }
    }
}

impl<D: Downlink> Drop for RemoteLearner<D> {
    fn drop(&mut self) {
        self.core.crew.close();
        self.downlink.close();
    }
}
