//! One actor as a process, over all its incarnations: killed when it hangs, started again when it dies.

use std::path::Path;
use std::process::Command;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use caudata_telemetry::{Failure, Pulse};
use nix::sys::signal::Signal;

use super::backoff::Backoff;
use super::children::{self, LineSink, Process};
use super::start::is_permanent;

/// An actor that is to run.
pub struct Watched {
    /// In messages, for instance `actor 3`.
    name: String,
    process: Option<Process>,
    backoff: Backoff,
    /// Beats when the process says that it is alive.
    pulse: Pulse,
    /// Raised when this process has had a policy.
    joined: Arc<AtomicBool>,
    /// When it shall be started (again).
    due: Option<Instant>,
    /// How often it was started.
    starts: usize,
}

impl Watched {
    /// One that is started again at most so often.
    pub fn new(name: String, restarts_per_minute: u32) -> Self {
        Self {
            name,
            process: None,
            backoff: Backoff::new(restarts_per_minute),
            pulse: Pulse::new(),
            joined: Arc::default(),
            due: None,
            starts: 0,
        }
    }

    /// To be started now, unless it runs; also where it does with `anew`.
    pub fn call(&mut self, anew: bool) {
        if anew {
            self.process = None;
        }
        if self.process.is_none() {
            self.due = Some(Instant::now());
        }
    }

    /// Whether it is time to start it.
    pub fn is_due(&self) -> bool {
        self.due.is_some_and(|due| Instant::now() >= due)
    }

    /// Whether the process that runs now has had a policy from the learner.
    pub fn has_joined(&self) -> bool {
        self.joined.load(Ordering::Relaxed)
    }

    /// How often it was started after the first time.
    pub fn restarts(&self) -> usize {
        self.starts.saturating_sub(1)
    }

    /// Whether it neither runs nor will be started again.
    pub fn is_down(&mut self) -> bool {
        let runs = self.process.as_mut().is_some_and(|p| p.ended().is_none());
        !runs && self.due.is_none()
    }

    /// Starts an incarnation.
    pub fn start(&mut self, mut command: Command, log: &Path) -> Result<(), Failure> {
        self.due = None;
        self.starts += 1;
        self.pulse.beat();
        let pulse = self.pulse.clone();
        self.joined = Arc::default();
        let joined = Arc::clone(&self.joined);
        let sink: LineSink = Box::new(move |line| {
            pulse.beat();
            if line == caudata_actor::JOINED {
                joined.store(true, Ordering::Relaxed);
            }
        });
        command.arg("--heartbeat");
        self.process = Some(Process::start(&self.name, command, log, Some(sink))?);
        Ok(())
    }

    /// Notices at `now`, since the supervisor began, what has become of the process, and decides what
    /// follows; `tell` hears of it. Answers why it stays down, where it has died too often.
    ///
    /// # Errors
    /// Where the actor cannot work at all.
    pub fn look(
        &mut self,
        hang_timeout_s: f64,
        now: Duration,
        mut tell: impl FnMut(&str),
    ) -> Result<Option<String>, Failure> {
        let Some(process) = &mut self.process else { return Ok(None) };
        let (name, pid) = (&self.name, process.pid());
        let silent_s = self.pulse.silent_for().as_secs_f64();
        if process.ended().is_none() && silent_s > hang_timeout_s {
            tell(&format!(
                "{name} (process {pid}) has given no sign of life for {silent_s:.0} s; it is killed"
            ));
            process.finish(Duration::ZERO);
        }
        let Some(status) = process.ended().filter(|status| !status.success()) else {
            // It runs, or the learner has said stop.
            return Ok(None);
        };
        let how = children::describe(status);
        let words = status.code().and_then(|_| process.last_error());
        let reason = words.map_or(String::new(), |words| format!(": {}", words.error));
        self.process = None;
        let code = children::exit_code(status);
        if status.code().is_some() && is_permanent(code) {
            let message = format!("{name} cannot work ({how}){reason}");
            return Err(Failure::message(code, message));
        }
        match self.backoff.died(now) {
            Some(pause) => {
                self.due = Some(Instant::now() + pause);
                tell(&format!(
                    "{name} (process {pid}) {how}; it is started again in {:.2} s{reason}",
                    pause.as_secs_f64()
                ));
                Ok(None)
            }
            None => {
                let text = format!("{name} {how} too often and stays down{reason}");
                tell(&text);
                Ok(Some(text))
            }
        }
    }
}

/// Asks all to end at once, then waits at most `patience` for them together.
pub fn stop_all(actors: &mut [Watched], patience: Duration) {
    let running = || actors.iter().filter_map(|actor| actor.process.as_ref());
    running().for_each(|process| process.signal(Signal::SIGTERM));
    let deadline = Instant::now() + patience;
    for actor in actors {
        if let Some(mut process) = actor.process.take() {
            process.finish(deadline.saturating_duration_since(Instant::now()));
        }
    }
}
