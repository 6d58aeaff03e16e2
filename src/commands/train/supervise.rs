//! Starting, watching and stopping the processes of a run.

use std::net::SocketAddr;
use std::os::unix::process::ExitStatusExt;
use std::path::PathBuf;
use std::process::Command;
use std::time::{Duration, Instant};

use caudata_actor::LedgerCount;
use caudata_config::Config;
use caudata_live::LivePage;
use caudata_telemetry::progress::{Event, Finished};
use caudata_telemetry::{ExitCode, Failure, FailureExt, Pulse, StopFlag};
use crossbeam_channel::{Receiver, RecvTimeoutError, bounded};
use nix::sys::signal::Signal;

use super::backoff::Backoff;
use super::children::{self, Process, Programs};
use super::desk::Desk;
use super::folder::RunFolder;
use super::start::{
    Resume, add_telemetry, failed_child, is_permanent, start_learner, start_server,
};
use super::view::View;
use super::watched::{Watched, stop_all};

/// Lines of the learner that may wait to be shown; then the learner waits.
const LINES_WAITING_MAX: usize = 256;
/// How long the loop sleeps at most between two looks at the children.
const WATCH_EVERY: Duration = Duration::from_millis(100);
/// How long the learner may take to finish its iteration, save, and say goodbye. Shorter than the deadline of
/// the supervisor itself, so that it is the supervisor who tells.
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
    /// Whether a learner that died goes on from its newest checkpoint while the actors wait, instead of
    /// ending the run.
    pub restart_learner: bool,
}

