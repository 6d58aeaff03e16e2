//! Starts the two halves of a robot, watches both, and makes the robot safe where the loop hangs or dies.
//!
//! | what | what the supervisor does |
//! |---|---|
//! | the agent ends or hangs | starts it again, first after half a second, then ever later; the loop goes on |
//! | the loop dies | lets the servos go, starts it again, three times at most |
//! | the loop gives no sign of life | kills it; then as above |
//! | the kill button, and the loop does not brake | kills it, lets the servos go, ends |
//! | the kill button while the loop is down | does not start it again, ends |
//! | a child does not end, not even by force | waits three seconds; lets the servos go whoever has their port, starts nothing, ends |
//! | the loop ends by itself | ends the agent, then itself, with the loop's exit code; the servos are let go where that is an error |
//! | a second signal | the loop lets go at once, or is ended; the servos are let go once more |
//! | the supervisor dies | both children are told to stop by the system: the loop stands down in order |
//!
//! What follows what is in [`machine`]; here are the processes, the clocks and the signals. It knows neither policies nor the network, and
//! waits for nobody: what it waits for has a limit.

pub mod machine;

use std::ffi::OsString;
use std::os::unix::process::CommandExt;
use std::path::PathBuf;
use std::process::{Child, Command, ExitStatus, Stdio};
use std::time::{Duration, Instant};

use caudata_telemetry::{ExitCode, Failure, PARENT_PID_VAR, StopFlag};
use machine::{Do, End, Event, Limits, Signs, State, Verdict, Why, judge, next};
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;

use crate::boundary::{LOOP_PAGE, RunFolder};
use crate::notify::{Ear, Notifier, SOCKET_VAR, Word};
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
/// How long a process may take to be gone after SIGKILL: one that is still there is held by a driver, and may be so for ever.
const UNDYING_MAX: Duration = Duration::from_secs(3);
/// How long letting go may take, asking the servos included.
const LIMP_MAX: Duration = Duration::from_secs(5);
/// How long a loop that was asked twice may take to let go by itself. With [`LIMP_MAX`], the agent's end and three times [`UNDYING_MAX`] (loop, the
/// one that lets go, agent) it must stay below [`caudata_telemetry::INSIST_DEADLINE`].
const INSIST_MAX: Duration = Duration::from_secs(2);
/// How long an agent may take to end where a person has no patience.
const AGENT_END_INSISTED: Duration = Duration::from_secs(1);
/// The loop must brake within this part of the time after which it counts as hanging, once the kill button is pressed: three ticks of
/// a real robot.
const BRAKE_SHARE: u32 = 5;
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
    /// Arguments of the command that lets the servos go, whoever has their port; `None`: this robot needs none.
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
    /// When it was ready.
    ready_at: Option<Instant>,
    stopping: bool,
    brakes: bool,
    /// When it was sent SIGKILL.
    killed_at: Option<Instant>,
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
            ready_at: None,
            stopping: false,
            brakes: false,
            killed_at: None,
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
        (self.again_at, self.ready_at, self.killed_at) = (None, None, None);
        Ok(())
    }

    /// Takes what the child said; whether it told of a kill.
    fn listen(&mut self) -> bool {
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
    fn ended(&mut self) -> Option<ExitStatus> {
        let status = self.child.as_mut()?.try_wait().ok().flatten()?;
        self.child = None;
        Some(status)
    }

    fn signal(&mut self, signal: Signal) {
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
            wait_for(self, Duration::ZERO);
        }
        let _ = std::fs::remove_file(&self.socket);
    }
}

/// Runs both halves until the loop is over. `insisted` is raised by a second signal.
///
/// # Errors
/// The failure that ends the process; a child that failed has said why itself.
pub fn supervise(plan: &Plan, stop: &StopFlag, insisted: &StopFlag) -> Result<(), Failure> {
    let mut supervisor = Supervisor::new(plan)?;
    let verdict = match supervisor.until_over(stop, insisted) {
        Err(failure) if supervisor.torque == Torque::Unproved => {
            let line = format!("{failure}; {}", Torque::Unproved.words());
            return Err(Failure::message(ExitCode::TorqueOn, line));
        }
        other => other?,
    };
    // Last words of the loop are on the disk; the agent takes them and reports.
    let patience = match verdict {
        Verdict::Interrupted => AGENT_END_INSISTED,
        _ => AGENT_END_MAX,
    };
    supervisor.agent.signal(Signal::SIGTERM);
    wait_for(&mut supervisor.agent, patience);
    supervisor.said(verdict)
}

