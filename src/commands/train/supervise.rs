//! Starting, watching and stopping the processes of a run.

use std::net::SocketAddr;
use std::process::Command;
use std::time::{Duration, Instant};

use caudata_actor::LedgerCount;
use caudata_config::Config;
use caudata_telemetry::progress::{Event, Finished};
use caudata_telemetry::{ExitCode, Failure, FailureExt, Listening, Pulse, StopFlag};
use crossbeam_channel::{Receiver, RecvTimeoutError, Sender, bounded};
use nix::sys::signal::Signal;

use super::Resume;
use super::backoff::{Backoff, Verdict};
use super::children::{self, LineSink, Process, Programs};
use super::folder::RunFolder;
use super::ranks::Ranks;
use super::view::View;

/// Lines of the learner that may wait to be shown; then the learner waits.
const LINES_WAITING_MAX: usize = 256;
/// How long the loop sleeps at most between two looks at the children.
const LOOK_EVERY: Duration = Duration::from_millis(100);
/// How long the policy server may take to start.
const SERVER_START_MAX: Duration = Duration::from_secs(15);
/// How long the learner may take to finish its iteration, save, and say goodbye. Shorter than the deadline of the
/// supervisor itself, so that it is the supervisor who tells.
const LEARNER_STOP_MAX: Duration = Duration::from_secs(45);
/// How long other children may take to stop.
const CHILD_STOP_MAX: Duration = Duration::from_secs(5);
/// Restarts of the learner per minute, where it is restarted at all.
const LEARNER_RESTARTS_PER_MINUTE: u32 = 5;
/// Restarts of the policy server per minute.
const SERVER_RESTARTS_PER_MINUTE: u32 = 5;

/// What is started, and what is started again.
#[derive(Clone, Debug)]
pub struct Plan {
    /// Where the learner begins.
    pub resume: Resume,
    /// Actors on this host, numbered from 0.
    pub actors: u32,
    /// Whether a learner that died goes on from its newest checkpoint while the actors wait, instead of ending the run.
    pub restart_learner: bool,
}

/// The processes of a run.
pub struct Supervisor<'a> {
    programs: &'a Programs,
    config: &'a Config,
    folder: &'a RunFolder,
    stop: &'a StopFlag,
    view: View,
    began: Instant,
    server: Process,
    server_addr: SocketAddr,
    server_backoff: Backoff,
    plan: Plan,
    learner: Process,
    learner_backoff: Backoff,
    ranks: Ranks<'a>,
    lines: Receiver<String>,
    progress: std::fs::File,
    actors: Vec<ActorSlot>,
    /// Endpoint for actors, once the learner has said it.
    transport: Option<String>,
    /// By actor, the first incarnation that the learner listens to.
    next_incarnations: Vec<u64>,
    /// Iterations that were done before.
    first_iteration: u64,
    finished: Option<Finished>,
    /// What ended the run early.
    fatal: Option<Failure>,
    /// When the learner was asked to stop.
    stopping_since: Option<Instant>,
}

/// One actor over all its incarnations.
struct ActorSlot {
    id: u32,
    process: Option<Process>,
    backoff: Backoff,
    /// Beats when the process says that it is alive.
    pulse: Pulse,
    /// When it shall be started (again).
    due: Option<Instant>,
    /// Incarnations started by this supervisor.
    started: Vec<u64>,
}

/// How a run went.
pub struct Outcome {
    /// The learner's last word.
    pub finished: Finished,
    /// Iterations of the run that were done before.
    pub first_iteration: u64,
    /// What the actors counted themselves.
    pub ledgers: Vec<LedgerCount>,
    /// Actors that were started again.
    pub restarts: usize,
    /// The policy server, still running.
    pub server: Process,
    /// Where it listens.
    pub server_addr: SocketAddr,
}

