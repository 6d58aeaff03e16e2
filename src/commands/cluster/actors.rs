//! `caudata actors`: the actors of one host, for a learner elsewhere; started, watched, started again.

use std::ffi::OsString;
use std::fs::DirBuilder;
use std::io::ErrorKind;
use std::os::unix::fs::{DirBuilderExt, MetadataExt};
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{Duration, Instant, SystemTime};

use caudata_config::{Config, ConfigArgs};
use caudata_studies::{files, flags};
use caudata_telemetry::{ExitCode, Failure, FailureExt, Process, StopFlag};
use clap::Args;

use crate::commands::train::children::Programs;
use crate::commands::train::watched::{Watched, stop_all};
use crate::say;

/// How often the actors are looked at.
const WATCH_EVERY: Duration = Duration::from_millis(100);
/// How long actors have to end besides `actors.flush_timeout_s`.
const STOP_MAX: Duration = Duration::from_secs(5);
/// While no actor has had a policy, that is said after this time, and whenever it has doubled.
const ALONE_SAID_AFTER: Duration = Duration::from_secs(15);

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
    // as `up` takes them: of a robot alone both have its preset
    let mut flags = flags::of_robot(&args.config);
    let endpoints = format!("transport.zenoh_connect={:?}", args.connect);
    flags.overrides.extend(["transport.kind=zenoh".to_owned(), endpoints]);
    let config = flags.load().or_exit(ExitCode::BadConfig)?;
    let run_id = args.run_id.as_deref().unwrap_or(config.cluster_run_id());
    let name = match &args.name {
        Some(name) => name.clone(),
        None => caudata_actor::host_name().or_exit(ExitCode::OsResource)?,
    };
    let count = args.count.unwrap_or_else(cores);
    let logs = match &args.logs {
        Some(folder) => {
            files::make_folder(folder)?;
            folder.clone()
        }
        None => {
            let folder = std::env::temp_dir().join(format!("caudata-actors-{run_id}"));
            private_folder(&folder)?;
            folder
        }
    };
    say::line(format!(
        "{count} actor{} of `{name}` for the run {run_id} at {}; logs in {}",
        if count == 1 { "" } else { "s" },
        args.connect.join(", "),
        logs.display()
    ));
    let mut host = Host {
        programs: Programs::beside_this_one()?,
        arguments: arguments(&flags, run_id),
        config: &config,
        logs: &logs,
        began: Instant::now(),
        joined: 0,
        alone_said_at: ALONE_SAID_AFTER,
        slots: (0..count).map(|index| Slot::new(&config, &name, index)).collect(),
    };
    let result = host.watch(&process.stop);
    let patience = STOP_MAX + Duration::from_secs_f64(config.actors.flush_timeout_s);
    let mut actors: Vec<Watched> = host.slots.into_iter().map(|slot| slot.actor).collect();
    stop_all(&mut actors, patience);
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
    /// How many have had a policy, as it was last said.
    joined: usize,
    /// When it is said, or said again, that none has.
    alone_said_at: Duration,
    slots: Vec<Slot>,
}

struct Slot {
    name: String,
    actor: Watched,
    last_incarnation: u64,
}

impl Slot {
    fn new(config: &Config, host: &str, index: u32) -> Self {
        let name = format!("{host}-{index}");
        let restarts = config.actors.restarts_per_minute;
        let mut actor = Watched::new(format!("actor {name}"), restarts);
        actor.call(true);
        Self { name, actor, last_incarnation: 0 }
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
        let patience_s = self.config.cluster.hang_timeout_s;
        let is_down = |slot: &mut Slot| slot.actor.is_down();
        loop {
            for index in 0..self.slots.len() {
                let since = self.began.elapsed();
                let slot = &mut self.slots[index];
                let gave_up = slot.actor.look(patience_s, since, |text| say::line(text))?;
                if gave_up.is_some() && self.slots.iter_mut().all(is_down) {
                    let failure = Failure::message(ExitCode::TempFail, "no actor is left");
                    return Err(failure.hint(format!("see {}", self.logs.display())));
                }
                if self.slots[index].actor.is_due() {
                    self.start(index)?;
                }
            }
            self.say_who_has_joined();
            // Each has been told to stop: the run is complete, or its learner ended for good.
            if self.slots.iter_mut().all(is_down) || stop.wait(WATCH_EVERY) {
                return Ok(());
            }
        }
    }

    fn say_who_has_joined(&mut self) {
        let joined = self.slots.iter().filter(|slot| slot.actor.has_joined());
        let (joined, all) = (joined.count(), self.slots.len());
        if joined != self.joined {
            self.joined = joined;
            say::line(format!("{joined} of {all} actors have joined the run"));
        }
        if joined == 0 && self.began.elapsed() > self.alone_said_at {
            self.alone_said_at = 2 * self.began.elapsed();
            say::line(format!(
                "no actor has had a policy for {:.0} s: is the learner up, at that address, with that run id (and \
                 with certificates of the same authority)? Logs in {}",
                self.began.elapsed().as_secs_f64(),
                self.logs.display()
            ));
        }
    }

    fn start(&mut self, index: usize) -> Result<(), Failure> {
        let mut command = Command::new(self.programs.find("caudata-actor")?);
        let slot = &mut self.slots[index];
        let incarnation = slot.next_incarnation(SystemTime::now());
        command.args(&self.arguments);
        command.args(["--actor-name", &slot.name]);
        command.args(["--incarnation", &incarnation.to_string()]);
        let log = self.logs.join(format!("{}.log", slot.name));
        slot.actor.start(command, &log)
    }
}

/// A folder in the system's folder for temporary files, where everybody may write: made for this user alone.
/// What another user has put there, a folder or a link to elsewhere, is refused.
fn private_folder(path: &Path) -> Result<(), Failure> {
    let cannot = || format!("cannot make {}", path.display());
    match DirBuilder::new().mode(0o700).create(path) {
        Err(error) if error.kind() != ErrorKind::AlreadyExists => {
            return Err(error).or_exit_with(ExitCode::CannotCreate, cannot);
        }
        _ => {}
    }
    let owner =
        |path: &Path| std::fs::symlink_metadata(path).map(|found| (found.is_dir(), found.uid()));
    let found = owner(path).or_exit_with(ExitCode::CannotCreate, cannot)?;
    let own = std::fs::metadata("/proc/self").or_exit(ExitCode::OsResource)?;
    if found == (true, own.uid()) {
        return Ok(());
    }
    let message = format!("{} is a link, or another user's", path.display());
    Err(Failure::message(ExitCode::CannotCreate, message)
        .hint("give a folder of your own with --logs"))
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
    fn a_folder_that_another_user_put_there_is_refused() {
        use std::os::unix::fs::PermissionsExt;
        let dir = tempfile::tempdir().unwrap();
        let (own, link) = (dir.path().join("own"), dir.path().join("link"));
        private_folder(&own).unwrap();
        private_folder(&own).unwrap();
        let mode = std::fs::metadata(&own).unwrap().permissions().mode();
        assert_eq!(mode & 0o777, 0o700);
        std::os::unix::fs::symlink(&own, &link).unwrap();
        let refused = |path: &Path| private_folder(path).unwrap_err().code();
        assert_eq!(refused(&link), ExitCode::CannotCreate);
        // Only root can give a folder away.
        if std::os::unix::fs::chown(&own, Some(65_534), None).is_ok() {
            assert_eq!(refused(&own), ExitCode::CannotCreate);
        }
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
