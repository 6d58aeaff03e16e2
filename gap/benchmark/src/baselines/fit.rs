//! Fitting turns to a case: least squares, forward selection, evolution.

use caudata_random::{Key, Purpose, Stream};

use super::data::{CaseData, DataError};
use super::setup::{KNOBS, Knob, Setup, Turn, knob_of, turned, turns};
use crate::truth::linear::solve_spd;

/// Most lanes at once.
const LANES: usize = 16;
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

fn square(r: &[f64]) -> f64 {
    r.iter().map(|x| x * x).sum()
}

fn in_lanes(data: &CaseData, setups: &[Setup]) -> Result<Vec<Vec<f64>>, DataError> {
    let mut all = Vec::new();
    for chunk in setups.chunks(LANES) {
        all.extend(data.residuals(&data.fit, chunk)?);
    }
    Ok(all)
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
        let steps: Vec<f64> = turns
            .iter()
            .zip(&x)
            .map(|((k, _), &x)| {
                if x + 0.3 * k.scale > k.range.1 {
                    -0.3 * k.scale
                } else {
                    0.3 * k.scale
                }
            })
            .collect();
        let near: Vec<Setup> = (0..n)
            .map(|i| {
                let mut at = x.clone();
                at[i] += steps[i];
                turned(&data.model, turns, &at)
            })
            .collect();
        let moved = in_lanes(data, &near)?;
        let columns: Vec<Vec<f64>> = moved
            .iter()
            .zip(turns)
            .zip(&steps)
            .map(|((m, (k, _)), h)| {
                m.iter()
                    .zip(&r)
                    .map(|(a, b)| (a - b) / (h / k.scale))
                    .collect()
            })
            .collect();
        let mut slope = vec![0.0; n];
        for i in 0..n {
            slope[i] = columns[i].iter().zip(&r).map(|(c, r)| c * r).sum();
            for j in 0..=i {
                let dot: f64 = columns[i].iter().zip(&columns[j]).map(|(a, b)| a * b).sum();
                normal[i * n + j] = dot;
                normal[j * n + i] = dot;
            }
        }
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
    // (JᵀJ)⁻¹·s², as if residuals were white: what such tools print.
    let white = cost / (r.len().saturating_sub(n)).max(1) as f64;
    let sd = (0..n)
        .map(|i| {
            let mut a = normal.clone();
            for k in 0..n {
                a[k * n + k] += 1e-9;
            }
            let mut unit = vec![0.0; n];
            unit[i] = 1.0;
            if solve_spd(&mut a, &mut unit) {
                (unit[i] * white).sqrt() * turns[i].0.scale
            } else {
                f64::INFINITY
            }
        })
        .collect();
    Ok(Fit {
        turns: turns.to_vec(),
        x,
        cost,
        values: r.len(),
        sd,
    })
}

/// Baseline 1, as identification tools do: every one of a fixed list is fitted, and every one whose 95 % interval leaves nothing out is "found".
/// Returns the fit and the names, strongest first.
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

/// The true structure, fitted: what a perfect name would be worth on held-out runs. `None` where it has no knob.
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