impl<'a> Supervisor<'a> {
    /// Starts the policy server and the learner.
    pub fn start(
        programs: &'a Programs,
        config: &'a Config,
        folder: &'a RunFolder,
        stop: &'a StopFlag,
        view: View,
        plan: Plan,
    ) -> Result<Self, Failure> {
        let progress = std::fs::OpenOptions::new()
            .create(true)
            .append(true)
            .open(folder.progress())
            .or_exit_with(ExitCode::CannotCreate, || "cannot write progress.jsonl")?;
        let (server, server_addr) =
            start_server(programs, config, folder, config.policy_server.addr)?;
        let (sender, lines) = bounded(LINES_WAITING_MAX);
        let learner = start_learner(programs, config, folder, server_addr, &plan.resume, sender)?;
        let ranks = Ranks::start(programs, config, folder)?;
        let actors = (0..plan.actors)
            .map(|id| ActorSlot {
                id,
                process: None,
                backoff: Backoff::new(config.actors.restarts_per_minute),
                pulse: Pulse::new(),
                due: None,
                started: Vec::new(),
            })
            .collect();
        Ok(Self {
            programs,
            config,
            folder,
            stop,
            view,
            began: Instant::now(),
            server,
            server_addr,
            server_backoff: Backoff::new(SERVER_RESTARTS_PER_MINUTE),
            plan,
            learner,
            learner_backoff: Backoff::new(LEARNER_RESTARTS_PER_MINUTE),
            ranks,
            lines,
            progress,
            actors,
            transport: None,
            next_incarnations: Vec::new(),
            first_iteration: 0,
            finished: None,
            fatal: None,
            stopping_since: None,
        })
    }

    /// Watches until the learner has ended, then stops the actors. The policy server stays up for the evaluation.
    pub fn watch(mut self) -> Result<Outcome, Failure> {
        while self.learner.ended().is_none() || self.restart_learner() {
            // Whatever fails here ends the run in good order: the learner saves, the transport is cleaned up.
            self.take_lines(LOOK_EVERY);
            let watched = self.watch_actors().and_then(|()| self.watch_server());
            let watched = watched.and_then(|()| self.watch_ranks());
            if let Err(failure) = watched {
                self.end_early(failure);
            }
            self.pass_stop_on();
        }
        self.take_lines(Duration::ZERO);
        self.view.done();
        self.stop_actors();
        self.ranks.finish(CHILD_STOP_MAX);
        let status = self.learner.ended();
        if !status.is_some_and(|status| status.success()) {
            self.clean_up_transport();
        }
        if let Some(fatal) = self.fatal {
            return Err(fatal);
        }
        let clean = status.is_some_and(|status| status.success());
        let Some(finished) = self.finished.filter(|_| clean) else {
            let (code, how) = match status {
                Some(status) if !status.success() => {
                    (children::exit_code(status), children::describe(status))
                }
                _ => (ExitCode::Internal, "ended without a last word".into()),
            };
            let failure = failed_child(&self.learner, code, &how);
            let killed = status.is_some_and(|status| status.code().is_none());
            return Err(match killed {
                true if self.plan.restart_learner => {
                    failure.hint("the same command goes on from its last checkpoint")
                }
                true => failure.hint(format!(
                    "go on from its last checkpoint with: caudata train --resume --out {}",
                    self.folder.root().display()
                )),
                false => failure,
            });
        };
        let restarts = self
            .actors
            .iter()
            .map(|actor| actor.started.len().saturating_sub(1))
            .sum();
        // Of the whole run, as the learner's account is.
        let ledgers = caudata_actor::ledgers_in(&self.folder.ledgers());
        let (server, server_addr) = (self.server, self.server_addr);
        Ok(Outcome {
            finished,
            first_iteration: self.first_iteration,
            ledgers,
            restarts,
            server,
            server_addr,
        })
    }

    /// Starts a learner that died again, if that is the plan and may help; true when one runs.
    fn restart_learner(&mut self) -> bool {
        let ending = self.stopping_since.is_some() || self.fatal.is_some() || self.stop.is_set();
        let Some(status) = self.learner.ended() else {
            return true;
        };
        let code = status.code().and_then(ExitCode::from_number);
        let hopeless = status.success()
            || code.is_some_and(|code| is_permanent(code) || code == ExitCode::CheckpointDamaged);
        if !self.plan.restart_learner || ending || hopeless {
            return false;
        }
        self.take_lines(Duration::ZERO);
        let how = children::describe(status);
        let Verdict::RestartAfter(pause) = self.learner_backoff.died(self.began.elapsed()) else {
            return false;
        };
        self.view.warn(&format!(
            "the learner {how}; it goes on from its newest checkpoint in {:.2} s",
            pause.as_secs_f64()
        ));
        self.clean_up_transport();
        if self.stop.wait(pause) {
            return false;
        }
        let (sender, lines) = bounded(LINES_WAITING_MAX);
        let started = start_learner(
            self.programs,
            self.config,
            self.folder,
            self.server_addr,
            &Resume::Latest,
            sender,
        );
        let started = started.and_then(|learner| self.ranks.start_anew().map(|()| learner));
        match started {
            Ok(learner) => {
                (self.learner, self.lines) = (learner, lines);
                true
            }
            Err(failure) => {
                self.end_early(failure);
                false
            }
        }
    }

