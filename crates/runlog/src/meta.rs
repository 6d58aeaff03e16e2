//! `log.toml`: the circumstances of a run.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::error::LogError;

/// How the base was held.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum BaseHold {
    /// Clamped.
    Fixed,
    /// On the ground.
    Free,
    /// In water.
    Water,
}

/// Value of a setting that this format has no field for.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(
    untagged,
    expecting = "a setting of a run is a number, a text, true or false; weights are `[[payload]]`, where forces act `[[outer_force]]`, what holds at one joint `[joint.NAME]`"
)]
pub enum Setting {
    /// true or false.
    Switch(bool),
    /// A number (SI unit, named in the key).
    Number(f64),
    /// A text.
    Text(String),
}

/// Contents of `log.toml`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct LogMeta {
    /// Robot name or robot file.
    pub robot: String,
    /// How the base was held.
    pub base: BaseHold,
    /// What it stood on; empty: not known.
    #[serde(default)]
    pub terrain: String,
    /// Nominal rows per second, Hz; 0 < rate ≤ 100 000.
    pub rate_hz: f64,
    /// Anything worth knowing.
    #[serde(default)]
    pub notes: String,
    /// Proportional gain in force, N·m/rad.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub kp: Option<f64>,
    /// Derivative gain in force, N·m·s/rad.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub kd: Option<f64>,
    /// Supply voltage, V.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub supply_v: Option<f64>,
    /// What was otherwise at single joints, by name.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub joint: BTreeMap<String, JointConditions>,
    /// Weights that were fastened to the robot.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub payload: Vec<Payload>,
    /// Where forces from outside act, of links whose `force.<link>` the rows have; elsewhere: the centre of mass.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub outer_force: Vec<ForcePoint>,
    /// Every other setting that was known, by key.
    #[serde(flatten)]
    pub settings: BTreeMap<String, Setting>,
}

/// What was otherwise at one joint than at all.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct JointConditions {
    /// Proportional gain in force, N·m/rad.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub kp: Option<f64>,
    /// Derivative gain in force, N·m·s/rad.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub kd: Option<f64>,
    /// Inertia that was added at the joint, kg·m² (a flywheel).
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub added_inertia_kgm2: Option<f64>,
}

/// A weight that was fastened to a link.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Payload {
    /// Link, by name.
    pub link: String,
    /// kg.
    pub mass_kg: f64,
    /// Its centre in the link's frame, m.
    #[serde(default)]
    pub at_m: [f64; 3],
}

/// Where a force from outside acts.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ForcePoint {
    /// Link, by name.
    pub link: String,
    /// In the link's frame, m.
    pub at_m: [f64; 3],
}

/// Highest sampling rate that a log may claim, Hz.
const MAX_RATE_HZ: f64 = 1e5;

impl LogMeta {
    /// A run of `robot` with nothing else known.
    pub fn new(robot: impl Into<String>, base: BaseHold, rate_hz: f64) -> Self {
        Self {
            robot: robot.into(),
            base,
            terrain: String::new(),
            rate_hz,
            notes: String::new(),
            kp: None,
            kd: None,
            supply_v: None,
            joint: BTreeMap::new(),
            payload: Vec::new(),
            outer_force: Vec::new(),
            settings: BTreeMap::new(),
        }
    }

    /// Reads the text of a `log.toml`; `file` names it in errors.
    ///
    /// # Errors
    /// [`LogError::Meta`] with the line.
    pub fn parse(file: &str, text: &str) -> Result<Self, LogError> {
        let meta: Self = toml::from_str(text).map_err(|e| LogError::Meta {
            file: file.to_owned(),
            line: e.span().map_or(1, |s| 1 + text[..s.start.min(text.len())].matches('\n').count()),
            message: plainly(e.message()),
        })?;
        meta.check().map_err(|message| LogError::Meta {
            file: file.to_owned(),
            line: 1,
            message,
        })?;
        Ok(meta)
    }

