//! How well parameters are known.

use std::collections::BTreeMap;

use nalgebra::DMatrix;

use super::alike::wider;
use super::extend::parameters;
use super::levels::RIGHT_LEAVES;
use super::naming::Named;
use super::product::{dot, gram, stiffen};
use super::state::{Context, Derivatives, State};
use super::words::rounded;
use crate::error::GapError;
use crate::plots::Correlation;
use crate::replay::{LANES, Term, Variant};
use crate::report::{Cause, Parameter};

/// Half an interval is at least this part of the smallest change that matters: labs differ by more than the
/// noise of one session …
const FINEST: f64 = 0.35;
/// … and this part of the effect: the law that is fitted is not quite nature's (on the benchmark, whose laws
/// are others, one error in two is larger than 4 %), more where the model leaves more than a right one does.
const LAW: f64 = 0.1;
/// Mean square of what a parameter does over all of its range that no run shows, floors.
const NO_TRACE: f64 = 1e-4;
/// Sizes at which an effect with a threshold may begin: each is so much nearer to the fitted one, and all fill one
/// engine.
const NEARER: f64 = 0.75;

/// Sandwich covariance of the fitted parameters.
pub struct Spread {
    /// `[P, P]`, SI.
    pub covariance: DMatrix<f64>,
    /// Variances with residuals that hang together within a second, or within a whole run: the larger. `[P]`,
    /// SI².
    variance: Vec<f64>,
}

/// The parameters of term `index` with their 95 % intervals. `wider`: variances of them that are larger than
/// `spread` says, SI², if any (see [`beside`]). `amounts`: see there.
pub fn intervals(
    context: &Context,
    best: &State,
    index: usize,
    spread: &Spread,
    (wider, amounts): (&[f64], &[f64]),
) -> BTreeMap<String, Parameter> {
    let model = context.replayer.model();
    let offset: usize = best.terms[..index].iter().map(|t| t.values.len()).sum();
    let term = &best.terms[index];
    // what the model still gets wrong pulls at its parameters as well; and no interval is finer than a part of
    // what matters
    let poor = (best.fit.misfit / RIGHT_LEAVES).max(1.0).sqrt();
    let mut out = parameters(model, term, |p| {
        let variance = spread.variance.get(offset + p).copied().unwrap_or(0.0);
        let sd = variance.max(wider.get(p).copied().unwrap_or(0.0)).max(0.0).sqrt();
        (1.96 * sd * poor).hypot(FINEST * term.scale(model, p).abs()).hypot(LAW * poor * amounts[p])
    });
    if let ([joint], true) = (&term.place.items[..], term.effect.ends) {
        // an end that the joint did not come to may be anywhere but where it was
        let (low, high) = context.excitation.joints[*joint].range_rad;
        for (p, spec) in term.effect.parameters.iter().enumerate() {
            let (Some(end), near) = (out.get_mut(spec.name), term.scale(model, p)) else {
                continue;
            };
            match p {
                0 if end.value < low - near => end.ci_high = end.ci_high.min(low),
                1 if end.value > high + near => end.ci_low = end.ci_low.max(high),
                _ => {}
            }
        }
    }
    out
}

/// How much of an effect each parameter of term `index` is, SI: how far it is from where the effect begins. That is its
/// neutral value; but where there is a threshold nothing may happen for most of the way, and a stop that is nowhere at
/// 4 rad begins where the joint would get.
///
/// # Errors
/// As [`crate::replay::Replayer::predict`].
pub fn amounts(context: &Context, best: &State, index: usize) -> Result<Vec<f64>, GapError> {
    let term = &best.terms[index];
    let neutral = term.neutral(context.replayer.model());
    let away = |share: f64| term.values.iter().zip(&neutral).map(move |(v, z)| share * (z - v));
    let mut share = 1.0;
    if term.effect.hinge {
        let shares: Vec<f64> = (0..LANES as i32).map(|k| NEARER.powi(k)).collect();
        let at = |share: &f64| {
            let mut terms = best.terms.clone();
            for (value, way) in terms[index].values.iter_mut().zip(away(*share)) {
                *value += way;
            }
            terms
        };
        let variants: Vec<Variant> = shares.iter().map(at).collect();
        let predictions = context.replayer.predict(&context.fit.data, &variants)?;
        let does = |prediction: &Vec<f32>| {
            let trace = context.fit.change(prediction, &predictions[0]);
            dot(&trace, &trace)
        };
        let whole = does(&best.fit.prediction);
        let nothing = |(_, p): &(&f64, &Vec<f32>)| does(p) <= LAW * LAW * whole;
        share = shares.iter().zip(&predictions).take_while(nothing).fold(1.0, |_, (s, _)| *s);
    }
    Ok(away(share).map(f64::abs).collect())
}

