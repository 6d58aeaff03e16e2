//! `caudata bench`: how fast the parts are on this machine. The measuring is in `crates/bench`.

use caudata_bench::transport::ingest;
use caudata_bench::{calibrate, explain, gap, session, sim, skill, train, transport};
use caudata_telemetry::{ExitCode, Failure, FailureExt};
use clap::Subcommand;

use crate::commands::bench_show as show;
use crate::commands::train::Programs;
use crate::say::{self, WithJson};

#[derive(Debug, Subcommand)]
pub enum BenchCommand {
    /// Physics steps per second by engine, scene and lane width, with MuJoCo beside; and environment steps:
    /// physics, task, resets
    Sim(WithJson<sim::Plan>),
    /// Diagnosis against hidden effects: false alarms, power, names, intervals, beside other methods
    Gap {
        #[command(flatten)]
        asked: WithJson<gap::Plan>,
        /// Every case, not only the table
        #[arg(long)]
        each: bool,
    },
    /// How often names with such evidence are right, on robots with laws of their own: from evidence to confidence
    Calibrate(WithJson<calibrate::Plan>),
    /// Sessions with robots that have something hidden: named, after how much motion
    Session(WithJson<session::Plan>),
    /// Mistakes hidden in tasks and robots, explained: named first, among three, names on healthy tasks
    Explain(WithJson<explain::Plan>),
    /// Where a second of training goes: per iteration and as shares of all cores' time; beside another build,
    /// beside other work
    Train(WithJson<train::Plan>),
    /// Trainings from nothing: wall time until the policy walks at a commanded speed with every gate met,
    /// median of seeds
    Skill(WithJson<skill::Plan>),
    /// Rollouts from actors to a learner on this machine, by transport: rate, latency, CPU, beside memcpy and
    /// a bare TCP socket
    Transport(WithJson<transport::Plan>),
    /// Many light actors against one learner: what arrives, how fast it is acknowledged, what it takes
    Ingest(WithJson<ingest::Plan>),
}

pub fn run(command: &BenchCommand) -> Result<(), Failure> {
    let learner = || Programs::beside_this_one()?.find("caudata-learner");
    let actor = || Programs::beside_this_one()?.find("caudata-actor");
    let own = || std::env::current_exe().or_exit(ExitCode::Internal);
    match command {
        BenchCommand::Sim(WithJson { plan, json }) => {
            say::either(*json, &sim::run(plan)?, show::sim)
        }
        BenchCommand::Gap { asked, each } => match gap::run(&asked.plan, &own()?)? {
            Some(found) => say::either(asked.json, &found, |found| show::gap(found, *each)),
            None => Ok(()),
        },
        BenchCommand::Calibrate(WithJson { plan, json }) => {
            let found = calibrate::run(plan, &own()?, &mut told(*json, show::calibrated))?;
            say::either(*json, &found, show::calibration)
        }
        BenchCommand::Session(WithJson { plan, json }) => {
            let found = session::run(plan, &own()?, &mut told(*json, show::session))?;
            say::either(*json, &found, show::sessions)
        }
        BenchCommand::Explain(WithJson { plan, json }) => {
            let found =
                explain::run(plan, &own()?, &learner()?, &mut told(*json, show::explained))?;
            say::either(*json, &found, show::explanations)
        }
        BenchCommand::Train(WithJson { plan, json }) => {
            say::either(*json, &train::run(plan, &learner()?)?, show::train)
        }
        BenchCommand::Skill(WithJson { plan, json }) => {
            let found = skill::run(plan, &own()?, &mut told(*json, show::skill))?;
            say::either(*json, &found, |found| say::record(found, "median_s"))
        }
        BenchCommand::Transport(WithJson { plan, json }) => {
            if transport::serve_if_peer()? {
                return Ok(());
            }
            say::either(*json, &transport::run(plan, &actor)?, show::transport)
        }
        BenchCommand::Ingest(WithJson { plan, json }) => {
            let found = ingest::run(plan)?;
            say::either(*json, &found, show::ingest)?;
            found.verdict(plan)
        }
    }
}

/// Tells a person of each case as it comes.
fn told<T>(json: bool, show: fn(&T)) -> impl FnMut(&T) {
    move |case| {
        if !json {
            show(case);
        }
    }
}
