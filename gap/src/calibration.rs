//! From evidence to a probability: how often names with such [`Grounds`] were right, and from what on a model is
//! doubted. The numbers are data, which `caudata bench calibrate` makes from robots whose laws are not the
//! catalogue's own.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::error::GapError;
use crate::report::Grounds;

/// The file that the program has.
const SHIPPED: &str = include_str!("calibration.json");
/// Version of the file's form.
pub const VERSION: u64 = 1;

/// What is known of names by their evidence.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Calibration {
    /// [`VERSION`].
    pub version: u64,
    /// The command that made it.
    pub command: String,
    /// Seed of its cases.
    pub seed: u64,
    /// How many cases gave a report.
    pub cases: u64,
    /// How many names they gave, leads included.
    pub names: u64,
    /// How many of these were right.
    pub right: u64,
    /// Nobody is surer than this: of the surest third of the names, what was right, by the rule of succession.
    pub surest: f64,
    /// From evidence to a probability.
    pub map: Map,
    /// The same before any of the cases: what rules by hand said of evidence from all over its range.
    pub by_hand: Map,
}

/// From evidence to a probability.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Map {
    /// Log odds that a name is right.
    pub log_odds: Weights,
    /// From what on a model is doubted.
    pub doubts: Thresholds,
}

/// Log odds that a name is right: a constant and a weight for each [feature](features).
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "BTreeMap<String, f64>", into = "BTreeMap<String, f64>")]
pub struct Weights {
    /// Log odds where all features are 0.
    pub constant: f64,
    /// In the order of [`FEATURES`].
    pub each: [f64; FEATURE_COUNT],
}

/// From what on something speaks against a model.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Thresholds {
    /// Floors left times their share of what there was.
    pub left: f64,
    /// Scatter of a cause's size.
    pub scatter: f64,
}

/// How many features there are.
pub const FEATURE_COUNT: usize = 7;
/// Name of each feature, and which way it may only count.
pub const FEATURES: [(&str, f64); FEATURE_COUNT] = [
    ("among_look_alikes", 1.0),
    ("gain", 1.0),
    ("distance", 1.0),
    ("much_left", -1.0),
    ("inconstant", -1.0),
    ("at_bound", -1.0),
    ("may_be_nothing", -1.0),
];
/// A probability among look-alikes is never told nearer to 0 or 1 than this: their number is finite.
const FINEST_TOLD: f64 = 0.02;

/// Grounds as the numbers that weights count, in the order of [`FEATURES`].
pub fn features(g: &Grounds, doubts: &Thresholds) -> [f64; FEATURE_COUNT] {
    let p = g.among_look_alikes.clamp(FINEST_TOLD, 1.0 - FINEST_TOLD);
    let flag = |x: bool| if x { 1.0 } else { 0.0 };
    [
        (p / (1.0 - p)).ln(),
        g.gain.clamp(0.0, 1.0),
        g.distance.max(0.0).ln_1p(),
        flag(doubts.much(g)),
        flag(g.scatter > doubts.scatter),
        flag(g.at_bound),
        flag(g.distance < 1.0),
    ]
}

impl Thresholds {
    /// Whether what is left is more than right explanations leave.
    pub fn much(&self, g: &Grounds) -> bool {
        !g.little_left && g.left * g.left_share > self.left
    }
}

impl Weights {
    /// Probability that a name is right.
    pub fn probability(&self, features: &[f64; FEATURE_COUNT]) -> f64 {
        let sum: f64 = self.each.iter().zip(features).map(|(w, x)| w * x).sum();
        1.0 / (1.0 + (-self.constant - sum).exp())
    }
}

impl TryFrom<BTreeMap<String, f64>> for Weights {
    type Error = String;

    fn try_from(of: BTreeMap<String, f64>) -> Result<Self, String> {
        let known = |key: &str| key == "constant" || FEATURES.iter().any(|f| f.0 == key);
        if let Some(key) = of.keys().find(|key| !known(key)) {
            return Err(format!("unknown key {key}"));
        }
        let take = |key: &str| of.get(key).copied().ok_or_else(|| format!("no {key}"));
        let mut weights = Self { constant: take("constant")?, ..Self::default() };
        for (weight, (name, _)) in weights.each.iter_mut().zip(FEATURES) {
            *weight = take(name)?;
        }
        Ok(weights)
    }
}

