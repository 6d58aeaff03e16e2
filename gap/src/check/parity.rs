//! Relations that hold whatever the robot does: speed is the change of position, gravity is 9.81 m/s² down,
//! turning turns gravity.

use std::f64::consts::TAU;

use caudata_runlog::{Axis, BaseHold, QuatPart, Signal};

use super::channels::{Channels, sound};
use super::excites::{JointExcitation, RunExcitation};
use super::finding::{Finding, MAYBE_HELD, Run};
use super::series::{AGAINST, Together, best_lag, median, slope, smooth, together};

/// Speeds are compared as means over so long, s: encoder steps vanish.
const PARITY_WINDOW_S: f64 = 0.15;
/// Longest lag of a speed estimate, s.
const LAG_S: f64 = 0.12;
/// Speeds below this (standard deviation, rad/s or m/s) tell nothing.
const MOVES: f64 = 0.08;
/// The ratio of a speed to the change of position may be off one by this factor: a filter takes some of it
/// away.
const RATIO: f64 = 1.5;
/// No torque is so many times what a servo can do.
const ABSURD_TORQUE: f64 = 20.0;
/// Least correlation of a speed with the change of position.
const LEAST_R: f64 = 0.6;

pub(super) fn faults(run: &Run<'_>, joints: &[Channels], out: &mut Vec<Finding>) {
    let speeds: Vec<(&Channels, Together)> = sound(joints, out)
        .into_iter()
        .filter_map(|j| Some((j, speed_parity(run, j.pos.as_ref()?, j.vel.as_ref()?)?)))
        .collect();
    // All speeds off by the same factor: it is the clock.
    if speeds.len() >= 2 && speeds.iter().all(|(_, t)| t.r > LEAST_R) {
        let ratios: Vec<f64> = speeds.iter().map(|(_, t)| t.slope).collect();
        let mean = ratios.iter().sum::<f64>() / ratios.len() as f64;
        let alike = ratios.iter().all(|r| (r / mean - 1.0).abs() < 0.1);
        let known_unit = unit_factor(mean).is_some();
        if alike && !known_unit && !(1.0 / RATIO..RATIO).contains(&mean) && mean > 0.0 {
            let detail = format!(
                "every joint's speed is {mean:.2} times its change of position per time: time runs at the wrong rate"
            );
            out.push(Finding::fatal("stamps", "t", detail));
            return;
        }
    }
    for (joint, t) in speeds {
        let at = format!("vel.{}", joint.name);
        if let Some(f) = speed_fault(t, &at, &format!("pos.{}", joint.name)) {
            out.push(f);
        }
    }
    second_encoders(run, joints, out);
    beside(run, joints, out);
    imu(run, out);
    base(run, out);
    plain_ranges(run, joints, out);
}

/// Whether speeds and torques that are commanded beside positions are in their units, and joints that get them alone
/// are not held at a position as well.
fn beside(run: &Run<'_>, joints: &[Channels], out: &mut Vec<Finding>) {
    for joint in joints {
        let of = |of: fn(String) -> Signal| run.grid.held(&run.log.table, &of(joint.name.clone()));
        let (speed, torque) = (of(Signal::CommandVelocity), of(Signal::CommandTorque));
        let kp = run.gains(joint.index).0;
        if joint.cmd.is_none() && (speed.is_some() || torque.is_some()) && kp > 0.0 {
            let name = &joint.name;
            let detail = format!(
                "is missing, and the gain of `{name}` is {kp:.3}: where it is sent no position, write `kp = 0` under `[joint.{name}]` in {}",
                run.log.meta_name
            );
            out.push(joint.fatal("columns", "cmd", detail));
        }
        let parity = joint.cmd.as_ref().zip(speed.as_ref());
        let parity = parity.and_then(|(cmd, speed)| speed_parity(run, cmd, speed));
        if let Some(t) = parity.filter(|t| t.r > LEAST_R)
            && let Some(unit) = unit_factor(t.slope)
        {
            let detail = format!(
                "is {:.1} times the change of `cmd.{}` per second; is it in {unit}?",
                t.slope, joint.name
            );
            out.push(joint.fatal("unit", "cmd_vel", detail));
        }
        let (most, most_nm) =
            (largest(torque.iter().flatten()), run.robot.servo(joint.index).tau_max_nm);
        if most > ABSURD_TORQUE * most_nm {
            let detail = format!(
                "reaches {most:.0} where the servo can do {most_nm:.1} N·m; is it in another unit?"
            );
            out.push(joint.fatal("unit", "cmd_tau", detail));
        }
    }
}

