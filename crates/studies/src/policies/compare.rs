//! The comparison, seed by seed.

use std::path::Path;
use std::sync::Arc;

use caudata_config::Config;
use caudata_gap::page;
use caudata_model::RobotModel;
use caudata_task::PolicyContract;
use caudata_telemetry::{ExitCode, Failure, FailureExt};

use super::chapter::chapter;
use super::results::{Compared, Policy};
use super::ways::{Effort, Given, Robots, Way};
use super::work::Work;
use crate::out_folder::{self, Asked, OutFolder};
use crate::{Steps, files};

/// The page of a comparison.
pub const PAGE: &str = "policies.html";
/// Keys that every training sets for itself.
const SET_BY_EACH: [&str; 3] = ["robot", "run.seed", "run.iterations"];

/// Trains and tests, and leaves everything in `out`, `policies.json` and `policies.html` among it, which hold
/// the seeds that are complete. What is finished in `out` is taken up.
///
/// # Errors
/// Where a file cannot be read or written, the robots have not the same joints, `out` was made with something
/// else or another process is at work in it, or a step fails or is stopped.
pub fn compare(
    robots: &Robots,
    out: &Path,
    effort: &Effort,
    given: &Given,
    steps: Steps<'_>,
) -> Result<Compared, Failure> {
    let models = same_joints(robots, &given.config)?;
    let kinds: &[Way] = match effort.oracle {
        true => &[Way::AsGiven, Way::Extended, Way::Wide, Way::Truth],
        false => &[Way::AsGiven, Way::Extended, Way::Wide],
    };
    let sets = kinds.iter().map(|way| way.set(&given.config));
    let sets = sets.collect::<Result<Vec<_>, _>>()?;
    let asked = asked(effort, given, &models);
    let _taken = OutFolder::take(out, &asked)?;
    let mut work = Work { robots, out, effort, given, truth: &models[2], steps };
    let mut made: Vec<Vec<Policy>> = kinds.iter().map(|_| Vec::new()).collect();
    let mut last = None;
    // Seed by seed, so that what is there when somebody stops it can be compared.
    for seed in 1..=effort.seeds {
        for ((way, set), policies) in kinds.iter().zip(&sets).zip(&mut made) {
            policies.push(work.policy(*way, set, seed)?);
        }
        let compared = Compared {
            seconds: work.steps.seconds(),
            ..Compared::of(robots, effort, kinds, &sets, &made)
        };
        files::write_json(&out.join("policies.json"), &compared)?;
        let title = "Policies trained in two models, run on the robot";
        let html = page::curves(title, "", &[], &[chapter(&compared)]);
        files::write_whole(&out.join(PAGE), html.as_bytes())?;
        last = Some(compared);
    }
    last.ok_or_else(|| Failure::message(ExitCode::BadConfig, "no seed is asked for"))
}

/// All that decides what one training and its evaluations come to; not how many there are.
fn asked(effort: &Effort, given: &Given, models: &[Arc<RobotModel>; 3]) -> Asked {
    let [robot, extended, truth] = models.each_ref().map(|model| model.hash_hex());
    let flags = [
        ("--robot", robot),
        ("--extended", extended),
        ("--truth", truth),
        ("--policy", given.start.clone().unwrap_or("none".to_owned())),
        ("--iterations", effort.iterations.to_string()),
        ("--suite", effort.suite.name().to_owned()),
        ("--episodes", effort.episodes.to_string()),
        ("--referee-episodes", effort.referee_episodes.to_string()),
    ];
    out_folder::asked(&given.config, &SET_BY_EACH, flags)
}

/// The models of the three robots, which the same policies must run on.
fn same_joints(robots: &Robots, config: &Config) -> Result<[Arc<RobotModel>; 3], Failure> {
    let of = |file: &Path| -> Result<(Arc<RobotModel>, PolicyContract), Failure> {
        let model = files::robot(file)?;
        let unfit = || format!("robot {}", file.display());
        let contract =
            PolicyContract::new(&model, &config.task).or_exit_with(ExitCode::BadInput, unfit)?;
        Ok((Arc::new(model), contract))
    };
    let (given, wanted) = of(&robots.given)?;
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
    Ok([given, same(&robots.extended)?, same(&robots.truth)?])
}
