//! Screening: what would each effect at each place explain of what is left, by its traces at a grid of sizes.
//!
//! One trace per size serves for all places of a joint effect at once: all joints get it together, and each
//! joint's channels are judged on their own. (Joints of a held robot hardly move each other; whoever passes
//! is fitted in earnest afterwards.)

use std::borrow::Cow;

use caudata_model::RobotModel;

use super::judge::{Judge, concerns};
use super::product::dot;
use super::state::{Context, On, State, builds_up};
use super::tracking::scaling;
use crate::effects::{Domain, Effect, Place};
use crate::error::GapError;
use crate::replay::{Term, Variant};

/// Predictions kept in memory at once, bytes.
const MEMORY_BYTES: usize = 256 * 1024 * 1024;
/// Starts that are kept per candidate.
const STARTS: usize = 3;

/// A candidate that was screened.
#[derive(Debug, Clone)]
pub struct Screened {
    /// Which effect.
    pub effect: &'static Effect,
    /// Where.
    pub place: Place,
    /// Fall of the misfit that its best size promises.
    pub gain: f64,
    /// Values to start a fit from, best first. SI.
    pub starts: Vec<Vec<f64>>,
    /// Mean square of its trace per grid point, largest sensitivity: misfit per (size of grid point)².
    pub traces: Vec<(Vec<f64>, f64)>,
}

/// Screens every effect that the context allows, at every place, on top of `state`.
///
/// # Errors
/// As [`crate::replay::Replayer::predict`].
pub fn screen(context: &Context, state: &State) -> Result<Vec<Screened>, GapError> {
    let model = context.replayer.model();
    let mut plan: Vec<(&'static Effect, Place, usize, Variant)> = Vec::new();
    for &effect in &context.effects {
        let all = effect.places(model);
        let simulated: Vec<Place> = match effect.domain {
            Domain::Joints => all.into_iter().take(1).collect(),
            _ => all,
        };
        for place in simulated {
            if !open(context, state, effect, &place) {
                continue;
            }
            for k in 0..effect.grid.len() {
                let values = effect.sizes(model, &place, k);
                let mut variant = state.terms.clone();
                variant.push(Term {
                    effect,
                    place: place.clone(),
                    values,
                });
                plan.push((effect, place.clone(), k, variant));
            }
        }
    }
    let mut out: Vec<Screened> = Vec::new();
    let (slow, quick): (Vec<_>, Vec<_>) = plan
        .into_iter()
        .partition(|p| context.scout.is_some() && builds_up(p.0));
    let scout = Look {
        judge: context.first_look(),
        on: state.on_scout(),
        basis: &state.basis,
        dilution: context.scout.as_ref().map_or(1.0, |s| s.dilution),
    };
    // what takes long to build up shows in whole runs only (what other parameters can do there is not known,
    // and not asked)
    let whole = Look {
        judge: &context.fit,
        on: &state.fit,
        basis: &[],
        dilution: 1.0,
    };
    for (look, plan) in [(&scout, quick), (&whole, slow)] {
        let data = &look.judge.data;
        let at_once = (MEMORY_BYTES / (8 * data.len().max(1))).max(16);
        for batch in plan.chunks(at_once) {
            let variants: Vec<Variant> = batch.iter().map(|p| p.3.clone()).collect();
            let predictions = context.replayer.predict(data, &variants)?;
            for ((effect, place, k, _), prediction) in batch.iter().zip(&predictions) {
                if !Judge::sound(prediction) {
                    continue;
                }
                let change = look.judge.change(prediction, &look.on.prediction);
                for place in judged_places(context, effect, place) {
                    judge(context, look, state, effect, &place, *k, &change, &mut out);
                }
            }
        }
    }
    for s in &mut out {
        s.traces.sort_by(|a, b| a.1.total_cmp(&b.1));
    }
    out.sort_by(|a, b| b.gain.total_cmp(&a.gain));
    Ok(out)
}

/// Whether the runs can show an effect at a place, and the model does not have it.
fn open(context: &Context, state: &State, effect: &Effect, place: &Place) -> bool {
    let mut had = state.terms.iter();
    (effect.unseen)(&context.excitation, place).is_none()
        && !had.any(|t| t.effect == effect && t.place == *place)
}

/// Places that a simulated trace speaks for.
fn judged_places(context: &Context, effect: &'static Effect, simulated: &Place) -> Vec<Place> {
    if effect.domain == Domain::Joints {
        effect.places(context.replayer.model())
    } else {
        vec![simulated.clone()]
    }
}

/// Where candidates are looked at: runs, how the present model does on them, and what its parameters can do
/// there.
struct Look<'a> {
    judge: &'a Judge,
    on: &'a On,
    basis: &'a [Vec<f32>],
    /// What a sample of all runs shows over what one of these shows.
    dilution: f64,
}