/// Encoders on either side of a gear do not differ by more all the time, rad: play and springs give on both sides.
const OTHER_ZERO_RAD: f64 = 0.05;

/// What varies by less than this share of itself, in the middle, stays.
const STAYS: f64 = 0.2;

/// Whether second encoders have the zero of the first.
fn second_encoders(run: &Run<'_>, joints: &[Channels], out: &mut Vec<Finding>) {
    for joint in joints {
        let second = run.grid.linear(&run.log.table, &Signal::SecondPosition(joint.name.clone()));
        let (Some(first), Some(second)) = (&joint.pos, second) else { continue };
        let apart: Vec<f64> = second.iter().zip(first).map(|(b, a)| b - a).collect();
        let Some(off) = median(apart.clone()) else { continue };
        let from_it = apart.iter().map(|d| (d - off).abs()).collect();
        let varies = median(from_it).unwrap_or(0.0);
        if off.abs() > OTHER_ZERO_RAD * joint.per_radian {
            let detail = format!(
                "is {off:+.2} {} from `pos.{}` all the time: its zero is another one, take that off it",
                joint.unit, joint.name
            );
            // a spring under load is off as well, and not always by the same
            out.push(match varies < STAYS * off.abs() {
                true => joint.fatal("zero", "pos2", detail),
                false => joint.note("zero", "pos2", detail),
            });
        }
    }
}

/// The change of `pos` per time against `speed`, at the lag where they go best together; `None` where nothing
/// moves.
pub(super) fn speed_parity(run: &Run<'_>, pos: &[f64], speed: &[f64]) -> Option<Together> {
    let grid = &run.grid;
    let width = grid.points(PARITY_WINDOW_S).max(2);
    let half = width / 2;
    let change = slope(pos, half, grid.step_s);
    let mean = smooth(speed, 2 * half);
    let lags = grid.points(LAG_S) as isize;
    let (_, t) = best_lag(&change, &mean, 0..=lags);
    let turned = together(&change, &mean, 0);
    let t = if turned.r < -t.r.abs() { turned } else { t };
    (t.points >= grid.points(1.0) && t.first_sd > MOVES).then_some(t)
}

/// The unit that stands behind a ratio of speeds.
fn unit_factor(ratio: f64) -> Option<&'static str> {
    let near = |x: f64| (ratio / x - 1.0).abs() < 0.12;
    [
        (57.2958, "deg/s"),
        (9.5493, "rev/min"),
        (0.159_155, "rev/s"),
        (41.7, "counts of 0.229 rev/min"),
        (1000.0, "thousandths"),
    ]
    .into_iter()
    .find_map(|(x, name)| near(x).then_some(name))
}

fn speed_fault(t: Together, at: &str, of: &str) -> Option<Finding> {
    if t.r < AGAINST {
        let detail = format!(
            "goes against the change of {of} (correlation {:.2}); turn the sign of one of them",
            t.r
        );
        return Some(Finding::fatal("sign", at.to_owned(), detail));
    }
    if t.r < LEAST_R {
        let detail = format!(
            "does not follow the change of {of} (correlation {:.2}); is it another joint's, or stuck?",
            t.r
        );
        return Some(Finding::fatal("parity", at.to_owned(), detail));
    }
    if let Some(unit) = unit_factor(t.slope) {
        let detail =
            format!("is {:.1} times the change of {of} per second; is it in {unit}?", t.slope);
        return Some(Finding::fatal("unit", at.to_owned(), detail));
    }
    if !(1.0 / RATIO..RATIO).contains(&t.slope) {
        let detail = format!("is {:.2} times the change of {of} per second", t.slope);
        return Some(Finding::fatal("parity", at.to_owned(), detail));
    }
    None
}

/// Three channels of a vector, if the log has them all.
fn vector(run: &Run<'_>, of: fn(Axis) -> Signal) -> Option<[Vec<f64>; 3]> {
    let [x, y, z] = Axis::ALL.map(|a| run.grid.linear(&run.log.table, &of(a)));
    Some([x?, y?, z?])
}

fn norms(v: &[Vec<f64>; 3]) -> Vec<f64> {
    (0..v[0].len()).map(|i| (v[0][i].powi(2) + v[1][i].powi(2) + v[2][i].powi(2)).sqrt()).collect()
}

