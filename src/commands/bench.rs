//! `caudata bench`: how fast the parts are on this machine. One number per question, measured for a given time.

use std::ffi::OsString;
use std::sync::Arc;
use std::time::{Duration, Instant};

use caudata_actor::build_env;
use caudata_config::ConfigArgs;
use caudata_policy::{
    Activation, Dense, Inference, MlpSpec, PolicyFile, PolicyMetadata, build_onnx,
};
use caudata_task::{PerJoint, PolicyContract};
use caudata_telemetry::{ExitCode, Failure, FailureExt};
use clap::{Args, Subcommand, ValueEnum};
use serde::Serialize;

use crate::commands::bench_gap::{self, GapBench};
use crate::commands::bench_ingest::{self, IngestBench};
use crate::commands::bench_lag::{self, LagBench};
use crate::commands::bench_learner;
use crate::commands::bench_sim::{self, Plan, SceneName};
use crate::commands::bench_skill::{self, SkillBench};
use crate::commands::bench_transport::{self, TransportBench};
use crate::commands::eval::EngineName;
use crate::commands::robot_model;
use crate::say;

#[derive(Debug, Subcommand)]
pub enum BenchCommand {
    /// Physics steps per second by engine, scene and lane width, with MuJoCo beside; and environment steps: physics, task, resets
    Sim(SimBench),
    /// Inferences per second of a network of the configured size, on ONNX Runtime
    Policy {
        #[command(flatten)]
        common: Common,
        /// Observations per inference
        #[arg(long, default_value_t = 64, value_parser = clap::value_parser!(u32).range(1..=65_536))]
        batch: u32,
        /// Threads
        #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=64))]
        threads: u32,
        /// Network and robot; the preset `quick` without these flags
        #[command(flatten)]
        config: ConfigArgs,
    },
    /// Updates of the learner on made-up data: samples/s, GFLOP/s, and what matrix products reach in the same run
    Learner {
        #[command(flatten)]
        common: Common,
        /// Networks, batch and threads; the preset `quick` without these flags
        #[command(flatten)]
        config: ConfigArgs,
    },
    /// Diagnosis against hidden effects: false alarms, power, names, intervals, beside other methods
    Gap(GapBench),
    /// Trainings from nothing: wall time until the policy walks at a commanded speed with every gate met, median of seeds
    Skill(SkillBench),
    /// Rollouts from actors to a learner on this machine, by transport: rate, latency, CPU, beside memcpy and a bare TCP socket
    Transport(TransportBench),
    /// Many light actors against one learner: what arrives, how fast it is acknowledged, what it takes
    Ingest(IngestBench),
    /// Trainings whose data is a forced number of iterations old: the final return against fresh data, with and without correction
    Lag(LagBench),
}

#[derive(Debug, Args)]
pub struct SimBench {
    #[command(flatten)]
    common: Common,
    /// Environments
    #[arg(long, default_value_t = 64, value_parser = clap::value_parser!(u32).range(1..=65_536))]
    lanes: u32,
    /// Threads of the environment steps; physics is measured on one and on all
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=256))]
    threads: u32,
    /// Engines whose physics is measured; default: all. May be given several times
    #[arg(long, value_enum)]
    engine: Vec<EngineName>,
    /// Scenes; default: all. May be given several times
    #[arg(long, value_enum)]
    scene: Vec<SceneName>,
    /// Lanes per vector register; default 0, the engine's choice. May be given several times
    #[arg(long)]
    lane_width: Vec<u32>,
    /// Environment steps only
    #[arg(long)]
    no_physics: bool,
    /// No MuJoCo beside
    #[arg(long)]
    no_mujoco: bool,
    /// The robot file's drive-line as it is, without delay, low-pass, Stribeck and load-dependent friction, gear play and sag of the supply
    #[arg(long)]
    bare: bool,
    /// Robot, engine, terrain and task; the preset `quick` without these flags
    #[command(flatten)]
    config: ConfigArgs,
}

#[derive(Debug, Args)]
pub struct Common {
    /// How long to measure, s
    #[arg(long, default_value_t = 3.0)]
    pub seconds: f64,
    /// One JSON object on the last line
    #[arg(long)]
    pub json: bool,
}

/// What a benchmark found.
#[derive(Debug, Serialize)]
struct Finding {
    benchmark: &'static str,
    /// Units of work done per second.
    per_second: f64,
    /// What one unit is.
    unit: &'static str,
    /// Rounds measured.
    rounds: u64,
    /// Time measured, s.
    seconds: f64,
    /// Median time of a round, s.
    round_median_s: f64,
    /// 99th percentile of it, s.
    round_p99_s: f64,
    /// Sizes that matter.
    settings: serde_json::Value,
}

