//! From measured logs to a policy for the robot as it is: diagnose, train in the extended model from the
//! policy that the robot has, evaluate before and after.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use caudata_config::{Config, ConfigArgs};
use caudata_evaluation::{Suite, SuiteResult};
use caudata_gap::Report;
use caudata_gap::check::run_names;
use caudata_gap::report::{Cause, Parameter, Verdict};
use caudata_runlog::{meta_file, rows_file};
use caudata_telemetry::{ExitCode, Failure, FailureExt};
use clap::Args;
use serde::{Deserialize, Serialize};

use crate::out_folder::{self, Asked, OutFolder};
use crate::policies::Run;
use crate::steps::{Steps, Test, Training};
use crate::{diagnosis, files, flags};

/// Share of the episodes that a new policy may fall in more often: less than that is chance.
const FALLS_TOLERANCE: f64 = 0.01;
/// Errors of velocity that nobody would notice, added to each before they are compared: forward and sideways
/// m/s, turning rad/s. Without them a hair's breadth more in what was nearly right outweighs much less in
/// what was not.
const UNNOTICED: [f64; 3] = [0.005, 0.005, 0.01];
/// Share of the error before, mean of the three axes, that may be left: less gain than that is chance.
const LEFT_AT_MOST: f64 = 0.95;
/// No axis may get worse than this many times.
const WORSE_AT_MOST: f64 = 1.25;
/// Verdicts of a diagnosis whose extended model is worth training in.
const WORTH_IT: [Verdict; 3] = [Verdict::Explained, Verdict::Ambiguous, Verdict::PartlyExplained];
/// Keys that flags and the diagnosis set.
const OWN_KEYS: [&str; 2] = ["robot", "run.iterations"];

/// What to adapt to what.
#[derive(Clone, Debug, Args)]
pub struct Plan {
    /// Logs of the robot: folders, files of rows with their circumstances beside them, or folders of such
    #[arg(long = "log", value_name = "LOG", required = true, num_args = 1..)]
    pub logs: Vec<PathBuf>,
    /// Logs that diagnosis is only judged on
    #[arg(long = "holdout", value_name = "LOG", num_args = 1..)]
    pub holdouts: Vec<PathBuf>,
    /// The policy that the robot has
    #[arg(long, value_name = "P.onnx")]
    pub policy: PathBuf,
    /// Folder for everything that is made: diagnosis, run, evaluations, adapt.json. What is finished in it is
    /// not done again: the same command goes on where it was stopped
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Effects that the diagnosis does not try, by id
    #[arg(long, value_name = "ID")]
    pub without: Vec<String>,
    /// Only these effects are tried, by id
    #[arg(long, value_name = "ID")]
    pub only: Vec<String>,
    /// Robot file of the robot that the logs come from, where it is known (a simulated robot): both policies
    /// are evaluated on it as well
    #[arg(long, value_name = "R.robot.toml")]
    pub truth: Option<PathBuf>,
    /// Iterations of training
    #[arg(long, default_value_t = 600, value_parser = clap::value_parser!(u64).range(1..=10_000_000))]
    pub iterations: u64,
    /// Suite of the evaluations: omni has commands in all directions
    #[arg(long, default_value = "omni", value_parser = flags::suite_parser())]
    pub suite: Suite,
    /// Episodes of each scenario
    #[arg(long, default_value_t = 64, value_parser = clap::value_parser!(u32).range(1..=100_000))]
    pub episodes: u32,
    /// How the policy was trained; without these flags config.toml beside the policy, else the preset flat
    #[command(flatten)]
    pub config: ConfigArgs,
}

/// `adapt.json`.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Adapted {
    /// Verdict of the diagnosis.
    pub verdict: Verdict,
    /// Effects it names.
    pub causes: Vec<Named>,
    /// Whether a policy was trained: not where nothing was found.
    pub trained: bool,
    /// The policy as it was, in the model as it was.
    pub before_in_nominal: Option<SuiteResult>,
    /// The policy as it was, in the extended model.
    pub before_in_extended: Option<SuiteResult>,
    /// The new policy, in the extended model.
    pub after_in_extended: Option<SuiteResult>,
    /// The policy as it was, on the robot that the logs come from, where that is known.
    pub before_in_truth: Option<SuiteResult>,
    /// The new policy there.
    pub after_in_truth: Option<SuiteResult>,
    /// Whether the new policy is the better one in the extended model; otherwise it is not published.
    pub better: Option<bool>,
    /// The new policy.
    pub policy: Option<PathBuf>,
    /// Version under which the server has it.
    pub published: Option<u64>,
    /// Wall time of each step of this call, s.
    pub seconds: Vec<(String, f64)>,
}

