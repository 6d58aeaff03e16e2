//! `caudata sim verify`: the engines against MuJoCo, closed forms, conservation laws and each other, as one table.

use std::path::PathBuf;

use caudata_config::ConfigArgs;
use caudata_sim::EngineConfig;
use caudata_telemetry::{ExitCode, Failure, FailureExt};
use caudata_verify::{CHECKS, Row, Settings, Subject, VerifyError, run as verify};
use clap::{Args, ValueEnum};
use serde_json::json;

use crate::commands::eval::EngineName;
use crate::say;

#[derive(Debug, Args)]
pub struct VerifyArgs {
    /// Robot file; default: the configuration's
    #[arg(long, value_name = "R.robot.toml")]
    robot: Option<PathBuf>,
    /// Engines to check; default: all. May be given several times
    #[arg(long, value_enum)]
    engine: Vec<EngineName>,
    /// Checks to run: accelerations, conservation, standing, incline, travel, water; default: all. May be given several times
    #[arg(long, value_parser = CHECKS)]
    only: Vec<String>,
    /// Draws states and gaits
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Random states of the accelerations
    #[arg(long, default_value_t = 500, value_parser = clap::value_parser!(u32).range(1..=10_000))]
    states: u32,
    /// Random gaits of the travel
    #[arg(long, default_value_t = 10, value_parser = clap::value_parser!(u32).range(1..=1000))]
    gaits: u32,
    /// Length of each gait, s
    #[arg(long, default_value_t = 20.0)]
    gait_s: f64,
    /// One JSON object on the last line
    #[arg(long)]
    json: bool,
    /// Contact and solver settings of the engines come from `[engine]`; the checks set the steps
    #[command(flatten)]
    config: ConfigArgs,
}

pub fn run(args: &VerifyArgs) -> Result<(), Failure> {
    let mut config = args.config.load().or_exit(ExitCode::BadConfig)?;
    if let Some(robot) = &args.robot {
        config.robot.clone_from(robot);
    }
    if !(1.0..=600.0).contains(&args.gait_s) {
        let message = "--gait-s must be 1 to 600";
        return Err(Failure::message(ExitCode::BadConfig, message));
    }
    let chosen = if args.engine.is_empty() {
        EngineName::value_variants().to_vec()
    } else {
        args.engine.clone()
    };
    let subjects = chosen
        .into_iter()
        .map(|name| Subject {
            name: name
                .to_possible_value()
                .map_or_else(String::new, |v| v.get_name().to_owned()),
            config: EngineConfig {
                kind: name.into(),
                ..config.engine.clone()
            },
        })
        .collect();
    let settings = Settings {
        robot: config.robot_path(),
        subjects,
        seed: args.seed,
        states: args.states as usize,
        gaits: args.gaits as usize,
        gait_s: args.gait_s,
        threads: std::thread::available_parallelism().map_or(1, usize::from),
        only: args.only.clone(),
    };
    let mut progress = |check: &str| tracing::info!(check, "checking");
    let rows = verify(&settings, &mut progress).map_err(|error| {
        let code = match &error {
            VerifyError::Model(_) => ExitCode::BadInput,
            VerifyError::Read { .. } => ExitCode::NoInput,
            VerifyError::Sim(_) => ExitCode::BadConfig,
            VerifyError::Mujoco(_) => ExitCode::Unavailable,
        };
        Failure::new(code, error)
    })?;
    let failed = rows.iter().filter(|r| r.pass == Some(false)).count();
    let passed = rows.iter().filter(|r| r.pass == Some(true)).count();
    let skipped = rows
        .iter()
        .filter(|r| r.value.is_none() && r.pass.is_none())
        .count();
    if args.json {
        say::json(
            &json!({ "rows": rows, "passed": passed, "failed": failed, "skipped": skipped }),
        )?;
    } else {
        print(&rows);
        say::line(format!(
            "{passed} passed, {failed} failed, {skipped} skipped"
        ));
    }
    if failed == 0 {
        return Ok(());
    }
    Err(Failure::message(
        ExitCode::TargetMissed,
        format!("{failed} of {} figures miss their target", passed + failed),
    ))
}

fn print(rows: &[Row]) {
    let header = ["check", "engine", "figure", "value", "target", "", "note"];
    let mut table = vec![header.map(str::to_owned).to_vec()];
    for row in rows {
        let number = |x: f64| {
            if x != 0.0 && !(1e-2..1e5).contains(&x.abs()) {
                format!("{x:.1e} {}", row.unit)
            } else {
                format!("{x:.2} {}", row.unit)
            }
        };
        let verdict = match (row.pass, row.value) {
            (Some(true), _) => "ok",
            (Some(false), _) => "MISSED",
            (None, Some(_)) => "",
            (None, None) => "-",
        };
        table.push(vec![
            row.check.to_owned(),
            row.engine.clone(),
            row.what.clone(),
            row.value.map_or("-".into(), number),
            row.target
                .map_or(String::new(), |t| format!("≤ {}", number(t))),
            verdict.to_owned(),
            row.note.clone(),
        ]);
    }
    say::table(&table);
}
