//! CSV files of anybody. A recording is one file, or a folder of several that share a clock; rows with the same
//! stamp become one. A column may hold lists (`"[0.1, 0.2]"`), of which a signal is one item.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use super::run::{ImportError, bytes, file_stem, files_below};
use super::sheet::{Hint, Joint, Recording, Sheet};
use super::units::unit_word;
use super::words::{CLOCKS, Words};

/// The recording at `path`: a file, or of a folder the files that are `named`; all of them where none is.
///
/// # Errors
/// [`ImportError`] with file and reason.
pub fn open(path: &Path, named: &BTreeSet<&str>) -> Result<Recording, ImportError> {
    let files: Vec<PathBuf> = match (path.is_dir(), named.is_empty()) {
        (false, _) => vec![path.to_owned()],
        (true, false) => named.iter().map(|name| path.join(name)).collect(),
        (true, true) => files_below(path, "csv", 1)?,
    };
    if files.is_empty() {
        let message = "has no .csv file".to_owned();
        return Err(ImportError::Format { file: path.display().to_string(), message });
    }
    let sheets = files.iter().map(|file| {
        let text = bytes(file)?;
        let table = Table::parse(&file.display().to_string(), &decoded(&text))?;
        Ok::<Box<dyn Sheet>, ImportError>(Box::new(table))
    });
    Ok(Recording {
        file: path.display().to_string(),
        name: file_stem(path),
        sheets: sheets.collect::<Result<_, _>>()?,
        clock: None,
        unread: Vec::new(),
        notes: Vec::new(),
    })
}

/// Headers of a column that says which joint a row is of.
const JOINT_COLUMNS: [&str; 8] =
    ["joint", "joint_name", "joint_id", "name", "motor", "motor_id", "servo", "servo_id"];
/// Most joints that such a column names.
const MOST_JOINTS: usize = 64;

/// A CSV file as text.
struct Table {
    file: String,
    header: Vec<String>,
    /// Whether `0,5` is a half: where semicolons or tabs part the fields.
    decimal_comma: bool,
    /// Line number and fields.
    rows: Vec<(usize, Vec<String>)>,
    hints: BTreeMap<String, Hint>,
}

impl Table {
    fn parse(file: &str, text: &str) -> Result<Self, ImportError> {
        let mut lines = text.lines().enumerate().peekable();
        let mut header = lines.next().map_or("", |(_, l)| l);
        header = header.trim_start_matches('\u{feff}');
        // remarks stand in front; the last of them is the header where numbers follow it (NumPy writes it so)
        while let (true, Some((_, next))) = (header.starts_with('#'), lines.peek()) {
            let first = fields(next, separator(next)).swap_remove(0);
            if number(&first, true).is_some() {
                header = header.trim_start_matches(['#', ' ']);
            } else {
                header = next;
                lines.next();
            }
        }
        let separator = separator(header);
        let mut table = Self {
            file: file.to_owned(),
            decimal_comma: separator != ',',
            header: fields(header, separator),
            rows: (lines.filter(|(_, l)| !l.trim().is_empty()))
                .map(|(n, l)| (n + 1, fields(l, separator)))
                .collect(),
            hints: BTreeMap::new(),
        };
        let most = table.header.len();
        let longer =
            |(_, row): &&(usize, Vec<String>)| row.iter().skip(most).any(|f| !f.trim().is_empty());
        if let Some((line, row)) = table.rows.iter().find(longer) {
            return Err(table.wrong(format!(
                "line {line}: has {} fields, and the header has {most}: where commas part the fields decimals need points",
                row.len()
            )));
        }
        table.take_units();
        table.spread();
        table.hints = table.named();
        match table.rows.is_empty() {
            true => Err(table.wrong("has no row below its header".to_owned())),
            false => Ok(table),
        }
    }

    fn wrong(&self, message: String) -> ImportError {
        ImportError::Format { file: self.file.clone(), message }
    }

