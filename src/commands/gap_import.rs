//! `caudata gap import`: recordings of other projects to log folders.

use std::path::PathBuf;

use caudata_gap::import::{ImportError, bam};
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
    /// Robot file of what was recorded
    #[arg(long, value_name = "R.robot.toml")]
    robot: PathBuf,
    /// Folder in which a log folder is made for each recording
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// The recordings
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
}

pub fn run(args: &ImportArgs) -> Result<(), Failure> {
    let robot = files::robot(&args.robot)?;
    let mut folders = Vec::new();
    let mut notes = Vec::new();
    for file in &args.files {
        let Format::Bam = args.format;
        let run = bam::read(file, &robot).map_err(failure)?;
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
