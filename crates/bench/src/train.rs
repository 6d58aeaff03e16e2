//! Where a second of training goes: per iteration and as shares of the time of all cores.

use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{ExitStatus, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

use caudata_config::ConfigArgs;
use caudata_studies::{flags, training};
use caudata_telemetry::progress::Event;
use caudata_telemetry::spans::Part;
use caudata_telemetry::{ExitCode, Failure, FailureExt};
use clap::Args;
use serde::Serialize;

use crate::measure::{cpu_s_of, median};

/// Iterations at the start of a training that are not counted.
const WARM_UP: u64 = 5;

/// Which trainings.
#[derive(Clone, Debug, Args)]
pub struct Plan {
    /// Iterations of a training; the first five are not counted
    #[arg(long, default_value_t = 45, value_parser = clap::value_parser!(u64).range(10..=100_000))]
    iterations: u64,
    /// How often each training is repeated
    #[arg(long, default_value_t = 3, value_parser = clap::value_parser!(u32).range(1..=1000))]
    rounds: u32,
    /// Folder with another build of caudata-learner, which trains in turns with this one
    #[arg(long)]
    other: Option<PathBuf>,
    /// Threads of this program that keep a core busy all the while
    #[arg(long, default_value_t = 0, value_parser = clap::value_parser!(u32).range(0..=1024))]
    busy: u32,
    /// What is trained; the preset `quick` without these flags
    #[command(flatten)]
    config: ConfigArgs,
}

/// A part of the work.
#[derive(Clone, Debug, Serialize)]
pub struct PartFound {
    /// Its name: those of the learner's `spans_s`, and `waiting`, which is the rest.
    pub part: &'static str,
    /// Thread time per iteration, ms; null where that build does not tell.
    pub ms: Option<f64>,
    /// Share of the wall time of all cores.
    pub share: Option<f64>,
}

/// The trainings of one build.
#[derive(Clone, Debug, Serialize)]
pub struct Build {
    /// `this` or `other`.
    pub build: &'static str,
    /// From the start of the program until its actors begin, median over the rounds, s.
    pub starts_after_s: f64,
    /// Wall time of an iteration, median over all iterations, ms.
    pub iteration_ms: f64,
    /// CPU time of an iteration, mean, ms.
    pub cpu_ms: f64,
    /// Environment steps per second, all included, at the median iteration.
    pub steps_per_s: f64,
    /// Where the time went, means over all iterations.
    pub parts: Vec<PartFound>,
}

/// What was found.
#[derive(Clone, Debug, Serialize)]
pub struct Finding {
    /// `train`.
    pub benchmark: &'static str,
    /// Cores whose wall time is shared out.
    pub cores: usize,
    /// Threads that kept cores busy beside it.
    pub busy: u32,
    /// This build, and the other one.
    pub builds: Vec<Build>,
    /// Wall time of this build's iterations over the other's, pair after pair of trainings, median.
    pub wall_ratio: Option<f64>,
    /// The same of CPU time.
    pub cpu_ratio: Option<f64>,
}

/// One training.
#[derive(Clone, Debug, Default)]
struct Run {
    starts_after_s: f64,
    iterations_s: Vec<f64>,
    steps: f64,
    cpu_s: f64,
    parts_s: Vec<Option<f64>>,
}

/// Trains with the program `learner`, in turns with another one if asked for.
///
/// # Errors
/// Where a training cannot be started or fails.
pub fn run(plan: &Plan, learner: &Path) -> Result<Finding, Failure> {
    let mut programs = vec![("this", learner.to_owned())];
    if let Some(folder) = &plan.other {
        programs.push(("other", folder.join("caudata-learner")));
    }
    let busy = Busy::start(plan.busy)?;
    let mut runs: Vec<Vec<Run>> = vec![Vec::new(); programs.len()];
    for _ in 0..plan.rounds {
        for ((_, program), runs) in programs.iter().zip(&mut runs) {
            runs.push(train(plan, program)?);
        }
    }
    drop(busy);
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    let builds = programs.iter().zip(&runs);
    let ratio = |of: fn(&Run) -> f64| {
        let pairs = runs[0].iter().zip(runs.get(1)?);
        median(pairs.map(|(this, other)| of(this) / of(other)).collect())
    };
    Ok(Finding {
        benchmark: "train",
        cores,
        busy: plan.busy,
        wall_ratio: ratio(|run| median(run.iterations_s.clone()).unwrap_or(f64::NAN)),
        cpu_ratio: ratio(|run| run.cpu_s),
        builds: builds.map(|((build, _), runs)| together(build, runs, cores)).collect(),
    })
}

fn together(build: &'static str, runs: &[Run], cores: usize) -> Build {
    let all: Vec<f64> = runs.iter().flat_map(|run| run.iterations_s.clone()).collect();
    let (count, wall_s) = (all.len() as f64, all.iter().sum::<f64>());
    let sum = |of: &dyn Fn(&Run) -> f64| runs.iter().map(of).sum::<f64>();
    let found = |part, seconds: Option<f64>| PartFound {
        part,
        ms: seconds.map(|s| 1e3 * s / count),
        share: seconds.map(|s| s / (cores as f64 * wall_s)),
    };
    let seconds = |i: usize| runs.iter().map(|run| run.parts_s[i]).sum::<Option<f64>>();
    let each: Vec<Option<f64>> = (0..Part::ALL.len()).map(seconds).collect();
    let worked: Option<f64> = each.iter().copied().sum();
    let parts = Part::ALL.iter().zip(each);
    let mut parts: Vec<_> = parts.map(|(part, s)| found(part.name(), s)).collect();
    parts.push(found("waiting", worked.map(|s| cores as f64 * wall_s - s)));
    let iteration_s = median(all).unwrap_or(f64::NAN);
    let starts = runs.iter().map(|run| run.starts_after_s).collect();
    Build {
        build,
        starts_after_s: median(starts).unwrap_or(f64::NAN),
        iteration_ms: 1e3 * iteration_s,
        cpu_ms: 1e3 * sum(&|run| run.cpu_s) / count,
        steps_per_s: sum(&|run| run.steps) / count / iteration_s,
        parts,
    }
}

fn train(plan: &Plan, program: &Path) -> Result<Run, Failure> {
    let began = Instant::now();
    let cpu_s = |process| cpu_s_of(process).unwrap_or(f64::NAN);
    let mut run = Run { parts_s: vec![Some(0.0); Part::ALL.len()], ..Run::default() };
    // When the last counted iteration ended, and the steps and CPU time before the first.
    let mut last: Option<(Instant, f64, f64)> = None;
    let hear = |process, event| match event {
        Event::Started(_) => run.starts_after_s = began.elapsed().as_secs_f64(),
        Event::Iteration(iteration) if iteration.iteration >= WARM_UP => {
            let (now, steps) = (Instant::now(), iteration.steps_total as f64);
            let Some((before, first_steps, first_cpu_s)) = last else {
                last = Some((now, steps, cpu_s(process)));
                return;
            };
            run.iterations_s.push((now - before).as_secs_f64());
            run.steps = steps - first_steps;
            run.cpu_s = cpu_s(process) - first_cpu_s;
            last = Some((now, first_steps, first_cpu_s));
            for (sum, part) in run.parts_s.iter_mut().zip(Part::ALL) {
                let seconds = iteration.spans_s.get(part.name());
                *sum = sum.zip(seconds).map(|(sum, s)| sum + s);
            }
        }
        _ => {}
    };
    let status = listened(plan, program, hear)?;
    if !status.success() || run.iterations_s.is_empty() {
        let message = format!("the training of {} ended with {status}", program.display());
        return Err(Failure::message(ExitCode::Internal, message));
    }
    Ok(run)
}

/// Trains in a folder of its own; `hear` is told the process and what it says.
fn listened(
    plan: &Plan,
    program: &Path,
    mut hear: impl FnMut(u32, Event),
) -> Result<ExitStatus, Failure> {
    let folder = tempfile::tempdir().or_exit(ExitCode::CannotCreate)?;
    let mut flags = flags::or_preset(&plan.config, "quick");
    flags.overrides.extend([
        format!("run.iterations={}", plan.iterations),
        "telemetry.metrics=false".to_owned(),
    ]);
    let words = flags::as_words(&flags);
    let mut child = training::command(program, &words, "bench", folder.path())
        .stdout(Stdio::piped())
        .spawn()
        .or_exit(ExitCode::OsResource)?;
    let process = child.id();
    if let Some(stdout) = child.stdout.take() {
        for line in BufReader::new(stdout).lines() {
            // What later versions may say is none of these.
            if let Ok(event) = serde_json::from_str(&line.or_exit(ExitCode::Internal)?) {
                hear(process, event);
            }
        }
    }
    child.wait().or_exit(ExitCode::OsResource)
}

/// Threads that do nothing, all the time, until dropped.
struct Busy {
    done: Arc<AtomicBool>,
    threads: Vec<std::thread::JoinHandle<()>>,
}

impl Busy {
    fn start(count: u32) -> Result<Self, Failure> {
        let mut busy = Self { done: Arc::default(), threads: Vec::new() };
        for _ in 0..count {
            let done = Arc::clone(&busy.done);
            let spin = move || while !done.load(Ordering::Relaxed) {};
            let thread = std::thread::Builder::new().spawn(spin);
            busy.threads.push(thread.or_exit(ExitCode::OsResource)?);
        }
        Ok(busy)
    }
}

impl Drop for Busy {
    fn drop(&mut self) {
        self.done.store(true, Ordering::Relaxed);
        for thread in self.threads.drain(..) {
            let _ = thread.join();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shares_are_of_all_cores_and_what_is_left_was_waited() {
        // Two iterations of 0.1 s on two cores: 0.4 s in all, of which physics takes 0.1 s and products 0.2 s.
        let mut parts_s = vec![Some(0.0); Part::ALL.len()];
        parts_s[Part::Physics as usize] = Some(0.1);
        parts_s[Part::Products as usize] = Some(0.2);
        let run = Run {
            starts_after_s: 0.5,
            iterations_s: vec![0.1, 0.1],
            steps: 200.0,
            cpu_s: 0.3,
            parts_s,
        };
        let found = together("this", &[run], 2);
        let share = |name: &str| {
            let part = found.parts.iter().find(|part| part.part == name);
            part.and_then(|part| part.share).unwrap()
        };
        for (name, expected) in [("physics", 0.25), ("products", 0.5), ("waiting", 0.25)] {
            assert!((share(name) - expected).abs() < 1e-9, "{name}");
        }
        assert!((found.cpu_ms - 150.0).abs() < 1e-9 && (found.steps_per_s - 1000.0).abs() < 1e-6);
    }
}
