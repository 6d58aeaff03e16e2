//! Baseline 4: an unnamed residual. Ridge regression of what the nominal robot gets wrong, per channel, on
//! what it predicts and is commanded.

use super::data::{CaseData, DataError};
use super::setup::Setup;
use crate::truth::linear::solve_spd;

/// Weight of the ridge, as a share of the features' own weight.
const RIDGE: f64 = 1e-4;
/// Rows back whose features are also given.
const LAGS: [usize; 3] = [0, 2, 5];

/// Error on held-out runs after over before, geometric mean over channels.
///
/// # Errors
/// [`DataError`].
pub fn holdout_ratio(data: &CaseData) -> Result<f64, DataError> {
    let nominal = Setup::nominal(&data.model);
    let fit = data.shown(&data.fit, &nominal)?;
    let holdout = data.shown(&data.holdout, &nominal)?;
    let servos = data.model.actuated().len();
    let mut log_sum = 0.0;
    for c in 0..3 * servos {
        let a = c % servos;
        let n = 1 + 6 * LAGS.len();
        let (mut normal, mut right) = (vec![0.0; n * n], vec![0.0; n]);
        for run in &fit {
            for k in LAGS[2]..run.shown[c].len() {
                let Some(measured) = run.measured[c][k] else {
                    continue;
                };
                let f = features(run, a, servos, k);
                let off = measured - run.shown[c][k];
                for i in 0..n {
                    right[i] += f[i] * off;
                    for j in 0..=i {
                        normal[i * n + j] += f[i] * f[j];
                    }
                }
            }
        }
        for i in 0..n {
            normal[i * n + i] = normal[i * n + i] * (1.0 + RIDGE) + 1e-9;
        }
        if !solve_spd(&mut normal, &mut right) {
            continue;
        }
        let (mut before, mut after) = (1e-12, 1e-12);
        for run in &holdout {
            for k in LAGS[2]..run.shown[c].len() {
                let Some(measured) = run.measured[c][k] else {
                    continue;
                };
                let off = measured - run.shown[c][k];
                let guess: f64 = features(run, a, servos, k)
                    .iter()
                    .zip(&right)
                    .map(|(f, w)| f * w)
                    .sum();
                before += off * off;
                after += (off - guess) * (off - guess);
            }
        }
        log_sum += 0.5 * f64::ln(after / before);
    }
    Ok((log_sum / (3 * servos) as f64).exp())
}

fn features(run: &super::data::Shown, a: usize, servos: usize, k: usize) -> Vec<f64> {
    let mut out = vec![1.0];
    for lag in LAGS {
        let k = k - lag;
        let (q, v, i) = (
            run.shown[a][k],
            run.shown[servos + a][k],
            run.shown[2 * servos + a][k],
        );
        out.extend([
            run.commands_rad[k][a] - q,
            v,
            (v / 0.05).tanh(),
            q,
            q.sin(),
            i,
        ]);
    }
    out
}
