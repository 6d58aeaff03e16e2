//! A map for a recording of anybody, guessed from its names and its numbers: something to begin with, and to check.
//!
//! What the form of the recording tells of a column counts ([`Hint`]). Else words of its name say what it is (`goal`,
//! `present position`, `vel`), brackets or the last word say its unit; where none does, the size of the numbers
//! does. A column whose name says nothing is known by its unit, and an angle by the numbers: of two of a joint that
//! are alike the one that comes later follows the other. What nobody can know (where zero is) is said as a comment.

use std::collections::BTreeMap;
use std::fmt::Write as _;

use caudata_model::{BaseKind, RobotModel};

use super::clock::clock;
use super::map::{UNKNOWN, unit};
use super::order::Order;
use super::run::ImportError;
use super::sheet::{Hint, Joint, Recording, Sheet};
use super::units::{MOST_RAD, is_slide, unit_at, unit_by_size, unit_of_slide};
use super::words::{COMMANDS, SUPPLIES, Words, joint_called};

/// Words in the names of grippers, which some give as a share of their range when all else is an angle.
const GRIPPERS: [&str; 3] = ["gripper", "jaw", "claw"];
/// Numbers beyond this are no shares of 100, but degrees.
const MOST_PERCENT: f64 = 100.5;

/// A map, and how far it goes.
#[derive(Debug, Clone, Default)]
pub struct Drafted {
    /// The map, with comments.
    pub map: String,
    /// Signals that have a column.
    pub read: Vec<String>,
    /// Columns that were not understood.
    pub unread: Vec<String>,
}

/// A map for `recordings`, which are of one form, of `robot`.
///
/// # Errors
/// [`ImportError`] where there is none, or no column of it can be the time.
pub fn map(recordings: &[Recording], robot: &RobotModel) -> Result<Drafted, ImportError> {
    let Some(first) = recordings.first() else { return Ok(Drafted::default()) };
    let clock = match &first.clock {
        Some(clock) => clock.clone(),
        None => clock(first)?,
    };
    let base = match robot.base() {
        BaseKind::Free => "\"free\"        # \"fixed\" where it hung, or was held",
        _ => "\"fixed\"",
    };
    let mut draft = Draft {
        recordings,
        robot,
        angles: None,
        offsets_rad: vec![None; robot.actuated().len()],
        read: Vec::new(),
        unread: Vec::new(),
        by_numbers: BTreeMap::new(),
        order: Order::of(first, robot, &clock.column),
        out: format!("# Guessed from {}; check every line.\n", first.file),
    };
    for note in &first.notes {
        let _ = writeln!(draft.out, "# {note}");
    }
    draft.angles = draft.angles();
    let _ = write!(
        draft.out,
        "base = {base}\n\
         # kp = 0.0            # N·m/rad, the gain that was in force; without it the robot file's\n\
         # supply_v = 0.0      # V\n\n[time]\ncolumn = {}\nunit = \"{}\"\n",
        quoted(&clock.column),
        clock.unit,
    );
    if !clock.remark.is_empty() {
        let _ = writeln!(draft.out, "# {}", clock.remark);
    }
    for (number, sheet) in first.sheets.iter().enumerate() {
        let joint = |words: &Words| words.joint(robot).or_else(|| draft.order.joint(words, robot));
        draft.by_numbers = by_numbers(sheet.as_ref(), &joint, &clock.column);
        let columns = sheet.header().into_iter();
        let clocks = ["stamp", "received"];
        let is_clock = |c: &str| c == clock.column || first.clock.is_some() && clocks.contains(&c);
        for column in columns.filter(|c| !is_clock(c)) {
            draft.column(number, sheet.as_ref(), column);
        }
    }
    for topic in &first.unread {
        let _ = writeln!(draft.out, "\n# not read: {topic}");
    }
    for (kind, what) in [("cmd", "commands"), ("pos", "measured angles")] {
        let taken = |name: &String| name.split_once('.').is_some_and(|(own, _)| own == kind);
        if !draft.read.iter().any(taken) {
            let _ = writeln!(
                draft.out,
                "\n# Nothing was taken for {what} ({kind}.<joint>): a diagnosis needs them. For instance:\n\
                 # [[signal]]\n# signal = \"{kind}.{}\"\n# column = \"the column's name\"\n# unit = \"deg\"",
                robot.actuated_names().first().unwrap_or(&"joint")
            );
        }
    }
    Ok(Drafted { map: draft.out, read: draft.read, unread: draft.unread })
}

