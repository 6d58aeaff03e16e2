//! What is left: where it is, on which arguments it depends, a formula that describes it, the nearest effect.

use nalgebra::{DMatrix, DVector};

use super::product::dot;
use super::search::Found;
use super::state::Context;
use crate::report::Unexplained;
use crate::trial::Kind;

/// A channel whose share of the misfit is below this, floors, is no leftover.
const LEFTOVER: f64 = 0.2;
/// An argument matters if it explains this share of what is left.
const MATTERS: f64 = 0.05;

/// Per joint signal of held-out runs, worst first, at most three.
pub fn leftover(context: &Context, found: &Found) -> Vec<Unexplained> {
    let judge = &context.fit;
    let on = &found.best.fit;
    let mut cells: Vec<(f64, Kind, usize, String)> = Vec::new();
    for segment in &judge.data.segments {
        for piece in &segment.pieces {
            let part = &on.residual[piece.range.clone()];
            let square = dot(part, part);
            let name = &judge.data.trials[segment.trial].channels[piece.channel].name;
            match cells.iter_mut().find(|c| c.1 == piece.kind && c.2 == piece.index) {
                Some(c) => c.0 += square,
                None => cells.push((square, piece.kind, piece.index, name.clone())),
            }
        }
    }
    cells.sort_by(|a, b| b.0.total_cmp(&a.0));
    let n = judge.data.len().max(1) as f64;
    let nearest = found
        .refused
        .iter()
        .filter_map(|(s, w)| s.terms.last().map(|t| (t, w)))
        .max_by(|a, b| a.1.fit.total_cmp(&b.1.fit))
        .map(|(t, _)| t.place.label(t.effect.id));
    cells
        .into_iter()
        .filter(|c| c.0 / n > LEFTOVER)
        .take(3)
        .map(|(_, kind, index, name)| {
            let (depends_on, description) = depends(context, found, kind, index);
            Unexplained {
                location: format!("{}.{name}", kind.name()),
                depends_on,
                description,
                nearest: nearest.clone(),
            }
        })
        .collect()
}

/// Which arguments the residual of a channel depends on: least squares on generic terms, stepwise.
fn depends(context: &Context, found: &Found, kind: Kind, index: usize) -> (Vec<String>, String) {
    let data = &context.fit.data;
    let mut rows: Vec<(f64, Vec<f64>)> = Vec::new();
    for segment in &data.segments {
        let trial = &data.trials[segment.trial];
        for piece in segment.pieces.iter().filter(|p| p.kind == kind && p.index == index) {
            let joint = if kind.of_joint() { index } else { 0 };
            let Some(position) = trial.channel(Kind::Position, joint) else {
                continue;
            };
            for k in piece.range.clone().step_by(3) {
                let t = data.time_s[k];
                let q = position.at(t);
                let ahead = position.at(t + 0.03);
                let behind = position.at(t - 0.03);
                let v = (ahead - behind) / 0.06;
                let e = trial.commands.get(joint).map_or(0.0, |c| c.at(t)) - q;
                let raw = data.value[k] - f64::from(found.best.fit.prediction[k]);
                rows.push((raw, library(q, v, e, t - segment.start_s)));
            }
        }
    }
    if rows.len() < 50 {
        return (Vec::new(), "too few samples to say".to_owned());
    }
    let mut chosen: Vec<usize> = Vec::new();
    let total = residual_energy(&rows, &[]).0;
    let mut left = total;
    let mut weights = Vec::new();
    for _ in 0..3 {
        let best = (0..NAMES.len())
            .filter(|i| !chosen.contains(i))
            .map(|i| {
                let mut with = chosen.clone();
                with.push(i);
                let (energy, w) = residual_energy(&rows, &with);
                (energy, i, w)
            })
            .min_by(|a, b| a.0.total_cmp(&b.0));
        let Some((energy, i, w)) = best else { break };
        if left - energy < MATTERS * total {
            break;
        }
        left = energy;
        chosen.push(i);
        weights = w;
    }
    if chosen.is_empty() {
        return (
            Vec::new(),
            "depends on none of angle, speed, error, time in a simple way".to_owned(),
        );
    }
    let mut arguments: Vec<String> = Vec::new();
    for i in &chosen {
        let a = ARGUMENTS[*i].to_owned();
        if !arguments.contains(&a) {
            arguments.push(a);
        }
    }
    let formula: Vec<String> =
        chosen.iter().zip(&weights).map(|(i, w)| format!("{w:+.3e}·{}", NAMES[*i])).collect();
    let share = 100.0 * (1.0 - left / total.max(1e-300));
    (
        arguments,
        format!(
            "measured − simulated ≈ {} {} ({share:.0} % of what is left)",
            formula.join(" "),
            kind.unit()
        ),
    )
}

const NAMES: [&str; 14] = [
    "1",
    "q",
    "q²",
    "sin q",
    "q̇",
    "|q̇|",
    "q̇·|q̇|",
    "sign q̇",
    "sign q̇·exp(−|q̇|/0.1)",
    "e",
    "|e|·sign q̇",
    "sin 8q",
    "q·q̇",
    "t",
];
const ARGUMENTS: [&str; 14] = [
    "offset",
    "angle",
    "angle",
    "angle",
    "speed",
    "speed",
    "speed",
    "direction",
    "direction",
    "load",
    "load",
    "angle",
    "angle",
    "time",
];

fn library(q: f64, v: f64, e: f64, t: f64) -> Vec<f64> {
    let s = (v / 0.05).clamp(-1.0, 1.0);
    vec![
        1.0,
        q,
        q * q,
        q.sin(),
        v,
        v.abs(),
        v * v.abs(),
        s,
        s * (-v.abs() / 0.1).exp(),
        e,
        e.abs() * s,
        (8.0 * q).sin(),
        q * v,
        t,
    ]
}

/// What is left of the rows after least squares on `terms`, and their weights.
fn residual_energy(rows: &[(f64, Vec<f64>)], terms: &[usize]) -> (f64, Vec<f64>) {
    let n = terms.len();
    let mut gram = DMatrix::zeros(n, n);
    let mut right = DVector::zeros(n);
    let mut energy = 0.0;
    for (y, x) in rows {
        energy += y * y;
        for (i, a) in terms.iter().enumerate() {
            right[i] += x[*a] * y;
            for (j, b) in terms.iter().enumerate() {
                gram[(i, j)] += x[*a] * x[*b];
            }
        }
    }
    for i in 0..n {
        gram[(i, i)] = gram[(i, i)] * (1.0 + 1e-9) + 1e-12;
    }
    let weights = gram.cholesky().map_or_else(|| DVector::zeros(n), |c| c.solve(&right));
    (energy - weights.dot(&right), weights.as_slice().to_vec())
}
