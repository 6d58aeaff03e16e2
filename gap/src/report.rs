//! `report.json`: what a diagnosis found. The keys are a contract (docs/reference/json.md): add, never
//! rename.

use std::collections::BTreeMap;

pub use caudata_model::ExtensionParameter as Parameter;
use caudata_runlog::Payload;
use serde::{Deserialize, Serialize};

/// The outcome of a diagnosis.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Report {
    /// The outcome in one word.
    pub verdict: Verdict,
    /// One sentence for a person: what was found, and what to do next.
    pub summary: String,
    /// Where simulation and measurement part before anything was changed, worst first.
    pub divergence: Vec<Divergence>,
    /// The same cells with the extended model; empty where the model was not extended.
    #[serde(default)]
    pub divergence_after: Vec<Divergence>,
    /// Named causes, strongest first.
    pub causes: Vec<Cause>,
    /// Effects that the extended model carries beside them and that are no findings, since they take less off
    /// than they leave: they may be there, and may make up for what a cause's law lacks. Strongest first.
    #[serde(default)]
    pub leads: Vec<Cause>,
    /// What speaks against the causes; not empty where the verdict is [`Verdict::PartlyExplained`].
    #[serde(default)]
    pub doubts: Vec<Doubt>,
    /// By signal: error on held-out runs before and after.
    pub gain: BTreeMap<String, Gain>,
    /// Mean absolute error of the joints' angles over whole held-out runs: of the robot as given, of standard
    /// models fitted to the same runs, and of the extended model, in this order.
    #[serde(default)]
    pub position_errors: Vec<PositionError>,
    /// Everything that the extended model carries, named or not.
    #[serde(default)]
    pub model: Vec<Carried>,
    /// Stretches of a few seconds in which a joint is far off with the extended model, worst first.
    #[serde(default)]
    pub local_gaps: Vec<LocalGap>,
    /// Whether time ended before everything was tried: this is the best so far.
    #[serde(default)]
    pub unfinished: bool,
    /// What is left that no cause of the catalogue explains.
    pub unexplained: Vec<Unexplained>,
    /// What to record next, and why.
    pub next_experiment: Option<NextExperiment>,
    /// By effect id (`effect` or `effect@joint`): the smallest size that would have been seen in these runs.
    pub detection_floor: BTreeMap<String, Floor>,
    /// Faults of the data themselves.
    #[serde(default)]
    pub data_faults: Vec<DataFault>,
    /// Runs used, and how.
    pub runs: Vec<RunUse>,
    /// What it took.
    pub compute: Compute,
}

/// The seven outcomes.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Verdict {
    /// Simulation and measurement agree within what repeats differ by.
    NoGap,
    /// The gap has named causes that leave nothing over.
    Explained,
    /// Several causes explain it as well; the next experiment, if there is one, tells some of them apart.
    Ambiguous,
    /// Named causes explain a part of it.
    PartlyExplained,
    /// A gap that no cause of the catalogue explains.
    #[default]
    Unexplained,
    /// What would show the effect was not recorded or not excited.
    InsufficientData,
    /// The data contradict themselves.
    DataFault,
}

/// One cell of the divergence map.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Divergence {
    /// Kind of signal: `pos`, `vel`, `cur`, `imu.gyro`, …
    pub signal: String,
    /// Joint, link or axis; empty for the whole robot.
    pub joint: String,
    /// Part of the run: `all`, `slow`, `fast`, `reversal`, `loaded`, `stance`, …
    pub regime: String,
    /// Root mean square of measured minus simulated, in the signal's SI unit.
    pub rmse: f64,
    /// Root mean square by which repeats of one run differ, same unit.
    pub noise_floor: f64,
    /// `rmse / noise_floor`.
    pub ratio: f64,
    /// Family-wise probability of a cell this bad where nothing is wrong.
    pub p: f64,
}

