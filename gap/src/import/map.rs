//! The map that says which column of a recording is which signal of a log, and in which unit.
//!
//! ```toml
//! base = "fixed"
//! kp = 16.4                      # everything that log.toml may say
//! [time]
//! column = "timestamp"
//! unit = "us"
//! [[signal]]
//! signal = "cmd.elbow"           # name of the log's column
//! file = "control.csv"           # of a folder of CSV files; without it the first that has the column
//! column = "positions"
//! item = 2                       # of a list; the first is 0
//! unit = "deg"
//! scale = -1.0                   # after the unit: scale · x + offset
//! offset = 0.1                   # SI
//! [[signal]]
//! signal = "pos.gripper"
//! column = "observation.state/gripper.pos"
//! unit = "0..100"                # a share of the joint's range,
//! range = [-0.17, 1.75]          # whose ends are these, SI
//! ```

use std::collections::{BTreeMap, BTreeSet};

use caudata_model::RobotModel;
use caudata_runlog::{BaseHold, ForcePoint, JointConditions, LogMeta, Payload, Setting, Signal};
use serde::Deserialize;

use super::run::{ImportError, Imported};
use super::sheet::{Recording, Sheet};
use super::units::unit_word;

/// Later than this a stamp is of the calendar (1970 and some months), not of a run, s.
const CALENDAR_S: f64 = 1e7;
/// Stamps nearer to each other than this are one row, s.
const SAME_STAMP_S: f64 = 1e-6;

/// Which column is what.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Map {
    base: BaseHold,
    #[serde(default)]
    terrain: String,
    #[serde(default)]
    notes: String,
    kp: Option<f64>,
    kd: Option<f64>,
    supply_v: Option<f64>,
    water_level_m: Option<f64>,
    #[serde(default)]
    joint: BTreeMap<String, JointConditions>,
    #[serde(default)]
    payload: Vec<Payload>,
    #[serde(default)]
    outer_force: Vec<ForcePoint>,
    time: Column,
    #[serde(default)]
    signal: Vec<SignalColumn>,
}

#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
struct Column {
    column: String,
    unit: String,
}

#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
struct SignalColumn {
    signal: String,
    file: Option<String>,
    column: String,
    item: Option<usize>,
    unit: String,
    #[serde(default = "one")]
    scale: f64,
    #[serde(default)]
    offset: f64,
    range: Option<[f64; 2]>,
}

fn one() -> f64 {
    1.0
}

/// Units of columns: their size in SI, and what they measure. `1` goes with everything.
const UNITS: &[(&str, f64, &str)] = &[
    ("1", 1.0, "any"),
    ("rad", 1.0, "angle"),
    ("deg", std::f64::consts::PI / 180.0, "angle"),
    ("turn", std::f64::consts::TAU, "angle"),
    ("mrad", 1e-3, "angle"),
    ("rad/s", 1.0, "speed"),
    ("deg/s", std::f64::consts::PI / 180.0, "speed"),
    ("mrad/s", 1e-3, "speed"),
    ("rev/s", std::f64::consts::TAU, "speed"),
    ("rev/min", std::f64::consts::TAU / 60.0, "speed"),
    ("rad/s2", 1.0, "angular acceleration"),
    ("deg/s2", std::f64::consts::PI / 180.0, "angular acceleration"),
    ("A", 1.0, "current"),
    ("mA", 1e-3, "current"),
    ("uA", 1e-6, "current"),
    ("N·m", 1.0, "torque"),
    ("Nm", 1.0, "torque"),
    ("mNm", 1e-3, "torque"),
    ("cNm", 1e-2, "torque"),
    ("kgf·cm", 0.098_066_5, "torque"),
    ("V", 1.0, "voltage"),
    ("mV", 1e-3, "voltage"),
    ("m", 1.0, "length"),
    ("mm", 1e-3, "length"),
    ("m/s", 1.0, "velocity"),
    ("mm/s", 1e-3, "velocity"),
    ("N", 1.0, "force"),
    ("m/s²", 1.0, "acceleration"),
    ("m/s2", 1.0, "acceleration"),
    ("g", 9.80665, "acceleration"),
    ("°C", 1.0, "temperature"),
    ("degC", 1.0, "temperature"),
    ("%", 1e-2, "share"),
    ("s", 1.0, "time"),
    ("ms", 1e-3, "time"),
    ("us", 1e-6, "time"),
    ("ns", 1e-9, "time"),
];

