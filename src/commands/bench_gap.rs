//! `caudata bench gap`: how well diagnosis finds what was hidden. Cases by other numerics, answers sealed, each diagnosis a process of its own.

use std::path::PathBuf;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Instant, SystemTime};

use caudata_gap::Options;
use caudata_gap_benchmark::baselines::{self, BaselineSummary};
use caudata_gap_benchmark::case::{Answer, Block};
use caudata_gap_benchmark::examinee;
use caudata_gap_benchmark::run::{self, BenchError, Diagnoser};
use caudata_gap_benchmark::score::{Outcome, Summary};
use caudata_gap_benchmark::sets::{self, SetName};
use caudata_telemetry::{ExitCode, Failure, FailureExt};
use clap::{Args, ValueEnum};
use serde::Serialize;
use serde_json::json;

use crate::say;

#[derive(Debug, Args)]
pub struct GapBench {
    /// Which cases
    #[arg(long, value_enum, default_value_t = Set::Quick)]
    set: Set,
    /// Only cases of these blocks: null, single, pair, decoy, outside, starved, ground, water, holdout_change; default: all
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
    /// Also what least squares, evolution, forward selection and an unnamed residual make of the same logs (slow)
    #[arg(long)]
    baselines: bool,
    /// Every case, not only the table
    #[arg(long)]
    each: bool,
    /// One JSON object on the last line
    #[arg(long)]
    json: bool,
    /// Diagnose one case folder into the current folder: what the benchmark starts for each case
    #[arg(long, value_name = "CASE", hide = true)]
    examinee: Option<PathBuf>,
    /// Effect ids that the examinee has to do without
    #[arg(long, hide = true)]
    without: Vec<String>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Set {
    /// A dozen short cases
    Quick,
    /// About 150: every effect once at d = 4, half of them at another size, and some of all other blocks
    Pr,
    /// About 1,200
    Nightly,
}

impl From<Set> for SetName {
    fn from(set: Set) -> Self {
        match set {
            Set::Quick => Self::Quick,
            Set::Pr => Self::Pr,
            Set::Nightly => Self::Nightly,
        }
    }
}

pub fn run(args: &GapBench) -> Result<(), Failure> {
    if let Some(case) = &args.examinee {
        let options = Options {
            threads: 1,
            without: args.without.clone(),
            ..Options::default()
        };
        return examinee::write_report(case, options).or_exit(ExitCode::BadInput);
    }
    let began = Instant::now();
    let temporary = std::env::temp_dir().join(format!("caudata-bench-gap-{}", std::process::id()));
    let root = args.keep.clone().unwrap_or_else(|| temporary.clone());
    if root.join(run::SEALED_NAME).exists() || root.join(run::CASES_NAME).exists() {
        let message = format!(
            "{} holds a set already; choose another folder",
            root.display()
        );
        return Err(Failure::message(ExitCode::CannotCreate, message));
    }
    let result = bench(args, &root, began);
    if args.keep.is_none() {
        // nothing of value is lost if it stays
        let _ = std::fs::remove_dir_all(&temporary);
    }
    result
}

fn bench(args: &GapBench, root: &std::path::Path, began: Instant) -> Result<(), Failure> {
    let jobs = args.jobs as usize;
    let secret = secret();
    let mut plans = sets::plan(args.set.into(), args.seed, None);
    plans.retain(|p| args.block.is_empty() || args.block.contains(&p.block));
    plans.truncate(args.cases.unwrap_or(usize::MAX));
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
        run::generate(&plans, root, &secret, jobs, progress("cases made")).map_err(failure)?;
    let program = std::env::current_exe().or_exit(ExitCode::Internal)?;
    let diagnoser = Diagnoser {
        program,
        arguments: ["bench", "gap", "--examinee"].map(str::to_owned).to_vec(),
        limit_s: run::DEFAULT_LIMIT_S,
    };
    let (outcomes, answers) =
        run::diagnose(root, &secret, &diagnoser, jobs, progress("cases diagnosed"))
            .map_err(failure)?;
    let summary = Summary::of(&outcomes);
    let beside = if args.baselines {
        with_baselines(root, &answers.answers)?
    } else {
        Vec::new()
    };
    let seconds = began.elapsed().as_secs_f64();
    if args.json {
        return say::json(&json!({
            "set": args.set, "seed": args.seed, "cases": made, "left_out": left_out, "seconds": seconds,
            "summary": summary, "baselines": beside, "outcomes": outcomes,
        }));
    }
    if args.each {
        for (outcome, answer) in outcomes.iter().zip(&answers.answers) {
            say::line(one_line(outcome, answer));
        }
    }
    let mut rows = vec![
        ["", "measured (95 % interval)", "owed"]
            .map(str::to_owned)
            .to_vec(),
    ];
    rows.extend(
        summary
            .rows()
            .into_iter()
            .map(|(what, value, owed)| vec![what, value, owed.to_owned()]),
    );
    say::table(&rows);
    if !beside.is_empty() {
        say::line("");
        say::table(&baseline_rows(&beside, &summary, &outcomes));
    }
    if !left_out.is_empty() {
        say::line(format!(
            "\n{} cases were not made: their effect cannot be as large as asked for",
            left_out.len()
        ));
    }
    say::line(format!("\n{made} cases in {seconds:.0} s"));
    Ok(())
}

/// The block with this name.
fn block(name: &str) -> Result<Block, String> {
    serde_json::from_value(json!(name)).map_err(|_| "no such block".to_owned())
}

/// Something that no process started here knows: the answers stay closed to them.
fn secret() -> Vec<u8> {
    let now = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH);
    format!("{:?} {}", now, std::process::id()).into_bytes()
}

