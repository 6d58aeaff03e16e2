//! From evidence to a probability: how often names with such [`Grounds`] were right, and from what on a model is
//! doubted. The numbers are data, which `caudata bench calibrate` makes from robots whose laws are not the
//! catalogue's own.

use serde::{Deserialize, Serialize};

use crate::error::GapError;
use crate::report::Grounds;

/// The file that the program has.
const SHIPPED: &str = include_str!("calibration.toml");
/// Version of the file's form.
pub const VERSION: u32 = 1;

/// What is known of names by their evidence.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Calibration {
    /// [`VERSION`].
    pub version: u32,
    /// The command that made it.
    pub command: String,
    /// Seed of its cases.
    pub seed: u64,
    /// How many cases gave a report.
    pub cases: usize,
    /// How many names they gave, leads included.
    pub names: usize,
    /// How many of these were right.
    pub right: usize,
    /// Nobody is surer than this: of the surest third of the names, what was right, by the rule of succession.
    pub surest: f64,
    /// A name is told as a finding if it is as probable as this once its look-alikes count as the same; else it
    /// is a lead.
    pub finding: f64,
    /// From evidence to log odds.
    pub log_odds: Weights,
    /// From what on a model is doubted.
    pub doubts: Thresholds,
    /// The same before any of the cases.
    pub by_hand: ByHand,
}

/// What rules by hand said: where a fit begins.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ByHand {
    /// What they said of evidence from all over its range.
    pub log_odds: Weights,
    /// Their limits.
    pub doubts: Thresholds,
}

/// Log odds that a name is right: a constant and a weight for each [feature](features).
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Weights {
    /// Without evidence.
    pub constant: f64,
    /// Of the log odds of the name among its look-alikes.
    pub among_look_alikes: f64,
    /// Of the share that the cause takes off.
    pub gain: f64,
    /// Of ln(1 + its distance from nothing).
    pub distance: f64,
    /// Where much is left.
    pub much_left: f64,
    /// Where it has no one size.
    pub inconstant: f64,
    /// Where a size is at its bound.
    pub at_bound: f64,
    /// Where its interval holds nothing.
    pub may_be_nothing: f64,
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
pub const FEATURES: usize = 7;
/// Which way each may only count.
pub const SIGNS: [f64; FEATURES] = [1.0, 1.0, 1.0, -1.0, -1.0, -1.0, -1.0];
/// A probability among look-alikes is never told nearer to 0 or 1 than this: their number is finite.
const FINEST: f64 = 0.02;

/// Grounds as the numbers that weights count, in the order of [`Weights`].
#[must_use]
pub fn features(g: &Grounds, doubts: &Thresholds) -> [f64; FEATURES] {
    let p = g.among_look_alikes.clamp(FINEST, 1.0 - FINEST);
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
    #[must_use]
    pub fn much(&self, g: &Grounds) -> bool {
        !g.little_left && g.left * g.left_share > self.left
    }
}

impl Weights {
    /// A constant and weights in the order of [`features`].
    #[must_use]
    pub fn of(constant: f64, w: [f64; FEATURES]) -> Self {
        let [
            among_look_alikes,
            gain,
            distance,
            much_left,
            inconstant,
            at_bound,
            may_be_nothing,
        ] = w;
        Self {
            constant,
            among_look_alikes,
            gain,
            distance,
            much_left,
            inconstant,
            at_bound,
            may_be_nothing,
        }
    }

    /// The weights in the order of [`features`].
    #[must_use]
    pub fn each(&self) -> [f64; FEATURES] {
        [
            self.among_look_alikes,
            self.gain,
            self.distance,
            self.much_left,
            self.inconstant,
            self.at_bound,
            self.may_be_nothing,
        ]
    }

    /// Probability that a name is right.
    #[must_use]
    pub fn probability(&self, features: &[f64; FEATURES]) -> f64 {
        let each = self.each().into_iter().zip(features);
        let sum: f64 = each.map(|(w, x)| w * x).sum();
        1.0 / (1.0 + (-self.constant - sum).exp())
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
        let found: Self = toml::from_str(text).map_err(|e| {
            let line = e.message().lines().next().unwrap_or_default().to_owned();
            GapError::Calibration(line)
        })?;
        if found.version != VERSION {
            let message = format!("version {} where {VERSION} is read", found.version);
            return Err(GapError::Calibration(message));
        }
        Ok(found)
    }

    /// How probable it is that a name with these grounds is right.
    #[must_use]
    pub fn confidence(&self, grounds: &Grounds) -> f64 {
        let told = self.log_odds.probability(&features(grounds, &self.doubts));
        told.clamp(1.0 - self.surest, self.surest)
    }

    /// Whether a name, or one of its look-alikes, is probable enough to be told as a finding.
    #[must_use]
    pub fn is_finding(&self, grounds: &Grounds) -> bool {
        let any_of_them = Grounds {
            among_look_alikes: 1.0,
            ..*grounds
        };
        self.confidence(&any_of_them) >= self.finding
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
            |g| g.among_look_alikes = 0.3,
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
        assert!(!shipped.doubts.much(&all));
        assert!(shipped.confidence(&all) < 0.5);
    }

    #[test]
    fn a_key_that_nobody_knows_and_another_form_are_errors() {
        let told = |text: String| Calibration::parse(&text).unwrap_err().to_string();
        let misspelt = SHIPPED.replace("at_bound", "at_buond");
        assert!(told(misspelt).contains("at_buond"));
        let version = format!("version = {VERSION}");
        let later = SHIPPED.replace(&version, &format!("version = {}", VERSION + 1));
        assert!(told(later).contains("version"));
    }
}