/// Units that are a share of a joint's range: what stands at its lower and at its upper end.
const SHARE_UNITS: &[(&str, [f64; 2])] =
    &[("-100..100", [-100.0, 100.0]), ("0..100", [0.0, 100.0]), ("0..1", [0.0, 1.0])];
/// Unit that a draft writes where it cannot tell.
pub(super) const UNKNOWN: &str = "?";

/// What the values of a signal measure; none where a plain number is all that it has.
fn measured(signal: &Signal) -> Option<&'static str> {
    Some(match signal {
        Signal::Command(_) | Signal::Position(_) | Signal::SecondPosition(_) => "angle",
        Signal::Velocity(_) | Signal::CommandVelocity(_) | Signal::Gyro(_) => "speed",
        Signal::Current(_) => "current",
        Signal::Torque(_) | Signal::CommandTorque(_) => "torque",
        Signal::Force(..) => "force",
        Signal::Temperature(_) => "temperature",
        Signal::Duty(_) => "share",
        Signal::Voltage => "voltage",
        Signal::Acceleration(_) => "acceleration",
        Signal::BasePosition(_) | Signal::Mocap(..) | Signal::Foot(..) => "length",
        Signal::BaseVelocity(_) => "velocity",
        Signal::Enabled(_) | Signal::Gravity(_) => return None,
        Signal::BaseQuaternion(_) | Signal::Contact(_) => return None,
    })
}

/// Whether a unit `of` something goes with a signal that measures `want`.
pub(super) fn fits(of: &str, want: &str) -> bool {
    of == want || of == "any"
}

/// Whether a unit of something is one of a slide's, in whose place hinges have `want`.
pub(super) fn of_slide(of: &str, want: &str) -> bool {
    [("length", "angle"), ("velocity", "speed"), ("force", "torque")].contains(&(of, want))
}

/// Size of a unit, and what it measures; `counts/4096` is a turn of 4096 counts, `counts/4096/s` a speed.
pub(super) fn unit(text: &str) -> Result<(f64, &'static str), String> {
    if let Some(n) = text.strip_prefix("counts/") {
        let (n, of) = match n.strip_suffix("/s") {
            Some(n) => (n, "speed"),
            None => (n, "angle"),
        };
        let n: f64 = n.parse().map_err(|_| format!("unit `{text}`: `{n}` is no number"))?;
        return match n > 0.0 {
            true => Ok((std::f64::consts::TAU / n, of)),
            false => Err(format!("unit `{text}`: a turn has more than no counts")),
        };
    }
    let called = |name: &str| UNITS.iter().find(|u| u.0 == name);
    let known = called(text).or_else(|| called(unit_word(&text.to_lowercase())?));
    known.map(|u| (u.1, u.2)).ok_or_else(|| {
        let all = UNITS.iter().map(|u| u.0);
        let all: Vec<&str> = all.chain(SHARE_UNITS.iter().map(|s| s.0)).collect();
        match text {
            UNKNOWN => "its unit is not known: the numbers fit degrees as well as shares of the joint's range; write `unit = \"deg\"`, or `unit = \"-100..100\"` with `range = [low, high]` in rad".to_owned(),
            _ => format!("unknown unit `{text}`; known: {}, counts/N, counts/N/s", all.join(", ")),
        }
    })
}