/// Most rows by which a reading may come after its command.
const MOST_LAG: usize = 40;
/// A reading differs from the command that it follows by no more than this share of its variance.
const KEEPS_UP: f64 = 0.6;
/// Columns of one joint of which nothing is known, at most, that are told by their numbers.
const MOST_UNKNOWN: usize = 4;
/// Rows by which they are told, at most.
const ROWS_ASKED: usize = 20_000;
/// Fewest rows that tell which of two columns follows the other.
const FEWEST_ROWS: usize = 50;

/// What columns without a word that says so are: by their unit, or, of angles, by which follows which.
fn by_numbers(
    sheet: &dyn Sheet,
    joint: &dyn Fn(&Words) -> Option<usize>,
    clock: &str,
) -> BTreeMap<String, &'static str> {
    let mut out = BTreeMap::new();
    // angles of each joint that nothing is known of, and its command and reading, if known
    let mut angles: BTreeMap<usize, Vec<&str>> = BTreeMap::new();
    let mut known: BTreeMap<(usize, &str), &str> = BTreeMap::new();
    for column in sheet.header().into_iter().filter(|c| *c != clock && sheet.hint(c).is_none()) {
        let words = Words::of(column);
        let Some(joint) = joint(&words) else { continue };
        match (words.kind(), words.unit) {
            (Some(kind), _) => {
                known.insert((joint, kind), column);
            }
            (None, _) if words.has(COMMANDS) => {}
            (None, Some("A" | "mA")) => {
                out.insert(column.to_owned(), "cur");
            }
            (None, Some(name)) if unit(name).is_ok_and(|(_, of)| of == "speed") => {
                out.insert(column.to_owned(), "vel");
            }
            (None, None | Some("rad" | "deg" | "turn")) => {
                angles.entry(joint).or_default().push(column);
            }
            _ => {}
        }
    }
    // among more than a few columns of one joint, numbers tell too little and take too long
    angles.retain(|_, unknown| unknown.len() <= MOST_UNKNOWN);
    for (joint, unknown) in angles {
        let of = |kind| known.get(&(joint, kind)).copied();
        let pairs: Vec<(&str, &str)> = match (of("cmd"), of("pos")) {
            (Some(_), Some(_)) => Vec::new(),
            (Some(cmd), None) => unknown.iter().map(|c| (cmd, *c)).collect(),
            (None, Some(pos)) => unknown.iter().map(|c| (*c, pos)).collect(),
            (None, None) => (unknown.iter())
                .flat_map(|a| unknown.iter().map(move |b| (*a, *b)))
                .filter(|(a, b)| a != b)
                .collect(),
        };
        let follows = |(a, b): (&'_ str, &'_ str)| {
            let left = follows(&sheet.values(a, None).ok()?, &sheet.values(b, None).ok()?)?;
            Some((left, a.to_owned(), b.to_owned()))
        };
        let best = pairs.into_iter().filter_map(follows).min_by(|a, b| a.0.total_cmp(&b.0));
        if let Some((_, command, reading)) = best {
            for (column, kind) in [(command, "cmd"), (reading, "pos")] {
                if Words::of(&column).kind().is_none() {
                    out.insert(column, kind);
                }
            }
        }
    }
    out
}

