//! Datasets of LeRobot (versions 2 and 3): `meta/info.json` says what there is, `data/**/*.parquet` holds it. Each
//! episode is a run.
//!
//! Columns are called as the dataset calls them, `observation.state/shoulder_pan.pos`; where it gives no names,
//! `action[0]`. Its units stand nowhere: degrees, radians, or shares of a joint's calibrated range (−100 to 100,
//! grippers 0 to 100).

use std::collections::BTreeMap;
use std::path::Path;

use caudata_runlog::parquet::{self, Column};
use serde_json::Value;

use super::map::UNKNOWN;
use super::run::{ImportError, bytes, file_stem, files_below};
use super::sheet::{Clock, Hint, Joint, MAX_COLUMNS, MAX_VALUES, Numbers, Recording};

/// What says that a folder is such a dataset.
pub(super) const INFO: &str = "meta/info.json";
/// Columns that number the rows.
const NUMBERS: [&str; 4] = ["index", "frame_index", "episode_index", "task_index"];
const EPISODE: &str = "episode_index";
const FRAME: &str = "frame_index";
const TIME: &str = "timestamp";
/// Times nearer than this to frame number over rate were not measured, s.
const NOMINAL_S: f64 = 1e-4;
/// Endings of names, and the kind that they tell.
const ENDINGS: [(&str, &str); 8] = [
    (".pos", "pos"),
    (".vel", "vel"),
    (".position", "pos"),
    (".velocity", "vel"),
    (".torque", "tau"),
    (".effort", "tau"),
    (".current", "cur"),
    (".temperature", "temp"),
];

/// A feature that is read.
struct Feature {
    name: String,
    /// Column of each of its values.
    columns: Vec<String>,
    hints: Vec<Hint>,
}

/// The episodes of the dataset in the folder `path`.
///
/// # Errors
/// [`ImportError`] with file and reason.
pub fn open(path: &Path) -> Result<Vec<Recording>, ImportError> {
    let info_file = path.join(INFO);
    let info = info_file.display().to_string();
    let wrong = |message: String| ImportError::Format { file: info.clone(), message };
    let json: Value = serde_json::from_slice(&bytes(&info_file)?)
        .map_err(|e| wrong(e.to_string().replace('\n', " ")))?;
    let version = json["codebase_version"].as_str().unwrap_or("?");
    if !version.starts_with("v2") && !version.starts_with("v3") {
        return Err(wrong(format!("has codebase_version `{version}`; v2.x and v3.x are read")));
    }
    let rate_hz = json["fps"].as_f64().filter(|f| *f > 0.0);
    let rate_hz = rate_hz.ok_or_else(|| wrong("has no `fps` above 0".to_owned()))?;
    let (features, unread) = features(&json).map_err(wrong)?;
    let mut episodes: BTreeMap<i64, Episode> = BTreeMap::new();
    let mut values = 0;
    for file in files_below(&path.join("data"), "parquet", 4)? {
        let wrong =
            |message: String| ImportError::Format { file: file.display().to_string(), message };
        let mut wanted = vec![EPISODE, FRAME, TIME];
        wanted.extend(features.iter().map(|f| f.name.as_str()));
        let left = MAX_VALUES.saturating_sub(values);
        let columns = parquet::read(&file, &wanted, left)?;
        values += take(&columns, &features, rate_hz, &mut episodes).map_err(wrong)?;
    }
    if episodes.is_empty() {
        return Err(wrong("its folder has no data/**/*.parquet with a row".to_owned()));
    }
    let stem = file_stem(path);
    let recordings = episodes.into_iter().map(|(number, episode)| {
        let mut sheet = episode.sheet;
        sheet.put_first(TIME, episode.time_s);
        let mut notes = Vec::new();
        if episode.nominal {
            notes.push(format!(
                "{}: `{TIME}` is the frame's number over {rate_hz} Hz: when a frame was really taken is not in the data",
                path.display()
            ));
        }
        Recording {
            file: format!("{}, episode {number}", path.display()),
            name: format!("{stem}_episode_{number:06}"),
            sheets: vec![Box::new(sheet)],
            clock: Some(Clock {
                column: TIME.to_owned(),
                unit: "s",
                remark: String::new(),
            }),
            unread: unread.clone(),
            notes,
        }
    });
    Ok(recordings.collect())
}

/// An episode so far.
struct Episode {
    sheet: Numbers,
    time_s: Vec<f64>,
    /// Whether every time so far is the frame's number over the rate.
    nominal: bool,
}