/// (JᵀJ)⁻¹·(Σ over blocks of score·scoreᵀ)·(JᵀJ)⁻¹: holds where residuals hang together within a block.
/// Friction and supply differ from run to run and hold for all of it, so that whole runs are taken for blocks
/// too.
pub fn spread(context: &Context, best: &State, derivatives: &Derivatives) -> Spread {
    let none = Spread { covariance: DMatrix::zeros(0, 0), variance: Vec::new() };
    if best.terms.is_empty() {
        return none;
    }
    let (columns, steps) = (&derivatives.fit, &derivatives.steps);
    let n = columns.len();
    let mut gram = gram(columns);
    stiffen(&mut gram);
    let Some(bread) = gram.cholesky().map(|c| c.inverse()) else {
        return none;
    };
    let residual = &best.fit.residual;
    let score = |c: &Vec<f32>, k: usize| f64::from(c[k]) * f64::from(residual[k]);
    let by_block = columns.iter().map(|c| context.fit.by_block(|k| score(c, k)));
    let by_run = columns.iter().map(|c| context.fit.by_trial(|k| score(c, k)));
    let by_run: Vec<Vec<f64>> = by_run.collect();
    // bread·(Σ score·scoreᵀ)·bread, SI
    let scaled = |scores: &[Vec<f64>]| {
        let meat = |i: usize, j: usize| scores[i].iter().zip(&scores[j]).map(|(a, b)| a * b).sum();
        let sandwich = &bread * DMatrix::from_fn(n, n, meat) * &bread;
        DMatrix::from_fn(n, n, |i, j| sandwich[(i, j)] * steps[i] * steps[j])
    };
    let covariance = scaled(&by_block.collect::<Vec<_>>());
    let mut variance: Vec<f64> = covariance.diagonal().iter().copied().collect();
    let runs = by_run.first().map_or(0, Vec::len);
    if runs > 1 {
        // scores sum to nothing at the best fit: one run of them is not free
        let few = runs as f64 / (runs as f64 - 1.0);
        let by_run = scaled(&by_run);
        for (i, v) in variance.iter_mut().enumerate() {
            *v = v.max(few * by_run[(i, i)]);
        }
    }
    // what no run shows can be anything
    let model = context.replayer.model();
    let bounds = best.terms.iter().flat_map(|t| (0..t.values.len()).map(|p| t.bounds(model, p)));
    for (i, (low, high)) in bounds.enumerate().take(n) {
        let whole = (high - low) / steps[i].abs().max(f64::MIN_POSITIVE);
        let trace = dot(&columns[i], &columns[i]) / residual.len().max(1) as f64;
        if trace * whole * whole < NO_TRACE {
            variance[i] = (high - low).powi(2);
        }
    }
    Spread { covariance, variance }
}

