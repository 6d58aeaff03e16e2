//! `caudata bench explain`: how well an explanation finds a mistake that was hidden in a task or a robot.
//!
//! Each case is drawn from its seed: a robot, a mistake (or none), its size, and harmless changes around it.
//! It is trained, and `caudata explain` looks at the run folder in a process of its own. What was hidden is
//! written nowhere before that has answered.

mod catalogue;

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use caudata_config::{Config, Source};
use caudata_explain::Trainer;
use caudata_model::RobotModel;
use caudata_studies::files;
use caudata_task::observation::ObservationTerm;
use caudata_task::reward::own::{OwnCondition, OwnTerm};
use caudata_telemetry::{ExitCode, Failure, FailureExt, StopFlag};
use clap::Args;
use serde::Serialize;
use serde_json::Value;

use catalogue::{Change, Draw, MISTAKES};

/// Robots, by the preset that trains them.
const ROBOTS: [&str; 4] = ["quick", "quadruped", "hexapod", "biped"];
/// Every how many seeds a case is healthy.
const HEALTHY_EVERY: u64 = 4;
/// Iterations that a case is trained for: healthy ones walk after 120.
const ITERATIONS: u64 = 180;
/// Longest that the training of a case may take, s.
const TRAINING_S: u64 = 1800;

/// Which cases, and how long each may take.
#[derive(Clone, Debug, Args)]
pub struct Plan {
    /// Seeds of the cases, `A..B` without B or separated by commas; every fourth is a healthy task
    #[arg(long, value_name = "SEEDS", default_value = "1..9", value_parser = seeds)]
    seeds: Seeds,
    /// Longest time of each explanation, s
    #[arg(long, value_name = "SECONDS", default_value_t = 120.0)]
    budget: f64,
    /// Only mistakes whose name contains this word
    #[arg(long, value_name = "WORD", default_value = "", hide_default_value = true)]
    only: String,
    /// Leave run folders and reports in this folder; default: a temporary one
    #[arg(long, value_name = "DIR")]
    keep: Option<PathBuf>,
}

/// Seeds of cases.
#[derive(Clone, Debug, PartialEq)]
pub struct Seeds(Vec<u64>);

fn seeds(text: &str) -> Result<Seeds, String> {
    let number = |word: &str| word.trim().parse::<u64>().map_err(|e| format!("`{word}`: {e}"));
    let all = match text.split_once("..") {
        Some((from, to)) => (number(from)?..number(to)?).collect(),
        None => text.split(',').map(number).collect::<Result<Vec<u64>, _>>()?,
    };
    match all.len() {
        1..=10_000 => Ok(Seeds(all)),
        _ => Err("must be 1 to 10000 seeds".to_owned()),
    }
}

/// How one case went.
#[derive(Clone, Debug, Serialize)]
pub struct Outcome {
    /// Its seed.
    pub seed: u64,
    /// Preset of its robot.
    pub robot: &'static str,
    /// The mistake that was hidden; null: a healthy task.
    pub hidden: Option<&'static str>,
    /// Places any of which names it.
    pub places: Vec<String>,
    /// Verdict of the explanation, or why there is none.
    pub verdict: String,
    /// Places that it names, the first cause first; then those of its suspects.
    pub named: Vec<Vec<String>>,
    /// How many of these are causes.
    pub causes: usize,
    /// Share of what was asked that the run's policy did, 0 to 1.
    pub score: f64,
    /// Wall time of the explanation, s.
    pub seconds: f64,
}

impl Outcome {
    /// Place of what was hidden among what is named, from 0.
    fn rank(&self) -> Option<usize> {
        let right = |names: &Vec<String>| names.iter().any(|name| self.places.contains(name));
        self.named.iter().position(right)
    }

    /// Whether the mistake kept it from walking.
    fn harms(&self) -> bool {
        self.hidden.is_some() && self.verdict != "walks"
    }

    /// The mistake was named as the cause, first.
    pub fn first(&self) -> bool {
        self.causes > 0 && self.rank() == Some(0)
    }

    /// A cause was named, and it was not the mistake.
    pub fn wrong(&self) -> bool {
        self.causes > 0 && self.rank().is_none_or(|rank| rank >= self.causes)
    }
}

/// All cases.
#[derive(Clone, Debug, Serialize)]
pub struct Finding {
    /// Cases with a mistake that kept the robot from walking.
    pub mistakes: usize,
    /// Mistakes that were named as the cause, first.
    pub first: usize,
    /// Mistakes among the first three that are named or suspected.
    pub among_three: usize,
    /// Mistakes where another cause was named.
    pub wrong: usize,
    /// Mistakes with which the robot walks all the same; not counted above.
    pub harmless: usize,
    /// Healthy tasks.
    pub healthy: usize,
    /// Healthy tasks in which a cause was named.
    pub false_names: usize,
    /// Median wall time of an explanation of a run that does not walk, s.
    pub median_s: Option<f64>,
    /// One per case.
    pub outcomes: Vec<Outcome>,
}