    /// Shows and keeps what the learner has said, waiting at most `patience` for the first line.
    fn take_lines(&mut self, patience: Duration) {
        let mut line = match self.lines.recv_timeout(patience) {
            Ok(line) => Some(line),
            Err(RecvTimeoutError::Timeout) => None,
            Err(RecvTimeoutError::Disconnected) => {
                // It has closed its standard output and is about to end.
                std::thread::sleep(patience);
                None
            }
        };
        while let Some(text) = line {
            self.take_line(&text);
            line = self.lines.try_recv().ok();
        }
    }

    fn take_line(&mut self, line: &str) {
        let Ok(event) = serde_json::from_str::<Event>(line) else {
            tracing::warn!(line, "the learner printed something that is no event");
            return;
        };
        use std::io::Write;
        let written = writeln!(self.progress, "{line}")
            .or_exit_with(ExitCode::IoError, || "cannot write progress.jsonl");
        if let Err(failure) = written {
            self.end_early(failure);
        }
        self.view.event(&event, line);
        match event {
            Event::Started(started) => {
                self.first_iteration = started.iteration;
                let moved = self.transport.as_ref() != Some(&started.transport);
                self.transport = Some(started.transport);
                self.next_incarnations = started.next_incarnations;
                // Actors that run find a learner that is back at its address by themselves.
                let now = Instant::now();
                for actor in &mut self.actors {
                    if moved {
                        actor.process = None;
                    }
                    if actor.process.is_none() {
                        actor.due = Some(now);
                    }
                }
            }
            Event::Finished(finished) => self.finished = Some(*finished),
            _ => {}
        }
    }

    fn watch_actors(&mut self) -> Result<(), Failure> {
        let winding_down = self.stopping_since.is_some() || self.finished.is_some();
        for index in 0..self.actors.len() {
            self.look_at_actor(index, winding_down);
            let due = self.actors[index]
                .due
                .is_some_and(|due| Instant::now() >= due);
            if due && !winding_down {
                self.start_actor(index)?;
            }
        }
        Ok(())
    }

    /// Notices that an actor has ended and decides what follows.
    fn look_at_actor(&mut self, index: usize, winding_down: bool) {
        let actor = &mut self.actors[index];
        let Some(process) = &mut actor.process else {
            return;
        };
        let silent = actor.pulse.silent_for();
        let hung = silent.as_secs_f64() > self.config.cluster.hang_timeout_s;
        if process.ended().is_none() && hung && !winding_down {
            self.view.warn(&format!(
                "actor {} (process {}) has given no sign of life for {:.0} s; it is killed",
                actor.id,
                process.pid(),
                silent.as_secs_f64()
            ));
            process.finish(Duration::ZERO);
        }
        let Some(status) = process.ended() else {
            return;
        };
        let (pid, log) = (process.pid(), process.log().to_owned());
        if winding_down || status.success() {
            return;
        }
        let how = children::describe(status);
        let reason = match status.code().and_then(|_| process.last_error()) {
            Some(words) => format!(": {}", words.error),
            None => String::new(),
        };
        actor.process = None;
        if status
            .code()
            .and_then(ExitCode::from_number)
            .is_some_and(is_permanent)
        {
            let message = format!("actor {} cannot work ({how}){reason}", actor.id);
            self.end_early(Failure::message(children::exit_code(status), message));
            return;
        }
        match actor.backoff.died(self.began.elapsed()) {
            Verdict::RestartAfter(pause) => {
                actor.due = Some(Instant::now() + pause);
                let text = format!(
                    "actor {} (process {pid}) {how}; it is started again in {:.2} s{reason}",
                    actor.id,
                    pause.as_secs_f64()
                );
                self.view.warn(&text);
            }
            Verdict::GiveUp => {
                actor.due = None;
                let text = format!("actor {} {how} too often and stays down{reason}", actor.id);
                self.view.warn(&text);
                let any_left = self
                    .actors
                    .iter()
                    .any(|other| other.process.is_some() || other.due.is_some());
                if !any_left {
                    let failure =
                        Failure::message(ExitCode::TempFail, format!("no actor is left: {text}"));
                    self.end_early(failure.hint(format!("see {}", log.display())));
                }
            }
        }
    }

