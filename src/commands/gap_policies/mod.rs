//! `caudata gap policies`: what an extended model is worth to a policy.
//!
//! The same training, with the same seeds and the same number of samples, in the model as given, in the extended one, and in the model as given with wide
//! randomisation; all policies are run on the robot that the extended model was made for, which is known where it is simulated.

mod figures;
mod show;

use std::path::{Path, PathBuf};
use std::sync::Arc;

use caudata_config::{Config, ConfigArgs};
use caudata_evaluation::{Leg, Order, Outcome, Scenario, ScenarioResult, Settings, run_scenario};
use caudata_gap::page;
use caudata_sim::EngineKind;
use caudata_telemetry::{ExitCode, Failure, FailureExt};
use clap::Args;
use serde::Serialize;
use serde_json::Value;

use super::eval::read_policy;
use super::robot_model;
use super::steps::{Steps, Test, Training};
use crate::say;
use figures::{Figures, Run};
pub use show::{chapter, tables};

/// Plain wide randomisation: what one does who knows that the robot differs and not how. The ranges hold a robot with servos of half their torque, a lag of
/// 50 ms, half or twice as much of what is hardest to measure; what the model has no parameter for (play that the file does not have) they cannot hold.
const WIDE: [&str; 15] = [
    "task.randomisation.foot_friction_scale=[0.4,1.5]",
    "task.randomisation.body_friction_scale=[0.4,1.6]",
    "task.randomisation.total_mass_scale=[0.8,1.3]",
    "task.randomisation.link_mass_scale=[0.8,1.2]",
    "task.randomisation.com_offset_m=[-0.01,0.01]",
    "task.randomisation.joint_friction_scale=[0.0,4.0]",
    "task.randomisation.armature_scale=[0.5,2.0]",
    "task.randomisation.damping_scale=[0.3,3.0]",
    "task.randomisation.kp_scale=[0.5,1.3]",
    "task.randomisation.kd_scale=[0.5,2.0]",
    "task.randomisation.torque_scale=[0.5,1.0]",
    "task.randomisation.supply_scale=[0.75,1.05]",
    "task.randomisation.command_delay_s=[0.0,0.05]",
    "task.randomisation.backlash_scale=[0.0,2.0]",
    "task.randomisation.enabled=true",
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
    /// Folder for runs, evaluations, policies.json and policies.html
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
    #[arg(long, default_value = "omni")]
    suite: String,
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

    fn set(self) -> &'static [&'static str] {
        match self {
            Self::Wide => &WIDE,
            _ => &[],
        }
    }
}

/// `policies.json`.
#[derive(Debug, Serialize)]
pub struct Compared {
    /// Trainings of each kind, and iterations of each.
    seeds: u64,
    iterations: u64,
    /// Suite of the evaluations.
    suite: String,
    /// One entry per way to train; the first is the model as given.
    ways: Vec<Trained>,
    /// Wall time of each step, s.
    seconds: Vec<(String, f64)>,
}

