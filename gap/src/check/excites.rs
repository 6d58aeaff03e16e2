//! What a run excites: speeds, loads, frequencies, reversals, per joint and in all.

use std::collections::BTreeMap;

use caudata_runlog::{BaseHold, Signal};
use serde::{Deserialize, Serialize};

use super::channels::Channels;
use super::finding::Run;
use super::series::{slope, smooth};

/// Frequencies at which a command's share is asked for, Hz: half-octaves.
const BAND_HZ: [f64; 16] =
    [0.1, 0.14, 0.2, 0.28, 0.4, 0.57, 0.8, 1.13, 1.6, 2.26, 3.2, 4.5, 6.4, 9.0, 12.8, 18.0];
/// A speed below this is rest, rad/s.
const REST_RADPS: f64 = 0.02;
/// Up to this speed motion counts as slow, rad/s: friction at rest and near it shows there.
const SLOW_RADPS: f64 = 0.3;
/// From this speed on as fast, rad/s.
const FAST_RADPS: f64 = 1.5;
/// A hold lasts at least so long, s.
const HOLD_S: f64 = 0.4;

/// What one joint did in a run.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct JointExcitation {
    /// Joint.
    pub joint: String,
    /// Least and greatest position, rad.
    pub range_rad: [f64; 2],
    /// Greatest speed (mean over 60 ms), rad/s.
    pub speed_max_radps: f64,
    /// Root mean square speed, rad/s.
    pub speed_rms_radps: f64,
    /// Time in slow motion (0.02 to 0.3 rad/s), s.
    pub slow_s: f64,
    /// Time in fast motion (from 1.5 rad/s), s.
    pub fast_s: f64,
    /// Distinct positions (5 per radian) at which it rested for 0.4 s or more.
    pub holds: usize,
    /// Longest rest, s.
    pub longest_hold_s: f64,
    /// Changes of direction of the command (of the position, where there is none).
    pub reversals: usize,
    /// Those among the reversals that come after less than 15 mrad on both sides.
    pub small_reversals: usize,
    /// Band that the command fills, Hz: from the lowest to the highest half-octave with a real share of its
    /// motion; 0 where there is none.
    pub band_hz: [f64; 2],
    /// Jumps of the command: below 0.1 rad, to 0.5 rad, above.
    pub steps: [usize; 3],
    /// Time let go, s.
    pub off_s: f64,
    /// Root mean square of command minus position, rad.
    pub error_rms_rad: f64,
    /// Root mean square of the torque that the gain asks for, as a share of the servo's greatest.
    pub effort: f64,
}

/// What a run offers in all.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct RunExcitation {
    /// s.
    pub duration_s: f64,
    /// How the base was held.
    pub base: BaseHold,
    /// Kinds of columns with samples: `cmd`, `pos`, `imu.gyro`, `foot`, …, and how many of each.
    pub channels: BTreeMap<String, usize>,
    /// Joints, policy order.
    pub joints: Vec<JointExcitation>,
    /// Rise of the warmest servo, K; 0 where temperatures were not logged.
    pub warming_k: f64,
}

/// Describes a run.
pub(super) fn of(run: &Run<'_>, joints: &[Channels]) -> RunExcitation {
    let mut channels = BTreeMap::new();
    for signal in run.log.table.signals() {
        let sampled = run.log.table.column(signal);
        if sampled.is_some_and(|c| c.iter().any(Option::is_some)) {
            *channels.entry(kind(signal)).or_insert(0) += 1;
        }
    }
    let warming_k = joints
        .iter()
        .filter_map(|j| {
            let t = run.grid.held(&run.log.table, &Signal::Temperature(j.name.clone()))?;
            let first = t.iter().find(|x| x.is_finite())?;
            Some(t.iter().filter(|x| x.is_finite()).fold(0.0, |m: f64, x| m.max(x - first)))
        })
        .fold(0.0, f64::max);
    RunExcitation {
        duration_s: run.grid.len as f64 * run.grid.step_s,
        base: run.log.meta.base,
        channels,
        joints: joints.iter().map(|j| joint(run, j)).collect(),
        warming_k,
    }
}

