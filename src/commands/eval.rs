//! `caudata eval`: how well a policy walks, in simulation, without exploration noise.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use caudata_config::{Config, ConfigArgs};
use caudata_evaluation::{
    Estimate, EvaluationError, Scenario, ScenarioResult, Settings, Suite, run_scenario, run_suite,
};
use caudata_model::RobotModel;
use caudata_policy::PolicyFile;
use caudata_sim::EngineKind;
use caudata_telemetry::{ExitCode, Failure, FailureExt, Process, StopFlag};
use clap::builder::{PossibleValuesParser, TypedValueParser};
use clap::{Args, ValueEnum};

use crate::commands::robot_model;
use crate::say;

/// Forward speed at which a training run is evaluated when it ends, m/s: the paper's.
const FINAL_COMMAND_MPS: f32 = 0.3;

#[derive(Debug, Args)]
pub struct EvalArgs {
    /// The policy
    #[arg(long, value_name = "P.onnx")]
    policy: PathBuf,
    /// Under what conditions: flat (0.3 m/s, standing, faster), rough (the paper's three grades), omni (75 commands),
    /// push, robust (corners of the randomisation), paper (all of them)
    #[arg(long, default_value = "flat", value_parser = suite_parser())]
    suite: Suite,
    /// On which engine; without it, the one of the configuration
    #[arg(long, value_enum)]
    engine: Option<EngineName>,
    /// Episodes of each scenario; fewer give a wider confidence interval
    #[arg(long, default_value_t = 256, value_parser = clap::value_parser!(u32).range(1..=100_000))]
    episodes: u32,
    /// Length of an episode, s
    #[arg(long, default_value_t = 20.0, value_parser = seconds)]
    seconds: f64,
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

fn suite_parser() -> impl TypedValueParser<Value = Suite> {
    PossibleValuesParser::new(Suite::ALL.map(Suite::name)).map(|name| {
        let named = |suite: &Suite| suite.name() == name;
        Suite::ALL.into_iter().find(named).unwrap_or(Suite::Flat)
    })
}

fn seconds(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(s) if (4.0..=600.0).contains(&s) => Ok(s),
        _ => Err("must be 4 to 600 s (the first 2 s are left out)".to_owned()),
    }
}

/// The engines, as words on the command line.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum EngineName {
    /// Articulated bodies in vector lanes, as in training
    Batch,
    /// Rapier multibody joints
    Rapier,
}

impl From<EngineName> for EngineKind {
    fn from(name: EngineName) -> Self {
        match name {
            EngineName::Batch => EngineKind::Batch,
            EngineName::Rapier => EngineKind::Rapier,
        }
    }
}

pub fn run(args: &EvalArgs, process: &Process) -> Result<(), Failure> {
    let policy = read_policy(&args.policy)?;
    let mut config = configuration(args)?;
    if let Some(engine) = args.engine {
        config.engine.kind = engine.into();
    }
    if let Some(robot) = &args.robot {
        config.robot.clone_from(robot);
    }
    let model = Arc::new(robot_model::load(&config.robot_path())?);
    warn_of_differences(&config, &model, &policy)?;
    let settings = Settings {
        episodes: args.episodes,
        episode_s: args.seconds,
        seed: args.seed,
        ..Settings::default()
    };
    let go_on = || process.stop.reason().is_none();
    let mut show = |scenario: &ScenarioResult| {
        if !args.json {
            print(scenario);
        }
    };
    if !args.json {
        say::line(format!(
            "policy version {} on engine {}, no exploration noise",
            policy.metadata().version,
            config.engine.kind.name()
        ));
    }
    let result = run_suite(
        &config, &model, &policy, args.suite, &settings, &go_on, &mut show,
    )
    .map_err(|error| failure(error, &process.stop))?;
    match args.json {
        true => say::json(&result),
        false => Ok(()),
    }
}

fn warn_of_differences(
    config: &Config,
    model: &RobotModel,
    policy: &PolicyFile,
) -> Result<(), Failure> {
    let contract =
        caudata_task::PolicyContract::new(model, &config.task).or_exit(ExitCode::BadConfig)?;
    let differences = policy
        .check_runs_on(&contract)
        .map_err(|error| failure(EvaluationError::Refused(error), &StopFlag::default()))?;
    for difference in differences {
        tracing::warn!("the policy was trained with another {}", difference.name());
    }
    Ok(())
}

