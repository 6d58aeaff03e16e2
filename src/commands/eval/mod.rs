//! `caudata eval`: how well a policy walks, in simulation, without exploration noise.

mod board;
pub mod log;
mod show;

use std::path::{Path, PathBuf};
use std::sync::Arc;

use caudata_config::{Config, ConfigArgs};
use caudata_evaluation::{
    Evaluation, EvaluationError, Outcome, Scenario, ScenarioResult, Settings, Suite, SuiteResult,
    Summary, flat_name, report, run_scenario, summary_path,
};
use caudata_model::RobotModel;
use caudata_policy::PolicyFile;
use caudata_sim::EngineKind;
use caudata_studies::failures::refused;
use caudata_studies::{files, flags};
use caudata_telemetry::{ExitCode, Failure, FailureExt, Process, StopFlag};
use clap::{Args, ValueEnum};

use crate::say;

pub use caudata_studies::files::policy as read_policy;
pub use show::{BREAKS_DOWN, print};

#[derive(Debug, Args)]
#[command(override_usage = "caudata eval [OPTIONS] <P.onnx>")]
pub struct EvalArgs {
    /// The policy
    #[arg(value_name = "P.onnx", required_unless_present = "named")]
    policy: Option<PathBuf>,
    /// The same as an option, which is how it was given once
    #[arg(long = "policy", value_name = "P.onnx", hide = true, conflicts_with = "policy")]
    named: Option<PathBuf>,
    /// Under what conditions: flat (the robot's speed, standing, faster), rough (the paper's three grades), omni (75
    /// commands), push, robust (corners of the randomisation), transition (land and water), swim, servo (one limp or stuck), righting (thrown, then walking), steps (of 3 and 5 cm), animal (beside a salamander), paper (all that
    /// walk), acceptance (the project's targets; exit code 79 where one is missed)
    #[arg(long, default_value = "flat", value_parser = flags::suite_parser())]
    suite: Suite,
    /// On which engine: the batch engine alone, or another after it, with how much of the speed is kept there. Without
    /// it, the one of the configuration
    #[arg(long, value_enum)]
    engine: Option<Engines>,
    /// Episodes of each scenario; fewer give a wider confidence interval
    #[arg(long, default_value_t = 256, value_parser = clap::value_parser!(u32).range(1..=100_000))]
    episodes: u32,
    /// Length of an episode, s
    #[arg(long, default_value_t = 20.0, value_parser = seconds)]
    seconds: f64,
    /// Seed of the episodes
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Writes a page with tables, curves and a replay in three dimensions; it needs nothing but a browser
    #[arg(long, value_name = "OUT.html")]
    report: Option<PathBuf>,
    /// Writes an episode of each scenario as a log folder below this one, which `caudata log convert` makes MCAP of
    #[arg(long, value_name = "DIR")]
    log: Option<PathBuf>,
    /// Adds the result to TensorBoard's files in this folder: figures at the step of the policy's version, and as a
    /// text what was met
    #[arg(long, value_name = "DIR")]
    tensorboard: Option<PathBuf>,
    /// Writes a summary beside the policy (P.evaluation.json), bound to the policy's bytes; `caudata policy
    /// show` shows it
    #[arg(long)]
    write_summary: bool,
    /// One JSON object on the last line
    #[arg(long)]
    json: bool,
    /// The task; without these flags, the config.toml beside the policy, else the preset that it was trained with
    #[command(flatten)]
    config: ConfigArgs,
}

fn seconds(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(s) if (4.0..=600.0).contains(&s) => Ok(s),
        _ => Err("must be 4 to 600 s (the first 2 s are left out)".to_owned()),
    }
}

impl EvalArgs {
    /// One of both is there.
    fn policy(&self) -> &Path {
        let given = self.policy.as_deref().or(self.named.as_deref());
        given.unwrap_or(Path::new(""))
    }
}

