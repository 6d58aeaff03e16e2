//! `caudata train`: everything on this machine, started, watched and stopped.

mod accounting;
pub mod backoff;
pub mod children;
mod choose;
pub mod desk;
mod finish;
pub mod folder;
mod fork;
mod robot;
mod start;
pub mod supervise;
pub mod tracker;
pub mod view;
pub mod watched;

use std::path::{Path, PathBuf};
use std::sync::Arc;

use caudata_config::{CHANGES, Changes, Config, ConfigArgs, Source, TransportKind};
use caudata_live::{LivePage, Policy, Show, Training};
use caudata_model::RobotModel;
use caudata_telemetry::{ExitCode, Failure, FailureExt, Process};
use clap::Args;

use crate::commands::config::fits;
use crate::commands::page::PageArgs;
use crate::commands::robot::load as load_robot;
use crate::commands::runs;
use crate::say;
pub use children::Programs;
use desk::Desk;
use folder::RunFolder;
use fork::{Fork, Origin, same_training};
pub use start::{Resume, clear_if_refused};
use supervise::{Plan, Supervisor};
use tracker::{Logger, Tracker};
use view::View;

#[derive(Debug, Args)]
pub struct TrainArgs {
    /// Actors: threads of the learner with inproc, processes otherwise
    #[arg(long, value_name = "N")]
    actors: Option<u32>,
    /// Iterations at which the run ends
    #[arg(long, value_name = "N")]
    iterations: Option<u64>,
    /// How rollouts reach the learner
    #[arg(long, value_enum)]
    transport: Option<TransportKind>,
    /// Seed of everything random
    #[arg(long)]
    seed: Option<u64>,
    /// Run folder; otherwise runs/<time>_<name>
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Go on with the run in DIR (or in --out), or with the newest one
    #[arg(long, value_name = "DIR", num_args = 0..=1)]
    resume: Option<Option<PathBuf>>,
    /// Go on from this checkpoint of the run in --out, for instance iter_000100
    #[arg(long, value_name = "NAME", requires = "out", conflicts_with = "resume")]
    resume_from: Option<String>,
    /// Begin a new run with a checkpoint of another one; settings that may change in a running training
    /// (caudata tune) may be other ones from there on
    #[arg(long, value_name = "RUN@ITERATION", conflicts_with_all = ["resume", "resume_from", "changes", "preset", "config"])]
    from: Option<Origin>,
    /// Make the changes of this record, each after its iteration: changes.toml of a run that is to be repeated
    #[arg(long, value_name = "FILE.toml", conflicts_with_all = ["resume", "resume_from"])]
    changes: Option<PathBuf>,
    /// Hand the run to a tracker, by its Python package and the one of caudata (python3, or CAUDATA_PYTHON)
    #[arg(long, value_enum, value_name = "TRACKER")]
    logger: Option<Logger>,
    /// Events as JSON lines; the last line is the report
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    page: PageArgs,
    /// Without these flags the preset is `quick`; for another robot the one that is made for it, else `walk`
    #[command(flatten)]
    config: ConfigArgs,
}

impl TrainArgs {
    fn resume(&self) -> Resume {
        match &self.resume_from {
            Some(name) => Resume::Named(name.clone()),
            None if self.resume.is_some() => Resume::Latest,
            None => Resume::No,
        }
    }

    /// The run folder that was named.
    fn out(&self) -> Result<Option<&Path>, Failure> {
        match (self.out.as_deref(), self.resume.as_ref().and_then(Option::as_deref)) {
            (Some(out), Some(resumed)) if out != resumed => {
                let message = "--resume and --out name two folders";
                Err(Failure::message(ExitCode::BadConfig, message)
                    .hint("name the run's folder once"))
            }
            (out, resumed) => Ok(out.or(resumed)),
        }
    }
}

