//! `caudata gap import`: recordings of other projects to log folders.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use caudata_gap::import::{self, Format, ImportError, draft, map::Map};
use caudata_runlog::LogError;
use caudata_studies::files;
use caudata_telemetry::{ExitCode, Failure};
use clap::Args;
use serde_json::json;

use crate::say;

#[derive(Debug, Args)]
pub struct ImportArgs {
    /// Form of the recordings; default: by their names
    #[arg(long, value_enum)]
    format: Option<Format>,
    /// Which column is which signal, in which unit (TOML); all forms but bam need one
    #[arg(long, value_name = "MAP.toml")]
    map: Option<PathBuf>,
    /// Guess a map from the first recording, write it here (never over a file), and stop; to be checked, then given as --map
    #[arg(long, value_name = "MAP.toml", conflicts_with = "map")]
    draft_map: Option<PathBuf>,
    /// Robot file of what was recorded
    #[arg(long, value_name = "R.robot.toml")]
    robot: PathBuf,
    /// Folder in which a log folder is made for each run
    #[arg(long, value_name = "DIR", default_value = "logs")]
    out: PathBuf,
    /// Files, or folders: a bag, a dataset, CSV files that share a clock
    #[arg(value_name = "RECORDING", required = true)]
    recordings: Vec<PathBuf>,
    /// One JSON object on the last line
    #[arg(long)]
    json: bool,
}

impl ImportArgs {
    fn format(&self, path: &Path) -> Result<Format, Failure> {
        self.format.map_or_else(|| Format::guess(path).map_err(failure), Ok)
    }
}

pub fn run(args: &ImportArgs) -> Result<(), Failure> {
    let robot = files::robot(&args.robot)?;
    if let (Some(path), Some(first)) = (&args.draft_map, args.recordings.first()) {
        if path.is_file() {
            let message = format!("{} is there already", path.display());
            return Err(Failure::message(ExitCode::CannotCreate, message)
                .hint("what was corrected in it would be lost: give another name, or remove it"));
        }
        let format = args.format(first)?;
        if format == Format::Bam {
            return Err(Failure::message(ExitCode::BadConfig, "--format bam needs no map"));
        }
        let recordings = import::open(first, format, None).map_err(failure)?;
        let drafted = draft::map(&recordings, &robot).map_err(failure)?;
        files::write(path, &drafted.map)?;
        let path = path.display();
        if drafted.read.is_empty() {
            let message = format!(
                "no column of {} was understood ({}); {path} has an example of what to write",
                first.display(),
                drafted.unread.join(", ")
            );
            return Err(Failure::message(ExitCode::BadInput, message)
                .hint(format!("write in {path} what each column is, then give it as --map")));
        }
        if !drafted.unread.is_empty() {
            let name = |column: &String| match column.trim() {
                "" => "a column without a name".to_owned(),
                named => named.to_owned(),
            };
            let names: Vec<String> = drafted.unread.iter().map(name).collect();
            tracing::warn!("not understood, and left out: {}", names.join(", "));
        }
        say::line(format!("{path} is a guess: check it, then give it as --map {path}"));
        return Ok(());
    }
    let map = match &args.map {
        Some(path) => {
            let text = String::from_utf8_lossy(&files::read(path)?).into_owned();
            Some(Map::parse(&path.display().to_string(), &text).map_err(failure)?)
        }
        None => None,
    };
    let mut folders = Vec::new();
    // what is said of every episode is said once
    let (mut notes, mut unused) = (BTreeSet::new(), BTreeSet::new());
    for path in &args.recordings {
        let format = args.format(path)?;
        if format != Format::Bam && map.is_none() {
            let message =
                format!("{} needs a map of columns and units: --map MAP.toml", path.display());
            return Err(Failure::message(ExitCode::BadConfig, message)
                .hint("--draft-map MAP.toml instead guesses one"));
        }
        for run in import::read(path, format, map.as_ref(), &robot).map_err(failure)? {
            folders.push(run.write(&args.out).map_err(|e| failure(e.into()))?);
            notes.extend(run.notes);
            unused.extend(run.unused);
        }
    }
    if args.json {
        return say::json(&json!({ "logs": folders, "notes": notes, "unused": unused }));
    }
    for note in &notes {
        say::line(format!("note: {note}"));
    }
    if !unused.is_empty() {
        let unused: Vec<String> = unused.into_iter().collect();
        say::line(format!("not used: {}", unused.join(", ")));
    }
    say::line(format!("{} log(s) are in {}", folders.len(), args.out.display()));
    Ok(())
}

fn failure(error: ImportError) -> Failure {
    let code = match &error {
        ImportError::Io { source, .. } => ExitCode::of_io(source, false),
        ImportError::Log(LogError::Io { source, .. }) => ExitCode::of_io(source, true),
        ImportError::Log(LogError::Exists { .. }) => ExitCode::CannotCreate,
        ImportError::Log(LogError::Python { .. }) => ExitCode::Unavailable,
        _ => ExitCode::BadInput,
    };
    Failure::new(code, error)
}
