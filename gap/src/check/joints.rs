//! Joint channels: sign, unit, order, stuck and doubled channels.

use caudata_runlog::Signal;

use super::channels::{Channels, SLOW_S};
use super::finding::{Finding, Run};
use super::late::{LAG_RANGE_S, LONGEST_LAG_S, asks_much_rad};
use super::parity::speed_parity;
use super::series::{AGAINST, Together, best_lag, slope, smooth, together};

/// A command that moves less than this (standard deviation of its slow part, rad) tells nothing.
const MOVES_RAD: f64 = 0.02;
/// A command of which less than this is slow is a quick swing.
const SLOW_SHARE: f64 = 0.25;
/// A joint slower than this rests, rad/s.
const RESTS_RADPS: f64 = 0.1;
/// A shift of the stamps explains a position that goes against its command by so much more correlation.
const CLEARLY: f64 = 0.1;
/// One reading this many times beyond the range is no reading, and no simulation can follow it.
const ABSURD: f64 = 1000.0;
/// At least so long a stretch is judged, s.
const LONG_ENOUGH_S: f64 = 1.0;
/// A joint may be read beyond its range by this factor and this angle (rad): stops yield, zeros are off.
const BEYOND: (f64, f64) = (1.3, 0.2);
/// A stop yields by less than this, rad.
const PAST_RAD: f64 = 0.15;
/// A reading of which its command leaves less than this share follows it.
const FOLLOWS: f64 = 0.02;
/// Each of two readings must leave at most this share with the other's command of what it leaves with its
/// own.
const BETTER: f64 = 0.5;
/// The same where only one of them can be told …
const MUCH_BETTER: f64 = 0.2;
/// … or, where commands are alike, this.
const FAR_BETTER: f64 = 0.1;
/// … which must follow as well as this …
const FOLLOWS_WELL: f64 = 0.06;
/// … and as far as this share of the command.
const FOLLOWS_FAR: f64 = 0.5;
/// For this comparison, lags differ by so much, s.
const LAG_STEP_S: f64 = 0.02;
/// Motion below this (standard deviation) is not told from noise, rad.
const RESOLVED_RAD: f64 = 0.004;
/// A reading that stays for longer than this while its command asks for both sides of it is stuck, s.
const STUCK_S: f64 = 0.3;
/// A joint that stands, however coarse its counts, has turned by so long after its command asks for it, s.
const REACTS_S: f64 = 0.15;
/// A servo that is asked for this share of its torque at rest draws a current that shows.
const PULLS: f64 = 0.05;

pub(super) fn faults(run: &Run<'_>, joints: &[Channels], out: &mut Vec<Finding>) {
    let exchanged = order(run, joints, out);
    for (joint, exchanged) in joints.iter().zip(exchanged) {
        let turned = if exchanged { None } else { turned(run, joint) };
        let is_turned = turned.is_some();
        out.extend(turned);
        units(run, joint, is_turned, out);
        if !exchanged && !is_turned {
            sign_of_current(run, joint, out);
        }
        stuck(run, joint, out);
        counts(run, joint, out);
    }
    doubled(joints, out);
}

/// The slow parts of command and position, where there is enough of both.
fn follows(run: &Run<'_>, cmd: &Channels, pos: &Channels) -> Option<Together> {
    let t = together(cmd.slow_cmd.as_ref()?, pos.slow_pos.as_ref()?, 0);
    let enough =
        t.points >= run.grid.points(LONG_ENOUGH_S) && t.first_sd > MOVES_RAD * cmd.per_radian;
    enough.then_some(t)
}

