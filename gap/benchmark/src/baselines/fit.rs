//! Fitting effects to a case: least squares, forward selection.

use caudata_gap::place::Domain;
use caudata_gap::replay::{Term, Variant};

use super::data::{CaseData, DataError, square};
use crate::truth::linear::solve_spd;

/// Rounds of least squares.
const ROUNDS: usize = 6;

/// A fit.
#[derive(Clone)]
pub struct Fit {
    /// The effects, fitted.
    pub terms: Variant,
    /// Sum of squared whitened residuals.
    pub cost: f64,
    /// Number of residuals.
    pub values: usize,
    /// Standard deviation of each parameter, as if residuals were white, SI. `[P]`
    pub sd: Vec<f64>,
}

/// A parameter: its term, and its number there.
type Slot = (usize, usize);

fn slots(terms: &Variant) -> Vec<Slot> {
    let of = |(i, t): (usize, &Term)| (0..t.values.len()).map(move |p| (i, p));
    terms.iter().enumerate().flat_map(of).collect()
}

/// Step that matters of a parameter, SI.
fn scale(data: &CaseData, terms: &Variant, (i, p): Slot) -> f64 {
    let term = &terms[i];
    term.scale(data.model(), p)
}

/// `terms` with each parameter moved by `by`, SI, within its bounds.
fn moved(data: &CaseData, terms: &Variant, by: impl Fn(usize) -> f64) -> Variant {
    let mut out = terms.clone();
    for (k, (i, p)) in slots(terms).into_iter().enumerate() {
        let term = &mut out[i];
        let (low, high) = term.bounds(data.model(), p);
        term.values[p] = (term.values[p] + by(k)).clamp(low, high);
    }
    out
}

/// JᵀJ (`[n, n]`) and Jᵀr at `terms` by differences, per step that matters; `r` the residuals there.
fn normal_equations(
    data: &CaseData,
    terms: &Variant,
    r: &[f64],
) -> Result<(Vec<f64>, Vec<f64>), DataError> {
    let slots = slots(terms);
    let n = slots.len();
    let steps: Vec<f64> = (slots.iter())
        .map(|&(i, p)| {
            let step = 0.3 * scale(data, terms, (i, p));
            let high = terms[i].bounds(data.model(), p).1;
            if terms[i].values[p] + step > high { -step } else { step }
        })
        .collect();
    let one = |k: usize| moved(data, terms, |other| if other == k { steps[k] } else { 0.0 });
    let near: Vec<Variant> = (0..n).map(one).collect();
    let columns: Vec<Vec<f64>> = (data.residuals(&data.fit, &near)?.iter().enumerate())
        .map(|(k, m)| {
            let per = steps[k] / scale(data, terms, slots[k]);
            m.iter().zip(r).map(|(a, b)| (a - b) / per).collect()
        })
        .collect();
    let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
    let normal = (0..n * n).map(|k| dot(&columns[k / n], &columns[k % n]));
    let slope = columns.iter().map(|c| dot(c, r)).collect();
    Ok((normal.collect(), slope))
}

/// Entry `i` of the diagonal of (JᵀJ)⁻¹, as if residuals were white: what such tools print.
fn variance(normal: &[f64], n: usize, i: usize) -> Option<f64> {
    let mut a = normal.to_vec();
    (0..n).for_each(|k| a[k * n + k] += 1e-9);
    let mut unit = vec![0.0; n];
    unit[i] = 1.0;
    solve_spd(&mut a, &mut unit).then(|| unit[i])
}

/// Damped Gauss–Newton with differences, from `start`.
pub fn least_squares(data: &CaseData, start: Variant) -> Result<Fit, DataError> {
    let mut terms = start;
    let scales: Vec<f64> =
        (slots(&terms).into_iter()).map(|slot| scale(data, &terms, slot)).collect();
    let n = scales.len();
    let mut damping = 1e-2;
    let mut r = (data.residuals(&data.fit, std::slice::from_ref(&terms))?).remove(0);
    let mut cost = square(&r);
    let mut normal = vec![0.0; n * n];
    for _ in 0..ROUNDS {
        let (normal_now, slope) = normal_equations(data, &terms, &r)?;
        normal = normal_now;
        let mut tries = Vec::new();
        for d in [damping * 0.1, damping, damping * 10.0, damping * 100.0] {
            let mut a = normal.clone();
            for i in 0..n {
                a[i * n + i] = a[i * n + i] * (1.0 + d) + 1e-9;
            }
            let mut step: Vec<f64> = slope.iter().map(|s| -s).collect();
            if solve_spd(&mut a, &mut step) {
                tries.push((d, moved(data, &terms, |k| step[k] * scales[k])));
            }
        }
        let variants: Vec<Variant> = tries.iter().map(|t| t.1.clone()).collect();
        let got = data.residuals(&data.fit, &variants)?.into_iter().zip(tries);
        let best = got.min_by(|a, b| square(&a.0).total_cmp(&square(&b.0)));
        let Some((residual, (d, at))) = best else {
            break;
        };
        let better = square(&residual);
        let ends = better >= cost * (1.0 - 1e-4);
        if better < cost {
            (terms, r, cost, damping) = (at, residual, better, d);
        }
        if ends {
            break;
        }
    }
    let white = cost / (r.len().saturating_sub(n)).max(1) as f64;
    let sd = |i: usize| {
        variance(&normal, n, i).map_or(f64::INFINITY, |v| (v * white).sqrt() * scales[i])
    };
    Ok(Fit { sd: (0..n).map(sd).collect(), terms, cost, values: r.len() })
}

