//! `caudata gap policies`: what an extended model is worth to a policy.
//!
//! The same training, with the same seeds and the same number of samples, in the model as given, in the extended one, and in the model as given with wide
//! randomisation; all policies are run on the robot that the extended model was made for, which is known where it is simulated.

mod asked;
mod figures;
mod show;

use std::path::{Path, PathBuf};
use std::sync::Arc;

use caudata_config::{Config, ConfigArgs};
use caudata_evaluation::{Leg, Order, Outcome, Scenario, Settings, Suite, run_scenario};
use caudata_gap::page;
use caudata_model::RobotModel;
use caudata_sim::EngineKind;
use caudata_task::PolicyContract;
use caudata_telemetry::{ExitCode, Failure, FailureExt, Process};
use clap::Args;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::eval::{self, read_policy, suite_parser};
use super::robot_model;
use super::steps::{Steps, Test, Training, last_json};
use super::train;
use crate::say;
use figures::{Figures, Run};
pub use show::{chapter, tables};

/// Plain wide randomisation: what one does who knows that the robot differs and not how. The ranges hold a robot with servos of half their torque, a lag of
/// 50 ms, half or twice as much of what is hardest to measure; what the model has no parameter for (play that the file does not have) they cannot hold.
/// Keys of `task.randomisation`, and their ranges at least: where the configuration's own reach further, they stay.
const WIDE: [(&str, f64, f64); 14] = [
    ("foot_friction_scale", 0.4, 1.5),
    ("body_friction_scale", 0.4, 1.6),
    ("total_mass_scale", 0.8, 1.3),
    ("link_mass_scale", 0.8, 1.2),
    ("com_offset_m", -0.01, 0.01), // m
    ("joint_friction_scale", 0.0, 4.0),
    ("armature_scale", 0.5, 2.0),
    ("damping_scale", 0.3, 3.0),
    ("kp_scale", 0.5, 1.3),
    ("kd_scale", 0.5, 2.0),
    ("torque_scale", 0.5, 1.0),
    ("supply_scale", 0.75, 1.05),
    ("command_delay_s", 0.0, 0.05), // s
    ("backlash_scale", 0.0, 2.0),
];
/// Forward velocities that are asked for in turn, m/s, each for [`LEG_S`]: what the picture of velocity tracking shows.
const FORWARD_MPS: [f32; 5] = [0.1, 0.2, 0.3, 0.4, 0.2];
const LEG_S: f64 = 4.0;

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
            Self::Wide => wide(config),
            _ => Ok(Vec::new()),
        }
    }
}