fn failure(e: BenchError) -> Failure {
    let code = match &e {
        BenchError::Io { source, .. } => ExitCode::of_io(source, true),
        _ => ExitCode::Internal,
    };
    Failure::new(code, e)
}

fn with_baselines(
    root: &std::path::Path,
    answers: &[Answer],
) -> Result<Vec<BaselineSummary>, Failure> {
    let mut all = Vec::new();
    for answer in answers {
        let folder = root.join(run::CASES_NAME).join(&answer.case);
        all.push((
            answer.clone(),
            baselines::all(&folder, answer).or_exit(ExitCode::Internal)?,
        ));
    }
    Ok(baselines::summaries(&all))
}

fn baseline_rows(
    beside: &[BaselineSummary],
    ours: &Summary,
    outcomes: &[Outcome],
) -> Vec<Vec<String>> {
    let head = [
        "",
        "false alarms",
        "first name right, d >= 4",
        "wrong names per single",
        "held-out error, median ratio",
        "s",
    ];
    let mut rows = vec![head.map(str::to_owned).to_vec()];
    rows.push(vec![
        "caudata".to_owned(),
        ours.false_alarms.to_string(),
        ours.first_large.to_string(),
        format!("{:.2}", ours.wrong_per_single),
        format!(
            "{:.3}",
            caudata_gap_benchmark::score::summary::median_gain(outcomes)
        ),
        format!("{:.1}", ours.seconds.0),
    ]);
    for b in beside {
        rows.push(vec![
            b.baseline.clone(),
            b.false_alarms.to_string(),
            b.first_large.to_string(),
            format!("{:.2}", b.wrong_per_case),
            format!("{:.3}", b.holdout_ratio),
            format!("{:.1}", b.seconds),
        ]);
    }
    rows
}

fn one_line(o: &Outcome, a: &Answer) -> String {
    let truth: Vec<String> = a
        .effects
        .iter()
        .map(|t| format!("{} {} d {:.1}", t.effect, t.joint, t.d))
        .collect();
    let given: Vec<String> = o
        .given
        .iter()
        .map(|(effect, place, c)| format!("{effect} {place} {c:.2}"))
        .collect();
    let mark = if o.right { "right" } else { "WRONG" };
    let what = if a.decoy.is_empty() {
        truth.join(", ")
    } else {
        a.decoy.clone()
    };
    format!(
        "{mark}  {:?} {} [{what}]: {} {} {}",
        o.block,
        o.rig,
        o.verdict,
        given.join(", "),
        o.failure
    )
}
