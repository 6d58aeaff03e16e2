//! The newest policy, and who has seen it: a cell that is overwritten, never queued.

use std::time::Duration;

use parking_lot::{Condvar, Mutex};

use crate::{Control, PolicyUpdate, TransportError};

/// Holds the newest policy for any number of readers, each with its own [`Seen`].
pub(crate) struct PolicyCell {
    max_bytes: usize,
    state: Mutex<State>,
    changed: Condvar,
}

#[derive(Default)]
struct State {
    /// Grows by one with every change, so that a repeated version is still news.
    generation: u64,
    newest: Option<PolicyUpdate>,
    closed: bool,
}

/// The generation that a reader has been given last.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Seen(u64);

impl PolicyCell {
    pub(crate) fn new(max_bytes: usize) -> Self {
        Self { max_bytes, state: Mutex::default(), changed: Condvar::new() }
    }

    /// The learner's way in: checks size, order and finality. Returns the new generation.
    pub(crate) fn publish(&self, update: PolicyUpdate) -> Result<u64, TransportError> {
        if update.bytes.len() > self.max_bytes {
            return Err(TransportError::PolicyTooLarge {
                size: update.bytes.len(),
                max: self.max_bytes,
            });
        }
        let mut state = self.state.lock();
        if let Some(last) = &state.newest {
            if last.control == Control::Stop {
                return Err(TransportError::Stopped);
            }
            if update.version < last.version {
                return Err(TransportError::VersionWentBack {
                    version: update.version,
                    last: last.version,
                });
            }
        }
        state.newest = Some(update);
        state.generation += 1;
        let generation = state.generation;
        drop(state);
        self.changed.notify_all();
        Ok(generation)
    }

    /// A carrier's way in on the actor's side, where the learner has checked already. A restarted learner may
    /// begin with an older version.
    pub(crate) fn replace(&self, update: PolicyUpdate) {
        let mut state = self.state.lock();
        state.newest = Some(update);
        state.generation += 1;
        drop(state);
        self.changed.notify_all();
    }

    /// The newest policy with its generation, for a carrier to hand on.
    pub(crate) fn newest(&self) -> Option<(u64, PolicyUpdate)> {
        let state = self.state.lock();
        let newest = state.newest.clone()?;
        Some((state.generation, newest))
    }

    /// The reader's way out: the newest policy when it is news to `seen`, waiting at most `timeout` for one.
    pub(crate) fn next(
        &self,
        seen: &mut Seen,
        timeout: Duration,
    ) -> Result<Option<PolicyUpdate>, TransportError> {
        let mut state = self.state.lock();
        let nothing = |state: &mut State| state.generation == seen.0 && !state.closed;
        self.changed.wait_while_for(&mut state, nothing, timeout);
        if state.generation == seen.0 {
            return if state.closed { Err(TransportError::Closed) } else { Ok(None) };
        }
        seen.0 = state.generation;
        Ok(state.newest.clone())
    }

    pub(crate) fn stop_requested(&self) -> bool {
        let state = self.state.lock();
        matches!(&state.newest, Some(update) if update.control == Control::Stop)
    }

    /// Nothing more will come: readers that have seen the newest get `Closed` instead of waiting.
    pub(crate) fn close(&self) {
        self.state.lock().closed = true;
        self.changed.notify_all();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn update(version: u64, control: Control) -> PolicyUpdate {
        PolicyUpdate { version, sha256: [version as u8; 32], bytes: vec![0; 4].into(), control }
    }

    #[test]
    fn only_the_newest_is_returned_and_only_once() {
        let cell = PolicyCell::new(4);
        let mut seen = Seen::default();
        assert_eq!(cell.next(&mut seen, Duration::ZERO), Ok(None));
        cell.publish(update(1, Control::Run)).unwrap();
        cell.publish(update(2, Control::Run)).unwrap();
        let got = cell.next(&mut seen, Duration::ZERO).unwrap().unwrap();
        assert_eq!(got.version, 2);
        assert_eq!(cell.next(&mut seen, Duration::ZERO), Ok(None));
        // A late reader starts with nothing seen.
        let mut late = Seen::default();
        assert!(cell.next(&mut late, Duration::ZERO).unwrap().is_some());
    }

    #[test]
    fn publishing_checks_size_order_and_finality() {
        let cell = PolicyCell::new(3);
        let refused = cell.publish(update(1, Control::Run));
        assert_eq!(refused, Err(TransportError::PolicyTooLarge { size: 4, max: 3 }));
        let cell = PolicyCell::new(4);
        cell.publish(update(5, Control::Run)).unwrap();
        let refused = cell.publish(update(4, Control::Run));
        assert_eq!(refused, Err(TransportError::VersionWentBack { version: 4, last: 5 }));
        cell.publish(update(5, Control::Stop)).unwrap();
        assert!(cell.stop_requested());
        assert_eq!(cell.publish(update(6, Control::Run)), Err(TransportError::Stopped));
    }
}
