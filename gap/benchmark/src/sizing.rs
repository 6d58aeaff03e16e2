//! How large an effect is in detectability units, and the size at which it is as large as asked for.

use crate::battery::Trial;
use crate::hidden::{Hidden, World};
use crate::lab::{GenerateError, Rig, lab, run};
use crate::replay::{self, Prediction};
use crate::truth::sensors::Row;

/// Channels that differences are measured in: position, speed, current.
fn channels(rig: &Rig, world: &World) -> Vec<(usize, usize)> {
    let a = rig.model.actuated().len();
    let mut all: Vec<(usize, usize)> = (0..a).map(|i| (0, i)).collect();
    all.extend((0..a).map(|i| (1, i)));
    if world.sensing.log_current {
        all.extend((0..a).map(|i| (2, i)));
    }
    all
}

fn measured(
    rows: &[Row],
    servos: usize,
    kind: usize,
    a: usize,
) -> impl Iterator<Item = Option<f64>> + '_ {
    rows.iter().map(move |(_, row)| row.get((1 + kind) * servos + a).copied().flatten())
}

fn predicted(p: &Prediction, kind: usize, a: usize) -> &[f64] {
    match kind {
        0 => &p.pos_rad[a],
        1 => &p.vel_radps[a],
        _ => &p.current_a[a],
    }
}

/// What a robot without effects looks like in this lab: its rows per trial, how far repeats are apart
/// (noise), and how far the nominal simulation is off (null discrepancy).
pub struct NullView {
    pub(crate) rows: Vec<Vec<Row>>,
    sigma: Vec<Vec<f64>>,
    /// Whitened norm of measured minus nominal simulation, per value.
    pub discrepancy: f64,
}

/// Runs the null of a lab on its fit trials.
pub fn null_view(rig: &Rig, trials: &[Trial], seed: u64) -> Result<NullView, GenerateError> {
    let world = lab(&rig.model, seed);
    let servos = rig.model.actuated().len();
    let (mut all_rows, mut sigmas) = (Vec::new(), Vec::new());
    let (mut sum, mut count) = (0.0, 0.0);
    for (i, trial) in trials.iter().enumerate() {
        let (commands, rows, day) = run(rig, &world, trial, seed, 10 * i as u64, None)?;
        let (_, again, _) = run(rig, &world, trial, seed, 10 * i as u64 + 1, None)?;
        let mut params = caudata_sim::LaneParams::nominal(&rig.model);
        params.supply_v = day.spec.supply_v as f32;
        let nominal = replay::predict(&rig.model, &[params], &commands, &commands.sent_s)?;
        let mut sigma = Vec::new();
        for (kind, a) in channels(rig, &world) {
            let pairs = measured(&rows, servos, kind, a).zip(measured(&again, servos, kind, a));
            let (mut s, mut n) = (0.0, 0.0);
            for (x, y) in pairs {
                if let (Some(x), Some(y)) = (x, y) {
                    s += 0.5 * (x - y) * (x - y);
                    n += 1.0;
                }
            }
            let sd = f64::sqrt(s / f64::max(n, 1.0)).max(1e-6);
            sigma.push(sd);
            for (x, p) in measured(&rows, servos, kind, a).zip(predicted(&nominal[0], kind, a)) {
                if let Some(x) = x {
                    sum += ((x - p) / sd).powi(2);
                    count += 1.0;
                }
            }
        }
        all_rows.push(rows);
        sigmas.push(sigma);
    }
    Ok(NullView { rows: all_rows, sigma: sigmas, discrepancy: (sum / f64::max(count, 1.0)).sqrt() })
}

/// Size of what `world` does beyond the null, in detectability units.
pub(crate) fn detectability(
    rig: &Rig,
    world: &World,
    trials: &[Trial],
    view: &NullView,
    seed: u64,
) -> Result<f64, GenerateError> {
    let servos = rig.model.actuated().len();
    let (mut sum, mut count) = (0.0, 0.0);
    for (i, trial) in trials.iter().enumerate() {
        let (_, rows, _) = run(rig, world, trial, seed, 10 * i as u64, None)?;
        for (c, (kind, a)) in channels(rig, world).into_iter().enumerate() {
            let sd = view.sigma[i][c];
            let pairs =
                measured(&rows, servos, kind, a).zip(measured(&view.rows[i], servos, kind, a));
            for (x, y) in pairs {
                if let (Some(x), Some(y)) = (x, y) {
                    sum += ((x - y) / sd).powi(2);
                    count += 1.0;
                }
            }
        }
    }
    Ok((sum / f64::max(count, 1.0)).sqrt() / view.discrepancy)
}

/// Finds the size at which the effect alone has `d` detectability units. Returns the size and the d reached.
pub(crate) fn size_for(
    rig: &Rig,
    hidden: &Hidden,
    joint: usize,
    sign: f64,
    d: f64,
    trials: &[Trial],
    view: &NullView,
    seed: u64,
) -> Result<(f64, f64), GenerateError> {
    let measure = |size: f64| -> Result<f64, GenerateError> {
        let mut world = lab(&rig.model, seed);
        hidden.apply(&mut world, &rig.model, joint, sign * size);
        detectability(rig, &world, trials, view, seed)
    };
    let (first, most) = hidden.sizes;
    let mut low: Option<(f64, f64)> = None;
    let mut high: Option<(f64, f64)> = None;
    let mut size = first;
    let mut best = (first, 0.0);
    for _ in 0..12 {
        let got = measure(size)?;
        if best.1 == 0.0 || (got / d).ln().abs() < (best.1 / d).ln().abs() {
            best = (size, got);
        }
        if (got / d).ln().abs() < 0.12 {
            return Ok((size, got));
        }
        if got < d {
            low = Some((size, got));
        } else {
            high = Some((size, got));
        }
        size = match (low, high) {
            (Some(l), Some(h)) => (l.0 * h.0).sqrt(),
            (Some(l), None) if l.0 >= most => {
                return Err(GenerateError::TooSmall {
                    effect: hidden.id.to_owned(),
                    reached: l.1,
                    asked: d,
                });
            }
            (Some(l), None) => (l.0 * (d / l.1.max(1e-3)).clamp(1.3, 4.0)).min(most),
            (None, Some(h)) => h.0 * (d / h.1).clamp(0.1, 0.8),
            (None, None) => size,
        };
    }
    // within a third is as asked; further off it would stand in the wrong column
    if (best.1 / d).ln().abs() < 0.3 {
        return Ok(best);
    }
    Err(GenerateError::TooSmall { effect: hidden.id.to_owned(), reached: best.1, asked: d })
}
