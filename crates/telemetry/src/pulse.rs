//! A sign of life: the loop that does the work beats, others look how long it has been silent.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

/// The pulse of one loop. Cloning shares it. A beat is one atomic store.
///
/// A thread that only answers `/healthz` says nothing about the loop beside it; this does.
#[derive(Clone, Debug)]
pub struct Pulse {
    began: Instant,
    /// Milliseconds from `began` to the last beat.
    last_ms: Arc<AtomicU64>,
}

impl Default for Pulse {
    fn default() -> Self {
        Self::new()
    }
}

impl Pulse {
    /// A pulse that has just beaten.
    pub fn new() -> Self {
        Self { began: Instant::now(), last_ms: Arc::default() }
    }

    /// The loop is alive.
    pub fn beat(&self) {
        let now = u64::try_from(self.began.elapsed().as_millis()).unwrap_or(u64::MAX);
        self.last_ms.store(now, Ordering::Relaxed);
    }

    /// Time since the last beat.
    pub fn silent_for(&self) -> Duration {
        let last = Duration::from_millis(self.last_ms.load(Ordering::Relaxed));
        self.began.elapsed().saturating_sub(last)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn silence_grows_until_the_next_beat_of_any_clone() {
        let pulse = Pulse::new();
        std::thread::sleep(Duration::from_millis(30));
        let silent = pulse.silent_for();
        assert!(silent >= Duration::from_millis(30), "{silent:?}");
        let before = Instant::now();
        pulse.clone().beat();
        // The beat is kept in whole milliseconds.
        let silent = pulse.silent_for();
        assert!(silent <= before.elapsed() + Duration::from_millis(1), "{silent:?}");
    }
}
