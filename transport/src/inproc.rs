//! Actors as threads of the learner's process: one lock, a bounded queue and a policy cell.

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::Duration;

use parking_lot::{Condvar, Mutex, MutexGuard};

use crate::policy_cell::{PolicyCell, Seen};
use crate::{
    ActorLink, Frame, InprocConfig, LearnerLink, LinkStats, PolicyUpdate, SendError,
    TransportConfig, TransportError, Value,
};

/// Makes the two kinds of ends of one in-process run. Cheap to clone.
///
/// There is one learner end; once it has been dropped, every actor end reports `Closed`.
#[derive(Clone)]
pub struct InprocHub {
    shared: Arc<Shared>,
}

impl InprocHub {
    /// A hub without ends yet.
    ///
    /// # Errors
    /// The limits do not work.
    pub fn new(config: &InprocConfig) -> Result<Self, TransportError> {
        config.limits.check()?;
        Ok(Self {
            shared: Arc::new(Shared {
                config: config.clone(),
                state: Mutex::default(),
                arrived: Condvar::new(),
                room: Condvar::new(),
                policy: PolicyCell::new(config.limits.max_policy_bytes),
            }),
        })
    }

    /// The learner's end.
    ///
    /// # Errors
    /// It has been taken before.
    pub fn learner(&self) -> Result<Box<dyn LearnerLink>, TransportError> {
        let mut state = self.shared.state.lock();
        if state.learner != LearnerState::NotYet {
            return Err(TransportError::AlreadyRunning {
                run_id: "in-process".to_owned(),
                detail: "this hub's learner end has been taken".to_owned(),
            });
        }
        state.learner = LearnerState::Alive;
        Ok(Box::new(InprocLearner {
            shared: Arc::clone(&self.shared),
            stats: LinkStats::default(),
        }))
    }

    /// One more actor's end.
    ///
    /// # Errors
    /// `max_actors` ends exist.
    pub fn actor(&self) -> Result<Box<dyn ActorLink>, TransportError> {
        let limits = &self.shared.config.limits;
        let mut state = self.shared.state.lock();
        if state.actors >= limits.max_actors {
            return Err(TransportError::Config(format!(
                "limits.max_actors = {} actors are connected",
                limits.max_actors
            )));
        }
        state.actors += 1;
        let slot = state.free.pop().unwrap_or_else(|| {
            state.waiting.push(0);
            state.waiting.len() - 1
        });
        Ok(Box::new(InprocActor {
            shared: Arc::clone(&self.shared),
            slot,
            seen: Seen::default(),
            stats: LinkStats::default(),
        }))
    }
}

#[derive(Clone, Copy, PartialEq, Eq, Default)]
enum LearnerState {
    #[default]
    NotYet,
    Alive,
    Gone,
}

#[derive(Default)]
struct State {
    learner: LearnerState,
    actors: usize,
    /// Frames of all actors in order of arrival, each with its actor's slot.
    queue: VecDeque<(usize, Frame)>,
    /// Per slot: how many of its frames are in `queue`.
    waiting: Vec<usize>,
    /// Slots of dropped actors whose frames have all been read.
    free: Vec<usize>,
    /// Slots of dropped actors with frames still in `queue`.
    leaving: Vec<usize>,
}

impl State {
    fn pop(&mut self) -> Option<Frame> {
        let (slot, frame) = self.queue.pop_front()?;
        self.waiting[slot] -= 1;
        if self.waiting[slot] == 0
            && let Some(at) = self.leaving.iter().position(|&s| s == slot)
        {
            self.leaving.swap_remove(at);
            self.free.push(slot);
        }
        Some(frame)
    }
}

struct Shared {
    config: InprocConfig,
    state: Mutex<State>,
    arrived: Condvar,
    room: Condvar,
    policy: PolicyCell,
}

struct InprocActor {
    shared: Arc<Shared>,
    slot: usize,
    seen: Seen,
    stats: LinkStats,
}

