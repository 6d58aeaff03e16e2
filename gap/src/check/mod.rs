//! Looking at logs before any physics: what is wrong with the data themselves, what they excite, and what they cannot tell.
//!
//! Everything here is a relation that holds whatever the robot is like (a command goes before its effect, speed is the change of position,
//! gravity is 9.81 m/s², repeats repeat), so it needs no simulation and no effect of the catalogue makes it fail.

mod blind;
mod excites;
mod joints;
mod parity;
mod repeats;
pub mod series;
mod stamps;

use std::collections::BTreeMap;
use std::path::Path;

use caudata_model::RobotModel;
use caudata_runlog::{LogError, RunLog};
use serde::{Deserialize, Serialize};

pub use blind::{Blind, blind};
pub use excites::{JointExcitation, RunExcitation};
pub use repeats::OddSpan;

use crate::report::DataFault;

/// A run shorter than this says nothing, s.
pub const SHORTEST_RUN_S: f64 = 2.0;
/// A run with fewer rows than this says nothing.
pub const FEWEST_ROWS: usize = 50;

/// Whether a finding stops a diagnosis.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Severity {
    /// It must be put right first.
    Fatal,
    /// It is worth knowing.
    Note,
}

/// A fault of one run, before it is given the run's name.
#[derive(Clone, Debug)]
pub(crate) struct Finding {
    pub kind: &'static str,
    pub at: String,
    pub detail: String,
    pub severity: Severity,
}

/// One run being looked at.
pub(crate) struct Run<'a> {
    pub name: String,
    pub log: &'a RunLog,
    pub robot: &'a RobotModel,
    pub grid: series::Grid,
}

/// What was found in one run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct RunCheck {
    /// Name of the run (its folder).
    pub name: String,
    /// Rows.
    pub rows: usize,
    /// Rows per second, from the median step, Hz.
    pub rate_hz: f64,
    /// What it excites.
    pub excites: RunExcitation,
}

/// What was found in a set of runs. This is what `caudata gap check --json` prints.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Checked {
    /// `ok`, or `data_fault` where a fault must be put right before a diagnosis.
    pub verdict: CheckVerdict,
    /// Faults, those that stop a diagnosis first.
    pub faults: Vec<DataFault>,
    /// Runs that could be read.
    pub runs: Vec<RunCheck>,
    /// Groups of runs with the same commands, by name: repeats are the only honest measure of noise.
    pub repeats: Vec<Vec<String>>,
    /// Stretches that repeats do not show; a diagnosis leaves them out.
    pub odd_spans: Vec<OddSpan>,
    /// Effects that these runs cannot show, and what would.
    pub cannot_tell: BTreeMap<String, Blind>,
}

/// The outcome of a check.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum CheckVerdict {
    /// Nothing that stops a diagnosis.
    Ok,
    /// Something that does.
    DataFault,
}

/// Reads log folders and checks them together. A log that cannot be read becomes a fault.
#[must_use]
pub fn check_dirs(
    dirs: &[impl AsRef<Path>],
    robot: &RobotModel,
) -> (Vec<(String, RunLog)>, Checked) {
    let mut logs = Vec::new();
    let mut unread = Vec::new();
    for dir in dirs {
        let dir = dir.as_ref();
        let name = run_name(dir);
        match RunLog::read(dir) {
            Ok(log) => logs.push((name, log)),
            Err(e) => unread.push(unreadable(&name, &e)),
        }
    }
    let named: Vec<(&str, &RunLog)> = logs.iter().map(|(n, l)| (n.as_str(), l)).collect();
    let mut checked = check(&named, robot);
    if !unread.is_empty() {
        unread.append(&mut checked.faults);
        checked.faults = unread;
        checked.verdict = CheckVerdict::DataFault;
    }
    (logs, checked)
}

/// The name that reports give to the run in `dir`: its folder's.
#[must_use]
pub fn run_name(dir: &Path) -> String {
    let name = dir.file_name().unwrap_or(dir.as_os_str());
    name.to_string_lossy().into_owned()
}

fn unreadable(name: &str, error: &LogError) -> DataFault {
    let text = error.to_string();
    let kind = match error {
        LogError::Row { message, .. } if message.contains("must increase") => "stamps",
        LogError::Row { .. } => "value",
        LogError::Header { .. } => "columns",
        LogError::Meta { .. } => "meta",
        _ => "unreadable",
    };
    DataFault {
        kind: kind.to_owned(),
        location: name.to_owned(),
        detail: text,
        fatal: true,
    }
}

