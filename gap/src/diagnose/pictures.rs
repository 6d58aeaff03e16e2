//! Numbers for the page's pictures.

use std::collections::BTreeMap;

use super::gates;
use super::naming::Named;
use super::search::Found;
use super::signature;
use super::state::{Context, State};
use crate::plots::{Horizon, Hypothesis, Overlay, Plots};
use crate::trial::Kind;

/// Overlays that are drawn.
const OVERLAYS: usize = 6;
/// Length of an overlay, s.
const OVERLAY_S: f64 = 8.0;
/// Horizons, s.
const HORIZONS_S: [f64; 5] = [0.2, 0.5, 1.0, 2.0, 5.0];

/// All of them.
/// `model`: the one that goes into the extended file.
pub fn plots(context: &Context, found: &Found, model: &State, named: &[Named]) -> Plots {
    Plots {
        overlays: overlays(context, found, model),
        signatures: signature::signatures(context, found, named),
        horizons: horizons(context, found, model),
        hypotheses: hypotheses(context, found, named),
        correlation: Default::default(),
    }
}

fn overlays(context: &Context, found: &Found, model: &State) -> Vec<Overlay> {
    let judge = &context.holdout;
    let data = &judge.data;
    let mut worst: Vec<(f64, usize, usize)> = Vec::new();
    for (s, segment) in data.segments.iter().enumerate() {
        for (p, piece) in segment.pieces.iter().enumerate() {
            let part = &found.base.holdout.residual[piece.range.clone()];
            let mean = part.iter().map(|r| f64::from(*r).powi(2)).sum::<f64>() / part.len() as f64;
            worst.push((mean, s, p));
        }
    }
    worst.sort_by(|a, b| b.0.total_cmp(&a.0));
    let mut seen: Vec<(Kind, usize, usize)> = Vec::new();
    let mut out = Vec::new();
    for (_, s, p) in worst {
        let segment = &data.segments[s];
        let piece = &segment.pieces[p];
        let trial = &data.trials[segment.trial];
        let key = (piece.kind, piece.index, trial.group);
        if seen.contains(&key) || out.len() == OVERLAYS {
            continue;
        }
        seen.push(key);
        let last = data.time_s[piece.range.start] + OVERLAY_S;
        let range: Vec<usize> = piece.range.clone().filter(|&k| data.time_s[k] <= last).collect();
        let repeats: Vec<_> = (data.trials.iter())
            .filter(|t| t.group == trial.group)
            .filter_map(|t| {
                t.channel(piece.kind, piece.index).map(|c| (t.span_s.0 - trial.span_s.0, c))
            })
            .collect();
        let band = |&k: &usize| {
            let (own, sigma) = (data.value[k], f64::from(judge.noise.sigma[k]));
            let all = repeats.iter().map(|(shift, c)| c.at(data.time_s[k] + shift));
            all.fold((own - sigma, own + sigma), |(low, high), v| (low.min(v), high.max(v)))
        };
        let (low, high): (Vec<f64>, Vec<f64>) = range.iter().map(band).unzip();
        let of = |x: &dyn Fn(usize) -> f64| -> Vec<f64> { range.iter().map(|&k| x(k)).collect() };
        let some = |x: Vec<f64>| x.into_iter().map(Some).collect();
        out.push(Overlay {
            run: trial.name.clone(),
            signal: piece.kind.name().to_owned(),
            joint: trial.channels[piece.channel].name.clone(),
            unit: piece.kind.unit_at(context.replayer.model(), piece.index).to_owned(),
            time_s: of(&|k| data.time_s[k]),
            command: match piece.kind {
                Kind::Position => of(&|k| trial.commands[piece.index].at(data.time_s[k])),
                _ => Vec::new(),
            },
            measured: some(of(&|k| data.value[k])),
            measured_low: some(low),
            measured_high: some(high),
            before: of(&|k| f64::from(found.base.holdout.prediction[k])),
            after: match model.terms.is_empty() && context.losses.is_none() {
                true => Vec::new(),
                false => of(&|k| f64::from(model.holdout.prediction[k])),
            },
        });
    }
    out
}

/// Error after so much time since the start of a stretch.
fn horizons(context: &Context, found: &Found, model: &State) -> Vec<Horizon> {
    let judge = &context.holdout;
    let data = &judge.data;
    let mut by_kind: BTreeMap<Kind, Vec<[f64; 4]>> = BTreeMap::new();
    for (segment, piece) in data.parts() {
        let rows =
            by_kind.entry(piece.kind).or_insert_with(|| vec![[0.0; 4]; HORIZONS_S.len() + 1]);
        for k in piece.range.clone() {
            let age = data.time_s[k] - segment.start_s;
            let off = |model: &State| data.value[k] - f64::from(model.holdout.prediction[k]);
            let squares = [off(&found.base), off(model), f64::from(judge.noise.sigma[k])];
            for (h, row) in rows.iter_mut().enumerate() {
                if HORIZONS_S.get(h).is_none_or(|limit| age <= *limit) {
                    row.iter_mut().zip(squares).for_each(|(sum, x)| *sum += x * x);
                    row[3] += 1.0;
                }
            }
        }
    }
    let longest = data.segments.iter().map(|s| s.duration_s()).fold(0.0, f64::max);
    by_kind
        .into_iter()
        .map(|(kind, rows)| {
            let of =
                |i: usize| rows.iter().map(|r| (r[i] / r[3].max(1.0)).sqrt()).collect::<Vec<_>>();
            let mut horizon_s = HORIZONS_S.to_vec();
            horizon_s.push(longest.max(HORIZONS_S[HORIZONS_S.len() - 1]));
            Horizon {
                signal: kind.name().to_owned(),
                unit: kind.unit_of_all(context.replayer.model()),
                horizon_s,
                before: of(0),
                after: if model.terms.is_empty() && context.losses.is_none() {
                    Vec::new()
                } else {
                    of(1)
                },
                floor: of(2),
            }
        })
        .collect()
}

fn hypotheses(context: &Context, found: &Found, named: &[Named]) -> Vec<Hypothesis> {
    let mut out = Vec::new();
    let of = |state: &State,
              index: usize,
              from: &State,
              probability: f64,
              accepted: bool,
              in_set: bool| {
        let term = &state.terms[index];
        let worth = gates::worth(context, from, state, Some(&term.place));
        let excess_fit = gates::part(&context.fit, &from.fit, Some(&term.place)).max(1e-9);
        let excess = worth.of.max(1e-9);
        Hypothesis {
            effect: term.effect.id.to_owned(),
            location: term.place.names.clone(),
            share_fit: worth.fit / excess_fit,
            share_holdout: worth.cross / excess,
            ci_low: worth.interval.0 / excess,
            ci_high: worth.interval.1 / excess,
            probability,
            in_answer_set: in_set,
            accepted,
            parameters: (term.effect.parameters.iter().zip(&term.values))
                .map(|(p, v)| (p.name.to_owned(), *v))
                .collect(),
        }
    };
    for n in named {
        out.push(of(&found.best, n.index, &n.without, n.probability, true, true));
        for r in &n.rivals {
            out.push(of(&r.state, r.index, &n.without, r.probability, false, r.in_set));
        }
    }
    if named.is_empty() {
        for (state, _) in &found.singles {
            out.push(of(state, state.terms.len() - 1, &found.base, 0.0, false, false));
        }
    }
    out
}
