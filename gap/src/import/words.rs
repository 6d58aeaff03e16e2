//! The words of a header: what they say of a column.

use caudata_model::RobotModel;

use super::map::{fits, of_slide, unit};
use super::units::unit_word;

/// Words that tell a kind of signal, the first that fits; a command is one of the words in [`COMMANDS`] with any
/// of them or none.
const KIND_WORDS: &[(&str, &str)] = &[
    (
        "vel",
        "vel velocity speed qd dq qvel dot omega drehzahl geschwindigkeit geschw vitesse velocidad",
    ),
    ("cur", "cur current currents amps i strom courant corriente"),
    ("tau", "tau torque torques effort drehmoment moment"),
    ("volt", "volt volts voltage supply vbat vbus vin spannung"),
    ("temp", "temp temperature"),
    ("pwm", "pwm duty"),
    (
        "pos",
        "pos position positions angle angles q qpos encoder present actual measured meas feedback fb theta ist winkel mesure medida",
    ),
];
pub(super) const COMMANDS: &str = "goal goals action actions qcmd cmd command commands commanded target targets desired des setpoint sp reference ref soll consigne consigna";
/// With a unit of voltage these say that a column is the supply.
pub(super) const SUPPLIES: &str = "bus batt battery pack rail";
/// What is on or off is no signal that a draft takes, whatever it switches …
const NO_SIGNAL: &str = "enable enabled enabling flag freigabe";
/// A torque of which these say that it is fed forward is a command of its own.
const FED_FORWARD: &str = "ff feedforward forward";
/// … and of a torque these say the same.
const SWITCHES_OF_TORQUE: &str = "on off status";
/// Units that are such in brackets only: `theta_m` is an angle of the motor.
const LETTERS: [&str; 2] = ["m", "n"];
pub(super) const CLOCKS: &str =
    "t time timestamp stamp clock seconds datetime zeit zeitstempel temps tiempo";

/// The actuated joint that is called so, or else the one with the longest name that is part of it, `_joint` left out.
pub(super) fn joint_called(robot: &RobotModel, text: &str) -> Option<usize> {
    let text = text.to_lowercase();
    let names: Vec<String> = robot.actuated_names().iter().map(|n| n.to_lowercase()).collect();
    let part = || {
        let stem = |j: usize| {
            names[j].strip_suffix("_joint").filter(|stem| stem.len() > 2).unwrap_or(&names[j])
        };
        let named = (0..names.len()).filter(|&j| text.contains(stem(j)));
        named.max_by_key(|&j| stem(j).len())
    };
    names.iter().position(|name| *name == text).or_else(part)
}

/// A header, taken apart.
pub(super) struct Words {
    /// Lower case, letters and digits only.
    words: Vec<String>,
    pub(super) whole: String,
    pub(super) unit: Option<&'static str>,
    /// What brackets say and no unit is called.
    pub(super) strange_unit: Option<String>,
}

/// `Sollwinkel` and `Istwert` as two words, a word as it is.
fn in_two(word: &str) -> Vec<&str> {
    let kind = |rest: &str| KIND_WORDS.iter().any(|(_, words)| words.split(' ').any(|w| w == rest));
    let two = ["soll", "ist"].into_iter().find_map(|start| {
        let rest = word.strip_prefix(start)?;
        (rest == "wert" || kind(rest)).then(|| vec![start, rest])
    });
    two.unwrap_or_else(|| vec![word])
}