/// What `reading` differs from `command` by, moved to where they are most alike, as a share of its variance;
/// `None` where they are not alike, or it does not come later.
fn follows(command: &[Option<f64>], reading: &[Option<f64>]) -> Option<f64> {
    let both: Vec<(f64, f64)> =
        command.iter().zip(reading).filter_map(|(a, b)| a.zip(*b)).take(ROWS_ASKED).collect();
    if both.len() < FEWEST_ROWS {
        return None;
    }
    let n = both.len() as f64;
    let mean = both.iter().map(|p| p.1).sum::<f64>() / n;
    let variance = both.iter().map(|p| (p.1 - mean).powi(2)).sum::<f64>() / n;
    let apart = |lag: usize| {
        let pairs = both.iter().zip(&both[lag..]);
        let square: f64 = pairs.map(|((a, _), (_, b))| (a - b).powi(2)).sum();
        square / (both.len() - lag) as f64
    };
    let lags = 0..=MOST_LAG.min(both.len() / 4);
    let (lag, least) = lags.map(|lag| (lag, apart(lag))).min_by(|a, b| a.1.total_cmp(&b.1))?;
    (lag > 0 && variance > 0.0 && least < KEEPS_UP * variance).then(|| least / variance)
}

/// A map that is being written.
struct Draft<'a> {
    recordings: &'a [Recording],
    robot: &'a RobotModel,
    /// Unit of the angles of a recording whose form leaves it open.
    angles: Option<&'static str>,
    /// What the angles of each joint were moved by.
    offsets_rad: Vec<Option<f64>>,
    /// Signals that have a column.
    read: Vec<String>,
    /// Columns that were not understood.
    unread: Vec<String>,
    /// What columns of the present sheet are by their units and numbers.
    by_numbers: BTreeMap<String, &'static str>,
    /// Joints of columns that name none.
    order: Order,
    out: String,
}