/// A named cause.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Cause {
    /// Effect id of the catalogue.
    pub effect: String,
    /// `sensing`, `timing`, `actuation`, `transmission`, `structure`, `inertia`, `contact`, `water`.
    pub layer: String,
    /// Joints or links; empty = the whole robot.
    #[serde(rename = "where")]
    pub location: Vec<String>,
    /// By name.
    pub parameters: BTreeMap<String, Parameter>,
    /// Probability that this name is right, 0 to 1: its share of the next.
    pub confidence: f64,
    /// Calibrated probability that this name, or one of its kind that these runs do not tell from it (two delays, two
    /// gains), is right.
    #[serde(default)]
    pub confidence_of_kind: f64,
    /// Effect ids that explain it as well, alone or two of them together.
    pub alternatives: Vec<String>,
    /// Those of `alternatives` that explain it as well two together, and not alone: on a hinge a mass and a rotor
    /// are what a weight on the link is.
    #[serde(default)]
    pub together: Vec<Vec<String>>,
    /// Those of `alternatives` that are the very same robot: no reading of any trial of the battery tells them
    /// from it.
    #[serde(default)]
    pub synonyms: Vec<String>,
    /// Other places at which the same effect explains it as well.
    #[serde(default)]
    pub elsewhere: Vec<Vec<String>>,
    /// Text and numbers that speak for it.
    pub evidence: Vec<String>,
    /// Look-alikes that were tried, and why they fell.
    pub rejected: Vec<Rejected>,
    /// Figures of the robot file that it corrects and that nobody looked up, by their paths: where there are
    /// any, it may be the file that is wrong.
    #[serde(default)]
    pub assumed: Vec<String>,
    /// What `confidence` rests on.
    #[serde(default)]
    pub grounds: Grounds,
}

/// What the confidence in a name rests on.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Grounds {
    /// Probability of the name among its look-alikes, by what they leave.
    pub among_look_alikes: f64,
    /// Misfit that the whole model leaves where it is most, of fitted or held-out runs, floors.
    pub left: f64,
    /// The same as a share of what the robot as given has where it is most.
    pub left_share: f64,
    /// Whether it is no more than careful labs leave.
    pub little_left: bool,
    /// Share of the misfit at its place that the cause takes off in cross-validation.
    pub gain: f64,
    /// Root mean square by which its size differs between parts of the data, or that of another cause at its place,
    /// as a share of it.
    pub scatter: f64,
    /// How far it is from no effect, in halves of its 95 % interval.
    pub distance: f64,
    /// Whether its size, or that of another cause at its place, lies at a bound.
    pub at_bound: bool,
}

impl Cause {
    /// What the confidence in the name alone leaves out, in words; nothing where it is no less.
    pub fn of_kind(&self) -> String {
        let (own, kind) = (100.0 * self.confidence, 100.0 * self.confidence_of_kind);
        match kind.round() > own.round() {
            true => format!(" ({kind:.0} % that it is this or one of its kind)"),
            false => String::new(),
        }
    }

    /// Whether another name, or another place, explains it as well.
    pub fn is_open(&self) -> bool {
        !self.alternatives.is_empty() || !self.elsewhere.is_empty()
    }

    /// Whether a name that is another robot explains it as well.
    pub fn has_open_name(&self) -> bool {
        self.alternatives.iter().any(|a| !self.synonyms.contains(a))
    }

    /// All that explain it alike, in words: `a at x or at y or b`.
    pub fn rivals(&self) -> String {
        let mut out = self.effect.clone();
        if !self.elsewhere.is_empty() {
            out.push_str(&format!(" at {}", self.location.join(", ")));
        }
        for place in &self.elsewhere {
            out.push_str(&format!(" or at {}", place.join(", ")));
        }
        for names in self.as_good(&str::to_owned) {
            out.push_str(&format!(" or {names}"));
        }
        out
    }

    /// What explains it as well, in words: `a`, `b with c`.
    pub fn as_good(&self, name: &dyn Fn(&str) -> String) -> Vec<String> {
        let alone =
            self.alternatives.iter().filter(|a| !self.together.iter().flatten().any(|t| t == *a));
        let all = |two: &Vec<String>| {
            let names: Vec<String> = two.iter().map(|id| name(id)).collect();
            names.join(" with ")
        };
        alone.map(|id| name(id)).chain(self.together.iter().map(all)).collect()
    }
}

/// A look-alike that fell.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Rejected {
    /// Effect id.
    pub effect: String,
    /// Why, with numbers.
    pub reason: String,
}

/// What speaks against an explanation.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Doubt {
    /// What kind.
    pub kind: DoubtKind,
    /// Joint, or effect and its place; empty: the whole robot.
    #[serde(rename = "where")]
    pub location: String,
    /// In a sentence, with numbers.
    pub detail: String,
}

