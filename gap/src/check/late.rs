//! Time from a command to its reading: none can be negative, and none longer than a servo needs.

use super::channels::{Channels, sound};
use super::finding::{Finding, Run};
use super::series::{best_lag, median, slope, smooth, together};

/// Longest time from a command to its effect that any servo needs, s. More is a fault of the stamps.
pub(super) const LONGEST_LAG_S: f64 = 0.3;
/// Lags that are looked at, s.
pub(super) const LAG_RANGE_S: f64 = 0.6;
/// An error that no servo leaves, rad …
const ASKS_RAD: f64 = 0.15;
/// … nor one that asks it for this share of its torque.
const ASKS_SHARE: f64 = 0.3;
/// So long a joint rests under an unchanged command before it is asked for much, s.
const RESTS_S: f64 = 0.3;
/// A motion is more than so many counts, and than it swings meanwhile …
const RESTS_COUNTS: f64 = 3.0;
/// … of which what is asked for must be so many times as much.
const SWINGS: f64 = 5.0;
/// Longest time from much being asked to the first motion, s: the longest delay that an effect of the
/// catalogue may have, and what a servo at 0.3 of its torque needs for a few counts.
const LONGEST_DEAD_S: f64 = 0.13;
/// So often it must be seen.
const OFTEN: usize = 2;
/// Correlation of the speeds of command and reading from which on their lag is known.
const FITS: f64 = 0.6;

/// Says where readings and commands were stamped by clocks that differ.
pub(super) fn faults(run: &Run<'_>, joints: &[Channels], out: &mut Vec<Finding>) {
    let before = out.len();
    let joints = &sound(joints, out);
    let lags = lags(run, joints);
    cause_before_effect(&lags, out);
    if out.len() == before {
        dead_time(run, joints, out);
    }
    if out.len() == before {
        slow(run, joints, &lags, out);
    }
}

/// How late a joint follows its command.
struct Lag<'a> {
    name: &'a str,
    s: f64,
    r: f64,
    /// Whether no servo can be so late, or early, and no lag that one can have goes nearly as well.
    impossible: bool,
}

/// An error that asks a servo for so much that nothing holds it back, rad. (A weak servo does not get through
/// friction: what counts goes with its gain.)
pub(super) fn asks_much_rad(run: &Run<'_>, joint: &Channels) -> f64 {
    let (kp, servo) = (run.gains(joint.index).0, run.robot.servo(joint.index));
    (ASKS_RAD * joint.per_radian).max(ASKS_SHARE * servo.tau_max_nm / kp.max(1e-6))
}

/// A joint at rest that does not stir for longer than any servo and any delay takes.
fn dead_time(run: &Run<'_>, joints: &[&Channels], out: &mut Vec<Finding>) {
    let seen: Vec<(&str, Vec<f64>)> =
        (joints.iter()).map(|j| (j.name.as_str(), dead_times_s(run, j))).collect();
    let all: Vec<f64> = seen.iter().flat_map(|(_, s)| s.iter().copied()).collect();
    let count = all.len();
    let Some(dead_s) = median(all).filter(|d| count >= OFTEN && *d > LONGEST_DEAD_S) else {
        return;
    };
    let most = seen.iter().max_by_key(|(_, s)| s.len());
    let name = most.map_or("", |(name, _)| name);
    let detail = format!(
        "does not stir for {:.0} ms after its command jumps ({count} times): readings are late, or stamped by another clock",
        1e3 * dead_s
    );
    out.push(Finding::fatal("stamps", format!("pos.{name}"), detail));
}

/// Times from much being asked of a joint that rests to its first motion, s.
fn dead_times_s(run: &Run<'_>, joint: &Channels) -> Vec<f64> {
    let (Some(cmd), Some(pos)) = (&joint.cmd, &joint.pos) else { return Vec::new() };
    let grid = &run.grid;
    let far = asks_much_rad(run, joint);
    let count = run.robot.servo(joint.index).encoder_lsb_rad();
    let (rest, range) = (grid.points(RESTS_S), grid.points(LAG_RANGE_S));
    let mut times_s = Vec::new();
    let mut i = rest;
    while i < cmd.len() {
        let before = i - rest..i;
        let (u, q) = (cmd[i - 1], pos[i - 1]);
        let rests = cmd[i] != u && cmd[before.clone()].iter().all(|x| *x == u);
        i += 1;
        if !rests {
            continue;
        }
        // it may still swing a little
        let spread = |m: f64, x: &f64| if m > (x - q).abs() { m } else { (x - q).abs() };
        let swings = pos[before].iter().fold(0.0, spread);
        let still = RESTS_COUNTS * count + 1.5 * swings;
        let far = far.max(SWINGS * swings);
        let within = i - 1..(i - 1 + range).min(cmd.len());
        let asked = |k: &usize| (cmd[*k] - u).abs() > far && (cmd[*k] - q).abs() > far;
        let moved = |k: &usize| (pos[*k] - q).abs() > still;
        if let (Some(asked), Some(moved)) = (within.clone().find(asked), within.clone().find(moved))
        {
            times_s.push(moved.saturating_sub(asked) as f64 * grid.step_s);
            i = asked.max(moved) + rest;
        }
    }
    times_s
}

