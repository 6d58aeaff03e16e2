//! The threads of one end of a link: told to end together, and missed when one ends by itself.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use parking_lot::Mutex;

use crate::TransportError;

/// First and longest pause between attempts to reach the other side.
const PAUSE: (Duration, Duration) = (Duration::from_millis(50), Duration::from_secs(5));
/// How soon a pause ends when the end closes.
const CLOSING_SEEN: Duration = Duration::from_millis(50);

/// Attempts in a row that failed. They come more and more rarely, and so do the lines about them.
#[derive(Default)]
pub(crate) struct Failures(u32);

impl Failures {
    /// One more: whether to say so, and how long to wait.
    fn count(&mut self) -> (bool, Duration) {
        self.0 = self.0.saturating_add(1);
        let doublings = (self.0 - 1).min(16);
        let pause = (PAUSE.0 * 2_u32.pow(doublings)).min(PAUSE.1);
        (self.0.is_power_of_two(), pause)
    }

    /// Says that `what` has failed once more, the 1st, 2nd, 4th, … time, and waits before the next attempt.
    pub(crate) fn pause(&mut self, crew: &Crew, what: &str, error: &dyn std::fmt::Display) {
        let (say, pause) = self.count();
        if say {
            tracing::warn!(attempts = self.0, %error, "{what}");
        }
        let until = Instant::now() + pause;
        while !crew.is_closing() && Instant::now() < until {
            let left = until.saturating_duration_since(Instant::now());
            std::thread::sleep(left.min(CLOSING_SEEN));
        }
    }
}

/// Whether the end is closing, and what broke it.
#[derive(Default)]
pub(crate) struct Crew {
    closing: AtomicBool,
    failure: Mutex<Option<String>>,
}

impl Crew {
    pub(crate) fn is_closing(&self) -> bool {
        self.closing.load(Ordering::Acquire)
    }

    pub(crate) fn close(&self) {
        self.closing.store(true, Ordering::Release);
    }

    /// The first thing that broke this end for good.
    pub(crate) fn failure(&self) -> Option<String> {
        self.failure.lock().clone()
    }

    pub(crate) fn fail(&self, failure: String) {
        self.failure.lock().get_or_insert(failure);
    }

    /// Starts a thread. Should it end (panic) before the end closes, that is its failure, and `alarm` is
    /// raised.
    pub(crate) fn spawn(
        self: &Arc<Self>,
        name: &'static str,
        alarm: impl Fn() + Send + 'static,
        body: impl FnOnce() + Send + 'static,
    ) -> Result<JoinHandle<()>, TransportError> {
        let guard = EndGuard { crew: Arc::clone(self), name, alarm };
        let body = move || {
            let _guard = guard;
            body();
        };
        std::thread::Builder::new()
            .name(name.to_owned())
            .spawn(body)
            .map_err(|e| TransportError::Backend(format!("cannot start thread {name}: {e}")))
    }
}

struct EndGuard<A: Fn()> {
    crew: Arc<Crew>,
    name: &'static str,
    alarm: A,
}

impl<A: Fn()> Drop for EndGuard<A> {
    fn drop(&mut self) {
        if !self.crew.is_closing() {
            let name = self.name;
            self.crew.fail(format!("thread {name} of the link has ended unexpectedly"));
            (self.alarm)();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn attempts_that_fail_come_more_rarely_and_are_told_more_rarely() {
        let mut failures = Failures::default();
        let counted: Vec<_> = (0..10).map(|_| failures.count()).collect();
        let pauses = counted.iter().map(|(_, pause)| pause.as_millis());
        // From 50 ms to 5 s.
        let doubled = [50, 100, 200, 400, 800, 1_600, 3_200, 5_000, 5_000, 5_000];
        assert!(pauses.eq(doubled));
        let told: Vec<_> = (1..).zip(counted).filter(|(_, (say, _))| *say).collect();
        assert!(told.iter().map(|(number, _)| *number).eq([1, 2, 4, 8]));
    }

    #[test]
    fn a_thread_that_ends_early_is_the_failure_of_its_end() {
        let crew = Arc::new(Crew::default());
        let (raise, raised) = crossbeam_channel::bounded(1);
        let alarm = move || raise.send(()).unwrap();
        let thread = crew.spawn("early", alarm, || ()).unwrap();
        thread.join().unwrap();
        raised.recv().unwrap();
        assert!(crew.failure().unwrap().contains("early"));
    }

    #[test]
    fn ending_after_close_is_no_failure() {
        let crew = Arc::new(Crew::default());
        crew.close();
        let thread = crew.spawn("orderly", || panic!("alarm"), || ()).unwrap();
        thread.join().unwrap();
        assert_eq!(crew.failure(), None);
    }
}