/// Kinds of [`Doubt`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum DoubtKind {
    /// More is left than careful labs differ by.
    MuchLeft,
    /// A cause would have to be larger than it can plausibly be.
    ImplausibleSize,
    /// Two causes take back nearly all that either does.
    Cancelling,
    /// A cause has another size in each part of the data.
    InconstantSize,
}

/// Error of a signal on held-out runs.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Gain {
    /// Root mean square error of the model given, SI.
    pub before: f64,
    /// The same for the extended model.
    pub after: f64,
    /// `after / before`.
    pub ratio: f64,
    /// Lower end of the 95 % interval of the ratio.
    pub ci_low: f64,
    /// Upper end.
    pub ci_high: f64,
}

/// How far a model's angles are off over whole runs.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PositionError {
    /// `as given`, the name of a standard model, or `extended`.
    pub model: String,
    /// Mean absolute error on held-out runs, mean over joints, rad.
    pub mean_rad: f64,
    /// The same on the runs that were fitted, rad.
    pub fitted_mean_rad: f64,
    /// By joint, on held-out runs, rad.
    pub joints_rad: BTreeMap<String, f64>,
    /// Those of them that slide: their errors are m, and count tenfold in the means.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub slides: Vec<String>,
}

impl PositionError {
    /// What to say of the units of a table of such errors.
    pub fn units(&self) -> &'static str {
        if self.slides.is_empty() { "rad" } else { "rad; of slides m, ten times in the mean" }
    }
}

/// An effect that the extended model carries.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Carried {
    /// Effect id.
    pub effect: String,
    /// Joints or links; empty: the whole robot.
    #[serde(rename = "where")]
    pub location: Vec<String>,
    /// Whether it is one of the causes or leads. If not, the runs support it and its name is no finding.
    pub named: bool,
    /// Values by name, SI.
    pub parameters: BTreeMap<String, f64>,
}

/// A stretch in which a joint is far off.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct LocalGap {
    /// Name of the run.
    pub run: String,
    /// Joint.
    pub joint: String,
    /// Begins here, s.
    pub from_s: f64,
    /// Ends here, s.
    pub to_s: f64,
    /// Root mean square error of its angle there, rad.
    pub rms_rad: f64,
    /// Unit of that: of a joint that slides m.
    #[serde(default = "radians")]
    pub unit: String,
    /// The same in tolerances (whitened), over a whole window: a shorter one at the end of a run counts less.
    pub ratio: f64,
}

fn radians() -> String {
    "rad".to_owned()
}

/// What is left over.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Unexplained {
    /// Joint, link or signal.
    #[serde(rename = "where")]
    pub location: String,
    /// Arguments on which it depends, strongest first.
    pub depends_on: Vec<String>,
    /// In words or as a formula.
    pub description: String,
    /// The effect of the catalogue that comes closest.
    pub nearest: Option<String>,
}

/// What to record next.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct NextExperiment {
    /// Name of a trial of the excitation battery.
    pub trial: String,
    /// Joints that it moves; empty = all.
    pub joints: Vec<String>,
    /// Why this one.
    pub reason: String,
    /// Effects that it tells apart or makes visible.
    pub separates: Vec<String>,
    /// A known weight that has to hang on the robot in this trial.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub payload: Option<Payload>,
}

/// Smallest size of an effect that would have been seen.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Floor {
    /// Name of the parameter.
    pub parameter: String,
    /// Its size; infinite sizes are left out by giving `excited = false`.
    pub value: f64,
    /// SI.
    pub unit: String,
    /// Whether the runs excite the effect at all.
    pub excited: bool,
}

/// A fault of the data.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct DataFault {
    /// `sign`, `unit`, `order`, `stamps`, `stuck`, `gap`, `parity`, …
    pub kind: String,
    /// Column or joint.
    #[serde(rename = "where")]
    pub location: String,
    /// What is wrong, with numbers, and what to do.
    pub detail: String,
    /// Whether diagnosis must stop.
    pub fatal: bool,
}

/// A run and its role.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RunUse {
    /// Folder name.
    pub name: String,
    /// `fit` or `holdout`.
    pub role: String,
    /// s.
    pub duration_s: f64,
    /// SHA-256 of the log file.
    pub sha256: String,
}

/// What a diagnosis took.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Compute {
    /// (effect, scope) pairs that were tried.
    pub candidates: usize,
    /// Simulated runs.
    pub rollouts: usize,
    /// Simulated time, s.
    pub simulated_s: f64,
    /// Wall time, s; 0 where nobody measured it.
    pub seconds: f64,
}