fn units(run: &Run<'_>, joint: &Channels, turned: bool, out: &mut Vec<Finding>) {
    let (low, high) = run.robot.joint_limits_rad()[joint.index];
    let unit = joint.unit;
    let widest = BEYOND.0 * low.abs().max(high.abs()) + BEYOND.1 * joint.per_radian;
    let beyond = |x: &Option<Vec<f64>>| {
        let x = x.as_ref()?;
        let known = x.iter().filter(|v| v.is_finite()).count();
        let over: Vec<f64> = x.iter().copied().filter(|v| v.abs() > widest).collect();
        let most = over.iter().fold(0.0, |m: f64, v| m.max(v.abs()));
        (over.len() * 50 > known || most > ABSURD * widest).then_some(most)
    };
    for (what, column) in [("cmd", &joint.cmd), ("pos", &joint.pos)] {
        if let Some(most) = beyond(column) {
            let why = if most > 10.0 {
                "is it in degrees or counts?"
            } else {
                "is it in another unit, from another zero, or of another robot?"
            };
            let most = if most > 1e5 { format!("{most:.0e}") } else { format!("{most:.2}") };
            let detail = format!(
                "reaches {most} where the joint's range is {low:.2} to {high:.2} {unit}; {why}"
            );
            out.push(joint.fatal("unit", what, detail));
        }
    }
    let past = |v: &f64| (low - v).max(v - high);
    let positions = joint.pos.iter().flatten().copied();
    let farthest = positions.max_by(|a, b| past(a).total_cmp(&past(b)));
    if let Some(at_rad) = farthest.filter(|v| {
        !turned && past(v) > PAST_RAD * joint.per_radian && beyond(&joint.pos).is_none()
    }) {
        let detail = format!(
            "reaches {at_rad:.2} {unit}, past the joint's range of {low:.2} to {high:.2} {unit}, where the simulated \
             robot has an end stop: are range and zero right?"
        );
        out.push(joint.note("range", "pos", detail));
    }
    let Some(t) = follows(run, joint, joint) else { return };
    // 57.3 either way, also where the joint's range is wide enough to hold it
    if t.r > 0.7 && t.slope > 20.0 && beyond(&joint.pos).is_none() {
        let detail =
            format!("moves {:.1} times as far as its command; is one of them in degrees?", t.slope);
        out.push(joint.fatal("unit", "pos", detail));
    } else if t.r > 0.7 && t.slope > 0.0 && t.slope < 0.03 && beyond(&joint.cmd).is_none() {
        let detail = format!(
            "moves {:.1} times as far as the position; is one of them in degrees?",
            1.0 / t.slope
        );
        out.push(joint.fatal("unit", "cmd", detail));
    }
}

/// A position that goes against its command, and does not just come late or early. The speed says which of the two
/// is turned.
fn turned(run: &Run<'_>, joint: &Channels) -> Option<Finding> {
    let t = follows(run, joint, joint)?;
    // beyond its resonance a servo goes against a swing: what is left of that alone is no slow motion
    let whole = joint.cmd.as_ref().map_or(0.0, |u| together(u, u, 0).first_sd);
    let swings = t.first_sd < SLOW_SHARE * whole;
    if t.r > AGAINST || t.second_sd < 0.2 * t.first_sd || swings {
        return None;
    }
    let (cmd, pos) = (joint.slow_cmd.as_ref()?, joint.slow_pos.as_ref()?);
    let opposite: Vec<f64> = pos.iter().map(|q| -q).collect();
    let [late, any] = [LONGEST_LAG_S, LAG_RANGE_S].map(|s| run.grid.points(s) as isize);
    let as_turned = best_lag(cmd, &opposite, 0..=late).1.r;
    if best_lag(cmd, pos, -any..=any).1.r > as_turned + CLEARLY {
        return None;
    }
    let name = &joint.name;
    let speed = joint.pos.as_ref().zip(joint.vel.as_ref());
    let todo = match speed.and_then(|(pos, vel)| speed_parity(run, pos, vel)) {
        Some(s) if s.r < AGAINST => format!(" and against vel.{name}: turn its sign"),
        Some(s) if s.r > -AGAINST => {
            format!(", and vel.{name} goes with it: turn the sign of the command, or of both")
        }
        _ => "; turn the sign of one of them".to_owned(),
    };
    let detail = format!("goes against cmd.{name} (correlation {:.2}){todo}", t.r);
    Some(joint.fatal("sign", "pos", detail))
}

fn sign_of_current(run: &Run<'_>, joint: &Channels, out: &mut Vec<Finding>) {
    if follows(run, joint, joint).is_none() {
        return;
    }
    // At rest the motor pulls towards the command: current follows the error where the sign is right. (In
    // motion the error is the lag.)
    let (Some(cmd), Some(pos), Some(cur)) = (&joint.slow_cmd, &joint.slow_pos, &joint.cur) else {
        return;
    };
    let half = run.grid.points(0.5 * SLOW_S);
    let speed = slope(pos, half, run.grid.step_s);
    let moves = slope(cmd, half, run.grid.step_s);
    let rests = RESTS_RADPS * joint.per_radian;
    let at_rest = |damping_s: f64| -> Vec<f64> {
        (cmd.iter().zip(pos).zip(speed.iter().zip(&moves)))
            .map(|((u, q), (v, w))| match v.abs() < rests && w.abs() < rests {
                true => u - q - damping_s * v,
                false => f64::NAN,
            })
            .collect()
    };
    let slow_cur = smooth(cur, run.grid.points(SLOW_S));
    let t = together(&at_rest(0.0), &slow_cur, 0);
    // a slow joint that is damped much leaves an error without a current
    let (kp, kd) = run.gains(joint.index);
    let damping_s = if kp > 0.0 { kd / kp } else { 0.0 };
    let damped = together(&at_rest(damping_s), &slow_cur, 0);
    let asked = cmd.iter().zip(pos).zip(&speed).map(|((u, q), v)| (u - q, *v));
    if let Some((kind, detail)) = one_sided(run, joint, cur, asked) {
        return out.push(joint.fatal(kind, "cur", detail));
    }
    // an error that hardly leaves its count, and a current that wanders meanwhile, tell nothing
    let told = t.first_sd > run.robot.servo(joint.index).encoder_lsb_rad();
    if told && t.r.max(damped.r) < -0.7 && t.points >= run.grid.points(LONG_ENOUGH_S) {
        let detail = format!(
            "pulls away from the command (correlation with cmd − pos {:.2}); turn its sign",
            t.r
        );
        out.push(joint.fatal("sign", "cur", detail));
    }
}

