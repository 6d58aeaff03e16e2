//! `caudata gap`: measured data to divergence, named cause, extended model, gain.

use std::path::{Path, PathBuf};

use caudata_telemetry::{ExitCode, Failure, FailureExt, Process};
use clap::Subcommand;
use sha2::{Digest, Sha256};

use super::{
    gap_apply, gap_check, gap_diagnose, gap_excite, gap_import, gap_paper, gap_policies, gap_report,
};

#[derive(Debug, Subcommand)]
pub enum GapCommand {
    /// Look at logs before any physics: faults, what they excite, what they cannot tell
    Check(gap_check::CheckArgs),
    /// Turn recordings of other projects into log folders
    Import(gap_import::ImportArgs),
    /// Say where simulation and measurement part, why, and what it is worth to know
    Diagnose(gap_diagnose::DiagnoseArgs),
    /// Merge what a diagnosis found into a robot file
    Apply(gap_apply::ApplyArgs),
    /// Show a diagnosis again
    Report(gap_report::ReportArgs),
    /// Write the experiment battery as command files for the robot
    Excite(gap_excite::ExciteArgs),
    /// What an extended model is worth to a policy: trains in it, in the model as given, and in that with wide randomisation, and runs all on the robot
    Policies(gap_policies::PoliciesArgs),
    /// The pipeline of the paper on logs of a simulated robot: play, low-pass and weaker servos are found and drawn as the paper draws them, and policies
    /// trained without and with them are run on that robot
    Paper(gap_paper::PaperArgs),
}

pub fn run(command: &GapCommand, process: &Process) -> Result<(), Failure> {
    match command {
        GapCommand::Check(args) => gap_check::run(args),
        GapCommand::Import(args) => gap_import::run(args),
        GapCommand::Diagnose(args) => gap_diagnose::run(args, process),
        GapCommand::Apply(args) => gap_apply::run(args),
        GapCommand::Report(args) => gap_report::run(args),
        GapCommand::Excite(args) => gap_excite::run(args),
        GapCommand::Policies(args) => gap_policies::run(args, process),
        GapCommand::Paper(args) => gap_paper::run(args, process),
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

/// Of a file, in hexadecimal.
///
/// # Errors
/// When it cannot be read.
pub fn file_sha256(path: &Path) -> Result<String, Failure> {
    let bytes = std::fs::read(path).map_err(|e| {
        Failure::new(ExitCode::of_io(&e, false), e)
            .context(format!("cannot read {}", path.display()))
    })?;
    let hash = Sha256::digest(bytes);
    Ok(hash.iter().map(|b| format!("{b:02x}")).collect())
}

/// The bytes of a robot file, and name and bytes of the MJCF beside it.
///
/// # Errors
/// When one cannot be read.
pub fn robot_files(path: &Path) -> Result<(Vec<u8>, String, Vec<u8>), Failure> {
    let read = |path: &Path| {
        std::fs::read(path).map_err(|e| {
            Failure::new(ExitCode::of_io(&e, false), e).context(path.display().to_string())
        })
    };
    let robot_toml = read(path)?;
    let mjcf_name = caudata_gap::mjcf_name(&String::from_utf8_lossy(&robot_toml))
        .or_exit(ExitCode::BadInput)?;
    let mjcf = read(&path.with_file_name(&mjcf_name))?;
    Ok((robot_toml, mjcf_name, mjcf))
}

fn is_log(dir: &Path) -> bool {
    dir.join(caudata_runlog::META_NAME).is_file()
}
