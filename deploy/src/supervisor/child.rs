//! One child process of the supervisor: started, listened to, ended.

use std::ffi::OsString;
use std::os::unix::process::{CommandExt, ExitStatusExt};
use std::path::PathBuf;
use std::process::{Child, Command, ExitStatus, Stdio};
use std::time::{Duration, Instant};

use caudata_telemetry::{ExitCode, PARENT_PID_VAR};
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;

use super::machine::End;
use crate::DeployError;
use crate::boundary::RunFolder;
use crate::notify::{Ear, SOCKET_VAR};

/// How often everything is looked at.
pub(super) const WATCH_LOOK: Duration = Duration::from_millis(10);
/// How long a process may take to be gone after SIGKILL: one that is still there is held by a driver, and may
/// be so for ever.
pub(super) const UNDYING_MAX: Duration = Duration::from_secs(3);

/// What to run.
#[derive(Clone, Debug)]
pub struct Plan {
    /// This program.
    pub program: PathBuf,
    /// Arguments before and after the name of the command.
    pub arguments: [Vec<OsString>; 2],
    /// Arguments of the command that lets the servos go, whoever has their port; `None`: this robot needs
    /// none.
    pub limp: Option<Vec<OsString>>,
    /// A loop without a sign of life for this long hangs.
    pub hang_after: Duration,
    /// Where sockets are.
    pub folder: RunFolder,
}

/// Whether a process that ended like this is worth another try: what a person or another file must set right
/// is not.
pub fn died(status: ExitStatus) -> bool {
    let again = [
        ExitCode::Internal,
        ExitCode::OsResource,
        ExitCode::IoError,
        ExitCode::TempFail,
        ExitCode::Interrupted,
    ];
    match status.code() {
        None => true,
        Some(code) => ExitCode::from_number(code).is_none_or(|code| again.contains(&code)),
    }
}

pub(super) fn end_of(status: ExitStatus) -> End {
    let code = status.code().map(|code| ExitCode::from_number(code).unwrap_or(ExitCode::Internal));
    match code {
        Some(ExitCode::Ok) => End::InOrder,
        Some(code) if !died(status) => End::Wrong(code),
        code => End::Died(code),
    }
}

/// The same of a loop that was asked to stop. One that has not come so far that it listens is ended by the very
/// signal that asks it: before anything was touched that is an end in order.
pub(super) fn end_of_asked(status: ExitStatus, touched: bool) -> End {
    let asking = [Signal::SIGTERM as i32, Signal::SIGINT as i32];
    match status.signal() {
        Some(signal) if !touched && asking.contains(&signal) => End::InOrder,
        _ => end_of(status),
    }
}

/// Pauses that double from `first` to `longest`.
pub fn pause(first: Duration, longest: Duration, tries: u32) -> Duration {
    (first * 2_u32.saturating_pow(tries.min(16))).min(longest)
}

/// One child, and what was heard of it.
pub(super) struct Watched {
    pub(super) command: &'static str,
    ear: Ear,
    socket: PathBuf,
    pub(super) child: Option<Child>,
    pub(super) began: Instant,
    pub(super) heard: Instant,
    pub(super) ready: bool,
    /// When it was ready.
    pub(super) ready_at: Option<Instant>,
    pub(super) stopping: bool,
    pub(super) brakes: bool,
    /// When it was sent SIGKILL.
    pub(super) killed_at: Option<Instant>,
    /// Starts that ended by themselves, in a row.
    pub(super) deaths: u32,
    pub(super) again_at: Option<Instant>,
}

impl Watched {
    pub(super) fn new(command: &'static str, folder: &RunFolder) -> Result<Self, DeployError> {
        let socket = folder.file(&format!("notify-{command}"));
        let ear = Ear::open(&socket).map_err(DeployError::folder(&socket))?;
        let now = Instant::now();
        Ok(Self {
            command,
            ear,
            socket,
            child: None,
            began: now,
            heard: now,
            ready: false,
            ready_at: None,
            stopping: false,
            brakes: false,
            killed_at: None,
            deaths: 0,
            again_at: Some(now),
        })
    }

