//! The threads of one end of a link: told to end together, and missed when one ends by itself.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;

use crate::TransportError;

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
        let failure = self.failure.lock().unwrap_or_else(PoisonError::into_inner);
        failure.clone()
    }

    pub(crate) fn fail(&self, failure: String) {
        let mut slot = self.failure.lock().unwrap_or_else(PoisonError::into_inner);
        slot.get_or_insert(failure);
    }

    /// Starts a thread. Should it end (panic) before the end closes, that is its failure, and `alarm` is raised.
    pub(crate) fn spawn(
        self: &Arc<Self>,
        name: &'static str,
        alarm: impl Fn() + Send + 'static,
        body: impl FnOnce() + Send + 'static,
    ) -> Result<JoinHandle<()>, TransportError> {
        let guard = EndGuard {
            crew: Arc::clone(self),
            name,
            alarm,
        };
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
            self.crew
                .fail(format!("thread {name} of the link has ended unexpectedly"));
            (self.alarm)();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

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