/// [`WIDE`] as keys, each as far as `config` reaches, if that is further.
fn wide(config: &Config) -> Result<Vec<String>, Failure> {
    let entries = config.entries();
    let mut set = vec!["task.randomisation.enabled=true".to_owned()];
    for (key, low, high) in WIDE {
        let key = format!("task.randomisation.{key}");
        let found = entries.iter().find(|(name, _)| *name == key);
        let range = found.and_then(|(_, range)| serde_json::from_str::<[f64; 2]>(range).ok());
        let [own_low, own_high] = range
            .ok_or_else(|| Failure::message(ExitCode::Internal, format!("{key} is not a range")))?;
        let (low, high) = (low.min(own_low), high.max(own_high));
        set.push(format!("{key}=[{low:?},{high:?}]"));
    }
    Ok(set)
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

/// `NAME_in_rapier.json`: a policy with forward velocities that change.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
struct Walks {
    /// A scenario of `caudata eval --json`.
    result: Value,
    /// Time between two values, s.
    period_s: f64,
    /// Commanded and achieved forward velocity of each episode, m/s.
    episodes: Vec<Vec<[f32; 2]>>,
}

impl Walks {
    fn of(outcome: &Outcome) -> Result<Self, Failure> {
        let forward = |row: &[f32; 6]| [row[0], row[3]];
        let tracks = outcome.tracks.iter();
        Ok(Self {
            result: serde_json::to_value(&outcome.result).or_exit(ExitCode::Internal)?,
            period_s: outcome.period_s,
            episodes: tracks
                .map(|track| track.rows.iter().map(forward).collect())
                .collect(),
        })
    }
}

/// What one policy did.
#[derive(Clone, Copy, Debug, Default)]
struct Runs {
    at_home: Run,
    in_truth: Run,
    in_rapier: Run,
}

/// Forward velocity over time, over the episodes of all trainings of a way; each is averaged over a stride of 0.7 s, since a trunk that bends sways.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Speed {
    /// s.
    time_s: Vec<f64>,
    /// What was asked for, m/s.
    command_mps: Vec<f64>,
    /// Mean, m/s.
    mean_mps: Vec<f64>,
    /// Standard deviation, m/s.
    sd_mps: Vec<f64>,
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
        let start = match &effort.policy {
            Some(policy) => Some(read_policy(policy)?.sha256_hex()),
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
/// Where a file cannot be read or written, the robots have not the same joints, `out` was made with other flags, or a step fails or is stopped.
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
    std::fs::create_dir_all(out).or_exit_with(ExitCode::CannotCreate, || {
        format!("folder {}", out.display())
    })?;
    asked::same_as_before(out, &asked::all(effort, given, &models))?;
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
        let compared = work.compared(kinds, &sets, &made, seed);
        let bytes = serde_json::to_vec_pretty(&compared).or_exit(ExitCode::Internal)?;
        write(&out.join("policies.json"), &bytes)?;
        let title = "Policies trained in two models, run on the robot";
        let html = page::curves(title, "", &[], &[chapter(&compared)]);
        write(&out.join(PAGE), html.as_bytes())?;
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

/// Writes a file whole: one that is there is complete.
fn write(path: &Path, bytes: &[u8]) -> Result<(), Failure> {
    let cannot = || format!("cannot write {}", path.display());
    caudata_durable::replace(path, bytes).or_exit_with(ExitCode::CannotCreate, cannot)
}

/// What all trainings share.
struct Work<'a> {
    robots: &'a Robots<'a>,
    out: &'a Path,
    effort: &'a Effort,
    given: &'a Given,
    truth: &'a Arc<RobotModel>,
    steps: Steps,
}

impl Work<'_> {
    /// What the policies of the first `seeds` seeds amount to.
    fn compared(
        &self,
        kinds: &[Way],
        sets: &[Vec<String>],
        made: &[Vec<Policy>],
        seeds: u64,
    ) -> Compared {
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
                robot: way.robot(self.robots).to_owned(),
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
        Compared {
            seeds,
            iterations: self.effort.iterations,
            suite: self.effort.suite.name().to_owned(),
            ways: ways.collect(),
            seconds: self.steps.seconds(),
        }
    }

    /// Trains one policy and tests it, as far as that has not been done.
    fn policy(&mut self, way: Way, set: &[String], seed: u64) -> Result<Policy, Failure> {
        self.steps.go_on()?;
        let name = format!("{}_{seed}", way.name());
        let home = way.robot(self.robots);
        let training = Training {
            flags: &self.given.flags,
            robot: home,
            start: self.effort.policy.as_deref(),
            iterations: self.effort.iterations,
            seed: Some(seed),
            set,
            out: self.out.join(&name),
            progress: Some(self.out.join(format!("{name}.log"))),
        };
        let step = format!("train {name}");
        let policy = match training.finished() {
            Some(policy) => {
                self.steps.is_there(&step, &policy);
                policy
            }
            None => self.steps.train(&step, &training)?,
        };
        let at_home = self.evaluate(&format!("{name}_at_home"), &policy, home)?;
        let in_truth = self.evaluate(&format!("{name}_in_truth"), &policy, self.robots.truth)?;
        let walks = self.forward(&name, &policy)?;
        let in_rapier = serde_json::json!({ "scenarios": [&walks.result] });
        let read = |evaluation: &Value| {
            let lacks = || {
                Failure::message(
                    ExitCode::Internal,
                    format!("the evaluation of {name} lacks figures"),
                )
            };
            Run::of(evaluation).ok_or_else(lacks)
        };
        Ok(Policy {
            seed,
            runs: Runs {
                at_home: read(&at_home)?,
                in_truth: read(&in_truth)?,
                in_rapier: read(&in_rapier)?,
            },
            policy,
            at_home,
            in_truth,
            in_rapier: walks.result.clone(),
            walks,
        })
    }

    fn evaluate(&mut self, name: &str, policy: &Path, robot: &Path) -> Result<Value, Failure> {
        let test = Test {
            flags: &self.given.flags,
            policy,
            robot,
            suite: self.effort.suite,
            episodes: self.effort.episodes,
        };
        let file = self.out.join(format!("{name}.json"));
        let step = format!("evaluate {name}");
        if file.is_file() {
            self.steps.is_there(&step, &file);
            return last_json(&file);
        }
        self.steps.evaluate(&step, &test, &file)
    }

    /// Forward velocities that change, on the true robot, in the engine that policies are not trained in.
    fn forward(&mut self, name: &str, policy: &Path) -> Result<Walks, Failure> {
        let file = self.out.join(format!("{name}_in_rapier.json"));
        let step = format!("evaluate {name}_in_rapier");
        if file.is_file() {
            self.steps.is_there(&step, &file);
            return last_json(&file);
        }
        let mut config = self.given.config.clone();
        config.robot = std::path::absolute(self.robots.truth).or_exit(ExitCode::NoInput)?;
        config.engine.kind = EngineKind::Rapier;
        let policy = read_policy(policy)?;
        let settings = Settings {
            episodes: self.effort.referee_episodes,
            episode_s: LEG_S * FORWARD_MPS.len() as f64,
            film: true, // keeps velocities
            ..Settings::default()
        };
        let what = format!(
            "{} episodes of {} s in Rapier, forward velocities that change",
            settings.episodes, settings.episode_s
        );
        let truth = self.truth;
        let outcome = self.steps.inside(&step, &what, |stop| {
            let go_on = || !stop.is_set();
            run_scenario(&config, truth, &policy, &forward(), &settings, &go_on)
                .map_err(|error| eval::failure(error, stop))
        })?;
        let walks = Walks::of(&outcome)?;
        write(
            &file,
            &serde_json::to_vec(&walks).or_exit(ExitCode::Internal)?,
        )?;
        Ok(walks)
    }
}

