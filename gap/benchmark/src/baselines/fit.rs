//! Fitting turns to a case: least squares, forward selection.

use super::data::{CaseData, DataError};
use super::setup::{KNOBS, Knob, Setup, Turn, knob_of, turned, turns};
use crate::truth::linear::solve_spd;

/// Most lanes at once.
pub(super) const LANES: usize = 16;
/// Rounds of least squares.
const ROUNDS: usize = 6;

/// A fit.
#[derive(Clone)]
pub struct Fit {
    /// What was turned.
    pub turns: Vec<Turn>,
    /// To where.
    pub x: Vec<f64>,
    /// Sum of squared whitened residuals.
    pub cost: f64,
    /// Number of residuals.
    pub values: usize,
    /// Standard deviation of each turn, as if residuals were white.
    pub sd: Vec<f64>,
}

impl Fit {
    /// The robot.
    #[must_use]
    pub fn setup(&self, data: &CaseData) -> Setup {
        turned(&data.model, &self.turns, &self.x)
    }
}

pub(super) fn square(r: &[f64]) -> f64 {
    r.iter().map(|x| x * x).sum()
}

pub(super) fn in_lanes(data: &CaseData, setups: &[Setup]) -> Result<Vec<Vec<f64>>, DataError> {
    let mut all = Vec::new();
    for chunk in setups.chunks(LANES) {
        all.extend(data.residuals(&data.fit, chunk)?);
    }
    Ok(all)
}

