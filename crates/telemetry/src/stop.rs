//! Stopping: one flag that everything waits on, set by the first signal; the second one ends at once.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::time::Duration;

use crate::exit::ExitCode;

/// How long a process may take to drain after the first signal before it is ended with
/// [`ExitCode::TempFail`]. Larger than any single time limit inside (checkpoint, flush, upload).
pub const DRAIN_DEADLINE: Duration = Duration::from_secs(60);

/// How long a process that deals with a second signal itself may take before it is ended.
pub const INSIST_DEADLINE: Duration = Duration::from_secs(20);

/// What a second signal does: it ends the process at once, unless the process said that it deals with it
/// itself, because something would be left in an unsafe state. Cloning shares it.
#[derive(Clone, Debug, Default)]
pub struct Insistence {
    flag: StopFlag,
    claimed: Arc<AtomicBool>,
}

impl Insistence {
    /// From now on a second signal raises the flag that is answered, and the process has [`INSIST_DEADLINE`]
    /// to end by itself.
    pub fn claim(&self) -> StopFlag {
        self.claimed.store(true, Ordering::SeqCst);
        self.flag.clone()
    }

    /// True where the process takes over.
    fn passed_on(&self, reason: &str) -> bool {
        let claimed = self.claimed.load(Ordering::SeqCst);
        if claimed {
            self.flag.request(reason);
        }
        claimed
    }
}

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
        let mut slot = self.shared.reason.lock().unwrap_or_else(PoisonError::into_inner);
        slot.get_or_insert_with(|| reason.to_owned());
        self.shared.raised.notify_all();
    }

    /// Whether somebody asked to stop.
    pub fn is_set(&self) -> bool {
        self.shared.reason.lock().unwrap_or_else(PoisonError::into_inner).is_some()
    }

    /// Why, once raised.
    pub fn reason(&self) -> Option<String> {
        self.shared.reason.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Waits until the flag is raised or `timeout` has passed; true when it is raised.
    pub fn wait(&self, timeout: Duration) -> bool {
        let slot = self.shared.reason.lock().unwrap_or_else(PoisonError::into_inner);
        let waited = self.shared.raised.wait_timeout_while(slot, timeout, |slot| slot.is_none());
        waited.unwrap_or_else(PoisonError::into_inner).0.is_some()
    }
}

/// Signals that come together are one.
const ONE_SIGNAL: Duration = Duration::from_millis(100);

/// From now on SIGINT, SIGTERM and SIGHUP (a terminal that closes; not where it is ignored, as under `nohup`)
/// raise `stop`; a second signal ends the process at once with [`ExitCode::Interrupted`], and draining longer
/// than `drain_deadline` ends it with [`ExitCode::TempFail`]; where `insistence` was claimed, both wait
/// [`INSIST_DEADLINE`] for the process to end by itself.
///
/// The handler runs on a thread of its own that lives as long as the process.
///
/// # Errors
/// When the operating system refuses the thread or the handlers.
pub fn stop_on_signals(
    stop: &StopFlag,
    insistence: &Insistence,
    drain_deadline: Duration,
) -> std::io::Result<()> {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    let (mut interrupt, mut terminate) = {
        use tokio::signal::unix::{SignalKind, signal};
        let _context = runtime.enter();
        (signal(SignalKind::interrupt())?, signal(SignalKind::terminate())?)
    };
    let mut hangup = {
        use tokio::signal::unix::{SignalKind, signal};
        let _context = runtime.enter();
        if hangup_is_ignored() { None } else { Some(signal(SignalKind::hangup())?) }
    };
    let (stop, insistence) = (stop.clone(), insistence.clone());
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
            let (code, why) = tokio::select! {
                _ = interrupt.recv() => (ExitCode::Interrupted, "second signal: ended without draining"),
                _ = terminate.recv() => (ExitCode::Interrupted, "second signal: ended without draining"),
                () = tokio::time::sleep(drain_deadline) => (ExitCode::TempFail, "draining took too long: ended"),
            };
            if insistence.passed_on(why) {
                tokio::time::sleep(INSIST_DEADLINE).await;
            }
            end(code, why);
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
    crate::logging::last_words(&[]);
    std::process::exit(i32::from(code.number()));
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_second_signal_is_passed_on_to_whoever_claimed_it_only() {
        let insistence = Insistence::default();
        assert!(!insistence.passed_on("SIGINT"));
        let flag = insistence.claim();
        assert!(!flag.is_set());
        assert!(insistence.passed_on("SIGINT") && flag.is_set());
    }

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
