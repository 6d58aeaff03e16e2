//! `caudata bench lag`: trainings whose data is a forced number of iterations old (`actors.lockstep`), with the decoupled loss and
//! with plain PPO; the final return of each beside that of fresh data.

use std::io::{BufRead, BufReader};
use std::process::{Command, Stdio};

use caudata_config::{ConfigArgs, Returns};
use caudata_telemetry::progress::{Event, MeanSe};
use caudata_telemetry::{ExitCode, Failure, FailureExt, PARENT_PID_VAR};
use clap::Args;
use serde::Serialize;

use super::bench::{as_flags, load, or_quick};
use crate::commands::train::Programs;
use crate::say;

/// The words of `learner.staleness.correction`, and what they are called here.
const LOSSES: [(&str, &str); 2] = [("decoupled", "decoupled"), ("none", "plain")];

#[derive(Debug, Args)]
pub struct LagBench {
    /// Iterations that the data is old, separated by commas; each at most 8. 0 is what others are compared with
    #[arg(long, value_delimiter = ',', default_values_t = [0, 1, 2, 4, 8], value_parser = clap::value_parser!(u32).range(0..=8))]
    lags: Vec<u32>,
    /// Trainings of each, with seeds 1, 2, …
    #[arg(long, default_value_t = 3, value_parser = clap::value_parser!(u64).range(1..=100))]
    seeds: u64,
    /// Iterations of each training; otherwise as the configuration says
    #[arg(long)]
    iterations: Option<u64>,
    /// One JSON object on the last line
    #[arg(long)]
    json: bool,
    /// What is trained; the preset `quick` without these flags
    #[command(flatten)]
    config: ConfigArgs,
}

/// One training.
#[derive(Clone, Debug, Serialize)]
struct Run {
    lag: u32,
    loss: &'static str,
    seed: u64,
    /// Return of a whole episode over the last tenth of the iterations.
    last_tenth_return: MeanSe,
    /// Largest lag that the learner reported.
    lag_seen: u64,
    /// Smallest effective sample share.
    effective_share_min: f64,
    seconds: f64,
}

/// All trainings of one lag and loss.
#[derive(Debug, Serialize)]
struct Row {
    lag: u32,
    loss: &'static str,
    /// Mean over the seeds.
    last_tenth_return: f64,
    /// Of the mean at lag 0 with the same loss; null where that was not run.
    share_of_fresh: Option<f64>,
}

#[derive(Debug, Serialize)]
struct Finding {
    benchmark: &'static str,
    /// `learner.staleness.returns` of every training.
    returns: Returns,
    rows: Vec<Row>,
    runs: Vec<Run>,
}

pub fn run(args: &LagBench) -> Result<(), Failure> {
    let returns = load(&or_quick(&args.config))?.learner.staleness.returns;
    let mut runs: Vec<Run> = Vec::new();
    for lag in &args.lags {
        for loss in LOSSES {
            for seed in 1..=args.seeds {
                let run = train(args, *lag, loss, seed)?;
                if !args.json {
                    say::line(format_args!(
                        "lag {} {} seed {}: return {:.2} ± {:.2}, least effective share {:.2}, {:.0} s",
                        run.lag,
                        run.loss,
                        run.seed,
                        run.last_tenth_return.mean,
                        run.last_tenth_return.standard_error,
                        run.effective_share_min,
                        run.seconds
                    ));
                }
                runs.push(run);
            }
        }
    }
    let finding = Finding {
        benchmark: "lag",
        returns,
        rows: rows(&runs),
        runs,
    };
    if args.json {
        return say::json(&finding);
    }
    let header = ["lag", "loss", "return", "of lag 0"];
    let mut table = vec![header.map(str::to_owned).to_vec()];
    for row in &finding.rows {
        let share = row.share_of_fresh;
        table.push(vec![
            row.lag.to_string(),
            row.loss.to_owned(),
            format!("{:.2}", row.last_tenth_return),
            share.map_or("-".to_owned(), |share| format!("{:.0} %", 100.0 * share)),
        ]);
    }
    say::line(format_args!("returns of older data: {returns:?}"));
    say::table(&table);
    Ok(())
}

