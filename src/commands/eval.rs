//! `caudata eval`: how well a policy walks, in simulation, without exploration noise.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use caudata_actor::build_env;
use caudata_config::{Config, ConfigArgs};
use caudata_env::{EpisodeStats, VecEnv};
use caudata_model::RobotModel;
use caudata_policy::{Inference, PolicyError, PolicyFile};
use caudata_sim::EngineKind;
use caudata_telemetry::{ExitCode, Failure, FailureExt, Process, StopFlag};
use clap::{Args, ValueEnum};
use serde::Serialize;

use crate::commands::robot_model;
use crate::say;

/// Environments stepped together; more do not make the evaluation faster.
const LANES_MAX: u32 = 64;
/// Actor number in the keys of the evaluation's random streams: no actor of a training run has it, so that the
/// episodes are new to the policy.
const EVALUATION_KEY: u64 = u64::MAX;

#[derive(Debug, Args)]
pub struct EvalArgs {
    /// The policy
    #[arg(long, value_name = "P.onnx")]
    policy: PathBuf,
    /// Under what conditions
    #[arg(long, value_enum, default_value_t = Suite::Flat)]
    suite: Suite,
    /// On which engine
    #[arg(long, value_enum, default_value_t = EngineName::Rapier)]
    engine: EngineName,
    /// Episodes; fewer give a wider standard error
    #[arg(long, default_value_t = 16, value_parser = clap::value_parser!(u32).range(1..=100_000))]
    episodes: u32,
    /// Seed of the episodes
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Robot file, instead of the configuration's
    #[arg(long, value_name = "FILE.robot.toml")]
    robot: Option<PathBuf>,
    /// One JSON object on the last line
    #[arg(long)]
    json: bool,
    /// The task; without these flags, the config.toml beside the policy, else the preset `quick`
    #[command(flatten)]
    config: ConfigArgs,
}

/// Conditions of an evaluation.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Suite {
    /// Flat ground, the robot as its file says, no pushes; commands and sensor noise as trained
    Flat,
}

/// The engines, as words on the command line.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum EngineName {
    /// Rapier multibody joints
    Rapier,
}

impl From<EngineName> for EngineKind {
    fn from(name: EngineName) -> Self {
        match name {
            EngineName::Rapier => EngineKind::Rapier,
        }
    }
}

/// A mean and its standard error.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Estimate {
    /// Mean.
    pub mean: f64,
    /// Standard error of the mean; 0 for a single value.
    pub standard_error: f64,
}

impl Estimate {
    /// Mean of the values and its standard error `s/√n`, with `s² = Σ(x − mean)²/(n − 1)`.
    pub fn of(values: impl Iterator<Item = f64>) -> Self {
        let values: Vec<f64> = values.collect();
        let n = values.len() as f64;
        if values.is_empty() {
            return Self::default();
        }
        let mean = values.iter().sum::<f64>() / n;
        if values.len() == 1 {
            return Self {
                mean,
                standard_error: 0.0,
            };
        }
        let squares: f64 = values.iter().map(|x| (x - mean).powi(2)).sum();
        Self {
            mean,
            standard_error: (squares / (n - 1.0) / n).sqrt(),
        }
    }
}

/// What an evaluation found. Means are over episodes.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Evaluation {
    /// Conditions.
    pub suite: Suite,
    /// Episodes.
    pub episodes: usize,
    /// Sum of rewards.
    pub episode_return: Estimate,
    /// Length, control steps.
    pub episode_steps: Estimate,
    /// Episodes that ended by failing, per reason.
    pub falls: BTreeMap<&'static str, usize>,
    /// Share of episodes that ended by failing.
    pub fall_share: f64,
    /// Horizontal speed of the whole body, m/s.
    pub speed_mps: Estimate,
    /// Distance between commanded and actual horizontal velocity, m/s.
    pub velocity_error_mps: Estimate,
    /// Σ|q̇τ|, W.
    pub power_w: Estimate,
    /// Share of steps with anything but the feet on the ground.
    pub trunk_contact_share: f64,
    /// Share of time that a foot is on the ground.
    pub duty_factor: f64,
    /// Horizontal speed of feet on the ground, m/s.
    pub slip_mps: f64,
    /// Version of the policy.
    pub policy_version: u64,
    /// SHA-256 of the policy's bytes, hex.
    pub policy_sha256: String,
}

