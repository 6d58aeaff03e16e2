//! The picture that shows a cause by its own mark, from held-out runs.

use super::motion::Motion;
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
    let names = context.replayer.model().actuated_names();
    (named.iter())
        .filter_map(|n| {
            let term = &found.best.terms[n.index];
            let joint = match term.place.domain {
                Domain::Joints => term.place.items.first().copied()?,
                _ => 0,
            };
            let (argument, x_label): (Argument, _) = match (term.effect.layer, term.effect.id) {
                (Layer::Timing, _) => (|_, change| change, "change of command (rad/s)"),
                (Layer::Inertia, _)
                | (
                    _,
                    "encoder_offset" | "encoder_gain" | "cogging" | "hard_stop" | "parallel_spring",
                ) => (|m, _| m.q_rad, "angle (rad)"),
                (
                    Layer::Actuation,
                    "kp_error"
                    | "torque_limit"
                    | "controller_dead_band"
                    | "stale_gains"
                    | "winding_resistance",
                ) => (|m, _| m.error_rad, "command − position (rad)"),
                _ => (|m, _| m.qd_radps, "speed (rad/s)"),
            };
            let x_label = match Kind::Position.unit_at(context.replayer.model(), joint) {
                "m" => x_label.replace("angle", "position").replace("rad", "m"),
                _ => x_label.to_owned(),
            };
            let kind = [Kind::Current, Kind::Torque, Kind::Position].into_iter().find(|k| {
                context.holdout.data.trials.iter().any(|t| t.channel(*k, joint).is_some())
            })?;
            let kind = if term.effect.layer == Layer::Timing { Kind::Position } else { kind };
            map(context, found, joint, kind, argument).map(|series| Signature {
                effect: term.effect.id.to_owned(),
                joint: names.get(joint).copied().unwrap_or_default().to_owned(),
                title: format!("measured − simulated {} against {}", kind.name(), x_label),
                x_label,
                y_label: format!("difference ({})", kind.unit_at(context.replayer.model(), joint)),
                series,
            })
        })
        .collect()
}

/// What a picture has along its axis, in a joint's motion and the change of its command, rad/s.
type Argument = fn(&Motion, f64) -> f64;

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
    for (segment, piece) in data.parts().filter(|(_, p)| p.kind == kind && p.index == joint) {
        let trial = &data.trials[segment.trial];
        let Some(position) = trial.channel(Kind::Position, joint) else {
            continue;
        };
        let command = &trial.commands[joint];
        for k in piece.range.clone() {
            let t = data.time_s[k];
            let change = (command.at(t + 0.03) - command.at(t - 0.03)) / 0.06;
            let x = argument(&Motion::at(position, Some(command), t), change);
            let left = |on: &On| data.value[k] - f64::from(on.prediction[k]);
            rows.push((x, left(&found.base.holdout), left(&found.best.holdout)));
        }
    }
    if rows.len() < 10 * BINS {
        return None;
    }
    rows.sort_by(|a, b| a.0.total_cmp(&b.0));
    let each = rows.len().div_ceil(BINS);
    let series = |label: &str, pick: &dyn Fn(&(f64, f64, f64)) -> f64| {
        let (mut x, mut y, mut spread) = (Vec::new(), Vec::new(), Vec::new());
        for bin in rows.chunks(each) {
            let n = bin.len() as f64;
            let mean = bin.iter().map(pick).sum::<f64>() / n;
            let var = bin.iter().map(|r| (pick(r) - mean).powi(2)).sum::<f64>() / n;
            x.push(bin.iter().map(|r| r.0).sum::<f64>() / n);
            y.push(mean);
            spread.push(var.sqrt());
        }
        Series { label: label.to_owned(), scatter: false, x, y, spread }
    };
    Some(vec![series("before", &|r| r.1), series("after", &|r| r.2)])
}
