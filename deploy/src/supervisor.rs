//! Starts the two halves of a robot, watches both, and makes the robot safe where the loop hangs or dies.
//!
//! | what | what the supervisor does |
//! |---|---|
//! | the agent ends or hangs | starts it again, first after half a second, then ever later; the loop goes on |
//! | the loop dies | lets the servos go, starts it again, three times at most |
//! | the loop gives no sign of life | kills it; then as above |
//! | the kill button, and the loop does not brake | kills it, lets the servos go, ends |
//! | the kill button while the loop is down | does not start it again, ends |
//! | the loop ends by itself | ends the agent, then itself, with the loop's exit code |
//! | the supervisor dies | both children are told to stop by the system: the loop stands down in order |
//!
//! It knows neither policies nor the network, and waits for nobody: what it waits for has a limit.

use std::ffi::OsString;
use std::os::unix::process::{CommandExt, ExitStatusExt};
use std::path::PathBuf;
use std::process::{Child, Command, ExitStatus, Stdio};
use std::time::{Duration, Instant};

use caudata_telemetry::{ExitCode, Failure, PARENT_PID_VAR, StopFlag};
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;

use crate::boundary::RunFolder;
use crate::notify::{ALIVE, Ear, Notifier, READY, SOCKET_VAR};
use crate::{DeployError, failure};

/// How often everything is looked at.
const LOOK: Duration = Duration::from_millis(10);
/// How long the loop may take to begin: it waits up to a minute for an agent.
const LOOP_START_MAX: Duration = Duration::from_secs(120);
/// The same of the agent, which may be fetching a policy over a poor network for ten minutes.
const AGENT_START_MAX: Duration = Duration::from_secs(900);
/// An agent that is silent for this long hangs. It waits for disks.
const AGENT_SILENT_MAX: Duration = Duration::from_secs(60);
/// How long tidying up may take.
const STOPPING_MAX: Duration = Duration::from_secs(30);
/// How long a robot may take to stand down when asked.
const STAND_DOWN_MAX: Duration = Duration::from_secs(50);
/// How long an agent may take to end when asked: its last reports take two seconds.
const AGENT_END_MAX: Duration = Duration::from_secs(10);
/// How long letting go may take.
const LIMP_MAX: Duration = Duration::from_secs(2);
/// The loop must brake within this part of the time after which it counts as hanging, once the kill button is pressed: three ticks of
/// a real robot.
const BRAKE_SHARE: u32 = 5;
/// How often a loop that died is started again.
pub const RESTARTS_MAX: u32 = 3;
/// A loop that ran for this long begins to count anew.
const CALM: Duration = Duration::from_secs(300);
/// First and longest pause before the agent is started again.
const AGENT_PAUSE: [Duration; 2] = [Duration::from_millis(500), Duration::from_secs(30)];

/// What to run.
#[derive(Clone, Debug)]
pub struct Plan {
    /// This program.
    pub program: PathBuf,
    /// Arguments before and after the name of the command.
    pub arguments: [Vec<OsString>; 2],
    /// Arguments of the command that lets the servos go; `None`: this robot needs none.
    pub limp: Option<Vec<OsString>>,
    /// A loop without a sign of life for this long hangs.
    pub hang_after: Duration,
    /// Where sockets are.
    pub folder: RunFolder,
}

/// Whether a process that ended like this is worth another try: what a person or another file must set right is not.
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

/// Pauses that double from `first` to `longest`.
pub fn pause(first: Duration, longest: Duration, tries: u32) -> Duration {
    (first * 2_u32.saturating_pow(tries.min(16))).min(longest)
}

/// One child, and what was heard of it.
struct Watched {
    command: &'static str,
    ear: Ear,
    socket: PathBuf,
    child: Option<Child>,
    began: Instant,
    heard: Instant,
    ready: bool,
    stopping: bool,
    brakes: bool,
    /// Starts that ended by themselves, in a row.
    deaths: u32,
    again_at: Option<Instant>,
}

impl Watched {
    fn new(command: &'static str, folder: &RunFolder) -> Result<Self, DeployError> {
        let socket = folder.file(&format!("notify-{command}"));
        let ear = Ear::open(&socket).map_err(|source| DeployError::Folder {
            path: socket.clone(),
            source,
        })?;
        let now = Instant::now();
        Ok(Self {
            command,
            ear,
            socket,
            child: None,
            began: now,
            heard: now,
            ready: false,
            stopping: false,
            brakes: false,
            deaths: 0,
            again_at: Some(now),
        })
    }