/// Baseline 2: covariance matrix adaptation on delay, armature, viscous and Coulomb friction, and bias (Hansen, "The CMA evolution strategy: a
/// tutorial", 2016, with its default weights and rates). Names what moved most, in steps that matter.
///
/// # Errors
/// [`DataError`].
pub fn evolve(data: &CaseData, generations: usize) -> Result<(Fit, Vec<&'static str>), DataError> {
    const LIST: [&str; 5] = [
        "command_delay",
        "armature",
        "viscous_friction",
        "coulomb_friction",
        "encoder_offset",
    ];
    let knobs: Vec<&'static Knob> = LIST.iter().filter_map(|id| knob_of(id)).collect();
    let turns = turns(&knobs, data.model.actuated().len());
    let n = turns.len();
    let dim = n as f64;
    let mut s = Stream::new(Key::for_run(1), Purpose::Action);
    let parents = LANES / 2;
    let raw: Vec<f64> = (0..parents)
        .map(|i| (parents as f64 + 0.5).ln() - (i as f64 + 1.0).ln())
        .collect();
    let total: f64 = raw.iter().sum();
    let weights: Vec<f64> = raw.iter().map(|w| w / total).collect();
    let mass = 1.0 / weights.iter().map(|w| w * w).sum::<f64>();
    let cc = (4.0 + mass / dim) / (dim + 4.0 + 2.0 * mass / dim);
    let cs = (mass + 2.0) / (dim + mass + 5.0);
    let c1 = 2.0 / ((dim + 1.3).powi(2) + mass);
    let cmu = (1.0 - c1).min(2.0 * (mass - 2.0 + 1.0 / mass) / ((dim + 2.0).powi(2) + mass));
    let ds = 1.0 + 2.0 * (((mass - 1.0) / (dim + 1.0)).sqrt() - 1.0).max(0.0) + cs;
    let expected = dim.sqrt() * (1.0 - 1.0 / (4.0 * dim) + 1.0 / (21.0 * dim * dim));
    let (mut mean, mut sigma) = (vec![0.0; n], 1.0);
    let mut cov = vec![0.0; n * n];
    (0..n).for_each(|i| cov[i * n + i] = 1.0);
    let (mut pc, mut ps) = (vec![0.0; n], vec![0.0; n]);
    let place = |y: &[f64]| -> Vec<f64> {
        y.iter()
            .zip(&turns)
            .map(|(y, (k, _))| (y * k.scale).clamp(k.range.0, k.range.1))
            .collect()
    };
    let mut best = (f64::INFINITY, vec![0.0; n], 0usize);
    for _ in 0..generations {
        let root = lower(&cov, n);
        let draws: Vec<Vec<f64>> = (0..LANES)
            .map(|_| (0..n).map(|_| s.normal_f64()).collect())
            .collect();
        let steps: Vec<Vec<f64>> = draws
            .iter()
            .map(|z| {
                (0..n)
                    .map(|i| (0..=i).map(|k| root[i * n + k] * z[k]).sum())
                    .collect()
            })
            .collect();
        let points: Vec<Vec<f64>> = steps
            .iter()
            .map(|d| (0..n).map(|i| mean[i] + sigma * d[i]).collect())
            .collect();
        let setups: Vec<Setup> = points
            .iter()
            .map(|y| turned(&data.model, &turns, &place(y)))
            .collect();
        let residuals = in_lanes(data, &setups)?;
        let mut order: Vec<(f64, usize)> = residuals
            .iter()
            .enumerate()
            .map(|(i, r)| (square(r), i))
            .collect();
        order.sort_by(|a, b| a.0.total_cmp(&b.0));
        if order[0].0 < best.0 {
            best = (order[0].0, place(&points[order[0].1]), residuals[0].len());
        }
        let mix = |from: &[Vec<f64>]| -> Vec<f64> {
            (0..n)
                .map(|i| {
                    weights
                        .iter()
                        .zip(&order)
                        .map(|(w, (_, k))| w * from[*k][i])
                        .sum()
                })
                .collect()
        };
        let (step, draw) = (mix(&steps), mix(&draws));
        for i in 0..n {
            mean[i] += sigma * step[i];
            // with a triangular root the white step is the mixed draw itself
            ps[i] = (1.0 - cs) * ps[i] + (cs * (2.0 - cs) * mass).sqrt() * draw[i];
            pc[i] = (1.0 - cc) * pc[i] + (cc * (2.0 - cc) * mass).sqrt() * step[i];
        }
        for i in 0..n {
            for j in 0..n {
                let rank: f64 = weights
                    .iter()
                    .zip(&order)
                    .map(|(w, (_, k))| w * steps[*k][i] * steps[*k][j])
                    .sum();
                cov[i * n + j] =
                    (1.0 - c1 - cmu) * cov[i * n + j] + c1 * pc[i] * pc[j] + cmu * rank;
            }
        }
        sigma *= (cs / ds * (square(&ps).sqrt() / expected - 1.0)).exp();
    }
    let mut moved: Vec<(f64, &'static str)> = turns
        .iter()
        .zip(&best.1)
        .map(|((k, _), x)| (x.abs() / k.scale, k.effect))
        .collect();
    moved.sort_by(|a, b| b.0.total_cmp(&a.0));
    let names = moved
        .into_iter()
        .filter(|m| m.0 > 1.0)
        .map(|m| m.1)
        .collect();
    Ok((
        Fit {
            turns,
            x: best.1,
            cost: best.0,
            values: best.2,
            sd: Vec::new(),
        },
        names,
    ))
}

/// Lower triangular root of a covariance; what rounding makes negative counts as nothing.
fn lower(a: &[f64], n: usize) -> Vec<f64> {
    let mut l = vec![0.0; n * n];
    for j in 0..n {
        let mut d = a[j * n + j];
        for k in 0..j {
            d -= l[j * n + k] * l[j * n + k];
        }
        l[j * n + j] = d.max(1e-12).sqrt();
        for i in j + 1..n {
            let mut x = a[i * n + j];
            for k in 0..j {
                x -= l[i * n + k] * l[j * n + k];
            }
            l[i * n + j] = x / l[j * n + j];
        }
    }
    l
}