fn rows(runs: &[Run]) -> Vec<Row> {
    let mean = |lag: u32, loss: &str| {
        let of: Vec<f64> = runs
            .iter()
            .filter(|run| run.lag == lag && run.loss == loss)
            .map(|run| run.last_tenth_return.mean)
            .collect();
        (!of.is_empty()).then(|| of.iter().sum::<f64>() / of.len() as f64)
    };
    let mut rows: Vec<Row> = Vec::new();
    for run in runs {
        if rows
            .iter()
            .any(|row| (row.lag, row.loss) == (run.lag, run.loss))
        {
            continue;
        }
        let Some(of_all) = mean(run.lag, run.loss) else {
            continue;
        };
        rows.push(Row {
            lag: run.lag,
            loss: run.loss,
            last_tenth_return: of_all,
            share_of_fresh: mean(0, run.loss).map(|fresh| of_all / fresh),
        });
    }
    rows
}

fn train(
    args: &LagBench,
    lag: u32,
    (correction, loss): (&str, &'static str),
    seed: u64,
) -> Result<Run, Failure> {
    let folder = tempfile::tempdir().or_exit(ExitCode::CannotCreate)?;
    let mut command = Command::new(Programs::beside_this_one()?.find("caudata-learner")?);
    command
        .args(as_flags(&or_quick(&args.config)))
        .args([
            "--inproc",
            "--log-filter",
            "error",
            "--run-id",
            "lag",
            "--run-dir",
        ])
        .arg(folder.path());
    let mut sets = vec![
        "transport.kind=inproc".to_owned(),
        "actors.lockstep=true".to_owned(),
        "telemetry.metrics=false".to_owned(),
        format!("actors.max_lead={lag}"),
        format!("learner.staleness.max_lag={lag}"),
        format!("learner.staleness.correction={correction}"),
        format!("run.seed={seed}"),
    ];
    if let Some(iterations) = args.iterations {
        sets.push(format!("run.iterations={iterations}"));
    }
    for set in &sets {
        command.args(["--set", set]);
    }
    let mut child = command
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .env(PARENT_PID_VAR, std::process::id().to_string())
        .spawn()
        .or_exit(ExitCode::OsResource)?;
    let (mut finished, mut lag_seen, mut effective_share_min) = (None, 0, f64::INFINITY);
    if let Some(stdout) = child.stdout.take() {
        for line in BufReader::new(stdout).lines() {
            match serde_json::from_str(&line.or_exit(ExitCode::Internal)?) {
                Ok(Event::Iteration(iteration)) => {
                    lag_seen = iteration.lag_max.max(lag_seen);
                    effective_share_min = iteration.effective_share.min(effective_share_min);
                }
                Ok(Event::Finished(last)) => finished = Some(last),
                // Checkpoints, warnings, and what later versions may say.
                _ => {}
            }
        }
    }
    let status = child.wait().or_exit(ExitCode::OsResource)?;
    let what = format!("the training with lag {lag}, loss {loss}, seed {seed}");
    let failed = |why: String| Failure::message(ExitCode::Internal, format!("{what} {why}"));
    let finished = finished
        .filter(|_| status.success())
        .ok_or_else(|| failed(format!("ended with {status}")))?;
    if lag_seen != u64::from(lag) {
        return Err(failed(format!("had a lag of {lag_seen}")));
    }
    Ok(Run {
        lag,
        loss,
        seed,
        last_tenth_return: finished.last_tenth_return.ok_or_else(|| {
            failed("is too short to have a last tenth".to_owned())
                .hint("give --iterations of 20 and more, long enough for episodes to end")
        })?,
        lag_seen,
        effective_share_min,
        seconds: finished.wall_s,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_loss_is_compared_with_its_own_fresh_data() {
        let run = |lag, loss, seed, mean| Run {
            lag,
            loss,
            seed,
            last_tenth_return: MeanSe {
                mean,
                standard_error: 0.0,
                n: 1,
            },
            lag_seen: u64::from(lag),
            effective_share_min: 1.0,
            seconds: 1.0,
        };
        let runs = [
            run(0, "decoupled", 1, 9.0),
            run(0, "decoupled", 2, 11.0),
            run(4, "decoupled", 1, 9.5),
            run(4, "decoupled", 2, 9.5),
            run(4, "plain", 1, 5.0),
        ];
        let rows: Vec<_> = rows(&runs)
            .iter()
            .map(|row| (row.lag, row.loss, row.last_tenth_return, row.share_of_fresh))
            .collect();
        assert_eq!(
            rows,
            [
                (0, "decoupled", 10.0, Some(1.0)),
                (4, "decoupled", 9.5, Some(0.95)),
                (4, "plain", 5.0, None),
            ]
        );
    }
}