/// Makes each case, has it explained by `program` and `learner`, and opens the answer; `tell` hears of each.
///
/// # Errors
/// Where a folder cannot be written or a case cannot be trained; an explanation that fails is an outcome.
pub fn run(
    plan: &Plan,
    program: &Path,
    learner: &Path,
    tell: &mut dyn FnMut(&Outcome),
) -> Result<Finding, Failure> {
    let temporary = tempfile::tempdir().or_exit(ExitCode::CannotCreate)?;
    let root = plan.keep.as_deref().unwrap_or(temporary.path());
    let mut outcomes = Vec::new();
    for &seed in &plan.seeds.0 {
        let Some((mut outcome, config)) =
            case(seed, &plan.only, &root.join(format!("robot {seed}")))?
        else {
            continue;
        };
        let folder = root.join(format!("case {seed}"));
        let trainer = Trainer {
            learner: learner.to_owned(),
            stop: StopFlag::new(),
            until: Instant::now() + Duration::from_secs(TRAINING_S),
        };
        match trainer.train(&config, &folder) {
            Ok(_) => explained(&mut outcome, plan, program, &folder)?,
            Err(failure) => outcome.verdict = format!("not trained: {failure}"),
        }
        tell(&outcome);
        outcomes.push(outcome);
    }
    Ok(sum(outcomes))
}

/// Has a run folder explained by a process of its own.
fn explained(
    outcome: &mut Outcome,
    plan: &Plan,
    program: &Path,
    folder: &Path,
) -> Result<(), Failure> {
    let answer = Command::new(program)
        .arg("explain")
        .arg(folder)
        .args(["--json", "--budget", &plan.budget.to_string()])
        .stderr(Stdio::null())
        .output()
        .or_exit(ExitCode::OsResource)?;
    let text = String::from_utf8_lossy(&answer.stdout);
    let report: Value =
        text.lines().last().and_then(|l| serde_json::from_str(l).ok()).unwrap_or_default();
    if plan.keep.is_some() {
        files::write_json(&folder.join("explained.json"), &report)?;
    }
    let places = |list: &str| -> Vec<Vec<String>> {
        let of =
            |cause: &Value| serde_json::from_value(cause["places"].clone()).unwrap_or_default();
        report[list].as_array().into_iter().flatten().map(of).collect()
    };
    outcome.verdict = report["verdict"].as_str().unwrap_or("no report").to_owned();
    outcome.named = places("causes");
    outcome.causes = outcome.named.len();
    outcome.named.extend(places("others"));
    outcome.score = report["behaviour"]["score"].as_f64().unwrap_or(f64::NAN);
    outcome.seconds = report["seconds"].as_f64().unwrap_or(f64::NAN);
    Ok(())
}

/// The case of a seed and what is hidden in it; robot files that are changed go into `folder`. `None` where its
/// mistake is not among those that are wanted.
fn case(seed: u64, only: &str, folder: &Path) -> Result<Option<(Outcome, Config)>, Failure> {
    let robot = ROBOTS[(seed / HEALTHY_EVERY % ROBOTS.len() as u64) as usize];
    let reference = Config::load(&Source::preset(robot)).or_exit(ExitCode::BadConfig)?;
    let path = std::path::absolute(reference.robot_path()).or_exit(ExitCode::NoInput)?;
    let model = files::robot(&path)?;
    let mut draw = Draw::new(seed, &reference, &model);
    let mut which = draw.stream.below(MISTAKES.len() as u64) as usize;
    if !only.is_empty() {
        let wanted = |i: &usize| MISTAKES[*i].0.contains(only);
        let some: Vec<usize> = (0..MISTAKES.len()).filter(wanted).collect();
        which = *some.get(seed as usize % some.len().max(1)).unwrap_or(&which);
    }
    let (name, make) = MISTAKES[which];
    let hidden = !seed.is_multiple_of(HEALTHY_EVERY);
    let mistake = if hidden { make(&mut draw) } else { Some(Change::default()) };
    let Some(mistake) = mistake else { return Ok(None) };
    let mut changes = draw.harmless(&mistake.places);
    let places = mistake.places.clone();
    changes.push(mistake);
    let config = configured(robot, &path, &changes, seed, folder)?;
    let outcome = Outcome {
        seed,
        robot,
        hidden: hidden.then_some(name),
        places,
        verdict: String::new(),
        named: Vec::new(),
        causes: 0,
        score: f64::NAN,
        seconds: f64::NAN,
    };
    Ok(Some((outcome, config)))
}

/// The configuration with all changes.
fn configured(
    preset: &str,
    robot: &Path,
    changes: &[Change],
    seed: u64,
    folder: &Path,
) -> Result<Config, Failure> {
    let source = Source {
        preset: Some(preset.to_owned()),
        file: None,
        overrides: changes.iter().flat_map(|change| change.sets.clone()).collect(),
    };
    let mut config = Config::load(&source).or_exit(ExitCode::BadConfig)?;
    (config.run.seed, config.run.iterations) = (seed, ITERATIONS);
    robot.clone_into(&mut config.robot);
    for change in changes {
        if let Some((name, value, weight)) = &change.reward {
            config.task.reward.term.push(OwnTerm {
                name: (*name).to_owned(),
                value: value.clone(),
                weight: *weight as f32,
            });
        }
        if let Some((name, value)) = &change.when {
            config
                .task
                .termination
                .when
                .push(OwnCondition { name: (*name).to_owned(), value: value.clone() });
        }
        for (name, value, noise) in change.observation.iter().flatten() {
            config.learner.network.symmetric = false;
            config.task.observation.term.push(ObservationTerm {
                name: (*name).to_owned(),
                value: (*value).to_owned(),
                history: 0,
                noise_std: *noise as f32,
            });
        }
        if let Some(joint) = &change.reversed {
            config.learner.network.symmetric = false;
            config.robot = reversed(robot, joint, folder)?;
        }
    }
    Ok(config)
}

