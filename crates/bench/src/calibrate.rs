//! `caudata bench calibrate`: how probable a name is, by how often names with such evidence were right on robots
//! whose laws are not the catalogue's own.

use std::path::{Path, PathBuf};

use caudata_gap::calibration::Calibration;
use caudata_gap_benchmark::calibrate::fit::{self, Score};
use caudata_gap_benchmark::calibrate::{self, Case};
use caudata_gap_benchmark::run::{self, Diagnoser};
use caudata_studies::files;
use caudata_telemetry::{ExitCode, Failure, FailureExt};
use clap::Args;
use serde::Serialize;

/// Which cases, and where the map goes.
#[derive(Clone, Debug, Args)]
pub struct Plan {
    /// Cases
    #[arg(long, value_name = "N", default_value_t = 200)]
    cases: usize,
    /// Seed of the cases
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Leave judged cases in this folder, as SEED.jsonl, and go on from those that stand there; default: a temporary one
    #[arg(long, value_name = "DIR")]
    keep: Option<PathBuf>,
    /// Fit the map to them and write it here; without it they judge the map that the program has
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
}

/// How names with evidence went.
#[derive(Debug, Serialize)]
pub struct Finding {
    /// Seed of the cases.
    pub seed: u64,
    /// How well what was said fits what was right.
    pub as_given: Score,
    /// The same of the map that the program has.
    pub shipped: Score,
    /// The same of maps of four fifths of the cases on the others, where a map was asked for.
    pub left_out: Option<Score>,
    /// One per case.
    pub cases: Vec<Case>,
}

/// Has `program` diagnose the cases.
///
/// # Errors
/// Where a folder cannot be written; a diagnosis that fails is a case.
pub fn run(plan: &Plan, program: &Path, tell: &mut dyn FnMut(&Case)) -> Result<Finding, Failure> {
    let temporary = tempfile::tempdir().or_exit(ExitCode::CannotCreate)?;
    let folder = plan.keep.as_deref().unwrap_or(temporary.path());
    files::make_folder(folder)?;
    let diagnoser = Diagnoser {
        program: program.to_owned(),
        arguments: ["bench", "gap", "--examinee"].map(str::to_owned).to_vec(),
        limit_s: run::DEFAULT_LIMIT_S,
    };
    let cases = calibrate::cases(plan.seed, plan.cases, folder, &diagnoser, tell)
        .map_err(crate::gap::failure)?;
    let shipped = Calibration::shipped().or_exit(ExitCode::Internal)?;
    let map = plan.out.as_ref().map(|out| {
        let keep = plan.keep.iter().map(|keep| format!(" --keep {}", keep.display()));
        let command = format!(
            "caudata bench calibrate --seed {} --cases {}{} --out {}",
            plan.seed,
            plan.cases,
            keep.collect::<String>(),
            out.display()
        );
        fit::fit(&cases, shipped.by_hand, command, plan.seed)
    });
    if let (Some(out), Some(map)) = (&plan.out, &map) {
        files::write(out, map.text())?;
    }
    Ok(Finding {
        seed: plan.seed,
        as_given: fit::as_given(&cases),
        shipped: fit::as_mapped(&cases, &shipped),
        left_out: (map.as_ref()).map(|_| fit::left_out(&cases, shipped.by_hand)),
        cases,
    })
}