pub fn run(args: &EvalArgs, process: &Process) -> Result<(), Failure> {
    let policy = read_policy(&args.policy)?;
    let mut config = configuration(args)?;
    config.engine.kind = args.engine.into();
    config.run.seed = args.seed;
    if let Some(robot) = &args.robot {
        config.robot.clone_from(robot);
    }
    let model = Arc::new(robot_model::load(&config.robot_path())?);
    let evaluation = evaluate(
        &config,
        model,
        &policy,
        args.suite,
        args.episodes,
        &process.stop,
    )?;
    if args.json {
        return say::json(&evaluation);
    }
    print(&evaluation);
    Ok(())
}

/// The flags' configuration, else the one of the run that the policy came from, else `quick`.
fn configuration(args: &EvalArgs) -> Result<Config, Failure> {
    let mut flags = args.config.clone();
    let beside = args.policy.with_file_name("config.toml");
    if flags.preset.is_none() && flags.config.is_none() {
        match beside.exists() {
            true => flags.config = Some(beside),
            false => flags.preset = Some("quick".into()),
        }
    }
    flags.load().or_exit(ExitCode::BadConfig)
}

/// Reads and checks a policy file.
pub fn read_policy(path: &Path) -> Result<PolicyFile, Failure> {
    let bytes = std::fs::read(path).or_exit_with(ExitCode::NoInput, || {
        format!("cannot read policy {}", path.display())
    })?;
    PolicyFile::parse(bytes.into())
        .or_exit_with(ExitCode::BadInput, || format!("policy {}", path.display()))
}

/// Runs the mean of the policy for `episodes` episodes (rounded up to whole rounds of all lanes).
///
/// Every lane contributes the same number of episodes, its first ones: taking episodes as they end would favour short
/// ones.
pub fn evaluate(
    config: &Config,
    model: Arc<RobotModel>,
    policy: &PolicyFile,
    suite: Suite,
    episodes: u32,
    stop: &StopFlag,
) -> Result<Evaluation, Failure> {
    let lanes = episodes.clamp(1, LANES_MAX);
    let per_lane = episodes.div_ceil(lanes).max(1) as usize;
    let config = under_suite(config, suite, lanes);
    let mut env = build_env(&config, model, EVALUATION_KEY).map_err(|e| e.into_failure())?;
    let differences = policy.check_runs_on(env.contract()).map_err(refused)?;
    for difference in differences {
        tracing::warn!("the policy was trained with another {}", difference.name());
    }
    let mut inference = Inference::new(policy, 1).or_exit(ExitCode::BadInput)?;
    let stats = run_episodes(&mut env, &mut inference, per_lane, stop)?;
    Ok(summarise(suite, policy, &stats))
}

fn refused(error: PolicyError) -> Failure {
    Failure::new(ExitCode::PolicyRefused, error).hint(
        "evaluate with the robot file and the [task] section that the policy was trained with",
    )
}

fn under_suite(config: &Config, suite: Suite, lanes: u32) -> Config {
    let mut config = config.clone();
    config.actors.lanes = lanes;
    config.actors.threads = std::thread::available_parallelism()
        .map_or(1, |n| n.get() as u32)
        .min(lanes);
    config.task.stagger_first_episode = false;
    match suite {
        Suite::Flat => {
            config.terrain = caudata_sim::TerrainConfig::default();
            config.task.randomisation.enabled = false;
            config.task.push.enabled = false;
        }
    }
    config
}

fn run_episodes(
    env: &mut VecEnv,
    inference: &mut Inference,
    per_lane: usize,
    stop: &StopFlag,
) -> Result<Vec<EpisodeStats>, Failure> {
    let lanes = env.lanes();
    let mut actions = vec![0.0; lanes * env.act_dim()];
    let mut done = vec![0; lanes];
    let mut stats = Vec::with_capacity(lanes * per_lane);
    env.reset_all().or_exit(ExitCode::Internal)?;
    while stats.len() < lanes * per_lane {
        if let Some(reason) = stop.reason() {
            return Err(Failure::message(
                ExitCode::TempFail,
                format!("stopped by {reason}"),
            ));
        }
        inference
            .run(env.observations(), lanes, &mut actions)
            .or_exit(ExitCode::Internal)?;
        let output = env.step(&actions).or_exit(ExitCode::Internal)?;
        for episode in &output.episodes {
            let done = &mut done[episode.lane as usize];
            if *done < per_lane {
                *done += 1;
                stats.push(episode.clone());
            }
        }
    }
    Ok(stats)
}

