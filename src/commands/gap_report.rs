//! `caudata gap report`: a diagnosis again, in words or as its page.

use std::path::{Path, PathBuf};

use caudata_gap::page;
use caudata_gap::report::Report;
use caudata_telemetry::{ExitCode, Failure, FailureExt};
use clap::Args;

use crate::say;

#[derive(Debug, Args)]
pub struct ReportArgs {
    /// Folder that `caudata gap diagnose` wrote
    #[arg(value_name = "DIR")]
    folder: PathBuf,
    /// Write the page again, there
    #[arg(long, value_name = "FILE.html")]
    html: Option<PathBuf>,
    /// The report as one JSON object
    #[arg(long)]
    json: bool,
}

pub fn run(args: &ReportArgs) -> Result<(), Failure> {
    let report: Report = read(&args.folder.join("report.json"))?;
    if let Some(path) = &args.html {
        let plots = read(&args.folder.join("plots.json")).ok();
        let robot = robot_name(&args.folder);
        std::fs::write(path, page::render(&robot, &report, plots.as_ref())).map_err(|e| {
            Failure::new(ExitCode::of_io(&e, true), e)
                .context(format!("cannot write {}", path.display()))
        })?;
    }
    if args.json {
        return say::json(&report);
    }
    print(&report);
    Ok(())
}

fn read<T: serde::de::DeserializeOwned>(path: &Path) -> Result<T, Failure> {
    let bytes = std::fs::read(path).map_err(|e| {
        Failure::new(ExitCode::of_io(&e, false), e).context(path.display().to_string())
    })?;
    serde_json::from_slice(&bytes).or_exit_with(ExitCode::BadInput, || path.display().to_string())
}

fn robot_name(folder: &Path) -> String {
    let robot = caudata_model::RobotModel::load(&folder.join("extended.robot.toml"));
    robot.map_or_else(|_| "robot".to_owned(), |r| r.name().to_owned())
}

/// The report in words.
pub fn print(report: &Report) {
    say::line(format!("\n{:?}: {}", report.verdict, report.summary));
    for fault in &report.data_faults {
        let word = if fault.fatal { "FAULT" } else { "note " };
        say::line(format!(
            "{word} {}: {}: {}",
            fault.kind, fault.location, fault.detail
        ));
    }
    for (i, cause) in report.causes.iter().enumerate() {
        say::line(format!(
            "\n{}. {} at {}, confidence {:.0} %",
            i + 1,
            cause.effect,
            place(&cause.location),
            100.0 * cause.confidence
        ));
        for (name, p) in &cause.parameters {
            let bound = if p.at_bound {
                ", at its bound: no result"
            } else {
                ""
            };
            say::line(format!(
                "   {name} = {} {} ({} to {}{bound})",
                short(p.value),
                p.unit,
                short(p.ci_low),
                short(p.ci_high)
            ));
        }
        if !cause.alternatives.is_empty() {
            say::line(format!("   as good: {}", cause.alternatives.join(", ")));
        }
        for place in &cause.elsewhere {
            say::line(format!("   as good: at {}", place.join(", ")));
        }
        for text in &cause.evidence {
            say::line(format!("   {text}"));
        }
    }
    for s in &report.leads {
        let values: Vec<String> = (s.parameters.iter())
            .map(|(name, p)| {
                format!("{name} = {} {}", short(p.value), p.unit)
                    .trim_end()
                    .to_owned()
            })
            .collect();
        say::line(format!(
            "\na lead, in the model and no finding: {} at {}, {}",
            s.effect,
            place(&s.location),
            values.join(", ")
        ));
        for text in s.evidence.iter().take(1) {
            say::line(format!("   {text}"));
        }
    }
    if !report.gain.is_empty() {
        let mut rows = vec![
            ["held-out error", "as given", "extended", "ratio", "95 %"]
                .map(str::to_owned)
                .to_vec(),
        ];
        for (signal, g) in &report.gain {
            rows.push(vec![
                signal.clone(),
                short(g.before),
                short(g.after),
                format!("{:.3}", g.ratio),
                format!("{:.3} to {:.3}", g.ci_low, g.ci_high),
            ]);
        }
        say::line("");
        say::table(&rows);
    }
    for u in &report.unexplained {
        say::line(format!("left over at {}: {}", u.location, u.description));
    }
    if let Some(next) = &report.next_experiment {
        say::line(format!("\nrecord next: {} ({})", next.trial, next.reason));
    }
    let c = &report.compute;
    say::line(format!(
        "{} hypotheses, {} simulated runs, {:.0} s simulated, {:.1} s",
        c.candidates, c.rollouts, c.simulated_s, c.seconds
    ));
}

/// Where a cause is.
fn place(location: &[String]) -> String {
    if location.is_empty() {
        "the whole robot".to_owned()
    } else {
        location.join(", ")
    }
}

/// Four significant digits.
fn short(x: f64) -> String {
    if x == 0.0 || !x.is_finite() {
        return format!("{x}");
    }
    let decimals = (3 - x.abs().log10().floor() as i32).clamp(0, 9) as usize;
    format!("{x:.decimals$}")
}
