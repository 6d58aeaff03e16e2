//! `caudata sweep`: one training for each seed and each point of a grid of settings, and a table of them.

use std::collections::BTreeSet;
use std::path::PathBuf;

use caudata_config::{Config, ConfigArgs};
use caudata_studies::steps::{Steps, Training};
use caudata_studies::{files, flags};
use caudata_telemetry::{ExitCode, Failure, FailureExt, Process};
use clap::Args;
use serde_json::{Value, json};

use crate::commands::runs::Run;
use crate::say;

/// Trainings of one sweep.
const RUNS_MAX: usize = 1_000;

#[derive(Debug, Args)]
pub struct Plan {
    /// The folder that the runs lie in; trainings that are complete in it are not done again, others go on
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// A setting and its values, for instance task.reward.weights.bend=[-0.5, -1.0]; several make a grid
    #[arg(long = "vary", value_name = "KEY=[VALUE, …]")]
    vary: Vec<String>,
    /// Trainings of each setting, with seeds one after the other
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u64).range(1..=1000))]
    seeds: u64,
    /// First of the seeds
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u64).range(..=1_000_000))]
    first_seed: u64,
    /// What is trained; the preset `quick` without these flags
    #[command(flatten)]
    config: ConfigArgs,
}

/// One training.
struct Point {
    name: String,
    seed: u64,
    /// `key=value` of each varied setting.
    set: Vec<String>,
    config: Config,
}

pub fn run(plan: &Plan, as_json: bool, process: &Process) -> Result<(), Failure> {
    let flags = flags::or_preset(&plan.config, "quick");
    let points = points(plan, &flags)?;
    files::make_folder(&plan.out)?;
    let program = std::env::current_exe().or_exit(ExitCode::Internal)?;
    let again = "the same command goes on where it was stopped";
    let mut steps = Steps::new(program, true, &process.stop, again, |_| ());
    let mut share = say::Share::new("trainings", points.len());
    let mut done = Vec::new();
    for point in &points {
        let run = trained(plan, &flags, point, &mut steps)?;
        let row = row(point, &run);
        if !as_json {
            share.above(|| say::record(&row, "run gates_missed episode_return seconds"));
        }
        share.one_more();
        done.push(row);
    }
    drop(share);
    let settings = summary(&points, &done);
    let found = json!({ "runs": done, "settings": settings });
    say::either(as_json, &found, |_| {
        say::line("");
        say::records(&settings, "setting runs gates_met episode_return forward_mps seconds");
    })
}

/// Trains one to its end. Missed gates are an answer, too.
fn trained(
    plan: &Plan,
    flags: &ConfigArgs,
    point: &Point,
    steps: &mut Steps<'_>,
) -> Result<Run, Failure> {
    let robot = point.config.robot_path();
    let judged = &point.config.evaluation;
    let mut set = vec![
        format!("evaluation.episodes={}", judged.episodes),
        format!("evaluation.robot_run_s={:?}", judged.robot_run_s),
    ];
    set.extend_from_slice(&point.set);
    let out = plan.out.join(&point.name);
    let training = Training {
        flags,
        robot: &robot,
        start: None,
        iterations: point.config.run.iterations,
        seed: Some(point.seed),
        set: &set,
        progress: Some(plan.out.join(format!("{}.log", point.name))),
        out: out.clone(),
    };
    if let Err(failure) = steps.train(&point.name, &training) {
        if training.finished().is_none() {
            let log = plan.out.join(format!("{}.log", point.name));
            return Err(failure.hint(format!("what it printed is in {}", log.display())));
        }
        // trained and evaluated; the robot client did not run it
        tracing::warn!("{}: {failure}", point.name);
    }
    let run = Run::read(&out)?;
    let length = |config: &Config| config.run.iterations;
    if run.config.hash() != point.config.hash() || length(&run.config) != length(&point.config) {
        let message = format!("{} holds a training with other settings", out.display());
        return Err(Failure::message(ExitCode::CannotCreate, message)
            .hint("give another --out, or take that folder away"));
    }
    Ok(run)
}

/// Every seed of every point of the grid.
fn points(plan: &Plan, flags: &ConfigArgs) -> Result<Vec<Point>, Failure> {
    let axes: Vec<(String, Vec<String>)> =
        plan.vary.iter().map(|vary| axis(vary)).collect::<Result<_, _>>()?;
    let last = |key: &str| key.rsplit('.').next().unwrap_or_default().to_owned();
    let short: BTreeSet<String> = axes.iter().map(|(key, _)| last(key)).collect();
    let count = axes.iter().fold(1_u64, |all, (_, values)| all.saturating_mul(values.len() as u64));
    let keys: BTreeSet<&String> = axes.iter().map(|(key, _)| key).collect();
    if keys.len() < axes.len() || keys.iter().any(|key| *key == "run.seed") {
        let message = "--vary takes every key once, and `run.seed` is for --seeds";
        return Err(Failure::message(ExitCode::BadConfig, message));
    }
    if count.saturating_mul(plan.seeds) > RUNS_MAX as u64 {
        let message =
            format!("{count} settings times {} seeds: at most {RUNS_MAX} trainings", plan.seeds);
        return Err(Failure::message(ExitCode::BadConfig, message));
    }
    let mut grid: Vec<Vec<(String, String)>> = vec![Vec::new()];
    for (key, values) in &axes {
        let with = |point: &Vec<(String, String)>| {
            let more = values.iter().map(|value| (key.clone(), value.clone()));
            more.map(|set| [point.clone(), vec![set]].concat()).collect::<Vec<_>>()
        };
        grid = grid.iter().flat_map(with).collect();
    }
    let mut points = Vec::new();
    for point in &grid {
        let set: Vec<String> = point.iter().map(|(k, v)| format!("{k}={v}")).collect();
        for seed in plan.first_seed..plan.first_seed + plan.seeds {
            let mut source = flags.source();
            source.overrides.extend(set.iter().cloned());
            source.overrides.push(format!("run.seed={seed}"));
            let word = |(key, value): &(String, String)| match short.len() == axes.len() {
                true => format!("{}={value}", last(key)),
                false => format!("{key}={value}"),
            };
            let words: Vec<String> = point.iter().map(word).collect();
            let plain = |c: char| {
                if c.is_ascii_alphanumeric() || "=.-_".contains(c) { c } else { '_' }
            };
            let name = [words, vec![format!("seed={seed}")]].concat().join("_");
            points.push(Point {
                name: name.chars().map(plain).collect(),
                seed,
                set: set.clone(),
                config: Config::load(&source).or_exit(ExitCode::BadConfig)?,
            });
        }
    }
    Ok(points)
}

