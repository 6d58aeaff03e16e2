//! `caudata runs`: what is in run folders, side by side.

use std::cmp::Ordering;
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use caudata_config::{Changes, Config, Source};
use caudata_studies::files;
use caudata_telemetry::progress::{Event, Iteration};
use caudata_telemetry::{ExitCode, Failure, FailureExt};
use clap::{Args, Subcommand};
use serde_json::{Value, json};

use crate::commands::train::folder::PROGRESS;
use crate::say::{self, WithJson};

/// Points at which curves are compared.
const POINTS: usize = 10;
/// Keys that differ from run to run without deciding anything.
const INCIDENTAL: [&str; 4] = ["run.name", "run.out_dir", "policy_server.", "telemetry."];

#[derive(Debug, Subcommand)]
pub enum RunsCommand {
    /// The runs in a folder, the oldest first
    List(WithJson<Within>),
    /// Runs side by side: curves, gates, and the settings that differ
    Compare(WithJson<Chosen>),
    /// The run whose policy walks best: goes as told and stays up, misses fewest gates, is nearest to its command
    Best(WithJson<Within>),
}

#[derive(Debug, Args)]
pub struct Within {
    /// The folder that they lie in
    #[arg(value_name = "DIR", default_value = "runs")]
    folder: PathBuf,
}

#[derive(Debug, Args)]
pub struct Chosen {
    /// Their folders
    #[arg(value_name = "RUN", num_args = 2..=12, required = true)]
    runs: Vec<PathBuf>,
}

pub fn run(command: &RunsCommand) -> Result<(), Failure> {
    match command {
        RunsCommand::List(args) => {
            let runs = within(&args.plan.folder)?;
            let all: Vec<Value> = runs.iter().map(Run::summary).collect();
            say::either(args.json, &json!({ "runs": all }), |_| {
                say::records(&all, SUMMARY);
            })
        }
        RunsCommand::Compare(args) => {
            let runs: Vec<Run> =
                args.plan.runs.iter().map(|dir| Run::read(dir)).collect::<Result<_, _>>()?;
            compare(&runs, args.json)
        }
        RunsCommand::Best(args) => {
            let runs = within(&args.plan.folder)?;
            let best = runs.iter().filter(|run| run.rank().is_some()).min_by(|a, b| a.by_rank(b));
            let best = best.ok_or_else(|| {
                let message = format!("no run in {} has an evaluation", args.plan.folder.display());
                Failure::message(ExitCode::NoInput, message)
            })?;
            say::either(args.json, &best.summary(), |summary| {
                say::fields(summary, SUMMARY);
                say::line(format!("policy {}", best.folder.join("policy.onnx").display()));
            })
        }
    }
}

/// Columns of a list.
const SUMMARY: &str = "run robot state iteration env_steps episode_return forward_mps power_w gates_missed fall_share";

/// What is in one run folder.
pub struct Run {
    folder: PathBuf,
    /// What it began with.
    pub config: Config,
    changes: Changes,
    /// Wall time of its learners that came to an end, s.
    seconds: f64,
    iterations: Vec<Iteration>,
    /// `evaluation` of its report, or null.
    evaluation: Value,
    state: &'static str,
}

impl Run {
    /// Reads one.
    ///
    /// # Errors
    /// When the folder is none of a run, or its configuration cannot be read.
    pub fn read(folder: &Path) -> Result<Self, Failure> {
        let config = folder.join("config.toml");
        files::run_folder(folder)?;
        let config = Config::load(&Source::file(&config)).or_exit(ExitCode::BadInput)?;
        let changes = Changes::of_run(folder, &config).or_exit(ExitCode::BadInput)?;
        let text = std::fs::read_to_string(folder.join(PROGRESS)).unwrap_or_default();
        let mut run = Self {
            folder: folder.to_owned(),
            config,
            changes,
            seconds: 0.0,
            iterations: Vec::new(),
            evaluation: Value::Null,
            state: "stopped or running",
        };
        for line in text.lines() {
            match serde_json::from_str(line) {
                Ok(Event::Iteration(iteration)) => {
                    // A run that went on from an earlier checkpoint tells its later part again.
                    let again = |before: &Iteration| before.iteration >= iteration.iteration;
                    while run.iterations.last().is_some_and(again) {
                        run.iterations.pop();
                    }
                    run.iterations.push(*iteration);
                }
                Ok(Event::Finished(finished)) => {
                    run.seconds += finished.wall_s;
                    if finished.reason == "completed" {
                        run.state = "completed";
                    }
                }
                Ok(Event::Started(_)) => run.state = "stopped or running",
                _ => {}
            }
        }
        let report = folder.join("report.json");
        if report.is_file() {
            run.evaluation = files::read_json::<Value>(&report)?["evaluation"].take();
        }
        Ok(run)
    }

