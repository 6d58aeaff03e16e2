//! A map for a CSV file of anybody, guessed from its header and its numbers: something to begin with, and to check.
//!
//! Words of the header say what a column is (`goal`, `present position`, `vel`), brackets or the last word say its
//! unit; where none does, the size of the numbers does. What nobody can know (where zero is) is said as a comment.

use std::fmt::Write as _;
use std::path::Path;

use caudata_model::{BaseKind, RobotModel};

use super::ImportError;
use super::csv::{Table, unit};

/// Words that tell a kind of signal, the first that fits; a command is one of the words in [`COMMANDS`] with any
/// of them or none.
const KIND_WORDS: &[(&str, &[&str])] = &[
    ("vel", &["vel", "velocity", "speed", "qd", "dq", "omega"]),
    ("cur", &["cur", "current", "currents", "amps", "i"]),
    ("tau", &["tau", "torque", "torques", "effort"]),
    (
        "volt",
        &["volt", "volts", "voltage", "supply", "vbat", "vin"],
    ),
    ("temp", &["temp", "temperature"]),
    ("pwm", &["pwm", "duty"]),
    (
        "pos",
        &[
            "pos",
            "position",
            "positions",
            "angle",
            "angles",
            "q",
            "encoder",
            "present",
            "actual",
            "measured",
            "theta",
        ],
    ),
];
const COMMANDS: &[&str] = &[
    "goal",
    "cmd",
    "command",
    "commanded",
    "target",
    "desired",
    "des",
    "setpoint",
    "reference",
    "ref",
];
const CLOCKS: &[&str] = &["t", "time", "timestamp", "stamp", "clock", "seconds"];
/// Last words of a header that are units, and what a map calls them.
const UNIT_WORDS: &[(&str, &str)] = &[
    ("rad", "rad"),
    ("rads", "rad"),
    ("radians", "rad"),
    ("deg", "deg"),
    ("degrees", "deg"),
    ("°", "deg"),
    ("turns", "turn"),
    ("rev", "turn"),
    ("rad/s", "rad/s"),
    ("deg/s", "deg/s"),
    ("rpm", "rev/min"),
    ("rev/min", "rev/min"),
    ("a", "A"),
    ("ma", "mA"),
    ("nm", "Nm"),
    ("n·m", "Nm"),
    ("v", "V"),
    ("mv", "mV"),
    ("c", "degC"),
    ("°c", "degC"),
    ("degc", "degC"),
    ("%", "%"),
    ("s", "s"),
    ("sec", "s"),
    ("ms", "ms"),
    ("us", "us"),
    ("µs", "us"),
    ("ns", "ns"),
];

/// A map for the file at `path` of `robot`, with comments.
///
/// # Errors
/// [`ImportError`] where the file is no CSV, or no column of it can be the time.
pub fn map(path: &Path, robot: &RobotModel) -> Result<String, ImportError> {
    let bytes = super::read(path)?;
    let file = path.display().to_string();
    let table = Table::parse(&file, &String::from_utf8_lossy(&bytes))?;
    let columns: Vec<Words> = table.header.iter().map(|h| Words::of(h)).collect();
    let clock = columns.iter().position(|c| c.has(CLOCKS)).ok_or_else(|| {
        let message = format!(
            "no column is called time; it has {}",
            table.header.join(", ")
        );
        table.wrong(message)
    })?;
    let base = match robot.base() {
        BaseKind::Free => "free",
        _ => "fixed",
    };
    let mut out = format!(
        "# Guessed from {file}; check every line.\nbase = \"{base}\"\n\
         # kp = 0.0            # N·m/rad, the gain that was in force; without it the robot file's\n\
         # supply_v = 0.0      # V\n\n[time]\ncolumn = {}\nunit = \"{}\"\n",
        quoted(&table.header[clock]),
        columns[clock]
            .unit
            .map_or_else(|| clock_unit(&numbers(&table, clock)), str::to_owned),
    );
    let mut offsets = vec![None; robot.actuated().len()];
    let mut read: Vec<String> = Vec::new();
    for (at, words) in columns.iter().enumerate().filter(|(at, _)| *at != clock) {
        let values = numbers(&table, at);
        let Some(kind) = words.kind().filter(|_| !values.is_empty()) else {
            let _ = writeln!(out, "\n# not read: {}", quoted(&table.header[at]));
            continue;
        };
        let joint = words.joint(robot);
        if kind != "volt" && joint.is_none() {
            let header = quoted(&table.header[at]);
            let _ = writeln!(
                out,
                "\n# not read: {header}, as none of the robot's joints is named in it"
            );
            continue;
        }
        let name = joint
            .filter(|_| kind != "volt")
            .map_or(kind.to_owned(), |joint| {
                format!("{kind}.{}", robot.actuated_names()[joint])
            });
        if read.contains(&name) {
            let header = quoted(&table.header[at]);
            let _ = writeln!(out, "\n# not read: {header}, as {name} is there already");
            continue;
        }
        read.push(name.clone());
        let unit_name = words.unit.unwrap_or_else(|| unit_by_size(kind, &values));
        let _ = writeln!(
            out,
            "\n[[signal]]\nsignal = {}\ncolumn = {}\nunit = \"{unit_name}\"",
            quoted(&name),
            quoted(&table.header[at])
        );
        if let (Some(joint), "cmd" | "pos") = (joint, kind) {
            let size = unit(unit_name).unwrap_or(1.0);
            let values_rad: Vec<f64> = values.iter().map(|v| v * size).collect();
            out.push_str(&zero(robot, joint, &mut offsets[joint], &values_rad));
        }
    }
    Ok(out)
}