/// A cause in brief.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Named {
    /// Effect id.
    pub effect: String,
    /// Joints or links; empty: the whole robot.
    #[serde(rename = "where")]
    pub location: Vec<String>,
    /// By name.
    pub parameters: BTreeMap<String, Parameter>,
    /// That it is this effect.
    pub confidence: f64,
}

impl From<&Cause> for Named {
    fn from(cause: &Cause) -> Self {
        Self {
            effect: cause.effect.clone(),
            location: cause.location.clone(),
            parameters: cause.parameters.clone(),
            confidence: cause.confidence,
        }
    }
}

/// Publishes the policy file at a path, and gives its version.
pub type Publish<'a> = &'a dyn Fn(&Path) -> Result<u64, Failure>;

/// Adapts as `plan` says, and leaves everything in its output folder. `publish` is called with a new policy
/// that is better, and gives its version.
///
/// # Errors
/// Where a file cannot be read or written, the folder was made with something else or is another process's,
/// or a step fails or is stopped.
pub fn adapt(
    plan: &Plan,
    mut steps: Steps<'_>,
    publish: Option<Publish<'_>>,
) -> Result<Adapted, Failure> {
    let policy = files::policy(&plan.policy)?;
    let flags = flags::or_beside(&plan.config, &plan.policy, "flat");
    let config = flags.load().or_exit(ExitCode::BadConfig)?;
    let robot = config.robot_path();
    let asked = asked(plan, &config, &policy.sha256_hex())?;
    let _taken = OutFolder::take(&plan.out, &asked)?;

    let diagnosis = plan.out.join("diagnosis");
    let report = diagnosed(&mut steps, plan, &robot, &diagnosis)?;
    let mut adapted = Adapted {
        verdict: report.verdict,
        causes: report.causes.iter().map(Named::from).collect(),
        trained: WORTH_IT.contains(&report.verdict) && !report.causes.is_empty(),
        ..Adapted::default()
    };
    if adapted.trained {
        let extended = diagnosis.join(diagnosis::EXTENDED);
        let training = Training {
            flags: &flags,
            robot: &extended,
            start: Some(&plan.policy),
            iterations: plan.iterations,
            seed: None,
            set: &[],
            out: plan.out.join("run"),
            progress: None,
        };
        let new = steps.train("train", &training)?;
        let robots = [robot.as_path(), extended.as_path()];
        evaluate(plan, &config, &mut steps, &new, robots, &mut adapted)?;
        steps.go_on()?;
        if let Some(publish) = publish.filter(|_| adapted.better == Some(true)) {
            adapted.published = Some(publish(&new)?);
        }
        adapted.policy = Some(new);
    }
    adapted.seconds = steps.seconds();
    files::write_json(&plan.out.join("adapt.json"), &adapted)?;
    Ok(adapted)
}

/// Both policies in the model as it was, in the extended one, and on the true robot where that is known.
fn evaluate(
    plan: &Plan,
    config: &Config,
    steps: &mut Steps<'_>,
    new: &Path,
    [robot, extended]: [&Path; 2],
    adapted: &mut Adapted,
) -> Result<(), Failure> {
    let mut evaluate = |name: &str, policy: &Path, robot: &Path| {
        let test = Test { config, policy, robot, suite: plan.suite, episodes: plan.episodes };
        let file = plan.out.join(format!("{name}.json"));
        steps.evaluate(name, &test, &file)
    };
    adapted.before_in_nominal = Some(evaluate("before_in_nominal", &plan.policy, robot)?);
    let before = evaluate("before_in_extended", &plan.policy, extended)?;
    let after = evaluate("after_in_extended", new, extended)?;
    if let Some(truth) = &plan.truth {
        adapted.before_in_truth = Some(evaluate("before_in_truth", &plan.policy, truth)?);
        adapted.after_in_truth = Some(evaluate("after_in_truth", new, truth)?);
    }
    let runs = [&before, &after].map(|result| Run::of(&result.scenarios));
    adapted.better = Some(improves(&runs[0], &runs[1]));
    (adapted.before_in_extended, adapted.after_in_extended) = (Some(before), Some(after));
    Ok(())
}

/// Whether the second of two evaluations of the same suite is the better one: no more falls (a hundredth of
/// the episodes, all told), and less off the commanded velocity: the errors forward, sideways and in turning,
/// root mean square over all scenarios, as shares of those before, come to at most [`LEFT_AT_MOST`] in the
/// mean, none to more than [`WORSE_AT_MOST`].
fn improves(old: &Run, new: &Run) -> bool {
    let left = |axis: usize| (new.off[axis] + UNNOTICED[axis]) / (old.off[axis] + UNNOTICED[axis]);
    let left = [0, 1, 2].map(left);
    let mean = left.iter().sum::<f64>() / 3.0;
    new.fall_share <= old.fall_share + FALLS_TOLERANCE
        && mean <= LEFT_AT_MOST
        && left.iter().all(|share| *share <= WORSE_AT_MOST)
}