pub fn run(args: &TrainArgs, process: &Process) -> Result<(), Failure> {
    let view = View::new(args.json);
    // What is refused must not leave a folder behind.
    let programs = programs()?;
    let (config, folder, resume) = prepare(args, &mut view.wait_for_owner(&process.stop))?;
    let model = Arc::new(load_robot(&config.robot_path())?);
    view.note(&format!("run folder {}", folder.root().display()));
    let plan = Plan {
        resume,
        actors: match config.transport.kind {
            TransportKind::Inproc => 0,
            TransportKind::Iceoryx2 | TransportKind::Zenoh => config.actors.count,
        },
        restart_learner: false,
    };
    let desk = Arc::new(Desk::open(folder.root(), &config)?);
    let page = live_page(args, &config, &model, &folder, &view, &desk);
    let shown = page.as_ref().map(|page| (page, desk.as_ref()));
    let logger = args.logger.map(|logger| (logger, view.clone()));
    let supervisor = Supervisor::start(&programs, &config, &folder, &process.stop, view, plan);
    if let Err(failure) = &supervisor {
        folder.disown(start::is_refusal(failure.code()));
    }
    let supervisor = supervisor?.shown_on(shown);
    let mut tracker = logger.and_then(|(logger, view)| Tracker::beside(&folder, logger, &view));
    let mut outcome = supervisor.watch().inspect_err(|failure| {
        // its log is in the folder
        drop(tracker.take());
        clear_if_refused(&folder, failure);
    })?;
    if outcome.finished.reason != "completed" {
        outcome.stop_server();
        drop(tracker);
        return stopped_early(args, &folder, &outcome);
    }
    let report = finish::evaluate(&config, &folder, model, &mut outcome, &process.stop)
        .map_err(|failure| finish::after_training(failure, &folder))?;
    outcome.stop_server();
    let text = serde_json::to_string_pretty(&report).or_exit(ExitCode::Internal)?;
    folder.write("report.json", text.as_bytes())?;
    drop(tracker);
    if args.json {
        say::json(&report)?;
    } else {
        finish::print(&report);
    }
    report.verdict()
}

/// The page on which the newest policy walks; a training goes on without it.
fn live_page(
    args: &TrainArgs,
    config: &Config,
    model: &Arc<RobotModel>,
    folder: &RunFolder,
    view: &View,
    desk: &Arc<Desk>,
) -> Option<LivePage> {
    let show = Show {
        config: config.clone(),
        model: Arc::clone(model),
        policy: Policy::Newest(folder.policy()),
    };
    let desk = Arc::clone(desk);
    let take = move |set: &[String]| match desk.ask(set) {
        Ok(_) => Ok(()),
        Err(error) => Err(error.to_string()),
    };
    let run = folder.root().to_owned();
    let training = Training {
        take: Box::new(take),
        beside: Box::new(move |other| runs::beside(&run, other).map_err(|why| why.to_string())),
    };
    match args.page.serve(show, Some(training), &|line| view.note(line)) {
        Ok(page) => {
            view.note(&format!("live at {}", page.address()));
            view.note(&format!("change it at {}", page.changing_address()));
            Some(page)
        }
        Err(failure) => {
            view.warn(&format!("there is no live page: {failure}"));
            None
        }
    }
}

/// The programs that a training needs.
///
/// # Errors
/// Where one is missing.
pub fn programs() -> Result<Programs, Failure> {
    let programs = Programs::beside_this_one()?;
    for name in ["caudata-policy-server", "caudata-learner", "caudata-actor", "caudata-robot"] {
        programs.find(name)?;
    }
    Ok(programs)
}

/// The configuration in effect, the run folder that it lies in, and where its learner begins.
fn prepare(
    args: &TrainArgs,
    wait: folder::Wait<'_>,
) -> Result<(Config, RunFolder, Resume), Failure> {
    let mut resume = args.resume();
    let mut before = None;
    let mut config = Config::load(&source(args, None)).or_exit(ExitCode::BadConfig)?;
    let out = args.out()?;
    let mut folder = if args.resume() != Resume::No {
        let folder = RunFolder::reopen(out, &config.run.out_dir, wait)?;
        if !folder.config().is_file() {
            let message = format!("{} is missing", folder.config().display());
            return Err(Failure::message(ExitCode::NoInput, message)
                .hint("a run cannot go on without its configuration"));
        }
        let old = Config::load(&Source::file(&folder.config())).or_exit(ExitCode::BadConfig)?;
        if args.config.preset.is_some() || args.config.config.is_some() {
            // a run goes on with its own: another one that is given must not be passed over in silence
            same_training(&old, &with_absolute_paths(config)?).map_err(|failure| {
                failure.hint("leave --preset and --config out: a run goes on with its own")
            })?;
        }
        config =
            Config::load(&source(args, Some(&folder.config()))).or_exit(ExitCode::BadConfig)?;
        same_training(&old, &config)?;
        before = Some(old);
        folder
    } else if let Some(origin) = &args.from {
        let fork = Fork::read(origin, &source(args, None).overrides)?;
        config = fork.config.clone();
        let folder = RunFolder::create(out, &config.run.out_dir, &config.run.name)?;
        fork.fill(&folder)?;
        resume = Resume::Named(fork.name());
        folder
    } else {
        fits(&config)?;
        let record = args.changes.as_deref().map(|path| record(path, &config));
        let record = record.transpose()?;
        let folder = RunFolder::create(out, &config.run.out_dir, &config.run.name)?;
        if let Some(record) = record {
            folder.write(CHANGES, record.as_bytes())?;
        }
        folder
    };
    config = with_absolute_paths(config)?;
    // What says the same stays as it is: the version that wrote it may be the only one that can go on.
    let text = config.to_toml().or_exit(ExitCode::BadConfig)?;
    match before {
        Some(before) => folder.goes_on((before != config).then_some(&text))?,
        None => folder.write("config.toml", text.as_bytes()).map(drop)?,
    }
    Ok((config, folder, resume))
}