/// The engines of an evaluation, as words on the command line.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Engines {
    /// Articulated bodies in vector lanes, as in training
    Batch,
    /// Rapier multibody joints; a hundred times slower
    Rapier,
    /// MuJoCo, in the Python that CAUDATA_MUJOCO_PYTHON names; slower still
    Mujoco,
}

impl Engines {
    /// What runs beside the batch engine.
    fn referee(self) -> Option<EngineKind> {
        match self {
            Self::Batch => None,
            Self::Rapier => Some(EngineKind::Rapier),
            Self::Mujoco => Some(EngineKind::Mujoco),
        }
    }
}

pub fn run(args: &EvalArgs, process: &Process) -> Result<(), Failure> {
    if let Some(set) = args.config.overrides.iter().find(|set| set.trim().starts_with("terrain.")) {
        let message = format!("--set {set}: the scenarios of a suite have grounds of their own");
        return Err(Failure::message(ExitCode::BadConfig, message).hint("choose with --suite"));
    }
    let policy = files::policy(args.policy())?;
    let (mut config, model) = task_of(args.policy(), &policy, &args.config)?;
    if args.engine.is_some() {
        config.engine.kind = EngineKind::Batch;
    }
    if args.engine == Some(Engines::Mujoco) {
        // before an hour on the other engine
        caudata_sim::mujoco::version()
            .map_err(|why| Failure::message(ExitCode::Unavailable, format!("no MuJoCo: {why}")))?;
    }
    // before the work, not after it
    if let Some(path) = &args.report {
        files::writable(path)?;
    }
    if let Some(root) = &args.log {
        log::check(root)?;
    }
    if let Some(folder) = &args.tensorboard {
        files::make_folder(folder)?;
    }
    let evaluation = Evaluation {
        config: &config,
        model: &model,
        policy: &policy,
        suite: args.suite,
        settings: Settings {
            episodes: args.episodes,
            episode_s: args.seconds,
            seed: args.seed,
            film: args.report.is_some() || args.log.is_some(),
            ..Settings::default()
        },
        referee: args.engine.and_then(Engines::referee),
    };
    let go_on = || process.stop.reason().is_none();
    let mut share = say::Share::new("scenarios", evaluation.scenarios());
    let trained = &policy.metadata().contract.command;
    let mut show = |engine: &str, scenario: &ScenarioResult| {
        if !args.json {
            share.above(|| show::print_on(engine, scenario, trained));
        }
        share.one_more();
    };
    if !args.json {
        say::line(format!("policy version {}, no exploration noise", policy.metadata().version,));
    }
    let (result, outcomes) =
        evaluation.run(&go_on, &mut show).map_err(|error| refused(error, &process.stop))?;
    drop(share);
    finish(args, &evaluation, &result, &outcomes)
}

/// Writes what was asked for, and says how it ended.
fn finish(
    args: &EvalArgs,
    evaluation: &Evaluation,
    result: &SuiteResult,
    outcomes: &[Outcome],
) -> Result<(), Failure> {
    let Evaluation { config, model, policy, settings, .. } = evaluation;
    if let Some(root) = &args.log {
        log::write(root, outcomes, settings.seed, &config.robot_path(), model)?;
    }
    if let Some(folder) = &args.tensorboard {
        to_tensorboard(folder, result)?;
    }
    if let Some(path) = &args.report {
        let page =
            report::page(result, outcomes, model, policy, settings).or_exit(ExitCode::Internal)?;
        files::write(path, page)?;
    }
    if args.write_summary {
        let summary = Summary::of(result, model.hash_hex(), settings.seed);
        write_summary(args.policy(), &summary)?;
    }
    match args.json {
        true => say::json(result)?,
        false => {
            show::print_end(result);
            if let Some(path) = &args.report {
                say::line(format!("report   {}", path.display()));
            }
            if args.write_summary {
                say::line(format!("summary  {}", summary_path(args.policy()).display()));
            }
        }
    }
    let rows = &result.acceptance;
    match rows.iter().filter(|row| !row.met).count() {
        0 => Ok(()),
        missed => Err(Failure::message(
            ExitCode::TargetMissed,
            format!("{missed} of {} targets are missed", rows.len()),
        )),
    }
}

