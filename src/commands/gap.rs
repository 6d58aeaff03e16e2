//! `caudata gap`: measured data to divergence, named cause, extended model, gain.

use std::path::{Path, PathBuf};

use caudata_telemetry::{ExitCode, Failure};
use clap::Subcommand;

use super::{gap_check, gap_excite, gap_import};

#[derive(Debug, Subcommand)]
pub enum GapCommand {
    /// Look at logs before any physics: faults, what they excite, what they cannot tell
    Check(gap_check::CheckArgs),
    /// Turn recordings of other projects into log folders
    Import(gap_import::ImportArgs),
    /// Write the experiment battery as command files for the robot
    Excite(gap_excite::ExciteArgs),
}

pub fn run(command: &GapCommand) -> Result<(), Failure> {
    match command {
        GapCommand::Check(args) => gap_check::run(args),
        GapCommand::Import(args) => gap_import::run(args),
        GapCommand::Excite(args) => gap_excite::run(args),
    }
}

/// The log folders that were named: each is one, or holds some (a folder of repeats).
///
/// # Errors
/// When a folder is missing or holds no log.
pub fn log_folders(given: &[PathBuf]) -> Result<Vec<PathBuf>, Failure> {
    let mut out = Vec::new();
    for dir in given {
        if is_log(dir) {
            out.push(dir.clone());
            continue;
        }
        let entries = std::fs::read_dir(dir).map_err(|e| {
            Failure::new(ExitCode::of_io(&e, false), e).context(format!("log {}", dir.display()))
        })?;
        let mut inside: Vec<PathBuf> = entries
            .filter_map(|e| Some(e.ok()?.path()))
            .filter(|p| is_log(p))
            .collect();
        inside.sort();
        if inside.is_empty() {
            return Err(Failure::message(
                ExitCode::NoInput,
                format!(
                    "{} is no log folder and holds none (log.csv and log.toml)",
                    dir.display()
                ),
            )
            .hint("`caudata gap import` makes log folders from other recordings"));
        }
        out.extend(inside);
    }
    Ok(out)
}

fn is_log(dir: &Path) -> bool {
    dir.join(caudata_runlog::META_NAME).is_file()
}
