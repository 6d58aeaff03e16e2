//! `caudata gap excite`: the experiment battery as command files.

use std::path::{Path, PathBuf};

use caudata_gap::excite::{self, ExciteError, Trial};
use caudata_telemetry::{ExitCode, Failure, FailureExt};
use clap::Args;
use serde_json::json;

use super::robot_model;
use crate::say;

#[derive(Debug, Args)]
pub struct ExciteArgs {
    /// Robot file
    #[arg(long, value_name = "R.robot.toml")]
    robot: PathBuf,
    /// Folder for one command file per trial, and `battery.json` about them
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Only this joint moves
    #[arg(long, value_name = "NAME")]
    joint: Option<String>,
    /// Only this trial
    #[arg(long, value_name = "NAME")]
    trial: Option<String>,
    /// Rows per second
    #[arg(long, value_name = "HZ", default_value_t = excite::DEFAULT_RATE_HZ)]
    rate_hz: f64,
    /// One JSON object on the last line
    #[arg(long)]
    json: bool,
}

pub fn run(args: &ExciteArgs) -> Result<(), Failure> {
    let robot = robot_model::load(&args.robot)?;
    let joint = args.joint.as_deref();
    let trials = match &args.trial {
        Some(name) => vec![excite::trial(&robot, name, joint, args.rate_hz).map_err(refused)?],
        None => excite::battery(&robot, joint, args.rate_hz).map_err(refused)?,
    };
    std::fs::create_dir_all(&args.out).or_exit_with(ExitCode::CannotCreate, || {
        format!("folder {}", args.out.display())
    })?;
    for trial in &trials {
        let csv = trial.to_csv().or_exit(ExitCode::Internal)?;
        write(&args.out.join(format!("{}.csv", trial.name)), &csv)?;
    }
    let about = json!({ "robot": robot.name(), "robot_hash": robot.hash_hex(), "trials": trials });
    let text = serde_json::to_vec_pretty(&about).or_exit(ExitCode::Internal)?;
    write(&args.out.join("battery.json"), &text)?;
    if args.json {
        return say::json(&about);
    }
    print(&trials);
    say::line(format!(
        "\n{} command file(s) are in {}",
        trials.len(),
        args.out.display()
    ));
    Ok(())
}

fn write(path: &Path, bytes: &[u8]) -> Result<(), Failure> {
    std::fs::write(path, bytes).map_err(|e| {
        Failure::new(ExitCode::of_io(&e, true), e)
            .context(format!("cannot write {}", path.display()))
    })
}

fn refused(error: ExciteError) -> Failure {
    Failure::new(ExitCode::BadConfig, error)
}

fn print(trials: &[Trial]) {
    let mut rows = vec![
        ["trial", "base", "s", "times", "torque", "purpose"]
            .map(str::to_owned)
            .to_vec(),
    ];
    for t in trials {
        rows.push(vec![
            t.name.clone(),
            format!("{:?}", t.base).to_lowercase(),
            format!("{:.0}", t.duration_s),
            t.repeats.to_string(),
            format!("{:.0} %", 100.0 * t.effort),
            t.purpose.clone(),
        ]);
    }
    say::table(&rows);
    let total_s: f64 = trials.iter().map(|t| t.duration_s * t.repeats as f64).sum();
    say::line(format!(
        "\n{:.0} minutes in all, repeats included",
        total_s / 60.0
    ));
}