    fn start_actor(&mut self, index: usize) -> Result<(), Failure> {
        let Some(transport) = self.transport.clone() else {
            return Ok(());
        };
        let (config, folder) = (self.config, self.folder);
        let actor = &mut self.actors[index];
        actor.due = None;
        let known = usize::try_from(actor.id).ok();
        let known = known.and_then(|id| self.next_incarnations.get(id).copied());
        let incarnation = folder.next_incarnation(actor.id).max(known.unwrap_or(0));
        let ledger = folder.ledger(actor.id, incarnation);
        let mut command = Command::new(self.programs.find("caudata-actor")?);
        command.arg("--config").arg(folder.config());
        command.args(["--run-id", folder.run_id()]);
        command.args(["--actor-id", &actor.id.to_string()]);
        command.args(["--incarnation", &incarnation.to_string()]);
        command.args(["--transport", &transport]);
        command.arg("--ledger").arg(ledger);
        command.arg("--heartbeat");
        add_telemetry(&mut command, config, true);
        actor.pulse.beat();
        let pulse = actor.pulse.clone();
        let sink: LineSink = Box::new(move |_| pulse.beat());
        let log = folder.logs().join(format!("actor-{}.log", actor.id));
        actor.started.push(incarnation);
        actor.process = Some(Process::start(
            &format!("actor {}", actor.id),
            command,
            &log,
            Some(sink),
        )?);
        Ok(())
    }

    /// Ranks that died are started again, unless the learner that they worked for ends, which its own end decides about.
    fn watch_ranks(&mut self) -> Result<(), Failure> {
        let ending = self.stopping_since.is_some() || self.fatal.is_some();
        if ending || self.finished.is_some() || self.learner.ended().is_some() {
            return Ok(());
        }
        self.ranks.watch(&self.view, self.began.elapsed())
    }

    /// A policy server that died is started again at its old address; training goes on meanwhile.
    fn watch_server(&mut self) -> Result<(), Failure> {
        let Some(status) = self.server.ended() else {
            return Ok(());
        };
        if self.fatal.is_some() {
            return Ok(());
        }
        let how = children::describe(status);
        match self.server_backoff.died(self.began.elapsed()) {
            Verdict::RestartAfter(pause) => {
                self.view
                    .warn(&format!("the policy server {how}; it is started again"));
                std::thread::sleep(pause);
                let restarted =
                    start_server(self.programs, self.config, self.folder, self.server_addr);
                match restarted {
                    Ok((server, _)) => self.server = server,
                    Err(failure) => self.end_early(failure),
                }
            }
            Verdict::GiveUp => {
                let failure = failed_child(&self.server, ExitCode::Unavailable, &how);
                self.end_early(failure);
            }
        }
        Ok(())
    }

    /// Asks the learner to stop; `failure` is what the run ends with.
    fn end_early(&mut self, failure: Failure) {
        self.fatal.get_or_insert(failure);
    }

    /// Passes a stop on to the learner, which then stops the actors; kills it when it takes too long.
    fn pass_stop_on(&mut self) {
        if !self.stop.is_set() && self.fatal.is_none() {
            return;
        }
        match self.stopping_since {
            None => {
                self.stopping_since = Some(Instant::now());
                self.view.note(
                    "stopping: the learner finishes its iteration and saves; again to end at once",
                );
                self.learner.signal(Signal::SIGTERM);
            }
            Some(since) if since.elapsed() > LEARNER_STOP_MAX => {
                self.learner.finish(Duration::ZERO);
            }
            Some(_) => {}
        }
    }

    /// Removes what a learner that was killed has left in shared memory.
    fn clean_up_transport(&self) {
        let transport = caudata_actor::transport_config(&self.config.transport);
        if let Err(error) = caudata_transport::clean_up(&transport, self.folder.run_id()) {
            tracing::warn!(%error, "something of the transport may be left behind");
        }
    }

    fn stop_actors(&mut self) {
        let patience = CHILD_STOP_MAX + Duration::from_secs_f64(self.config.actors.flush_timeout_s);
        let processes = || {
            self.actors
                .iter()
                .filter_map(|actor| actor.process.as_ref())
        };
        processes().for_each(|process| process.signal(Signal::SIGTERM));
        for actor in &mut self.actors {
            if let Some(mut process) = actor.process.take() {
                process.finish(patience);
            }
        }
    }
}

impl Outcome {
    /// Stops the policy server.
    pub fn stop_server(&mut self) {
        self.server.signal(Signal::SIGTERM);
        self.server.finish(CHILD_STOP_MAX);
    }
}

/// Exit codes that starting again does not cure.
pub fn is_permanent(code: ExitCode) -> bool {
    matches!(
        code,
        ExitCode::BadConfig
            | ExitCode::BadInput
            | ExitCode::NoInput
            | ExitCode::Protocol
            | ExitCode::PolicyRefused
            | ExitCode::CannotCreate
    )
}

