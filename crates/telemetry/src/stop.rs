//! Stopping: one flag that everything waits on, set by the first signal; the second one ends at once.

use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::time::{Duration, Instant};

use crate::ExitCode;

/// How long a process may take to drain after the first signal before it is ended with
/// [`ExitCode::TempFail`]. Larger than any single time limit inside (checkpoint, flush, upload).
pub const DRAIN_DEADLINE: Duration = Duration::from_secs(60);

/// A flag that is raised once and can be waited on. Cloning shares it.
#[derive(Clone, Debug, Default)]
pub struct StopFlag {
    shared: Arc<Shared>,
}

#[derive(Debug, Default)]
struct Shared {
    reason: Mutex<Option<String>>,
    raised: Condvar,
}

impl StopFlag {
    /// A flag that is down.
    pub fn new() -> Self {
        Self::default()
    }

    /// Raises the flag. The first reason is kept.
    pub fn request(&self, reason: &str) {
        let mut slot = self
            .shared
            .reason
            .lock()
            .unwrap_or_else(PoisonError::into_inner);
        slot.get_or_insert_with(|| reason.to_owned());
        self.shared.raised.notify_all();
    }

    /// Whether somebody asked to stop.
    pub fn is_set(&self) -> bool {
        self.shared
            .reason
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .is_some()
    }

    /// Why, once raised.
    pub fn reason(&self) -> Option<String> {
        self.shared
            .reason
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .clone()
    }

    /// Waits until the flag is raised or `timeout` has passed; true when it is raised.
    pub fn wait(&self, timeout: Duration) -> bool {
        let deadline = Instant::now() + timeout;
        let mut slot = self
            .shared
            .reason
            .lock()
            .unwrap_or_else(PoisonError::into_inner);
        while slot.is_none() {
            let left = deadline.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return false;
            }
            slot = self
                .shared
                .raised
                .wait_timeout(slot, left)
                .unwrap_or_else(PoisonError::into_inner)
                .0;
        }
        true
    }
}

/// Signals that come together are one.
const ONE_SIGNAL: Duration = Duration::from_millis(100);

/// From now on SIGINT, SIGTERM and SIGHUP (a terminal that closes; not where it is ignored, as under `nohup`) raise `stop`; a second signal ends the process at once with
/// [`ExitCode::Interrupted`], and draining longer than `drain_deadline` ends it with [`ExitCode::TempFail`].
///
/// The handler runs on a thread of its own that lives as long as the process.
///
/// # Errors
/// When the operating system refuses the thread or the handlers.
pub fn stop_on_signals(stop: &StopFlag, drain_deadline: Duration) -> std::io::Result<()> {
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()?;
    let (mut interrupt, mut terminate) = {
        use tokio::signal::unix::{SignalKind, signal};
        let _context = runtime.enter();
        (
            signal(SignalKind::interrupt())?,
            signal(SignalKind::terminate())?,
        )
    };
    let mut hangup = {
        use tokio::signal::unix::{SignalKind, signal};
        let _context = runtime.enter();
        match hangup_is_ignored() {
            true => None,
            false => Some(signal(SignalKind::hangup())?),
        }
    };
    let stop = stop.clone();
    std::thread::Builder::new().name("signals".into()).spawn(move || {
        runtime.block_on(async {
            let name = tokio::select! {
                _ = interrupt.recv() => "SIGINT",
                _ = terminate.recv() => "SIGTERM",
                () = async {
                    match &mut hangup {
                        Some(hangup) => {
                            hangup.recv().await;
                        }
                        None => std::future::pending().await,
                    }
                } => "SIGHUP",
            };
            // Before the log: who reads it may be gone or asleep.
            stop.request(name);
            tracing::info!(signal = name, "stopping; a second signal ends at once");
            // A parent that dies signals its children once for each of its threads that they hung on.
            let same = async {
                loop {
                    tokio::select! {
                        _ = interrupt.recv() => {}
                        _ = terminate.recv() => {}
                    }
                }
            };
            let _ = tokio::time::timeout(ONE_SIGNAL, same).await;
            tokio::select! {
                _ = interrupt.recv() => end(ExitCode::Interrupted, "second signal: ended without draining"),
                _ = terminate.recv() => end(ExitCode::Interrupted, "second signal: ended without draining"),
                () = tokio::time::sleep(drain_deadline) => end(ExitCode::TempFail, "draining took too long: ended"),
            }
        });
    })?;
    Ok(())
}

/// Whether this process was started with SIGHUP ignored. Bit n − 1 of `SigIgn` is signal n.
fn hangup_is_ignored() -> bool {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let mask = status.lines().find_map(|line| line.strip_prefix("SigIgn:"));
    mask.and_then(|mask| u64::from_str_radix(mask.trim(), 16).ok())
        .is_some_and(|mask| mask & 1 == 1)
}

fn end(code: ExitCode, why: &str) {
    tracing::error!("{why}");
    std::process::exit(i32::from(code.number()));
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn waiting_ends_when_another_thread_raises_the_flag() {
        let stop = StopFlag::new();
        assert!(!stop.wait(Duration::from_millis(1)));
        let other = stop.clone();
        let thread = std::thread::spawn(move || other.request("test"));
        assert!(stop.wait(Duration::from_secs(60)));
        thread.join().unwrap();
        stop.request("later");
        assert_eq!(stop.reason().as_deref(), Some("test"));
    }
}
