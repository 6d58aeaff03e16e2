//! Running a set: make the cases, seal the answers, diagnose each in a process of its own that sees its
//! folder only, judge, sum up.

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::Mutex;
use std::time::{Duration, Instant};

use caudata_gap::report::Report;

use crate::case::{Answer, Answers};
use crate::file::{FileError, at};
use crate::generate::{self, GenerateError, Rig};
use crate::salamander::{self, LabFile, SalamanderPlan};
use crate::score::{Given, Outcome, judge};
use crate::seal;
use crate::sets::Plan;

/// Why a set could not be run.
#[derive(Debug, thiserror::Error)]
pub enum BenchError {
    /// A case could not be made.
    #[error("{0}")]
    Generate(#[from] GenerateError),
    /// A file could not be read or written.
    #[error(transparent)]
    File(#[from] FileError),
    /// The answers do not open.
    #[error("{0}")]
    Seal(#[from] seal::SealError),
    /// The answers are not what they were.
    #[error("sealed answers are damaged: {0}")]
    Answers(#[from] serde_json::Error),
    /// A kept case is not one.
    #[error("{0}, line {1}: {2}; move the file away, and its cases are made again")]
    Kept(String, usize, String),
}

/// Name of the sealed file.
pub const SEALED_NAME: &str = "answers.sealed";
/// Folder of the cases beside it.
pub const CASES_NAME: &str = "cases";
/// Longest that one diagnosis may take before it is stopped and counted as failed, s.
pub const DEFAULT_LIMIT_S: f64 = 900.0;
/// How often a running diagnosis is looked after, ms.
const POLL_MS: u64 = 20;

/// How a diagnosis is started: a program that takes a case folder as its last argument and writes
/// `report.json` into its current folder. It sees no environment variables.
#[derive(Clone, Debug)]
pub struct Diagnoser {
    /// Program.
    pub program: PathBuf,
    /// Arguments before the case folder.
    pub arguments: Vec<String>,
    /// Longest run, s.
    pub limit_s: f64,
}

/// Makes the cases of `plans` under `root/cases` and seals their answers beside them. Returns (made, left out
/// because they cannot be as large as asked for, with the reason).
pub fn generate(
    plans: &[Plan],
    root: &Path,
    secret: &[u8],
    jobs: usize,
    mut each: impl FnMut(usize, usize) + Send,
) -> Result<(usize, Vec<String>), BenchError> {
    let cases = root.join(CASES_NAME);
    let results = in_parallel(plans, jobs, |i, plan| make(i, plan, &cases), &mut each);
    let mut answers = Answers::default();
    let mut left_out = Vec::new();
    for result in results {
        match result {
            Ok(answer) => answers.answers.push(answer),
            Err(e @ (GenerateError::TooSmall { .. } | GenerateError::Diverged(_))) => {
                left_out.push(e.to_string())
            }
            Err(e) => return Err(e.into()),
        }
    }
    let path = root.join(SEALED_NAME);
    let text = serde_json::to_vec(&answers)?;
    std::fs::write(&path, seal::seal(&text, secret)).map_err(at(&path))?;
    Ok((answers.answers.len(), left_out))
}

fn make(index: usize, plan: &Plan, cases: &Path) -> Result<Answer, GenerateError> {
    if let Some((place, hidden, channels)) = plan.salamander {
        let plan = SalamanderPlan {
            name: format!("c{index:04}"),
            file: LabFile::Stiff,
            place,
            hidden,
            channels,
            seed: plan.seed,
            repeats: 2,
        };
        return salamander::make(&plan, cases, &|| true);
    }
    generate::make(&format!("c{index:04}"), plan, cases)
}

/// Makes the case of `plan` in `root`, has it diagnosed in a process of its own, and tells what is true and what
/// was given.
pub fn one_case(
    number: usize,
    plan: &Plan,
    root: &Path,
    diagnoser: &Diagnoser,
) -> Result<(Answer, Given), GenerateError> {
    let answer = make(number, plan, &root.join(CASES_NAME))?;
    let given = one(root, &answer.case, &answer.without, diagnoser);
    Ok((answer, given))
}

/// Opens the answers of a set.
pub fn answers(root: &Path, secret: &[u8]) -> Result<Answers, BenchError> {
    let path = root.join(SEALED_NAME);
    let sealed = std::fs::read(&path).map_err(at(&path))?;
    Ok(serde_json::from_slice(&seal::open(&sealed, secret)?)?)
}

/// Diagnoses every case of a set, `jobs` at a time, and judges it. The examiner opens the answers to learn
/// which effects a case leaves out of the catalogue; the process that diagnoses never sees them.
pub fn diagnose(
    root: &Path,
    secret: &[u8],
    diagnoser: &Diagnoser,
    jobs: usize,
    mut each: impl FnMut(usize, usize) + Send,
) -> Result<(Vec<Outcome>, Answers), BenchError> {
    // What has to be left out of the catalogue must be known before; nothing else of the answers is looked
    // at.
    let known = answers(root, secret)?;
    let orders: Vec<(String, Vec<String>)> =
        known.answers.iter().map(|a| (a.case.clone(), a.without.clone())).collect();
    let given = in_parallel(
        &orders,
        jobs,
        |_, (case, without)| one(root, case, without, diagnoser),
        &mut each,
    );
    let outcomes = judged(&known, &given)?;
    Ok((outcomes, known))
}

fn judged(known: &Answers, given: &[Given]) -> Result<Vec<Outcome>, BenchError> {
    let mut outcomes = Vec::new();
    for (answer, given) in known.answers.iter().zip(given) {
        let model = if answer.rig == salamander::RIG {
            salamander::lab_file(LabFile::Stiff)?.2
        } else {
            Rig::bench(&answer.rig)?.model
        };
        let links: Vec<(String, String)> = model
            .actuated()
            .iter()
            .map(|&j| {
                let joint = &model.joints()[j];
                (joint.name.clone(), model.links()[joint.child_link].name.clone())
            })
            .collect();
        outcomes.push(judge(answer, given, &links));
    }
    Ok(outcomes)
}

/// Runs one diagnosis in a process with its case folder and an empty output folder, and nothing else.
fn one(root: &Path, case: &str, without: &[String], diagnoser: &Diagnoser) -> Given {
    let began = Instant::now();
    let failed =
        |failure: String| Given { report: None, failure, seconds: began.elapsed().as_secs_f64() };
    let out = root.join("out").join(case);
    if let Err(e) = std::fs::create_dir_all(&out) {
        return failed(format!("{}: {e}", out.display()));
    }
    let folder = match root.join(CASES_NAME).join(case).canonicalize() {
        Ok(folder) => folder,
        Err(e) => return failed(format!("{case}: {e}")),
    };
    let mut command = Command::new(&diagnoser.program);
    command.args(&diagnoser.arguments).env_clear().current_dir(&out).stdin(Stdio::null());
    for id in without {
        command.args(["--without", id]);
    }
    command.arg(&folder);
    let log = out.join("log.txt");
    let to = |path: &Path| std::fs::File::create(path).map_or_else(|_| Stdio::null(), Stdio::from);
    command.stdout(Stdio::null()).stderr(to(&log));
    let mut child = match command.spawn() {
        Ok(child) => child,
        Err(e) => return failed(format!("{}: {e}", diagnoser.program.display())),
    };
    let status = loop {
        match child.try_wait() {
            Ok(Some(status)) => break status,
            Ok(None) if began.elapsed().as_secs_f64() > diagnoser.limit_s => {
                // nothing more to learn from it
                let _ = child.kill();
                let _ = child.wait();
                return failed(format!("stopped after {:.0} s", diagnoser.limit_s));
            }
            Ok(None) => std::thread::sleep(Duration::from_millis(POLL_MS)),
            Err(e) => return failed(e.to_string()),
        }
    };
    let seconds = began.elapsed().as_secs_f64();
    let text = std::fs::read_to_string(out.join("report.json")).unwrap_or_default();
    match serde_json::from_str::<Report>(&text) {
        Ok(report) => Given { report: Some(report), failure: String::new(), seconds },
        Err(_) => {
            let said = std::fs::read_to_string(&log).unwrap_or_default();
            failed(format!("{status}: {}", said.lines().last().unwrap_or("no report")))
        }
    }
}

/// Results in the order of `items`, `jobs` at a time; `each` hears (done, all).
fn in_parallel<T: Sync, R: Send>(
    items: &[T],
    jobs: usize,
    work: impl Fn(usize, &T) -> R + Sync,
    each: &mut (impl FnMut(usize, usize) + Send),
) -> Vec<R> {
    let next = std::sync::atomic::AtomicUsize::new(0);
    let done: Mutex<(Vec<(usize, R)>, _)> = Mutex::new((Vec::new(), each));
    std::thread::scope(|scope| {
        for _ in 0..jobs.clamp(1, items.len().max(1)) {
            scope.spawn(|| {
                loop {
                    let i = next.fetch_add(1, std::sync::atomic::Ordering::Relaxed);
                    let Some(item) = items.get(i) else { break };
                    let result = work(i, item);
                    let mut done = done.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
                    done.0.push((i, result));
                    let count = done.0.len();
                    (done.1)(count, items.len());
                }
            });
        }
    });
    let mut results = done.into_inner().unwrap_or_else(std::sync::PoisonError::into_inner).0;
    results.sort_by_key(|(i, _)| *i);
    results.into_iter().map(|(_, r)| r).collect()
}