/// Variances of the parameters of term `index`, SI², if `rivals`, which explain the runs about as well in its
/// place, may be there beside it: each with the size that it would need alone as the standard deviation of
/// what is known of it beforehand. Empty where that says nothing.
///
/// # Errors
/// As [`crate::replay::Replayer::predict`].
pub fn beside(
    context: &Context,
    best: &State,
    index: usize,
    rivals: &[&Term],
    spread: &Spread,
) -> Result<Vec<f64>, GapError> {
    let model = context.replayer.model();
    let mut terms = best.terms.clone();
    let own: usize = terms.iter().map(|t| t.values.len()).sum();
    let mut sizes = Vec::new();
    for rival in rivals {
        let neutral = rival.neutral(model);
        sizes.extend(rival.values.iter().zip(&neutral).map(|(v, z)| (v - z).abs()));
        terms.push(Term { values: neutral, ..(*rival).clone() });
    }
    let (columns, steps) = context.jacobian(&context.fit, &terms)?;
    let mut gram = gram(&columns);
    let largest = gram.diagonal().rows(0, own).max().max(1e-12);
    for i in 0..gram.nrows() {
        gram[(i, i)] += 1e-9 * largest;
        if i >= own {
            // what leaves no trace, or was not needed, stays where it is
            let size = (sizes[i - own] / steps[i]).max(1e-6);
            gram[(i, i)] += 1.0 / (size * size);
        }
    }
    let alone = gram.view((0, 0), (own, own)).into_owned().cholesky();
    let (Some(together), Some(alone)) = (gram.cholesky(), alone) else {
        return Ok(Vec::new());
    };
    let (together, alone) = (together.inverse(), alone.inverse());
    let offset: usize = best.terms[..index].iter().map(|t| t.values.len()).sum();
    let count = best.terms[index].values.len();
    Ok((offset..offset + count)
        .map(|i| {
            let known = spread.variance.get(i).copied().unwrap_or(0.0);
            let grows = together[(i, i)] / alone[(i, i)].max(1e-300);
            // either the noise as the sandwich has it, grown alike, or the model's own
            (known * grows).max((together[(i, i)] - alone[(i, i)]) * steps[i] * steps[i])
        })
        .collect())
}

/// A size is known no better than the names beside it: the intervals of `cause`, which is the term `own` of
/// `best`, hold what it would be with another of its answer set in the place of each other cause.
pub fn widen(cause: &mut Cause, own: &Term, best: &State, causes: &[Named]) {
    let rivals = causes.iter().flat_map(|n| n.rivals.iter().map(move |r| (n, r)));
    for (named, rival) in rivals.filter(|(_, r)| r.in_set) {
        let (instead, of) = (&rival.state.terms[rival.index], &best.terms[named.index]);
        let same = |t: &&Term| t.same(own);
        let other = rival.state.terms.iter().find(same);
        let Some(other) = other.filter(|_| of != own && !wider(of.effect, instead.effect)) else {
            continue;
        };
        for (spec, &value) in own.effect.parameters.iter().zip(&other.values) {
            let Some(p) = cause.parameters.get_mut(spec.name) else {
                continue;
            };
            if (p.ci_low..=p.ci_high).contains(&value) {
                continue;
            }
            let instead = instead.label();
            let of = of.label();
            let unit = format!(" {}", p.unit);
            cause.evidence.push(format!(
                "with {instead} instead of {of} its {} would be {}{}",
                spec.name,
                rounded(value),
                unit.trim_end()
            ));
            let moved = value - p.value;
            (p.ci_low, p.ci_high) =
                (p.ci_low.min(p.ci_low + moved), p.ci_high.max(p.ci_high + moved));
        }
    }
}

/// Correlation of all fitted parameters.
pub fn correlation(best: &State, spread: &Spread) -> Correlation {
    let names: Vec<String> = best
        .terms
        .iter()
        .flat_map(|t| {
            let label = t.label();
            t.effect.parameters.iter().map(move |p| format!("{label}.{}", p.name))
        })
        .collect();
    let c = &spread.covariance;
    if c.nrows() != names.len() {
        return Correlation::default();
    }
    let of = |i: usize, j: usize| {
        let scale = (c[(i, i)] * c[(j, j)]).sqrt();
        match scale > 0.0 {
            true => (c[(i, j)] / scale).clamp(-1.0, 1.0),
            false => f64::from(u8::from(i == j)),
        }
    };
    let row = |i| (0..c.nrows()).map(|j| of(i, j)).collect();
    Correlation { names, matrix: (0..c.nrows()).map(row).collect() }
}