/// Names of effects by how far their first parameter is from nothing in `units` of its own, where that is more
/// than `least`, strongest first.
pub(super) fn named(
    data: &CaseData,
    terms: &Variant,
    units: impl Fn(usize) -> f64,
    least: f64,
) -> Vec<&'static str> {
    let mut found: Vec<(f64, &'static str)> = Vec::new();
    for (k, (i, p)) in slots(terms).into_iter().enumerate() {
        if p == 0 {
            let term = &terms[i];
            let neutral = term.neutral(data.model())[0];
            let far = (term.values[0] - neutral).abs() / units(k).max(1e-12);
            found.push((far, term.effect.id));
        }
    }
    found.retain(|f| f.0 > least);
    found.sort_by(|a, b| b.0.total_cmp(&a.0));
    let mut names = Vec::new();
    for (_, name) in found {
        if !names.contains(&name) {
            names.push(name);
        }
    }
    names
}

/// Baseline 1, as identification tools do: every one of a fixed list is fitted, and every one whose 95 %
/// interval leaves nothing out is "found". Returns the fit and the names, strongest first.
pub fn fit_all(data: &CaseData) -> Result<(Fit, Vec<&'static str>), DataError> {
    const LIST: [&str; 9] = [
        "command_delay",
        "encoder_offset",
        "command_low_pass",
        "kp_error",
        "kd_error",
        "coulomb_friction",
        "viscous_friction",
        "armature",
        "link_mass",
    ];
    let nothing: Variant = LIST.iter().flat_map(|id| data.each(id)).collect();
    let slots = slots(&nothing);
    // what has no slope at its bound begins beside it
    let start = moved(data, &nothing, |k| 0.3 * scale(data, &nothing, slots[k]));
    let fit = least_squares(data, start)?;
    let names = named(data, &fit.terms, |k| fit.sd[k], 1.96);
    Ok((fit, names))
}

/// `terms` with each size of the grid of `candidate` added, smooth ones the other way round as well.
fn with_sizes<'a>(
    data: &'a CaseData,
    terms: &'a Variant,
    candidate: &'a Term,
) -> impl Iterator<Item = Variant> + 'a {
    let effect = candidate.effect;
    let both = if effect.hinge { &[1.0][..] } else { &[1.0, -1.0] };
    let sizes = (0..effect.grid.len()).flat_map(move |k| both.iter().map(move |way| (k, *way)));
    sizes.map(move |(k, way)| {
        let mut term = candidate.clone();
        let sizes = effect.sizes(data.model(), &term.place, k);
        for (p, size) in sizes.into_iter().enumerate() {
            let (low, high) = effect.bounds(data.model(), &term.place, p);
            let neutral = term.values[p];
            term.values[p] = (neutral + way * (size - neutral)).clamp(low, high);
        }
        let mut with = terms.clone();
        with.push(term);
        with
    })
}

/// The true structure (effects with their joints), fitted: what a perfect name would be worth on held-out
/// runs. `None` where the catalogue lacks it.
pub fn oracle(data: &CaseData, truth: &[(String, String)]) -> Result<Option<Fit>, DataError> {
    let model = data.model();
    let names = model.actuated_names();
    let mut starts = vec![Variant::new()];
    for (effect, joint) in truth {
        let a = names.iter().position(|n| n == joint).unwrap_or(0);
        let link = model.joints()[model.actuated()[a]].child_link;
        let there = |t: &&Term| match t.place.domain {
            Domain::Joints => t.place.items == [a],
            Domain::Links => t.place.names == [model.links()[link].name.as_str()],
            _ => true,
        };
        let places = data.each(effect);
        let Some(term) = places.iter().find(there) else {
            return Ok(None);
        };
        let more = starts.iter().flat_map(|s| with_sizes(data, s, term));
        starts = more.collect();
    }
    best_of(data, starts, 6)
}

/// The best fit from the most promising `most` of `starts`.
fn best_of(data: &CaseData, starts: Vec<Variant>, most: usize) -> Result<Option<Fit>, DataError> {
    let mut costs: Vec<(f64, usize)> =
        (data.residuals(&data.fit, &starts)?.iter()).map(|r| square(r)).zip(0..).collect();
    costs.sort_by(|a, b| a.0.total_cmp(&b.0));
    let mut best: Option<Fit> = None;
    for &(_, k) in costs.iter().take(most) {
        let fit = least_squares(data, starts[k].clone())?;
        if best.as_ref().is_none_or(|b| fit.cost < b.cost) {
            best = Some(fit);
        }
    }
    Ok(best)
}

/// Baseline 3: forward selection by the Bayesian information criterion on fit data.
pub fn forward_selection(data: &CaseData) -> Result<(Fit, Vec<&'static str>), DataError> {
    const MOST: usize = 4;
    let candidates = data.candidates();
    let mut fit = least_squares(data, Variant::new())?;
    let criterion = |f: &Fit| {
        let n = f.values as f64;
        n * (f.cost / n).ln() + f.sd.len() as f64 * n.ln()
    };
    for _ in 0..MOST {
        let had = |c: &&Term| !(fit.terms.iter()).any(|t| t.same(c));
        // one scan over sizes, then the best are refined
        let tries = candidates.iter().filter(had);
        let tries: Vec<Variant> = tries.flat_map(|c| with_sizes(data, &fit.terms, c)).collect();
        match best_of(data, tries, 3)? {
            Some(next) if criterion(&next) < criterion(&fit) => fit = next,
            _ => break,
        }
    }
    let names = fit.terms.iter().map(|t| t.effect.id).collect();
    Ok((fit, names))
}
