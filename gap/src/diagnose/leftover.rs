//! What is left: where it is, on which arguments it depends, a formula that describes it, the nearest effect.

use nalgebra::{DMatrix, DVector};

use super::levels::RIGHT_LEAVES;
use super::motion::Motion;
use super::product::dot;
use super::search::Found;
use super::state::Context;
use crate::report::Unexplained;
use crate::trial::Kind;

/// An argument matters if it explains this share of what is left.
const MATTERS: f64 = 0.05;

/// Per joint signal of held-out runs, worst first, at most three.
pub fn leftover(context: &Context, found: &Found) -> Vec<Unexplained> {
    let judge = &context.fit;
    let on = &found.best.fit;
    let mut cells: Vec<(f64, Kind, usize, String)> = Vec::new();
    for (segment, piece) in judge.data.parts() {
        let part = &on.residual[piece.range.clone()];
        let square = dot(part, part);
        match cells.iter_mut().find(|c| c.1 == piece.kind && c.2 == piece.index) {
            Some(c) => c.0 += square,
            None => {
                let name = &judge.data.trials[segment.trial].channels[piece.channel].name;
                cells.push((square, piece.kind, piece.index, name.clone()));
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
        .map(|(t, _)| t.label());
    cells
        .into_iter()
        .filter(|c| c.0 / n > RIGHT_LEAVES)
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
    let joint = if kind.of_joint() { index } else { 0 };
    let mut rows: Vec<(f64, Vec<f64>)> = Vec::new();
    for (segment, piece) in data.parts().filter(|(_, p)| p.kind == kind && p.index == index) {
        let trial = &data.trials[segment.trial];
        let Some(position) = trial.channel(Kind::Position, joint) else {
            continue;
        };
        for k in piece.range.clone().step_by(3) {
            let t = data.time_s[k];
            let motion = Motion::at(position, trial.commands.get(joint), t);
            let raw = data.value[k] - f64::from(found.best.fit.prediction[k]);
            let terms = LIBRARY.iter().map(|(_, _, of)| of(&motion, t - segment.start_s));
            rows.push((raw, terms.collect()));
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
        let with = |i: usize| [&chosen[..], &[i]].concat();
        let others = (0..LIBRARY.len()).filter(|i| !chosen.contains(i));
        let best = others
            .map(|i| (i, residual_energy(&rows, &with(i))))
            .min_by(|a, b| a.1.0.total_cmp(&b.1.0));
        let Some((i, (energy, w))) = best.filter(|b| left - b.1.0 >= MATTERS * total) else {
            break;
        };
        (left, weights) = (energy, w);
        chosen.push(i);
    }
    let mut arguments: Vec<String> = Vec::new();
    for i in &chosen {
        if !arguments.iter().any(|a| a == LIBRARY[*i].1) {
            arguments.push(LIBRARY[*i].1.to_owned());
        }
    }
    if chosen.is_empty() {
        let none = "depends on none of angle, speed, error, time in a simple way";
        return (arguments, none.to_owned());
    }
    let terms = chosen.iter().zip(&weights);
    let formula: Vec<String> = terms.map(|(i, w)| format!("{w:+.3e}·{}", LIBRARY[*i].0)).collect();
    let share = 100.0 * (1.0 - left / total.max(1e-300));
    let (formula, unit) = (formula.join(" "), kind.unit_at(context.replayer.model(), index));
    (arguments, format!("measured − simulated ≈ {formula} {unit} ({share:.0} % of what is left)"))
}

/// A term as people write it, what it is of, and its value in a motion so long after a stretch began.
type Generic = (&'static str, &'static str, fn(&Motion, f64) -> f64);

/// −1 to 1, by the direction of a speed.
fn sign(m: &Motion) -> f64 {
    (m.qd_radps / 0.05).clamp(-1.0, 1.0)
}

const LIBRARY: [Generic; 14] = [
    ("1", "offset", |_, _| 1.0),
    ("q", "angle", |m, _| m.q_rad),
    ("q²", "angle", |m, _| m.q_rad.powi(2)),
    ("sin q", "angle", |m, _| m.q_rad.sin()),
    ("q̇", "speed", |m, _| m.qd_radps),
    ("|q̇|", "speed", |m, _| m.qd_radps.abs()),
    ("q̇·|q̇|", "speed", |m, _| m.qd_radps * m.qd_radps.abs()),
    ("sign q̇", "direction", |m, _| sign(m)),
    ("sign q̇·exp(−|q̇|/0.1)", "direction", |m, _| sign(m) * (-m.qd_radps.abs() / 0.1).exp()),
    ("e", "load", |m, _| m.error_rad),
    ("|e|·sign q̇", "load", |m, _| m.error_rad.abs() * sign(m)),
    ("sin 8q", "angle", |m, _| (8.0 * m.q_rad).sin()),
    ("q·q̇", "angle", |m, _| m.q_rad * m.qd_radps),
    ("t", "time", |_, t| t),
];

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