    /// A first row of units belongs to the header: no number is in it, and most of it is known.
    fn take_units(&mut self) {
        let Some((_, row)) = self.rows.first() else { return };
        let bare = |field: &str| field.trim().trim_matches(['[', ']', '(', ')']).to_lowercase();
        let units: Vec<String> = row.iter().map(|field| bare(field)).collect();
        let plain = |unit: &String| ["", "-", "1"].contains(&unit.as_str());
        let said = || units.iter().filter(|unit| !plain(unit));
        let known = said().filter(|unit| unit_word(unit).is_some()).count();
        if known == 0 || 2 * known < said().count() || said().any(|u| number(u, true).is_some()) {
            return;
        }
        for (header, unit) in self.header.iter_mut().zip(units).filter(|(_, unit)| !plain(unit)) {
            *header = format!("{} [{unit}]", header.trim());
        }
        self.rows.remove(0);
    }

    /// A row for each joint and moment: the other columns become one for each joint, named `elbow angle`.
    fn spread(&mut self) {
        let names = |at: usize| -> BTreeSet<String> {
            let fields = self.rows.iter().map(|(_, row)| row.get(at).map_or("", |f| f.trim()));
            fields.filter(|name| !name.is_empty()).map(str::to_owned).collect()
        };
        // a signal that is called `servo` keeps its value from row to row
        let changes = |at: usize| {
            let differs = |w: &&[(usize, Vec<String>)]| w[0].1.get(at) != w[1].1.get(at);
            2 * self.rows.windows(2).filter(differs).count() >= self.rows.len()
        };
        let names_one = |name: &String| name.parse::<f64>().is_err() || name.parse::<u8>().is_ok();
        let is_key = |(at, header): &(usize, &String)| {
            JOINT_COLUMNS.contains(&header.trim().to_lowercase().as_str()) && changes(*at) && {
                let names = names(*at);
                (2..=MOST_JOINTS).contains(&names.len()) && names.iter().all(names_one)
            }
        };
        let Some((key, _)) = self.header.iter().enumerate().find(is_key) else { return };
        if !self.header.iter().any(|header| Words::of(header).has(CLOCKS)) {
            return;
        }
        let names: Vec<String> = names(key).into_iter().collect();
        let columns = std::mem::take(&mut self.header);
        let (clocks, others): (Vec<usize>, Vec<usize>) = (0..columns.len())
            .filter(|at| *at != key)
            .partition(|at| Words::of(&columns[*at]).has(CLOCKS));
        self.header = clocks.iter().map(|at| columns[*at].clone()).collect();
        for name in &names {
            self.header.extend(others.iter().map(|at| format!("{name} {}", columns[*at].trim())));
        }
        let mut rows: Vec<(usize, Vec<String>)> = Vec::new();
        for (line, mut row) in std::mem::take(&mut self.rows) {
            row.resize(columns.len(), String::new());
            let Some(joint) = names.iter().position(|name| row[key].trim() == name) else {
                continue;
            };
            let stamps: Vec<String> = clocks.iter().map(|at| row[*at].clone()).collect();
            // a moment's joints follow each other and share its row
            if rows.last().is_none_or(|(_, last)| !last.starts_with(&stamps)) {
                let mut moment = stamps;
                moment.resize(self.header.len(), String::new());
                rows.push((line, moment));
            }
            if let Some((_, moment)) = rows.last_mut() {
                for (k, at) in others.iter().enumerate() {
                    moment[clocks.len() + joint * others.len() + k] = std::mem::take(&mut row[*at]);
                }
            }
        }
        self.rows = rows;
    }

    /// Joints of a joint state that was flattened: `name0` holds what `position0` is of, if that never changes.
    fn named(&self) -> BTreeMap<String, Hint> {
        let mut out = BTreeMap::new();
        for (at, header) in self.header.iter().enumerate() {
            let Some((before, k)) = header.trim().rsplit_once("name") else { continue };
            let plain = |c: char| c.is_ascii_digit() || "_[]".contains(c);
            let mut joints = self.rows.iter().map(|(_, row)| row.get(at).map(|f| f.trim()));
            let Some(Some(joint)) = joints.next() else { continue };
            if k.is_empty() || !k.chars().all(plain) || number(joint, true).is_some() {
                continue;
            }
            let same = joints.all(|other| other == Some(joint));
            for (word, kind, unit) in [
                ("position", "pos", None),
                ("velocity", "vel", None),
                ("effort", "tau", Some("Nm")),
            ] {
                let (kind, joint) = (if same { kind } else { "" }, Joint::Named(joint.to_owned()));
                out.insert(format!("{before}{word}{k}"), Hint { kind, joint: Some(joint), unit });
            }
        }
        out
    }
}

