//! `caudata bench skill`: how long a training takes, from nothing, until its policy walks.
//!
//! Trains with each seed, publishing often, and afterwards evaluates every published policy in order: the first one that is fast enough and
//! passes every gate of walking gives the time, taken from the start of the command to that policy's arrival on the policy server.

use std::path::Path;
use std::process::{Command, Stdio};
use std::sync::Arc;
use std::time::SystemTime;

use caudata_config::{Config, ConfigArgs};
use caudata_evaluation::{Scenario, Settings, run_scenario};
use caudata_model::RobotModel;
use caudata_policy::PolicyFile;
use caudata_telemetry::{ExitCode, Failure, FailureExt};
use clap::Args;
use serde::Serialize;

use crate::commands::{eval, robot_model};
use crate::say;

#[derive(Debug, Args)]
pub struct SkillBench {
    /// Trainings, with seeds 1, 2, …
    #[arg(long, default_value_t = 5, value_parser = clap::value_parser!(u64).range(1..=1000))]
    seeds: u64,
    /// Forward velocity commanded, m/s
    #[arg(long, default_value_t = 0.3)]
    command_mps: f32,
    /// Forward velocity that counts as walking, m/s
    #[arg(long, default_value_t = 0.2)]
    speed_mps: f64,
    /// Every how many iterations a policy is looked at
    #[arg(long, default_value_t = 10, value_parser = clap::value_parser!(u64).range(1..=100_000))]
    every: u64,
    /// Episodes of 20 s per policy
    #[arg(long, default_value_t = 32, value_parser = clap::value_parser!(u32).range(1..=10_000))]
    episodes: u32,
    /// One JSON object on the last line
    #[arg(long)]
    json: bool,
    /// What is trained; the preset `quick` without these flags
    #[command(flatten)]
    config: ConfigArgs,
}

/// What one training reached.
#[derive(Debug, Serialize)]
struct Skill {
    seed: u64,
    /// Policies that were published.
    policies: usize,
    /// Wall time until one walked, s; null where none did.
    walks_after_s: Option<f64>,
    /// Its environment steps.
    walks_after_env_steps: Option<u64>,
    /// Wall time until one was fast enough, gates or not, s.
    fast_after_s: Option<f64>,
    /// Of the last policy, m/s.
    last_speed_mps: f64,
    /// Gates that the last policy misses.
    last_missed: Vec<&'static str>,
    /// Wall time of the training, s.
    training_s: f64,
}

#[derive(Debug, Serialize)]
struct Finding {
    benchmark: &'static str,
    command_mps: f32,
    speed_mps: f64,
    /// Median over the seeds, those that never walked counting as infinite (null), s.
    median_s: Option<f64>,
    seeds: Vec<Skill>,
}

pub fn run(args: &SkillBench) -> Result<(), Failure> {
    let flags = super::bench::or_quick(&args.config);
    let config = flags.load().or_exit(ExitCode::BadConfig)?;
    let model = Arc::new(robot_model::load(&config.robot_path())?);
    let mut seeds = Vec::new();
    for seed in 1..=args.seeds {
        let skill = one(args, &flags, &config, &model, seed)?;
        if !args.json {
            tell(&skill);
        }
        seeds.push(skill);
    }
    let mut times: Vec<f64> = seeds
        .iter()
        .map(|skill| skill.walks_after_s.unwrap_or(f64::INFINITY))
        .collect();
    times.sort_unstable_by(f64::total_cmp);
    let median_s = times.get(times.len() / 2).copied();
    let finding = Finding {
        benchmark: "skill",
        command_mps: args.command_mps,
        speed_mps: args.speed_mps,
        median_s: median_s.filter(|s| s.is_finite()),
        seeds,
    };
    if args.json {
        return say::json(&finding);
    }
    match finding.median_s {
        Some(s) => say::line(format_args!(
            "median of {} seeds: walks after {s:.1} s",
            args.seeds
        )),
        None => say::line("most seeds do not walk"),
    }
    Ok(())
}

fn tell(skill: &Skill) {
    let time = |s: Option<f64>| s.map_or("never".to_owned(), |s| format!("after {s:.1} s"));
    let missed = match skill.last_missed.as_slice() {
        [] => "every gate met".to_owned(),
        some => format!("misses {}", some.join(", ")),
    };
    say::line(format_args!(
        "seed {}: walks {}, fast enough {}; at the end ({:.1} s) {:.3} m/s, {missed}",
        skill.seed,
        time(skill.walks_after_s),
        time(skill.fast_after_s),
        skill.training_s,
        skill.last_speed_mps,
    ));
}

fn one(
    args: &SkillBench,
    flags: &ConfigArgs,
    config: &Config,
    model: &Arc<RobotModel>,
    seed: u64,
) -> Result<Skill, Failure> {
    let folder = tempfile::tempdir().or_exit(ExitCode::CannotCreate)?;
    let run = folder.path().join("run");
    let (began, training_s) = train(args, flags, seed, &run)?;
    let scenario = Scenario::walk("skill", [args.command_mps, 0.0, 0.0]);
    let settings = Settings {
        episodes: args.episodes,
        ..Settings::default()
    };
    let mut skill = Skill {
        seed,
        policies: 0,
        walks_after_s: None,
        walks_after_env_steps: None,
        fast_after_s: None,
        last_speed_mps: f64::NAN,
        last_missed: Vec::new(),
        training_s,
    };
    let policies = published(&run.join("registry/blobs"), began)?;
    skill.policies = policies.len();
    for (index, (at_s, policy)) in policies.iter().enumerate() {
        let last = index + 1 == policies.len();
        if skill.walks_after_s.is_some() && !last {
            continue;
        }
        let outcome = run_scenario(config, model, policy, &scenario, &settings, &|| true)
            .or_exit(ExitCode::PolicyRefused)?;
        let speed_mps = outcome.result.vx_mps.mean;
        let gates = outcome.result.gates.as_ref();
        let fast = speed_mps >= args.speed_mps;
        if fast && skill.fast_after_s.is_none() {
            skill.fast_after_s = Some(*at_s);
        }
        if fast && skill.walks_after_s.is_none() && gates.is_some_and(|gates| gates.walks) {
            skill.walks_after_s = Some(*at_s);
            skill.walks_after_env_steps = Some(policy.metadata().env_steps);
        }
        if last {
            skill.last_speed_mps = speed_mps;
            skill.last_missed = gates.map(|gates| gates.missed()).unwrap_or_default();
        }
    }
    Ok(skill)
}

/// Trains into `run`; when the command began, and how long it took, s.
fn train(
    args: &SkillBench,
    flags: &ConfigArgs,
    seed: u64,
    run: &Path,
) -> Result<(SystemTime, f64), Failure> {
    let mut command = Command::new(std::env::current_exe().or_exit(ExitCode::Internal)?);
    command.arg("train").args(super::bench::as_flags(flags));
    command
        .args(["--seed", &seed.to_string(), "--json", "--out"])
        .arg(run);
    for set in [
        &format!("learner.publish_every={}", args.every),
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
        let policy = eval::read_policy(&entry.path())?;
        found.push((after.unwrap_or_default().as_secs_f64(), policy));
    }
    found.sort_by_key(|(_, policy)| policy.metadata().version);
    Ok(found)
}
