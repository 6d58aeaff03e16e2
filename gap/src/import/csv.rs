//! CSV files of anybody, by a map that says which column is which signal and in which unit.
//!
//! The map is a TOML file. A recording is one CSV file, or a folder of several that share a clock; rows with
//! the same stamp become one. A column may hold lists (`"[0.1, 0.2]"`), of which a signal is one item.
//!
//! ```toml
//! base = "fixed"
//! kp = 16.4                      # everything that log.toml may say
//! [time]
//! column = "timestamp"
//! unit = "us"
//! [[signal]]
//! signal = "cmd.elbow"           # name of the log's column
//! file = "control.csv"           # of a folder; without it the only file
//! column = "positions"
//! item = 2                       # of a list; the first is 0
//! unit = "deg"
//! scale = -1.0                   # after the unit: scale · x + offset
//! offset = 0.1                   # SI
//! ```

use std::collections::BTreeMap;
use std::path::Path;

use caudata_model::RobotModel;
use caudata_runlog::{BaseHold, JointConditions, LogMeta, Payload, Setting, Signal};
use serde::Deserialize;

use super::{ImportError, Imported};

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
    time: Column,
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
}

fn one() -> f64 {
    1.0
}

/// Units of columns, in SI.
const UNITS: &[(&str, f64)] = &[
    ("1", 1.0),
    ("rad", 1.0),
    ("deg", std::f64::consts::PI / 180.0),
    ("turn", std::f64::consts::TAU),
    ("rad/s", 1.0),
    ("deg/s", std::f64::consts::PI / 180.0),
    ("rev/min", std::f64::consts::TAU / 60.0),
    ("A", 1.0),
    ("mA", 1e-3),
    ("N·m", 1.0),
    ("Nm", 1.0),
    ("V", 1.0),
    ("mV", 1e-3),
    ("m", 1.0),
    ("mm", 1e-3),
    ("m/s", 1.0),
    ("m/s²", 1.0),
    ("m/s2", 1.0),
    ("g", 9.80665),
    ("°C", 1.0),
    ("degC", 1.0),
    ("%", 1e-2),
    ("s", 1.0),
    ("ms", 1e-3),
    ("us", 1e-6),
    ("ns", 1e-9),
];

/// Size of a unit; `counts/4096` is a turn of 4096 counts.
pub(super) fn unit(text: &str) -> Result<f64, String> {
    if let Some(n) = text.strip_prefix("counts/") {
        let n: f64 = n
            .parse()
            .map_err(|_| format!("unit `{text}`: `{n}` is no number"))?;
        return match n > 0.0 {
            true => Ok(std::f64::consts::TAU / n),
            false => Err(format!("unit `{text}`: a turn has more than no counts")),
        };
    }
    let known = UNITS.iter().find(|u| u.0 == text);
    known.map(|u| u.1).ok_or_else(|| {
        let all: Vec<&str> = UNITS.iter().map(|u| u.0).collect();
        format!("unknown unit `{text}`; known: {}, counts/N", all.join(", "))
    })
}

impl Map {
    /// Reads a map; `file` names it in errors.
    ///
    /// # Errors
    /// [`ImportError::Format`] with line and reason.
    pub fn parse(file: &str, text: &str) -> Result<Self, ImportError> {
        let wrong = |message: String| ImportError::Format {
            file: file.to_owned(),
            message,
        };
        let map: Self = toml::from_str(text).map_err(|e| {
            let line = e.span().map_or(1, |s| {
                1 + text[..s.start.min(text.len())].matches('\n').count()
            });
            wrong(format!("line {line}: {}", e.message().replace('\n', " ")))
        })?;
        if map.signal.is_empty() {
            return Err(wrong("has no [[signal]]".to_owned()));
        }
        unit(&map.time.unit).map_err(wrong)?;
        for s in &map.signal {
            unit(&s.unit).map_err(|e| wrong(format!("{}: {e}", s.signal)))?;
            s.signal
                .parse::<Signal>()
                .map_err(|e| wrong(format!("{}: {e}", s.signal)))?;
        }
        Ok(map)
    }
}