/// `pos`, `imu.gyro`, `foot`: the column's name without joint, leg, marker and axis.
pub(super) fn kind(signal: &Signal) -> String {
    let text = signal.to_string();
    let keep = if text.starts_with("imu.") || text.starts_with("base.") { 2 } else { 1 };
    let parts: Vec<&str> = text.split('.').take(keep).collect();
    parts.join(".")
}

fn joint(run: &Run<'_>, c: &Channels) -> JointExcitation {
    let grid = &run.grid;
    let step_s = grid.step_s;
    let mut out = JointExcitation { joint: c.name.clone(), ..JointExcitation::default() };
    // limits are angles: of a slide everything is looked at in what counts as a radian
    let in_radians = |x: &Option<Vec<f64>>| -> Option<Vec<f64>> {
        Some(x.as_ref()?.iter().map(|v| v / c.per_radian).collect())
    };
    let (cmd, pos) = (in_radians(&c.cmd), in_radians(&c.pos));
    if let Some(on) = &c.on {
        out.off_s = on.iter().filter(|x| **x == 0.0).count() as f64 * step_s;
    }
    if let Some(pos) = &pos {
        let half = (grid.points(0.06) / 2).max(1);
        let speed = slope(&smooth(pos, 2 * half), half, step_s);
        // one count of an encoder in 0.25 s is 6 mrad/s: rest is told from slow motion
        let calm = slope(&smooth(pos, grid.points(0.25)), (grid.points(0.25) / 2).max(1), step_s);
        let known = || pos.iter().copied().filter(|x| x.is_finite());
        out.range_rad =
            [known().fold(f64::INFINITY, f64::min), known().fold(f64::NEG_INFINITY, f64::max)];
        if known().next().is_none() {
            out.range_rad = [0.0; 2];
        }
        let size = || speed.iter().filter(|v| v.is_finite()).map(|v| v.abs());
        let time = |low: f64, high: f64| {
            size().filter(|v| (low..high).contains(v)).count() as f64 * step_s
        };
        out.speed_max_radps = size().fold(0.0, f64::max);
        let count = size().count().max(1) as f64;
        out.speed_rms_radps = (size().map(|v| v * v).sum::<f64>() / count).sqrt();
        let slow = |v: &&f64| (REST_RADPS..SLOW_RADPS).contains(&v.abs());
        out.slow_s = calm.iter().filter(slow).count() as f64 * step_s;
        out.fast_s = time(FAST_RADPS, f64::INFINITY);
        holds(pos, &calm, grid.points(HOLD_S), step_s, &mut out);
        if cmd.is_none() {
            reversals(&smooth(pos, 2 * half), &mut out);
        }
    }
    if let Some(cmd) = &cmd {
        let jump = |w: &[f64]| (w[1] - w[0]).abs();
        for size in cmd.windows(2).map(jump).filter(|x| *x > 0.02) {
            // a chirp's or ramp's change per point is smaller than this unless it is faster than any servo
            if size / step_s > 3.0 {
                out.steps[usize::from(size >= 0.1) + usize::from(size >= 0.5)] += 1;
            }
        }
        out.band_hz = band(cmd, step_s);
        // of the command: a reading reverses with every count
        reversals(cmd, &mut out);
        if let Some(pos) = &pos {
            let squares: Vec<f64> = cmd
                .iter()
                .zip(pos)
                .map(|(u, q)| (u - q).powi(2))
                .filter(|x| x.is_finite())
                .collect();
            let mean = squares.iter().sum::<f64>() / squares.len().max(1) as f64;
            out.error_rms_rad = mean.sqrt() * c.per_radian;
            out.effort =
                run.gains(c.index).0 * out.error_rms_rad / run.robot.servo(c.index).tau_max_nm;
        }
    }
    out.range_rad = out.range_rad.map(|x| x * c.per_radian);
    out.speed_max_radps *= c.per_radian;
    out.speed_rms_radps *= c.per_radian;
    out
}

fn holds(pos: &[f64], speed: &[f64], least: usize, step_s: f64, out: &mut JointExcitation) {
    let mut places = std::collections::BTreeSet::new();
    let mut from = None;
    for i in 0..=pos.len() {
        let rests = i < pos.len() && speed[i].abs() < REST_RADPS;
        match (rests, from) {
            (true, None) => from = Some(i),
            (false, Some(start)) => {
                if i - start >= least {
                    out.longest_hold_s = out.longest_hold_s.max((i - start) as f64 * step_s);
                    places.insert((5.0 * pos[start]).round() as i64);
                }
                from = None;
            }
            _ => {}
        }
    }
    out.holds = places.len();
}

