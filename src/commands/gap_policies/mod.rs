//! `caudata gap policies`: what an extended model is worth to a policy.
//!
//! The same training, with the same seeds and the same number of samples, in the model as given, in the extended one, and in the model as given with wide
//! randomisation; all policies are run on the robot that the extended model was made for, which is known where it is simulated.

mod asked;
mod figures;
mod show;
mod speed;
mod wide;
mod work;

use std::path::{Path, PathBuf};
use std::sync::Arc;

use caudata_config::{Config, ConfigArgs};
use caudata_evaluation::Suite;
use caudata_gap::page;
use caudata_model::RobotModel;
use caudata_task::PolicyContract;
use caudata_telemetry::{ExitCode, Failure, FailureExt, Process};
use clap::Args;
use serde::Serialize;
use serde_json::Value;

use super::eval::{read_policy, suite_parser};
use super::out_folder::{OutFolder, write_whole};
use super::robot_model;
use super::steps::Steps;
use super::train;
use crate::say;
use figures::{Figures, Run};
pub use show::{chapter, tables};
use speed::{Speed, Walks};
use work::Work;

#[derive(Debug, Args)]
pub struct PoliciesArgs {
    /// Robot file as given, without the extension
    #[arg(long, value_name = "R.robot.toml")]
    robot: PathBuf,
    /// Extended robot file (`extended.robot.toml` of a diagnosis)
    #[arg(long, value_name = "R.robot.toml")]
    extended: PathBuf,
    /// Robot file of the robot that the policies are for, known because it is simulated
    #[arg(long, value_name = "R.robot.toml")]
    truth: PathBuf,
    /// Folder for runs, evaluations, policies.json and policies.html. What is finished in it is not done again: the same command goes on where it was stopped,
    /// and takes more seeds
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    #[command(flatten)]
    effort: Effort,
    /// One JSON object on the last line
    #[arg(long)]
    json: bool,
    /// How policies are trained; without these flags the preset flat
    #[command(flatten)]
    config: ConfigArgs,
}

/// How much is trained and tested.
#[derive(Clone, Debug, Args)]
pub struct Effort {
    /// Trainings of each kind, with seeds 1, 2, …; intervals are over them
    #[arg(long, value_name = "N", default_value_t = 3, value_parser = clap::value_parser!(u64).range(1..=100))]
    seeds: u64,
    /// Iterations of each training
    #[arg(long, default_value_t = 1000, value_parser = clap::value_parser!(u64).range(1..=10_000_000))]
    iterations: u64,
    /// Policy that every training begins with; without it, from nothing
    #[arg(long, value_name = "P.onnx")]
    policy: Option<PathBuf>,
    /// Suite of the evaluations: omni has commands in all directions
    #[arg(long, default_value = "omni", value_parser = suite_parser())]
    suite: Suite,
    /// Episodes of each scenario; omni has one for each of its 75 commands at least
    #[arg(long, default_value_t = 75, value_parser = clap::value_parser!(u32).range(1..=100_000))]
    episodes: u32,
    /// Episodes of each policy on Rapier, a hundred times slower, with forward velocities that change
    #[arg(long, default_value_t = 8, value_parser = clap::value_parser!(u32).range(1..=10_000))]
    referee_episodes: u32,
    /// Trains in the true robot's model as well: what could be had
    #[arg(long)]
    oracle: bool,
}

/// The three robots.
#[derive(Clone, Copy, Debug)]
pub struct Robots<'a> {
    /// As given.
    pub given: &'a Path,
    /// Extended.
    pub extended: &'a Path,
    /// True.
    pub truth: &'a Path,
}

/// A way to train.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Way {
    /// In the model as given.
    AsGiven,
    /// In the extended model.
    Extended,
    /// In the model as given, with wide randomisation.
    Wide,
    /// In the true robot's model.
    Truth,
}

impl Way {
    fn name(self) -> &'static str {
        match self {
            Self::AsGiven => "as_given",
            Self::Extended => "extended",
            Self::Wide => "wide",
            Self::Truth => "truth",
        }
    }

    fn robot<'a>(self, robots: &Robots<'a>) -> &'a Path {
        match self {
            Self::AsGiven | Self::Wide => robots.given,
            Self::Extended => robots.extended,
            Self::Truth => robots.truth,
        }
    }

    /// Keys that are set for it, on top of `config`.
    fn set(self, config: &Config) -> Result<Vec<String>, Failure> {
        match self {
            Self::Wide => wide::keys(config),
            _ => Ok(Vec::new()),
        }
    }
}