/// What became of letting the servos go.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Torque {
    /// Nobody had to.
    Untouched,
    /// They say that it is off.
    Off,
    /// They do not.
    Unproved,
}

impl Torque {
    fn words(self) -> &'static str {
        match self {
            Self::Untouched => "no servo had been taken hold of",
            Self::Off => "the torque is off",
            Self::Unproved => "THE TORQUE MAY STILL BE ON: cut the supply, or `caudata-robot limp`",
        }
    }
}

struct Supervisor<'a> {
    plan: &'a Plan,
    state: State,
    agent: Watched,
    looper: Watched,
    /// Who watches this process.
    above: Notifier,
    agent_was_ready: bool,
    /// Starts of the loop.
    starts: u32,
    /// Whether a loop came so far that there may be torque.
    touched: bool,
    stop_seen: bool,
    insist_seen: bool,
    /// When the kill button was pressed.
    pressed_at: Option<Instant>,
    /// When the loop was asked to end, last.
    asked_at: Option<Instant>,
    torque: Torque,
    /// How a process ended last.
    status: Option<ExitStatus>,
}

impl<'a> Supervisor<'a> {
    fn new(plan: &'a Plan) -> Result<Self, Failure> {
        Ok(Self {
            plan,
            state: State::Waiting,
            agent: Watched::new("agent", &plan.folder).map_err(failure)?,
            looper: Watched::new("rt", &plan.folder).map_err(failure)?,
            above: Notifier::from_environment().map_err(failure)?,
            agent_was_ready: false,
            starts: 0,
            touched: false,
            stop_seen: false,
            insist_seen: false,
            pressed_at: None,
            asked_at: None,
            torque: Torque::Untouched,
            status: None,
        })
    }

    fn until_over(&mut self, stop: &StopFlag, insisted: &StopFlag) -> Result<Verdict, Failure> {
        loop {
            std::thread::sleep(LOOK);
            self.above.say(Word::Alive);
            self.look_at_agent()?;
            self.looper.listen();
            self.touched |= self.looper.ready;
            if stop.is_set() && !std::mem::replace(&mut self.stop_seen, true) {
                self.handle(Event::Stop)?;
            }
            if insisted.is_set() && !std::mem::replace(&mut self.insist_seen, true) {
                self.handle(Event::Insist)?;
            }
            self.look_at_loop()?;
            if let State::Over(verdict) = self.state {
                return Ok(verdict);
            }
        }
    }

    /// The robot walks on without an agent, so that it is only ever started again; but for one that never was ready.
    fn look_at_agent(&mut self) -> Result<(), Failure> {
        if self.agent.listen() && self.pressed_at.is_none() {
            self.pressed_at = Some(Instant::now());
            self.handle(Event::Kill)?;
        }
        if self.agent.ready && !std::mem::replace(&mut self.agent_was_ready, true) {
            self.above.say(Word::Ready);
            self.handle(Event::AgentReady)?;
        }
        let silent_max = match self.agent.ready {
            true => AGENT_SILENT_MAX,
            false => AGENT_START_MAX,
        };
        let hangs = self.agent.child.is_some() && self.agent.heard.elapsed() > silent_max;
        if hangs && self.agent.killed_at.is_none() {
            self.agent.signal(Signal::SIGKILL);
            tracing::error!("the agent hangs: ended");
        }
        if let Some(status) = self.agent.ended() {
            if !self.agent_was_ready {
                self.status = Some(status);
                return self.handle(Event::AgentFailed(end_of(status)));
            }
            let pause = self.agent_again();
            tracing::error!(%status, ?pause, "the agent ended; the loop goes on, the agent starts again");
        }
        if self.agent.child.is_some() && self.agent.ready && self.agent.began.elapsed() > CALM {
            self.agent.deaths = 0;
        }
        let over = matches!(self.state, State::Over(_));
        if due(&self.agent) && !self.stop_seen && !over {
            // That one cannot be started now must not end the walk.
            if let Err(error) = self.agent.start(self.plan, &[]) {
                if !self.agent_was_ready {
                    return Err(failure(error));
                }
                self.agent_again();
                tracing::error!(%error, "the agent cannot be started; the loop goes on");
            }
        }
        Ok(())
    }

    fn agent_again(&mut self) -> Duration {
        let [first, longest] = AGENT_PAUSE;
        let pause = pause(first, longest, self.agent.deaths);
        self.agent.deaths += 1;
        self.agent.again_at = Some(Instant::now() + pause);
        pause
    }

