//! Looking at logs before any physics: what is wrong with the data themselves, what they excite, and what
//! they cannot tell.
//!
//! Everything here is a relation that holds whatever the robot is like (a command goes before its effect,
//! speed is the change of position, gravity is 9.81 m/s², repeats repeat), so it needs no simulation and no
//! effect of the catalogue makes it fail.

mod blind;
mod channels;
mod excites;
mod finding;
mod holes;
mod joints;
mod late;
mod parity;
mod repeats;
pub mod series;
mod stamps;
mod usable;

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use caudata_model::{BaseKind, RobotModel};
use caudata_runlog::{BaseHold, LogError, RunLog};
use serde::{Deserialize, Serialize};

pub use blind::{Blind, blind};
pub use excites::{JointExcitation, RunExcitation};
pub use repeats::OddSpan;

use crate::reading::known_conditions;
use crate::report::DataFault;
use channels::Channels;
pub(crate) use finding::MAYBE_HELD;
use finding::{Finding, Run};
pub(crate) use holes::holes;

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
    /// Stretches that repeats do not show; a diagnosis leaves those out of which it is known whose they are.
    pub odd_spans: Vec<OddSpan>,
    /// What stands in the logs and no diagnosis reads, with the number of runs: columns, settings,
    /// topics.
    pub not_used: BTreeMap<String, usize>,
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

/// Reads logs and checks them together. A log that cannot be read becomes a fault.
pub fn check_dirs(
    dirs: &[impl AsRef<Path>],
    robot: &RobotModel,
) -> (Vec<(String, RunLog)>, Checked) {
    let mut logs = Vec::new();
    let mut unread = Vec::new();
    for (dir, name) in dirs.iter().zip(run_names(dirs)) {
        match RunLog::read(dir.as_ref()) {
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

/// The names that reports give to the runs of logs: a folder's, or a file's without what that ends with; where
/// several would have the same, their paths.
pub fn run_names(logs: &[impl AsRef<Path>]) -> Vec<String> {
    let short = |log: &Path| {
        let name = if log.is_file() { log.file_stem() } else { log.file_name() };
        let name = name.unwrap_or(log.as_os_str());
        name.to_string_lossy().into_owned()
    };
    let names: Vec<String> = logs.iter().map(|log| short(log.as_ref())).collect();
    let alone = |name: &String| names.iter().filter(|n| *n == name).count() == 1;
    let name = |(name, log): (&String, &_)| match alone(name) {
        true => name.clone(),
        false => AsRef::<Path>::as_ref(log).display().to_string(),
    };
    names.iter().zip(logs).map(name).collect()
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
    DataFault { kind: kind.to_owned(), location: name.to_owned(), detail: text, fatal: true }
}

/// The runs of these logs, each on its grid.
fn runs_of<'a>(logs: &[(&'a str, &'a RunLog)], robot: &'a RobotModel) -> Vec<Run<'a>> {
    let run = |&(name, log): &(&str, &'a RunLog)| Run {
        name: name.to_owned(),
        log,
        robot,
        grid: series::Grid::of(&log.table),
    };
    logs.iter().map(run).collect()
}

/// Whether what a run notes of itself can be said of the robot.
fn conditions(run: &Run<'_>, out: &mut Vec<Finding>) {
    if let Err(why) = known_conditions(run.robot, run.log) {
        out.push(Finding::fatal("meta", "conditions", why));
    }
    if run.robot.base() == BaseKind::Fixed && run.log.meta.base == BaseHold::Free {
        let detail =
            "says `base = \"free\"`, and the base of the robot file is fixed: one of them is wrong";
        out.push(Finding::fatal("meta", "base", detail.to_owned()));
    }
}

/// Checks runs (name and log) of `robot` together.
pub fn check(logs: &[(&str, &RunLog)], robot: &RobotModel) -> Checked {
    let runs = runs_of(logs, robot);
    let mut faults = Vec::new();
    let mut checks = Vec::new();
    let mut channels = Vec::new();
    for run in &runs {
        let mut found = Vec::new();
        let joints = Channels::all(run);
        conditions(run, &mut found);
        if usable::usable(run, &joints, &mut found) {
            stamps::faults(run, &joints, &mut found);
            joints::faults(run, &joints, &mut found);
            late::faults(run, &joints, &mut found);
            parity::faults(run, &joints, &mut found);
        }
        let excites = excites::of(run, &joints);
        found.extend(parity::held(run, &excites));
        faults.extend(found.into_iter().map(|f| fault(&run.name, f)));
        checks.push(RunCheck {
            name: run.name.clone(),
            rows: run.log.table.len(),
            rate_hz: 1.0 / series::median_step_s(&series::busiest(&run.log.table)).max(1e-9),
            excites,
        });
        channels.push(joints);
    }
    let groups = repeats::groups(&runs, &channels);
    let mut odd = Vec::new();
    // Runs that contradict themselves differ from their repeats for that reason.
    if !faults.iter().any(|f| f.fatal) {
        faults.extend(repeats::unlike(&runs, &channels, &groups).into_iter().map(|f| fault("", f)));
        for group in &groups {
            let spans = repeats::odd_spans(&runs, &channels, group);
            let as_fault = |s: &OddSpan| fault("", repeats::finding(s, group.len()));
            faults.extend(spans.iter().map(as_fault));
            odd.extend(spans);
        }
    }
    faults.sort_by_key(|f| !f.fatal);
    let excitations: Vec<RunExcitation> = checks.iter().map(|c| c.excites.clone()).collect();
    faults.extend(assumed(robot, &excitations));
    faults.extend(assumed_gain(robot, &runs));
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
        not_used: usable::not_used(&runs),
        cannot_tell: blind(logs, &excitations, robot),
        runs: checks,
    }
}

