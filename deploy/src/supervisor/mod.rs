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
//! What follows what is in [`machine`]; here are the processes, the clocks and the signals. It knows neither
//! policies nor the network, and waits for nobody: what it waits for has a limit.

mod child;
pub mod machine;

use std::process::{Child, Command, ExitStatus, Stdio};
use std::time::{Duration, Instant};

use caudata_telemetry::{ExitCode, Failure, StopFlag};
pub use child::{Plan, died};
use child::{UNDYING_MAX, WATCH_LOOK, Watched, end_of, end_of_asked, pause, reap};
use machine::{Do, End, Event, Limits, Signs, State, Verdict, Why, judge, next};
use nix::sys::signal::Signal;

use crate::boundary::LOOP_PAGE;
use crate::failure;
use crate::notify::{Notifier, Word};

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
/// How long letting go may take, asking the servos included.
const LIMP_MAX: Duration = Duration::from_secs(5);
/// How long a loop that was asked twice may take to let go by itself. With [`LIMP_MAX`], the agent's end and
/// three times [`UNDYING_MAX`] (loop, the one that lets go, agent) it must stay below
/// [`caudata_telemetry::INSIST_DEADLINE`].
const INSIST_MAX: Duration = Duration::from_secs(2);
/// How long an agent may take to end where a person has no patience.
const AGENT_END_INSISTED: Duration = Duration::from_secs(1);
/// The loop must brake within this part of the time after which it counts as hanging, once the kill button is
/// pressed: three ticks of a real robot.
const BRAKE_SHARE: u32 = 5;
/// A loop that ran for this long begins to count anew.
const CALM: Duration = Duration::from_secs(300);
/// First and longest pause before the agent is started again.
const AGENT_PAUSE: [Duration; 2] = [Duration::from_millis(500), Duration::from_secs(30)];

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
    supervisor.agent.wait(patience);
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
            std::thread::sleep(WATCH_LOOK);
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

    /// The robot walks on without an agent, so that it is only ever started again; but for one that never was
    /// ready.
    fn look_at_agent(&mut self) -> Result<(), Failure> {
        if self.agent.listen() && self.pressed_at.is_none() {
            self.pressed_at = Some(Instant::now());
            self.handle(Event::Kill)?;
        }
        if self.agent.ready && !std::mem::replace(&mut self.agent_was_ready, true) {
            self.above.say(Word::Ready);
            self.handle(Event::AgentReady)?;
        }
        let silent_max = if self.agent.ready { AGENT_SILENT_MAX } else { AGENT_START_MAX };
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
        if self.agent.is_due() && !self.stop_seen && !over {
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
                end: match self.asked_at {
                    Some(_) => end_of_asked(status, self.touched),
                    None => end_of(status),
                },
                touched: self.touched,
                calm: self.looper.ready && self.looper.began.elapsed() > CALM,
                stopping: self.looper.stopping,
            });
        }
        if self.looper.child.is_none() {
            return if self.looper.is_due() { self.handle(Event::PauseOver) } else { Ok(()) };
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
        let event = judge(&signs, &limits, self.state, self.touched);
        event.map_or(Ok(()), |event| self.handle(event))
    }

    fn handle(&mut self, event: Event) -> Result<(), Failure> {
        let (state, todo) = next(self.state, event);
        if let Event::LoopEnded { end: End::InOrder, .. } = event {
            // It has let go itself, and asked whether the servos did: what was not proved of an earlier loop
            // is now.
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
            tracing::error!(status, ?pause, torque, "the control loop died: it starts again");
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
            Verdict::Interrupted => {
                (ExitCode::Interrupted, "stopped at once by a second signal".to_owned())
            }
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
                let before = if line.is_empty() { String::new() } else { format!("{line}; ") };
                Err(Failure::message(ExitCode::TorqueOn, format!("{before}{torque}")))
            }
            (ExitCode::Ok, _) => Ok(()),
            (code, _) if line.is_empty() => Err(Failure::said_already(code)),
            (code, _) => Err(Failure::message(code, format!("{line}; {torque}"))),
        }
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

/// Lets the servos go, in a process of its own: a port that hangs does not hold this one. It asks them
/// whether they did. `anyway`: also where another program has the port.
fn let_go(plan: &Plan, anyway: bool) -> Torque {
    let Some(arguments) = &plan.limp else { return Torque::Untouched };
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
            Ok(None) if begun.elapsed() < LIMP_MAX => std::thread::sleep(WATCH_LOOK),
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