    fn look_at_loop(&mut self) -> Result<(), Failure> {
        if let Some(status) = self.looper.ended() {
            self.status = Some(status);
            // Its last words may have come after it was listened to.
            self.looper.listen();
            self.touched |= self.looper.ready;
            let _ = std::fs::remove_file(self.plan.folder.file(LOOP_PAGE));
            return self.handle(Event::LoopEnded {
                end: end_of(status),
                touched: self.touched,
                calm: self.looper.ready && self.looper.began.elapsed() > CALM,
                stopping: self.looper.stopping,
            });
        }
        if self.looper.child.is_none() {
            return match due(&self.looper) {
                true => self.handle(Event::PauseOver),
                false => Ok(()),
            };
        }
        let since = |at: Option<Instant>| at.map(|at| at.elapsed());
        let signs = Signs {
            heard: self.looper.heard.elapsed(),
            ready: since(self.looper.ready_at),
            stopping: self.looper.stopping,
            brakes: self.looper.brakes,
            pressed: since(self.pressed_at),
            asked: since(self.asked_at),
            killed: since(self.looper.killed_at),
        };
        let limits = Limits {
            start: LOOP_START_MAX,
            silent: self.plan.hang_after,
            brake: self.plan.hang_after / BRAKE_SHARE,
            stopping: STOPPING_MAX,
            stand_down: STAND_DOWN_MAX,
            insisted: INSIST_MAX,
            undying: UNDYING_MAX,
        };
        match judge(&signs, &limits, self.state, self.touched) {
            Some(event) => self.handle(event),
            None => Ok(()),
        }
    }

    fn handle(&mut self, event: Event) -> Result<(), Failure> {
        let (state, todo) = next(self.state, event);
        if let Event::LoopEnded {
            end: End::InOrder, ..
        } = event
        {
            // It has let go itself, and asked whether the servos did: what was not proved of an earlier loop is now.
            self.torque = Torque::Untouched;
        }
        // Also after the kill button the end is not waited for without limit.
        if state == State::Ending(Why::Kill) {
            self.asked_at.get_or_insert_with(Instant::now);
        }
        self.state = state;
        for todo in todo {
            match todo {
                Do::StartLoop => {
                    self.starts += 1;
                    let extra = ["--start".into(), self.starts.to_string().into()];
                    self.looper.start(self.plan, &extra).map_err(failure)?;
                }
                Do::AskLoop => {
                    self.asked_at = Some(Instant::now());
                    self.looper.signal(Signal::SIGTERM);
                }
                Do::KillLoop => {
                    // First the deed: who reads the log may be asleep.
                    self.looper.signal(Signal::SIGKILL);
                    let silent = self.looper.heard.elapsed();
                    match event {
                        Event::TooLong => tracing::error!("the loop does not stand down: ended"),
                        _ => {
                            let deaf = state == State::Ending(Why::Deaf);
                            tracing::error!(deaf, ?silent, "the loop hangs: ended");
                        }
                    }
                }
                Do::LetGo => self.torque = let_go(self.plan, false),
                Do::LetGoAnyway => self.torque = let_go(self.plan, true),
            }
        }
        if let (State::Down { deaths }, Event::LoopEnded { .. }) = (state, event) {
            let pause = pause(Duration::from_secs(1), Duration::from_secs(4), deaths - 1);
            self.looper.again_at = Some(Instant::now() + pause);
            let status = self.status.map(|status| status.to_string());
            let torque = self.torque.words();
            tracing::error!(
                status,
                ?pause,
                torque,
                "the control loop died: it starts again"
            );
        }
        Ok(())
    }

    /// The verdict in words.
    fn said(&self, verdict: Verdict) -> Result<(), Failure> {
        let torque = self.torque.words();
        let status = self.status.map_or_else(String::new, |s| s.to_string());
        let (code, line) = match verdict {
            Verdict::Done => (ExitCode::Ok, "stopped while the loop was down".to_owned()),
            Verdict::Agent(end) => passed_on(end, "the agent", &status),
            Verdict::Loop(end) => passed_on(end, "the loop", &status),
            Verdict::Undying => (
                ExitCode::OsResource,
                format!(
                    "the loop (process {}) does not end, not even by force: a driver holds it",
                    self.looper.child.as_ref().map_or(0, Child::id)
                ),
            ),
            Verdict::GivenUp { deaths } => (
                ExitCode::Internal,
                format!("the control loop died {deaths} times in a row, last by {status}"),
            ),
            Verdict::Interrupted => (
                ExitCode::Interrupted,
                "stopped at once by a second signal".to_owned(),
            ),
            Verdict::KilledBefore => (
                ExitCode::Unavailable,
                "the kill button was pressed before the loop was started; it is not started"
                    .to_owned(),
            ),
            Verdict::KilledWhileDown => (
                ExitCode::Unavailable,
                "the kill button was pressed while the loop was down; it is not started again"
                    .to_owned(),
            ),
            Verdict::KilledWhileHung => (
                ExitCode::Unavailable,
                "the loop hung when the kill button was pressed; it was ended".to_owned(),
            ),
        };
        match (code, self.torque) {
            // Whatever else it came to: nobody may take a robot that holds on for one that let go.
            (_, Torque::Unproved) => {
                let before = match line.is_empty() {
                    true => String::new(),
                    false => format!("{line}; "),
                };
                Err(Failure::message(
                    ExitCode::TorqueOn,
                    format!("{before}{torque}"),
                ))
            }
            (ExitCode::Ok, _) => Ok(()),
            (code, _) if line.is_empty() => Err(Failure::said_already(code)),
            (code, _) => Err(Failure::message(code, format!("{line}; {torque}"))),
        }
    }
}