    /// What it began with, and how that changed on the way.
    fn settings(&self) -> Vec<(String, String)> {
        let changes = self.changes.change.iter();
        let changes = changes.map(|c| format!("after {}: {}", c.iteration, c.set.join(", ")));
        let changes = changes.collect::<Vec<_>>().join("; ");
        let mut settings = self.config.entries();
        settings.extend((!changes.is_empty()).then(|| ("changes".to_owned(), changes)));
        settings
    }

    fn name(&self) -> String {
        let name = self.folder.file_name().unwrap_or(self.folder.as_os_str());
        name.to_string_lossy().into_owned()
    }

    /// Gates that its policy missed; `None` where it was not asked.
    fn missed(&self) -> Option<Vec<String>> {
        let gates = self.evaluation["gates"]["gates"].as_array()?;
        let missed = gates.iter().filter(|gate| gate["met"] == false);
        Some(missed.filter_map(|gate| Some(gate["name"].as_str()?.to_owned())).collect())
    }

    /// Whether it falls or stays behind half of its command, gates missed, how far its speed is off, m/s.
    fn rank(&self) -> Option<(bool, usize, f64)> {
        let command = self.evaluation["command"][0].as_f64()?;
        let off = (self.evaluation["vx_mps"]["mean"].as_f64()? - command).abs();
        let falls = self.evaluation["fall_share"]["mean"].as_f64().is_some_and(|share| share > 0.5);
        Some((falls || off > 0.5 * command.abs(), self.missed()?.len(), off))
    }

    fn by_rank(&self, other: &Self) -> Ordering {
        let key = |run: &Self| run.rank().unwrap_or((true, usize::MAX, f64::INFINITY));
        let (a, b) = (key(self), key(other));
        (a.0, a.1).cmp(&(b.0, b.1)).then(a.2.total_cmp(&b.2))
    }

    /// Its figures.
    pub fn summary(&self) -> Value {
        let last = self.iterations.last();
        let robot = self.config.robot_path();
        let robot = robot.file_name().unwrap_or_default().to_string_lossy();
        json!({
            "run": self.name(),
            "folder": self.folder,
            "robot": robot.trim_end_matches(".robot.toml"),
            "state": self.state,
            "iteration": last.map(|i| i.iteration),
            "env_steps": last.map(|i| i.steps_total),
            "episode_return": last.and_then(|i| i.mean_return),
            "forward_mps": self.evaluation["vx_mps"]["mean"],
            "power_w": self.evaluation["power_w"]["mean"],
            "gates_missed": self.missed().map(|missed| missed.len()),
            "fall_share": self.evaluation["fall_share"]["mean"],
            "seconds": self.seconds,
            "changes": self.changes.change.len(),
        })
    }

    /// Its value after so many environment steps: the last one until then.
    fn at(&self, env_steps: u64, value: impl Fn(&Iteration) -> Option<f64>) -> Option<f64> {
        let until = self.iterations.partition_point(|i| i.steps_total <= env_steps);
        let reached = self.iterations.last()?.steps_total >= env_steps;
        self.iterations[..until].last().filter(|_| reached).and_then(value)
    }
}

/// The folders of the runs in a folder, by name: names begin with the time.
fn dirs(folder: &Path) -> Result<Vec<PathBuf>, Failure> {
    let entries = std::fs::read_dir(folder)
        .or_exit_with(ExitCode::NoInput, || format!("no runs in {}", folder.display()))
        .map_err(|failure| {
            failure.hint("`caudata train` makes one; give the folder that yours lie in")
        })?;
    let mut dirs: Vec<PathBuf> = entries
        .flatten()
        .map(|entry| entry.path())
        .filter(|path| path.join("run_id.txt").is_file() && path.join("config.toml").is_file())
        .collect();
    dirs.sort();
    Ok(dirs)
}

