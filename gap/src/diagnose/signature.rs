//! The picture that shows a cause by its own mark, from held-out runs.

use super::naming::Named;
use super::search::Found;
use super::state::{Context, On};
use crate::effects::{Domain, Layer};
use crate::plots::{Series, Signature};
use crate::trial::Kind;

/// Bins of a map.
const BINS: usize = 16;

/// One per cause.
pub fn signatures(context: &Context, found: &Found, named: &[Named]) -> Vec<Signature> {
    let mut order: Vec<&Named> = named.iter().collect();
    order.sort_by(|a, b| b.worth.cross.total_cmp(&a.worth.cross));
    order
        .into_iter()
        .filter_map(|n| {
            let term = &found.best.terms[n.index];
            let joint = match term.place.domain {
                Domain::Joints => term.place.items.first().copied()?,
                _ => 0,
            };
            let (argument, x_label) = match (term.effect.layer, term.effect.id) {
                (Layer::Timing, _) => (Argument::CommandSpeed, "change of command (rad/s)"),
                (
                    _,
                    "encoder_offset" | "encoder_gain" | "cogging" | "hard_stop" | "parallel_spring",
                ) => (Argument::Angle, "angle (rad)"),
                (Layer::Inertia, _) => (Argument::Angle, "angle (rad)"),
                (
                    Layer::Actuation,
                    "kp_error"
                    | "torque_limit"
                    | "controller_dead_band"
                    | "stale_gains"
                    | "winding_resistance",
                ) => (Argument::Error, "command − position (rad)"),
                _ => (Argument::Speed, "speed (rad/s)"),
            };
            let kind = [Kind::Current, Kind::Torque, Kind::Position].into_iter().find(|k| {
                context.holdout.data.trials.iter().any(|t| t.channel(*k, joint).is_some())
            })?;
            let kind = if term.effect.layer == Layer::Timing { Kind::Position } else { kind };
            map(context, found, joint, kind, argument).map(|series| Signature {
                effect: term.effect.id.to_owned(),
                joint: context
                    .replayer
                    .model()
                    .actuated_names()
                    .get(joint)
                    .map_or(String::new(), |n| (*n).to_owned()),
                title: format!("measured − simulated {} against {}", kind.name(), x_label),
                x_label: x_label.to_owned(),
                y_label: format!("difference ({})", kind.unit()),
                series,
            })
        })
        .collect()
}

#[derive(Clone, Copy)]
enum Argument {
    Angle,
    Speed,
    Error,
    CommandSpeed,
}

/// Mean difference in bins of an argument, before and after.
fn map(
    context: &Context,
    found: &Found,
    joint: usize,
    kind: Kind,
    argument: Argument,
) -> Option<Vec<Series>> {
    let data = &context.holdout.data;
    let mut rows: Vec<(f64, f64, f64)> = Vec::new();
    for segment in &data.segments {
        let trial = &data.trials[segment.trial];
        let Some(position) = trial.channel(Kind::Position, joint) else {
            continue;
        };
        for piece in segment.pieces.iter().filter(|p| p.kind == kind && p.index == joint) {
            for k in piece.range.clone() {
                let t = data.time_s[k];
                let q = position.at(t);
                let command = |t: f64| trial.commands[joint].at(t);
                let x = match argument {
                    Argument::Angle => q,
                    Argument::Error => command(t) - q,
                    Argument::Speed => {
                        let (a, b) = (position.at(t - 0.03), position.at(t + 0.03));
                        (b - a) / 0.06
                    }
                    Argument::CommandSpeed => (command(t + 0.03) - command(t - 0.03)) / 0.06,
                };
                let left = |on: &On| data.value[k] - f64::from(on.prediction[k]);
                rows.push((x, left(&found.base.holdout), left(&found.best.holdout)));
            }
        }
    }
    if rows.len() < 10 * BINS {
        return None;
    }
    rows.sort_by(|a, b| a.0.total_cmp(&b.0));
    let each = rows.len().div_ceil(BINS);
    let series = |label: &str, pick: &dyn Fn(&(f64, f64, f64)) -> f64| {
        let mut s = Series {
            label: label.to_owned(),
            scatter: false,
            x: Vec::new(),
            y: Vec::new(),
            spread: Vec::new(),
        };
        for bin in rows.chunks(each) {
            let n = bin.len() as f64;
            let mean = bin.iter().map(pick).sum::<f64>() / n;
            let var = bin.iter().map(|r| (pick(r) - mean).powi(2)).sum::<f64>() / n;
            s.x.push(bin.iter().map(|r| r.0).sum::<f64>() / n);
            s.y.push(mean);
            s.spread.push(var.sqrt());
        }
        s
    };
    Some(vec![series("before", &|r| r.1), series("after", &|r| r.2)])
}