/// The report of the diagnosis, which is not made again where it is complete.
fn diagnosed(
    steps: &mut Steps<'_>,
    plan: &Plan,
    robot: &Path,
    out: &Path,
) -> Result<Report, Failure> {
    let report = out.join(diagnosis::REPORT);
    if report.is_file() {
        steps.is_there("diagnose", &report);
        return files::read_json(&report);
    }
    let plan = diagnosis::Plan {
        robot: robot.to_owned(),
        logs: plan.logs.clone(),
        holdouts: plan.holdouts.clone(),
        out: out.to_owned(),
        without: plan.without.clone(),
        only: plan.only.clone(),
        threads: None,
        seed: 1,
        budget: None,
    };
    steps.diagnose("diagnose", &plan)
}

/// All that decides what is made.
///
/// # Errors
/// Where a robot or a log cannot be read.
fn asked(plan: &Plan, config: &Config, policy: &str) -> Result<Asked, Failure> {
    let ids = |all: &[String]| if all.is_empty() { "none".to_owned() } else { all.join(" ") };
    let truth = match &plan.truth {
        Some(truth) => files::robot(truth)?.hash_hex(),
        None => "none".to_owned(),
    };
    let flags = [
        ("--policy", policy.to_owned()),
        ("--robot", files::robot(&config.robot_path())?.hash_hex()),
        ("--truth", truth),
        ("--without", ids(&plan.without)),
        ("--only", ids(&plan.only)),
        ("--iterations", plan.iterations.to_string()),
        ("--suite", plan.suite.name().to_owned()),
        ("--episodes", plan.episodes.to_string()),
    ];
    let mut asked = out_folder::asked(config, &OWN_KEYS, flags);
    for (flag, dirs) in [("--log", &plan.logs), ("--holdout", &plan.holdouts)] {
        let logs = diagnosis::logs_at(dirs)?;
        for ((number, dir), name) in (1..).zip(&logs).zip(run_names(&logs)) {
            let rows = files::sha256(&rows_file(dir))?;
            let about = files::sha256(&meta_file(dir))?;
            asked.insert(format!("{flag} {number}"), format!("{name} {rows} {about}"));
        }
    }
    Ok(asked)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::policies::tests::scenario;

    #[test]
    fn better_is_nearer_to_the_command_without_more_falls() {
        // Scenarios: share of falls, and errors forward and in turning.
        let run = |scenarios: &[(f64, f64, f64)]| {
            let of =
                |&(falls, off, turning): &(f64, f64, f64)| scenario(falls, [off, 0.015, turning]);
            Run::of(&scenarios.iter().map(of).collect::<Vec<_>>())
        };
        let before = run(&[(0.0, 0.045, 0.09), (0.1, 0.045, 0.09)]); // falls 5 %
        let better = |scenarios: &[(f64, f64, f64)]| improves(&before, &run(scenarios));
        // (0.02 + 0.005)/(0.045 + 0.005) = 0.5 forward, 1 sideways, (0.11 + 0.01)/(0.09 + 0.01) = 1.2 in
        // turning: 0.9 in the mean
        assert!(better(&[(0.0, 0.02, 0.11), (0.1, 0.02, 0.11)]));
        // 0.13 in turning: 0.933 in the mean, and 1.4 there
        assert!(!better(&[(0.0, 0.015, 0.13), (0.1, 0.015, 0.13)]));
        // 0.04 forward: 0.9, and 0.967 in the mean: chance
        assert!(!better(&[(0.0, 0.04, 0.09), (0.1, 0.04, 0.09)]));
        assert!(better(&[(0.02, 0.02, 0.09), (0.1, 0.02, 0.09)])); // falls 6 %: chance
        assert!(!better(&[(0.05, 0.02, 0.09), (0.1, 0.02, 0.09)])); // 7.5 %
        // root mean square of 0 and 0.05: 0.0354, so 0.807 forward and 0.936 in the mean; the mean would be
        // less as well at 0 and 0.08, and 0.0566 is not
        assert!(better(&[(0.0, 0.0, 0.09), (0.1, 0.05, 0.09)]));
        assert!(!better(&[(0.0, 0.0, 0.09), (0.1, 0.08, 0.09)]));
        assert!(!improves(&before, &before));
        // What could not be measured is not better.
        assert!(!better(&[(0.0, f64::NAN, 0.09)]) && !better(&[(f64::NAN, 0.0, 0.0)]));
    }
}