/// A configuration that means the same from any folder.
fn with_absolute_paths(mut config: Config) -> Result<Config, Failure> {
    config.robot = std::path::absolute(config.robot_path()).or_exit(ExitCode::NoInput)?;
    if !config.terrain.map.as_os_str().is_empty() {
        config.terrain.map = std::path::absolute(&config.terrain.map).or_exit(ExitCode::NoInput)?;
    }
    Ok(config)
}

/// A record of changes that fits a configuration, as it is to lie in the run folder.
fn record(path: &Path, config: &Config) -> Result<String, Failure> {
    let found = path.metadata().map(|_| ());
    found.or_exit_with(ExitCode::NoInput, || format!("cannot read {}", path.display()))?;
    let record = Changes::read(path, config).or_exit(ExitCode::BadConfig)?;
    record.to_toml().or_exit(ExitCode::Internal)
}

/// Preset, file and overrides as the flags say; with `resumed`, that file instead of preset and file.
fn source(args: &TrainArgs, resumed: Option<&Path>) -> Source {
    let mut source = match resumed {
        Some(path) => Source { overrides: args.config.assignments(), ..Source::file(path) },
        None => args.config.source(),
    };
    source.or_preset("quick");
    let mut set = |key: &str, value: Option<String>| {
        source.overrides.extend(value.map(|value| format!("{key}={value}")));
    };
    set("actors.count", args.actors.map(|n| n.to_string()));
    set("run.iterations", args.iterations.map(|n| n.to_string()));
    set("run.seed", args.seed.map(|seed| seed.to_string()));
    set("transport.kind", args.transport.map(|kind| kind.name().to_owned()));
    source
}

/// Says where the run stands and how to go on.
fn stopped_early(
    args: &TrainArgs,
    folder: &RunFolder,
    outcome: &supervise::Outcome,
) -> Result<(), Failure> {
    let finished = &outcome.finished;
    let balance = accounting::balance(&finished.actors, &outcome.ledgers);
    if args.json {
        return say::json(&serde_json::json!({
            "stopped": finished.reason,
            "iteration": finished.iteration,
            "checkpoint": finished.checkpoint_path,
            "accounting": balance,
            "folder": folder.root(),
        }));
    }
    say::line(format!(
        "stopped ({}) after iteration {}; go on with: caudata train --resume --out {}",
        finished.reason,
        finished.iteration,
        quoted(folder.root())
    ));
    Ok(())
}

/// A path as a shell takes it.
fn quoted(path: &Path) -> String {
    let path = path.display().to_string();
    let plain = |c: char| c.is_alphanumeric() || "/._-+@:".contains(c);
    match path.chars().all(plain) {
        true => path,
        false => format!("'{}'", path.replace('\'', r"'\''")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::Parser;

    #[derive(Parser)]
    struct Command {
        #[command(flatten)]
        train: TrainArgs,
    }

    fn args(line: &str) -> TrainArgs {
        Command::parse_from(std::iter::once("train").chain(line.split_whitespace())).train
    }

    #[test]
    fn flags_become_overrides_and_quick_is_the_default() {
        let source = source(&args("--actors 3 --transport zenoh --set run.name=a"), None);
        assert_eq!(source.preset.as_deref(), Some("quick"));
        assert_eq!(source.overrides, ["run.name=a", "actors.count=3", "transport.kind=zenoh"]);
    }

    #[test]
    fn a_checkpoint_can_be_named_for_a_run_that_is() {
        assert_eq!(args("").resume(), Resume::No);
        assert_eq!(args("--resume").resume(), Resume::Latest);
        assert_eq!(args("--resume r").out().unwrap(), Some(Path::new("r")));
        assert_eq!(args("--resume --out r").out().unwrap(), Some(Path::new("r")));
        assert!(args("--resume r --out s").out().is_err(), "which of the two?");
        let named = args("--out r --resume-from iter_000004");
        assert_eq!(named.resume(), Resume::Named("iter_000004".into()));
        let refused = |line: &str| Command::try_parse_from(line.split_whitespace()).is_err();
        assert!(refused("train --resume-from iter_000004"), "of which run?");
        assert!(refused("train --out r --resume --resume-from iter_000004"));
    }

    #[test]
    fn a_resumed_run_takes_its_own_configuration_and_the_flags_on_top() {
        let source =
            source(&args("--iterations 9 --preset flat"), Some(Path::new("r/config.toml")));
        assert_eq!((source.preset, source.file), (None, Some("r/config.toml".into())));
        assert_eq!(source.overrides, ["run.iterations=9"]);
    }
}