/// Adds a result to the files of TensorBoard in a folder.
pub fn to_tensorboard(folder: &Path, result: &SuiteResult) -> Result<(), Failure> {
    let cannot = || format!("cannot write TensorBoard's files into {}", folder.display());
    board::write(folder, result).or_exit_with(ExitCode::CannotCreate, cannot)
}

/// Puts a summary beside its policy.
pub fn write_summary(policy: &Path, summary: &Summary) -> Result<(), Failure> {
    files::write_json(&summary_path(policy), summary)
}

/// The task and the robot of the policy in the file `path`: those of the flags, else of the config.toml beside
/// it, else of the preset that it was trained with. Warns where they differ from its own.
///
/// # Errors
/// When the policy does not run there, or the configuration or the robot is wrong.
pub fn task_of(
    path: &Path,
    policy: &PolicyFile,
    flags: &ConfigArgs,
) -> Result<(Config, Arc<RobotModel>), Failure> {
    let fitting = flags::presets_for(&policy.metadata().contract);
    let preset = fitting.first().copied().unwrap_or("quick");
    let flags = flags::or_beside(flags, path, preset);
    let config = flags.load().or_exit(ExitCode::BadConfig)?;
    let model = Arc::new(files::robot(&config.robot_path())?);
    warn_of_differences(&config, &model, policy, &fitting)?;
    Ok((config, model))
}

fn warn_of_differences(
    config: &Config,
    model: &RobotModel,
    policy: &PolicyFile,
    fitting: &[&str],
) -> Result<(), Failure> {
    let contract =
        caudata_task::PolicyContract::new(model, &config.task).or_exit(ExitCode::BadConfig)?;
    let differences = policy.check_runs_on(&contract).map_err(|error| {
        let failure = refused(EvaluationError::Refused(error), &StopFlag::default());
        match fitting {
            [] => failure,
            _ => failure.hint(format!("it fits --preset {}", fitting.join(" or "))),
        }
    })?;
    for difference in differences {
        tracing::warn!("the policy was trained with another {}", difference.name());
    }
    Ok(())
}

/// What a run is told about its policy when it ends: forward at its speed, on flat ground or afloat. The page goes into
/// the file `page`.
pub fn evaluate(
    config: &Config,
    model: &Arc<RobotModel>,
    policy: &PolicyFile,
    page: &Path,
    stop: &StopFlag,
) -> Result<SuiteResult, Failure> {
    let settings = Settings {
        episodes: config.evaluation.episodes,
        seed: config.run.seed,
        film: true,
        ..Settings::default()
    };
    let speed_mps = config.evaluation.command_mps as f32;
    // what was trained where there is no land is judged there
    let swims = config.terrain.is_deep_water();
    let name = if swims { format!("swim {speed_mps} m/s") } else { flat_name(speed_mps) };
    let scenario = Scenario::trained(&name, [speed_mps, 0.0, 0.0], &config.terrain);
    let go_on = || stop.reason().is_none();
    let outcome = run_scenario(config, model, policy, &scenario, &settings, &go_on)
        .map_err(|error| refused(error, stop))?;
    let result = SuiteResult {
        suite: if swims { Suite::Swim } else { Suite::Flat },
        engine: config.engine.kind.name().into(),
        policy_version: policy.metadata().version,
        policy_sha256: policy.sha256_hex(),
        scenarios: vec![outcome.result.clone()],
        referee: None,
        acceptance: Vec::new(),
        animal: Vec::new(),
    };
    let html =
        report::page(&result, &[outcome], model, policy, &settings).or_exit(ExitCode::Internal)?;
    files::write_whole(page, html.as_bytes())?;
    Ok(result)
}