/// `policies.json`.
#[derive(Debug, Serialize)]
pub struct Compared {
    /// Trainings of each kind that are there, and iterations of each.
    seeds: u64,
    iterations: u64,
    /// Suite of the evaluations.
    suite: String,
    /// One entry per way to train; the first is the model as given.
    ways: Vec<Trained>,
    /// Wall time of each step of this call, s.
    seconds: Vec<(String, f64)>,
}

impl Compared {
    /// What the policies amount to that are there: of each of `kinds` one per seed, the same seeds of all.
    fn of(work: &Work<'_>, kinds: &[Way], sets: &[Vec<String>], made: &[Vec<Policy>]) -> Self {
        let runs: Vec<Vec<Runs>> = made
            .iter()
            .map(|policies| policies.iter().map(|p| p.runs).collect())
            .collect();
        let each = kinds.iter().zip(sets).zip(made).enumerate();
        let ways = each.map(|(k, ((way, set), made))| {
            let of = |pick: &dyn Fn(&Runs) -> Run| runs[k].iter().map(pick).collect::<Vec<_>>();
            let given = |pick: &dyn Fn(&Runs) -> Run| runs[0].iter().map(pick).collect::<Vec<_>>();
            let less = |pick: &dyn Fn(&Runs) -> Run| {
                (k > 0).then(|| Figures::less(&of(pick), &given(pick)))
            };
            Trained {
                way: *way,
                robot: way.robot(work.robots).to_owned(),
                set: set.clone(),
                at_home: Figures::of(&of(&|r| r.at_home)),
                in_truth: Figures::of(&of(&|r| r.in_truth)),
                in_rapier: Figures::of(&of(&|r| r.in_rapier)),
                gain: less(&|r| r.in_truth),
                gain_in_rapier: less(&|r| r.in_rapier),
                speed: Speed::of(made.iter().map(|p| &p.walks)),
                policies: made.clone(),
            }
        });
        Self {
            seeds: made.first().map_or(0, |policies| policies.len() as u64),
            iterations: work.effort.iterations,
            suite: work.effort.suite.name().to_owned(),
            ways: ways.collect(),
            seconds: work.steps.seconds(),
        }
    }
}

/// A way to train, and what came of it.
#[derive(Debug, Serialize)]
struct Trained {
    way: Way,
    /// Robot file that it was trained in.
    robot: PathBuf,
    /// Keys that were set for it.
    set: Vec<String>,
    /// One per seed.
    policies: Vec<Policy>,
    /// In the model that it was trained in (of wide randomisation: in the middle of it).
    at_home: Figures,
    /// On the true robot.
    in_truth: Figures,
    /// On the true robot in Rapier, forward velocities that change.
    in_rapier: Figures,
    /// What it has less of on the true robot than what was trained in the model as given; null for that.
    gain: Option<Figures>,
    /// The same in Rapier.
    gain_in_rapier: Option<Figures>,
    /// Forward velocity over time in Rapier.
    speed: Speed,
}

/// One training.
#[derive(Clone, Debug, Serialize)]
struct Policy {
    seed: u64,
    /// Its file.
    policy: PathBuf,
    /// `caudata eval --json` in the model that it was trained in, and on the true robot.
    at_home: Value,
    in_truth: Value,
    /// A scenario of `caudata eval --json` on the true robot in Rapier.
    in_rapier: Value,
    #[serde(skip)]
    runs: Runs,
    #[serde(skip)]
    walks: Walks,
}

/// What one policy did.
#[derive(Clone, Copy, Debug, Default)]
struct Runs {
    at_home: Run,
    in_truth: Run,
    in_rapier: Run,
}

pub fn run(args: &PoliciesArgs, process: &Process) -> Result<(), Failure> {
    let robots = Robots {
        given: &args.robot,
        extended: &args.extended,
        truth: &args.truth,
    };
    let mut steps = Steps::new(args.json, &process.stop);
    steps.after_stop("the same command goes on from here");
    let given = Given::read(&args.effort, &args.config)?;
    let compared = compare(&robots, &args.out, &args.effort, &given, steps)?;
    if args.json {
        return say::json(&compared);
    }
    tables(&compared);
    let file = args.out.join(PAGE);
    say::line(format_args!("pictures   {}", file.display()));
    Ok(())
}