/// What is wrong with a current that is never negative, or always the same, although what is left of the
/// command (rad), with the damping of the speed (rad/s) and without it, asks the servo for much torque one way and,
/// as long, the other. (What hangs on a joint holds its torque to one way while the error goes both.)
fn one_sided(
    run: &Run<'_>,
    joint: &Channels,
    cur: &[f64],
    asked: impl Iterator<Item = (f64, f64)>,
) -> Option<(&'static str, String)> {
    let servo = run.robot.servo(joint.index);
    let (kp, kd) = run.gains(joint.index);
    let idle_nm = servo.current_dead_band_a * servo.torque_per_current_nm_per_a;
    let most_nm = (PULLS * servo.tau_max_nm).max(2.0 * idle_nm);
    let much = |x: f64| kp * x > most_nm && x > 3.0 * servo.encoder_lsb_rad();
    let ways = asked.fold([0; 2], |[up, down], (x, v)| {
        let damped = x - kd / kp * v;
        let most = |way: f64| usize::from(much(way * x) && much(way * damped));
        [up + most(1.0), down + most(-1.0)]
    });
    if ways.iter().any(|n| *n < run.grid.points(LONG_ENOUGH_S)) {
        return None;
    }
    let known = || cur.iter().filter(|i| i.is_finite());
    let first = known().next()?;
    if known().all(|i| i == first) {
        return Some((
            "stuck",
            format!(
                "reads {first:.4} A in the whole run although the servo pulls both ways: is it read at all?"
            ),
        ));
    }
    let detail = "is never negative although the servo pulls both ways: log it with its sign";
    known().all(|i| *i >= 0.0).then(|| ("sign", detail.to_owned()))
}

/// Least and greatest reading.
fn ends(pos: &[f64]) -> (f64, f64) {
    let known = || pos.iter().filter(|q| q.is_finite());
    (
        known().fold(f64::INFINITY, |m, q| m.min(*q)),
        known().fold(f64::NEG_INFINITY, |m, q| m.max(*q)),
    )
}

/// A reading that stays the same to the last bit while the command asks for both sides of it.
fn stuck(run: &Run<'_>, joint: &Channels, out: &mut Vec<Finding>) {
    let (Some(cmd), Some(pos)) = (&joint.cmd, &joint.pos) else { return };
    let (far, unit) = (asks_much_rad(run, joint), joint.unit);
    let asked = cmd.iter().filter(|u| (*u - pos[0]).abs() > far).count();
    if pos.iter().all(|q| *q == pos[0]) && asked >= run.grid.points(LONG_ENOUGH_S) {
        let detail = format!(
            "reads {:.4} {unit} in the whole run while the command moves {:.2} {unit} away: is the encoder read at all?",
            pos[0],
            cmd.iter().map(|u| (u - pos[0]).abs()).fold(0.0, f64::max)
        );
        return out.push(joint.fatal("stuck", "pos", detail));
    }
    let (least, most) = ends(pos);
    let mut from = 0;
    for i in 1..=pos.len() {
        if i < pos.len() && pos[i] == pos[from] {
            continue;
        }
        let asked_s = |way: f64| {
            let asked = cmd[from..i].iter().filter(|u| way * (*u - pos[from]) > far);
            asked.count() as f64 * run.grid.step_s
        };
        let (above_s, below_s) = (asked_s(1.0), asked_s(-1.0));
        let lasts = (i - from) as f64 * run.grid.step_s;
        // where no reading goes further there may be a stop: only a joint that does not come back is stuck
        let up = below_s > if pos[from] == most { STUCK_S } else { REACTS_S };
        let down = above_s > if pos[from] == least { STUCK_S } else { REACTS_S };
        if up && down && lasts > STUCK_S {
            let detail = format!(
                "reads {:.4} {unit} for {lasts:.1} s from t = {:.2} s while the command asks for both sides of it",
                pos[from],
                run.grid.start_s + from as f64 * run.grid.step_s
            );
            out.push(joint.fatal("stuck", "pos", detail));
            return;
        }
        from = i;
    }
}