impl Words {
    pub(super) fn of(header: &str) -> Self {
        let whole = header.trim().to_lowercase();
        let words_of = |text: &str| -> Vec<String> {
            let words = text.split(|c: char| !c.is_alphanumeric());
            words.filter(|w| !w.is_empty()).flat_map(in_two).map(str::to_owned).collect()
        };
        let in_brackets = whole
            .rsplit_once(['[', '('])
            .map(|(before, unit)| (before, unit.trim_end_matches([']', ')']).trim()));
        let (text, said) = match in_brackets {
            Some((before, unit)) if unit_word(unit).is_some() => (before, unit_word(unit)),
            _ => (whole.as_str(), None),
        };
        let mut words = words_of(text);
        // `pos_deg`, `vel_deg_s`, `vel_deg_per_s`, `time_ms`; all that there is is no unit
        let ends = |n: usize| {
            let said = words.len().checked_sub(n).filter(|&from| from > 0)?;
            let said = words[said..].iter().filter(|w| n == 1 || *w != "per");
            let said: Vec<&str> = said.map(String::as_str).collect();
            let said = Some(said.join("/")).filter(|said| !LETTERS.contains(&said.as_str()))?;
            Some((n, unit_word(&said)?))
        };
        let last = [3, 2, 1].into_iter().find_map(ends);
        let unit = said.or(last.map(|l| l.1));
        if let (None, Some((n, _))) = (said, last) {
            words.truncate(words.len() - n);
        }
        let strange =
            in_brackets.filter(|(_, word)| said.is_none() && word.parse::<usize>().is_err());
        let strange_unit = strange.map(|(_, word)| word.to_owned());
        let mut out = Self { words, unit, strange_unit, whole };
        // `vel_counts_ms`: its last word is a unit, and not of this
        if let Some(other) = out.unit.filter(|unit| !out.may_be_in(unit)) {
            out.strange_unit.get_or_insert(other.to_owned());
            out.unit = None;
        }
        out
    }

    /// Whether a unit goes with what the column is, as far as its name says so.
    fn may_be_in(&self, name: &str) -> bool {
        let fit = |(_, of)| self.want().is_none_or(|want| fits(of, want) || of_slide(of, want));
        // shares of a range have no size of their own
        unit(name).map_or(true, fit)
    }