/// The processes of a run.
pub struct Supervisor<'a> {
    programs: &'a Programs,
    config: &'a Config,
    folder: &'a RunFolder,
    stop: &'a StopFlag,
    view: View,
    shown: Option<(&'a LivePage, &'a Desk)>,
    began: Instant,
    server: Process,
    server_addr: SocketAddr,
    server_backoff: Backoff,
    plan: Plan,
    learner: Process,
    learner_backoff: Backoff,
    /// Beats with everything that the learner says.
    learner_pulse: Pulse,
    /// Whether it has been said that the learner stands still.
    learner_silent: bool,
    /// How often it stood still.
    learner_silences: usize,
    lines: Receiver<String>,
    progress: std::fs::File,
    /// By number.
    actors: Vec<Watched>,
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
    /// How often the learner gave no sign of life for longer than an actor may.
    pub learner_silences: usize,
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
        let learner_pulse = Pulse::new();
        let learner = start_learner(
            programs,
            config,
            folder,
            server_addr,
            &plan.resume,
            sender,
            learner_pulse.clone(),
        )?;
        let restarts = config.actors.restarts_per_minute;
        let actors =
            (0..plan.actors).map(|id| Watched::new(format!("actor {id}"), restarts)).collect();
        Ok(Self {
            programs,
            config,
            folder,
            stop,
            view,
            shown: None,
            began: Instant::now(),
            server,
            server_addr,
            server_backoff: Backoff::new(SERVER_RESTARTS_PER_MINUTE),
            plan,
            learner,
            learner_backoff: Backoff::new(LEARNER_RESTARTS_PER_MINUTE),
            learner_pulse,
            learner_silent: false,
            learner_silences: 0,
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

    /// Shows the training on a live page too.
    pub fn shown_on(self, shown: Option<(&'a LivePage, &'a Desk)>) -> Self {
        Self { shown, ..self }
    }

    /// Watches until the learner has ended, then stops the actors. The policy server stays up for the
    /// evaluation.
    pub fn watch(mut self) -> Result<Outcome, Failure> {
        while self.learner.ended().is_none() || self.restart_learner() {
            // Whatever fails here ends the run in good order: the learner saves, the transport is cleaned up.
            self.take_lines(WATCH_EVERY);
            self.watch_learner();
            let watched = self.watch_actors().and_then(|()| self.watch_server());
            if let Err(failure) = watched {
                self.end_early(failure);
            }
            self.pass_stop_on();
        }
        self.take_lines(Duration::ZERO);
        self.view.done();
        let patience = CHILD_STOP_MAX + Duration::from_secs_f64(self.config.actors.flush_timeout_s);
        stop_all(&mut self.actors, patience);
        let status = self.learner.ended();
        if !status.is_some_and(|status| status.success()) {
            self.clean_up_transport();
        }
        if let Some(fatal) = self.fatal {
            return Err(fatal);
        }
        let clean = status.is_some_and(|status| status.success());
        let Some(mut finished) = self.finished.take().filter(|_| clean) else {
            return Err(self.learner_failure());
        };
        if let (true, Some(reason)) = (finished.reason == "SIGTERM", self.stop.reason()) {
            // which it was passed on as
            finished.reason = reason;
        }
        let restarts = self.actors.iter().map(Watched::restarts).sum();
        // Of the whole run, as the learner's account is.
        let ledgers = caudata_actor::ledgers_in(&self.folder.ledgers());
        let (server, server_addr) = (self.server, self.server_addr);
        Ok(Outcome {
            finished,
            first_iteration: self.first_iteration,
            ledgers,
            restarts,
            learner_silences: self.learner_silences,
            server,
            server_addr,
        })
    }

    /// What the end of a learner that did not finish amounts to.
    fn learner_failure(&mut self) -> Failure {
        let status = self.learner.ended();
        // One that has only just started does not listen for signals yet.
        let by_signal = status.and_then(|status| status.signal());
        if self.stopping_since.is_some() && by_signal == Some(Signal::SIGTERM as i32) {
            let message = "stopped before the learner had begun";
            let hint = "what was saved before is as it was: the same command begins again, or `train --resume`";
            return Failure::message(ExitCode::Interrupted, message).hint(hint);
        }
        let (code, how) = match status {
            Some(status) if !status.success() => {
                (children::exit_code(status), children::describe(status))
            }
            _ => (ExitCode::Internal, "ended without a last word".into()),
        };
        let failure = failed_child(&self.learner, code, &how);
        let killed = status.is_some_and(|status| status.code().is_none());
        match killed {
            true if self.plan.restart_learner => {
                failure.hint("the same command goes on from its last checkpoint")
            }
            true => failure.hint(format!(
                "go on from its last checkpoint with: caudata train --resume --out {}",
                self.folder.root().display()
            )),
            false => failure,
        }
    }

    /// Says once that the learner stands still, and when it goes on. It is not killed: whoever stopped it may
    /// let it go on, with everything it has, and a batch that is long to learn from is no fault.
    fn watch_learner(&mut self) {
        let silent_s = self.learner_pulse.silent_for().as_secs_f64();
        let silent = silent_s > self.config.cluster.hang_timeout_s;
        if silent && !self.learner_silent {
            self.learner_silences += 1;
            self.view.warn(&format!(
                "the learner (process {}) has given no sign of life for {silent_s:.0} s; training stands still until it goes on, or is killed",
                self.learner.pid()
            ));
        } else if !silent && self.learner_silent {
            self.view.warn("the learner gives signs of life again");
        }
        self.learner_silent = silent;
    }

    /// Starts a learner that died again, if that is the plan and may help; true when one runs.
    fn restart_learner(&mut self) -> bool {
        let ending = self.stopping_since.is_some() || self.fatal.is_some() || self.stop.is_set();
        let Some(status) = self.learner.ended() else { return true };
        let code = status.code().and_then(ExitCode::from_number);
        let hopeless = status.success()
            || code.is_some_and(|code| is_permanent(code) || code == ExitCode::CheckpointDamaged);
        if !self.plan.restart_learner || ending || hopeless {
            return false;
        }
        self.take_lines(Duration::ZERO);
        let how = children::describe(status);
        let Some(pause) = self.learner_backoff.died(self.began.elapsed()) else {
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
            self.learner_pulse.clone(),
        );
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
        if let Some((page, desk)) = self.shown {
            desk.follow(&event, page);
        }
        match event {
            Event::Started(started) => {
                self.first_iteration = started.iteration;
                let moved = self.transport.as_ref() != Some(&started.transport);
                self.transport = Some(started.transport);
                self.next_incarnations = started.next_incarnations;
                // Actors that run find a learner that is back at its address by themselves.
                self.actors.iter_mut().for_each(|actor| actor.call(moved));
            }
            Event::Finished(finished) => self.finished = Some(*finished),
            _ => {}
        }
    }

    fn watch_actors(&mut self) -> Result<(), Failure> {
        if self.stopping_since.is_some() || self.finished.is_some() {
            return Ok(());
        }
        for id in 0..self.actors.len() {
            let patience_s = self.config.cluster.hang_timeout_s;
            let since = self.began.elapsed();
            let down = self.actors[id].look(patience_s, since, |text| self.view.warn(text))?;
            if let Some(text) = down
                && self.actors.iter_mut().all(Watched::is_down)
            {
                let failure =
                    Failure::message(ExitCode::TempFail, format!("no actor is left: {text}"));
                return Err(failure.hint(format!("see {}", self.actor_log(id).display())));
            }
            if self.actors[id].is_due() {
                self.start_actor(id)?;
            }
        }
        Ok(())
    }

    fn actor_log(&self, id: usize) -> PathBuf {
        self.folder.logs().join(format!("actor-{id}.log"))
    }

    fn start_actor(&mut self, index: usize) -> Result<(), Failure> {
        let (Some(transport), Ok(id)) = (&self.transport, u32::try_from(index)) else {
            return Ok(());
        };
        let (config, folder) = (self.config, self.folder);
        let known = self.next_incarnations.get(index).copied();
        let incarnation = folder.next_incarnation(id).max(known.unwrap_or(0));
        let mut command = Command::new(self.programs.find("caudata-actor")?);
        command.arg("--config").arg(folder.config());
        command.args(["--run-id", folder.run_id()]);
        command.args(["--actor-id", &id.to_string()]);
        command.args(["--incarnation", &incarnation.to_string()]);
        command.args(["--transport", transport]);
        command.arg("--ledger").arg(folder.ledger(id, incarnation));
        add_telemetry(&mut command, config, true);
        let log = self.actor_log(index);
        self.actors[index].start(command, &log)
    }

    /// A policy server that died is started again at its old address; training goes on meanwhile.
    fn watch_server(&mut self) -> Result<(), Failure> {
        let Some(status) = self.server.ended() else { return Ok(()) };
        if self.fatal.is_some() {
            return Ok(());
        }
        let how = children::describe(status);
        match self.server_backoff.died(self.began.elapsed()) {
            Some(pause) => {
                self.view.warn(&format!("the policy server {how}; it is started again"));
                std::thread::sleep(pause);
                let restarted =
                    start_server(self.programs, self.config, self.folder, self.server_addr);
                match restarted {
                    Ok((server, _)) => self.server = server,
                    Err(failure) => self.end_early(failure),
                }
            }
            None => {
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
}

impl Outcome {
    /// Stops the policy server.
    pub fn stop_server(&mut self) {
        self.server.signal(Signal::SIGTERM);
        self.server.finish(CHILD_STOP_MAX);
    }
}

#[cfg(test)]
pub mod tests;