/// Mean of what is known; `None` where nothing is.
fn mean(x: &[f64]) -> Option<f64> {
    let known: Vec<f64> = x.iter().copied().filter(|v| v.is_finite()).collect();
    (!known.is_empty()).then(|| known.iter().sum::<f64>() / known.len() as f64)
}

fn imu(run: &Run<'_>, out: &mut Vec<Finding>) {
    let gyro = vector(run, Signal::Gyro);
    let acc = vector(run, Signal::Acceleration);
    let grav = vector(run, Signal::Gravity);
    let g = run.robot.gravity_mps2();
    let g = (g[0].powi(2) + g[1].powi(2) + g[2].powi(2)).sqrt();
    if let Some(median) = acc.as_ref().and_then(|a| median(norms(a))) {
        let at = "imu.acc".to_owned();
        if (median / 1.0 - 1.0).abs() < 0.2 && g > 2.0 {
            out.push(Finding::fatal("unit", at, format!("is {median:.2} long in the middle where gravity is {g:.2} m/s²; is it in units of g?")));
        } else if !(0.8..1.25).contains(&(median / g)) {
            let detail =
                format!("is {median:.2} m/s² long in the middle where gravity is {g:.2} m/s²");
            out.push(Finding::fatal("parity", at, detail));
        }
    }
    if let Some(grav) = &grav {
        let mut against = None;
        if let Some(length) = median(norms(grav))
            && !(0.9..1.1).contains(&length)
        {
            let detail = format!("is {length:.2} long; the direction of gravity is a unit vector");
            out.push(Finding::fatal("unit", "imu.grav", detail));
        }
        if let (Some(acc), Some(along)) = (&acc, acc.as_ref().and_then(|a| along(a, grav))) {
            let length = median(norms(acc)).unwrap_or(g).max(1e-9);
            // at rest the accelerometer reads gravity's reaction: straight against its direction
            if along / length > -0.7 {
                let (kind, how) =
                    if along / length > 0.7 { ("sign", "along") } else { ("order", "across") };
                let detail = format!(
                    "points {how} imu.grav (cosine {:.2}) where it must point against it: check signs and axes",
                    along / length
                );
                against = Some(Finding::fatal(kind, "imu.acc", detail));
            }
        }
        let turning = gyro.as_ref().and_then(|gyro| turning(run, gyro, grav));
        match (against, turning) {
            // what two go against is at fault, not they
            (Some(acc), Some(gyro)) if gyro.kind != "unit" => {
                let detail = format!("imu.acc {}; and imu.gyro {}", acc.detail, gyro.detail);
                out.push(Finding::fatal(acc.kind, "imu.grav", detail));
            }
            (acc, gyro) => out.extend(acc.into_iter().chain(gyro)),
        }
    }
    if let Some(gyro) = &gyro {
        let most = norms(gyro).into_iter().filter(|x| x.is_finite()).fold(0.0, f64::max);
        if most > 60.0 {
            let detail = format!("reaches {most:.0} rad/s; is it in deg/s?");
            out.push(Finding::fatal("unit", "imu.gyro", detail));
        }
    }
}

/// A trunk whose gyroscope varies by less stands still, as a share of the fastest joint's speed and in rad/s: sixty
/// times the noise of an LSM6DSOX that is read at 50 Hz (3.8 m°/s/√Hz, data sheet).
const TRUNK_STILL: (f64, f64) = (0.02, 0.02);
/// Joints that move by less, root mean square, move no trunk, rad/s.
const JOINTS_MOVE_RADPS: f64 = 0.3;
/// What says how a free base moved.
const SEES_BASE: [&str; 8] =
    ["imu.gyro", "imu.acc", "imu.grav", "base.pos", "base.quat", "base.vel", "mocap", "foot"];

