//! Baseline 4: an unnamed residual. Ridge regression of what the nominal robot gets wrong, per channel, on
//! what it predicts and is commanded.

use caudata_gap::replay::{Segment, Variant};
use caudata_gap::trial::{Channel, Kind};

use super::data::{CaseData, DataError, Part};
use crate::truth::linear::solve_spd;

/// Weight of the ridge, as a share of the features' own weight.
const RIDGE: f64 = 1e-4;
/// How far back features are also given, s.
const LAGS_S: [f64; 3] = [0.0, 0.02, 0.05];

/// Features of every sample of channel `kind` of joint `a`, and its place in the flat vector.
fn rows(part: &Part, shown: &[f32], kind: Kind, a: usize) -> Vec<(usize, Vec<f64>)> {
    let mut out = Vec::new();
    for segment in &part.data.segments {
        let commands = &part.data.trials[segment.trial].commands[a];
        let predicted = [Kind::Position, Kind::Velocity, Kind::Current]
            .map(|kind| series(part, segment, shown, kind, a));
        for piece in (segment.pieces.iter()).filter(|p| (p.kind, p.index) == (kind, a)) {
            for k in piece.range.clone() {
                let mut features = vec![1.0];
                for lag_s in LAGS_S {
                    let t = part.data.time_s[k] - lag_s;
                    let at = |c: &Option<Channel>| c.as_ref().map_or(0.0, |c| c.at(t));
                    let [q, v, i] = [0, 1, 2].map(|n| at(&predicted[n]));
                    let error = commands.at(t) - q;
                    features.extend([error, v, (v / 0.05).tanh(), q, q.sin(), i]);
                }
                out.push((k, features));
            }
        }
    }
    out
}

/// What is predicted of a channel in a stretch.
fn series(part: &Part, s: &Segment, shown: &[f32], kind: Kind, index: usize) -> Option<Channel> {
    let piece = (s.pieces.iter()).find(|p| (p.kind, p.index) == (kind, index))?;
    Some(Channel {
        kind,
        index,
        name: String::new(),
        time_s: part.data.time_s[piece.range.clone()].to_vec(),
        value: shown[piece.range.clone()].iter().map(|x| f64::from(*x)).collect(),
    })
}

/// Error on held-out runs after over before, geometric mean over channels.
pub fn holdout_ratio(data: &CaseData) -> Result<f64, DataError> {
    let nominal = [Variant::new()];
    let shown = |part: &Part| data.replayer.predict(&part.data, &nominal);
    let (fit, held) = (shown(&data.fit)?.remove(0), shown(&data.holdout)?.remove(0));
    let off = |part: &Part, shown: &[f32], k: usize| part.data.value[k] - f64::from(shown[k]);
    let before: Vec<f64> = (0..held.len()).map(|k| off(&data.holdout, &held, k)).collect();
    let mut after = before.clone();
    for a in 0..data.model().actuated().len() {
        for kind in [Kind::Position, Kind::Velocity, Kind::Current] {
            let n = 1 + 6 * LAGS_S.len();
            let (mut normal, mut right) = (vec![0.0; n * n], vec![0.0; n]);
            for (k, f) in rows(&data.fit, &fit, kind, a) {
                for i in 0..n {
                    right[i] += f[i] * off(&data.fit, &fit, k);
                    for j in 0..=i {
                        normal[i * n + j] += f[i] * f[j];
                    }
                }
            }
            for i in 0..n {
                normal[i * n + i] = normal[i * n + i] * (1.0 + RIDGE) + 1e-9;
            }
            if solve_spd(&mut normal, &mut right) {
                for (k, f) in rows(&data.holdout, &held, kind, a) {
                    after[k] -= f.iter().zip(&right).map(|(f, w)| f * w).sum::<f64>();
                }
            }
        }
    }
    Ok(data.holdout.ratio(&before, &after))
}
