//! How long a training takes, from nothing, until its policy walks.
//!
//! Trains with each seed, publishing often, and afterwards evaluates every published policy in order: the
//! first one that is fast enough and passes every gate of walking gives the time, taken from the start of the
//! command to that policy's arrival on the policy server.

use std::path::Path;
use std::process::{Command, Stdio};
use std::sync::Arc;
use std::time::SystemTime;

use caudata_config::{Config, ConfigArgs};
use caudata_evaluation::{Scenario, Settings, run_scenario};
use caudata_model::RobotModel;
use caudata_policy::PolicyFile;
use caudata_studies::{files, flags};
use caudata_telemetry::{ExitCode, Failure, FailureExt};
use clap::Args;
use serde::Serialize;

use crate::measure::median;

/// Which trainings.
#[derive(Clone, Debug, Args)]
pub struct Plan {
    /// Trainings, with seeds one after the other
    #[arg(long, default_value_t = 5, value_parser = clap::value_parser!(u64).range(1..=1000))]
    seeds: u64,
    /// First of the seeds; whoever tunes on some of them judges with others
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u64).range(..=1_000_000))]
    first_seed: u64,
    /// Forward velocity commanded, m/s; without it, evaluation.command_mps
    #[arg(long)]
    command_mps: Option<f32>,
    /// Forward velocity that counts as walking, m/s; without it, two thirds of the command, or what the
    /// gate of speed asks for if that is more
    #[arg(long)]
    speed_mps: Option<f64>,
    /// Every how many iterations a policy is looked at
    #[arg(long, default_value_t = 10, value_parser = clap::value_parser!(u64).range(1..=100_000))]
    every: u64,
    /// Episodes of 20 s per policy
    #[arg(long, default_value_t = 32, value_parser = clap::value_parser!(u32).range(1..=10_000))]
    episodes: u32,
    /// What is trained; the preset `quick` without these flags
    #[command(flatten)]
    config: ConfigArgs,
}

/// What one training reached.
#[derive(Clone, Debug, Serialize)]
pub struct Skill {
    /// Its seed.
    pub seed: u64,
    /// Policies that were published.
    pub policies: usize,
    /// Wall time until one walked, s; null where none did.
    pub walks_after_s: Option<f64>,
    /// Its environment steps.
    pub walks_after_env_steps: Option<u64>,
    /// Wall time until one was fast enough, gates or not, s.
    pub fast_after_s: Option<f64>,
    /// Velocity of the last policy, m/s.
    pub last_speed_mps: f64,
    /// Gates that the last policy misses.
    pub last_missed: Vec<String>,
    /// Wall time of the training, s.
    pub training_s: f64,
}

/// All trainings.
#[derive(Clone, Debug, Serialize)]
pub struct Finding {
    /// `skill`.
    pub benchmark: &'static str,
    /// Forward velocity commanded, m/s.
    pub command_mps: f32,
    /// Forward velocity that counts as walking, m/s.
    pub speed_mps: f64,
    /// Median over the seeds, those that never walked counting as infinite (null), s.
    pub median_s: Option<f64>,
    /// One per seed.
    pub seeds: Vec<Skill>,
}

/// Trains with each seed by `program train`; `tell` hears of each training when its policies have been looked
/// at.
///
/// # Errors
/// Where a training fails or a policy cannot be evaluated.
pub fn run(plan: &Plan, program: &Path, tell: &mut dyn FnMut(&Skill)) -> Result<Finding, Failure> {
    let flags = flags::or_preset(&plan.config, "quick");
    let config = flags.load().or_exit(ExitCode::BadConfig)?;
    let model = Arc::new(files::robot(&config.robot_path())?);
    let judged = &config.evaluation;
    let command_mps = plan.command_mps.unwrap_or(judged.command_mps as f32);
    let share = judged.gates.speed_share.max(2.0 / 3.0);
    let speed_mps = plan.speed_mps.unwrap_or(share * f64::from(command_mps));
    let asked = Asked { command_mps, speed_mps, episodes: plan.episodes };
    let mut seeds = Vec::new();
    for seed in plan.first_seed..plan.first_seed + plan.seeds {
        let folder = tempfile::tempdir().or_exit(ExitCode::CannotCreate)?;
        let run = folder.path().join("run");
        let (began, training_s) = train(plan, program, &flags, seed, &run)?;
        let policies = published(&run.join("registry/blobs"), began)?;
        let mut skill = Skill {
            seed,
            policies: policies.len(),
            walks_after_s: None,
            walks_after_env_steps: None,
            fast_after_s: None,
            last_speed_mps: f64::NAN,
            last_missed: Vec::new(),
            training_s,
        };
        look(&asked, &config, &model, &policies, &mut skill)?;
        tell(&skill);
        seeds.push(skill);
    }
    let never = |skill: &Skill| skill.walks_after_s.unwrap_or(f64::INFINITY);
    Ok(Finding {
        benchmark: "skill",
        command_mps,
        speed_mps,
        median_s: median(seeds.iter().map(never).collect()).filter(|s| s.is_finite()),
        seeds,
    })
}

