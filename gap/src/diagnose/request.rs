//! What a diagnosis is made from, and what it gives.

use crate::extension::Extension;
use crate::go_on::GoOn;
use crate::plots::Plots;
use crate::report::{DataFault, Report};
use crate::trial::Run;

/// What a diagnosis is made from.
#[derive(Debug, Clone)]
pub struct Request {
    /// The robot file, as bytes, and a name for it in messages.
    pub robot_toml: Vec<u8>,
    /// The MJCF that it names.
    pub mjcf: Vec<u8>,
    /// Names the robot file in messages.
    pub label: String,
    /// In order of recording.
    pub runs: Vec<Run>,
    /// Faults that a check of the data found. A fatal one ends the diagnosis.
    pub data_faults: Vec<DataFault>,
    /// Settings.
    pub options: Options,
}

/// Settings of a diagnosis.
#[derive(Debug, Clone)]
pub struct Options {
    /// Threads; results do not depend on it.
    pub threads: usize,
    /// Seed of resampling.
    pub seed: u64,
    /// Effects that are not tried, by id.
    pub without: Vec<String>,
    /// Only these are tried, by id; empty: all.
    pub only: Vec<String>,
    /// Whether to go on. Where it says no once there is something to tell, that is told.
    pub go_on: GoOn,
    /// After so long the best so far is reported, s; none: when everything was tried.
    pub budget_s: Option<f64>,
}

impl Default for Options {
    fn default() -> Self {
        Self {
            threads: 2,
            seed: 1,
            without: Vec::new(),
            only: Vec::new(),
            go_on: GoOn::default(),
            budget_s: None,
        }
    }
}

/// What a diagnosis gives.
#[derive(Debug, Clone)]
pub struct Diagnosis {
    /// `report.json`.
    pub report: Report,
    /// What goes into the extended robot file.
    pub extension: Extension,
    /// What the page draws.
    pub plots: Plots,
}

/// What it is doing.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Stage {
    /// Reading runs, noise.
    Reading,
    /// Trying sizes of every effect.
    Screening,
    /// Fitting the promising ones.
    Fitting,
    /// Fitting models of angles alone.
    Tracking,
    /// A cause was accepted.
    Accepted,
    /// Looking for look-alikes.
    Naming,
    /// Floors, intervals, pictures.
    Reporting,
}

/// How far it is.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Progress {
    /// What it is doing.
    pub stage: Stage,
    /// Which round of extension, from 1.
    pub round: usize,
    /// The model that it works on, in words.
    pub model: String,
}

impl Progress {
    pub(super) fn new(stage: Stage, round: usize, model: &str) -> Self {
        let model = if model.is_empty() { "robot as given" } else { model };
        Self { stage, round, model: model.to_owned() }
    }
}

/// How held-out runs came about.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Split {
    /// They were given.
    Given,
    /// A third of the groups of repeats was set aside.
    SetAside,
    /// There are too few runs: what was fitted is judged on the same runs.
    Same,
}
