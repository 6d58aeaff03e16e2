//! `caudata bench lag`: trainings whose data is a forced number of iterations old (`actors.lockstep`), with
//! the decoupled loss and with plain PPO; the final return of each beside that of fresh data.

use std::path::Path;

use caudata_config::{ConfigArgs, Returns};
use caudata_telemetry::progress::{Event, MeanSe};
use caudata_telemetry::{ExitCode, Failure};
use clap::Args;
use serde::Serialize;

use crate::{parts, training};

/// The words of `learner.staleness.correction`, and what they are called here.
const LOSSES: [(&str, &str); 2] = [("decoupled", "decoupled"), ("none", "plain")];

/// Which trainings.
#[derive(Clone, Debug, Args)]
pub struct Plan {
    /// Iterations that the data is old, separated by commas; each at most 8. 0 is what others are compared
    /// with
    #[arg(long, value_delimiter = ',', default_values_t = [0, 1, 2, 4, 8], value_parser = clap::value_parser!(u32).range(0..=8))]
    lags: Vec<u32>,
    /// Trainings of each, with seeds 1, 2, …
    #[arg(long, default_value_t = 3, value_parser = clap::value_parser!(u64).range(1..=100))]
    seeds: u64,
    /// Iterations of each training; otherwise as the configuration says
    #[arg(long)]
    iterations: Option<u64>,
    /// What is trained; the preset `quick` without these flags
    #[command(flatten)]
    config: ConfigArgs,
}

/// One training.
#[derive(Clone, Debug, Serialize)]
pub struct Run {
    /// Iterations that its data was old.
    pub lag: u32,
    /// `decoupled` or `plain`.
    pub loss: &'static str,
    /// Its seed.
    pub seed: u64,
    /// Return of a whole episode over the last tenth of the iterations.
    pub last_tenth_return: MeanSe,
    /// Largest lag that the learner reported.
    pub lag_seen: u64,
    /// Smallest effective sample share.
    pub effective_share_min: f64,
    /// Wall time.
    pub seconds: f64,
}

/// All trainings of one lag and loss.
#[derive(Clone, Debug, Serialize)]
pub struct Row {
    /// Iterations that the data was old.
    pub lag: u32,
    /// `decoupled` or `plain`.
    pub loss: &'static str,
    /// Mean over the seeds.
    pub last_tenth_return: f64,
    /// Share of the mean at lag 0 with the same loss; null where that was not run.
    pub share_of_fresh: Option<f64>,
}

/// All trainings.
#[derive(Clone, Debug, Serialize)]
pub struct Finding {
    /// `lag`.
    pub benchmark: &'static str,
    /// `learner.staleness.returns` of every training.
    pub returns: Returns,
    /// By lag and loss.
    pub rows: Vec<Row>,
    /// Each by itself.
    pub runs: Vec<Run>,
}

/// Trains with each lag, loss and seed by the program `learner`; `tell` hears of each training when it has
/// ended.
///
/// # Errors
/// Where a training fails, is too short, or did not have its lag.
pub fn run(plan: &Plan, learner: &Path, tell: &mut dyn FnMut(&Run)) -> Result<Finding, Failure> {
    let returns = parts::config(&plan.config)?.learner.staleness.returns;
    let mut runs: Vec<Run> = Vec::new();
    for lag in &plan.lags {
        for loss in LOSSES {
            for seed in 1..=plan.seeds {
                let run = train(plan, learner, *lag, loss, seed)?;
                tell(&run);
                runs.push(run);
            }
        }
    }
    Ok(Finding {
        benchmark: "lag",
        returns,
        rows: rows(&runs),
        runs,
    })
}

fn rows(runs: &[Run]) -> Vec<Row> {
    let mean = |lag: u32, loss: &str| {
        let of = runs.iter().filter(|run| (run.lag, run.loss) == (lag, loss));
        let of: Vec<f64> = of.map(|run| run.last_tenth_return.mean).collect();
        (!of.is_empty()).then(|| of.iter().sum::<f64>() / of.len() as f64)
    };
    let mut kinds: Vec<(u32, &'static str)> = runs.iter().map(|run| (run.lag, run.loss)).collect();
    kinds.dedup();
    let row = |(lag, loss)| {
        let last_tenth_return = mean(lag, loss)?;
        Some(Row {
            lag,
            loss,
            last_tenth_return,
            share_of_fresh: mean(0, loss).map(|fresh| last_tenth_return / fresh),
        })
    };
    kinds.into_iter().filter_map(row).collect()
}

fn train(
    plan: &Plan,
    learner: &Path,
    lag: u32,
    (correction, loss): (&str, &'static str),
    seed: u64,
) -> Result<Run, Failure> {
    let mut sets = vec![
        "transport.kind=inproc".to_owned(),
        "actors.lockstep=true".to_owned(),
        "telemetry.metrics=false".to_owned(),
        format!("actors.max_lead={lag}"),
        format!("learner.staleness.max_lag={lag}"),
        format!("learner.staleness.correction={correction}"),
        format!("run.seed={seed}"),
    ];
    if let Some(iterations) = plan.iterations {
        sets.push(format!("run.iterations={iterations}"));
    }
    let (mut finished, mut lag_seen, mut effective_share_min) = (None, 0, f64::INFINITY);
    let hear = |_, event| match event {
        Event::Iteration(iteration) => {
            lag_seen = iteration.lag_max.max(lag_seen);
            effective_share_min = iteration.effective_share.min(effective_share_min);
        }
        Event::Finished(last) => finished = Some(last),
        // Checkpoints and warnings.
        _ => {}
    };
    let status = training::run(learner, &plan.config, &sets, "lag", hear)?;
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