impl Draft<'_> {
    /// The numbers of a column as they stand, in all recordings.
    fn numbers(&self, sheet: usize, column: &str) -> Vec<f64> {
        let sheets = self.recordings.iter().filter_map(|r| r.sheets.get(sheet));
        let values = sheets.filter_map(|s| s.values(column, None).ok());
        values.flatten().flatten().collect()
    }

    /// In which unit the angles are where the form leaves it open, and why: written as a comment.
    fn angles(&mut self) -> Option<&'static str> {
        let first = self.recordings.first()?;
        let mut most = None;
        for (number, sheet) in first.sheets.iter().enumerate() {
            for column in sheet.header() {
                let open = sheet.hint(column).is_some_and(|h| {
                    h.unit == Some(UNKNOWN)
                        && ["cmd", "pos"].contains(&h.kind)
                        && !is_gripper(column)
                });
                if open {
                    let values = self.numbers(number, column);
                    let largest = values.iter().fold(0.0f64, |m, v| m.max(v.abs()));
                    most = Some(largest.max(most.unwrap_or(0.0)));
                }
            }
        }
        let most: f64 = most?;
        let (unit, why) = match most {
            m if m > MOST_PERCENT => ("deg", "taken for degrees: no share of 100 is as large"),
            m if m <= MOST_RAD => ("rad", "taken for radians"),
            _ => (
                UNKNOWN,
                "which fits degrees as well as shares of each joint's calibrated range (-100..100): \
                 write in one of them",
            ),
        };
        let _ = writeln!(
            self.out,
            "# Its units are not in the data. The largest of its angles is {most:.2}, {why}."
        );
        Some(unit)
    }

    /// The lines of one column.
    fn column(&mut self, number: usize, sheet: &dyn Sheet, column: &str) {
        let values = self.numbers(number, column);
        let hint = sheet.hint(column);
        let mut recordings = self.recordings.iter().filter(|_| hint.is_none());
        let file = recordings.find_map(|recording| recording.file_of(sheet));
        match self.said(column, hint, file, &values) {
            Ok((name, joint, unit_name)) => {
                let unit_name = unit_at(self.robot, joint, unit_name);
                if self.read.contains(&name) {
                    let header = quoted(column);
                    let _ =
                        writeln!(self.out, "\n# not read: {header}, as {name} is there already");
                    return;
                }
                let _ = writeln!(self.out, "\n[[signal]]\nsignal = {}", quoted(&name));
                let by_place = match hint {
                    Some(hint) => matches!(hint.joint, Some(Joint::Numbered(_, 2..))),
                    None => Words::of(column).joint(self.robot).is_none(),
                };
                if joint.is_some() && by_place {
                    self.out.push_str(
                        "# it names no joint: this one is guessed by its place or number\n",
                    );
                }
                if self.by_numbers.contains_key(column) {
                    self.out.push_str(
                        "# its name says nothing: guessed by its unit and by what follows what\n",
                    );
                }
                if let Some(file) = file {
                    let _ = writeln!(self.out, "file = {}", quoted(file));
                }
                let _ = writeln!(self.out, "column = {}\nunit = \"{unit_name}\"", quoted(column));
                let words = Words::of(column);
                let hinge = joint.is_some() && !is_slide(self.robot, joint);
                let of_slide = words.unit.filter(|_| words.unit_at(hinge).is_none());
                if let Some(word) = words.strange_unit.or(of_slide.map(str::to_owned)) {
                    let _ = writeln!(
                        self.out,
                        "# its unit, `{word}`, is none of these here: this one is guessed by the size of its numbers"
                    );
                }
                if let (Some(joint), true) =
                    (joint, name.starts_with("cmd.") || name.starts_with("pos."))
                {
                    self.place(joint, unit_name, &values);
                }
                let figure = "torque_per_current_nm_per_a";
                let assumed = joint.and_then(|j| self.robot.assumed_of_servo(j, figure));
                if let (true, Some(path)) = (name.starts_with("cur."), assumed) {
                    let _ = writeln!(
                        self.out,
                        "# leave it out until the robot file's {path} is that of your motor"
                    );
                }
                if name.starts_with("base.") {
                    self.out.push_str("# odometry is an estimate: leave it out unless it was measured from outside\n");
                }
                self.read.push(name);
            }
            Err(why) => {
                let _ = writeln!(self.out, "\n# not read: {}{why}", quoted(column));
                self.unread.push(column.to_owned());
            }
        }
    }

    /// Which signal a column is (of a `file` among several), of which joint, in which unit; else why it is none.
    fn said(
        &self,
        column: &str,
        hint: Option<&Hint>,
        file: Option<&str>,
        values: &[f64],
    ) -> Result<(String, Option<usize>, &'static str), String> {
        let words = Words::of(column);
        let kind = match hint {
            Some(hint) => Some(hint.kind).filter(|kind| !kind.is_empty()),
            None => {
                // the name of a file says nothing of a count or a stamp
                let joint = || {
                    joint_called(self.robot, &words.whole).or(self.order.joint(&words, self.robot))
                };
                let kind = words.kind_in(file.filter(|_| joint().is_some()));
                // `bus_mV` is in volts and of no joint: the supply
                let of_robot = || joint_called(self.robot, &words.whole).is_none();
                let of_supply = words.has(SUPPLIES) && !words.says(COMMANDS);
                let supply = matches!(words.unit, Some("V" | "mV")) && of_supply && of_robot();
                kind.or(self.by_numbers.get(column).copied()).or(supply.then_some("volt"))
            }
        };
        let not_taken = || words.commands_otherwise().unwrap_or_default().to_owned();
        let kind = kind.filter(|_| !values.is_empty()).ok_or_else(not_taken)?;
        if let (None, Some(why)) = (hint, words.moves_otherwise()) {
            return Err(why);
        }
        let joint = match hint.map(|hint| &hint.joint) {
            _ if kind == "volt" => None,
            Some(None) => None,
            Some(Some(Joint::Named(name))) => Some(joint_called(self.robot, name)),
            Some(Some(Joint::Numbered(k, count))) => {
                let joints = self.robot.actuated().len();
                if *count != joints {
                    return Err(format!(
                        ", as which joints its {count} numbers are is not said, and the robot has {joints}"
                    ));
                }
                Some(Some(*k))
            }
            None => {
                let by_order = || self.order.joint(&words, self.robot);
                Some(words.joint(self.robot).or_else(by_order))
            }
        };
        let (name, joint) = match joint {
            Some(Some(joint)) => {
                (format!("{kind}.{}", self.robot.actuated_names()[joint]), Some(joint))
            }
            Some(None) => return Err(", as none of the robot's joints is named in it".to_owned()),
            None => (kind.to_owned(), None),
        };
        let slide = is_slide(self.robot, joint);
        let unit_name =
            match hint.and_then(|hint| hint.unit).or(words.unit_at(joint.is_some() && !slide)) {
                Some(UNKNOWN) if ["cmd", "pos"].contains(&kind) => self.open_unit(column, values),
                Some(UNKNOWN) | None if slide => unit_of_slide(kind, values),
                Some(UNKNOWN) | None => unit_by_size(kind, values),
                Some(unit) => unit,
            };
        Ok((name, joint, unit_name))
    }

    /// Unit of an angle whose form leaves it open.
    fn open_unit(&self, column: &str, values: &[f64]) -> &'static str {
        let angles = self.angles.unwrap_or(UNKNOWN);
        let within = |low: f64, high: f64| values.iter().all(|v| (low..=high).contains(v));
        match (is_gripper(column), angles) {
            (true, "rad") if within(-0.05, 1.05) => "0..1",
            (true, "deg" | UNKNOWN) if within(-0.5, MOST_PERCENT) => "0..100",
            _ => angles,
        }
    }

    /// Where zero is, or the range of which a number is a share: no file says.
    fn place(&mut self, joint: usize, unit_name: &str, values: &[f64]) {
        let (low, high) = self.robot.joint_limits_rad()[joint];
        let text = match unit(unit_name) {
            Ok((size, _)) => {
                let values_rad: Vec<f64> = values.iter().map(|v| v * size).collect();
                zero(self.robot, joint, &mut self.offsets_rad[joint], &values_rad)
            }
            Err(_) if unit_name == UNKNOWN => format!(
                "# range = [{low:.4}, {high:.4}]   # rad at -100 and at 100, with unit = \"-100..100\"; these are the robot file's\n"
            ),
            Err(_) => format!(
                "# range = [{low:.4}, {high:.4}]   # rad at its ends. These are the robot file's: check them, and take away the # in front\n"
            ),
        };
        self.out.push_str(&text);
    }
}