impl InprocActor {
    /// Waits until a frame of `size` bytes has room, and keeps the queue until it has been put there.
    fn room(&self, size: usize, timeout: Duration) -> Result<MutexGuard<'_, State>, SendError> {
        let limits = &self.shared.config.limits;
        if size > limits.max_frame_bytes {
            return Err(SendError::TooLarge { size, max: limits.max_frame_bytes });
        }
        let full = |state: &mut State| {
            state.learner != LearnerState::Gone && state.waiting[self.slot] >= limits.window_frames
        };
        let mut state = self.shared.state.lock();
        self.shared.room.wait_while_for(&mut state, full, timeout);
        if state.learner == LearnerState::Gone {
            return Err(SendError::Closed);
        }
        if full(&mut state) {
            return Err(SendError::Full { unacknowledged: state.waiting[self.slot] });
        }
        Ok(state)
    }

    fn put(&self, mut state: MutexGuard<'_, State>, frame: Frame) {
        state.waiting[self.slot] += 1;
        state.queue.push_back((self.slot, frame));
        drop(state);
        self.shared.arrived.notify_one();
    }

    fn count(&mut self, taken: bool) {
        if taken { self.stats.frames += 1 } else { self.stats.refused += 1 }
    }
}

impl ActorLink for InprocActor {
    fn send(&mut self, frame: &[u8], timeout: Duration) -> Result<(), SendError> {
        let sent = self.room(frame.len(), timeout).map(|state| {
            let bytes = frame.to_vec();
            self.put(state, Frame { bytes, value: None });
        });
        self.count(sent.is_ok());
        sent
    }

    fn takes_values(&self) -> bool {
        true
    }

    fn send_value(&mut self, value: Value, timeout: Duration) -> Result<(), (SendError, Value)> {
        let sent = match self.room(value.bytes, timeout) {
            Err(error) => Err((error, value)),
            Ok(state) => {
                let (bytes, value) = (Vec::new(), Some(value));
                self.put(state, Frame { bytes, value });
                Ok(())
            }
        };
        self.count(sent.is_ok());
        sent
    }

    fn next_policy(&mut self, timeout: Duration) -> Result<Option<PolicyUpdate>, TransportError> {
        self.shared.policy.next(&mut self.seen, timeout)
    }

    /// The queue is in the learner's process: whatever was sent is there already.
    fn flush(&mut self, _timeout: Duration) -> Result<(), SendError> {
        match self.shared.state.lock().learner {
            LearnerState::Gone => Err(SendError::Closed),
            _ => Ok(()),
        }
    }

    fn stop_requested(&self) -> bool {
        self.shared.policy.stop_requested()
    }

    fn is_connected(&self) -> bool {
        self.shared.state.lock().learner == LearnerState::Alive
    }

    fn stats(&self) -> LinkStats {
        let state = self.shared.state.lock();
        LinkStats { peers: usize::from(state.learner == LearnerState::Alive), ..self.stats }
    }
}

impl Drop for InprocActor {
    fn drop(&mut self) {
        let mut state = self.shared.state.lock();
        state.actors -= 1;
        // What it sent stays readable; the slot is reused once that has been read.
        if state.waiting[self.slot] == 0 {
            state.free.push(self.slot);
        } else {
            state.leaving.push(self.slot);
        }
    }
}

struct InprocLearner {
    shared: Arc<Shared>,
    stats: LinkStats,
}

impl LearnerLink for InprocLearner {
    fn recv(&mut self, timeout: Duration) -> Result<Option<Frame>, TransportError> {
        let mut state = self.shared.state.lock();
        let nothing = |state: &mut State| state.queue.is_empty();
        self.shared.arrived.wait_while_for(&mut state, nothing, timeout);
        let Some(frame) = state.pop() else { return Ok(None) };
        drop(state);
        self.shared.room.notify_all();
        self.stats.frames += 1;
        Ok(Some(frame))
    }

