//! `caudata gap check`: faults of logs, what they excite, what they cannot tell.

use std::path::PathBuf;

use caudata_gap::check::{CheckVerdict, Checked, check_dirs};
use caudata_telemetry::{ExitCode, Failure};
use clap::Args;

use super::gap::log_folders;
use super::robot_model;
use crate::say;

#[derive(Debug, Args)]
pub struct CheckArgs {
    /// Robot file
    #[arg(long, value_name = "R.robot.toml")]
    robot: PathBuf,
    /// Log folder, or a folder of log folders; may be given several times
    #[arg(long = "log", value_name = "DIR", required = true)]
    logs: Vec<PathBuf>,
    /// One JSON object on the last line
    #[arg(long)]
    json: bool,
}

pub fn run(args: &CheckArgs) -> Result<(), Failure> {
    let robot = robot_model::load(&args.robot)?;
    let dirs = log_folders(&args.logs)?;
    let (_, checked) = check_dirs(&dirs, &robot);
    if args.json {
        say::json(&checked)?;
    } else {
        print(&checked);
    }
    match checked.verdict {
        CheckVerdict::Ok => Ok(()),
        CheckVerdict::DataFault => {
            let count = checked.faults.iter().filter(|f| f.fatal).count();
            let message = format!("{count} fault(s) must be put right before a diagnosis");
            Err(Failure::outcome(ExitCode::DataFault, message))
        }
    }
}

fn print(checked: &Checked) {
    let mut rows = vec![row(&[
        "run",
        "rows",
        "s",
        "Hz",
        "base",
        "joints",
        "fastest rad/s",
        "band Hz",
        "logged",
    ])];
    for run in &checked.runs {
        let e = &run.excites;
        let fastest = e
            .joints
            .iter()
            .map(|j| j.speed_max_radps)
            .fold(0.0, f64::max);
        let low = e
            .joints
            .iter()
            .map(|j| j.band_hz[0])
            .filter(|f| *f > 0.0)
            .fold(f64::INFINITY, f64::min);
        let high = e.joints.iter().map(|j| j.band_hz[1]).fold(0.0, f64::max);
        let kinds: Vec<&str> = e.channels.keys().map(String::as_str).collect();
        rows.push(row(&[
            &run.name,
            &run.rows.to_string(),
            &format!("{:.1}", e.duration_s),
            &format!("{:.0}", run.rate_hz),
            &format!("{:?}", e.base).to_lowercase(),
            &e.joints.len().to_string(),
            &format!("{fastest:.2}"),
            &if high > 0.0 {
                format!("{low:.1} to {high:.1}")
            } else {
                "rests".to_owned()
            },
            &kinds.join(" "),
        ]));
    }
    say::table(&rows);
    let repeated = checked.repeats.iter().filter(|g| g.len() > 1).count();
    say::line(format!(
        "\n{} trial(s), {repeated} of them repeated{}",
        checked.repeats.len(),
        if repeated == 0 && checked.runs.len() > 1 {
            ": without repeats the noise must be guessed"
        } else {
            ""
        }
    ));
    if checked.faults.is_empty() {
        say::line("no fault found");
    }
    for f in &checked.faults {
        let word = if f.fatal { "FAULT" } else { "note " };
        say::line(format!("{word} {}: {}: {}", f.kind, f.location, f.detail));
    }
    if !checked.cannot_tell.is_empty() {
        say::line(
            "\nCannot show in these runs (and the trial of `caudata gap excite` that would show it):",
        );
        let mut by_need: Vec<(String, Vec<&str>)> = Vec::new();
        for (effect, blind) in &checked.cannot_tell {
            let trial = if blind.record.is_empty() {
                String::new()
            } else {
                format!(" [{}]", blind.record)
            };
            let need = format!("{}{trial}", blind.missing);
            match by_need.iter_mut().find(|n| n.0 == need) {
                Some(n) => n.1.push(effect),
                None => by_need.push((need, vec![effect])),
            }
        }
        for (need, effects) in by_need {
            say::line(format!("  {}: needs {need}", effects.join(", ")));
        }
    }
}

fn row(cells: &[&str]) -> Vec<String> {
    cells.iter().map(|c| (*c).to_owned()).collect()
}
