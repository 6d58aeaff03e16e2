//! Refinement: least squares (Levenberg–Marquardt with bounds) of many candidates in step with each other, so
//! that their simulations share lanes.

use caudata_model::RobotModel;
use nalgebra::{DMatrix, DVector};

use super::judge::Judge;
use super::product::{dot, gram};
use super::state::{Context, differences};
use crate::error::GapError;
use crate::replay::{Term, Variant};

/// Most iterations.
const ITERATIONS: usize = 8;
/// Dampings that are tried at once, relative to the present one.
pub const TRIES: [f64; 3] = [0.1, 1.0, 12.0];
/// A fall of the misfit by less than this share ends a fit.
const ENOUGH: f64 = 1e-3;

/// Iterations after which of several starts only those go on that are about as good as the best.
const STARTS_UNTIL: usize = 2;
/// A start goes on if it has explained this share of what the best start has.
const GOOD_START: f64 = 0.9;
/// Iterations after which candidates that are far behind stay as they are.
const RACE_UNTIL: usize = 3;
/// They are if they explain less than this share of what the best explains.
const LEAST_OF_BEST: f64 = 0.4;

/// Who competes with whom, so that time goes to those who may win.
pub struct Race<'a> {
    /// Which variants are starts of the same candidate. `[V]`
    pub of: &'a [usize],
    /// Misfit that all of them begin with.
    pub from: f64,
}

/// A candidate being fitted.
struct Fit {
    terms: Variant,
    prediction: Vec<f32>,
    cost: f64,
    damping: f64,
    failures: usize,
    done: bool,
}

/// Fits every parameter of every candidate to the runs of `judge`. Gives the fitted candidates with their
/// misfits, in the same order.
///
/// # Errors
/// As [`crate::replay::Replayer::predict`].
pub fn refine(
    context: &Context,
    judge: &Judge,
    variants: Vec<Variant>,
    iterations: Option<usize>,
    race: Option<&Race<'_>>,
) -> Result<Vec<(Variant, f64)>, GapError> {
    let first = context.replayer.predict(&judge.data, &variants)?;
    let mut fits: Vec<Fit> = variants
        .into_iter()
        .zip(first)
        .map(|(terms, prediction)| {
            let cost = judge.misfit(&judge.residual(&prediction));
            Fit { done: terms.is_empty(), terms, prediction, cost, damping: 0.1, failures: 0 }
        })
        .collect();
    for k in 0..iterations.unwrap_or(ITERATIONS) {
        if fits.iter().all(|f| f.done) {
            break;
        }
        round(context, judge, &mut fits)?;
        if let Some(race) = race {
            weed(&mut fits, race, k + 1);
        }
    }
    Ok(fits.into_iter().map(|f| (f.terms, f.cost)).collect())
}

/// Ends fits that will not win, after `rounds` iterations.
fn weed(fits: &mut [Fit], race: &Race<'_>, rounds: usize) {
    let earned: Vec<f64> = fits.iter().map(|f| race.from - f.cost).collect();
    let most = earned.iter().copied().fold(0.0, f64::max);
    for ((fit, own), group) in fits.iter_mut().zip(&earned).zip(race.of) {
        let starts = earned.iter().zip(race.of).filter(|(_, g)| *g == group);
        let best_start = starts.map(|(e, _)| *e).fold(0.0, f64::max);
        let beaten = rounds >= STARTS_UNTIL && *own < GOOD_START * best_start;
        let behind = rounds >= RACE_UNTIL && *own < LEAST_OF_BEST * most;
        fit.done |= beaten || behind;
    }
}

fn round(context: &Context, judge: &Judge, fits: &mut [Fit]) -> Result<(), GapError> {
    let active: Vec<usize> = (0..fits.len()).filter(|&i| !fits[i].done).collect();
    let mut variants = Vec::new();
    let mut spans = Vec::new();
    for &i in &active {
        let (more, steps) = differences(&context.replayer, &fits[i].terms);
        spans.push((variants.len(), steps));
        variants.extend(more);
    }
    let predictions = context.replayer.predict(&judge.data, &variants)?;
    let mut tries: Vec<(usize, f64, Variant)> = Vec::new();
    for (&i, (from, steps)) in active.iter().zip(&spans) {
        let columns: Vec<Vec<f32>> = (0..steps.len())
            .map(|p| judge.change(&predictions[from + 2 * p], &predictions[from + 2 * p + 1]))
            .collect();
        let residual = judge.residual(&fits[i].prediction);
        let gram = 0.25 * gram(&columns);
        let slope = columns.iter().map(|c| 0.5 * dot(c, &residual));
        let slope = DVector::from_iterator(columns.len(), slope);
        for share in TRIES {
            let damping = fits[i].damping * share;
            if let Some(variant) = step(context, &fits[i].terms, &gram, &slope, steps, damping) {
                tries.push((i, damping, variant));
            }
        }
    }
    let variants: Vec<Variant> = tries.iter().map(|t| t.2.clone()).collect();
    let predictions = context.replayer.predict(&judge.data, &variants)?;
    let mut better = vec![None; fits.len()];
    for ((i, damping, _), (k, prediction)) in tries.iter().zip(predictions.iter().enumerate()) {
        let cost = judge.misfit(&judge.residual(prediction));
        let best: &mut Option<(f64, f64, usize)> = &mut better[*i];
        if best.is_none_or(|b| cost < b.0) {
            *best = Some((cost, *damping, k));
        }
    }
    for &i in &active {
        let fit = &mut fits[i];
        match better[i] {
            Some((cost, damping, k)) if cost < fit.cost => {
                let fall = (fit.cost - cost) / fit.cost.max(1e-12);
                fit.terms.clone_from(&tries[k].2);
                fit.prediction.clone_from(&predictions[k]);
                fit.cost = cost;
                fit.damping = (damping * 0.5).clamp(1e-6, 1e6);
                fit.failures = 0;
                fit.done = fall < ENOUGH;
            }
            _ => {
                fit.failures += 1;
                fit.damping = (fit.damping * 30.0).clamp(1e-6, 1e6);
                fit.done = fit.failures >= 2 || better[i].is_none();
            }
        }
    }
    Ok(())
}

/// One damped step, within bounds.
fn step(
    context: &Context,
    terms: &Variant,
    gram: &DMatrix<f64>,
    slope: &DVector<f64>,
    steps: &[f64],
    damping: f64,
) -> Option<Variant> {
    let model = context.replayer.model();
    let most = gram.diagonal().iter().copied().fold(0.0, f64::max);
    if most <= 0.0 {
        return None;
    }
    let mut matrix = gram.clone();
    for i in 0..matrix.nrows() {
        // a parameter without any trace stays where it is
        matrix[(i, i)] += damping * matrix[(i, i)] + 1e-9 * most;
    }
    let change = matrix.cholesky()?.solve(slope);
    let mut variant = terms.clone();
    moved(model, &mut variant, change.as_slice(), steps);
    Some(variant)
}

/// Moves parameters by so many steps, within bounds and by at most a tenth of a range, or half of a value, at once.
pub fn moved(model: &RobotModel, terms: &mut [Term], by: &[f64], steps: &[f64]) {
    let mut change = by.iter().zip(steps).map(|(by, step)| by * step);
    for term in terms {
        for p in 0..term.values.len() {
            let (low, high) = term.bounds(model, p);
            let value = term.values[p];
            let most = (0.1 * (high - low)).max(0.5 * value.abs());
            let by = change.next().unwrap_or(0.0).clamp(-most, most);
            term.values[p] = (value + by).clamp(low, high);
        }
    }
}
