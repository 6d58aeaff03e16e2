//! A recording of any form, by its name.

use std::collections::BTreeSet;
use std::path::Path;

use caudata_model::RobotModel;
use caudata_runlog::META_NAME;
use caudata_runlog::ros::bag::{files, is_recording};

use super::map::{Map, apply};
use super::run::{ImportError, Imported, files_below};
use super::sheet::Recording;
use super::{bag, bam, csv, lerobot, npz};

/// Form of a recording.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum Format {
    /// A servo that swings a weight: JSON of the BAM project
    Bam,
    /// CSV files of any kind
    Csv,
    /// ROS 2: .mcap or .db3, alone or in the folder of a bag
    Rosbag,
    /// The folder of a LeRobot dataset (v2, v3); each episode is a run
    Lerobot,
    /// Arrays of NumPy, as numpy.savez writes them
    Npz,
}

impl Format {
    /// By what the file or folder at `path` is called, and what is in it.
    ///
    /// # Errors
    /// [`ImportError::Format`] where it is none of them.
    pub fn guess(path: &Path) -> Result<Self, ImportError> {
        let wrong = |message: &str| ImportError::Format {
            file: path.display().to_string(),
            message: message.to_owned(),
        };
        let about = std::fs::metadata(path);
        let about = about.map_err(|source| ImportError::Io { path: path.to_owned(), source })?;
        if !about.is_dir() {
            let extension = path.extension().map(|x| x.to_ascii_lowercase());
            return match extension.as_ref().and_then(|x| x.to_str()) {
                _ if is_recording(path) => Ok(Self::Rosbag),
                Some("json") => Ok(Self::Bam),
                Some("csv" | "tsv" | "txt") => Ok(Self::Csv),
                Some("npz") => Ok(Self::Npz),
                Some("npy") => Err(wrong(
                    "is one array without names: write time, commands and angles into one file with numpy.savez",
                )),
                Some("parquet") => {
                    Err(wrong("give the folder of the dataset, which has meta/info.json"))
                }
                Some("jsonl" | "ndjson") => {
                    Err(wrong("JSON lines are not read; write the same as .csv or .npz"))
                }
                _ => Err(wrong(
                    "its form is not known: .mcap, .db3, .csv, .npz, a .json of BAM's, or say --format",
                )),
            };
        }
        let bag = path.join("metadata.yaml").is_file();
        if path.join(lerobot::INFO).is_file() {
            return Ok(Self::Lerobot);
        }
        if path.join(META_NAME).is_file() {
            return Err(wrong("is a log folder already"));
        }
        let files = files(path)?;
        if bag || !files.is_empty() {
            return Ok(Self::Rosbag);
        }
        match files_below(path, "csv", 1)?.is_empty() {
            false => Ok(Self::Csv),
            true => Err(wrong(
                "is no recording: a bag has .mcap or .db3 files, a LeRobot dataset meta/info.json, a CSV recording .csv files",
            )),
        }
    }
}

/// The runs at `path`, as sheets. Of a folder of CSV files only those are read that `map` names.
///
/// # Errors
/// [`ImportError`] with file and reason.
pub fn open(path: &Path, format: Format, map: Option<&Map>) -> Result<Vec<Recording>, ImportError> {
    match format {
        Format::Lerobot => lerobot::open(path),
        Format::Rosbag => Ok(vec![bag::open(path)?]),
        Format::Npz => Ok(vec![npz::open(path)?]),
        _ => {
            let named = map.map_or_else(BTreeSet::new, Map::files);
            Ok(vec![csv::open(path, &named)?])
        }
    }
}

/// The logs of `robot` that the recordings at `path` are by `map`; BAM's need none.
///
/// # Errors
/// [`ImportError`] with file, column and reason.
pub fn read(
    path: &Path,
    format: Format,
    map: Option<&Map>,
    robot: &RobotModel,
) -> Result<Vec<Imported>, ImportError> {
    match (format, map) {
        (Format::Bam, _) | (_, None) => Ok(vec![bam::read(path, robot)?]),
        (_, Some(map)) => {
            let recordings = open(path, format, Some(map))?;
            recordings.iter().map(|r| apply(r, map, robot)).collect()
        }
    }
}