    /// Its unit, but none that only slides have at a `hinge`.
    pub(super) fn unit_at(&self, hinge: bool) -> Option<&'static str> {
        let long = |of| ["length", "velocity", "force"].contains(&of);
        self.unit.filter(|name| !hinge || !unit(name).is_ok_and(|(_, of)| long(of)))
    }

    fn want(&self) -> Option<&'static str> {
        Some(match self.kind()? {
            "cmd" | "pos" => "angle",
            "vel" => "speed",
            "cur" => "current",
            "tau" | "cmd_tau" => "torque",
            "volt" => "voltage",
            _ => return None,
        })
    }

    /// Why a column that moves is not what its name says: a speed in degrees may be an angle as well. Other units
    /// of something else may be no units: `pos_a` is of leg A.
    pub(super) fn moves_otherwise(&self) -> Option<String> {
        let (name, want) = (self.strange_unit.as_ref()?, self.want()?);
        let (_, of) = unit(name).ok()?;
        let moves =
            |of| ["angle", "speed", "angular acceleration", "length", "velocity"].contains(&of);
        (moves(of) && moves(want))
            .then(|| format!(", as its unit `{name}` is one of {of}, and not of {want}"))
    }

    /// Whether it has one of these words, with spaces between.
    pub(super) fn has(&self, any: &str) -> bool {
        any.split(' ').any(|word| self.words.iter().any(|w| w == word))
    }

    /// The same, whatever number stands behind it (`q1`, `ref2`).
    pub(super) fn says(&self, any: &str) -> bool {
        any.split(' ').any(|word| self.words.iter().any(|w| parted(w).0 == word))
    }

    pub(super) fn kind(&self) -> Option<&'static str> {
        let kind = KIND_WORDS.iter().find(|(_, words)| self.says(words)).map(|k| k.0);
        let of_torque = matches!(kind, None | Some("tau")) && self.says(SWITCHES_OF_TORQUE);
        if of_torque || self.says(NO_SIGNAL) {
            return None;
        }
        match (self.says(COMMANDS), kind) {
            _ if self.says(FED_FORWARD) => {
                let in_torque =
                    || self.unit.is_some_and(|u| unit(u).is_ok_and(|u| u.1 == "torque"));
                let short = kind.is_none() && self.says("ff feedforward") && in_torque();
                (kind == Some("tau") || short).then_some("cmd_tau")
            }
            (true, None | Some("pos")) => Some("cmd"),
            // whether a drive heeds it no file says
            (true, Some(_)) => None,
            (false, kind) => kind,
        }
    }

    /// Why a commanded speed or torque is not taken.
    pub(super) fn commands_otherwise(&self) -> Option<&'static str> {
        let kind = KIND_WORDS.iter().find(|(_, words)| self.says(words)).map(|k| k.0);
        match kind.filter(|_| self.says(COMMANDS) || self.says(FED_FORWARD))? {
            "vel" => Some(
                ", a commanded speed: where the drive damps what the joint's speed differs from it by, take it as cmd_vel.<joint>",
            ),
            "tau" => Some(
                ", a commanded torque: where it is fed forward, and not all that the drive gives, take it as cmd_tau.<joint>",
            ),
            _ => None,
        }
    }

    /// The same of a column in one of several files, whose name may say it: `commands.csv`, `positions.csv`.
    pub(super) fn kind_in(&self, file: Option<&str>) -> Option<&'static str> {
        let file = file.map(|name| Self::of(name.rsplit_once('.').map_or(name, |parts| parts.0)));
        match (self.kind(), file) {
            (None | Some("pos"), Some(file)) if file.says(COMMANDS) => Some("cmd"),
            (Some(_), Some(file)) if file.says(COMMANDS) => None,
            (kind, file) => kind.or(file.and_then(|file| file.kind())),
        }
    }

    /// The actuated joint that the header names, or the only one.
    pub(super) fn joint(&self, robot: &RobotModel) -> Option<usize> {
        match robot.actuated().len() {
            1 => Some(0),
            _ => joint_called(robot, &self.whole),
        }
    }

    /// What is left of it without the words that tell a kind of signal; `None`: nothing.
    pub(super) fn label(&self) -> Option<String> {
        let kinds = KIND_WORDS.iter().flat_map(|(_, words)| words.split(' '));
        let left = self.words.iter().map(|word| {
            let (text, number) = parted(word);
            let tells = COMMANDS.split(' ').chain(kinds.clone()).any(|known| known == text);
            if tells { number } else { word }
        });
        let left: Vec<&str> = left.filter(|word| !word.is_empty()).collect();
        (!left.is_empty()).then(|| left.join(" "))
    }

    /// The last number in it.
    pub(super) fn number(&self) -> Option<usize> {
        self.words.iter().rev().find_map(|word| parted(word).1.parse().ok())
    }
}

