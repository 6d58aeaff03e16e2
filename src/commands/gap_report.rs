//! `caudata gap report`: a diagnosis again, in words or as its page.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use caudata_gap::page;
use caudata_gap::report::{Cause, DataFault, Report, Verdict};
use caudata_model::RobotModel;
use caudata_studies::diagnosis::{EXTENDED, PLOTS, REPORT};
use caudata_studies::files;
use caudata_telemetry::Failure;
use clap::Args;

use crate::say::{self, short};

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
    let report: Report = files::read_json(&args.folder.join(REPORT)).map_err(|failure| {
        failure.hint("give the folder that `caudata gap diagnose --out` wrote")
    })?;
    if let Some(path) = &args.html {
        let plots = files::read_json(&args.folder.join(PLOTS)).ok();
        let robot = robot_name(&args.folder);
        files::write(path, page::render(&robot, &report, plots.as_ref()))?;
    }
    say::either(args.json, &report, print)
}

fn robot_name(folder: &Path) -> String {
    let robot = RobotModel::load(&folder.join(EXTENDED));
    robot.map_or_else(|_| "robot".to_owned(), |r| r.name().to_owned())
}

/// A verdict as `report.json` has it.
pub fn word(verdict: &Verdict) -> String {
    let word = serde_json::to_value(verdict).unwrap_or_default();
    word.as_str().unwrap_or_default().to_owned()
}

/// Faults of the data, a line each.
pub fn faults(faults: &[DataFault]) {
    // what is the same in several runs is said once, and what is so of several joints in the same runs
    let mut rows: Vec<(&DataFault, &str, Vec<&str>)> = Vec::new();
    for f in faults {
        let (run, what) = f.location.split_once(' ').unwrap_or(("", &f.location));
        let same = |r: &&mut (&DataFault, &str, Vec<&str>)| {
            (&r.0.kind, &r.0.detail, r.1, r.0.fatal) == (&f.kind, &f.detail, what, f.fatal)
        };
        match rows.iter_mut().find(same) {
            Some(row) => row.2.push(run),
            None => rows.push((f, what, vec![run])),
        }
    }
    let mut lines: Vec<(&DataFault, String, Vec<&str>)> = Vec::new();
    for (f, what, runs) in rows {
        let same = |l: &&mut (&DataFault, String, Vec<&str>)| {
            (&l.0.kind, &l.0.detail, &l.2, l.0.fatal) == (&f.kind, &f.detail, &runs, f.fatal)
        };
        match lines.iter_mut().find(same) {
            Some(line) => line.1 += &format!(", {what}"),
            None => lines.push((f, what.to_owned(), runs)),
        }
    }
    for (f, what, runs) in lines {
        let word = if f.fatal { "FAULT" } else { "note " };
        let place = match runs.as_slice() {
            [run] => format!("{run} {what}").trim_start().to_owned(),
            [first, .., last] => format!("{what} in {} runs ({first} to {last})", runs.len()),
            [] => String::new(),
        };
        say::line(format!("{word} {}: {place}: {}", f.kind, f.detail));
    }
}

/// The report in words.
pub fn print(report: &Report) {
    say::line(format!("\n{:?}: {}", report.verdict, report.summary));
    faults(&report.data_faults);
    for (i, found) in report.causes.iter().enumerate() {
        cause(i + 1, found);
    }
    for s in &report.leads {
        let values = s.parameters.iter().map(|(name, p)| {
            let value = format!("{name} = {} {}", short(p.value), p.unit);
            value.trim_end().to_owned()
        });
        say::line(format!(
            "\na lead, in the model and no finding: {} at {}, {}",
            s.effect,
            place(&s.location),
            values.collect::<Vec<_>>().join(", ")
        ));
        for text in s.evidence.iter().take(1) {
            say::line(format!("   {text}"));
        }
    }
    unnamed(report);
    if !report.gain.is_empty() {
        say::line("");
        say::table(
            &["held-out error", "as given", "extended", "ratio", "95 %"],
            report.gain.iter().map(|(signal, g)| {
                vec![
                    signal.clone(),
                    short(g.before),
                    short(g.after),
                    format!("{:.3}", g.ratio),
                    format!("{:.3} to {:.3}", g.ci_low, g.ci_high),
                ]
            }),
        );
    }
    if let Some(given) = report.position_errors.first() {
        let joints: Vec<&str> = given.joints_rad.keys().map(String::as_str).collect();
        // of many joints the mean is enough here; report.json has all
        let shown = if joints.len() > 8 { &[] } else { &joints[..] };
        let about = format!("mean |error|, held out ({})", given.units());
        let mut head = vec![about.as_str(), "all"];
        head.extend(shown);
        say::line("");
        say::table(
            &head,
            report.position_errors.iter().map(|e| {
                let mut row = vec![e.model.clone(), short(e.mean_rad)];
                let of = |j: &&str| e.joints_rad.get(*j).copied().map_or(String::new(), short);
                row.extend(shown.iter().map(of));
                row
            }),
        );
    }
    for g in &report.local_gaps {
        say::line(format!(
            "far off: {} in {} from {:.1} s to {:.1} s, {} {}",
            g.joint,
            g.run,
            g.from_s,
            g.to_s,
            short(g.rms_rad),
            g.unit
        ));
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

/// What the model carries without a name that anybody vouches for, a line for each place.
fn unnamed(report: &Report) {
    let mut places: BTreeMap<String, Vec<String>> = BTreeMap::new();
    for c in report.model.iter().filter(|c| !c.named) {
        let values = c.parameters.iter();
        let values: Vec<String> =
            values.map(|(name, value)| format!("{name} = {}", short(*value))).collect();
        let of_place = places.entry(place(&c.location)).or_default();
        of_place.push(format!("{} ({})", c.effect, values.join(", ")));
    }
    for (place, effects) in places {
        say::line(format!("in the model at {place}, and no findings: {}", effects.join(", ")));
    }
}

fn cause(number: usize, cause: &Cause) {
    say::line(format!(
        "\n{number}. {} at {}, confidence {:.0} %{}{}",
        cause.effect,
        place(&cause.location),
        100.0 * cause.confidence,
        cause.of_kind(),
        if cause.alternatives.is_empty() { "" } else { ", its name open" }
    ));
    if !cause.assumed.is_empty() {
        let figures = cause.assumed.join(", ");
        say::line(format!("   the robot file assumes {figures}: look it up first"));
    }
    for (name, p) in &cause.parameters {
        let bound = if p.at_bound { ", at its bound: no result" } else { "" };
        say::line(format!(
            "   {name} = {} {} ({} to {}{bound})",
            short(p.value),
            p.unit,
            short(p.ci_low),
            short(p.ci_high)
        ));
    }
    if !cause.alternatives.is_empty() {
        say::line(format!("   as good: {}", cause.as_good(&str::to_owned).join(", ")));
    }
    for place in &cause.elsewhere {
        say::line(format!("   as good: at {}", place.join(", ")));
    }
    for text in &cause.evidence {
        say::line(format!("   {text}"));
    }
}

/// Where a cause is.
fn place(location: &[String]) -> String {
    if location.is_empty() { "the whole robot".to_owned() } else { location.join(", ") }
}
