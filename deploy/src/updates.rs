//! What passes between the control loop and the threads that fetch and keep policies: nothing of it makes the
//! loop wait.

use std::sync::{Arc, Mutex, PoisonError, TryLockError};

use crossbeam_channel::{Receiver, Sender, bounded};
use serde::{Deserialize, Serialize};

use crate::runner::PolicyRunner;
use crate::state::PolicyRef;
use crate::verify::Verified;

/// Events that wait to be dealt with.
const EVENTS_MAX: usize = 16;

/// What the loop's process has to say, mostly about policies.
#[derive(Debug, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum PolicyEvent {
    /// The robot is there and in order; this start of the loop wants a policy.
    Ready {
        /// Drawn anew at each start.
        run: u64,
    },
    /// It was staged, and the loop's process refuses it.
    Unfit {
        /// Which one.
        policy: PolicyRef,
        /// Why.
        reason: String,
    },
    /// It drives the robot from now on.
    Begun(PolicyRef),
    /// It ran well through its trial.
    Good {
        /// Which one.
        policy: PolicyRef,
        /// How long it drove the robot, s.
        walked_s: f64,
    },
    /// It misbehaved and must not run again.
    Bad {
        /// Which one.
        policy: PolicyRef,
        /// What it did.
        reason: String,
        /// How long it drove the robot, s.
        walked_s: f64,
        /// Whether the robot fell.
        fell: bool,
    },
    /// The run ended in order; what it was on trial for is not held against it.
    Ended(PolicyRef),
    /// It was replaced; taking it apart takes longer than the loop has. Stays within the process.
    #[serde(skip)]
    Replaced(Box<PolicyRunner>),
}

/// A place for the newest verified policy; an older one that nobody took is replaced.
#[derive(Clone, Debug, Default)]
pub struct Slot(Arc<Mutex<Option<Verified>>>);

impl Slot {
    /// Puts a policy there.
    pub fn put(&self, verified: Verified) {
        let old = self.0.lock().unwrap_or_else(PoisonError::into_inner).replace(verified);
        drop(old);
    }

    /// Whether there is one; false also where somebody is just putting one there.
    pub fn has_one(&self) -> bool {
        match self.0.try_lock() {
            Ok(slot) => slot.is_some(),
            Err(TryLockError::Poisoned(slot)) => slot.into_inner().is_some(),
            Err(TryLockError::WouldBlock) => false,
        }
    }

    /// Takes it; `None` also where somebody is just putting one there.
    pub fn try_take(&self) -> Option<Verified> {
        match self.0.try_lock() {
            Ok(mut slot) => slot.take(),
            Err(TryLockError::Poisoned(slot)) => slot.into_inner().take(),
            Err(TryLockError::WouldBlock) => None,
        }
    }
}

/// The loop's side.
#[derive(Debug)]
pub struct Updates {
    slot: Slot,
    events: Sender<PolicyEvent>,
}

impl Updates {
    /// New policies come through `slot`; what the loop learns goes to the receiver.
    pub fn new(slot: Slot) -> (Self, Receiver<PolicyEvent>) {
        let (events, receiver) = bounded(EVENTS_MAX);
        (Self { slot, events }, receiver)
    }

    /// Whether a newer policy waits.
    pub fn waits(&self) -> bool {
        self.slot.has_one()
    }

    /// A newer policy, if there is one.
    pub fn take(&self) -> Option<Verified> {
        self.slot.try_take()
    }

    /// Reports an event. Full means that the disk hangs; the loop goes on and the event is lost with a line
    /// in the log.
    pub fn tell(&self, event: PolicyEvent) {
        if self.events.try_send(event).is_err() {
            tracing::error!("an event about a policy is lost: nobody takes it");
        }
    }
}
