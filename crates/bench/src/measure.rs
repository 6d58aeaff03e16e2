//! How everything here is measured: for a given time, in rounds, with the wall and CPU time that it takes.

use std::time::Instant;

use caudata_telemetry::{ExitCode, Failure, FailureExt};
use nix::sys::resource::{UsageWho, getrusage};
use nix::sys::time::TimeValLike;
use serde::Serialize;
use serde_json::Value;

/// What the kernel counts CPU time of other processes in; the same on every Linux that Rust knows.
const TICKS_PER_S: f64 = 100.0;

/// How often something is done in a second.
#[derive(Clone, Debug, Serialize)]
pub struct Rate {
    /// Which benchmark.
    pub benchmark: &'static str,
    /// Units of work done per second.
    pub per_second: f64,
    /// What one unit is.
    pub unit: &'static str,
    /// Rounds measured.
    pub rounds: usize,
    /// Time measured, s.
    pub seconds: f64,
    /// Median time of a round, s.
    pub round_median_s: f64,
    /// 99th percentile of it, s.
    pub round_p99_s: f64,
    /// Sizes that matter.
    pub settings: Value,
}

/// Repeats `round`, which does so many `units` of work, for so many seconds, after one round to warm up.
///
/// # Errors
/// Those of `round`.
pub fn rate(
    benchmark: &'static str,
    (unit, units): (&'static str, u32),
    seconds: f64,
    settings: Value,
    mut round: impl FnMut() -> Result<(), Failure>,
) -> Result<Rate, Failure> {
    round()?;
    let mut times_s = Vec::new();
    let began = Instant::now();
    until(seconds, || {
        let round_began = Instant::now();
        round()?;
        times_s.push(round_began.elapsed().as_secs_f64());
        Ok(())
    })?;
    let seconds = began.elapsed().as_secs_f64();
    let rounds = times_s.len();
    times_s.sort_by(f64::total_cmp);
    let quantile = |q| quantile(&times_s, q).unwrap_or(f64::NAN);
    Ok(Rate {
        benchmark,
        per_second: rounds as f64 * f64::from(units) / seconds,
        unit,
        rounds,
        seconds,
        round_median_s: quantile(0.5),
        round_p99_s: quantile(0.99),
        settings,
    })
}

/// Repeats `round` at least once and until so many seconds are over.
///
/// # Errors
/// Those of `round`.
pub fn until(seconds: f64, mut round: impl FnMut() -> Result<(), Failure>) -> Result<(), Failure> {
    let began = Instant::now();
    loop {
        round()?;
        if began.elapsed().as_secs_f64() >= seconds {
            return Ok(());
        }
    }
}

/// The value at a share of sorted ones; `None` where there are none.
pub fn quantile(sorted: &[f64], q: f64) -> Option<f64> {
    let last = sorted.len().checked_sub(1)?;
    sorted.get((last as f64 * q).round() as usize).copied()
}

/// The middle one, the upper of two; `None` where there are none.
pub fn median(mut values: Vec<f64>) -> Option<f64> {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied()
}

/// What work took.
#[derive(Clone, Copy, Debug)]
pub struct Cost {
    /// Wall time, s.
    pub wall_s: f64,
    /// CPU time, s.
    pub cpu_s: f64,
}

impl Cost {
    /// Measures the cost of `work`, by what `cpu_s` says before and after it.
    ///
    /// # Errors
    /// Those of `work`, and where the system does not tell.
    pub fn of<T>(
        cpu_s: impl Fn() -> Result<f64, Failure>,
        work: impl FnOnce() -> Result<T, Failure>,
    ) -> Result<(T, Self), Failure> {
        let (began, before_s) = (Instant::now(), cpu_s()?);
        let done = work()?;
        let cost = Self { wall_s: began.elapsed().as_secs_f64(), cpu_s: cpu_s()? - before_s };
        Ok((done, cost))
    }
}

/// CPU time of this process so far, s.
///
/// # Errors
/// When the system does not tell.
pub fn own_cpu_s() -> Result<f64, Failure> {
    cpu_s(UsageWho::RUSAGE_SELF)
}

/// CPU time of this thread so far, s.
///
/// # Errors
/// When the system does not tell.
pub fn thread_cpu_s() -> Result<f64, Failure> {
    cpu_s(UsageWho::RUSAGE_THREAD)
}

fn cpu_s(who: UsageWho) -> Result<f64, Failure> {
    let usage = getrusage(who).or_exit(ExitCode::Internal)?;
    let micros = usage.user_time().num_microseconds() + usage.system_time().num_microseconds();
    Ok(micros as f64 / 1e6)
}

/// CPU time of process `pid` so far, all threads, user and system, s.
pub fn cpu_s_of(pid: u32) -> Option<f64> {
    let text = std::fs::read_to_string(format!("/proc/{pid}/stat")).ok()?;
    // The second field is the name in brackets, which may have spaces; utime and stime are the 14th and 15th.
    let rest = text.rsplit_once(") ")?.1;
    let mut fields = rest.split(' ').skip(11);
    let mut ticks = || fields.next()?.parse::<f64>().ok();
    Some((ticks()? + ticks()?) / TICKS_PER_S)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles_by_hand() {
        let sorted = [1.0, 2.0, 3.0, 4.0, 5.0];
        assert_eq!(quantile(&sorted, 0.5), Some(3.0));
        assert_eq!((quantile(&sorted, 0.99), quantile(&[], 0.5)), (Some(5.0), None));
        assert_eq!(median(vec![3.0, 1.0]), Some(3.0));
    }

    #[test]
    fn rounds_are_counted_and_one_warms_up() {
        let mut rounds = 0;
        let found = rate("test", ("things", 3), 0.0, Value::Null, || {
            rounds += 1;
            Ok(())
        });
        let found = found.unwrap();
        assert_eq!((rounds, found.rounds), (2, 1));
        assert!((found.per_second * found.seconds - 3.0).abs() < 1e-9);
    }
}