fn failure(error: EvaluationError, stop: &StopFlag) -> Failure {
    match error {
        EvaluationError::Build(error) => error.into_failure(),
        EvaluationError::Refused(error) => Failure::new(ExitCode::PolicyRefused, error).hint(
            "evaluate with the robot file and the [task] section that the policy was trained with",
        ),
        EvaluationError::Inference(error) => Failure::new(ExitCode::BadInput, error),
        EvaluationError::Env(error) => Failure::new(ExitCode::Internal, error),
        EvaluationError::Stopped => {
            let reason = stop
                .reason()
                .map_or_else(String::new, |r| format!(" by {r}"));
            Failure::message(ExitCode::TempFail, format!("stopped{reason}"))
        }
    }
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

/// What a run is told about its policy when it ends: forward at 0.3 m/s on flat ground.
pub fn evaluate(
    config: &Config,
    model: &Arc<RobotModel>,
    policy: &PolicyFile,
    episodes: u32,
    stop: &StopFlag,
) -> Result<ScenarioResult, Failure> {
    let settings = Settings {
        episodes,
        seed: config.run.seed,
        ..Settings::default()
    };
    let scenario = Scenario::walk("flat 0.3 m/s", [FINAL_COMMAND_MPS, 0.0, 0.0]);
    let go_on = || stop.reason().is_none();
    let (result, _) = run_scenario(config, model, policy, &scenario, &settings, &go_on)
        .map_err(|error| failure(error, stop))?;
    Ok(result)
}

/// One scenario as lines for a person.
pub fn print(r: &ScenarioResult) {
    let pm = |x: Estimate, digits: usize| {
        format!(
            "{:.digits$} ± {:.digits$}",
            x.mean,
            (x.ci_high - x.ci_low) / 2.0
        )
    };
    say::line(format!(
        "{}: {} episodes, falls {:.1} %{}",
        r.name,
        r.episodes,
        100.0 * r.fall_share.mean,
        reasons(r)
    ));
    say::line(format!(
        "  velocity {} m/s forward, {} left, yaw {} rad/s; rms off the command {:.3}, {:.3} m/s, {:.3} rad/s",
        pm(r.vx_mps, 3),
        pm(r.vy_mps, 3),
        pm(r.yaw_rate_radps, 3),
        r.rmse_of_means[0],
        r.rmse_of_means[1],
        r.rmse_of_means[2]
    ));
    say::line(format!(
        "  power {} W, cost of transport {:.2}, torque {:.2} N·m rms, {:.2} peak",
        pm(r.power_w, 1),
        r.cost_of_transport.mean,
        r.torque_rms_nm,
        r.torque_peak_nm
    ));
    say::line(format!(
        "  stride {:.2} Hz, duty {}, clearance {} cm, slip {:.1} cm/s, vibration {:.1} %, trunk down {:.1} %",
        r.stride_hz.mean,
        r.duty_factor.map(|d| format!("{d:.2}")).join(" "),
        r.clearance_m.map(|c| format!("{:.1}", 100.0 * c)).join(" "),
        100.0 * r.slip_mps.mean,
        100.0 * r.vibration_share.mean,
        100.0 * r.trunk_contact_share.mean
    ));
    if let (Some(gates), Some(walks)) = (&r.gates, r.walks()) {
        let verdict = match (walks, gates.missed()) {
            (true, _) => "walks: every gate is met".to_owned(),
            (false, missed) if missed.is_empty() => "does not walk: it falls too often".to_owned(),
            (false, missed) => format!("does not walk: {}", missed.join("; ")),
        };
        say::line(format!("  {verdict}"));
    }
}

fn reasons(r: &ScenarioResult) -> String {
    if r.falls.is_empty() {
        return String::new();
    }
    let list: Vec<String> = r
        .falls
        .iter()
        .map(|(reason, n)| format!("{reason} {n}"))
        .collect();
    format!(" ({})", list.join(", "))
}