/// A way to train, and what came of it.
#[derive(Debug, Serialize)]
struct Trained {
    way: Way,
    /// Robot file that it was trained in.
    robot: PathBuf,
    /// Keys that were set for it.
    set: Vec<&'static str>,
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
#[derive(Debug, Serialize)]
struct Policy {
    seed: u64,
    /// Its file.
    policy: PathBuf,
    /// `caudata eval --json` in the model that it was trained in, and on the true robot.
    at_home: Value,
    in_truth: Value,
    /// A scenario of `caudata eval --json` on the true robot in Rapier.
    in_rapier: ScenarioResult,
    #[serde(skip)]
    runs: Runs,
    #[serde(skip)]
    outcome: Option<Outcome>,
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

pub fn run(args: &PoliciesArgs) -> Result<(), Failure> {
    let robots = Robots {
        given: &args.robot,
        extended: &args.extended,
        truth: &args.truth,
    };
    let compared = compare(&robots, &args.out, &args.effort, &args.config, args.json)?;
    let html = page::curves(
        "Policies trained in two models, run on the robot",
        "",
        &[],
        &[chapter(&compared)],
    );
    let file = args.out.join("policies.html");
    write(&file, html.as_bytes())?;
    if args.json {
        return say::json(&compared);
    }
    tables(&compared);
    say::line(format_args!("pictures   {}", file.display()));
    Ok(())
}

/// Trains and tests, and leaves everything in `out`, `policies.json` among it. `quiet`: nothing is said on the way.
///
/// # Errors
/// Where a file cannot be read or written, or a step fails.
pub fn compare(
    robots: &Robots<'_>,
    out: &Path,
    effort: &Effort,
    config: &ConfigArgs,
    quiet: bool,
) -> Result<Compared, Failure> {
    let mut flags = config.clone();
    if flags.preset.is_none() && flags.config.is_none() {
        flags.preset = Some("flat".into());
    }
    flags.load().or_exit(ExitCode::BadConfig)?;
    for robot in [robots.given, robots.extended, robots.truth] {
        robot_model::load(robot)?;
    }
    if let Some(policy) = &effort.policy {
        read_policy(policy)?;
    }
    std::fs::create_dir_all(out).or_exit_with(ExitCode::CannotCreate, || {
        format!("folder {}", out.display())
    })?;
    let mut work = Work {
        robots,
        out,
        effort,
        flags: &flags,
        steps: Steps::new(quiet),
    };
    let mut kinds = vec![Way::AsGiven, Way::Extended, Way::Wide];
    if effort.oracle {
        kinds.push(Way::Truth);
    }
    let mut made: Vec<Vec<Policy>> = kinds.iter().map(|_| Vec::new()).collect();
    // Seed by seed, so that what is there when somebody stops it can be compared.
    for seed in 1..=effort.seeds {
        for (way, policies) in kinds.iter().zip(&mut made) {
            policies.push(work.policy(*way, seed)?);
        }
    }
    let runs: Vec<Vec<Runs>> = made
        .iter()
        .map(|policies| policies.iter().map(|p| p.runs).collect())
        .collect();
    let ways = kinds.iter().zip(made).enumerate().map(|(k, (way, made))| {
        let of = |pick: &dyn Fn(&Runs) -> Run| runs[k].iter().map(pick).collect::<Vec<_>>();
        let given = |pick: &dyn Fn(&Runs) -> Run| runs[0].iter().map(pick).collect::<Vec<_>>();
        let less =
            |pick: &dyn Fn(&Runs) -> Run| (k > 0).then(|| Figures::less(&of(pick), &given(pick)));
        Trained {
            way: *way,
            robot: way.robot(robots).to_owned(),
            set: way.set().to_vec(),
            at_home: Figures::of(&of(&|r| r.at_home)),
            in_truth: Figures::of(&of(&|r| r.in_truth)),
            in_rapier: Figures::of(&of(&|r| r.in_rapier)),
            gain: less(&|r| r.in_truth),
            gain_in_rapier: less(&|r| r.in_rapier),
            speed: Speed::of(made.iter().filter_map(|p| p.outcome.as_ref())),
            policies: made,
        }
    });
    let compared = Compared {
        seeds: effort.seeds,
        iterations: effort.iterations,
        suite: effort.suite.clone(),
        ways: ways.collect(),
        seconds: work.steps.seconds(),
    };
    let bytes = serde_json::to_vec_pretty(&compared).or_exit(ExitCode::Internal)?;
    write(&out.join("policies.json"), &bytes)?;
    Ok(compared)
}

fn write(path: &Path, bytes: &[u8]) -> Result<(), Failure> {
    std::fs::write(path, bytes).or_exit_with(ExitCode::CannotCreate, || {
        format!("cannot write {}", path.display())
    })
}

/// What all trainings share.
struct Work<'a> {
    robots: &'a Robots<'a>,
    out: &'a Path,
    effort: &'a Effort,
    flags: &'a ConfigArgs,
    steps: Steps,
}

impl Work<'_> {
    /// Trains one policy and tests it.
    fn policy(&mut self, way: Way, seed: u64) -> Result<Policy, Failure> {
        let name = format!("{}_{seed}", way.name());
        let home = way.robot(self.robots);
        let training = Training {
            flags: self.flags,
            robot: home,
            start: self.effort.policy.as_deref(),
            iterations: self.effort.iterations,
            seed: Some(seed),
            set: way.set(),
            out: self.out.join(&name),
            progress: Some(self.out.join(format!("{name}.log"))),
        };
        let policy = self.steps.train(&format!("train {name}"), &training)?;
        let at_home = self.evaluate(&format!("{name}_at_home"), &policy, home)?;
        let in_truth = self.evaluate(&format!("{name}_in_truth"), &policy, self.robots.truth)?;
        let outcome = self.forward(&name, &policy)?;
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
                in_rapier: Run::of_scenario(&outcome.result),
            },
            policy,
            at_home,
            in_truth,
            in_rapier: outcome.result.clone(),
            outcome: Some(outcome),
        })
    }

    fn evaluate(&mut self, name: &str, policy: &Path, robot: &Path) -> Result<Value, Failure> {
        let test = Test {
            flags: self.flags,
            policy,
            robot,
            suite: &self.effort.suite,
            episodes: self.effort.episodes,
        };
        let file = self.out.join(format!("{name}.json"));
        self.steps
            .evaluate(&format!("evaluate {name}"), &test, &file)
    }

    /// Forward velocities that change, on the true robot, in the engine that policies are not trained in.
    fn forward(&self, name: &str, policy: &Path) -> Result<Outcome, Failure> {
        let mut config: Config = self.flags.load().or_exit(ExitCode::BadConfig)?;
        config.robot = std::path::absolute(self.robots.truth).or_exit(ExitCode::NoInput)?;
        config.engine.kind = EngineKind::Rapier;
        let model = Arc::new(robot_model::load(self.robots.truth)?);
        let policy = read_policy(policy)?;
        let settings = Settings {
            episodes: self.effort.referee_episodes,
            episode_s: LEG_S * FORWARD_MPS.len() as f64,
            film: true, // keeps velocities
            ..Settings::default()
        };
        let outcome = run_scenario(&config, &model, &policy, &forward(), &settings, &|| true)
            .or_exit(ExitCode::PolicyRefused)?;
        let text = serde_json::to_vec_pretty(&outcome.result).or_exit(ExitCode::Internal)?;
        write(&self.out.join(format!("{name}_in_rapier.json")), &text)?;
        Ok(outcome)
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
    /// Of the episodes of `outcomes`; where some have ended, of those that go on.
    fn of<'a>(outcomes: impl Iterator<Item = &'a Outcome>) -> Self {
        const STRIDE_S: f64 = 0.7;
        let mut speed = Self::default();
        let mut tracks: Vec<Vec<f64>> = Vec::new();
        let mut period_s = 0.0;
        for outcome in outcomes {
            period_s = outcome.period_s;
            let half = (0.5 * STRIDE_S / period_s) as usize;
            for track in &outcome.tracks {
                if track.rows.len() > speed.command_mps.len() {
                    let commands = track.rows.iter().map(|row| f64::from(row[0]));
                    speed.command_mps = commands.collect();
                }
                let forward: Vec<f64> = track.rows.iter().map(|row| f64::from(row[3])).collect();
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

    #[test]
    fn wide_ranges_are_keys_and_hold_those_of_the_presets() {
        let load = |overrides: &[&str]| {
            let flags = ConfigArgs {
                preset: Some("flat".into()),
                config: None,
                overrides: overrides.iter().map(|s| (*s).to_owned()).collect(),
            };
            let loaded = flags.load().unwrap().task.randomisation;
            serde_json::to_value(loaded).unwrap()
        };
        let (narrow, wide) = (load(&[]), load(&WIDE));
        for (key, range) in narrow.as_object().unwrap() {
            let Some(range) = range.as_array() else {
                continue;
            };
            let end = |of: &serde_json::Value, i: usize| of[key][i].as_f64().unwrap();
            assert!(end(&wide, 0) <= range[0].as_f64().unwrap(), "{key}");
            assert!(end(&wide, 1) >= range[1].as_f64().unwrap(), "{key}");
            assert!(wide[key] != narrow[key], "{key}");
        }
    }
}
