//! How well parameters are known.

use std::collections::BTreeMap;

use super::algebra::{dot, inverse};
use super::state::{Context, State};
use crate::error::GapError;
use crate::plots::Correlation;
use crate::report::Parameter;

/// Half an interval is at least this part of the smallest change that matters: labs differ by more than the noise of one session …
const FINEST: f64 = 0.35;
/// … and this part of the effect: the law that is fitted is not quite nature's (on the benchmark, whose laws are others, one error in two is
/// larger than 4 %) …
const LAW: f64 = 0.1;
/// … and more where the model fits worse than careful labs do (misfit of nulls of the benchmark).
const GOOD_MISFIT: f64 = 0.2;

/// Sandwich covariance of the fitted parameters, and their names.
pub struct Spread {
    /// `[P, P]`, SI.
    pub covariance: Vec<Vec<f64>>,
}

/// The parameters of one term with their 95 % intervals.
pub fn parameters(
    context: &Context,
    best: &State,
    index: usize,
    spread: &Spread,
) -> BTreeMap<String, Parameter> {
    let model = context.replayer.model();
    let offset: usize = best.terms[..index].iter().map(|t| t.values.len()).sum();
    let term = &best.terms[index];
    let neutral = term.effect.neutral(model, &term.place);
    let mut out = BTreeMap::new();
    for (p, spec) in term.effect.parameters.iter().enumerate() {
        let value = term.values[p];
        let (low, high) = term.effect.bounds(model, &term.place, p);
        let near = 1e-6 * (high - low);
        let sd = spread
            .covariance
            .get(offset + p)
            .map_or(0.0, |row| row[offset + p].max(0.0).sqrt());
        // what the model still gets wrong pulls at its parameters as well; and no interval is finer than a part of what matters
        let poor = (best.fit.misfit / GOOD_MISFIT).max(1.0).sqrt();
        let half = (1.96 * sd * poor)
            .hypot(FINEST * term.effect.scale(model, &term.place, p).abs())
            .hypot(LAW * poor * (value - neutral[p]).abs());
        let still = (value - neutral[p]).abs() < near;
        out.insert(
            spec.name.to_owned(),
            Parameter {
                value,
                unit: spec.unit.to_owned(),
                ci_low: (value - half).max(low),
                ci_high: (value + half).min(high),
                at_bound: !still && (value <= low + near || value >= high - near),
            },
        );
    }
    out
}

/// (JᵀJ)⁻¹·(Σ over blocks of score·scoreᵀ)·(JᵀJ)⁻¹: holds where residuals hang together within a block.
pub fn spread(context: &Context, best: &State) -> Result<Spread, GapError> {
    let none = Spread {
        covariance: Vec::new(),
    };
    if best.terms.is_empty() {
        return Ok(none);
    }
    let (columns, steps) = context.jacobian(&best.terms, &best.fit.prediction)?;
    let n = columns.len();
    let mut gram: Vec<Vec<f64>> = columns
        .iter()
        .map(|a| columns.iter().map(|b| dot(a, b)).collect())
        .collect();
    let largest = (0..n).map(|i| gram[i][i]).fold(0.0, f64::max);
    for (i, row) in gram.iter_mut().enumerate() {
        row[i] += 1e-9 * largest.max(1e-12);
    }
    let Some(bread) = inverse(&gram) else {
        return Ok(none);
    };
    let residual = &best.fit.residual;
    let scores: Vec<Vec<f64>> = columns
        .iter()
        .map(|c| {
            context
                .fit
                .by_block(|k| f64::from(c[k]) * f64::from(residual[k]))
        })
        .collect();
    let meat: Vec<Vec<f64>> = (0..n)
        .map(|i| {
            (0..n)
                .map(|j| scores[i].iter().zip(&scores[j]).map(|(a, b)| a * b).sum())
                .collect()
        })
        .collect();
    let product = |a: &[Vec<f64>], b: &[Vec<f64>]| -> Vec<Vec<f64>> {
        (0..n)
            .map(|i| {
                (0..n)
                    .map(|j| (0..n).map(|k| a[i][k] * b[k][j]).sum())
                    .collect()
            })
            .collect()
    };
    let mut covariance = product(&product(&bread, &meat), &bread);
    for (i, row) in covariance.iter_mut().enumerate() {
        for (j, c) in row.iter_mut().enumerate() {
            *c *= steps[i] * steps[j];
        }
    }
    Ok(Spread { covariance })
}

/// Correlation of all fitted parameters.
pub fn correlation(best: &State, spread: &Spread) -> Correlation {
    let names: Vec<String> = best
        .terms
        .iter()
        .flat_map(|t| {
            let label = t.place.label(t.effect.id);
            t.effect
                .parameters
                .iter()
                .map(move |p| format!("{label}.{}", p.name))
        })
        .collect();
    let c = &spread.covariance;
    if c.len() != names.len() {
        return Correlation::default();
    }
    let matrix = (0..c.len())
        .map(|i| {
            (0..c.len())
                .map(|j| {
                    let scale = (c[i][i] * c[j][j]).sqrt();
                    if scale > 0.0 {
                        (c[i][j] / scale).clamp(-1.0, 1.0)
                    } else {
                        f64::from(u8::from(i == j))
                    }
                })
                .collect()
        })
        .collect();
    Correlation { names, matrix }
}