/// The features that are read; the names of the others.
fn features(info: &Value) -> Result<(Vec<Feature>, Vec<String>), String> {
    let all = info["features"].as_object().ok_or("has no `features`")?;
    let (mut features, mut unread) = (Vec::new(), Vec::new());
    for (name, feature) in all {
        if NUMBERS.contains(&name.as_str()) || name == TIME {
            continue;
        }
        let kind = feature["dtype"].as_str().unwrap_or("?");
        if !["float", "int", "uint", "bool"].iter().any(|k| kind.starts_with(k)) {
            unread.push(format!("{name} ({kind})"));
            continue;
        }
        let shape = feature["shape"].as_array().map_or(&[][..], Vec::as_slice);
        let mut sizes = shape.iter().map(|n| n.as_u64().and_then(|n| usize::try_from(n).ok()));
        let size = sizes.try_fold(1usize, |all, n| all.checked_mul(n?));
        let size = size.filter(|n| (1..=MAX_COLUMNS).contains(n)).ok_or_else(|| {
            format!("`{name}` has a shape of none or of more than {MAX_COLUMNS} values")
        })?;
        let mut names = Vec::new();
        flattened(&feature["names"], &mut names);
        let named = names.len() == size && size > 1 || name.contains('.') && names.len() == size;
        let columns = (0..size).map(|k| match (named, size) {
            (true, _) => format!("{name}/{}", names[k]),
            (false, 1) => name.clone(),
            (false, _) => format!("{name}[{k}]"),
        });
        let hints = (0..size).map(|k| {
            let joint = match named {
                true => Joint::Named(names[k].clone()),
                false => Joint::Numbered(k, size),
            };
            hint(name, joint)
        });
        features.push(Feature {
            columns: columns.collect(),
            hints: hints.collect(),
            name: name.clone(),
        });
    }
    Ok((features, unread))
}

/// The names in a list, a list of lists, or a list below any key (`{"motors": […]}`).
fn flattened(names: &Value, out: &mut Vec<String>) {
    match names {
        Value::String(name) => out.push(name.clone()),
        Value::Array(all) => all.iter().for_each(|names| flattened(names, out)),
        Value::Object(all) => all.values().for_each(|names| flattened(names, out)),
        _ => {}
    }
}

/// What is known of a value of the feature `name`.
fn hint(name: &str, joint: Joint) -> Hint {
    let (of, ending) = match &joint {
        Joint::Named(of) => {
            let ending = ENDINGS.iter().find(|(ending, _)| of.ends_with(ending));
            (of.trim_end_matches(ending.map_or("", |e| e.0)), ending.map(|e| e.1))
        }
        Joint::Numbered(..) => ("", None),
    };
    let kind = match (name, ending) {
        ("action", None | Some("pos")) => "cmd",
        ("observation.state", ending) => ending.unwrap_or("pos"),
        ("observation.velocity", None) => "vel",
        ("observation.effort", None) => "tau",
        _ => "",
    };
    let joint = match joint {
        Joint::Named(_) => Joint::Named(of.to_owned()),
        numbered => numbered,
    };
    Hint { kind, joint: Some(joint), unit: Some(UNKNOWN) }
}

/// Adds the rows of a file to their episodes; how many values they take.
fn take(
    columns: &[Column],
    features: &[Feature],
    rate_hz: f64,
    episodes: &mut BTreeMap<i64, Episode>,
) -> Result<usize, String> {
    let column = |name: &str| columns.iter().find(|c| c.name == name);
    let number = column(EPISODE).ok_or_else(|| format!("has no column `{EPISODE}`"))?;
    let (time, frame) = (column(TIME), column(FRAME));
    let mut values = 0;
    for row in 0..number.rows() {
        let one = |c: &Column| c.row(row).first().copied();
        let number = one(number).ok_or_else(|| format!("row {row} has no `{EPISODE}`"))?;
        let episode = episodes.entry(number as i64).or_insert_with(|| Episode {
            sheet: Numbers::new(EPISODE),
            time_s: Vec::new(),
            nominal: true,
        });
        let frame = frame.and_then(one).unwrap_or(episode.time_s.len() as f64);
        let time_s = time.and_then(one).unwrap_or(frame / rate_hz);
        episode.nominal &= (time_s - frame / rate_hz).abs() < NOMINAL_S;
        episode.time_s.push(time_s);
        let mut found: Vec<(String, f64)> = Vec::new();
        for feature in features {
            let Some(column) = column(&feature.name) else { continue };
            let said = column.row(row);
            if !said.is_empty() && said.len() != feature.columns.len() {
                return Err(format!(
                    "row {row} has {} values of `{}`, {INFO} says {}",
                    said.len(),
                    feature.name,
                    feature.columns.len()
                ));
            }
            found.extend(feature.columns.iter().cloned().zip(said.iter().copied()));
        }
        let hint = |column: &str| {
            let of = features.iter().find_map(|f| {
                let place = f.columns.iter().position(|c| c == column)?;
                Some(f.hints[place].clone())
            });
            of.unwrap_or(Hint { kind: "", joint: None, unit: None })
        };
        values += episode.sheet.push(found.into_iter(), &hint)? + 1;
    }
    Ok(values)
}