    fn start(&mut self, plan: &Plan, extra: &[OsString]) -> Result<(), DeployError> {
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
            .map_err(|source| DeployError::System {
                what: "a child process",
                source,
            })?;
        tracing::info!(part = self.command, pid = child.id(), "started");
        let now = Instant::now();
        self.child = Some(child);
        (self.began, self.heard) = (now, now);
        (self.ready, self.stopping, self.brakes) = (false, false, false);
        self.again_at = None;
        Ok(())
    }

    /// Takes what the child said; whether it told of a kill.
    fn listen(&mut self) -> bool {
        let heard = self.ear.listen();
        if heard.alive {
            self.heard = Instant::now();
        }
        self.ready |= heard.ready;
        self.stopping |= heard.stopping;
        self.brakes |= heard.brakes;
        heard.kill
    }

    /// Whether it hangs: silent for longer than it may be in its present state.
    fn hangs(&self, start_max: Duration, silent_max: Duration) -> bool {
        let limit = match (self.ready, self.stopping) {
            (_, true) => STOPPING_MAX,
            (true, false) => silent_max,
            (false, false) => start_max,
        };
        self.child.is_some() && self.heard.elapsed() > limit
    }

    /// How it ended, if it just has.
    fn ended(&mut self) -> Option<ExitStatus> {
        let status = self.child.as_mut()?.try_wait().ok().flatten()?;
        self.child = None;
        Some(status)
    }

    fn signal(&self, signal: Signal) {
        if let Some(child) = &self.child {
            let _ = kill(Pid::from_raw(child.id() as i32), signal);
        }
    }
}

impl Drop for Watched {
    fn drop(&mut self) {
        // No child outlives an error here.
        if let Some(mut child) = self.child.take() {
            let _ = child.kill();
            let _ = child.wait();
        }
        let _ = std::fs::remove_file(&self.socket);
    }
}

/// Runs both halves until the loop is over.
///
/// # Errors
/// The failure that ends the process; a child that failed has said why itself.
pub fn supervise(plan: &Plan, stop: &StopFlag) -> Result<(), Failure> {
    let mut agent = Watched::new("agent", &plan.folder).map_err(failure)?;
    let mut looper = Watched::new("rt", &plan.folder).map_err(failure)?;
    let above = Notifier::from_environment();
    let (mut starts, mut killed_at, mut stop_at) = (0_u32, None, None);
    let (mut agent_was_ready, mut hung_on_kill) = (false, false);
    let result = loop {
        std::thread::sleep(LOOK);
        if agent.listen() {
            killed_at.get_or_insert_with(Instant::now);
        }
        looper.listen();
        above.say(ALIVE);
        if agent.ready && !agent_was_ready {
            agent_was_ready = true;
            above.say(READY);
        }

        if stop.is_set() && stop_at.is_none() {
            stop_at = Some(Instant::now());
            looper.signal(Signal::SIGTERM);
        }
        if stop_at.is_some() && looper.child.is_none() {
            break Ok(());
        }

        if agent.hangs(AGENT_START_MAX, AGENT_SILENT_MAX) {
            agent.signal(Signal::SIGKILL);
            tracing::error!("the agent hangs: ended");
        }
        if let Some(status) = agent.ended() {
            if !agent_was_ready {
                break passed_on(status, "the agent");
            }
            let [first, longest] = AGENT_PAUSE;
            let pause = pause(first, longest, agent.deaths);
            tracing::error!(%status, ?pause, "the agent ended; the loop goes on, the agent starts again");
            agent.deaths += 1;
            agent.again_at = Some(Instant::now() + pause);
        }
        if agent.child.is_some() && agent.ready && agent.began.elapsed() > CALM {
            agent.deaths = 0;
        }
        if due(&agent) && stop_at.is_none() {
            // The robot walks on without an agent: that one cannot be started now must not end it.
            if let Err(error) = agent.start(plan, &[]) {
                if !agent_was_ready {
                    break Err(failure(error));
                }
                let [first, longest] = AGENT_PAUSE;
                agent.again_at = Some(Instant::now() + pause(first, longest, agent.deaths));
                agent.deaths += 1;
                tracing::error!(%error, "the agent cannot be started; the loop goes on");
            }
        }

        if killed_at.is_some() && looper.child.is_none() && starts > 0 {
            let line =
                "the kill button was pressed while the loop was down; it is not started again";
            break Err(Failure::message(ExitCode::Unavailable, line));
        }
        if due(&looper) && agent_was_ready && stop_at.is_none() {
            starts += 1;
            let extra = ["--start".into(), starts.to_string().into()];
            looper.start(plan, &extra).map_err(failure)?;
        }
        let late = |since: Option<Instant>, limit| since.is_some_and(|at| at.elapsed() > limit);
        let deaf = looper.ready && !looper.brakes && late(killed_at, plan.hang_after / BRAKE_SHARE);
        if looper.child.is_some() && (deaf || looper.hangs(LOOP_START_MAX, plan.hang_after)) {
            // First the deed: who reads the log may be asleep.
            looper.signal(Signal::SIGKILL);
            hung_on_kill |= deaf;
            tracing::error!(deaf, silent = ?looper.heard.elapsed(), "the loop hangs: ended");
        }
        if looper.child.is_some() && late(stop_at, STAND_DOWN_MAX) {
            looper.signal(Signal::SIGKILL);
            tracing::error!("the loop does not stand down: ended");
        }
        let Some(status) = looper.ended() else {
            continue;
        };
        if !died(status) {
            break passed_on(status, "the loop");
        }
        limp(plan);
        if hung_on_kill {
            let line =
                "the loop hung when the kill button was pressed; it was ended, the torque is off";
            break Err(Failure::message(ExitCode::Unavailable, line));
        }
        if killed_at.is_some() || stop_at.is_some() {
            break passed_on(status, "the loop");
        }
        if looper.ready && looper.began.elapsed() > CALM {
            looper.deaths = 0;
        }
        looper.deaths += 1;
        if looper.deaths > RESTARTS_MAX {
            let line = format!(
                "the control loop died {} times in a row, last by {status}; the torque is off",
                looper.deaths
            );
            break Err(Failure::message(ExitCode::Internal, line));
        }
        let pause = pause(
            Duration::from_secs(1),
            Duration::from_secs(4),
            looper.deaths - 1,
        );
        tracing::error!(%status, ?pause, "the control loop died: the torque is off, it starts again");
        looper.again_at = Some(Instant::now() + pause);
    };
    // Last words of the loop are on the disk; the agent takes them and reports.
    agent.signal(Signal::SIGTERM);
    wait_for(&mut agent, AGENT_END_MAX);
    result
}