/// `KEY=[VALUE, …]`.
fn axis(vary: &str) -> Result<(String, Vec<String>), Failure> {
    let wrong = || {
        let message = format!(
            "--vary {vary}: must be KEY=[VALUE, …], for instance learner.ppo.clip=[0.1, 0.2]"
        );
        Failure::message(ExitCode::BadConfig, message)
    };
    let (key, values) = vary.split_once('=').ok_or_else(wrong)?;
    // Numbers, words in quotes and lists of them are written alike in JSON and in TOML.
    let values: Vec<Value> = serde_json::from_str(values).map_err(|_| wrong())?;
    if values.is_empty() {
        return Err(wrong());
    }
    let key = key.trim().to_owned();
    Ok((key, values.iter().map(ToString::to_string).collect()))
}

fn row(point: &Point, run: &Run) -> Value {
    let mut row = run.summary();
    row["run"] = json!(point.name);
    row["seed"] = json!(point.seed);
    row["set"] = json!(point.set);
    row
}

/// A row for each setting: of its seeds, how many meet every gate, and medians.
fn summary(points: &[Point], rows: &[Value]) -> Vec<Value> {
    let mut settings: Vec<&Vec<String>> = points.iter().map(|point| &point.set).collect();
    settings.dedup();
    let of = |set: &Vec<String>| -> Value {
        let own = points.iter().zip(rows).filter(|(point, _)| point.set == *set);
        let own: Vec<&Value> = own.map(|(_, row)| row).collect();
        let median = |key: &str| {
            let mut values: Vec<f64> = own.iter().filter_map(|row| row[key].as_f64()).collect();
            values.sort_by(f64::total_cmp);
            let n = values.len();
            (n > 0).then(|| 0.5 * (values[(n - 1) / 2] + values[n / 2]))
        };
        let met = own.iter().filter(|row| row["gates_missed"] == 0).count();
        json!({
            "setting": if set.is_empty() { "as configured".to_owned() } else { set.join(", ") },
            "runs": own.len(),
            "gates_met": met,
            "episode_return": median("episode_return"),
            "forward_mps": median("forward_mps"),
            "seconds": median("seconds"),
        })
    };
    settings.into_iter().map(of).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn plan(vary: &[&str], seeds: u64) -> Plan {
        Plan {
            out: "out".into(),
            vary: vary.iter().map(|&v| v.to_owned()).collect(),
            seeds,
            first_seed: 7,
            config: ConfigArgs::default(),
        }
    }

    fn names(vary: &[&str], seeds: u64) -> Result<Vec<String>, Failure> {
        let plan = plan(vary, seeds);
        let found = points(&plan, &plan.config)?;
        Ok(found.into_iter().map(|point| point.name).collect())
    }

    #[test]
    fn a_grid_has_every_value_with_every_other_and_every_seed() {
        let vary = ["learner.ppo.clip=[0.1, 0.2]", "task.command.vx_mps=[[0.0, 0.5]]"];
        let found = names(&vary, 2).unwrap();
        assert_eq!(
            found,
            [
                "clip=0.1_vx_mps=_0.0_0.5__seed=7",
                "clip=0.1_vx_mps=_0.0_0.5__seed=8",
                "clip=0.2_vx_mps=_0.0_0.5__seed=7",
                "clip=0.2_vx_mps=_0.0_0.5__seed=8",
            ]
        );
        assert_eq!(names(&[], 1).unwrap(), ["seed=7"]);
    }

    #[test]
    fn what_is_no_list_or_no_setting_is_refused_before_anything_is_trained() {
        for vary in [
            "learner.ppo.clip",
            "learner.ppo.clip=0.1",
            "learner.ppo.clip=[]",
            "learner.ppo.clop=[1]",
            "learner.ppo.clip=[7]",
        ] {
            let refused = names(&[vary], 1).unwrap_err();
            assert_eq!(refused.code(), ExitCode::BadConfig, "{vary}");
        }
        assert!(names(&["learner.ppo.epochs=[1, 2, 3]"], 500).is_err());
    }

    #[test]
    fn medians_are_over_the_seeds_of_a_setting() {
        let plan = plan(&["learner.ppo.clip=[0.1, 0.2]"], 3);
        let points = points(&plan, &plan.config).unwrap();
        let rows: Vec<Value> = [0, 2, 0, 1, 1, 1]
            .iter()
            .zip([1.0, 5.0, 2.0, 9.0, 9.0, 9.0])
            .map(|(missed, gain)| json!({ "gates_missed": missed, "episode_return": gain }))
            .collect();
        let found = summary(&points, &rows);
        assert_eq!(found.len(), 2);
        assert_eq!(found[0]["gates_met"], 2);
        assert_eq!(found[0]["episode_return"], 2.0);
        assert_eq!(found[1]["gates_met"], 0);
    }
}