    fn publish_policy(&mut self, update: PolicyUpdate) -> Result<(), TransportError> {
        self.shared.policy.publish(update).map(|_| ())
    }

    fn actor_config(&self) -> TransportConfig {
        TransportConfig::Inproc(self.shared.config.clone())
    }

    fn stats(&self) -> LinkStats {
        let state = self.shared.state.lock();
        LinkStats { depth: state.queue.len(), peers: state.actors, ..self.stats }
    }
}

impl Drop for InprocLearner {
    fn drop(&mut self) {
        let mut state = self.shared.state.lock();
        state.learner = LearnerState::Gone;
        state.queue.clear();
        drop(state);
        self.shared.room.notify_all();
        self.shared.policy.close();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Limits;

    const SOON: Duration = Duration::from_millis(10);

    fn hub(window_frames: usize) -> InprocHub {
        let limits = Limits { window_frames, max_actors: 2, ..Limits::default() };
        InprocHub::new(&InprocConfig { limits }).unwrap()
    }

    #[test]
    fn there_is_one_learner_and_a_bounded_number_of_actors() {
        let hub = hub(1);
        let _learner = hub.learner().unwrap();
        assert!(hub.learner().is_err());
        let first = hub.actor().unwrap();
        let _second = hub.actor().unwrap();
        assert!(hub.actor().is_err());
        drop(first);
        assert!(hub.actor().is_ok());
    }

    #[test]
    fn frames_of_a_dropped_actor_stay_readable_and_its_slot_waits_for_that() {
        let hub = hub(1);
        let mut learner = hub.learner().unwrap();
        let mut first = hub.actor().unwrap();
        first.send(b"a", SOON).unwrap();
        drop(first);
        // The new actor has a window of its own although the old frame is still unread.
        let mut second = hub.actor().unwrap();
        second.send(b"b", SOON).unwrap();
        assert_eq!(learner.stats().depth, 2);
        assert_eq!(learner.recv(SOON).unwrap().unwrap().bytes, b"a");
        assert_eq!(learner.recv(SOON).unwrap().unwrap().bytes, b"b");
        assert_eq!(hub.shared.state.lock().free.len(), 1);
    }

    #[test]
    fn values_and_frames_share_the_order_the_window_and_the_books() {
        let hub = hub(2);
        let mut learner = hub.learner().unwrap();
        let mut actor = hub.actor().unwrap();
        assert!(actor.takes_values());
        let value = |content: u32, bytes| Value { content: Box::new(content), bytes };
        actor.send(b"a", SOON).unwrap();
        actor.send_value(value(7, 100), SOON).unwrap();
        let (error, back) = actor.send_value(value(8, 100), SOON).unwrap_err();
        assert_eq!(error, SendError::Full { unacknowledged: 2 });
        assert_eq!(back.content.downcast_ref::<u32>(), Some(&8));
        assert_eq!(learner.recv(SOON).unwrap().unwrap().bytes, b"a");
        let taken = learner.recv(SOON).unwrap().unwrap().value.unwrap();
        assert_eq!(taken.content.downcast_ref::<u32>(), Some(&7));
        let (sent, read) = (actor.stats(), learner.stats());
        assert_eq!((sent.frames, sent.refused), (2, 1));
        assert_eq!((read.frames, read.depth), (2, 0));
        let large = value(9, Limits::default().max_frame_bytes + 1);
        let (error, _) = actor.send_value(large, SOON).unwrap_err();
        assert!(matches!(error, SendError::TooLarge { .. }));
    }

    #[test]
    fn actors_see_that_the_learner_has_gone() {
        let hub = hub(1);
        let learner = hub.learner().unwrap();
        let mut actor = hub.actor().unwrap();
        assert!(actor.is_connected());
        drop(learner);
        assert_eq!(actor.send(b"x", SOON), Err(SendError::Closed));
        assert_eq!(actor.flush(SOON), Err(SendError::Closed));
        assert_eq!(actor.next_policy(SOON), Err(TransportError::Closed));
    }
}
