//! `caudata gap excite`: the experiment battery as command files.

use std::path::PathBuf;

use caudata_gap::excite::{self, ExciteError, Trial};
use caudata_studies::files;
use caudata_telemetry::{ExitCode, Failure, FailureExt};
use clap::Args;
use serde_json::json;

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
    let robot = files::robot(&args.robot)?;
    let joint = args.joint.as_deref();
    let trials = match &args.trial {
        Some(name) => vec![excite::trial(&robot, name, joint, args.rate_hz).map_err(refused)?],
        None => excite::battery(&robot, joint, args.rate_hz).map_err(refused)?,
    };
    files::make_folder(&args.out)?;
    for trial in &trials {
        let csv = trial.to_csv().or_exit(ExitCode::Internal)?;
        files::write(&args.out.join(format!("{}.csv", trial.name)), csv)?;
    }
    let about = json!({ "robot": robot.name(), "robot_hash": robot.hash_hex(), "trials": trials });
    files::write_json(&args.out.join("battery.json"), &about)?;
    say::either(args.json, &about, |_| {
        print(&trials);
        let mut driven = robot.actuated().iter().map(|&j| &robot.joints()[j]);
        if let Some(slide) = driven.find(|j| j.unit() == "m") {
            let way_mm = slide.per_radian() * 10.0;
            say::line(format!("Of joints that slide, read 10 mrad in a purpose as {way_mm:.0} mm"));
        }
        let out = args.out.display();
        say::line(format!("\n{} command file(s) are in {out}", trials.len()));
    })
}

fn refused(error: ExciteError) -> Failure {
    Failure::new(ExitCode::BadConfig, error)
}

fn print(trials: &[Trial]) {
    say::records(trials, "name base duration_s repeats effort purpose");
    let total_s: f64 = trials.iter().map(|t| t.duration_s * t.repeats as f64).sum();
    say::line(format!("\n{:.1} min in all, repeats included", total_s / 60.0));
}