/// The page of a comparison.
const PAGE: &str = "policies.html";

/// What is trained with, read and checked.
pub struct Given {
    flags: ConfigArgs,
    config: Config,
    /// SHA-256 of the policy that every training begins with.
    start: Option<String>,
}

impl Given {
    /// Reads what the flags name. The preset is flat without them.
    ///
    /// # Errors
    /// Where something is missing or wrong: before anything is made.
    pub fn read(effort: &Effort, config: &ConfigArgs) -> Result<Self, Failure> {
        let mut flags = config.clone();
        if flags.preset.is_none() && flags.config.is_none() {
            flags.preset = Some("flat".into());
        }
        let config = flags.load().or_exit(ExitCode::BadConfig)?;
        train::programs()?;
        let start = effort.policy.clone().or_else(|| config.warm_start_path());
        let start = match start {
            Some(policy) => Some(read_policy(&policy)?.sha256_hex()),
            None => None,
        };
        Ok(Self {
            flags,
            config,
            start,
        })
    }
}

/// Trains and tests, and leaves everything in `out`, `policies.json` and `policies.html` among it, which hold the seeds that are complete. What is finished in
/// `out` is taken up.
///
/// # Errors
/// Where a file cannot be read or written, the robots have not the same joints, `out` was made with something else or another process is at work in it, or a step
/// fails or is stopped.
pub fn compare(
    robots: &Robots<'_>,
    out: &Path,
    effort: &Effort,
    given: &Given,
    steps: Steps,
) -> Result<Compared, Failure> {
    let models = same_joints(robots, &given.config)?;
    let kinds: &[Way] = match effort.oracle {
        true => &[Way::AsGiven, Way::Extended, Way::Wide, Way::Truth],
        false => &[Way::AsGiven, Way::Extended, Way::Wide],
    };
    let sets = kinds.iter().map(|way| way.set(&given.config));
    let sets = sets.collect::<Result<Vec<_>, _>>()?;
    let asked = asked::all(effort, given, &models);
    let _taken = OutFolder::take(out, &asked)?;
    let mut work = Work {
        robots,
        out,
        effort,
        given,
        truth: &models[2],
        steps,
    };
    let mut made: Vec<Vec<Policy>> = kinds.iter().map(|_| Vec::new()).collect();
    let mut last = None;
    // Seed by seed, so that what is there when somebody stops it can be compared.
    for seed in 1..=effort.seeds {
        for ((way, set), policies) in kinds.iter().zip(&sets).zip(&mut made) {
            policies.push(work.policy(*way, set, seed)?);
        }
        let compared = Compared::of(&work, kinds, &sets, &made);
        let bytes = serde_json::to_vec_pretty(&compared).or_exit(ExitCode::Internal)?;
        write_whole(&out.join("policies.json"), &bytes)?;
        let title = "Policies trained in two models, run on the robot";
        let html = page::curves(title, "", &[], &[chapter(&compared)]);
        write_whole(&out.join(PAGE), html.as_bytes())?;
        last = Some(compared);
    }
    last.ok_or_else(|| Failure::message(ExitCode::BadConfig, "no seed is asked for"))
}

/// The models of the three robots, which the same policies must run on.
fn same_joints(robots: &Robots<'_>, config: &Config) -> Result<[Arc<RobotModel>; 3], Failure> {
    let of = |file: &Path| -> Result<(Arc<RobotModel>, PolicyContract), Failure> {
        let model = robot_model::load(file)?;
        let unfit = || format!("robot {}", file.display());
        let contract =
            PolicyContract::new(&model, &config.task).or_exit_with(ExitCode::BadInput, unfit)?;
        Ok((Arc::new(model), contract))
    };
    let (given, wanted) = of(robots.given)?;
    let same = |file: &Path| -> Result<Arc<RobotModel>, Failure> {
        let (model, contract) = of(file)?;
        let differences = wanted.differences(&contract);
        match differences.iter().find(|d| d.is_breaking()) {
            None => Ok(model),
            Some(difference) => {
                let message = format!(
                    "a policy trained in {} cannot run on {}: another {}",
                    robots.given.display(),
                    file.display(),
                    difference.name()
                );
                Err(Failure::message(ExitCode::PolicyRefused, message)
                    .hint("the three robot files must be of one robot"))
            }
        }
    };
    Ok([given, same(robots.extended)?, same(robots.truth)?])
}