/// A base that counts as free while joints move: of which nothing says how it moved, or that stood still. What turns
/// by more than a turn is a wheel, and drives straight ahead.
pub(super) fn held(run: &Run<'_>, excites: &RunExcitation) -> Option<Finding> {
    let wheel = |j: &&JointExcitation| j.range_rad[1] - j.range_rad[0] > TAU;
    let joints = || excites.joints.iter().filter(|j| !wheel(j));
    let fastest = joints().map(|j| j.speed_rms_radps).fold(0.0, f64::max);
    if excites.base != BaseHold::Free || fastest < JOINTS_MOVE_RADPS {
        return None;
    }
    let seen = SEES_BASE.iter().any(|kind| excites.channels.contains_key(*kind));
    let variance = |values: &Vec<f64>| {
        let squares = mean(&values.iter().map(|w| w * w).collect::<Vec<f64>>())?;
        Some((squares - mean(values)?.powi(2)).max(0.0))
    };
    let turns = vector(run, Signal::Gyro).map(|gyro| gyro.iter().filter_map(variance).sum::<f64>());
    let why = match turns.map(f64::sqrt) {
        None if !seen => "nothing that was logged says how it moved",
        Some(rms) if rms < (TRUNK_STILL.0 * fastest).min(TRUNK_STILL.1) => {
            "the gyroscope stands still while joints move"
        }
        _ => return None,
    };
    let todo = "if the robot hung, or was held, it is \"fixed\" (in the map, or in log.toml)";
    Some(Finding::note(MAYBE_HELD, "base", format!("counts as free, and {why}: {todo}")))
}

/// Mean component of `a` along the unit vector `g`.
fn along(a: &[Vec<f64>; 3], g: &[Vec<f64>; 3]) -> Option<f64> {
    let dots: Vec<f64> = (0..a[0].len()).map(|i| (0..3).map(|k| a[k][i] * g[k][i]).sum()).collect();
    mean(&dots)
}

/// Gravity seen from a turning body turns the other way: d(grav)/dt = −ω × grav.
fn turning(run: &Run<'_>, gyro: &[Vec<f64>; 3], grav: &[Vec<f64>; 3]) -> Option<Finding> {
    let half = (run.grid.points(PARITY_WINDOW_S) / 2).max(1);
    let smooth3 = |v: &[Vec<f64>; 3]| [0, 1, 2].map(|k| smooth(&v[k], 2 * half));
    let (w, g) = (smooth3(gyro), smooth3(grav));
    let change: Vec<f64> = (0..3).flat_map(|k| slope(&grav[k], half, run.grid.step_s)).collect();
    let predicted = |signs: [f64; 3], axes: [usize; 3]| -> Vec<f64> {
        let w = |k: usize, i: usize| signs[k] * w[axes[k]][i];
        (0..3)
            .flat_map(|k| {
                let (a, b) = ((k + 1) % 3, (k + 2) % 3);
                let g = &g;
                let w = &w;
                (0..g[0].len()).map(move |i| -(w(a, i) * g[b][i] - w(b, i) * g[a][i]))
            })
            .collect()
    };
    let plain = together(&predicted([1.0; 3], [0, 1, 2]), &change, 0);
    if plain.second_sd < 0.02 {
        return None;
    }
    if plain.r > LEAST_R {
        let times = 1.0 / plain.slope;
        let unit = unit_factor(times)?;
        let detail = format!("turns {times:.1} times as fast as gravity does; is it in {unit}?");
        return Some(Finding::fatal("unit", "imu.gyro", detail));
    }
    // Which exchange of axes and signs would explain it?
    let mut best: Option<(f64, String)> = None;
    for axes in [[0, 1, 2], [0, 2, 1], [1, 0, 2], [1, 2, 0], [2, 0, 1], [2, 1, 0]] {
        for bits in 0..8u8 {
            let signs = [0, 1, 2].map(|k| if bits >> k & 1 == 1 { -1.0 } else { 1.0 });
            let r = together(&predicted(signs, axes), &change, 0).r;
            if best.as_ref().is_none_or(|b| r > b.0 + 1e-9) {
                let word = |k: usize| {
                    let minus = if signs[k] < 0.0 { "-" } else { "" };
                    format!("{minus}{}", ["x", "y", "z"][axes[k]])
                };
                best = Some((r, format!("({}, {}, {})", word(0), word(1), word(2))));
            }
        }
    }
    let hint = match best {
        Some((r, axes)) if r > 0.8 => {
            format!("; with its axes taken as {axes} it does ({r:.2})")
        }
        _ => String::new(),
    };
    let kind = if plain.r < AGAINST {
        "sign"
    } else if hint.is_empty() {
        "parity"
    } else {
        "order"
    };
    let detail = format!("does not turn imu.grav as it must (correlation {:.2}){hint}", plain.r);
    Some(Finding::fatal(kind, "imu.gyro", detail))
}