/// Turning points, with 1.5 mrad of play so that noise does not count.
fn reversals(pos: &[f64], out: &mut JointExcitation) {
    const PLAY_RAD: f64 = 0.0015;
    const SMALL_RAD: f64 = 0.015;
    let mut known = pos.iter().copied().filter(|x| x.is_finite());
    let Some(first) = known.next() else { return };
    // the last turning point, the farthest from it since, and the way there
    let (mut turn, mut far, mut way) = (first, first, 0.0_f64);
    let mut travel = f64::INFINITY;
    for x in known {
        if way == 0.0 && (x - first).abs() > PLAY_RAD {
            way = (x - first).signum();
        }
        if way * (x - far) >= 0.0 {
            far = x;
        } else if way * (far - x) > PLAY_RAD {
            let size = (far - turn).abs();
            out.reversals += 1;
            out.small_reversals += usize::from(size < SMALL_RAD && travel < SMALL_RAD);
            (travel, turn, far, way) = (size, far, x, -way);
        }
    }
}

/// Lowest and highest half-octave with at least 4 % of the strongest one's speed.
fn band(cmd: &[f64], step_s: f64) -> [f64; 2] {
    let known: Vec<f64> = cmd.iter().map(|x| if x.is_finite() { *x } else { 0.0 }).collect();
    let n = known.len();
    let mean = known.iter().sum::<f64>() / n.max(1) as f64;
    let span_s = n as f64 * step_s;
    let sizes: Vec<f64> = BAND_HZ
        .iter()
        .map(|&f| {
            if f > 0.4 / step_s || f * span_s < 1.0 {
                return 0.0;
            }
            // three lines across the half-octave, each with a window against leakage
            [0.9, 1.0, 1.12].iter().map(|k| line(&known, mean, f * k * step_s)).fold(0.0, f64::max)
                * f
        })
        .collect();
    let most = sizes.iter().copied().fold(0.0, f64::max);
    // at least about 1 mrad of amplitude at 1 Hz
    if most < 1e-3 {
        return [0.0; 2];
    }
    let filled: Vec<f64> = BAND_HZ
        .iter()
        .zip(&sizes)
        .filter(|(_, s)| **s > 0.04 * most && **s > 5e-4)
        .map(|(f, _)| *f)
        .collect();
    match (filled.first(), filled.last()) {
        (Some(&low), Some(&high)) => [low, high],
        _ => [0.0; 2],
    }
}

/// Amplitude at `cycles` per point (Goertzel with a Hann window).
fn line(x: &[f64], mean: f64, cycles: f64) -> f64 {
    let w = std::f64::consts::TAU * cycles;
    let c = 2.0 * w.cos();
    let n = x.len().max(1) as f64;
    let (mut s1, mut s2) = (0.0, 0.0);
    for (i, v) in x.iter().enumerate() {
        let window = 0.5 - 0.5 * (std::f64::consts::TAU * i as f64 / n).cos();
        let s = (v - mean) * window + c * s1 - s2;
        s2 = s1;
        s1 = s;
    }
    (s1 * s1 + s2 * s2 - c * s1 * s2).max(0.0).sqrt() * 4.0 / n
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reversals_and_bands_of_a_sine() {
        // 1 Hz, 10 s, 0.3 rad at 100 Hz: two reversals a second
        let x: Vec<f64> =
            (0..1000).map(|i| 0.3 * (std::f64::consts::TAU * f64::from(i) / 100.0).sin()).collect();
        let mut out = JointExcitation::default();
        reversals(&x, &mut out);
        assert_eq!((out.reversals, out.small_reversals), (20, 0));
        let [low, high] = band(&x, 0.01);
        assert!((0.5..1.2).contains(&low) && (0.8..1.7).contains(&high), "{low} {high}");
        assert!((line(&x, 0.0, 0.01) - 0.3).abs() < 0.01); // the amplitude
        // 5 mrad back and forth
        let small: Vec<f64> = x.iter().map(|v| v / 60.0).collect();
        let mut out = JointExcitation::default();
        reversals(&small, &mut out);
        assert!(out.small_reversals >= 17, "{}", out.small_reversals);
    }
}
