//! `caudata up`: policy server, learner and some actors of a cluster's run, on this host.

use std::path::{Path, PathBuf};

use caudata_config::{Config, ConfigArgs, TransportKind};
use caudata_studies::flags;
use caudata_telemetry::{ExitCode, Failure, FailureExt, Process};
use clap::Args;

use crate::commands::robot;
use crate::commands::train::children::Programs;
use crate::commands::train::folder::RunFolder;
use crate::commands::train::supervise::{Plan, Supervisor};
use crate::commands::train::tracker::{Logger, Tracker};
use crate::commands::train::view::View;
use crate::commands::train::{Resume, clear_if_refused};
use crate::say;

#[derive(Debug, Args)]
pub struct UpArgs {
    /// Actors on this host; more join with `caudata actors`. Otherwise one for each core but one
    #[arg(long, value_name = "N")]
    actors: Option<u32>,
    /// Hand the run to a tracker, by its Python package and the one of caudata (python3, or CAUDATA_PYTHON)
    #[arg(long, value_enum, value_name = "TRACKER")]
    logger: Option<Logger>,
    /// Events as JSON lines; the last line says how it ended
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    config: ConfigArgs,
}

/// Starts what the run of this configuration needs, or goes on with it; ends when the run is complete or at
/// Ctrl-C.
pub fn run(args: &UpArgs, process: &Process) -> Result<(), Failure> {
    let mut flags = flags::of_robot(&args.config);
    let of_file = flags.sets("transport", "kind").or_exit(ExitCode::BadConfig)?
        && flags.load().or_exit(ExitCode::BadConfig)?.transport.kind != TransportKind::Zenoh;
    if flags.overrides.iter().any(|o| o.starts_with("transport.kind=") && !o.contains("zenoh")) {
        let message = "transport.kind: `up` has zenoh, which reaches other hosts; leave it out";
        return Err(Failure::message(ExitCode::BadConfig, message));
    }
    flags.overrides.push("transport.kind=zenoh".to_owned());
    let mut config = flags.load().or_exit(ExitCode::BadConfig)?;
    robot::load(&config.robot_path())?;
    let run_id = config.cluster_run_id().to_owned();
    let view = View::new(args.json);
    if of_file {
        view.note(
            "transport.kind of the file is not taken: `up` has zenoh, which reaches other hosts",
        );
    }
    let (root, stop) = (run_dir(&config), &process.stop);
    let folder = RunFolder::of_run(&root, &run_id, &mut view.wait_for_owner(stop))?;
    config.robot = std::path::absolute(config.robot_path()).or_exit(ExitCode::NoInput)?;
    let text = config.to_toml().or_exit(ExitCode::BadConfig)?;
    folder.write("config.toml", text.as_bytes())?;

    let programs = Programs::beside_this_one()?;
    view.note(&format!("run {run_id} in {}", folder.root().display()));
    if let Some(address) = config.transport.zenoh_listen.first() {
        view.note(&joining(address));
    }
    let plan = Plan {
        resume: Resume::Latest,
        actors: args.actors.unwrap_or_else(spare_cores),
        restart_learner: true,
    };
    let logger = args.logger.map(|logger| (logger, view.clone()));
    let supervisor = Supervisor::start(&programs, &config, &folder, &process.stop, view, plan);
    let logger = logger.filter(|_| supervisor.is_ok());
    let tracker = logger.and_then(|(logger, view)| Tracker::beside(&folder, logger, &view));
    let outcome = supervisor.and_then(Supervisor::watch);
    drop(tracker);
    let mut outcome = outcome.inspect_err(|failure| clear_if_refused(&folder, failure))?;
    outcome.stop_server();
    let finished = &outcome.finished;
    if args.json {
        return say::json(&serde_json::json!({
            "reason": finished.reason,
            "iteration": finished.iteration,
            "checkpoint": finished.checkpoint_path,
            "accounting": finished.accounting,
            "restarts": outcome.restarts,
            "folder": folder.root(),
        }));
    }
    let policy = folder.policy();
    say::line(match finished.reason.as_str() {
        "completed" => format!(
            "complete after iteration {}; the policy is {}",
            finished.iteration,
            policy.display()
        ),
        reason => format!(
            "stopped ({reason}) after iteration {}; the same command goes on from there",
            finished.iteration
        ),
    });
    Ok(())
}

/// The run's folder: `cluster.run_dir`, else its id under `run.out_dir`.
pub fn run_dir(config: &Config) -> PathBuf {
    match config.cluster.run_dir.as_path() {
        empty if empty == Path::new("") => config.run.out_dir.join(config.cluster_run_id()),
        folder => folder.to_owned(),
    }
}

/// One core stays for the learner.
fn spare_cores() -> u32 {
    u32::try_from(caudata_studies::flags::cores().saturating_sub(1)).unwrap_or(1).max(1)
}

/// How more actors come to a learner that listens there.
fn joining(address: &str) -> String {
    let who = match address.split_once('/').map_or("", |(_, at)| at) {
        at if at.ends_with(":0") => {
            return format!(
                "no other actors can join: transport.zenoh_listen is {address}, any free port; set it to \
                 [\"tcp/127.0.0.1:7447\"] for actors of this host, to [\"quic/0.0.0.0:7447\"] (certificates in \
                 cluster.tls_dir) for others"
            );
        }
        at if at.starts_with("127.") || at.starts_with("[::1]") || at.starts_with("localhost:") => {
            "more actors of this host"
        }
        _ => "actors of other hosts",
    };
    let address = with_own_name(address);
    format!("{who} join with: caudata actors --config FILE --connect {address}")
}

/// An endpoint with this host's name instead of "any address", for others to connect to.
fn with_own_name(endpoint: &str) -> String {
    let host = caudata_actor::host_name().unwrap_or_else(|_| "HOST".to_owned());
    endpoint.replace("/0.0.0.0:", &format!("/{host}:")).replace("/[::]:", &format!("/{host}:"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use caudata_config::Source;

    #[test]
    fn a_run_has_the_folder_that_is_given_or_its_id() {
        let config = |sets: &[&str]| {
            let source = sets.iter().fold(Source::default(), |s, set| s.set(*set));
            Config::load(&source).unwrap()
        };
        let dir = |sets: &[&str]| run_dir(&config(sets));
        assert_eq!(dir(&["run.name=walk"]), Path::new("runs/walk"));
        assert_eq!(dir(&["cluster.run_id=a.b"]), Path::new("runs/a.b"));
        assert_eq!(dir(&["cluster.run_dir=/data/x"]), Path::new("/data/x"));
    }

    #[test]
    fn others_are_told_a_name_that_leads_here() {
        let host = caudata_actor::host_name().unwrap();
        assert_eq!(with_own_name("quic/0.0.0.0:7447"), format!("quic/{host}:7447"));
        assert_eq!(with_own_name("quic/learner:7447"), "quic/learner:7447");
        assert!(joining("quic/0.0.0.0:7447").starts_with("actors of other hosts join"));
        assert!(joining("tcp/127.0.0.1:7447").starts_with("more actors of this host join"));
        assert!(joining("tcp/127.0.0.1:0").starts_with("no other actors can join"));
    }
}