/// The failure that a child's end amounts to: its own error line and hint; without them, `how` it ended and its log.
pub fn failed_child(child: &Process, code: ExitCode, how: &str) -> Failure {
    let log = format!("its log is {}", child.log().display());
    match child.last_error() {
        Some(words) => Failure::message(code, format!("{}: {}", child.name(), words.error))
            .hint(words.hint.unwrap_or(log)),
        None => Failure::message(code, format!("{} {how}", child.name())).hint(log),
    }
}

fn start_server(
    programs: &Programs,
    config: &Config,
    folder: &RunFolder,
    addr: SocketAddr,
) -> Result<(Process, SocketAddr), Failure> {
    let mut command = Command::new(programs.find("caudata-policy-server")?);
    command
        .arg("--data")
        .arg(folder.root().join(&config.policy_server.dir));
    command.args(["--addr", &addr.to_string()]);
    command.args(["--keep", &config.policy_server.keep_versions.to_string()]);
    if let Some(certificates) = server_certificates(config) {
        command.arg("--tls-dir").arg(certificates);
    }
    add_telemetry(&mut command, config, true);
    let (sender, announced) = bounded(1);
    let sink: LineSink = Box::new(move |line| {
        if let Ok(listening) = serde_json::from_str::<Listening>(&line)
            && listening.listening == "policy_server"
        {
            let _ = sender.try_send(listening.address);
        }
    });
    let log = folder.logs().join("policy_server.log");
    let mut server = Process::start("the policy server", command, &log, Some(sink))?;
    match announced.recv_timeout(SERVER_START_MAX) {
        Ok(addr) => Ok((server, addr)),
        Err(error) => Err(match server.finish(patience_after(error)) {
            Some(status) if status.code().is_some() => failed_child(
                &server,
                children::exit_code(status),
                &children::describe(status),
            ),
            _ => failed_child(&server, ExitCode::TempFail, "did not start in time"),
        }),
    }
}

/// How long a child may take to end that has announced nothing: one that has closed its standard output is about to.
pub fn patience_after(error: RecvTimeoutError) -> Duration {
    match error {
        RecvTimeoutError::Disconnected => CHILD_STOP_MAX,
        RecvTimeoutError::Timeout => Duration::ZERO,
    }
}

/// The certificates of a policy server that others than this host reach.
fn server_certificates(config: &Config) -> Option<&std::path::Path> {
    let open = !config.policy_server.addr.ip().is_loopback();
    config.cluster.certificates().filter(|_| open)
}

fn start_learner(
    programs: &Programs,
    config: &Config,
    folder: &RunFolder,
    server: SocketAddr,
    resume: &Resume,
    lines: Sender<String>,
) -> Result<Process, Failure> {
    let mut command = Command::new(programs.find("caudata-learner")?);
    command.arg("--config").arg(folder.config());
    command.arg("--run-dir").arg(folder.root());
    command.args(["--run-id", folder.run_id()]);
    let server = match server_certificates(config) {
        // Its certificate is for a name, not for "any address".
        Some(_) if config.cluster.policy_server.is_empty() => {
            format!("https://localhost:{}", server.port())
        }
        Some(_) => config.cluster.policy_server.clone(),
        None => server.to_string(),
    };
    command.args(["--policy-server", &server]);
    match resume {
        Resume::No => {}
        Resume::Latest => {
            command.arg("--resume");
        }
        Resume::Named(name) => {
            command.args(["--resume-from", name]);
        }
    }
    add_telemetry(&mut command, config, false);
    let sink: LineSink = Box::new(move |line| {
        // Blocks while the queue is full; nobody reads any more when the supervisor ends.
        let _ = lines.send(line);
    });
    Process::start(
        "the learner",
        command,
        &folder.logs().join("learner.log"),
        Some(sink),
    )
}

/// Log flags, and with `own_metrics` a metrics endpoint on any free port of the configured address.
pub fn add_telemetry(command: &mut Command, config: &Config, own_metrics: bool) {
    let telemetry = &config.telemetry;
    command.args([
        "--log-format",
        telemetry.log_format.name(),
        "--log-filter",
        &telemetry.log,
    ]);
    if own_metrics && telemetry.metrics {
        let any_port = SocketAddr::new(telemetry.metrics_addr.ip(), 0);
        command.args(["--metrics-addr", &any_port.to_string()]);
    }
}

#[cfg(test)]
mod tests;