fn summarise(suite: Suite, policy: &PolicyFile, stats: &[EpisodeStats]) -> Evaluation {
    let estimate = |value: fn(&EpisodeStats) -> f32| {
        Estimate::of(stats.iter().map(|episode| f64::from(value(episode))))
    };
    let mut falls = BTreeMap::new();
    for reason in stats.iter().filter_map(|episode| episode.reason) {
        *falls.entry(reason.name()).or_insert(0) += 1;
    }
    let fallen: usize = falls.values().sum();
    Evaluation {
        suite,
        episodes: stats.len(),
        episode_return: estimate(|episode| episode.return_sum),
        episode_steps: estimate(|episode| episode.steps as f32),
        falls,
        fall_share: fallen as f64 / stats.len().max(1) as f64,
        speed_mps: estimate(|episode| episode.mean_speed_mps),
        velocity_error_mps: estimate(|episode| episode.mean_velocity_error_mps),
        power_w: estimate(|episode| episode.mean_power_w),
        trunk_contact_share: estimate(|episode| episode.trunk_contact_share).mean,
        duty_factor: estimate(|episode| episode.duty_factor).mean,
        slip_mps: estimate(|episode| episode.mean_slip_mps).mean,
        policy_version: policy.metadata().version,
        policy_sha256: policy.sha256_hex(),
    }
}

/// The evaluation as lines for a person.
pub fn print(evaluation: &Evaluation) {
    let e = evaluation;
    let pm =
        |x: Estimate, digits: usize| format!("{:.digits$} ± {:.digits$}", x.mean, x.standard_error);
    say::line(format!(
        "evaluation: {} episodes on flat ground, policy version {}, no exploration noise",
        e.episodes, e.policy_version
    ));
    say::line(format!(
        "  return {} over {:.0} steps, falls {:.0} %{}",
        pm(e.episode_return, 2),
        e.episode_steps.mean,
        100.0 * e.fall_share,
        reasons(&e.falls)
    ));
    say::line(format!(
        "  speed {} m/s, off the command by {} m/s",
        pm(e.speed_mps, 3),
        pm(e.velocity_error_mps, 3)
    ));
    say::line(format!(
        "  power {} W, duty factor {:.2}, slip {:.1} cm/s, trunk on the ground {:.1} % of the time",
        pm(e.power_w, 1),
        e.duty_factor,
        100.0 * e.slip_mps,
        100.0 * e.trunk_contact_share
    ));
}

fn reasons(falls: &BTreeMap<&'static str, usize>) -> String {
    if falls.is_empty() {
        return String::new();
    }
    let list: Vec<String> = falls
        .iter()
        .map(|(reason, n)| format!("{reason} {n}"))
        .collect();
    format!(" ({})", list.join(", "))
}

/// An evaluation with nothing in it.
#[cfg(test)]
pub fn example() -> Evaluation {
    Evaluation {
        suite: Suite::Flat,
        episodes: 0,
        episode_return: Estimate::default(),
        episode_steps: Estimate::default(),
        falls: BTreeMap::new(),
        fall_share: 0.0,
        speed_mps: Estimate::default(),
        velocity_error_mps: Estimate::default(),
        power_w: Estimate::default(),
        trunk_contact_share: 0.0,
        duty_factor: 0.0,
        slip_mps: 0.0,
        policy_version: 0,
        policy_sha256: String::new(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn estimates_by_hand() {
        // 1, 2, 6: mean 3, s² = (4 + 1 + 9)/2 = 7, standard error √(7/3) = 1.527525.
        let estimate = Estimate::of([1.0, 2.0, 6.0].into_iter());
        assert_eq!(estimate.mean, 3.0);
        assert!((estimate.standard_error - 1.527_525_231_651_947).abs() < 1e-12);
        let single = Estimate::of([5.0].into_iter());
        assert_eq!((single.mean, single.standard_error), (5.0, 0.0));
    }
}
