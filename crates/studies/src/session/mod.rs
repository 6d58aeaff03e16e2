//! A diagnosis that asks for its own experiments: record, diagnose, choose what to record next, until it is
//! sure or says that it cannot be.
//!
//! Everything lies in one folder: `logs/01_chirp_medium`, …, one per round; `rounds/03`, …, the diagnosis of
//! all logs up to there; `session.json`. The same command goes on where it was. A simulated robot is recorded
//! at once; for any other the command file of the next trial is written, and its log is waited for.

mod choose;
mod work;

use std::path::PathBuf;

use caudata_gap::report::Verdict;
use caudata_runlog::{BaseHold, Payload};
use clap::{Args, ValueEnum};
use serde::{Deserialize, Serialize};

use crate::Table;
use crate::adapt::Named;
use crate::diagnosis::seconds;

pub use work::session;

/// What a session leaves in its folder beside logs and diagnoses.
pub const SESSION: &str = "session.json";
/// Where trials are done.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Place {
    /// Clamped, or hung up by the trunk
    Stand,
    /// On its feet
    Ground,
    /// Afloat
    Water,
}

impl Place {
    fn base(self) -> BaseHold {
        match self {
            Self::Stand => BaseHold::Fixed,
            Self::Ground => BaseHold::Free,
            Self::Water => BaseHold::Water,
        }
    }
}

/// What to diagnose, and what it may take.
#[derive(Clone, Debug, Args)]
pub struct Plan {
    /// Folder of the session: logs, diagnoses, session.json. The same command goes on in it
    #[arg(value_name = "DIR")]
    pub dir: PathBuf,
    /// Robot file
    #[arg(long, value_name = "R.robot.toml")]
    pub robot: PathBuf,
    /// Robot file of a robot to be simulated, which trials are recorded of; without it command files are
    /// written for a real one
    #[arg(long, value_name = "T.robot.toml")]
    pub truth: Option<PathBuf>,
    /// Where trials can be done
    #[arg(long, value_enum, value_delimiter = ',', default_values = ["stand", "ground"])]
    pub place: Vec<Place>,
    /// Motion of the robot that it may take, all trials together
    #[arg(long, value_name = "TIME", default_value = "120s", value_parser = seconds)]
    pub motion: f64,
    /// Each diagnosis reports its best so far after about so long. Default: when everything was tried
    #[arg(long, value_name = "TIME", value_parser = seconds)]
    pub budget: Option<f64>,
    /// Wait so long for the log of each trial; without it the command ends there, to be started again
    #[arg(long, value_name = "TIME", value_parser = seconds, conflicts_with = "truth")]
    pub wait: Option<f64>,
    /// Effects that are not tried, by id
    #[arg(long, value_name = "ID")]
    pub without: Vec<String>,
    /// Only these effects are tried, by id
    #[arg(long, value_name = "ID")]
    pub only: Vec<String>,
    /// Threads; the result does not depend on it. Default: as many as the machine has
    #[arg(long, value_name = "N")]
    pub threads: Option<usize>,
    /// Seed of resampling, and of a simulated robot's noise and day
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
}

/// How a session stands.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Ending {
    /// It is sure of its verdict.
    Sure,
    /// It is not, and cannot be within what it may take.
    Unsure,
    /// It waits for a log.
    Waiting,
}

/// One trial, and what was known after it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Round {
    /// From 1.
    pub round: usize,
    /// Name in the battery.
    pub trial: String,
    /// Why this one.
    pub why: String,
    /// A known weight that hung on the robot.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub payload: Option<Payload>,
    /// Motion up to here, s.
    pub motion_s: f64,
    /// Mean absolute error of the joints' angles as given, rad; none where nothing was diagnosed yet.
    pub given_rad: Option<f64>,
    /// The same with the extended model, rad.
    pub left_rad: Option<f64>,
    /// Verdict on all logs up to here.
    pub verdict: Option<Verdict>,
    /// Causes, strongest first: `effect` or `effect@place`.
    pub names: Vec<String>,
}

/// A trial to be recorded.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Next {
    /// Name in the battery.
    pub trial: String,
    /// Why this one.
    pub why: String,
    /// How the robot is held.
    pub base: BaseHold,
    /// What to send it.
    pub commands: PathBuf,
    /// Where the log folder belongs, or a folder of repeats.
    pub log: PathBuf,
    /// A known weight to hang on the robot, which the log has to note.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub payload: Option<Payload>,
}

/// A weight as `log.toml` notes it, in one line.
pub fn noted(weight: &Payload) -> String {
    let [x, y, z] = weight.at_m;
    format!(
        "payload = [{{ link = \"{}\", mass_kg = {:.3}, at_m = [{x:.4}, {y:.4}, {z:.4}] }}]",
        weight.link, weight.mass_kg
    )
}

/// `session.json`.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Session {
    /// How it stands.
    pub ending: Ending,
    /// Why it ended, or waits.
    pub reason: String,
    /// Verdict of the last diagnosis.
    pub verdict: Option<Verdict>,
    /// Its causes.
    pub causes: Vec<Named>,
    /// All motion, s.
    pub motion_s: f64,
    /// In order.
    pub rounds: Vec<Round>,
    /// What it waits for.
    pub next: Option<Next>,
    /// Folder of the last diagnosis.
    pub diagnosis: Option<PathBuf>,
}

impl Session {
    /// Its rounds.
    pub fn table(&self) -> Table {
        let head =
            ["round", "trial", "why", "motion s", "off mrad", "left mrad", "verdict", "causes"];
        let mrad = |rad: Option<f64>| rad.map_or("-".to_owned(), |x| format!("{:.1}", 1e3 * x));
        let row = |r: &Round| {
            let verdict = serde_json::to_value(r.verdict).unwrap_or_default();
            vec![
                r.round.to_string(),
                r.trial.clone(),
                r.why.clone(),
                format!("{:.0}", r.motion_s),
                mrad(r.given_rad),
                mrad(r.left_rad),
                verdict.as_str().unwrap_or("-").to_owned(),
                r.names.join(" "),
            ]
        };
        Table {
            head: head.map(str::to_owned).to_vec(),
            rows: self.rounds.iter().map(row).collect(),
        }
    }
}