pub fn run(command: &BenchCommand) -> Result<(), Failure> {
    let (common, finding) = match command {
        BenchCommand::Sim(args) => return bench_sim(args),
        BenchCommand::Gap(args) => return bench_gap::run(args),
        BenchCommand::Skill(args) => return bench_skill::run(args),
        BenchCommand::Transport(args) => return bench_transport::run(args),
        BenchCommand::Ingest(args) => return bench_ingest::run(args),
        BenchCommand::Lag(args) => return bench_lag::run(args),
        BenchCommand::Learner { common, config } => {
            return bench_learner::run(&or_quick(config), common.seconds, common.json);
        }
        BenchCommand::Policy {
            common,
            batch,
            threads,
            config,
        } => (common, bench_policy(common, *batch, *threads, config)?),
    };
    if common.json {
        return say::json(&finding);
    }
    print(&finding);
    Ok(())
}

fn print(finding: &Finding) {
    say::line(format!(
        "{}: {:.0} {}/s  (one round {:.3} ms median, {:.3} ms p99, {} rounds, {})",
        finding.benchmark,
        finding.per_second,
        finding.unit,
        1e3 * finding.round_median_s,
        1e3 * finding.round_p99_s,
        finding.rounds,
        finding.settings
    ));
}

/// Repeats `round` until the time is over, after one round to warm up. `units` is the work in one round.
fn measure(
    benchmark: &'static str,
    (unit, units): (&'static str, u64),
    common: &Common,
    settings: serde_json::Value,
    mut round: impl FnMut() -> Result<(), Failure>,
) -> Result<Finding, Failure> {
    let limit = Duration::try_from_secs_f64(common.seconds).or_exit(ExitCode::BadConfig)?;
    round()?;
    let mut times_s = Vec::new();
    let began = Instant::now();
    while began.elapsed() < limit || times_s.is_empty() {
        let started = Instant::now();
        round()?;
        times_s.push(started.elapsed().as_secs_f64());
    }
    let seconds = began.elapsed().as_secs_f64();
    let rounds = times_s.len() as u64;
    times_s.sort_by(f64::total_cmp);
    let quantile = |q: f64| times_s[((times_s.len() - 1) as f64 * q).round() as usize];
    Ok(Finding {
        benchmark,
        per_second: (rounds * units) as f64 / seconds,
        unit,
        rounds,
        seconds,
        round_median_s: quantile(0.5),
        round_p99_s: quantile(0.99),
        settings,
    })
}

/// The flags as given, or the preset `quick`.
pub fn or_quick(flags: &ConfigArgs) -> ConfigArgs {
    let mut flags = flags.clone();
    if flags.preset.is_none() && flags.config.is_none() {
        flags.preset = Some("quick".into());
    }
    flags
}

/// The flags again, for a program that takes them too.
pub fn as_flags(flags: &ConfigArgs) -> Vec<OsString> {
    let mut out: Vec<OsString> = Vec::new();
    if let Some(preset) = &flags.preset {
        out.extend(["--preset".into(), preset.into()]);
    }
    if let Some(file) = &flags.config {
        out.extend(["--config".into(), file.into()]);
    }
    for change in &flags.overrides {
        out.extend(["--set".into(), change.into()]);
    }
    out
}

pub fn load(flags: &ConfigArgs) -> Result<caudata_config::Config, Failure> {
    or_quick(flags).load().or_exit(ExitCode::BadConfig)
}

fn bench_sim(args: &SimBench) -> Result<(), Failure> {
    let config = load(&args.config)?;
    let all = |engines: &[EngineName]| match engines {
        [] => EngineName::value_variants().to_vec(),
        some => some.to_vec(),
    };
    let plan = Plan {
        robot: config.robot_path(),
        engine: config.engine.clone(),
        engines: all(&args.engine),
        scenes: match args.scene.as_slice() {
            [] => SceneName::value_variants().to_vec(),
            some => some.to_vec(),
        },
        widths: match args.lane_width.as_slice() {
            [] => vec![0],
            some => some.to_vec(),
        },
        lanes: args.lanes as usize,
        seconds: args.common.seconds,
        mujoco: !args.no_mujoco,
        bare: args.bare,
    };
    let (speeds, mujoco) = if args.no_physics {
        (Vec::new(), "skipped: --no-physics".to_owned())
    } else {
        bench_sim::measure(&plan)?
    };
    let finding = bench_env(&args.common, args.lanes, args.threads, config)?;
    if args.common.json {
        let mut found = serde_json::to_value(&finding).or_exit(ExitCode::Internal)?;
        found["physics"] = serde_json::to_value(&speeds).or_exit(ExitCode::Internal)?;
        found["mujoco"] = mujoco.into();
        return say::json(&found);
    }
    bench_sim::print(&speeds, &mujoco);
    print(&finding);
    Ok(())
}

fn bench_env(
    common: &Common,
    lanes: u32,
    threads: u32,
    mut config: caudata_config::Config,
) -> Result<Finding, Failure> {
    (config.actors.lanes, config.actors.threads) = (lanes, threads);
    let model = Arc::new(robot_model::load(&config.robot_path())?);
    let mut env = build_env(&config, model, 0).map_err(|error| error.into_failure())?;
    env.reset_all().or_exit(ExitCode::Internal)?;
    // A gait-like motion, so that contacts come and go.
    let width = env.act_dim();
    let mut actions = vec![0.0f32; lanes as usize * width];
    let mut step = 0u32;
    let settings = serde_json::json!({
        "engine": config.engine.kind, "lanes": lanes, "threads": threads,
        "dt_s": config.engine.dt_s, "substeps": config.engine.substeps,
    });
    measure(
        "sim",
        ("environment steps", u64::from(lanes)),
        common,
        settings,
        || {
            // Once for all lanes: a sine per lane and joint would be a fortieth of what is measured.
            let action: PerJoint =
                PerJoint::from_fn(width, |i| 0.5 * (step as f32 * 0.16 + i as f32).sin());
            for lane in actions.chunks_exact_mut(width) {
                lane.copy_from_slice(&action);
            }
            step += 1;
            env.step(&actions).map(|_| ()).or_exit(ExitCode::Internal)
        },
    )
}

fn bench_policy(
    common: &Common,
    batch: u32,
    threads: u32,
    config: &ConfigArgs,
) -> Result<Finding, Failure> {
    let config = load(config)?;
    let model = robot_model::load(&config.robot_path())?;
    let contract = PolicyContract::new(&model, &config.task).or_exit(ExitCode::BadInput)?;
    let hidden = &config.learner.network.policy_hidden;
    let file = PolicyFile::parse(example_policy(&contract, hidden, "bench", 0)?.into())
        .or_exit(ExitCode::Internal)?;
    let mut inference = Inference::new(&file, threads as usize).or_exit(ExitCode::NoInput)?;
    let lanes = batch as usize;
    let observations: Vec<f32> = (0..lanes * contract.obs_dim())
        .map(|i| (i as f32 * 0.37).sin())
        .collect();
    let mut actions = vec![0.0; lanes * contract.act_dim()];
    let settings =
        serde_json::json!({ "batch": batch, "threads": threads, "policy_hidden": hidden });
    measure(
        "policy",
        ("inferences", u64::from(batch)),
        common,
        settings,
        || {
            inference
                .run(&observations, lanes, &mut actions)
                .or_exit(ExitCode::Internal)
        },
    )
}

/// A policy file with made-up weights: only its size matters.
pub fn example_policy(
    contract: &PolicyContract,
    hidden: &[u32],
    run_id: &str,
    version: u64,
) -> Result<Vec<u8>, Failure> {
    let sizes: Vec<usize> = std::iter::once(contract.obs_dim())
        .chain(hidden.iter().map(|&n| n as usize))
        .chain([contract.act_dim()])
        .collect();
    let layers = sizes
        .windows(2)
        .map(|pair| Dense {
            input: pair[0],
            out: pair[1],
            weight: (0..pair[0] * pair[1])
                .map(|i| 0.05 * (i as f32).sin())
                .collect(),
            bias: vec![0.0; pair[1]],
        })
        .collect();
    let spec = MlpSpec {
        obs_mean: vec![0.0; contract.obs_dim()],
        obs_std: vec![1.0; contract.obs_dim()],
        obs_clip: Some(10.0),
        layers,
        activation: Activation::Elu,
    };
    let metadata = PolicyMetadata {
        contract: contract.clone(),
        version,
        run_id: run_id.into(),
        training_commit: String::new(),
        config_hash: String::new(),
        env_steps: 0,
        seed: 0,
        log_std: vec![0.0; contract.act_dim()],
        created_unix_s: None,
        evaluation: None,
    };
    build_onnx(&spec, &metadata).or_exit(ExitCode::Internal)
}