impl From<Weights> for BTreeMap<String, f64> {
    fn from(of: Weights) -> Self {
        let each = FEATURES.iter().map(|f| f.0).zip(of.each);
        let all = each.chain([("constant", of.constant)]);
        all.map(|(name, weight)| (name.to_owned(), weight)).collect()
    }
}

impl Calibration {
    /// The one that the program has.
    ///
    /// # Errors
    /// [`GapError::Calibration`].
    pub fn shipped() -> Result<Self, GapError> {
        Self::parse(SHIPPED)
    }

    /// Reads a file.
    ///
    /// # Errors
    /// [`GapError::Calibration`] where a key is unknown or missing, or the file is of another form.
    pub fn parse(text: &str) -> Result<Self, GapError> {
        let file: Self =
            serde_json::from_str(text).map_err(|e| GapError::Calibration(e.to_string()))?;
        match file.version {
            VERSION => Ok(file),
            other => {
                let what = format!("version {other} where {VERSION} is read");
                Err(GapError::Calibration(what))
            }
        }
    }

    /// The file.
    pub fn text(&self) -> String {
        // keys in order
        let file = serde_json::to_value(self).unwrap_or_default();
        format!("{file:#}\n")
    }

    /// How probable it is that a name with these grounds is right.
    pub fn confidence(&self, grounds: &Grounds) -> f64 {
        let told = (self.map.log_odds).probability(&features(grounds, &self.map.doubts));
        told.clamp((1.0 - self.surest).min(self.surest), self.surest)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_shipped_file_reads_and_counts_each_ground_its_way() {
        let shipped = Calibration::shipped().unwrap();
        let good = Grounds {
            among_look_alikes: 0.9,
            left: 0.5,
            left_share: 0.05,
            gain: 0.9,
            scatter: 0.02,
            distance: 8.0,
            ..Grounds::default()
        };
        let p = shipped.confidence(&good);
        assert!(p > 0.5 && p <= shipped.surest);
        let worse: [fn(&mut Grounds); 7] = [
            |g| g.among_look_alikes = 0.02,
            |g| g.left = 30.0,
            |g| g.left_share = 0.9,
            |g| g.gain = 0.2,
            |g| g.scatter = 0.9,
            |g| g.distance = 0.5,
            |g| g.at_bound = true,
        ];
        let mut all = good;
        for make_worse in worse {
            let mut one = good;
            make_worse(&mut one);
            make_worse(&mut all);
            assert!(shipped.confidence(&one) <= shipped.confidence(&good));
        }
        // what careful labs leave is not much, however little there was
        all.little_left = true;
        assert!(!shipped.map.doubts.much(&all));
        assert!(shipped.confidence(&all) < 0.5);
    }

    /// Its surest third was one name, and wrong.
    #[test]
    fn a_fit_that_is_right_of_a_third_tells_something_all_the_same() {
        let poor = Calibration { surest: 1.0 / 3.0, ..Calibration::shipped().unwrap() };
        let told = poor.confidence(&Grounds::default());
        assert_eq!(told, 1.0 / 3.0);
    }

    #[test]
    fn a_key_that_nobody_knows_and_another_form_are_errors() {
        let told = |text: String| Calibration::parse(&text).unwrap_err().to_string();
        let misspelt = SHIPPED.replace("at_bound", "at_buond");
        assert!(told(misspelt).contains("at_buond"));
        let later = SHIPPED.replace("\"version\": 1", "\"version\": 2");
        assert!(told(later).contains("version"));
        let wordy = SHIPPED.replace("\"seed\": ", "\"seed\": -");
        assert!(told(wordy).contains("expected u64"));
    }

    #[test]
    fn a_file_is_read_as_it_is_written() {
        let shipped = Calibration::shipped().unwrap();
        assert_eq!(shipped.text(), SHIPPED);
        assert_eq!(Calibration::parse(&shipped.text()).unwrap(), shipped);
    }
}
