//! What others would do with the same logs, in the same engine: least squares on everything, evolution on a
//! fixed set, forward selection by BIC, an unnamed residual; and the oracle, who knows the structure and only
//! fits.

pub mod data;
pub mod evolve;
pub mod fit;
pub mod residual;

use std::path::Path;
use std::time::Instant;

use caudata_gap::check::series::median;
use serde::Serialize;

use crate::case::{Answer, Block};
use crate::score::Rate;
use data::{CaseData, DataError};

/// Generations of the evolution.
const GENERATIONS: usize = 25;

/// One baseline on one case.
#[derive(Clone, Debug, Serialize)]
pub struct BaselineOutcome {
    /// Which.
    pub baseline: &'static str,
    /// Names, strongest first.
    pub names: Vec<String>,
    /// Error on held-out runs, after over before.
    pub holdout_ratio: f64,
    /// s.
    pub seconds: f64,
}

/// The names of the baselines, in the order of [`all`].
pub const NAMES: [&str; 5] = [
    "least squares on all",
    "CMA-ES on a fixed set",
    "forward selection by BIC",
    "unnamed residual",
    "oracle",
];

/// Every baseline on a case, and the oracle where the truth has a knob.
pub fn all(folder: &Path, answer: &Answer) -> Result<Vec<BaselineOutcome>, DataError> {
    let data = CaseData::read(folder)?;
    let mut out = Vec::new();
    let mut timed = |baseline,
                     work: &dyn Fn() -> Result<Option<(Vec<&'static str>, f64)>, DataError>|
     -> Result<(), DataError> {
        let began = Instant::now();
        if let Some((names, holdout_ratio)) = work()? {
            out.push(BaselineOutcome {
                baseline,
                names: names.into_iter().map(str::to_owned).collect(),
                holdout_ratio,
                seconds: began.elapsed().as_secs_f64(),
            });
        }
        Ok(())
    };
    let judged = |(fit, names): (fit::Fit, Vec<&'static str>)| {
        Ok(Some((names, data.holdout_ratio(&fit.terms)?)))
    };
    timed(NAMES[0], &|| judged(fit::fit_all(&data)?))?;
    timed(NAMES[1], &|| judged(evolve::evolve(&data, GENERATIONS)?))?;
    timed(NAMES[2], &|| judged(fit::forward_selection(&data)?))?;
    timed(NAMES[3], &|| Ok(Some((Vec::new(), residual::holdout_ratio(&data)?))))?;
    if matches!(answer.block, Block::Single | Block::Pair) {
        let truth: Vec<(String, String)> =
            answer.effects.iter().map(|e| (e.effect.clone(), e.joint.clone())).collect();
        timed(NAMES[4], &|| match fit::oracle(&data, &truth)? {
            Some(fit) => judged((fit, Vec::new())),
            None => Ok(None),
        })?;
    }
    Ok(out)
}

/// A baseline over a set.
#[derive(Clone, Debug, Serialize)]
pub struct BaselineSummary {
    /// Which.
    pub baseline: String,
    /// Nulls with any name.
    pub false_alarms: Rate,
    /// First name right, singles of d ≥ 3.
    pub first_large: Rate,
    /// Wrong names per single.
    pub wrong_per_case: f64,
    /// Median error on held-out runs after over before, singles of d ≥ 3.
    pub holdout_ratio: f64,
    /// Mean wall time, s.
    pub seconds: f64,
}

/// Sums up `(answer, outcomes)` per baseline.
pub fn summaries(all: &[(Answer, Vec<BaselineOutcome>)]) -> Vec<BaselineSummary> {
    NAMES
        .iter()
        .map(|name| {
            let mine: Vec<(&Answer, &BaselineOutcome)> = all
                .iter()
                .filter_map(|(a, o)| Some((a, o.iter().find(|o| o.baseline == *name)?)))
                .collect();
            let right = |a: &Answer, n: &str| {
                a.effects.iter().any(|t| t.effect == n || t.equivalent.iter().any(|e| e == n))
            };
            let large = |a: &Answer| {
                a.block == Block::Single && a.effects.first().is_some_and(|t| t.d >= 3.0)
            };
            let singles: Vec<_> = mine.iter().filter(|(a, _)| a.block == Block::Single).collect();
            let wrong: usize =
                singles.iter().map(|(a, o)| o.names.iter().filter(|n| !right(a, n)).count()).sum();
            let ratios: Vec<f64> =
                mine.iter().filter(|(a, _)| large(a)).map(|(_, o)| o.holdout_ratio).collect();
            BaselineSummary {
                baseline: (*name).to_owned(),
                false_alarms: Rate::count(
                    &mine,
                    |(a, _)| a.block == Block::Null,
                    |(_, o)| !o.names.is_empty(),
                ),
                first_large: Rate::count(
                    &mine,
                    |(a, _)| large(a),
                    |(a, o)| o.names.first().is_some_and(|n| right(a, n)),
                ),
                wrong_per_case: wrong as f64 / singles.len().max(1) as f64,
                holdout_ratio: median(ratios).unwrap_or(f64::NAN),
                seconds: mine.iter().map(|(_, o)| o.seconds).sum::<f64>()
                    / mine.len().max(1) as f64,
            }
        })
        .collect()
}