impl SignalColumn {
    /// What a value of the column is multiplied by and what is then added, for SI.
    fn factors(&self) -> Result<(f64, f64), String> {
        let signal: Signal = self.signal.parse().map_err(|e| format!("{e}"))?;
        let share = SHARE_UNITS.iter().find(|s| s.0 == self.unit);
        let (factor, shift) = match (share, self.range) {
            (None, None) => {
                let (size, of) = unit(&self.unit)?;
                let of_joint = signal.joint().is_some();
                let goes = |want: &&str| fits(of, want) || of_joint && of_slide(of, want);
                if let Some(want) = measured(&signal).filter(|want| !goes(want)) {
                    let unit = &self.unit;
                    return Err(format!("unit `{unit}` is one of {of}, and not of {want}"));
                }
                (size, 0.0)
            }
            (Some((_, [from, to])), Some([low, high])) => {
                let factor = (high - low) / (to - from);
                (factor, low - factor * from)
            }
            (Some(_), None) => {
                return Err(format!(
                    "unit `{}` is a share of the joint's range: say what its ends are, `range = [low, high]` in rad, or leave the signal out",
                    self.unit
                ));
            }
            (None, Some(_)) => {
                let shares: Vec<&str> = SHARE_UNITS.iter().map(|s| s.0).collect();
                return Err(format!("`range` is for the units {}", shares.join(", ")));
            }
        };
        Ok((self.scale * factor, self.scale * shift + self.offset))
    }

    /// Joints are the robot's, and only slides have lengths.
    fn goes_with(&self, signal: &Signal, robot: &RobotModel) -> Result<(), String> {
        let names = robot.actuated_names();
        if let Some(joint) = signal.joint().filter(|joint| !names.contains(joint)) {
            let names = names.join(", ");
            return Err(format!(
                "{}: the robot has no joint `{joint}`; it has {names}",
                self.signal
            ));
        }
        let (Some(want), Ok((_, of))) = (measured(signal), unit(&self.unit)) else { return Ok(()) };
        let named = |name: &&str| signal.joint() == Some(*name);
        let joint = names.iter().position(named);
        let slide = joint.is_some_and(|joint| robot.per_radian(joint) != 1.0);
        match !slide && of_slide(of, want) {
            true => Err(format!(
                "{}: unit `{}` is one of {of}, and not of {want}",
                self.signal, self.unit
            )),
            false => Ok(()),
        }
    }
}

impl Map {
    /// Reads a map; `file` names it in errors.
    ///
    /// # Errors
    /// [`ImportError::Format`] with line and reason.
    pub fn parse(file: &str, text: &str) -> Result<Self, ImportError> {
        let wrong = |message: String| ImportError::Format { file: file.to_owned(), message };
        let map: Self = toml::from_str(text).map_err(|e| {
            let line =
                e.span().map_or(1, |s| 1 + text[..s.start.min(text.len())].matches('\n').count());
            wrong(format!("line {line}: {}", e.message().replace('\n', " ")))
        })?;
        if map.signal.is_empty() {
            return Err(wrong(
                "is empty: it says of no column what it is; write a [[signal]] for the command and one for the angle of each joint"
                    .to_owned(),
            ));
        }
        match unit(&map.time.unit).map_err(wrong)? {
            (_, "time" | "any") => {}
            (_, of) => {
                let unit = &map.time.unit;
                return Err(wrong(format!(
                    "[time]: unit `{unit}` is one of {of}, and not of time"
                )));
            }
        }
        for s in &map.signal {
            s.factors().map_err(|e| wrong(format!("{}: {e}", s.signal)))?;
        }
        Ok(map)
    }

    /// The files that it names, of a folder of CSV files.
    pub(super) fn files(&self) -> BTreeSet<&str> {
        self.signal.iter().filter_map(|s| s.file.as_deref()).collect()
    }
}