/// Stretches of one of at least three repeats that the others do not show.
pub(crate) fn touched(logs: &[(&str, &RunLog)], robot: &RobotModel) -> Vec<OddSpan> {
    let runs = runs_of(logs, robot);
    let channels: Vec<Vec<Channels>> = runs.iter().map(Channels::all).collect();
    let groups = repeats::groups(&runs, &channels).into_iter().filter(|g| g.len() > 2);
    groups.flat_map(|g| repeats::odd_spans(&runs, &channels, &g)).collect()
}

/// Kind of a note that something stands on an assumed figure of the robot file.
pub(crate) const ASSUMED: &str = "assumed";

/// Nearly as fast (speeds are means over 60 ms) as an assumed figure, as a share of it.
const NEARLY: f64 = 0.75;

/// The joint that turns about as fast as an assumed figure lets it have its torque, or faster, and currents whose
/// torque is assumed, once for each type of servo.
fn assumed(robot: &RobotModel, runs: &[RunExcitation]) -> Vec<DataFault> {
    let names = robot.actuated_names();
    let speed = |(a, name): (usize, &&str)| {
        let own = runs.iter().flat_map(|r| r.joints.iter().filter(|j| j.joint == **name));
        (a, own.map(|j| j.speed_max_radps).fold(0.0, f64::max))
    };
    let mut fastest: Vec<(usize, f64)> = names.iter().enumerate().map(speed).collect();
    fastest.sort_by(|a, b| b.1.total_cmp(&a.1));
    let (mut notes, mut told) = (Vec::new(), BTreeSet::new());
    for (a, speed) in fastest {
        let full = robot.servo(a).qd_tau_max_radps;
        if let Some(path) = robot.assumed_of_servo(a, "qd_tau_max_radps")
            && speed > NEARLY * full
            && told.insert(path)
        {
            let detail = format!(
                "turns at {speed:.0} rad/s, and that its torque falls from {full:.0} rad/s on is assumed: look up {path} and what follows it in the data sheet first"
            );
            notes.push(note(names[a].to_owned(), detail));
        }
    }
    for a in (0..names.len()).filter(|_| runs.iter().any(|r| r.channels.contains_key("cur"))) {
        if let Some(path) = robot.assumed_of_servo(a, "torque_per_current_nm_per_a")
            && told.insert(path)
        {
            let detail = format!(
                "is logged, and which torque a current stands for is assumed: look up {path} first, or leave currents out"
            );
            notes.push(note("cur".to_owned(), detail));
        }
    }
    notes
}

/// The gain of the position loop, if nobody looked it up and a run does not say which one was in force: what is wrong
/// with it hides everything else.
fn assumed_gain(robot: &RobotModel, runs: &[Run<'_>]) -> Option<DataFault> {
    const PATH: &str = "control.kp_nm_per_rad";
    let names = robot.actuated_names();
    let unsaid = |r: &Run<'_>| names.iter().any(|name| r.log.meta.gains(name).0.is_none());
    if !robot.assumed().iter().any(|path| path == PATH) || !runs.iter().any(unsaid) {
        return None;
    }
    let kp = robot.kp_nm_per_rad(0);
    let detail = format!(
        "of {kp:.3} is assumed, and not every log says which gain was in force: write kp and kd into log.toml, or look it up first"
    );
    Some(note(PATH.to_owned(), detail))
}

fn note(location: String, detail: String) -> DataFault {
    DataFault { kind: ASSUMED.to_owned(), location, detail, fatal: false }
}

fn fault(run: &str, f: Finding) -> DataFault {
    let location = if run.is_empty() { f.at } else { format!("{run} {}", f.at) };
    DataFault { kind: f.kind.to_owned(), location, detail: f.detail, fatal: f.fatal }
}