/// Where zero is: no file says. What lies outside of the joint's range is moved so that it begins at its nominal
/// position, command and reading alike; `offset_rad` is what the first of them was moved by.
fn zero(
    robot: &RobotModel,
    joint: usize,
    offset_rad: &mut Option<f64>,
    values_rad: &[f64],
) -> String {
    let (low, high) = robot.joint_limits_rad()[joint];
    let least = values_rad.iter().copied().fold(f64::INFINITY, f64::min);
    let most = values_rad.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    if least >= low - 0.2 && most <= high + 0.2 {
        return "# scale = -1.0        # where it counts the other way\n".to_owned();
    }
    let first = values_rad.first().copied().unwrap_or_default();
    let offset = *offset_rad.get_or_insert(robot.nominal_pos_rad()[joint] - first);
    format!(
        "offset = {offset:.4}     # rad. A guess: {least:.2} to {most:.2} rad is outside of the joint's range {low:.2} \
         to {high:.2},\n                      # so it is taken to begin at the nominal position\n"
    )
}

/// The numbers of a column as they stand.
fn numbers(table: &Table<'_>, at: usize) -> Vec<f64> {
    let values = table.values(&table.header[at], None, 1.0);
    values.unwrap_or_default().into_iter().flatten().collect()
}

/// Nobody samples a servo slower than once in 0.4 s, or faster than 20,000 times a second.
fn clock_unit(stamps: &[f64]) -> String {
    let span = stamps.last().unwrap_or(&0.0) - stamps.first().unwrap_or(&0.0);
    let step = span / (stamps.len().max(2) - 1) as f64;
    let unit = match step {
        s if s < 0.4 => "s",
        s if s < 400.0 => "ms",
        s if s < 400_000.0 => "us",
        _ => "ns",
    };
    unit.to_owned()
}

fn unit_by_size(kind: &str, values: &[f64]) -> &'static str {
    let most = values.iter().fold(0.0f64, |most, v| most.max(v.abs()));
    match kind {
        "cmd" | "pos" if most > 720.0 => "counts/4096",
        "cmd" | "pos" if most > 7.0 => "deg",
        "cmd" | "pos" => "rad",
        "vel" if most > 100.0 => "deg/s",
        "vel" => "rad/s",
        "cur" if most > 30.0 => "mA",
        "cur" => "A",
        "tau" => "Nm",
        "volt" if most > 1000.0 => "mV",
        "volt" => "V",
        "temp" => "degC",
        _ if most > 1.0 => "%",
        _ => "1",
    }
}

fn quoted(text: &str) -> String {
    toml::Value::String(text.trim().to_owned()).to_string()
}

/// A header, taken apart.
struct Words {
    /// Lower case, letters and digits only.
    words: Vec<String>,
    whole: String,
    unit: Option<&'static str>,
}

impl Words {
    fn of(header: &str) -> Self {
        let whole = header.trim().to_lowercase();
        let parted = |text: &str| -> Vec<String> {
            let words = text.split(|c: char| !c.is_alphanumeric());
            words.filter(|w| !w.is_empty()).map(str::to_owned).collect()
        };
        let in_brackets = whole
            .rsplit_once(['[', '('])
            .map(|(before, unit)| (before, unit.trim_end_matches([']', ')']).trim()));
        let (text, said) = match in_brackets {
            Some((before, unit)) if unit_word(unit).is_some() => (before, unit_word(unit)),
            _ => (whole.as_str(), None),
        };
        let mut words = parted(text);
        // `pos_deg`, `time_ms`; one word alone is no unit
        let last = words.last().and_then(|w| unit_word(w));
        let unit = said.or(last.filter(|_| words.len() > 1));
        if said.is_none() && unit.is_some() {
            words.pop();
        }
        Self { words, whole, unit }
    }

