//! `caudata actors`: the actors of one host, for a learner elsewhere; started, watched, started again.

use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{Duration, Instant, SystemTime};

use caudata_config::{Config, ConfigArgs};
use caudata_studies::{files, flags};
use caudata_telemetry::{ExitCode, Failure, FailureExt, Process, Pulse, StopFlag};
use clap::Args;
use nix::sys::signal::Signal;

use crate::commands::train::backoff::{Backoff, Verdict};
use crate::commands::train::children::{self, LineSink, Process as Child, Programs};
use crate::commands::train::supervise::is_permanent;
use crate::say;

/// How often the actors are looked at.
const LOOK_AT_ACTORS_EVERY: Duration = Duration::from_millis(100);
/// How long actors have to end besides `actors.flush_timeout_s`.
const STOP_MAX: Duration = Duration::from_secs(5);

#[derive(Debug, Args)]
pub struct ActorsArgs {
    /// The learner or a router, for instance quic/learner.lab:7447
    #[arg(long, value_name = "ENDPOINT", required = true)]
    connect: Vec<String>,
    /// How many; otherwise one for each core
    #[arg(long, value_name = "N")]
    count: Option<u32>,
    /// The run; otherwise as the configuration says
    #[arg(long, value_name = "ID")]
    run_id: Option<String>,
    /// Name of this host among all; otherwise its own
    #[arg(long, value_name = "NAME")]
    name: Option<String>,
    /// Folder for the logs; otherwise in the system's folder for temporary files
    #[arg(long, value_name = "DIR")]
    logs: Option<PathBuf>,
    #[command(flatten)]
    config: ConfigArgs,
}

/// Runs until the learner says stop, until asked to, or until an actor cannot work at all.
pub fn run(args: &ActorsArgs, process: &Process) -> Result<(), Failure> {
    let mut flags = args.config.clone();
    let endpoints = format!("transport.zenoh_connect={:?}", args.connect);
    flags
        .overrides
        .extend(["transport.kind=zenoh".to_owned(), endpoints]);
    let config = flags.load().or_exit(ExitCode::BadConfig)?;
    let run_id = args.run_id.as_deref().unwrap_or(config.cluster_run_id());
    let name = match &args.name {
        Some(name) => name.clone(),
        None => caudata_actor::host_name().or_exit(ExitCode::OsResource)?,
    };
    let count = args.count.unwrap_or_else(cores);
    let logs = match &args.logs {
        Some(folder) => folder.clone(),
        None => std::env::temp_dir().join(format!("caudata-actors-{run_id}")),
    };
    files::make_folder(&logs)?;
    say::line(format!(
        "{count} actors of `{name}` for the run {run_id} at {}; logs in {}",
        args.connect.join(", "),
        logs.display()
    ));
    let mut host = Host {
        programs: Programs::beside_this_one()?,
        arguments: arguments(&flags, run_id),
        config: &config,
        logs: &logs,
        began: Instant::now(),
        slots: (0..count)
            .map(|index| Slot::new(&config, &name, index))
            .collect(),
    };
    let result = host.watch(&process.stop);
    host.stop();
    result
}

fn cores() -> u32 {
    u32::try_from(flags::cores()).unwrap_or(1)
}

/// The arguments that all actors of this host share.
fn arguments(flags: &ConfigArgs, run_id: &str) -> Vec<OsString> {
    let mut arguments = vec!["--run-id".into(), run_id.into()];
    arguments.extend(flags::as_words(flags));
    arguments
}

struct Host<'a> {
    programs: Programs,
    arguments: Vec<OsString>,
    config: &'a Config,
    logs: &'a Path,
    began: Instant,
    slots: Vec<Slot>,
}

/// One actor over all its incarnations.
struct Slot {
    name: String,
    process: Option<Child>,
    pulse: Pulse,
    backoff: Backoff,
    due: Option<Instant>,
    last_incarnation: u64,
}

impl Slot {
    fn new(config: &Config, host: &str, index: u32) -> Self {
        Self {
            name: format!("{host}-{index}"),
            process: None,
            pulse: Pulse::new(),
            backoff: Backoff::new(config.actors.restarts_per_minute),
            due: Some(Instant::now()),
            last_incarnation: 0,
        }
    }

    /// By the clock, so that it is larger than any that an earlier supervisor of this host gave out.
    fn next_incarnation(&mut self, now: SystemTime) -> u64 {
        let clock = caudata_actor::clock_incarnation(now);
        self.last_incarnation = clock.max(self.last_incarnation + 1);
        self.last_incarnation
    }
}

