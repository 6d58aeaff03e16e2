//! `caudata sim verify`: the engines against MuJoCo, closed forms, conservation laws and each other, as one
//! table.

use caudata_bench::verify::{CHECKS, Settings, Subject, VerifyError, run as verify};
use caudata_config::ConfigArgs;
use caudata_sim::{EngineConfig, EngineKind};
use caudata_studies::flags::{self, EngineName};
use caudata_telemetry::{ExitCode, Failure, FailureExt};
use clap::Args;
use serde_json::json;

use crate::say;

#[derive(Debug, Args)]
pub struct VerifyArgs {
    /// Engines to check; default: all. May be given several times
    #[arg(long, value_enum)]
    engine: Vec<EngineName>,
    /// Checks to run: accelerations, conservation, standing, incline, travel, water; default: all. May be
    /// given several times
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
    let config = args.config.load().or_exit(ExitCode::BadConfig)?;
    if !(1.0..=600.0).contains(&args.gait_s) {
        let message = "--gait-s must be 1 to 600";
        return Err(Failure::message(ExitCode::BadConfig, message));
    }
    let subject = |name: EngineName| Subject {
        name: EngineKind::from(name).name().to_owned(),
        config: EngineConfig { kind: name.into(), ..config.engine.clone() },
    };
    let settings = Settings {
        robot: config.robot_path(),
        subjects: EngineName::or_all(&args.engine).into_iter().map(subject).collect(),
        seed: args.seed,
        states: args.states as usize,
        gaits: args.gaits as usize,
        gait_s: args.gait_s,
        threads: flags::cores(),
        only: args.only.clone(),
    };
    let checks = match args.only.len() {
        0 => CHECKS.len(),
        some => some,
    };
    let mut share = say::Share::new("checks", checks);
    let rows = verify(&settings, &mut |_| share.one_more()).map_err(|error| {
        let code = match &error {
            VerifyError::Model(_) => ExitCode::BadInput,
            VerifyError::Read { .. } => ExitCode::NoInput,
            VerifyError::Sim(_) => ExitCode::BadConfig,
            VerifyError::Mujoco(_) => ExitCode::Unavailable,
        };
        Failure::new(code, error)
    })?;
    drop(share);
    let failed = rows.iter().filter(|r| r.pass == Some(false)).count();
    let passed = rows.iter().filter(|r| r.pass == Some(true)).count();
    let skipped = rows.iter().filter(|r| r.value.is_none() && r.pass.is_none()).count();
    let found = json!({ "rows": rows, "passed": passed, "failed": failed, "skipped": skipped });
    say::either(args.json, &found, |_| {
        say::records(&rows, "check engine what value unit target pass note");
        say::line(format!("{passed} passed, {failed} failed, {skipped} skipped"));
    })?;
    if failed == 0 {
        return Ok(());
    }
    Err(Failure::message(
        ExitCode::TargetMissed,
        format!("{failed} of {} figures miss their target", passed + failed),
    ))
}
