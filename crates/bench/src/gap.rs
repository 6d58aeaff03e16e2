//! `caudata bench gap`: how well diagnosis finds what was hidden. Cases by other numerics, answers sealed,
//! each diagnosis a process of its own.

use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Instant, SystemTime};

use caudata_gap::Options;
use caudata_gap_benchmark::baselines::{self, BaselineSummary};
use caudata_gap_benchmark::case::{Answer, Block};
use caudata_gap_benchmark::examinee;
use caudata_gap_benchmark::run::{self, BenchError, Diagnoser};
use caudata_gap_benchmark::score::{Outcome, Summary};
use caudata_gap_benchmark::sets::{self, SetName};
use caudata_studies::files;
use caudata_telemetry::{ExitCode, Failure, FailureExt};
use clap::Args;
use serde::Serialize;

/// Which cases, and how they are diagnosed.
#[derive(Clone, Debug, Args)]
pub struct Plan {
    /// Which cases
    #[arg(long, value_enum, default_value_t = SetName::Quick)]
    set: SetName,
    /// Only cases of these blocks: null, single, pair, decoy, outside, starved, ground, water,
    /// holdout_change; default: all
    #[arg(long, value_name = "BLOCK", value_delimiter = ',', value_parser = block)]
    block: Vec<Block>,
    /// Only so many of them; default: all
    #[arg(long, value_name = "N")]
    cases: Option<usize>,
    /// Diagnoses at a time
    #[arg(long, value_name = "J", default_value_t = 2, value_parser = clap::value_parser!(u32).range(1..=256))]
    jobs: u32,
    /// Seed of the set
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Leave cases, reports and sealed answers in this folder; default: a temporary one
    #[arg(long, value_name = "DIR")]
    keep: Option<PathBuf>,
    /// Also what least squares, evolution, forward selection and an unnamed residual make of the same logs
    /// (slow)
    #[arg(long)]
    baselines: bool,
    /// Diagnose one case folder into the current folder: what the benchmark starts for each case
    #[arg(long, hide = true, requires = "case")]
    examinee: bool,
    /// Effect ids that the examinee has to do without
    #[arg(long, hide = true)]
    without: Vec<String>,
    /// The case folder
    #[arg(hide = true, requires = "examinee")]
    case: Option<PathBuf>,
}

/// How every case went.
#[derive(Debug, Serialize)]
pub struct Finding {
    /// Which cases.
    pub set: SetName,
    /// Seed of the set.
    pub seed: u64,
    /// How many were made.
    pub cases: usize,
    /// Why a case was not made.
    pub left_out: Vec<String>,
    /// What it took.
    pub seconds: f64,
    /// Rates.
    pub summary: Summary,
    /// The same of other methods, where that was asked for.
    pub baselines: Vec<BaselineSummary>,
    /// One per case.
    pub outcomes: Vec<Outcome>,
    /// What was hidden in each.
    #[serde(skip)]
    pub answers: Vec<Answer>,
}

/// Makes the cases, has each diagnosed by `program` in a process of its own, and opens the answers; nothing
/// where this process is such a one.
///
/// # Errors
/// Where a folder cannot be written or a baseline cannot run; a diagnosis that fails is an outcome.
pub fn run(plan: &Plan, program: &Path) -> Result<Option<Finding>, Failure> {
    if let Some(case) = &plan.case {
        let options = Options { threads: 1, without: plan.without.clone(), ..Options::default() };
        examinee::write_report(case, options).or_exit(ExitCode::BadInput)?;
        return Ok(None);
    }
    // Of nobody else, and gone in the end, whatever comes of it.
    let temporary = tempfile::tempdir().or_exit(ExitCode::CannotCreate)?;
    let root = plan.keep.as_deref().unwrap_or(temporary.path());
    if root.join(run::SEALED_NAME).exists() || root.join(run::CASES_NAME).exists() {
        let message = format!("{} holds a set already; choose another folder", root.display());
        return Err(Failure::message(ExitCode::CannotCreate, message));
    }
    files::make_folder(root)?;
    bench(plan, program, root).map(Some)
}

fn bench(plan: &Plan, program: &Path, root: &Path) -> Result<Finding, Failure> {
    let began = Instant::now();
    let jobs = plan.jobs as usize;
    let secret = secret();
    let mut cases = sets::plan(plan.set, plan.seed, None);
    cases.retain(|c| plan.block.is_empty() || plan.block.contains(&c.block));
    cases.truncate(plan.cases.unwrap_or(usize::MAX));
    let told = AtomicUsize::new(0);
    let progress = |what: &'static str| {
        told.store(0, Ordering::Relaxed);
        let told = &told;
        move |done: usize, all: usize| {
            // tenths are often enough
            let tenth = 10 * done / all.max(1);
            if tenth > told.swap(tenth, Ordering::Relaxed) {
                tracing::info!("{what}: {done} of {all}");
            }
        }
    };
    let (made, left_out) =
        run::generate(&cases, root, &secret, jobs, progress("cases made")).map_err(failure)?;
    let diagnoser = Diagnoser {
        program: program.to_owned(),
        arguments: ["bench", "gap", "--examinee"].map(str::to_owned).to_vec(),
        limit_s: run::DEFAULT_LIMIT_S,
    };
    let (outcomes, answers) =
        run::diagnose(root, &secret, &diagnoser, jobs, progress("cases diagnosed"))
            .map_err(failure)?;
    let baselines = match plan.baselines {
        true => with_baselines(root, &answers.answers)?,
        false => Vec::new(),
    };
    Ok(Finding {
        set: plan.set,
        seed: plan.seed,
        cases: made,
        left_out,
        seconds: began.elapsed().as_secs_f64(),
        summary: Summary::of(&outcomes),
        baselines,
        outcomes,
        answers: answers.answers,
    })
}

/// The block with this name.
fn block(name: &str) -> Result<Block, String> {
    serde_json::from_value(serde_json::Value::from(name)).map_err(|_| "no such block".to_owned())
}

/// Something that no process started here knows: the answers stay closed to them.
fn secret() -> Vec<u8> {
    let now = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH);
    format!("{:?} {}", now, std::process::id()).into_bytes()
}

pub(crate) fn failure(e: BenchError) -> Failure {
    let code = match &e {
        BenchError::File(file) => ExitCode::of_io(&file.source, true),
        BenchError::Kept(..) => ExitCode::BadInput,
        _ => ExitCode::Internal,
    };
    Failure::new(code, e)
}

fn with_baselines(root: &Path, answers: &[Answer]) -> Result<Vec<BaselineSummary>, Failure> {
    let mut all = Vec::new();
    for answer in answers {
        let folder = root.join(run::CASES_NAME).join(&answer.case);
        all.push((answer.clone(), baselines::all(&folder, answer).or_exit(ExitCode::Internal)?));
    }
    Ok(baselines::summaries(&all))
}

#[cfg(test)]
mod tests {
    use clap::Parser;

    use super::*;

    #[derive(Parser)]
    struct Command {
        #[command(flatten)]
        plan: Plan,
    }

    #[test]
    fn an_examinee_is_told_its_case_and_what_it_has_to_do_without() {
        // in the order in which the benchmark starts it
        let told = ["bench", "--examinee", "--without", "a", "--without", "b", "case"];
        let plan = Command::try_parse_from(told).unwrap().plan;
        assert_eq!(plan.without, ["a", "b"]);
        assert_eq!(plan.case.as_deref(), Some(Path::new("case")));
        for wrong in [vec!["bench", "--examinee"], vec!["bench", "case"]] {
            assert!(Command::try_parse_from(wrong).is_err());
        }
    }
}