impl Host<'_> {
    fn watch(&mut self, stop: &StopFlag) -> Result<(), Failure> {
        loop {
            for index in 0..self.slots.len() {
                self.look_at(index)?;
                let slot = &self.slots[index];
                if slot.due.is_some_and(|due| Instant::now() >= due) {
                    self.start(index)?;
                }
            }
            if self.is_over() || stop.wait(LOOK_AT_ACTORS_EVERY) {
                return Ok(());
            }
        }
    }

    /// Nobody works, and nobody will.
    fn is_over(&self) -> bool {
        let over = |slot: &Slot| slot.process.is_none() && slot.due.is_none();
        self.slots.iter().all(over)
    }

    fn start(&mut self, index: usize) -> Result<(), Failure> {
        let program = self.programs.find("caudata-actor")?;
        let slot = &mut self.slots[index];
        slot.due = None;
        let incarnation = slot.next_incarnation(SystemTime::now());
        let mut command = Command::new(program);
        command.args(&self.arguments);
        command.args(["--actor-name", &slot.name]);
        command.args(["--incarnation", &incarnation.to_string(), "--heartbeat"]);
        slot.pulse.beat();
        let pulse = slot.pulse.clone();
        let sink: LineSink = Box::new(move |_| pulse.beat());
        let log = self.logs.join(format!("{}.log", slot.name));
        let name = format!("actor {}", slot.name);
        slot.process = Some(Child::start(&name, command, &log, Some(sink))?);
        Ok(())
    }

    fn look_at(&mut self, index: usize) -> Result<(), Failure> {
        let slot = &mut self.slots[index];
        let Some(process) = &mut slot.process else {
            return Ok(());
        };
        let silent = slot.pulse.silent_for().as_secs_f64();
        if process.ended().is_none() && silent > self.config.cluster.hang_timeout_s {
            say::line(format!(
                "actor {} gives no sign of life for {silent:.0} s; it is killed",
                slot.name
            ));
            process.finish(Duration::ZERO);
        }
        let Some(status) = process.ended() else {
            return Ok(());
        };
        let how = children::describe(status);
        let why = process
            .last_error()
            .map_or(String::new(), |words| format!(": {}", words.error));
        slot.process = None;
        if status.success() {
            // The learner said stop: the run is complete, or its learner ended for good.
            return Ok(());
        }
        let code = children::exit_code(status);
        if status.code().is_some() && is_permanent(code) {
            let message = format!("actor {} cannot work ({how}){why}", slot.name);
            return Err(Failure::message(code, message));
        }
        match slot.backoff.died(self.began.elapsed()) {
            Verdict::RestartAfter(pause) => {
                slot.due = Some(Instant::now() + pause);
                say::line(format!(
                    "actor {} {how}; it is started again in {:.2} s{why}",
                    slot.name,
                    pause.as_secs_f64()
                ));
            }
            Verdict::GiveUp => {
                say::line(format!(
                    "actor {} {how} too often and stays down{why}",
                    slot.name
                ));
                if self.is_over() {
                    return Err(Failure::message(ExitCode::TempFail, "no actor is left")
                        .hint(format!("see {}", self.logs.display())));
                }
            }
        }
        Ok(())
    }

    /// All at once, then each with what is left of the patience.
    fn stop(&mut self) {
        let patience = STOP_MAX + Duration::from_secs_f64(self.config.actors.flush_timeout_s);
        let running = || self.slots.iter().filter_map(|slot| slot.process.as_ref());
        running().for_each(|process| process.signal(Signal::SIGTERM));
        let deadline = Instant::now() + patience;
        for slot in &mut self.slots {
            if let Some(mut process) = slot.process.take() {
                process.finish(deadline.saturating_duration_since(Instant::now()));
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use std::time::UNIX_EPOCH;

    use super::*;
    use caudata_config::Source;

    #[test]
    fn incarnations_follow_the_clock_and_never_repeat() {
        let config = Config::load(&Source::default()).unwrap();
        let mut slot = Slot::new(&config, "node", 3);
        assert_eq!(slot.name, "node-3");
        let at = |seconds| UNIX_EPOCH + Duration::from_secs(seconds);
        // Started three times within one second, then later; a clock that was set back changes nothing.
        let times = [100, 100, 100, 200, 150];
        let given = times.map(|seconds| slot.next_incarnation(at(seconds)));
        assert_eq!(given, [100, 101, 102, 200, 201]);
    }

    #[test]
    fn actors_get_the_configuration_of_the_command_and_where_to_connect() {
        let set = |change: &str| change.to_owned();
        let flags = ConfigArgs {
            config: Some("cluster.toml".into()),
            overrides: vec![set("actors.lanes=8"), set("transport.kind=zenoh")],
            ..ConfigArgs::default()
        };
        assert_eq!(
            arguments(&flags, "walk"),
            [
                "--run-id",
                "walk",
                "--config",
                "cluster.toml",
                "--set",
                "actors.lanes=8",
                "--set",
                "transport.kind=zenoh"
            ]
        );
    }
}