/// A word without the number behind it, and that number.
fn parted(word: &str) -> (&str, &str) {
    word.split_at(word.trim_end_matches(|c: char| c.is_ascii_digit()).len())
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use super::*;

    #[test]
    fn a_header_may_leave_out_that_a_joint_is_one() {
        let [toml, xml] = ["robot.toml", "xml"].map(|end| {
            let robots = concat!(env!("CARGO_MANIFEST_DIR"), "/../robots/xl330_pendulum.");
            let text = std::fs::read_to_string(format!("{robots}{end}")).unwrap();
            text.replace("swing", "swing_joint")
        });
        let robot = RobotModel::from_bytes("rig", toml.as_bytes(), xml.as_bytes()).unwrap();
        assert_eq!(joint_called(&robot, "Swing_soll"), Some(0));
        assert_eq!(joint_called(&robot, "joint"), None);
        // the longest part that is there counts, not the longest name
        let [toml, xml] = ["robot.toml", "xml"].map(|end| {
            let robots = concat!(env!("CARGO_MANIFEST_DIR"), "/../robots/polymander.");
            let text = std::fs::read_to_string(format!("{robots}{end}")).unwrap();
            text.replace("FL_hip", "arm_joint").replace("FL_knee", "forearm")
        });
        let robot = RobotModel::from_bytes("arm", toml.as_bytes(), xml.as_bytes()).unwrap();
        let called = |text| joint_called(&robot, text).map(|joint| robot.actuated_names()[joint]);
        assert_eq!(called("forearm_cmd"), Some("forearm"));
        assert_eq!(called("arm_cmd"), Some("arm_joint"));
    }

    #[test]
    fn german_says_what_is_asked_for_and_what_is_in_one_word() {
        assert_eq!(Words::of("Knie Sollwinkel [deg]").words, ["knie", "soll", "winkel"]);
        assert_eq!(Words::of("Istgeschwindigkeit").words, ["ist", "geschwindigkeit"]);
        assert_eq!(Words::of("distance").words, ["distance"]);
    }

    #[test]
    fn a_unit_is_said_by_the_end_of_a_header_if_it_is_one_of_that_kind() {
        let cases = [
            ("vel_deg_s", Some("deg/s"), None),
            ("velocity_rad_per_sec", Some("rad/s"), None),
            ("vel_dps", Some("deg/s"), None),
            ("vel_degps", Some("deg/s"), None),
            ("speed [rpm]", Some("rev/min"), None),
            ("vel_turns_s", Some("rev/s"), None),
            ("torque_Nmm", Some("mNm"), None),
            ("torque_Ncm", Some("cNm"), None),
            ("torque (kgf·cm)", Some("kgf·cm"), None),
            ("current_uA", Some("uA"), None),
            ("vel_counts_ms", None, Some("ms")),
            ("vel_counts_s", Some("counts/4096/s"), None),
            ("vel_deg_s2", None, Some("deg/s2")),
            ("vel_deg", None, Some("deg")),
            ("vel(steps/s)", None, Some("steps/s")),
            ("torque [N mm]", None, Some("n mm")),
            ("pos_knee", None, None),
            ("lift_pos [mm]", Some("mm"), None),
            ("lift_vel_mm_s", Some("mm/s"), None),
            ("theta_m", None, None),
        ];
        for (header, unit, strange) in cases {
            let words = Words::of(header);
            let said = (words.unit, words.strange_unit.as_deref());
            assert_eq!(said, (unit, strange), "{header}");
        }
    }

    #[test]
    fn the_name_of_a_file_says_what_its_columns_are() {
        let kind = |column: &str, file: &str| Words::of(column).kind_in(Some(file));
        assert_eq!(kind("elbow", "commands.csv"), Some("cmd"));
        assert_eq!(kind("elbow_pos", "joint_commands.csv"), Some("cmd"));
        assert_eq!(kind("elbow_vel", "commands.csv"), None, "a commanded speed is no signal");
        assert_eq!(kind("elbow_vel", "positions.csv"), Some("vel"));
        assert_eq!(kind("elbow", "motor_currents.csv"), Some("cur"));
        assert_eq!(kind("elbow", "states.csv"), None);
        assert_eq!(Words::of("elbow").kind_in(None), None);
        let said = |header: &str| Words::of(header).kind();
        assert_eq!([said("torque_enable"), said("position_flag")], [None, None]);
        assert_eq!([said("pwm_enable1"), said("torque_status")], [None, None]);
        let fed = ["tau_ff", "feed_forward_torque_elbow", "q_ff", "knee_ff_Nm"].map(said);
        assert_eq!(fed, [Some("cmd_tau"), Some("cmd_tau"), None, Some("cmd_tau")]);
        assert!(Words::of("qd_des").commands_otherwise().is_some_and(|w| w.contains("cmd_vel")));
        assert_eq!(said("motor_status_velocity"), Some("vel"));
        assert_eq!(said("drive_on_current_a"), Some("cur"));
        let dot = Words::of("q1_dot");
        assert_eq!(
            (dot.kind(), dot.label().as_deref(), dot.number()),
            (Some("vel"), Some("1"), Some(1))
        );
    }
}