/// `change` in the channels of a place's joints, and nothing elsewhere.
fn in_joints_of(place: &Place, judge: &Judge, change: &[f32]) -> Vec<f32> {
    let mut trace = change.to_vec();
    for piece in judge.data.segments.iter().flat_map(|s| &s.pieces) {
        if !concerns(place, piece.kind, piece.index) || !piece.kind.of_joint() {
            trace[piece.range.clone()].fill(0.0);
        }
    }
    trace
}

impl Screened {
    /// Takes a start that promises `gain`: the best stays first.
    fn take(&mut self, gain: f64, start: Vec<f64>) {
        let place = if gain > self.gain {
            self.gain = gain;
            0
        } else {
            1.min(self.starts.len())
        };
        self.starts.insert(place, start);
        // a smooth effect of one parameter has one way down
        self.starts.truncate(match self.effect.hinge {
            true => STARTS,
            false => self.effect.parameters.len().min(2),
        });
    }
}

/// Shares of `sizes` that a smooth effect may have instead: up to three times as much either way, as far as its
/// bounds go. One that is nothing at its bound has one way.
fn shares(
    effect: &Effect,
    model: &RobotModel,
    place: &Place,
    sizes: &[f64],
    neutral: &[f64],
) -> (f64, f64) {
    let back = |i: usize| {
        let (low, high) = effect.bounds(model, place, i);
        match sizes[i] - neutral[i] {
            up if up > 0.0 => (low - neutral[i]) / up,
            down if down < 0.0 => (high - neutral[i]) / down,
            _ => f64::NEG_INFINITY,
        }
    };
    let low = scaling(effect).map(back).fold(-3.0, f64::max);
    (if low < 0.0 { low } else { 0.05 }, 3.0)
}

fn judge(
    context: &Context,
    look: &Look<'_>,
    state: &State,
    effect: &'static Effect,
    place: &Place,
    k: usize,
    change: &[f32],
    out: &mut Vec<Screened>,
) {
    let model = context.replayer.model();
    if !open(context, state, effect, place) {
        return;
    }
    let n = change.len().max(1) as f64;
    let whole =
        place.domain != Domain::Joints || place.names.is_empty() || model.actuated().len() == 1;
    let trace: Cow<'_, [f32]> = match whole {
        true => change.into(),
        false => in_joints_of(place, look.judge, change).into(),
    };
    let trace: &[f32] = &trace;
    let residual = &look.on.residual;
    let (rd, dd) = (dot(residual, trace), dot(trace, trace));
    if dd < 1e-6 * n {
        return;
    }
    // less what parameters that are free already can do
    let (mut prd, mut pdd) = (rd, dd);
    for q in look.basis {
        let (qd, qr) = (dot(q, trace), dot(q, residual));
        prd -= qd * qr;
        pdd -= qd * qd;
    }
    let pdd = pdd.max(0.01 * dd);
    let sizes = effect.sizes(model, place, k);
    let neutral = effect.neutral(model, place);
    let (low, high) = match effect.hinge {
        true => (0.4, 1.6),
        false => shares(effect, model, place, &sizes, &neutral),
    };
    let share = (prd / pdd).clamp(low, high);
    let projected = (2.0 * share * prd - share * share * pdd) / n;
    let direct = (2.0 * rd - dd) / n;
    let gain = projected.max(direct);
    let start: Vec<f64> = if effect.hinge {
        sizes.clone()
    } else {
        // how many ripples there are in a turn does not grow with them
        let mut start = sizes.clone();
        for i in scaling(effect) {
            let (low, high) = effect.bounds(model, place, i);
            start[i] = (neutral[i] + share * (sizes[i] - neutral[i])).clamp(low, high);
        }
        start
    };
    let known = out
        .iter()
        .position(|s| s.effect == effect && s.place == *place);
    let entry = &mut match known {
        Some(k) => out[k..].first_mut(),
        None => {
            out.push(Screened {
                effect,
                place: place.clone(),
                gain: f64::NEG_INFINITY,
                starts: Vec::new(),
                traces: Vec::new(),
            });
            out.last_mut()
        }
    };
    let Some(entry) = entry else { return };
    entry.traces.push((sizes, look.dilution * dd / n));
    entry.take(gain, start);
}