/// Lags of all joints that move, by the speeds of command and reading.
fn lags<'a>(run: &Run<'_>, joints: &[&'a Channels]) -> Vec<Lag<'a>> {
    let grid = &run.grid;
    let fine = grid.points(0.04);
    let most = grid.points(LAG_RANGE_S) as isize;
    let late = grid.points(LONGEST_LAG_S) as isize;
    let rate = |x: &[f64]| slope(&smooth(x, fine), fine.div_ceil(2), grid.step_s);
    let of = |joint: &'a Channels| {
        let (u, q) = (rate(joint.cmd.as_ref()?), rate(joint.pos.as_ref()?));
        if together(&u, &q, 0).first_sd < 0.1 {
            return None;
        }
        let (any, possible) = (best_lag(&u, &q, -most..=most), best_lag(&u, &q, 0..=late));
        // a periodic motion fits a period off, too: one that no servo has must be clearly better
        let (lag, at_lag) = if any.1.r > possible.1.r + 0.15 { any } else { possible };
        let s = lag as f64 * grid.step_s;
        let outside = s < -(2.5 * grid.step_s).max(0.02) || s > LONGEST_LAG_S;
        Some(Lag { name: &joint.name, s, r: at_lag.r, impossible: outside && at_lag.r > FITS })
    };
    joints.iter().copied().filter_map(of).collect()
}

/// A position that moves before its command was sent, or much later than any servo: stamps of two clocks.
fn cause_before_effect(lags: &[Lag<'_>], out: &mut Vec<Finding>) {
    let wrong: Vec<&Lag<'_>> = lags.iter().filter(|l| l.impossible).collect();
    // stamps are wrong for all joints; a single one may swing on its own gain, a period off
    if 2 * wrong.len() <= lags.len() {
        return;
    }
    if let Some(lag) = wrong.iter().max_by(|a, b| a.r.total_cmp(&b.r)) {
        let how = if lag.s < 0.0 { "before" } else { "after" };
        let detail = format!(
            "moves {:.0} ms {how} its command (correlation {:.2}; {} joint(s)): commands and readings were stamped by different clocks or shifted",
            1e3 * lag.s.abs(),
            lag.r,
            wrong.len()
        );
        out.push(Finding::fatal("stamps", format!("pos.{}", lag.name), detail));
    }
}

/// Joints that follow their commands later than the servos of the robot file do by what no delay accounts for.
/// In smooth motions nobody can tell late readings from a slow servo, so that this is a note.
fn slow(run: &Run<'_>, joints: &[&Channels], lags: &[Lag<'_>], out: &mut Vec<Finding>) {
    let over = |lag: &&Lag<'_>| {
        let own = joints.iter().find(|j| j.name == lag.name);
        lag.r > FITS && own.is_some_and(|j| lag.s > LONGEST_DEAD_S + servo_lag_s(run, j))
    };
    let slow: Vec<&Lag<'_>> = lags.iter().filter(over).collect();
    if 2 * slow.len() <= lags.len() {
        return;
    }
    let Some(lag) = slow.iter().max_by(|a, b| a.r.total_cmp(&b.r)) else { return };
    let detail = format!(
        "follows its command {:.0} ms late ({} joint(s)): readings are late, or the servo is much slower than in the robot file. Steps from rest tell which",
        1e3 * lag.s,
        slow.len()
    );
    out.push(Finding::note("stamps", format!("pos.{}", lag.name), detail));
}

/// By how much a servo of the robot file follows a slow motion late, s: damping over gain.
fn servo_lag_s(run: &Run<'_>, joint: &Channels) -> f64 {
    let servo = run.robot.servo(joint.index);
    let (kp, kd) = run.gains(joint.index);
    (kd + servo.damping_nm_s_per_rad) / kp.max(1e-6)
}