/// The runs in a folder, in that order.
fn within(folder: &Path) -> Result<Vec<Run>, Failure> {
    let read = |dir: PathBuf| match Run::read(&dir) {
        Ok(run) => Some(run),
        Err(failure) => {
            tracing::warn!("{} is left out: {failure}", dir.display());
            None
        }
    };
    Ok(dirs(folder)?.into_iter().filter_map(read).collect())
}

/// The run in a folder beside another one in the folder above it: without a name the names that there are, the
/// newest first, at most 100; with one, what [`compare`] finds and the other's return by environment steps.
///
/// # Errors
/// When a run cannot be read, or there is none of that name.
pub fn beside(run: &Path, other: Option<&str>) -> Result<Value, Failure> {
    /// Most points of a curve.
    const CURVE_POINTS: usize = 512;
    let run = run.canonicalize().or_exit(ExitCode::NoInput)?;
    let dirs = dirs(run.parent().unwrap_or(&run))?;
    let others = dirs.iter().rev().filter(|dir| **dir != run).take(100);
    let mut others = others.filter_map(|dir| Some((dir.file_name()?.to_str()?, dir)));
    let Some(other) = other else { return Ok(others.map(|(name, _)| name).collect()) };
    let found = others.find(|(name, _)| *name == other);
    let (_, dir) = found.ok_or_else(|| {
        Failure::message(ExitCode::NoInput, format!("there is no run {other} here"))
    })?;
    let runs = [Run::read(&run)?, Run::read(dir)?];
    let mut both = compared(&runs);
    let iterations = &runs[1].iterations;
    let every = iterations.len().div_ceil(CURVE_POINTS).max(1);
    let curve = iterations.iter().step_by(every);
    both["curve"] = curve.map(|i| json!([i.steps_total, i.mean_return])).collect();
    Ok(both)
}

fn compared(runs: &[Run]) -> Value {
    let longest = runs.iter().filter_map(|run| run.iterations.last()).map(|i| i.steps_total).max();
    let steps: Vec<u64> =
        (1..=POINTS).map(|k| longest.unwrap_or(0) * k as u64 / POINTS as u64).collect();
    let curve = |value: fn(&Iteration) -> Option<f64>| -> Vec<Vec<Option<f64>>> {
        let of = |&at: &u64| runs.iter().map(|run| run.at(at, value)).collect();
        steps.iter().map(of).collect()
    };
    let settings = differing(runs);
    json!({
        "runs": runs.iter().map(Run::summary).collect::<Vec<_>>(),
        "gates_missed": runs.iter().map(Run::missed).collect::<Vec<_>>(),
        "env_steps": steps,
        "episode_return": curve(|i| i.mean_return),
        "settings": settings.iter().map(|(key, values)| json!({ "key": key, "values": values })).collect::<Vec<_>>(),
    })
}

fn compare(runs: &[Run], as_json: bool) -> Result<(), Failure> {
    say::either(as_json, &compared(runs), |found| {
        let names: Vec<String> = runs.iter().map(Run::name).collect();
        let row = |first: String, cells: Vec<String>| [vec![first], cells].concat();
        let head = |first: &str| row(first.to_owned(), names.clone());
        say::line("return per episode after so many environment steps");
        let list = |value: &Value| value.as_array().cloned().unwrap_or_default();
        let rows = list(&found["env_steps"]).into_iter().zip(list(&found["episode_return"]));
        let rows = rows.map(|(at, values)| {
            let cells = list(&values).into_iter().map(|value| cell(&value.as_f64()));
            row(at.to_string(), cells.collect())
        });
        say::table(&[], std::iter::once(head("steps")).chain(rows));
        say::line("\nevaluation at the end");
        say::table(&[], std::iter::once(head("")).chain(evaluations(runs)));
        say::line("\nsettings that differ");
        let rows = differing(runs).into_iter();
        let rows = rows.map(|(key, values)| row(key, values));
        say::table(&[], std::iter::once(head("key")).chain(rows));
    })
}

/// A figure, or a dash where there is none.
fn cell(value: &Option<f64>) -> String {
    value.map_or_else(|| "-".to_owned(), say::short)
}