/// Checks runs (name and log) of `robot` together.
#[must_use]
pub fn check(logs: &[(&str, &RunLog)], robot: &RobotModel) -> Checked {
    let runs: Vec<Run<'_>> = logs
        .iter()
        .map(|(name, log)| Run {
            name: (*name).to_owned(),
            log,
            robot,
            grid: series::Grid::of(log.table.time_s()),
        })
        .collect();
    let mut faults = Vec::new();
    let mut checks = Vec::new();
    let mut channels = Vec::new();
    for run in &runs {
        let mut found = Vec::new();
        let joints = joints::Channels::all(run);
        if usable(run, &joints, &mut found) {
            stamps::faults(run, &joints, &mut found);
            joints::faults(run, &joints, &mut found);
            parity::faults(run, &joints, &mut found);
        }
        faults.extend(found.into_iter().map(|f| fault(&run.name, f)));
        checks.push(RunCheck {
            name: run.name.clone(),
            rows: run.log.table.len(),
            rate_hz: 1.0 / series::median_step_s(run.log.table.time_s()).max(1e-9),
            excites: excites::of(run, &joints),
        });
        channels.push(joints);
    }
    let groups = repeats::groups(&runs, &channels);
    let mut odd = Vec::new();
    // Runs that contradict themselves differ from their repeats for that reason.
    if !faults.iter().any(|f| f.fatal) {
        for group in &groups {
            let spans = repeats::odd_spans(&runs, &channels, group);
            let as_fault = |s: &OddSpan| fault("", repeats::finding(s, group.len()));
            faults.extend(spans.iter().map(as_fault));
            odd.extend(spans);
        }
    }
    faults.sort_by_key(|f| !f.fatal);
    let excitations: Vec<RunExcitation> = checks.iter().map(|c| c.excites.clone()).collect();
    let names = |g: &Vec<usize>| g.iter().map(|&i| runs[i].name.clone()).collect();
    Checked {
        verdict: if faults.iter().any(|f| f.fatal) {
            CheckVerdict::DataFault
        } else {
            CheckVerdict::Ok
        },
        faults,
        repeats: groups.iter().map(names).collect(),
        odd_spans: odd,
        cannot_tell: blind(logs, &excitations, robot),
        runs: checks,
    }
}

fn fault(run: &str, f: Finding) -> DataFault {
    let location = if run.is_empty() {
        f.at
    } else {
        format!("{run} {}", f.at)
    };
    DataFault {
        kind: f.kind.to_owned(),
        location,
        detail: f.detail,
        fatal: f.severity == Severity::Fatal,
    }
}

/// Whether there is anything to check: the right robot, its joints, enough rows.
fn usable(run: &Run<'_>, joints: &[joints::Channels], out: &mut Vec<Finding>) -> bool {
    let before = out.len();
    let mut fatal = |kind, at: &str, detail: String| {
        out.push(Finding {
            kind,
            at: at.to_owned(),
            detail,
            severity: Severity::Fatal,
        });
    };
    let table = &run.log.table;
    let known = run.robot.actuated_names();
    let strangers: Vec<&str> = {
        let mut all: Vec<&str> = table
            .signals()
            .iter()
            .filter_map(|s| s.joint())
            .filter(|j| !known.contains(j))
            .collect();
        all.sort_unstable();
        all.dedup();
        all
    };
    let robot = run.robot.name();
    if joints.is_empty() {
        let detail = if strangers.is_empty() {
            "has no joint column; a diagnosis needs `cmd.<joint>` and `pos.<joint>`".to_owned()
        } else {
            format!(
                "has joints {} where `{robot}` has {}: a log of another robot (`robot = \"{}\"`)",
                strangers.join(", "),
                known.join(", "),
                run.log.meta.robot
            )
        };
        fatal("columns", "log.csv", detail);
    } else {
        if !strangers.is_empty() {
            fatal(
                "columns",
                "log.csv",
                format!(
                    "has {} and `{robot}` has no such joint; its joints are {}",
                    strangers.join(", "),
                    known.join(", ")
                ),
            );
        }
        for (what, has) in [
            ("cmd", joints.iter().any(|j| j.cmd.is_some())),
            ("pos", joints.iter().any(|j| j.pos.is_some())),
        ] {
            if !has {
                fatal(
                    "columns",
                    "log.csv",
                    format!("has no column `{what}.<joint>`"),
                );
            }
        }
    }
    let span_s = table.time_s().last().unwrap_or(&0.0) - table.time_s().first().unwrap_or(&0.0);
    if table.len() < FEWEST_ROWS || span_s < SHORTEST_RUN_S {
        fatal(
            "short",
            "log.csv",
            format!(
                "is {span_s:.2} s long in {} rows; a run has at least {SHORTEST_RUN_S} s and {FEWEST_ROWS} rows",
                table.len()
            ),
        );
    }
    let usable = out.len() == before;
    for signal in table.signals() {
        if table
            .column(signal)
            .is_some_and(|c| c.iter().all(Option::is_none))
        {
            out.push(Finding {
                kind: "empty",
                at: signal.to_string(),
                detail: "has no sample in the whole run".to_owned(),
                severity: Severity::Note,
            });
        }
    }
    usable
}