/// JᵀJ (`[n, n]`) and Jᵀr at `x` by differences, `r` the residuals there.
fn normal_equations(
    data: &CaseData,
    turns: &[Turn],
    x: &[f64],
    r: &[f64],
) -> Result<(Vec<f64>, Vec<f64>), DataError> {
    let n = turns.len();
    let ahead = |((k, _), x): (&Turn, &f64)| match x + 0.3 * k.scale > k.range.1 {
        true => -0.3 * k.scale,
        false => 0.3 * k.scale,
    };
    let steps: Vec<f64> = turns.iter().zip(x).map(ahead).collect();
    let near = |i: usize| {
        let mut at = x.to_vec();
        at[i] += steps[i];
        turned(&data.model, turns, &at)
    };
    let near: Vec<Setup> = (0..n).map(near).collect();
    let moved = in_lanes(data, &near)?;
    let column = |((m, (k, _)), h): ((&Vec<f64>, &Turn), &f64)| -> Vec<f64> {
        let pairs = m.iter().zip(r);
        pairs.map(|(a, b)| (a - b) / (h / k.scale)).collect()
    };
    let columns: Vec<Vec<f64>> = moved.iter().zip(turns).zip(&steps).map(column).collect();
    let (mut normal, mut slope) = (vec![0.0; n * n], vec![0.0; n]);
    for i in 0..n {
        slope[i] = columns[i].iter().zip(r).map(|(c, r)| c * r).sum();
        for j in 0..=i {
            let dot: f64 = columns[i].iter().zip(&columns[j]).map(|(a, b)| a * b).sum();
            normal[i * n + j] = dot;
            normal[j * n + i] = dot;
        }
    }
    Ok((normal, slope))
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
///
/// # Errors
/// [`DataError`].
pub fn least_squares(data: &CaseData, turns: &[Turn], start: &[f64]) -> Result<Fit, DataError> {
    let n = turns.len();
    let mut x = start.to_vec();
    let mut damping = 1e-2;
    let mut r = data
        .residuals(&data.fit, &[turned(&data.model, turns, &x)])?
        .remove(0);
    let mut cost = square(&r);
    let mut normal = vec![0.0; n * n];
    for _ in 0..ROUNDS {
        let (normal_now, slope) = normal_equations(data, turns, &x, &r)?;
        normal = normal_now;
        let mut tries = Vec::new();
        for d in [damping * 0.1, damping, damping * 10.0, damping * 100.0] {
            let mut a = normal.clone();
            for i in 0..n {
                a[i * n + i] = a[i * n + i] * (1.0 + d) + 1e-9;
            }
            let mut step: Vec<f64> = slope.iter().map(|s| -s).collect();
            if solve_spd(&mut a, &mut step) {
                let at: Vec<f64> = x
                    .iter()
                    .zip(&step)
                    .zip(turns)
                    .map(|((x, s), (k, _))| (x + s * k.scale).clamp(k.range.0, k.range.1))
                    .collect();
                tries.push((d, at));
            }
        }
        let setups: Vec<Setup> = tries
            .iter()
            .map(|(_, at)| turned(&data.model, turns, at))
            .collect();
        let got = in_lanes(data, &setups)?;
        let best = got
            .into_iter()
            .zip(tries)
            .min_by(|a, b| square(&a.0).total_cmp(&square(&b.0)));
        let Some((residual, (d, at))) = best else {
            break;
        };
        let better = square(&residual);
        if better >= cost * (1.0 - 1e-4) {
            if better < cost {
                (x, r, cost) = (at, residual, better);
            }
            break;
        }
        (x, r, cost, damping) = (at, residual, better, d);
    }
    let white = cost / (r.len().saturating_sub(n)).max(1) as f64;
    let sd = (0..n).map(|i| {
        variance(&normal, n, i).map_or(f64::INFINITY, |v| (v * white).sqrt() * turns[i].0.scale)
    });
    let sd = sd.collect();
    Ok(Fit {
        turns: turns.to_vec(),
        x,
        cost,
        values: r.len(),
        sd,
    })
}

/// Baseline 1, as identification tools do: every one of a fixed list is fitted, and every one whose 95 %
/// interval leaves nothing out is "found". Returns the fit and the names, strongest first.
///
/// # Errors
/// [`DataError`].
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
    let knobs: Vec<&'static Knob> = LIST.iter().filter_map(|id| knob_of(id)).collect();
    let turns = turns(&knobs, data.model.actuated().len());
    let start: Vec<f64> = turns
        .iter()
        .map(|(k, _)| if k.range.0 >= 0.0 { 0.3 * k.scale } else { 0.0 })
        .collect();
    let fit = least_squares(data, &turns, &start)?;
    let mut found: Vec<(f64, &'static str)> = fit
        .turns
        .iter()
        .zip(&fit.x)
        .zip(&fit.sd)
        .map(|(((k, _), x), sd)| (x.abs() / sd.max(1e-12), k.effect))
        .filter(|f| f.0 > 1.96)
        .collect();
    found.sort_by(|a, b| b.0.total_cmp(&a.0));
    let mut names = Vec::new();
    for (_, name) in found {
        if !names.contains(&name) {
            names.push(name);
        }
    }
    Ok((fit, names))
}

/// The true structure, fitted: what a perfect name would be worth on held-out runs. `None` where it has no
/// knob.
///
/// # Errors
/// [`DataError`].
pub fn oracle(data: &CaseData, effects: &[(String, String)]) -> Result<Option<Fit>, DataError> {
    let names = data.model.actuated_names();
    let mut turns = Vec::new();
    for (effect, joint) in effects {
        let Some(knob) = knob_of(effect) else {
            return Ok(None);
        };
        turns.push((knob, names.iter().position(|n| n == joint).unwrap_or(0)));
    }
    let mut best: Option<Fit> = None;
    let grid: Vec<f64> = turns
        .first()
        .map_or(Vec::new(), |(k, _)| [&[0.0], k.starts].concat());
    for first in grid {
        let mut start: Vec<f64> = turns
            .iter()
            .map(|(k, _)| k.starts.first().copied().unwrap_or(0.0))
            .collect();
        start[0] = first;
        let fit = least_squares(data, &turns, &start)?;
        if best.as_ref().is_none_or(|b| fit.cost < b.cost) {
            best = Some(fit);
        }
    }
    Ok(best)
}

/// Baseline 3: forward selection by the Bayesian information criterion on fit data.
///
/// # Errors
/// [`DataError`].
pub fn forward_selection(data: &CaseData) -> Result<(Fit, Vec<&'static str>), DataError> {
    const MOST: usize = 4;
    let all: Vec<&'static Knob> = KNOBS.iter().collect();
    let candidates = turns(&all, data.model.actuated().len());
    let mut fit = least_squares(data, &[], &[])?;
    let criterion = |f: &Fit| {
        f.values as f64 * (f.cost / f.values as f64).ln()
            + f.turns.len() as f64 * (f.values as f64).ln()
    };
    for _ in 0..MOST {
        // one scan over sizes, then the best is refined
        let mut tries: Vec<(usize, f64)> = Vec::new();
        for (i, (k, _)) in candidates.iter().enumerate() {
            if fit
                .turns
                .iter()
                .any(|(t, a)| t.effect == k.effect && *a == candidates[i].1)
            {
                continue;
            }
            for units in [-8.0, -3.0, -1.0, 1.0, 3.0, 8.0] {
                let x = units * k.scale;
                if x >= k.range.0 && x <= k.range.1 {
                    tries.push((i, x));
                }
            }
            tries.extend(k.starts.iter().map(|x| (i, *x)));
        }
        let setups: Vec<Setup> = tries
            .iter()
            .map(|&(i, x)| {
                let mut turns = fit.turns.clone();
                turns.push(candidates[i]);
                turned(&data.model, &turns, &[fit.x.as_slice(), &[x]].concat())
            })
            .collect();
        let mut costs: Vec<(f64, usize)> = in_lanes(data, &setups)?
            .iter()
            .enumerate()
            .map(|(i, r)| (square(r), i))
            .collect();
        costs.sort_by(|a, b| a.0.total_cmp(&b.0));
        let mut best: Option<Fit> = None;
        for &(_, t) in costs.iter().take(3) {
            let (i, x) = tries[t];
            let mut turns = fit.turns.clone();
            turns.push(candidates[i]);
            let next = least_squares(data, &turns, &[fit.x.as_slice(), &[x]].concat())?;
            if best.as_ref().is_none_or(|b| next.cost < b.cost) {
                best = Some(next);
            }
        }
        match best {
            Some(next) if criterion(&next) < criterion(&fit) => fit = next,
            _ => break,
        }
    }
    let names = fit.turns.iter().map(|(k, _)| k.effect).collect();
    Ok((fit, names))
}