    fn has(&self, any: &[&str]) -> bool {
        self.words.iter().any(|w| any.contains(&w.as_str()))
    }

    fn kind(&self) -> Option<&'static str> {
        let kind = KIND_WORDS
            .iter()
            .find(|(_, words)| self.has(words))
            .map(|k| k.0);
        match (self.has(COMMANDS), kind) {
            (true, None | Some("pos")) => Some("cmd"),
            // a commanded speed or torque is nothing that a log has
            (true, Some(_)) => None,
            (false, kind) => kind,
        }
    }

    /// The actuated joint that the header names, the only one, or the one with its number (from 0).
    fn joint(&self, robot: &RobotModel) -> Option<usize> {
        let names = robot.actuated_names();
        if names.len() == 1 {
            return Some(0);
        }
        let named = (0..names.len()).filter(|&j| self.whole.contains(&names[j].to_lowercase()));
        let number = || {
            let last = self.words.last()?;
            let digits = last.trim_start_matches(|c: char| !c.is_ascii_digit());
            digits.parse().ok().filter(|&j: &usize| j < names.len())
        };
        named.max_by_key(|&j| names[j].len()).or_else(number)
    }
}

fn unit_word(word: &str) -> Option<&'static str> {
    let found = UNIT_WORDS.iter().find(|(said, _)| *said == word);
    found.map(|(_, unit)| *unit)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use super::super::csv::{Map, read};
    use super::*;

    fn robot(name: &str) -> RobotModel {
        let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../robots");
        RobotModel::load(&Path::new(folder).join(format!("{name}.robot.toml"))).unwrap()
    }

    /// Semicolons, decimal commas, units in brackets: the draft reads it as it stands.
    #[test]
    fn a_draft_reads_the_file_that_it_was_made_from() {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("sine.csv");
        let text = "Time [ms];Goal Position (deg);Present Position (deg);Present Current (mA);Voltage;Remark\n\
            0,0;150,0;150,0;0;11,9;x\n5,0;151,5;150,5;31,5;11,9;y\n";
        std::fs::write(&file, text).unwrap();
        let robot = robot("xl330_pendulum");
        let draft = map(&file, &robot).unwrap();
        assert!(draft.contains("# not read: \"Remark\""), "{draft}");
        let run = read(&file, &Map::parse("draft", &draft).unwrap(), &robot).unwrap();
        let names: Vec<String> = run.signals.iter().map(ToString::to_string).collect();
        assert_eq!(names, ["cmd.swing", "pos.swing", "cur.swing", "volt"]);
        let deg = std::f64::consts::PI / 180.0;
        // the joint turns that far, so that nothing is moved
        let want = [0.005, 151.5 * deg, 150.5 * deg, 0.0315, 11.9];
        let (t, row) = &run.rows[1];
        let got = [Some(*t)].into_iter().chain(row.iter().copied());
        for (got, want) in got.zip(want) {
            assert!((got.unwrap() - want).abs() < 1e-4, "{got:?} {want}");
        }
    }

    #[test]
    fn columns_find_their_joints_and_units() {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("dog.csv");
        let text = "timestamp,FL_hip_cmd,FL_hip_pos_deg,q_1,torque.HR_calf,cmd_vel_2,target_99\n\
            1000000,0.1,205.0,2048,1.0,0,0\n1010000,0.1,205.0,2100,1.0,0,0\n";
        std::fs::write(&file, text).unwrap();
        let draft = map(&file, &robot("quadruped")).unwrap();
        for said in [
            "unit = \"us\"",
            "signal = \"cmd.FL_hip\"\ncolumn = \"FL_hip_cmd\"\nunit = \"rad\"",
            "signal = \"pos.FL_hip\"\ncolumn = \"FL_hip_pos_deg\"\nunit = \"deg\"",
            "signal = \"pos.FL_thigh\"\ncolumn = \"q_1\"\nunit = \"counts/4096\"",
            "rad is outside of the joint's range",
            "signal = \"tau.HR_calf\"",
            "# not read: \"cmd_vel_2\"",
            "# not read: \"target_99\", as none",
        ] {
            assert!(draft.contains(said), "{said} in {draft}");
        }
        assert!(Map::parse("draft", &draft).is_ok());
    }
}