fn due(watched: &Watched) -> bool {
    watched.again_at.is_some_and(|at| Instant::now() >= at)
}

fn passed_on(status: ExitStatus, who: &str) -> Result<(), Failure> {
    match status.code() {
        Some(0) => Ok(()),
        Some(code) => {
            let code = ExitCode::from_number(code).unwrap_or(ExitCode::Internal);
            Err(Failure::said_already(code))
        }
        None => {
            let signal = status.signal().unwrap_or_default();
            let line = format!("{who} was ended by signal {signal}");
            Err(Failure::message(ExitCode::Internal, line))
        }
    }
}

fn wait_for(watched: &mut Watched, limit: Duration) {
    let end = Instant::now() + limit;
    while watched.child.is_some() && watched.ended().is_none() {
        if Instant::now() > end {
            tracing::error!(part = watched.command, "does not end: killed");
            watched.signal(Signal::SIGKILL);
        }
        std::thread::sleep(LOOK);
    }
}

/// Lets the servos go, in a process of its own: a port that hangs does not hold this one.
fn limp(plan: &Plan) {
    let Some(arguments) = &plan.limp else {
        return;
    };
    let begun = Instant::now();
    let child = Command::new(&plan.program)
        .args(&plan.arguments[0])
        .arg("limp")
        .args(arguments)
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        .spawn();
    let mut child = match child {
        Ok(child) => child,
        Err(error) => return tracing::error!(%error, "cannot let the servos go"),
    };
    loop {
        match child.try_wait() {
            Ok(Some(status)) if status.success() => {
                tracing::warn!(took = ?begun.elapsed(), "the servos were let go");
                return;
            }
            Ok(None) if begun.elapsed() < LIMP_MAX => std::thread::sleep(LOOK),
            other => {
                let _ = child.kill();
                let _ = child.wait();
                return tracing::error!(
                    ?other,
                    "the servos were not let go; their own watchdogs hold them"
                );
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_a_person_must_set_right_is_not_tried_again() {
        let by_code = |code: i32| died(ExitStatus::from_raw(code << 8));
        for code in [0, 64, 65, 66, 69, 73, 76, 77, 79] {
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
    fn pauses_double_up_to_the_longest() {
        let [first, longest] = AGENT_PAUSE;
        let all: Vec<u128> = (0..8)
            .map(|n| pause(first, longest, n).as_millis())
            .collect();
        assert_eq!(all, [500, 1000, 2000, 4000, 8000, 16_000, 30_000, 30_000]);
        assert_eq!(pause(first, longest, u32::MAX), longest);
    }
}
