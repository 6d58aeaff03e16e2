//! What the report page draws: plain numbers, in SI units, that serialise to JSON. Nothing here is needed to
//! read the verdict.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

/// Everything that a diagnosis can show in pictures.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Plots {
    /// The cells that part most, measured against simulated, worst first. At most eight.
    pub overlays: Vec<Overlay>,
    /// One or more per effect of the extended model that has a picture.
    pub signatures: Vec<Signature>,
    /// Error against prediction horizon, by signal.
    pub horizons: Vec<Horizon>,
    /// Every hypothesis that was refined, best first.
    pub hypotheses: Vec<Hypothesis>,
    /// Correlation of the fitted parameters.
    pub correlation: Correlation,
}

/// Measured and simulated signal over a stretch of one run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Overlay {
    /// Folder name of the run.
    pub run: String,
    /// Kind of signal: `pos`, `vel`, ….
    pub signal: String,
    /// Joint, link or axis.
    pub joint: String,
    /// SI.
    pub unit: String,
    /// s. `[N]`
    pub time_s: Vec<f64>,
    /// What was commanded, where the signal is a position; empty otherwise. `[N]`
    pub command: Vec<f64>,
    /// Mean of the repeats, or the run itself. Gaps are `None`. `[N]`
    pub measured: Vec<Option<f64>>,
    /// Lowest of the repeats (the run itself less its noise where there are none). `[N]`
    pub measured_low: Vec<Option<f64>>,
    /// Highest. `[N]`
    pub measured_high: Vec<Option<f64>>,
    /// The model given. `[N]`
    pub before: Vec<f64>,
    /// The extended model; empty where it was not extended. `[N]`
    pub after: Vec<f64>,
}

/// A picture that shows a cause by its own mark: friction map, lag against frequency, plateau, work per
/// cycle, ….
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Signature {
    /// Effect id.
    pub effect: String,
    /// Joint, link; empty for the whole robot.
    pub joint: String,
    /// What is shown, in a few words.
    pub title: String,
    /// Label of the horizontal axis, with unit.
    pub x_label: String,
    /// Label of the vertical axis, with unit.
    pub y_label: String,
    /// Curves or point clouds.
    pub series: Vec<Series>,
}

/// One curve.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Series {
    /// `measured`, `before`, `after`, or what the curve is.
    pub label: String,
    /// Points to draw singly instead of a line.
    pub scatter: bool,
    /// `[N]`
    pub x: Vec<f64>,
    /// `[N]`
    pub y: Vec<f64>,
    /// Half width of a band around it; empty: none. `[N]`
    #[serde(default)]
    pub spread: Vec<f64>,
}

/// Error on held-out runs against how far ahead is predicted.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Horizon {
    /// Kind of signal.
    pub signal: String,
    /// SI.
    pub unit: String,
    /// Horizons, s; the last is the whole run. `[N]`
    pub horizon_s: Vec<f64>,
    /// Root mean square error of the model given. `[N]`
    pub before: Vec<f64>,
    /// The same in the extended model; empty where it was not extended. `[N]`
    pub after: Vec<f64>,
    /// What repeats differ by. `[N]`
    pub floor: Vec<f64>,
}

/// A hypothesis that was fitted.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Hypothesis {
    /// Effect id.
    pub effect: String,
    /// Joints, links; empty = the whole robot.
    pub location: Vec<String>,
    /// Share of the misfit that it takes away on the runs it was fitted to, 0 to 1.
    pub share_fit: f64,
    /// The same on held-out runs (negative: makes it worse).
    pub share_holdout: f64,
    /// 95 % interval of that.
    pub ci_low: f64,
    /// Upper end.
    pub ci_high: f64,
    /// Probability that it is the cause, given that one of the catalogue is.
    pub probability: f64,
    /// Part of the answer set.
    pub in_answer_set: bool,
    /// Accepted as a cause.
    pub accepted: bool,
    /// Fitted parameters.
    pub parameters: BTreeMap<String, f64>,
}

/// Correlation matrix of parameters that were fitted together.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Correlation {
    /// `effect@joint.parameter`. `[P]`
    pub names: Vec<String>,
    /// Row by row, −1 to 1. `[P, P]`
    pub matrix: Vec<Vec<f64>>,
}
