//! From evidence to a probability: how often names with such [`Grounds`] were right, and from what on a model is
//! doubted. The numbers are data, which `caudata bench calibrate` makes from robots whose laws are not the
//! catalogue's own.

use serde_json::{Value, json};

use crate::error::GapError;
use crate::report::Grounds;

/// The file that the program has.
const SHIPPED: &str = include_str!("calibration.json");
/// Version of the file's form.
const VERSION: u64 = 1;

/// What is known of names by their evidence.
#[derive(Debug, Clone, PartialEq)]
pub struct Calibration {
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
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Map {
    /// Log odds that a name is right.
    pub log_odds: Weights,
    /// From what on a model is doubted.
    pub doubts: Thresholds,
}

/// Log odds that a name is right: a constant and a weight for each [feature](features).
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Weights {
    /// Log odds where all features are 0.
    pub constant: f64,
    /// In the order of [`FEATURES`].
    pub each: [f64; FEATURE_COUNT],
}

/// From what on something speaks against a model.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
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
#[must_use]
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
    #[must_use]
    pub fn much(&self, g: &Grounds) -> bool {
        !g.little_left && g.left * g.left_share > self.left
    }
}

impl Weights {
    /// Probability that a name is right.
    #[must_use]
    pub fn probability(&self, features: &[f64; FEATURE_COUNT]) -> f64 {
        let sum: f64 = self.each.iter().zip(features).map(|(w, x)| w * x).sum();
        1.0 / (1.0 + (-self.constant - sum).exp())
    }
}

impl Map {
    fn read(of: &Value) -> Result<Self, GapError> {
        let [log_odds, doubts] = members(of, ["log_odds", "doubts"])?;
        let mut names = ["constant"; FEATURE_COUNT + 1];
        for (name, feature) in names[1..].iter_mut().zip(FEATURES) {
            *name = feature.0;
        }
        let [constant, each @ ..] = members(log_odds, names)?;
        let mut weights = Weights { constant: number(constant)?, ..Weights::default() };
        for (weight, value) in weights.each.iter_mut().zip(each) {
            *weight = number(value)?;
        }
        let [left, scatter] = members(doubts, ["left", "scatter"])?;
        Ok(Self {
            log_odds: weights,
            doubts: Thresholds { left: number(left)?, scatter: number(scatter)? },
        })
    }

    fn to_json(self) -> Value {
        let each = FEATURES.iter().zip(self.log_odds.each);
        let mut log_odds = json!({ "constant": self.log_odds.constant });
        for ((name, _), weight) in each {
            log_odds[*name] = weight.into();
        }
        json!({
            "log_odds": log_odds,
            "doubts": { "left": self.doubts.left, "scatter": self.doubts.scatter },
        })
    }
}

/// Exactly the members `names` of an object.
fn members<'a, const N: usize>(
    of: &'a Value,
    names: [&str; N],
) -> Result<[&'a Value; N], GapError> {
    let wrong = |what: String| GapError::Calibration(what);
    let of =
        of.as_object().ok_or_else(|| wrong(format!("{of} where {} are due", names.join(", "))))?;
    if let Some(key) = of.keys().find(|k| !names.contains(&k.as_str())) {
        return Err(wrong(format!("unknown key {key}")));
    }
    let mut out = [&Value::Null; N];
    for (member, name) in out.iter_mut().zip(names) {
        *member = of.get(name).ok_or_else(|| wrong(format!("no {name}")))?;
    }
    Ok(out)
}

fn number(of: &Value) -> Result<f64, GapError> {
    let wrong = || GapError::Calibration(format!("{of} where a number is due"));
    of.as_f64().ok_or_else(wrong)
}

fn count(of: &Value) -> Result<u64, GapError> {
    let wrong = || GapError::Calibration(format!("{of} where a count is due"));
    of.as_u64().ok_or_else(wrong)
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
        let wrong = |what: String| GapError::Calibration(what);
        let file: Value = serde_json::from_str(text).map_err(|e| wrong(e.to_string()))?;
        let keys =
            ["version", "command", "seed", "cases", "names", "right", "surest", "map", "by_hand"];
        let [version, command, seed, cases, names, right, surest, map, by_hand] =
            members(&file, keys)?;
        if count(version)? != VERSION {
            return Err(wrong(format!("version {version} where {VERSION} is read")));
        }
        Ok(Self {
            command: command.as_str().unwrap_or_default().to_owned(),
            seed: count(seed)?,
            cases: count(cases)?,
            names: count(names)?,
            right: count(right)?,
            surest: number(surest)?,
            map: Map::read(map)?,
            by_hand: Map::read(by_hand)?,
        })
    }

    /// The file.
    #[must_use]
    pub fn text(&self) -> String {
        let file = json!({
            "version": VERSION,
            "command": self.command,
            "seed": self.seed,
            "cases": self.cases,
            "names": self.names,
            "right": self.right,
            "surest": self.surest,
            "map": self.map.to_json(),
            "by_hand": self.by_hand.to_json(),
        });
        format!("{file:#}\n")
    }

    /// How probable it is that a name with these grounds is right.
    #[must_use]
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
        assert!(told(wordy).contains("where a count is due"));
    }

    #[test]
    fn a_file_is_read_as_it_is_written() {
        let shipped = Calibration::shipped().unwrap();
        assert_eq!(shipped.text(), SHIPPED);
        assert_eq!(Calibration::parse(&shipped.text()).unwrap(), shipped);
    }
}
