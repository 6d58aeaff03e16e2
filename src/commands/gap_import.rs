//! `caudata gap import`: recordings of other projects to log folders.

use std::path::PathBuf;

use caudata_gap::import::{ImportError, bam, csv, draft};
use caudata_runlog::LogError;
use caudata_studies::files;
use caudata_telemetry::{ExitCode, Failure};
use clap::{Args, ValueEnum};
use serde_json::json;

use crate::say;

#[derive(Debug, Args)]
pub struct ImportArgs {
    /// Form of the recordings
    #[arg(long, value_enum)]
    format: Format,
    /// For CSV: which column is which signal, in which unit (TOML)
    #[arg(long, value_name = "MAP.toml")]
    map: Option<PathBuf>,
    /// For CSV: guess a map from the first file, write it here, and stop; to be checked, then given as --map
    #[arg(long, value_name = "MAP.toml", conflicts_with = "map")]
    draft_map: Option<PathBuf>,
    /// Robot file of what was recorded
    #[arg(long, value_name = "R.robot.toml")]
    robot: PathBuf,
    /// Folder in which a log folder is made for each recording
    #[arg(long, value_name = "DIR", default_value = "logs")]
    out: PathBuf,
    /// The recordings; of CSV also folders of several files that share a clock
    #[arg(value_name = "FILE", required = true)]
    files: Vec<PathBuf>,
    /// One JSON object on the last line
    #[arg(long)]
    json: bool,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Format {
    /// A servo that swings a weight: JSON of the BAM project
    Bam,
    /// CSV files of any kind, by a map of columns and units
    Csv,
}

pub fn run(args: &ImportArgs) -> Result<(), Failure> {
    let robot = files::robot(&args.robot)?;
    if let (Some(path), Some(file)) = (&args.draft_map, args.files.first()) {
        files::write(path, draft::map(file, &robot).map_err(failure)?)?;
        let path = path.display();
        say::line(format!(
            "{path} is a guess: check it, then give it as --map {path}"
        ));
        return Ok(());
    }
    if args.format == Format::Csv && args.map.is_none() {
        return Err(Failure::message(
            ExitCode::BadConfig,
            "--format csv needs a map of columns and units: --map MAP.toml",
        )
        .hint("--draft-map MAP.toml instead guesses one"));
    }
    let mut folders = Vec::new();
    let mut notes = Vec::new();
    let map = match &args.map {
        Some(path) => {
            let text = String::from_utf8_lossy(&files::read(path)?).into_owned();
            Some(csv::Map::parse(&path.display().to_string(), &text).map_err(failure)?)
        }
        None => None,
    };
    for file in &args.files {
        let run = match (args.format, &map) {
            (Format::Csv, Some(map)) => csv::read(file, map, &robot),
            _ => bam::read(file, &robot),
        };
        let run = run.map_err(failure)?;
        folders.push(run.write(&args.out).map_err(|e| failure(e.into()))?);
        notes.extend(run.notes);
    }
    if args.json {
        return say::json(&json!({ "logs": folders, "notes": notes }));
    }
    for note in &notes {
        say::line(format!("note: {note}"));
    }
    say::line(format!(
        "{} log(s) are in {}",
        folders.len(),
        args.out.display()
    ));
    Ok(())
}

fn failure(error: ImportError) -> Failure {
    let code = match &error {
        ImportError::Io { source, .. } => ExitCode::of_io(source, false),
        ImportError::Log(LogError::Io { source, .. }) => ExitCode::of_io(source, true),
        ImportError::Log(LogError::Exists { .. }) => ExitCode::CannotCreate,
        _ => ExitCode::BadInput,
    };
    Failure::new(code, error)
}