    /// The text of `log.toml`.
    ///
    /// # Errors
    /// [`LogError::Refused`] where a value is not valid.
    pub fn to_toml(&self) -> Result<String, LogError> {
        self.check().map_err(LogError::Refused)?;
        toml::to_string(self).map_err(|e| LogError::Refused(e.to_string()))
    }

    /// Gains in force at `joint`, as far as they are noted: N·m/rad, N·m·s/rad.
    pub fn gains(&self, joint: &str) -> (Option<f64>, Option<f64>) {
        let own = self.joint.get(joint).copied().unwrap_or_default();
        (own.kp.or(self.kp), own.kd.or(self.kd))
    }

    /// Whether `other` was recorded under the same conditions, as far as they are noted. Supplies that differ
    /// by a twentieth are the same.
    pub fn same_conditions(&self, other: &Self) -> bool {
        let supplies = match (self.supply_v, other.supply_v) {
            (Some(a), Some(b)) => (a - b).abs() <= 0.05 * a.max(b),
            _ => true,
        };
        let fixed = |m: &Self| (m.base, m.kp, m.kd, m.joint.clone(), m.payload.clone());
        supplies && fixed(self) == fixed(other)
    }

    fn check(&self) -> Result<(), String> {
        if self.robot.is_empty() {
            return Err("`robot` is empty; name the robot or its file".to_owned());
        }
        if !(self.rate_hz > 0.0 && self.rate_hz <= MAX_RATE_HZ) {
            return Err(format!(
                "`rate_hz` is {}; it must be above 0 and at most {MAX_RATE_HZ}",
                self.rate_hz
            ));
        }
        let gains = [("kp", self.kp), ("kd", self.kd), ("supply_v", self.supply_v)];
        for (key, value) in gains {
            if value.is_some_and(|v| !(v.is_finite() && v >= 0.0)) {
                return Err(format!("`{key}` must be a number ≥ 0"));
            }
        }
        for (joint, own) in &self.joint {
            let values = [own.kp, own.kd, own.added_inertia_kgm2];
            if values.into_iter().flatten().any(|v| !(v.is_finite() && v >= 0.0)) {
                return Err(format!("`joint.{joint}`: every value must be a number ≥ 0"));
            }
        }
        for p in &self.payload {
            let known = p.at_m.iter().all(|x| x.is_finite()) && p.mass_kg.is_finite();
            if !known || p.mass_kg < 0.0 {
                return Err(format!(
                    "`payload` at `{}`: a mass is a number ≥ 0, a place is finite",
                    p.link
                ));
            }
        }
        if let Some(p) = self.outer_force.iter().find(|p| p.at_m.iter().any(|x| !x.is_finite())) {
            return Err(format!("`outer_force` at `{}`: a place is finite", p.link));
        }
        for (key, value) in &self.settings {
            if matches!(value, Setting::Number(x) if !x.is_finite()) {
                return Err(format!("`{key}` is not a finite number"));
            }
        }
        Ok(())
    }
}