/// The log of `robot` that `recording` is by `map`.
///
/// # Errors
/// [`ImportError`] with file, column and reason.
pub fn apply(
    recording: &Recording,
    map: &Map,
    robot: &RobotModel,
) -> Result<Imported, ImportError> {
    let wrong = |message: String| ImportError::Format { file: recording.file.clone(), message };
    let mut signals: Vec<Signal> = Vec::new();
    let mut samples: Vec<(f64, usize, f64)> = Vec::new();
    let mut used: BTreeSet<(&str, &str)> = BTreeSet::new();
    // values of the signal with the most, and their rate
    let mut most = (0, 1.0);
    for column in &map.signal {
        let sheet = sheet_of(recording, column).map_err(wrong)?;
        let name = called(sheet, &column.column);
        let time_s = sheet.values(called(sheet, &map.time.column), None)?;
        let (size_s, _) = unit(&map.time.unit).map_err(wrong)?;
        let (factor, shift) = column.factors().map_err(wrong)?;
        let values = sheet.values(name, column.item)?;
        used.insert((sheet.name(), name));
        let before = samples.len();
        for (t, v) in time_s.iter().zip(values) {
            if let (Some(t), Some(v)) = (t, v) {
                samples.push((t * size_s, signals.len(), factor * v + shift));
            }
        }
        if samples.len() == before {
            return Err(wrong(format!("`{}` has no value with a stamp", column.column)));
        }
        if samples.len() - before > most.0 {
            let time_s: Vec<f64> = samples[before..].iter().map(|sample| sample.0).collect();
            most = (time_s.len(), rate_hz(&time_s));
        }
        let signal = column.signal.parse();
        let signal: Signal = signal.map_err(|e| wrong(format!("{}: {e}", column.signal)))?;
        column.goes_with(&signal, robot).map_err(wrong)?;
        signals.push(signal);
    }
    let mut notes = recording.notes.clone();
    notes.extend(not_later(&samples));
    let mut rows = rows(samples, signals.len());
    // stamps of the calendar count from the first
    if let Some(first_s) = rows.first().map(|r| r.0).filter(|t| *t > CALENDAR_S) {
        rows.iter_mut().for_each(|row| row.0 -= first_s);
    }
    if rows.is_empty() {
        return Err(wrong("has no row with a stamp and a value".to_owned()));
    }
    // Topics have stamps of their own: the rate is that of the signal with the most values.
    let meta = map.meta(robot, most.1, &recording.name);
    Ok(Imported {
        name: recording.name.chars().map(letters).collect(),
        meta,
        signals,
        rows,
        notes,
        unused: unused(recording, map, &used),
    })
}

/// Values per second, pauses left out: whatever stamps are rounded to, and however values are bunched.
fn rate_hz(time_s: &[f64]) -> f64 {
    const PAUSE: f64 = 5.0;
    let steps = || time_s.windows(2).map(|w| w[1] - w[0]);
    let most_s = PAUSE * steps().sum::<f64>() / steps().count().max(1) as f64;
    let (count, span_s) =
        steps().filter(|step| *step <= most_s).fold((0.0, 0.0), |(n, s), x| (n + 1.0, s + x));
    // no stamp is finer
    (count / f64::max(span_s, 1e-6) * 1e6).round() / 1e6
}

fn letters(c: char) -> char {
    if c.is_ascii_alphanumeric() || c == '-' { c } else { '_' }
}

/// What a sheet calls a column: its header may have got its unit from a row of units.
fn called<'a>(sheet: &'a dyn Sheet, name: &'a str) -> &'a str {
    let name = name.trim();
    let of = |is: &dyn Fn(&str) -> bool| sheet.header().into_iter().map(str::trim).find(|h| is(h));
    let bare = |h: &str| h.strip_prefix(name).is_some_and(|unit| unit.starts_with(" ["));
    of(&|h| h == name).or_else(|| of(&bare)).unwrap_or(name)
}

/// Where a signal's column is.
fn sheet_of<'a>(recording: &'a Recording, column: &SignalColumn) -> Result<&'a dyn Sheet, String> {
    let has = |s: &dyn Sheet| {
        let name = called(s, &column.column);
        s.header().iter().any(|h| h.trim() == name)
    };
    let mut sheets = recording.sheets.iter().map(AsRef::as_ref);
    if let Some(file) = &column.file {
        let ends = |s: &&dyn Sheet| std::path::Path::new(s.name()).ends_with(file);
        return sheets.find(ends).ok_or_else(|| format!("has no file `{file}`"));
    }
    sheets.find(|s| has(*s)).ok_or_else(|| {
        let all: Vec<&str> = recording.sheets.iter().flat_map(|s| s.header()).collect();
        format!("has no column `{}`; it has {}", column.column, listed(&all))
    })
}