impl Sheet for Table {
    fn name(&self) -> &str {
        &self.file
    }

    fn header(&self) -> Vec<&str> {
        self.header.iter().map(String::as_str).collect()
    }

    fn hint(&self, column: &str) -> Option<&Hint> {
        self.hints.get(column.trim())
    }

    /// An empty field was not sampled.
    fn values(&self, column: &str, item: Option<usize>) -> Result<Vec<Option<f64>>, ImportError> {
        let at = self.header.iter().position(|h| h.trim() == column.trim());
        let at = at.ok_or_else(|| {
            self.wrong(format!("has no column `{column}`; it has {}", self.header.join(", ")))
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
            let x = number(text, self.decimal_comma).ok_or_else(|| {
                self.wrong(format!("line {line}: `{column}`: `{text}` is no number"))
            })?;
            Ok(x.is_finite().then_some(x))
        };
        self.rows.iter().map(value).collect()
    }
}

/// A number, or a date (`2026-03-04T09:15:00.123Z`, with a space, without a zone) as seconds since 1970.
fn number(text: &str, decimal_comma: bool) -> Option<f64> {
    let text = text.trim();
    let text = if decimal_comma { text.replace(',', ".") } else { text.to_owned() };
    text.parse().ok().or_else(|| date_s(&text))
}

/// Seconds since 1970 of a date of ISO 8601; one without a zone counts as of Greenwich.
fn date_s(text: &str) -> Option<f64> {
    let (date, clock) = text.split_once(['T', ' '])?;
    let mut date = date.splitn(3, '-').map(|n| n.parse::<i64>().ok());
    let (year, month, day) = (date.next()??, date.next()??, date.next()??);
    let clock = clock.trim_end_matches('Z');
    let zone_at = clock.rfind(['+', '-']).unwrap_or(clock.len());
    let (clock, zone) = clock.split_at(zone_at);
    let seconds = |text: &str| {
        let parts = text.split(':').zip([3600.0, 60.0, 1.0]);
        parts.map(|(n, unit)| Some(unit * n.parse::<f64>().ok()?)).sum::<Option<f64>>()
    };
    let zone_s = match zone.split_at_checked(1) {
        Some(("-", rest)) => -seconds(rest)?,
        Some((_, rest)) => seconds(rest)?,
        None => 0.0,
    };
    if !((1970..10_000).contains(&year) && (1..=12).contains(&month) && (1..=31).contains(&day)) {
        return None;
    }
    // days of the Gregorian calendar, with the year beginning in March
    let (y, m) = if month > 2 { (year, month - 3) } else { (year - 1, month + 9) };
    let days = 365 * y + y / 4 - y / 100 + y / 400 + (153 * m + 2) / 5 + day - 719_469;
    Some(86_400.0 * days as f64 + seconds(clock)? - zone_s)
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

/// A text in UTF-8, or, where nothing beyond ASCII is, in Latin-1, as spreadsheets of old write it: every byte is the
/// character of its number.
fn decoded(bytes: &[u8]) -> String {
    let lossy = String::from_utf8_lossy(bytes);
    let read = |c: char| !c.is_ascii() && c != char::REPLACEMENT_CHARACTER;
    match lossy.contains(char::REPLACEMENT_CHARACTER) && !lossy.contains(read) {
        true => bytes.iter().map(|&b| char::from(b)).collect(),
        false => lossy.into_owned(),
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use caudata_model::RobotModel;

    use super::super::map::{Map, apply};
    use super::super::{ImportError, Imported};
    use super::*;

    #[test]
    fn a_spreadsheet_of_old_is_latin_1() {
        assert_eq!(decoded(b"Sollwinkel [\xb0]"), "Sollwinkel [°]");
        assert_eq!(decoded("Sollwinkel [°]".as_bytes()), "Sollwinkel [°]");
        // one bad byte does not make °C two characters
        assert_eq!(decoded(b"t [\xc2\xb0C];x\xff"), "t [°C];x\u{fffd}");
    }

    fn read(path: &Path, map: &Map, robot: &RobotModel) -> Result<Imported, ImportError> {
        apply(&open(path, &map.files())?, map, robot)
    }

    const MAP: &str = "base = \"fixed\"\nkp = 2\n[time]\ncolumn = \"stamp\"\nunit = \"ms\"\n\
        [[signal]]\nsignal = \"cmd.swing\"\nfile = \"goal.csv\"\ncolumn = \"goals\"\nitem = 1\nunit = \"deg\"\n\
        [[signal]]\nsignal = \"pos.swing\"\nfile = \"state.csv\"\ncolumn = \"ticks\"\nunit = \"counts/4096\"\nscale = -1\noffset = 1\n";

    fn robot() -> RobotModel {
        let file = concat!(env!("CARGO_MANIFEST_DIR"), "/../robots/xl330_pendulum.robot.toml");
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
        let place = "[[outer_force]]\nlink = \"arm\"\nat_m = [0, 0, -0.1]\n";
        let map = Map::parse("map.toml", &format!("{MAP}{place}")).unwrap();
        let run = read(&folder, &map, &robot()).unwrap();
        assert_eq!((run.name.as_str(), run.meta.kp), ("run_1", Some(2.0)));
        assert_eq!(run.meta.outer_force[0].at_m, [0.0, 0.0, -0.1]);
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
    fn a_flattened_joint_state_says_which_joint_is_which() {
        let text = "ms,name_0,position_0,name_1,position_1\n0,tilt,1,pan,2\n1,tilt,1,tilt,2\n";
        let table = Table::parse("state.csv", text).unwrap();
        let tilt = Some(Joint::Named("tilt".to_owned()));
        let first = table.hint("position_0").unwrap();
        assert_eq!((first.kind, &first.joint), ("pos", &tilt));
        assert_eq!(table.hint("position_1").unwrap().kind, "", "its joint changes");
        assert_eq!(table.hint("ms"), None);
    }

    #[test]
    fn dates_are_seconds_and_remarks_are_passed_over() {
        for (text, want) in [
            ("1970-01-02T00:00:01.5Z", 86_401.5),
            ("2026-03-04 09:15:00.25", 1_772_615_700.25),
            ("2026-03-04T09:15:00+01:00", 1_772_612_100.0),
            ("2024-02-29T00:00:00", 1_709_164_800.0),
        ] {
            assert_eq!(number(text, false), Some(want), "{text}");
        }
        assert_eq!(number("2026-13-04T00:00:00", false), None);
        assert_eq!(number("2026-03-04Tnoon", false), None);
        for text in ["# bench 3\n#\nt,q\n0,1\n", "# bench 3\n# t,q\n0,1\n", "\u{feff}#t,q\n0,1\n"] {
            let table = Table::parse("remarks.csv", text).unwrap();
            assert_eq!((table.header.join(","), table.rows.len()), ("t,q".to_owned(), 1), "{text}");
        }
        assert!(Table::parse("empty.csv", "# nothing\n").is_err());
        let longer = Table::parse("half.csv", "t,q\n0,1,\n1,0,5\n").err().unwrap().to_string();
        assert!(longer.contains("line 3: has 3 fields, and the header has 2"), "{longer}");
    }

    #[test]
    fn what_is_wrong_is_said_in_one_line() {
        let says = |from: &str, to: &str, want: &str| {
            let error = Map::parse("map.toml", &MAP.replace(from, to)).unwrap_err().to_string();
            assert!(error.contains(want) && !error.contains('\n'), "{error}");
        };
        says("unit = \"deg\"", "unit = \"grad\"", "cmd.swing: unknown unit `grad`");
        says(
            "unit = \"deg\"",
            "unit = \"s\"",
            "cmd.swing: unit `s` is one of time, and not of angle",
        );
        says(
            "\"pos.swing\"",
            "\"vel.swing\"",
            "vel.swing: unit `counts/4096` is one of angle, and not of speed",
        );
        says("kp = 2", "Kp = 2", "line 2: unknown field `Kp`");
        says("pos.swing", "place.swing", "place.swing");
        let dir = tempfile::tempdir().unwrap();
        std::fs::write(dir.path().join("goal.csv"), "stamp,goal\n0,1\n").unwrap();
        std::fs::write(dir.path().join("state.csv"), "stamp,ticks\n0,1\n").unwrap();
        let map = Map::parse("map.toml", MAP).unwrap();
        let error = read(dir.path(), &map, &robot()).unwrap_err().to_string();
        assert!(error.contains("has no column `goals`; it has stamp, goal"), "{error}");
        // a slide has metres, and a hinge has not
        std::fs::write(dir.path().join("goal.csv"), "stamp,goals\n0,\"[1, 90]\"\n").unwrap();
        let metres = MAP.replace("unit = \"deg\"", "unit = \"mm\"");
        let map = Map::parse("map.toml", &metres).unwrap();
        let error = read(dir.path(), &map, &robot()).unwrap_err().to_string();
        assert!(
            error.contains("cmd.swing: unit `mm` is one of length, and not of angle"),
            "{error}"
        );
    }

    #[test]
    fn a_map_finds_a_column_without_the_unit_that_a_row_of_units_says() {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("units.csv");
        std::fs::write(&file, "time,goal,angle,angle 2\ns,deg,deg,deg\n0,1,180,5\n1,1,90,5\n")
            .unwrap();
        let map = "base = \"fixed\"\n[time]\ncolumn = \"time\"\nunit = \"s\"\n\
            [[signal]]\nsignal = \"pos.swing\"\ncolumn = \"angle\"\nunit = \"deg\"\n";
        let run = read(&file, &Map::parse("map.toml", map).unwrap(), &robot()).unwrap();
        let pi = std::f64::consts::PI;
        let want = [(0.0, vec![Some(pi)]), (1.0, vec![Some(0.5 * pi)])];
        assert_eq!(
            (run.rows.as_slice(), run.unused),
            (&want[..], vec!["angle 2 [deg]".to_owned(), "goal [deg]".to_owned()])
        );
    }

    #[test]
    fn rows_of_one_joint_each_become_columns() {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("long.csv");
        let text = "time,joint,actual,volts,load\ns,,deg,V,bits\n0,hip,1,12,5\n0,knee,2,12,5\n0.1,hip,3,12,5\n0.1,knee,4,11,5\n";
        std::fs::write(&file, text).unwrap();
        let recording = open(&file, &BTreeSet::new()).unwrap();
        let sheet = &recording.sheets[0];
        let of =
            |joint| ["actual [deg]", "volts [v]", "load [bits]"].map(|c| format!("{joint} {c}"));
        assert_eq!(sheet.header()[1..], [of("hip"), of("knee")].concat());
        assert_eq!(sheet.values("time [s]", None).unwrap(), [0.0, 0.1].map(Some));
        let knee = sheet.values("knee actual [deg]", None).unwrap();
        assert_eq!(knee, [2.0, 4.0].map(Some));
        // a signal that is called so is none of a joint
        std::fs::write(&file, "time,servo,angle\n0,0,1\n1,0,2\n2,30,3\n3,30,4\n").unwrap();
        let recording = open(&file, &BTreeSet::new()).unwrap();
        assert_eq!(recording.sheets[0].header(), ["time", "servo", "angle"]);
        // one joint throughout: nothing to be told apart
        std::fs::write(&file, "time,joint,actual\n0,hip,1\n1,hip,2\n").unwrap();
        let recording = open(&file, &BTreeSet::new()).unwrap();
        assert_eq!(recording.sheets[0].header(), ["time", "joint", "actual"]);
    }
}