/// What a policy is asked for.
struct Asked {
    command_mps: f32,
    speed_mps: f64,
    episodes: u32,
}

/// Evaluates policies in order until one walks, and the last one.
fn look(
    asked: &Asked,
    config: &Config,
    model: &Arc<RobotModel>,
    policies: &[(f64, PolicyFile)],
    skill: &mut Skill,
) -> Result<(), Failure> {
    let scenario = Scenario::walk("skill", [asked.command_mps, 0.0, 0.0]);
    let settings = Settings { episodes: asked.episodes, ..Settings::default() };
    for (index, (at_s, policy)) in policies.iter().enumerate() {
        let last = index + 1 == policies.len();
        if skill.walks_after_s.is_some() && !last {
            continue;
        }
        let outcome = run_scenario(config, model, policy, &scenario, &settings, &|| true)
            .or_exit(ExitCode::PolicyRefused)?;
        let speed_mps = outcome.result.vx_mps.mean;
        let gates = outcome.result.gates.as_ref();
        let fast = speed_mps >= asked.speed_mps;
        if fast && skill.fast_after_s.is_none() {
            skill.fast_after_s = Some(*at_s);
        }
        if fast && skill.walks_after_s.is_none() && gates.is_some_and(|gates| gates.walks) {
            skill.walks_after_s = Some(*at_s);
            skill.walks_after_env_steps = Some(policy.metadata().env_steps);
        }
        if last {
            skill.last_speed_mps = speed_mps;
            let missed = gates.map_or_else(Vec::new, |gates| gates.missed());
            skill.last_missed = missed.into_iter().map(str::to_owned).collect();
        }
    }
    Ok(())
}

/// Trains into `run`; when the command began, and how long it took, s.
fn train(
    plan: &Plan,
    program: &Path,
    flags: &ConfigArgs,
    seed: u64,
    run: &Path,
) -> Result<(SystemTime, f64), Failure> {
    let mut command = Command::new(program);
    command.arg("train").args(flags::as_words(flags));
    command.args(["--seed", &seed.to_string(), "--json", "--out"]).arg(run);
    for set in [
        &format!("learner.publish_every={}", plan.every),
        "policy_server.keep_versions=100000",
        "evaluation.episodes=0",
        "evaluation.robot_run_s=0",
    ] {
        command.args(["--set", set]);
    }
    let began = SystemTime::now();
    let status = command
        .stdout(Stdio::null())
        .stderr(Stdio::inherit())
        .status()
        .or_exit(ExitCode::OsResource)?;
    let took = began.elapsed().unwrap_or_default().as_secs_f64();
    if !status.success() {
        let message = format!("the training with seed {seed} ended with {status}");
        return Err(Failure::message(ExitCode::Internal, message));
    }
    Ok((began, took))
}

/// Every published policy with its arrival after `began`, s, oldest first.
fn published(blobs: &Path, began: SystemTime) -> Result<Vec<(f64, PolicyFile)>, Failure> {
    let mut found = Vec::new();
    for entry in std::fs::read_dir(blobs).or_exit(ExitCode::NoInput)? {
        let entry = entry.or_exit(ExitCode::NoInput)?;
        let arrived = entry.metadata().and_then(|m| m.modified());
        let after = arrived.or_exit(ExitCode::NoInput)?.duration_since(began);
        let policy = files::policy(&entry.path())?;
        found.push((after.unwrap_or_default().as_secs_f64(), policy));
    }
    found.sort_by_key(|(_, policy)| policy.metadata().version);
    Ok(found)
}
