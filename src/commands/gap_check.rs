//! `caudata gap check`: faults of logs, what they excite, what they cannot tell.

use std::path::PathBuf;

use caudata_gap::check::{CheckVerdict, Checked, JointExcitation, RunCheck, check_dirs};
use caudata_model::RobotModel;
use caudata_studies::diagnosis::logs_at;
use caudata_studies::files;
use caudata_telemetry::{ExitCode, Failure};
use clap::Args;

use super::gap_report;
use crate::say;

#[derive(Debug, Args)]
pub struct CheckArgs {
    /// Robot file
    #[arg(long, value_name = "R.robot.toml")]
    robot: PathBuf,
    /// Logs: folders, files of rows with their circumstances beside them, or folders of such
    #[arg(long = "log", value_name = "LOG", required = true, num_args = 1..)]
    logs: Vec<PathBuf>,
    /// One JSON object on the last line
    #[arg(long)]
    json: bool,
}

pub fn run(args: &CheckArgs) -> Result<(), Failure> {
    let robot = files::robot(&args.robot)?;
    let dirs = logs_at(&args.logs)?;
    let (_, checked) = check_dirs(&dirs, &robot);
    say::either(args.json, &checked, |checked| print(checked, &robot))?;
    match checked.verdict {
        CheckVerdict::Ok => Ok(()),
        CheckVerdict::DataFault => {
            let count = checked.faults.iter().filter(|f| f.fatal).count();
            let message = format!("{count} fault(s) must be put right before a diagnosis");
            Err(Failure::outcome(ExitCode::DataFault, message))
        }
    }
}

fn print(checked: &Checked, robot: &RobotModel) {
    let head = ["run", "rows", "s", "Hz", "base", "joints", "fastest", "band Hz", "logged"];
    say::table(&head, checked.runs.iter().map(|run| row(run, robot)));
    let repeated = checked.repeats.iter().filter(|g| g.len() > 1).count();
    let guessed = match repeated == 0 && checked.runs.len() > 1 {
        true => ": without repeats the noise must be guessed",
        false => "",
    };
    let trials = checked.repeats.len();
    say::line(format!("\n{trials} trial(s), {repeated} of them repeated{guessed}"));
    if checked.faults.is_empty() {
        say::line("no fault found");
    }
    gap_report::faults(&checked.faults);
    if !checked.not_used.is_empty() {
        say::line("\nNot used by a diagnosis (and in how many of the runs):");
        for (what, runs) in &checked.not_used {
            say::line(format!("  {what} ({runs})"));
        }
    }
    if checked.cannot_tell.is_empty() {
        return;
    }
    say::line(
        "\nHard to see in these runs, if at all (and the trial of `caudata gap excite` that shows it well):",
    );
    let mut by_need: Vec<(String, Vec<&str>)> = Vec::new();
    for (effect, blind) in &checked.cannot_tell {
        let need = match blind.record.is_empty() {
            true => blind.missing.clone(),
            false => format!("{} [{}]", blind.missing, blind.record),
        };
        match by_need.iter_mut().find(|n| n.0 == need) {
            Some(n) => n.1.push(effect),
            None => by_need.push((need, vec![effect])),
        }
    }
    for (need, effects) in by_need {
        say::line(format!("  {}: needs {need}", effects.join(", ")));
    }
}

fn row(run: &RunCheck, robot: &RobotModel) -> Vec<String> {
    let e = &run.excites;
    let most =
        |value: &dyn Fn(&JointExcitation) -> f64| e.joints.iter().map(value).fold(0.0, f64::max);
    let high = most(&|j| j.band_hz[1]);
    let low = e.joints.iter().map(|j| j.band_hz[0]);
    let low = low.filter(|f| *f > 0.0).fold(f64::INFINITY, f64::min);
    let kinds: Vec<&str> = e.channels.keys().map(String::as_str).collect();
    vec![
        run.name.clone(),
        run.rows.to_string(),
        format!("{:.1}", e.duration_s),
        format!("{:.0}", run.rate_hz),
        format!("{:?}", e.base).to_lowercase(),
        e.joints.len().to_string(),
        fastest(&e.joints, robot),
        if high > 0.0 { format!("{low:.1} to {high:.1}") } else { "rests".to_owned() },
        kinds.join(" "),
    ]
}

/// Highest speed of the joints that turn, and of those that slide.
fn fastest(joints: &[JointExcitation], robot: &RobotModel) -> String {
    let of_unit = |unit: &str| {
        let has = |j: &&JointExcitation| {
            robot.joints().iter().any(|own| own.name == j.joint && own.unit() == unit)
        };
        let speeds = joints.iter().filter(has).map(|j| j.speed_max_radps);
        speeds.reduce(f64::max).map(|speed| format!("{speed:.2} {unit}/s"))
    };
    ["rad", "m"].into_iter().filter_map(of_unit).collect::<Vec<_>>().join(", ")
}