fn due(watched: &Watched) -> bool {
    watched.child.is_none() && watched.again_at.is_some_and(|at| Instant::now() >= at)
}

fn end_of(status: ExitStatus) -> End {
    let code = status
        .code()
        .map(|code| ExitCode::from_number(code).unwrap_or(ExitCode::Internal));
    match code {
        Some(ExitCode::Ok) => End::InOrder,
        Some(code) if !died(status) => End::Wrong(code),
        code => End::Died(code),
    }
}

/// Its exit code, and what is still to be said: nothing where it said so itself.
fn passed_on(end: End, who: &str, status: &str) -> (ExitCode, String) {
    match end {
        End::InOrder => (ExitCode::Ok, String::new()),
        End::Wrong(code) | End::Died(Some(code)) => (code, String::new()),
        End::Died(None) => (ExitCode::Internal, format!("{who} was ended by {status}")),
    }
}

/// Waits for a child that was asked to end, ends it by force after `limit`, and leaves it where it is still there then.
fn wait_for(watched: &mut Watched, limit: Duration) {
    let end = Instant::now() + limit;
    while watched.child.is_some() && watched.ended().is_none() {
        match watched.killed_at {
            Some(at) if at.elapsed() > UNDYING_MAX => {
                tracing::error!(
                    part = watched.command,
                    "does not end, not even by force: left behind"
                );
                return;
            }
            None if Instant::now() >= end => {
                watched.signal(Signal::SIGKILL);
                if !limit.is_zero() {
                    tracing::error!(part = watched.command, "does not end: killed");
                }
            }
            _ => std::thread::sleep(LOOK),
        }
    }
}

/// Lets the servos go, in a process of its own: a port that hangs does not hold this one. It asks them whether they did. `anyway`: also where
/// another program has the port.
fn let_go(plan: &Plan, anyway: bool) -> Torque {
    let Some(arguments) = &plan.limp else {
        return Torque::Untouched;
    };
    let begun = Instant::now();
    let child = Command::new(&plan.program)
        .args(&plan.arguments[0])
        .arg("limp")
        .args((!anyway).then_some("--unless-taken"))
        .args(arguments)
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        .spawn();
    let mut child = match child {
        Ok(child) => child,
        Err(error) => {
            tracing::error!(%error, "cannot let the servos go");
            return Torque::Unproved;
        }
    };
    loop {
        match child.try_wait() {
            Ok(Some(status)) if status.success() => {
                tracing::warn!(took = ?begun.elapsed(), "the servos were let go");
                return Torque::Off;
            }
            Ok(None) if begun.elapsed() < LIMP_MAX => std::thread::sleep(LOOK),
            other => {
                let _ = child.kill();
                reap(&mut child);
                tracing::error!(
                    ?other,
                    "nobody knows whether the servos were let go; their own watchdogs hold them"
                );
                return Torque::Unproved;
            }
        }
    }
}

/// Takes note of a child's end that must come now; one that does not end is left behind.
fn reap(child: &mut Child) {
    let begun = Instant::now();
    while matches!(child.try_wait(), Ok(None)) && begun.elapsed() < UNDYING_MAX {
        std::thread::sleep(LOOK);
    }
}

#[cfg(test)]
mod tests {
    use std::os::unix::process::ExitStatusExt;

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
    fn pauses_double_up_to_the_longest() {
        let [first, longest] = AGENT_PAUSE;
        let all: Vec<u128> = (0..8)
            .map(|n| pause(first, longest, n).as_millis())
            .collect();
        assert_eq!(all, [500, 1000, 2000, 4000, 8000, 16_000, 30_000, 30_000]);
        assert_eq!(pause(first, longest, u32::MAX), longest);
    }
}