/// Positions that were rounded much more coarsely than the encoder counts.
fn counts(run: &Run<'_>, joint: &Channels, out: &mut Vec<Finding>) {
    let (signal, unit) = (Signal::Position(joint.name.clone()), joint.unit);
    let Some(column) = run.log.table.column(&signal) else { return };
    let mut known: Vec<f64> = column.iter().flatten().copied().collect();
    known.sort_unstable_by(f64::total_cmp);
    known.dedup();
    let span = known.last().unwrap_or(&0.0) - known.first().unwrap_or(&0.0);
    let step =
        known.windows(2).map(|w| w[1] - w[0]).filter(|d| *d > 1e-9).fold(f64::INFINITY, f64::min);
    let lsb = run.robot.servo(joint.index).encoder_lsb_rad();
    if known.len() >= 5 && span > 20.0 * lsb && step > 4.0 * lsb {
        let counts = "encoder_counts_per_turn";
        let todo = match run.robot.assumed_of_servo(joint.index, counts) {
            None => format!("where the encoder counts {lsb:.4} {unit}; log it unrounded"),
            // nobody knows that the encoder is finer
            Some(path) => format!(
                "as of an encoder of {:.0} counts; what the robot file has is assumed: look up {path}",
                std::f64::consts::TAU / step
            ),
        };
        let detail = format!("comes in steps of {step:.4} {unit} {todo}");
        out.push(joint.note("quantisation", "pos", detail));
    }
}

/// Two joints' readings in each other's place. Returns which joints are in another's.
///
/// A reading is compared with what a servo may make of a command: late, smaller, shifted. Alike commands (a
/// wave that travels down a spine) make a reading go well with a neighbour's command too, but only one way:
/// readings that were exchanged each go better with the other's command.
fn order(run: &Run<'_>, joints: &[Channels], out: &mut Vec<Finding>) -> Vec<bool> {
    let n = joints.len();
    // joints that another's reading is in the place of, and readings that are in another's place
    let (mut named, mut taken) = (vec![false; n], vec![false; n]);
    // what each command leaves of each reading: [command][reading]
    let left: Vec<Vec<Option<Missed>>> =
        (joints.iter()).map(|a| joints.iter().map(|b| missed(run, a, b)).collect()).collect();
    let own = |j: usize| left[j][j];
    let ahead = |a: usize, b: usize, share: f64| {
        let than = |own: Option<Missed>| {
            left[a][b].is_some_and(|ab| own.is_none_or(|own| ab.left < share * own.left))
        };
        than(own(a)) && than(own(b))
    };
    for a in 0..n {
        if named[a] || own(a).is_none_or(|m| m.left < FOLLOWS) {
            continue;
        }
        let best = follower(&left, a, |b| !taken[b] && ahead(a, b, BETTER));
        let Some((b, ab)) = best else { continue };
        let exchanged = ahead(b, a, BETTER);
        // without a way back (the other command hardly moves, or three are in each other's place) only a good
        // fit to a command that is not alike proves anything, or one as good as a servo's own: a limp tail
        // follows a trunk that bends
        let not_alike = ab.left < FOLLOWS_WELL
            && ahead(a, b, MUCH_BETTER)
            && !alike(run, &joints[a], &joints[b]);
        let as_its_own = ab.left < FOLLOWS && ahead(a, b, FAR_BETTER);
        // and then, what that reading leaves must be another's as well, round to the first: in a trunk with
        // worn joints two servos follow neither their own command nor anybody's
        let alone = ab.slope > FOLLOWS_FAR
            && (not_alike || as_its_own)
            && comes_round(&left, a, b, |a, b| ahead(a, b, BETTER));
        if !exchanged && !alone {
            continue;
        }
        named[a] = true;
        taken[b] = true;
        if exchanged {
            named[b] = true;
            taken[a] = true;
        }
        let (a_name, b_name) = (&joints[a].name, &joints[b].name);
        let more = if exchanged {
            format!(" and pos.{a_name} cmd.{b_name}: exchange them")
        } else {
            ": are the columns in another joint's order?".to_owned()
        };
        let detail = format!(
            "pos.{b_name} follows cmd.{a_name} ({:.1} % of its motion is left; of pos.{a_name} {:.0} %){more}",
            100.0 * ab.left,
            100.0 * own(a).map_or(1.0, |m| m.left)
        );
        out.push(Finding::fatal("order", format!("pos.{a_name}"), detail));
    }
    named
}