fn is_gripper(column: &str) -> bool {
    let column = column.to_lowercase();
    GRIPPERS.iter().any(|word| column.contains(word))
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

fn quoted(text: &str) -> String {
    toml::Value::String(text.trim().to_owned()).to_string()
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use super::super::map::{Map, apply};
    use super::super::{Format, open};
    use super::*;
    use std::path::Path;

    fn robot(name: &str) -> RobotModel {
        let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../robots");
        RobotModel::load(&Path::new(folder).join(format!("{name}.robot.toml"))).unwrap()
    }

    /// Semicolons, decimal commas, units in brackets: the draft reads it as it stands.
    #[test]
    fn a_draft_reads_the_file_that_it_was_made_from() {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("sine.csv");
        let text = "Time [ms];Goal Position (deg);Present Position (deg);Present Current (mA);Voltage;Geschw. [°/s];Remark;Soll [°/s]\n\
            0,0;150,0;150,0;0;11,9;0;x;0\n5,0;151,5;150,5;31,5;11,9;9;y;0\n";
        std::fs::write(&file, text).unwrap();
        let robot = robot("xl330_pendulum");
        let recordings = open(&file, Format::Csv, None).unwrap();
        let draft = map(&recordings, &robot).unwrap().map;
        assert!(draft.contains("# not read: \"Remark\""), "{draft}");
        let run = apply(&recordings[0], &Map::parse("draft", &draft).unwrap(), &robot).unwrap();
        assert_eq!(run.unused, ["Remark", "Soll [°/s]"]);
        let names: Vec<String> = run.signals.iter().map(ToString::to_string).collect();
        assert_eq!(names, ["cmd.swing", "pos.swing", "cur.swing", "volt", "vel.swing"]);
        let deg = std::f64::consts::PI / 180.0;
        // the joint turns that far, so that nothing is moved
        let want = [0.005, 151.5 * deg, 150.5 * deg, 0.0315, 11.9, 9.0 * deg];
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
        let text = "timestamp,FL_hip_cmd,FL_hip_pos_deg,q_1,torque.HR_calf,cmd_vel_2,target_99,FL_hip_vel_deg_s,FR_hip_vel_deg_s2,HL_hip_vel_deg,bus_mV\n\
            1000000,0.1,205.0,2048,1.0,0,0,1,1,1,24000\n1010000,0.1,205.0,2100,1.0,0,0,1,1,1,24010\n";
        std::fs::write(&file, text).unwrap();
        let recordings = open(&file, Format::Csv, None).unwrap();
        let draft = map(&recordings, &robot("quadruped")).unwrap().map;
        for said in [
            "unit = \"us\"",
            "signal = \"cmd.FL_hip\"\ncolumn = \"FL_hip_cmd\"\nunit = \"rad\"",
            "signal = \"pos.FL_hip\"\ncolumn = \"FL_hip_pos_deg\"\nunit = \"deg\"",
            "signal = \"pos.FL_thigh\"\n# it names no joint: this one is guessed by its place or number\ncolumn = \"q_1\"",
            "rad is outside of the joint's range",
            "signal = \"tau.HR_calf\"",
            "signal = \"vel.FL_hip\"\ncolumn = \"FL_hip_vel_deg_s\"\nunit = \"deg/s\"",
            "# not read: \"cmd_vel_2\"",
            "signal = \"volt\"\ncolumn = \"bus_mV\"\nunit = \"mV\"",
            "# not read: \"FR_hip_vel_deg_s2\", as its unit `deg/s2` is one of angular acceleration",
            "# not read: \"HL_hip_vel_deg\", as its unit `deg` is one of angle, and not of speed",
            "# not read: \"target_99\", as none",
        ] {
            assert!(draft.contains(said), "{said} in {draft}");
        }
        assert!(Map::parse("draft", &draft).is_ok());
    }

    /// A command in steps of which a reading is what a slow joint makes, and a current; no word is known.
    #[test]
    fn what_follows_is_the_reading() {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("arm.csv");
        let mut text = String::from("t;kyynar_a_deg;kyynar_b_deg;kyynar_c_mA\n");
        let mut reading = 0.0_f64;
        for k in 0..400 {
            let command = [0.0, 30.0, -20.0, 10.0][k / 40 % 4];
            reading += 0.2 * (command - reading);
            text += &format!(
                "{};{reading:.3};{command};{:.0}\n",
                0.01 * k as f64,
                9.0 * (command - reading)
            );
        }
        std::fs::write(&file, text).unwrap();
        let recordings = open(&file, Format::Csv, None).unwrap();
        let drafted = map(&recordings, &robot("xl330_pendulum")).unwrap();
        assert_eq!(drafted.read, ["pos.swing", "cmd.swing", "cur.swing"]);
        assert!(drafted.unread.is_empty() && drafted.map.contains("guessed by its unit"));
        assert!(drafted.map.contains("column = \"kyynar_b_deg\""));

        // two that move at once say nothing, and an example stands in for them
        std::fs::write(&file, "t;a;b\n0;1;1\n1;2;2\n").unwrap();
        let recordings = open(&file, Format::Csv, None).unwrap();
        let drafted = map(&recordings, &robot("xl330_pendulum")).unwrap();
        assert_eq!(drafted.unread, ["a", "b"]);
        assert!(drafted.map.contains("# signal = \"cmd.swing\""));
        assert!(Map::parse("draft", &drafted.map).unwrap_err().to_string().contains("is empty"));
    }
}