/// Reads the recording at `path` (a file, or a folder) of `robot` by `map`.
///
/// # Errors
/// [`ImportError`] with file, column and reason.
pub fn read(path: &Path, map: &Map, robot: &RobotModel) -> Result<Imported, ImportError> {
    let stem = path.file_stem().unwrap_or_default().to_string_lossy();
    let mut files: BTreeMap<Option<&str>, Vec<&SignalColumn>> = BTreeMap::new();
    for s in &map.signal {
        files.entry(s.file.as_deref()).or_default().push(s);
    }
    let mut signals: Vec<Signal> = Vec::new();
    let mut samples: Vec<(f64, usize, f64)> = Vec::new();
    for (name, columns) in files {
        let file = name.map_or_else(|| path.to_owned(), |name| path.join(name));
        let bytes = super::read(&file)?;
        let file = file.display().to_string();
        let table = Table::parse(&file, &String::from_utf8_lossy(&bytes))?;
        let time_s = table.values(&map.time.column, None, unit(&map.time.unit).unwrap_or(1.0))?;
        for column in columns {
            let values = table.values(
                &column.column,
                column.item,
                unit(&column.unit).unwrap_or(1.0),
            )?;
            let number = signals.len();
            signals.push(
                column
                    .signal
                    .parse()
                    .map_err(|e| table.wrong(format!("{}: {e}", column.signal)))?,
            );
            for (t, v) in time_s.iter().zip(values) {
                if let (Some(t), Some(v)) = (t, v) {
                    samples.push((*t, number, column.scale * v + column.offset));
                }
            }
        }
    }
    let rows = rows(samples, signals.len());
    let (Some(first), Some(last)) = (rows.first(), rows.last()) else {
        return Err(ImportError::Format {
            file: path.display().to_string(),
            message: "has no row with a stamp and a value".to_owned(),
        });
    };
    let span_s = (last.0 - first.0).max(1e-6);
    let mut meta = LogMeta::new(
        robot.name(),
        map.base,
        (rows.len() as f64 / span_s).clamp(1e-3, 1e5),
    );
    meta.terrain.clone_from(&map.terrain);
    meta.notes = match map.notes.as_str() {
        "" => format!("imported from {stem}"),
        notes => notes.to_owned(),
    };
    (meta.kp, meta.kd, meta.supply_v) = (map.kp, map.kd, map.supply_v);
    meta.joint.clone_from(&map.joint);
    meta.payload.clone_from(&map.payload);
    if let Some(level_m) = map.water_level_m {
        let key = "water_level_m".to_owned();
        meta.settings.insert(key, Setting::Number(level_m));
    }
    let letters = |c: char| match c.is_ascii_alphanumeric() || c == '-' {
        true => c,
        false => '_',
    };
    Ok(Imported {
        name: stem.chars().map(letters).collect(),
        meta,
        signals,
        rows,
        notes: Vec::new(),
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

/// A CSV file as text.
pub(super) struct Table<'a> {
    pub(super) file: &'a str,
    pub(super) header: Vec<String>,
    /// Whether `0,5` is a half: where semicolons or tabs part the fields.
    decimal_comma: bool,
    /// Line number and fields.
    rows: Vec<(usize, Vec<String>)>,
}

impl<'a> Table<'a> {
    pub(super) fn parse(file: &'a str, text: &str) -> Result<Self, ImportError> {
        let mut lines = text.lines().enumerate();
        let header = lines.next().map_or("", |(_, l)| l);
        let header = header.trim_start_matches('\u{feff}');
        let separator = separator(header);
        let table = Self {
            file,
            decimal_comma: separator != ',',
            header: fields(header, separator),
            rows: (lines.filter(|(_, l)| !l.trim().is_empty()))
                .map(|(n, l)| (n + 1, fields(l, separator)))
                .collect(),
        };
        match table.rows.is_empty() {
            true => Err(table.wrong("has no row below its header".to_owned())),
            false => Ok(table),
        }
    }

    pub(super) fn wrong(&self, message: String) -> ImportError {
        ImportError::Format {
            file: self.file.to_owned(),
            message,
        }
    }

    /// A column in SI; an empty field was not sampled.
    pub(super) fn values(
        &self,
        column: &str,
        item: Option<usize>,
        unit: f64,
    ) -> Result<Vec<Option<f64>>, ImportError> {
        let at = self.header.iter().position(|h| h.trim() == column.trim());
        let at = at.ok_or_else(|| {
            self.wrong(format!(
                "has no column `{column}`; it has {}",
                self.header.join(", ")
            ))
        })?;
        let value = |(line, row): &(usize, Vec<String>)| {
            let text = row.get(at).map_or("", |f| f.trim());
            let text = match item {
                Some(k) => {
                    let list = text.trim_matches(['[', ']', '(', ')']);
                    let mut items = list.split([',', ';']);
                    items.nth(k).map(str::trim).ok_or_else(|| {
                        self.wrong(format!("line {line}: `{column}` has no item {k}"))
                    })?
                }
                None => text,
            };
            if text.is_empty() {
                return Ok(None);
            }
            let x = match self.decimal_comma {
                true => text.replace(',', ".").parse(),
                false => text.parse::<f64>(),
            };
            let x = x.map_err(|_| {
                self.wrong(format!("line {line}: `{column}`: `{text}` is no number"))
            })?;
            Ok(x.is_finite().then_some(x * unit))
        };
        self.rows.iter().map(value).collect()
    }
}

/// What parts the fields of a file with this header: comma, semicolon or tab, whichever is there most.
fn separator(header: &str) -> char {
    let count = |c: &char| header.matches(*c).count();
    let all = ['\t', ';', ','];
    all.into_iter().max_by_key(count).unwrap_or(',')
}

/// Fields of a line; a field in quotes may hold separators, and a doubled quote is one.
fn fields(line: &str, separator: char) -> Vec<String> {
    let (mut out, mut field, mut quoted) = (Vec::new(), String::new(), false);
    let mut letters = line.chars().peekable();
    while let Some(c) = letters.next() {
        match c {
            '"' if quoted && letters.peek() == Some(&'"') => {
                letters.next();
                field.push('"');
            }
            '"' => quoted = !quoted,
            c if c == separator && !quoted => out.push(std::mem::take(&mut field)),
            _ => field.push(c),
        }
    }
    out.push(field);
    out
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use super::*;

    const MAP: &str = "base = \"fixed\"\nkp = 2\n[time]\ncolumn = \"stamp\"\nunit = \"ms\"\n\
        [[signal]]\nsignal = \"cmd.swing\"\nfile = \"goal.csv\"\ncolumn = \"goals\"\nitem = 1\nunit = \"deg\"\n\
        [[signal]]\nsignal = \"pos.swing\"\nfile = \"state.csv\"\ncolumn = \"ticks\"\nunit = \"counts/4096\"\nscale = -1\noffset = 1\n";

    fn robot() -> RobotModel {
        let file = concat!(
            env!("CARGO_MANIFEST_DIR"),
            "/../robots/xl330_pendulum.robot.toml"
        );
        RobotModel::load(file.as_ref()).unwrap()
    }

    #[test]
    fn two_files_of_one_clock_become_one_log() {
        let dir = tempfile::tempdir().unwrap();
        let folder = dir.path().join("run 1");
        std::fs::create_dir(&folder).unwrap();
        let goal = "stamp,goals\n0,\"[1, 90]\"\n20,\"[1, 180]\"\n";
        let state = "stamp,ticks\n0,0\n10,1024\n20,\n";
        std::fs::write(folder.join("goal.csv"), goal).unwrap();
        std::fs::write(folder.join("state.csv"), state).unwrap();
        let map = Map::parse("map.toml", MAP).unwrap();
        let run = read(&folder, &map, &robot()).unwrap();
        assert_eq!((run.name.as_str(), run.meta.kp), ("run_1", Some(2.0)));
        let pi = std::f64::consts::PI;
        let want = [
            (0.0, [Some(0.5 * pi), Some(1.0)]),
            // a quarter of a turn, the other way round and shifted
            (0.01, [None, Some(1.0 - 0.5 * pi)]),
            (0.02, [Some(pi), None]),
        ];
        assert_eq!(run.rows.len(), want.len());
        for ((t, row), (want_t, want)) in run.rows.iter().zip(want) {
            assert!((t - want_t).abs() < 1e-12);
            for (x, want) in row.iter().zip(want) {
                assert_eq!(x.is_some(), want.is_some());
                assert!((x.unwrap_or(0.0) - want.unwrap_or(0.0)).abs() < 1e-12);
            }
        }
    }

    #[test]
    fn what_is_wrong_is_said_in_one_line() {
        let says = |from: &str, to: &str, want: &str| {
            let error = Map::parse("map.toml", &MAP.replace(from, to))
                .unwrap_err()
                .to_string();
            assert!(error.contains(want) && !error.contains('\n'), "{error}");
        };
        says(
            "unit = \"deg\"",
            "unit = \"grad\"",
            "cmd.swing: unknown unit `grad`",
        );
        says("kp = 2", "Kp = 2", "line 2: unknown field `Kp`");
        says("pos.swing", "place.swing", "place.swing");
        let dir = tempfile::tempdir().unwrap();
        std::fs::write(dir.path().join("goal.csv"), "stamp,goal\n0,1\n").unwrap();
        let map = Map::parse("map.toml", MAP).unwrap();
        let error = read(dir.path(), &map, &robot()).unwrap_err().to_string();
        assert!(
            error.contains("has no column `goals`; it has stamp, goal"),
            "{error}"
        );
    }
}