/// Names for a message; of very many the first.
pub(super) fn listed(names: &[&str]) -> String {
    const MOST: usize = 40;
    let shown = names[..names.len().min(MOST)].join(", ");
    match names.len() {
        n if n > MOST => format!("{shown} and {} more", n - MOST),
        _ => shown,
    }
}

/// What is there and was not used: topics, and columns; of a part (`/imu/orientation`) of which nothing was used
/// only its name with a star.
fn unused(recording: &Recording, map: &Map, used: &BTreeSet<(&str, &str)>) -> Vec<String> {
    let mut out = recording.unread.clone();
    for sheet in &recording.sheets {
        let header = sheet.header();
        let columns = header.iter().map(|h| h.trim());
        let clocks = ["stamp", "received", called(sheet.as_ref(), &map.time.column)];
        let columns: Vec<&str> = columns.filter(|c| !clocks.contains(c)).collect();
        // a unit in brackets may have a slash too
        let path = |c: &str| c.split(['[', '(']).next()?.rsplit_once('/').map(|p| p.0.to_owned());
        let part = |c: &str| path(c).unwrap_or_default();
        let is_used = |c: &str| used.contains(&(sheet.name(), c));
        if !columns.iter().any(|c| is_used(c)) {
            out.push(sheet.name().to_owned());
            continue;
        }
        let touched: BTreeSet<String> =
            columns.iter().filter(|c| is_used(c)).map(|c| part(c)).collect();
        let mut shown = BTreeSet::new();
        for column in columns.into_iter().filter(|c| !is_used(c)) {
            let part = part(column);
            shown.insert(match part.is_empty() || touched.contains(&part) {
                true => column.to_owned(),
                false => format!("{part}/*"),
            });
        }
        out.extend(shown);
    }
    out
}

impl Map {
    /// The circumstances of a run.
    fn meta(&self, robot: &RobotModel, rate_hz: f64, from: &str) -> LogMeta {
        let mut meta = LogMeta::new(robot.name(), self.base, rate_hz.clamp(1e-3, 1e5));
        meta.terrain.clone_from(&self.terrain);
        meta.notes = match self.notes.as_str() {
            "" => format!("imported from {from}"),
            notes => notes.to_owned(),
        };
        (meta.kp, meta.kd, meta.supply_v) = (self.kp, self.kd, self.supply_v);
        meta.joint.clone_from(&self.joint);
        meta.payload.clone_from(&self.payload);
        meta.outer_force.clone_from(&self.outer_force);
        if let Some(level_m) = self.water_level_m {
            let key = "water_level_m".to_owned();
            meta.settings.insert(key, Setting::Number(level_m));
        }
        meta
    }
}

/// What is to be said of samples (time, signal, value), signal by signal, whose stamps do not come after the one
/// before.
fn not_later(samples: &[(f64, usize, f64)]) -> Option<String> {
    let of = |own: &[(f64, usize, f64)]| {
        let wrong = own.windows(2).filter(|w| w[1].0 < w[0].0 + SAME_STAMP_S);
        let at_s: Vec<f64> = wrong.map(|w| w[1].0 - own[0].0).collect();
        Some((at_s.len(), *at_s.first()?))
    };
    let worst = samples.chunk_by(|a, b| a.1 == b.1).filter_map(of).max_by_key(|(count, _)| *count);
    worst.map(|(count, at_s)| {
        format!(
            "{count} stamp(s) do not come after the one before, the first {at_s:.3} s after the beginning: rows are put in order, and of a doubled stamp the last value counts"
        )
    })
}

/// Samples (time, signal, value) as rows.
fn rows(mut samples: Vec<(f64, usize, f64)>, width: usize) -> Vec<(f64, Vec<Option<f64>>)> {
    samples.sort_by(|a, b| a.0.total_cmp(&b.0));
    let mut rows: Vec<(f64, Vec<Option<f64>>)> = Vec::new();
    for (t, signal, value) in samples {
        match rows.last_mut() {
            Some(row) if t - row.0 < SAME_STAMP_S => row.1[signal] = Some(value),
            _ => {
                let mut row = vec![None; width];
                row[signal] = Some(value);
                rows.push((t, row));
            }
        }
    }
    rows
}