fn base(run: &Run<'_>, out: &mut Vec<Finding>) {
    let table = &run.log.table;
    let quat: Option<Vec<Vec<f64>>> =
        QuatPart::ALL.iter().map(|p| run.grid.held(table, &Signal::BaseQuaternion(*p))).collect();
    if let Some(q) = quat {
        let lengths =
            (0..q[0].len()).map(|i| q.iter().map(|c| c[i] * c[i]).sum::<f64>().sqrt()).collect();
        if let Some(length) = median(lengths)
            && !(0.95..1.05).contains(&length)
        {
            let detail =
                format!("is {length:.2} long; a rotation is a unit quaternion (w, x, y, z)");
            out.push(Finding::fatal("unit", "base.quat", detail));
        }
    }
    for axis in Axis::ALL {
        let (pos, vel) = (Signal::BasePosition(axis), Signal::BaseVelocity(axis));
        if let (Some(p), Some(v)) = (run.grid.linear(table, &pos), run.grid.linear(table, &vel))
            && let Some(t) = speed_parity(run, &p, &v)
            && let Some(f) = speed_fault(t, &vel.to_string(), &pos.to_string())
        {
            out.push(f);
        }
    }
}

/// A torque that is at most this share of what the loop asks for is in another unit.
const SMALL: f64 = 0.01;

/// The largest of finite values, either way.
fn largest<'a>(values: impl Iterator<Item = &'a f64>) -> f64 {
    values.filter(|x| x.is_finite()).fold(0.0, |most, x| most.max(x.abs()))
}

/// Readings in the wrong order of magnitude.
fn plain_ranges(run: &Run<'_>, joints: &[Channels], out: &mut Vec<Finding>) {
    let middle = |signal: &Signal| median(run.grid.linear(&run.log.table, signal)?);
    if let Some(v) = middle(&Signal::Voltage) {
        let nominal = run.log.meta.supply_v.unwrap_or(run.robot.supply_v());
        if !(0.2..3.0).contains(&(v / nominal)) {
            let detail =
                format!("is {v:.1} in the middle where the supply is about {nominal:.1} V");
            out.push(Finding::fatal("unit", "volt", detail));
        }
    }
    for joint in joints {
        if let Some(t) = middle(&Signal::Temperature(joint.name.clone()))
            && !(-30.0..130.0).contains(&t)
        {
            let detail = format!("is {t:.0} in the middle; servos live between −30 and 130 °C");
            out.push(joint.fatal("unit", "temp", detail));
        }
        let servo = run.robot.servo(joint.index);
        let stall_a =
            servo.tau_max_nm / servo.torque_per_current_nm_per_a + servo.current_dead_band_a;
        let most = largest(joint.cur.iter().flatten());
        if most > 20.0 * stall_a {
            let detail =
                format!("reaches {most:.0} where the servo stalls at {stall_a:.1} A; is it in mA?");
            out.push(joint.fatal("unit", "cur", detail));
        }
        let torque = run.grid.linear(&run.log.table, &Signal::Torque(joint.name.clone()));
        let most = largest(torque.iter().flatten());
        if most > ABSURD_TORQUE * servo.tau_max_nm {
            let detail = format!(
                "reaches {most:.0} where the servo can do {:.1} N·m; is it a current, or in another unit?",
                servo.tau_max_nm
            );
            out.push(joint.fatal("unit", "tau", detail));
        }
        if let Some(asked) =
            asked_nm(run, joint).filter(|&asked| 0.0 < most && most < SMALL * asked)
        {
            let detail = format!(
                "reaches {most:.1e} where gain and error ask for {asked:.2} N·m; is it in another unit?"
            );
            out.push(joint.fatal("unit", "tau", detail));
        }
    }
}

/// Torque that a joint's loop asks for at most, as far as the servo can give it, N·m.
fn asked_nm(run: &Run<'_>, joint: &Channels) -> Option<f64> {
    let (cmd, pos) = (joint.cmd.as_ref()?, joint.pos.as_ref()?);
    let fed = run.grid.held(&run.log.table, &Signal::CommandTorque(joint.name.clone()));
    let fed_nm = |k: usize| fed.as_ref().map_or(0.0, |fed| fed[k]);
    let kp = run.gains(joint.index).0;
    let asked = cmd.iter().zip(pos).enumerate().map(|(k, (u, q))| kp * (u - q) + fed_nm(k));
    let asked_nm = largest(asked.collect::<Vec<f64>>().iter());
    Some(asked_nm.min(run.robot.servo(joint.index).tau_max_nm))
}