fn forward() -> Scenario {
    let leg = |(i, vx): (usize, &f32)| Leg {
        from_s: LEG_S * i as f64,
        order: Order::Command([*vx, 0.0, 0.0]),
    };
    Scenario {
        course: FORWARD_MPS.iter().enumerate().map(leg).collect(),
        judged: false,
        film: None,
        ..Scenario::walk("forward velocities that change", [FORWARD_MPS[0], 0.0, 0.0])
    }
}

impl Speed {
    /// Of the episodes of all of them; where some have ended, of those that go on.
    fn of<'a>(all: impl Iterator<Item = &'a Walks>) -> Self {
        const STRIDE_S: f64 = 0.7;
        let mut speed = Self::default();
        let mut tracks: Vec<Vec<f64>> = Vec::new();
        let mut period_s = 0.0;
        for walks in all {
            period_s = walks.period_s;
            let half = (0.5 * STRIDE_S / period_s) as usize;
            for rows in &walks.episodes {
                if rows.len() > speed.command_mps.len() {
                    speed.command_mps = rows.iter().map(|row| f64::from(row[0])).collect();
                }
                let forward: Vec<f64> = rows.iter().map(|row| f64::from(row[1])).collect();
                tracks.push(smooth(&forward, half));
            }
        }
        for k in 0..speed.command_mps.len() {
            let there: Vec<f64> = tracks.iter().filter_map(|t| t.get(k).copied()).collect();
            let n = there.len().max(1) as f64;
            let mean = there.iter().sum::<f64>() / n;
            let square = there.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / n;
            speed.time_s.push(k as f64 * period_s);
            speed.mean_mps.push(mean);
            speed.sd_mps.push(square.sqrt());
        }
        speed
    }
}