/// A copy of a robot in `folder`, with a joint that turns the other way round.
fn reversed(robot: &Path, joint: &str, folder: &Path) -> Result<PathBuf, Failure> {
    let model: RobotModel = files::robot(robot)?;
    let text = String::from_utf8(files::read(robot)?).or_exit(ExitCode::BadInput)?;
    let mjcf = robot.with_extension("").with_extension("xml");
    let bytes = String::from_utf8(files::read(&mjcf)?).or_exit(ExitCode::BadInput)?;
    let index = model.joint_index(joint).unwrap_or(0);
    let axis = model.joints()[index].axis.map(|a| -a);
    files::make_folder(folder)?;
    let name = mjcf.file_name().unwrap_or_default();
    let turned = caudata_explain::turned(&bytes, joint, axis);
    files::write_whole(&folder.join(name), turned.as_bytes())?;
    let copy = folder.join("robot.robot.toml");
    files::write_whole(&copy, text.as_bytes())?;
    Ok(copy)
}

fn sum(outcomes: Vec<Outcome>) -> Finding {
    let count = |which: &dyn Fn(&Outcome) -> bool| outcomes.iter().filter(|o| which(o)).count();
    let times = outcomes.iter().filter(|o| o.verdict != "walks").map(|o| o.seconds);
    Finding {
        mistakes: count(&Outcome::harms),
        first: count(&|o| o.harms() && o.first()),
        among_three: count(&|o| o.harms() && o.rank().is_some_and(|rank| rank < 3)),
        wrong: count(&|o| o.harms() && o.wrong()),
        harmless: count(&|o| o.hidden.is_some() && !o.harms()),
        healthy: count(&|o| o.hidden.is_none()),
        false_names: count(&|o| o.hidden.is_none() && o.causes > 0),
        median_s: crate::measure::median(times.filter(|s| s.is_finite()).collect()),
        outcomes,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_named_is_right_where_it_names_the_place() {
        let outcome = |named: &[&str], causes: usize| Outcome {
            seed: 1,
            robot: "quick",
            hidden: Some("power costs too much"),
            places: vec!["task.reward.weights.power".into()],
            verdict: "explained".into(),
            named: named.iter().map(|n| vec![(*n).to_owned()]).collect(),
            causes,
            score: 0.0,
            seconds: 1.0,
        };
        let (power, slip) = ("task.reward.weights.power", "task.reward.weights.slip");
        assert!(outcome(&[power, slip], 1).first());
        assert!(!outcome(&[power, slip], 0).first(), "a suspect is not named");
        assert!(outcome(&[slip, power], 1).wrong());
        let all = sum(vec![outcome(&[slip, power], 1), outcome(&[power], 1)]);
        assert_eq!((all.mistakes, all.first, all.among_three, all.wrong), (2, 1, 2, 1));
    }

    /// Every mistake is among the suspects; most are the first of them before anything has been trained.
    #[test]
    fn every_mistake_is_suspected_before_anything_is_trained() {
        let folder = tempfile::tempdir().unwrap();
        let mut later = Vec::new();
        for (at, (name, _)) in MISTAKES.iter().enumerate() {
            // not a multiple of four: those are healthy
            let seed = 4 * at as u64 + 1;
            let made = case(seed, name, &folder.path().join(format!("robot {seed}")));
            let (outcome, config) = made.unwrap().unwrap();
            let run = folder.path().join(format!("case {seed}"));
            files::make_folder(&run).unwrap();
            std::fs::write(run.join("config.toml"), config.to_toml().unwrap()).unwrap();
            let run = caudata_explain::Run::read(&run).unwrap();
            let suspects = caudata_explain::suspects(&run, &Default::default()).unwrap();
            let right = |key: &String| outcome.places.contains(key);
            let rank = suspects.iter().position(|s| s.keys.iter().any(right));
            let rank = rank.unwrap_or_else(|| panic!("{name} on {}", outcome.robot));
            later.extend(
                (rank > 0).then(|| format!("{name} on {}: {}", outcome.robot, suspects[0].id)),
            );
        }
        assert!(later.len() <= MISTAKES.len() / 10, "{later:?}");
    }

    #[test]
    fn seeds_are_a_range_or_a_list() {
        assert_eq!(seeds("3..6").unwrap(), Seeds(vec![3, 4, 5]));
        assert_eq!(seeds("7,9").unwrap(), Seeds(vec![7, 9]));
        assert!(seeds("6..3").is_err() && seeds("a").is_err());
    }
}
