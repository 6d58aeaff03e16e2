//! What came of each way to train.

use std::path::PathBuf;

use caudata_evaluation::{ScenarioResult, SuiteResult};
use serde::Serialize;

use super::figures::{Figures, Run};
use super::speed::{Speed, Walks};
use super::ways::{Effort, Robots, Way};

/// `policies.json`.
#[derive(Debug, Serialize)]
pub struct Compared {
    /// Trainings of each kind that are there.
    pub seeds: u64,
    /// Iterations of each.
    pub iterations: u64,
    /// Suite of the evaluations.
    pub suite: String,
    /// One entry per way to train; the first is the model as given.
    pub ways: Vec<Trained>,
    /// Wall time of each step of this call, s.
    pub seconds: Vec<(String, f64)>,
}

impl Compared {
    /// What the policies amount to that are there: of each of `kinds` one per seed, the same seeds of all.
    pub fn of(
        robots: &Robots,
        effort: &Effort,
        kinds: &[Way],
        sets: &[Vec<String>],
        made: &[Vec<Policy>],
    ) -> Self {
        let runs: Vec<Vec<Runs>> =
            made.iter().map(|policies| policies.iter().map(|p| p.runs).collect()).collect();
        let each = kinds.iter().zip(sets).zip(made).enumerate();
        let ways = each.map(|(k, ((way, set), made))| {
            let of = |pick: &dyn Fn(&Runs) -> Run| runs[k].iter().map(pick).collect::<Vec<_>>();
            let given = |pick: &dyn Fn(&Runs) -> Run| runs[0].iter().map(pick).collect::<Vec<_>>();
            let less = |pick: &dyn Fn(&Runs) -> Run| {
                (k > 0).then(|| Figures::less(&of(pick), &given(pick)))
            };
            Trained {
                way: *way,
                robot: way.robot(robots).to_owned(),
                set: set.clone(),
                at_home: Figures::of(&of(&|r| r.at_home)),
                in_truth: Figures::of(&of(&|r| r.in_truth)),
                in_rapier: Figures::of(&of(&|r| r.in_rapier)),
                gain: less(&|r| r.in_truth),
                gain_in_rapier: less(&|r| r.in_rapier),
                speed: Speed::of(made.iter().map(|p| &p.walks)),
                policies: made.clone(),
            }
        });
        Self {
            seeds: made.first().map_or(0, |policies| policies.len() as u64),
            iterations: effort.iterations,
            suite: effort.suite.name().to_owned(),
            ways: ways.collect(),
            seconds: Vec::new(),
        }
    }
}

/// A way to train, and what came of it.
#[derive(Debug, Serialize)]
pub struct Trained {
    /// Which way.
    pub way: Way,
    /// Robot file that it was trained in.
    pub robot: PathBuf,
    /// Keys that were set for it.
    pub set: Vec<String>,
    /// One per seed.
    pub policies: Vec<Policy>,
    /// In the model that it was trained in (of wide randomisation: in the middle of it).
    pub at_home: Figures,
    /// On the true robot.
    pub in_truth: Figures,
    /// On the true robot in Rapier, forward velocities that change.
    pub in_rapier: Figures,
    /// What it has less of on the true robot than what was trained in the model as given; null for that.
    pub gain: Option<Figures>,
    /// The same in Rapier.
    pub gain_in_rapier: Option<Figures>,
    /// Forward velocity over time in Rapier.
    pub speed: Speed,
}

/// One training.
#[derive(Clone, Debug, Serialize)]
pub struct Policy {
    /// Its seed.
    pub seed: u64,
    /// Its file.
    pub policy: PathBuf,
    /// In the model that it was trained in.
    pub at_home: SuiteResult,
    /// On the true robot.
    pub in_truth: SuiteResult,
    /// On the true robot in Rapier.
    pub in_rapier: ScenarioResult,
    /// The same added up.
    #[serde(skip)]
    pub runs: Runs,
    /// Its velocities in Rapier.
    #[serde(skip)]
    pub walks: Walks,
}

/// What one policy did.
#[derive(Clone, Copy, Debug, Default)]
pub struct Runs {
    /// In the model that it was trained in.
    pub at_home: Run,
    /// On the true robot.
    pub in_truth: Run,
    /// There, in Rapier.
    pub in_rapier: Run,
}