impl Speed {
    /// Commanded velocities, each once, and what was achieved in the second half of their time, m/s.
    fn held(&self) -> (Vec<f64>, Vec<f64>) {
        let mut wanted: Vec<f64> = self.command_mps.clone();
        wanted.sort_unstable_by(f64::total_cmp);
        wanted.dedup();
        let mut held = Vec::new();
        wanted.retain(|command| {
            let late = |k: &usize| {
                self.command_mps[*k] == *command && self.time_s[*k] % LEG_S >= 0.5 * LEG_S
            };
            let there: Vec<usize> = (0..self.command_mps.len()).filter(late).collect();
            let sum: f64 = there.iter().map(|&k| self.mean_mps[k]).sum();
            if !there.is_empty() {
                held.push(sum / there.len() as f64);
            }
            !there.is_empty()
        });
        (wanted, held)
    }
}

/// Means over `half` values on each side, fewer at the ends.
fn smooth(values: &[f64], half: usize) -> Vec<f64> {
    let mean = |k: usize| {
        let near = &values[k.saturating_sub(half)..(k + half + 1).min(values.len())];
        near.iter().sum::<f64>() / near.len() as f64
    };
    (0..values.len()).map(mean).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn smoothing_by_hand() {
        assert_eq!(smooth(&[0.0, 3.0, 6.0, 0.0], 1), [1.5, 3.0, 3.0, 3.0]);
        assert_eq!(smooth(&[], 3), [0.0; 0]);
    }

    #[test]
    fn what_is_achieved_is_read_late() {
        let speed = Speed {
            time_s: vec![0.0, 2.5, 4.5, 7.0, 8.5],
            command_mps: vec![0.2, 0.2, 0.1, 0.1, 0.3],
            mean_mps: vec![0.0, 0.18, 0.15, 0.11, 0.2],
            sd_mps: vec![0.0; 5],
        };
        // 0.3 m/s: only its beginning is there
        assert_eq!(speed.held(), (vec![0.1, 0.2], vec![0.11, 0.18]));
    }

    fn loaded(preset: &str, overrides: &[String]) -> Config {
        let flags = ConfigArgs {
            preset: Some(preset.into()),
            config: None,
            overrides: overrides.to_vec(),
        };
        flags.load().unwrap()
    }

    #[test]
    fn wide_ranges_are_keys_and_hold_those_of_the_presets() {
        for preset in caudata_config::PRESETS {
            let preset = preset.name;
            let narrow = loaded(preset, &[]);
            let wide = loaded(preset, &wide(&narrow).unwrap());
            let table = |config: &Config| serde_json::to_value(config.task.randomisation).unwrap();
            let (narrow, wide) = (table(&narrow), table(&wide));
            let mut ranges = 0;
            for (key, range) in narrow.as_object().unwrap() {
                let Some(range) = range.as_array() else {
                    continue;
                };
                ranges += 1;
                let end = |of: &serde_json::Value, i: usize| of[key][i].as_f64().unwrap();
                let held = end(&wide, 0) <= range[0].as_f64().unwrap()
                    && end(&wide, 1) >= range[1].as_f64().unwrap();
                assert!(held && wide[key] != narrow[key], "{preset} {key}");
                // A preset never reaches further than the ranges that are documented.
                let (_, low, high) = WIDE.iter().find(|(name, ..)| name == key).unwrap();
                let near = |i: usize, x: f64| (end(&wide, i) - x).abs() < 1e-6;
                assert!(near(0, *low) && near(1, *high), "{preset} {key}");
            }
            assert_eq!(ranges, WIDE.len());
        }
    }

    #[test]
    fn a_range_that_is_wider_already_stays() {
        let own = [
            "task.randomisation.kp_scale=[0.3,1.1]".to_owned(),
            "task.randomisation.enabled=false".to_owned(),
        ];
        let narrow = loaded("flat", &own);
        let mut all = own.to_vec();
        all.extend(wide(&narrow).unwrap());
        let wide = loaded("flat", &all).task.randomisation;
        assert_eq!(wide.kp_scale, [0.3, 1.3]);
        assert_eq!(wide.kd_scale, [0.5, 2.0]);
        assert!(wide.enabled);
    }
}