/// The reading that goes best with the command of `a`, of those that `may`.
fn follower(
    left: &[Vec<Option<Missed>>],
    a: usize,
    may: impl Fn(usize) -> bool,
) -> Option<(usize, Missed)> {
    (0..left.len())
        .filter(|&b| b != a && may(b))
        .filter_map(|b| Some((b, left[a][b]?)))
        .min_by(|x, y| x.1.left.total_cmp(&y.1.left))
}

/// Whether the readings of `a`, whose place `b` is in, `b`, and those after it are in each other's places:
/// the command of `b` is followed by a third reading, and so on, until one is followed by that of `a`, or
/// hardly moves, so that nobody can tell.
fn comes_round(
    left: &[Vec<Option<Missed>>],
    a: usize,
    b: usize,
    ahead: impl Fn(usize, usize) -> bool,
) -> bool {
    let mut at = b;
    for _ in 0..left.len() {
        if left[at][at].is_none() {
            return true;
        }
        let next = follower(left, at, |next| ahead(at, next));
        match next.filter(|(_, missed)| missed.left < FOLLOWS_WELL) {
            Some((next, _)) if next == a => return true,
            Some((next, _)) => at = next,
            None => return false,
        }
    }
    false
}

/// What a command does not account for in a reading.
#[derive(Clone, Copy)]
struct Missed {
    /// Share of the reading's motion.
    left: f64,
    /// Size of the reading's motion over the command's.
    slope: f64,
}

/// How a reading follows a command that acts late by what a servo needs at most, and at any size of the same
/// sign. `None` where the command does not move enough to tell.
fn missed(run: &Run<'_>, cmd: &Channels, pos: &Channels) -> Option<Missed> {
    follows(run, cmd, pos)?;
    let (u, q) = (cmd.fine_cmd.as_ref()?, pos.fine_pos.as_ref()?);
    let stride = run.grid.points(LAG_STEP_S);
    let thinned = |x: &[f64]| -> Vec<f64> { x.iter().step_by(stride).copied().collect() };
    let most = (LONGEST_LAG_S / (stride as f64 * run.grid.step_s)).round() as isize;
    let (_, t) = best_lag(&thinned(u), &thinned(q), 0..=most);
    let resolved = t.second_sd > 0.2 * t.first_sd && (0.1..3.0).contains(&t.slope);
    let left = if resolved && t.r > 0.0 { 1.0 - t.r * t.r } else { 1.0 };
    // counts, friction and droop leave something of the best
    let noise = (RESOLVED_RAD * pos.per_radian / t.second_sd.max(1e-9)).powi(2).min(1.0);
    Some(Missed { left: left.max(noise), slope: t.slope })
}

/// Whether two commands go together, one of them late by anything up to what is looked at.
fn alike(run: &Run<'_>, a: &Channels, b: &Channels) -> bool {
    let (Some(u), Some(v)) = (&a.slow_cmd, &b.slow_cmd) else { return false };
    let most = run.grid.points(LAG_RANGE_S) as isize;
    best_lag(u, v, -most..=most).1.r > 0.5
}

/// Two joints that read the same although they are asked for different things.
fn doubled(joints: &[Channels], out: &mut Vec<Finding>) {
    for (a, first) in joints.iter().enumerate() {
        for second in &joints[a + 1..] {
            let (Some(x), Some(y)) = (&first.pos, &second.pos) else { continue };
            let known = || x.iter().zip(y).filter(|(p, q)| p.is_finite() && q.is_finite());
            let all = known().count();
            let same = known().filter(|(p, q)| p == q).count();
            let moved = together(x, y, 0).first_sd > MOVES_RAD * first.per_radian;
            let asked_alike = match (&first.cmd, &second.cmd) {
                (Some(u), Some(v)) => {
                    let off = u.iter().zip(v).map(|(u, v)| (u - v).abs());
                    off.fold(0.0, |m: f64, d| if d > m { d } else { m }) < 1e-3 * first.per_radian
                }
                _ => false,
            };
            if moved && !asked_alike && all > 50 && same * 100 > all * 98 {
                let detail = format!(
                    "is the same as pos.{} in {same} of {all} points; one channel was logged twice",
                    first.name
                );
                out.push(second.fatal("duplicate", "pos", detail));
            }
        }
    }
}