/// Rows of what the evaluations found, a run each column.
fn evaluations(runs: &[Run]) -> Vec<Vec<String>> {
    const FIGURES: [(&str, &str); 4] = [
        ("forward, m/s", "vx_mps"),
        ("power, W", "power_w"),
        ("cost of transport", "cost_of_transport"),
        ("falls", "fall_share"),
    ];
    let figure = |(name, key): (&str, &str)| {
        let of = |run: &Run| cell(&run.evaluation[key]["mean"].as_f64());
        std::iter::once(name.to_owned()).chain(runs.iter().map(of)).collect()
    };
    let missed = |run: &Run| match run.missed() {
        Some(missed) if missed.is_empty() => "none".to_owned(),
        Some(missed) => missed.join("; "),
        None => "-".to_owned(),
    };
    let gates = std::iter::once("gates missed".to_owned()).chain(runs.iter().map(missed));
    FIGURES.into_iter().map(figure).chain([gates.collect()]).collect()
}

/// The keys that do not have one value in all runs, with each run's.
fn differing(runs: &[Run]) -> Vec<(String, Vec<String>)> {
    let all: Vec<Vec<(String, String)>> = runs.iter().map(Run::settings).collect();
    let keys: BTreeSet<&String> = all.iter().flatten().map(|(key, _)| key).collect();
    let value = |entries: &Vec<(String, String)>, key: &String| {
        let found = entries.iter().find(|(name, _)| name == key);
        found.map_or_else(|| "-".to_owned(), |(_, value)| value.clone())
    };
    keys.into_iter()
        .filter(|key| !INCIDENTAL.iter().any(|prefix| key.starts_with(prefix)))
        .map(|key| (key.clone(), all.iter().map(|entries| value(entries, key)).collect::<Vec<_>>()))
        .filter(|(_, values)| values.iter().any(|value| *value != values[0]))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn run(dir: &Path, name: &str, gamma: &str, missed: bool, speed: f64) -> PathBuf {
        let folder = dir.join(name);
        std::fs::create_dir(&folder).unwrap();
        std::fs::write(folder.join("run_id.txt"), name).unwrap();
        std::fs::write(folder.join("config.toml"), format!("[learner.ppo]\ngamma = {gamma}\n"))
            .unwrap();
        let lines: Vec<String> = (1..=20)
            .map(|number| {
                let iteration = Iteration {
                    iteration: number,
                    iterations: 20,
                    steps_total: 100 * number,
                    mean_return: Some(number as f64),
                    ..Iteration::default()
                };
                serde_json::to_string(&Event::Iteration(Box::new(iteration))).unwrap()
            })
            .collect();
        std::fs::write(folder.join(PROGRESS), lines.join("\n")).unwrap();
        let report = json!({ "evaluation": {
            "vx_mps": { "mean": speed }, "command": [0.3, 0, 0],
            "gates": { "gates": [{ "name": "slip", "met": !missed }] },
        }});
        std::fs::write(folder.join("report.json"), report.to_string()).unwrap();
        folder
    }

    #[test]
    fn the_best_misses_fewest_gates_and_then_keeps_its_command_best() {
        let dir = tempfile::tempdir().unwrap();
        run(dir.path(), "a", "0.97", true, 0.3);
        run(dir.path(), "b", "0.97", false, 0.2);
        run(dir.path(), "c", "0.97", false, 0.35);
        run(dir.path(), "d", "0.97", false, 0.1);
        std::fs::create_dir(dir.path().join("no run")).unwrap();
        let runs = within(dir.path()).unwrap();
        assert_eq!(runs.len(), 4);
        let best = runs.iter().min_by(|a, b| a.by_rank(b)).unwrap();
        assert_eq!((best.name().as_str(), best.rank().unwrap().1), ("c", 0));
        assert_eq!(runs.iter().max_by(|a, b| a.by_rank(b)).unwrap().name(), "d", "it hardly moves");
        assert_eq!(runs[0].missed(), Some(vec!["slip".to_owned()]));
    }

    #[test]
    fn only_what_differs_is_compared_and_curves_end_where_a_run_ends() {
        let dir = tempfile::tempdir().unwrap();
        let folders =
            [run(dir.path(), "a", "0.97", false, 0.3), run(dir.path(), "b", "0.9", false, 0.3)];
        let runs: Vec<Run> = folders.iter().map(|folder| Run::read(folder).unwrap()).collect();
        let found = differing(&runs);
        assert_eq!(
            found,
            [("learner.ppo.gamma".to_owned(), vec!["0.97".to_owned(), "0.9".to_owned()])]
        );
        assert_eq!(runs[0].at(1000, |i| i.mean_return), Some(10.0));
        assert_eq!(runs[0].at(3000, |i| i.mean_return), None);
    }
}
