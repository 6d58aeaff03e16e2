//! Noise of a channel of a run without repeats: what no function of the joint's own command and angle is.
//!
//! The change from sample to sample shows white noise only. What wanders (a filtered speed, a current read
//! beside its pulse) shows in what a free law of the joint leaves of it: a speed is the change of the angle,
//! through any short filter; a torque or a current is any sum of command, angle, speed and its sign. No
//! simulation is asked, so that no cause that moves the joint counts as noise. The law is fitted by
//! least squares with the weights of Huber (P. J. Huber, Robust Statistics, 1981), and the noise is the median
//! of what it leaves: steps, limits and shocks are rarer than half of the samples.

use nalgebra::{DMatrix, DVector};

use caudata_model::RobotModel;

use crate::check::series::median;
use crate::trial::{Kind, Trial};

/// A speed is taken over so long before and after, s.
const HALF_S: f64 = 0.02;
/// Lags of the filter, s.
const LAGS_S: [f64; 4] = [0.0, 0.01, 0.02, 0.04];
/// A joint that is this slow may stick, rad/s.
const STICKS_RADPS: f64 = 0.05;
/// Rounds of weighing.
const WEIGHINGS: usize = 4;

/// Standard deviation of what a law of a joint of `model` leaves of its `values` (SI) of a kind at `time_s`; 0 where
/// that is not known.
pub fn unexplained(
    model: &RobotModel,
    trial: &Trial,
    (kind, index): (Kind, usize),
    time_s: &[f64],
    values: &[f64],
) -> f64 {
    let (Some(angle), Some(command)) =
        (trial.channel(Kind::Position, index), trial.commands.get(index))
    else {
        return 0.0;
    };
    let speed = |t: f64| (angle.at(t + HALF_S) - angle.at(t - HALF_S)) / (2.0 * HALF_S);
    let rows: Vec<Vec<f64>> = (time_s.iter())
        .map(|&t| {
            let mut row = vec![1.0];
            match kind {
                Kind::Velocity => row.extend(LAGS_S.map(|lag| speed(t - lag))),
                _ => {
                    row.extend(LAGS_S.map(|lag| command.at(t - lag)));
                    let v = speed(t);
                    let sign = (v / (STICKS_RADPS * model.per_radian(index))).clamp(-1.0, 1.0);
                    row.extend([angle.at(t), v, sign]);
                }
            }
            row
        })
        .collect();
    left(&rows, values)
}

/// 1.4826 times the median of what the best weights of the columns of `rows` leave of `values`.
fn left(rows: &[Vec<f64>], values: &[f64]) -> f64 {
    let n = rows.first().map_or(0, Vec::len);
    if values.len() < 4 * n {
        return 0.0;
    }
    let mut residual = values.to_vec();
    let mut weight = vec![1.0; values.len()];
    let mut scale = 0.0;
    for _ in 0..WEIGHINGS {
        let mut gram = DMatrix::<f64>::zeros(n, n);
        let mut slope = DVector::<f64>::zeros(n);
        for ((row, w), y) in rows.iter().zip(&weight).zip(values) {
            for i in 0..n {
                slope[i] += w * row[i] * y;
                for j in 0..n {
                    gram[(i, j)] += w * row[i] * row[j];
                }
            }
        }
        for i in 0..n {
            gram[(i, i)] += 1e-9 * (1.0 + gram[(i, i)]);
        }
        let Some(by) = gram.cholesky().map(|c| c.solve(&slope)) else {
            return 0.0;
        };
        for ((r, row), y) in residual.iter_mut().zip(rows).zip(values) {
            *r = y - row.iter().zip(by.iter()).map(|(x, b)| x * b).sum::<f64>();
        }
        let size = residual.iter().map(|r| r.abs()).collect();
        scale = 1.4826 * median(size).unwrap_or(0.0);
        for (w, r) in weight.iter_mut().zip(&residual) {
            *w = (1.345 * scale / r.abs().max(1e-12)).min(1.0);
        }
    }
    scale
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::trial::Channel;
    use caudata_random::{Key, Purpose, Stream};
    use caudata_runlog::BaseHold;

    #[test]
    fn noise_that_wanders_is_found_and_a_late_speed_is_none() {
        let time_s: Vec<f64> = (0..2000).map(|k| f64::from(k) * 0.01).collect();
        let angle = |t: f64| 0.6 * (2.1 * t).sin() + 0.35 * (5.3 * t).sin();
        let speed = |t: f64| 1.26 * (2.1 * t).cos() + 1.855 * (5.3 * t).cos();
        let value: Vec<f64> = time_s.iter().map(|&t| angle(t)).collect();
        let position = Channel {
            kind: Kind::Position,
            index: 0,
            name: "pos".into(),
            time_s: time_s.clone(),
            value,
        };
        let file = concat!(env!("CARGO_MANIFEST_DIR"), "/../robots/xl330_pendulum.robot.toml");
        let model = RobotModel::load(file.as_ref()).unwrap();
        let trial = Trial::bare(BaseHold::Fixed, 20.0, vec![position]);
        let late: Vec<f64> = time_s.iter().map(|&t| 0.97 * speed(t - 0.03)).collect();
        let of = |values: &[f64]| unexplained(&model, &trial, (Kind::Velocity, 0), &time_s, values);
        assert!(of(&late) < 0.02, "{}", of(&late));
        // x ← 0.85·x + √(1 − 0.85²)·0.3·N(0, 1): 0.3, and next to no change from sample to sample
        let mut noise = Stream::new(Key::for_run(3), Purpose::Sensor);
        let mut x = 0.0;
        let wanders: Vec<f64> = (late.iter())
            .map(|v| {
                x = 0.85 * x + (1.0_f64 - 0.85 * 0.85).sqrt() * 0.3 * noise.normal_f64();
                v + x
            })
            .collect();
        assert!((of(&wanders) - 0.3).abs() < 0.06, "{}", of(&wanders));
    }
}
