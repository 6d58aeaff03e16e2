//! The three gates that a cause must pass, on held-out runs: significant, relevant, general.

use caudata_random::{Key, Purpose, Stream};

use super::judge::Judge;
use super::state::{Context, On, State};
use crate::replay::Term;

/// Resamplings.
const RESAMPLES: usize = 400;
/// Gain on held-out runs that counts, as a share of their misfit.
pub const RELATIVE_GAIN: f64 = 0.06;
/// The same in units of the floor.
pub const ABSOLUTE_GAIN: f64 = 0.12;
/// A gain that comes from so few blocks is an incident, not an effect: the largest block's share.
const ONE_BLOCK: f64 = 0.6;

/// What a step is worth.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Worth {
    /// Fall of the misfit on fit runs.
    pub fit: f64,
    /// On held-out runs.
    pub holdout: f64,
    /// Lower end of that (0.5 %).
    pub low: f64,
    /// 95 % interval of that.
    pub interval: (f64, f64),
    /// Whether all gates are passed.
    pub passed: bool,
    /// Which gate failed first; empty if none.
    pub why: &'static str,
}

/// What going from `from` to `to` is worth.
#[must_use]
pub fn worth(context: &Context, from: &State, to: &State) -> Worth {
    let fit = from.fit.misfit - to.fit.misfit;
    let holdout = from.holdout.misfit - to.holdout.misfit;
    let gains = block_gains(&context.holdout, &from.holdout, &to.holdout);
    let sorted = resampled(&gains, context.seed, context.holdout.data.len());
    let at = |share: f64| {
        let k = (share * sorted.len() as f64) as usize;
        sorted
            .get(k.min(sorted.len().saturating_sub(1)))
            .copied()
            .unwrap_or(0.0)
    };
    let total: f64 = gains.iter().sum();
    let largest = gains.iter().copied().fold(0.0, f64::max);
    let low = at(0.005);
    let why = if fit <= 0.0 {
        "no gain on the runs it was fitted to"
    } else if holdout <= 0.0 {
        "makes held-out runs worse"
    } else if low <= 0.0 {
        "its gain on held-out runs is within what resampling gives by chance"
    } else if holdout < RELATIVE_GAIN * from.holdout.misfit || holdout < ABSOLUTE_GAIN {
        "its gain on held-out runs is too small to matter"
    } else if largest > ONE_BLOCK * total && gains.len() > 4 {
        "its gain comes from one second of one run"
    } else if fit < 0.2 * RELATIVE_GAIN * from.fit.misfit {
        "its gain on the runs it was fitted to is too small to matter"
    } else {
        ""
    };
    Worth {
        fit,
        holdout,
        low,
        interval: (at(0.025), at(0.975)),
        passed: why.is_empty(),
        why,
    }
}

/// Whether a term is far enough from nothing to matter.
#[must_use]
pub fn matters(context: &Context, term: &Term) -> bool {
    let model = context.replayer.model();
    let neutral = term.effect.neutral(model, &term.place);
    (0..term.values.len()).any(|p| {
        (term.values[p] - neutral[p]).abs() >= term.effect.scale(model, &term.place, p).abs()
    })
}

/// Per block: fall of the summed squares.
fn block_gains(judge: &Judge, from: &On, to: &On) -> Vec<f64> {
    judge.by_block(|k| f64::from(from.residual[k]).powi(2) - f64::from(to.residual[k]).powi(2))
}

/// Mean gains per sample of blocks drawn with replacement, sorted.
fn resampled(gains: &[f64], seed: u64, samples: usize) -> Vec<f64> {
    let mut stream = Stream::new(Key::for_run(seed), Purpose::Minibatch);
    let n = gains.len();
    if n == 0 {
        return Vec::new();
    }
    let mut out: Vec<f64> = (0..RESAMPLES)
        .map(|_| {
            let sum: f64 = (0..n)
                .map(|_| {
                    let k = (f64::from(stream.uniform(0.0, 1.0)) * n as f64) as usize;
                    gains[k.min(n - 1)]
                })
                .sum();
            sum / samples.max(1) as f64
        })
        .collect();
    out.sort_by(f64::total_cmp);
    out
}