    pub(super) fn start(&mut self, plan: &Plan, extra: &[OsString]) -> Result<(), DeployError> {
        let [before, after] = &plan.arguments;
        // What an earlier start said does not count for this one.
        self.ear.listen();
        let child = Command::new(&plan.program)
            .args(before)
            .arg(self.command)
            .args(after)
            .args(extra)
            .env(PARENT_PID_VAR, std::process::id().to_string())
            .env(SOCKET_VAR, &self.socket)
            .stdin(Stdio::null())
            // Ctrl-C reaches the supervisor alone, which then stops the children in order.
            .process_group(0)
            .spawn()
            .map_err(DeployError::system("a child process"))?;
        tracing::info!(part = self.command, pid = child.id(), "started");
        let now = Instant::now();
        self.child = Some(child);
        (self.began, self.heard) = (now, now);
        (self.ready, self.stopping, self.brakes) = (false, false, false);
        (self.again_at, self.ready_at, self.killed_at) = (None, None, None);
        Ok(())
    }

    /// Takes what the child said; whether it told of a kill.
    pub(super) fn listen(&mut self) -> bool {
        let heard = self.ear.listen();
        if heard.alive {
            self.heard = Instant::now();
        }
        self.ready |= heard.ready;
        if self.ready {
            self.ready_at.get_or_insert_with(Instant::now);
        }
        self.stopping |= heard.stopping;
        self.brakes |= heard.brakes;
        heard.kill
    }

    /// How it ended, if it just has.
    pub(super) fn ended(&mut self) -> Option<ExitStatus> {
        let status = self.child.as_mut()?.try_wait().ok().flatten()?;
        self.child = None;
        Some(status)
    }

    /// Whether it is down and its pause is over.
    pub(super) fn is_due(&self) -> bool {
        self.child.is_none() && self.again_at.is_some_and(|at| Instant::now() >= at)
    }

    /// Waits for one that was asked to end, ends it by force after `limit`, and leaves it where it is still
    /// there then.
    pub(super) fn wait(&mut self, limit: Duration) {
        let end = Instant::now() + limit;
        while self.child.is_some() && self.ended().is_none() {
            match self.killed_at {
                Some(at) if at.elapsed() > UNDYING_MAX => {
                    tracing::error!(
                        part = self.command,
                        "does not end, not even by force: left behind"
                    );
                    return;
                }
                None if Instant::now() >= end => {
                    self.signal(Signal::SIGKILL);
                    if !limit.is_zero() {
                        tracing::error!(part = self.command, "does not end: killed");
                    }
                }
                _ => std::thread::sleep(WATCH_LOOK),
            }
        }
    }

    pub(super) fn signal(&mut self, signal: Signal) {
        if signal == Signal::SIGKILL {
            self.killed_at.get_or_insert_with(Instant::now);
        }
        if let Some(child) = &self.child {
            let _ = kill(Pid::from_raw(child.id() as i32), signal);
        }
    }
}

impl Drop for Watched {
    fn drop(&mut self) {
        // No child outlives an error here, as far as it can be ended at all.
        if self.child.is_some() {
            self.wait(Duration::ZERO);
        }
        let _ = std::fs::remove_file(&self.socket);
    }
}

/// Takes note of a child's end that must come now; one that does not end is left behind.
pub(super) fn reap(child: &mut Child) {
    let begun = Instant::now();
    while matches!(child.try_wait(), Ok(None)) && begun.elapsed() < UNDYING_MAX {
        std::thread::sleep(WATCH_LOOK);
    }
}

#[cfg(test)]
mod tests {

    use super::*;

    #[test]
    fn what_a_person_must_set_right_is_not_tried_again() {
        let by_code = |code: i32| died(ExitStatus::from_raw(code << 8));
        for code in [0, 64, 65, 66, 69, 73, 76, 77, 79, 86] {
            assert!(!by_code(code), "{code}");
        }
        for code in [1, 70, 71, 74, 75, 101, 130] {
            assert!(by_code(code), "{code}");
        }
        // SIGKILL, SIGSEGV, SIGABRT.
        for signal in [9, 11, 6] {
            assert!(died(ExitStatus::from_raw(signal)), "{signal}");
        }
    }

    #[test]
    fn a_loop_that_is_asked_to_stop_before_it_listens_ends_in_order() {
        let end = |signal, touched| end_of_asked(ExitStatus::from_raw(signal), touched);
        assert_eq!([end(15, false), end(2, false)], [End::InOrder; 2]);
        assert_eq!([end(15, true), end(9, false)], [End::Died(None); 2]);
    }

    #[test]
    fn pauses_double_up_to_the_longest() {
        let [first, longest] = [500, 30_000].map(Duration::from_millis);
        let all: Vec<u128> = (0..8).map(|n| pause(first, longest, n).as_millis()).collect();
        assert_eq!(all, [500, 1000, 2000, 4000, 8000, 16_000, 30_000, 30_000]);
        assert_eq!(pause(first, longest, u32::MAX), longest);
    }
}