/// What the parser says, in a line; of a list that was written as one table, what to write.
fn plainly(message: &str) -> String {
    match message {
        "invalid type: map, expected a sequence" => {
            "there may be several of these: write `[[payload]]`, `[[outer_force]]`, in two brackets"
                .to_owned()
        }
        "missing field `at_m`" => {
            "`[[outer_force]]` lacks `at_m`: where the force acts, in the link's frame, m"
                .to_owned()
        }
        other => other.replace('\n', " "),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reads_what_the_format_lists_and_keeps_other_settings() {
        let text = "robot = \"polymander\"\nbase = \"water\"\nterrain = \"pool\"\nrate_hz = 50\nnotes = \"first\"\nkp = 15\n\
                    kd = 0.15\nsupply_v = 14.0\nwater_level_m = 0.2\ntether = true\n";
        let meta = LogMeta::parse("log.toml", text).unwrap();
        assert_eq!((meta.base, meta.rate_hz, meta.kp), (BaseHold::Water, 50.0, Some(15.0)));
        assert_eq!(meta.settings["water_level_m"], Setting::Number(0.2));
        assert_eq!(meta.settings["tether"], Setting::Switch(true));
        assert_eq!(LogMeta::parse("log.toml", &meta.to_toml().unwrap()).unwrap(), meta);
    }

    #[test]
    fn conditions_of_a_run_are_read_and_compared() {
        let text = "robot = \"arm\"\nbase = \"fixed\"\nrate_hz = 100\nkp = 15\nsupply_v = 12.0\n\
                    [joint.elbow]\nkp = 4\n[[payload]]\nlink = \"hand\"\nmass_kg = 0.5\nat_m = [0, 0, 0.1]\n";
        let meta = LogMeta::parse("log.toml", text).unwrap();
        assert_eq!(meta.gains("elbow"), (Some(4.0), None));
        assert_eq!(meta.gains("wrist"), (Some(15.0), None));
        assert_eq!(LogMeta::parse("log.toml", &meta.to_toml().unwrap()).unwrap(), meta);
        let mut other = meta.clone();
        other.supply_v = Some(11.8);
        assert!(meta.same_conditions(&other));
        other.supply_v = Some(9.0);
        assert!(!meta.same_conditions(&other));
        let place = "[[outer_force]]\nlink = \"hand\"\nat_m = [0, 0, 0.1]\n";
        let pushed = LogMeta::parse("log.toml", &format!("{text}{place}")).unwrap();
        assert_eq!(pushed.outer_force[0].at_m, [0.0, 0.0, 0.1]);
        assert_eq!(LogMeta::parse("log.toml", &pushed.to_toml().unwrap()).unwrap(), pushed);
        let mut heavier = meta.clone();
        heavier.payload[0].mass_kg = 1.0;
        assert!(!meta.same_conditions(&heavier));
        // what is misspelt inside is an error that says where
        let wrong = text.replace("[joint.elbow]\nkp", "[joint.elbow]\nKp");
        let error = LogMeta::parse("log.toml", &wrong).unwrap_err().to_string();
        assert!(error.contains("unknown field `Kp`"), "{error}");
    }

    #[test]
    fn wrong_meta_says_where() {
        let check = |text: &str, want: &str| {
            let e = LogMeta::parse("log.toml", text).unwrap_err().to_string();
            assert!(e.contains(want) && !e.contains('\n'), "{e}");
        };
        check(
            "robot = \"p\"\nbase = \"flying\"\nrate_hz = 50\n",
            "log.toml:2: unknown variant `flying`",
        );
        check("robot = \"p\"\nbase = \"free\"\n", "missing field `rate_hz`");
        check("robot = \"p\"\nbase = \"free\"\nrate_hz = 0\n", "`rate_hz` is 0");
        check("robot = \"p\"\nbase = \"free\"\nrate_hz = nan\n", "`rate_hz` is NaN");
        check("robot = \"\"\nbase = \"free\"\nrate_hz = 50\n", "`robot` is empty");
        check("robot = \"p\"\nbase = \"free\"\nrate_hz = 50\nkp = -1\n", "`kp` must be");
        check(
            "robot = \"p\"\nbase = \"free\"\nrate_hz = 50\nlist = [1]\n",
            "a setting of a run is",
        );
        check(
            "robot = \"p\"\nbase = \"free\"\nrate_hz = 50\n[[payloads]]\nlink = \"arm\"\n",
            "[[payload]]",
        );
        check(
            "robot = \"p\"\nbase = \"free\"\nrate_hz = 50\n[payload]\nlink = \"arm\"\n",
            "write `[[payload]]`",
        );
        let place = "[[outer_force]]\nlink = \"arm\"\n";
        check(
            &format!("robot = \"p\"\nbase = \"free\"\nrate_hz = 50\n{place}"),
            "`[[outer_force]]` lacks `at_m`",
        );
        check("robot = \"p\nbase = \"free\"\n", "log.toml:1");
    }
}
