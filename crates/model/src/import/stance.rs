//! A pose to stand in, for a robot whose file has none: knees bent, feet below the hips, all at one height.

use super::finish::nominal;
use super::robot_toml::{moved, places};
use super::sole::{foot_of, middle};
use crate::parts::{Joint, Robot};
use crate::pose::{self, Pose};
use crate::types::JointMotion;

/// How far a leg reaches down, of what it could: knees bent by some 80°.
const BENT: f64 = 0.75;
/// The same of two legs, each of which holds the whole robot in turn: knees bent by 50°.
const BENT_OF_TWO: f64 = 0.9;
/// Nearer to the middle the end of a limb is on no side, m.
const ASIDE_LEAST_M: f64 = 1e-3;
/// Between these a leg is bent already; beyond, it is as good as straight.
const BENT_MOST: f64 = 0.4;
const STRAIGHT: f64 = 0.93;
/// How far before or behind its hip a foot may be in a file that is left as it is, of the leg.
const ASIDE_MAX: f64 = 0.15;
/// How far out a foot stands, of how far it is in the file, where that is at least this much of the leg.
const SPREAD: f64 = 0.6;
const SPREAD_LEAST: f64 = 0.5;
/// A foot may end so far above or below the ground, share of the leg's length.
const HEIGHT_OFF_MAX: f64 = 0.12;
/// How far feet are moved below the centre of mass, of the leg.
const AHEAD_MAX: f64 = 0.4;
/// A shorter limb is no leg, of the longest.
const LEG_SHARE: f64 = 0.75;
/// Lengths of like legs differ by this part at most.
const ALIKE: f64 = 0.02;
/// Nearer to its ends a joint is not put, of its range.
const MARGIN: f64 = 0.08;
/// Where the search begins, rad, at each joint.
const BEGIN_RAD: [f64; 3] = [0.0, 0.7, -0.7];
/// A joint this near to the end of a leg is an ankle, of its length.
const ANKLE_SHARE: f64 = 0.3;
/// More joints than this are no leg: the search is 3 to this power.
const JOINTS_MAX: usize = 7;
/// What a turn of a joint, a turned foot, and a knee on the wrong side cost beside a foot that is off by the
/// whole leg.
const TURN_COST: f64 = 0.01;
const SOLE_COST: f64 = 0.1;
const KNEE_COST: f64 = 0.02;

/// A limb: bodies from the trunk to its end, where they hang, and the end's lowest shape.
struct Limb {
    chain: Vec<usize>,
    trunk: Pose,
    tip_m: [f64; 3],
    /// Whether the end is wider than a point, with a joint near by that can level it.
    sole: bool,
    /// Where the first joint is, and the tip with all joints at zero.
    hip_m: [f64; 3],
    zero_m: [f64; 3],
    /// Lowest that the tip can be below the root.
    deepest_m: f64,
}

impl Limb {
    fn joints<'a>(&'a self, robot: &'a Robot) -> impl Iterator<Item = &'a Joint> {
        self.chain.iter().flat_map(|&b| &robot.bodies[b].joints)
    }

    /// Frames of the chain's bodies, seen from the root.
    fn frames(&self, robot: &Robot, q: &[f64]) -> Vec<Pose> {
        let mut q = q.iter();
        let mut at = self.trunk;
        let frame = |&b: &usize| {
            let body = &robot.bodies[b];
            at = at.compose(&body.parent_from_body);
            for (joint, q) in body.joints.iter().zip(&mut q) {
                at = at.compose(&moved(joint, *q));
            }
            at
        };
        self.chain.iter().map(frame).collect()
    }

    fn tip(&self, robot: &Robot, q: &[f64]) -> [f64; 3] {
        let end = self.frames(robot, q).pop().unwrap_or(Pose::IDENTITY);
        end.point(self.tip_m)
    }

    fn is_like(&self, other: &Limb) -> bool {
        let near = |a: f64, b: f64| (a - b).abs() <= ALIKE * other.length_m();
        self.chain.len() == other.chain.len()
            && near(self.length_m(), other.length_m())
            && near(self.deepest_m, other.deepest_m)
    }

    fn length_m(&self) -> f64 {
        self.hip_m[2] - self.deepest_m
    }

    /// How far out the file stretches it, forward and to the left; forward counts only where it is spread.
    fn out_m(&self) -> [f64; 2] {
        let [x, y, _] = pose::sub(self.zero_m, self.hip_m);
        // a leg in the middle, of those that stand around a trunk, is spread forward or backward
        let aside = match self.hip_m[1].abs() < ASIDE_LEAST_M {
            true => x.abs() >= SPREAD_LEAST * self.length_m(),
            false => y.abs() >= SPREAD_LEAST * self.length_m() && x.abs() <= 2.0 * y.abs(),
        };
        if aside { [x, y].map(|d| SPREAD * d) } else { [0.0, y] }
    }

    /// Whether it is bent in the file, with its end where a foot belongs.
    fn stands(&self) -> bool {
        let [x, _, z] = pose::sub(self.zero_m, self.hip_m);
        let aside = x - self.out_m()[0];
        let bent = (BENT_MOST..STRAIGHT).contains(&(-z / self.length_m()));
        bent && (aside.abs() < ASIDE_MAX * self.length_m() || self.out_m()[0] != 0.0)
    }
}

/// Writes down angles in which the robot stands; not where it has no legs, or stands as its file is.
pub(super) fn find(robot: &mut Robot) -> bool {
    let places_at_rest = places(robot);
    let trunk = trunk(robot, &places_at_rest);
    let ends = 1..robot.bodies.len();
    let mut legs: Vec<Limb> =
        ends.filter_map(|b| limb(robot, b, &trunk, &places_at_rest)).collect();
    let mirrored = |a: &Limb, place: fn(&Limb) -> [f64; 3]| {
        let [x, y, z] = place(a);
        let off = |b: &Limb| pose::norm(pose::sub(place(b), [x, -y, z]));
        y.abs() > 0.02 * a.length_m() && legs.iter().any(|b| off(b) < 0.1 * a.length_m())
    };
    // a mesh that is missing leaves hips alike
    let paired = |l: &Limb| mirrored(l, |l| l.zero_m) || mirrored(l, |l| l.hip_m);
    let paired: Vec<&Limb> = legs.iter().filter(|l| paired(l)).collect();
    // the third leg of three is in the middle, and like the two
    let kept = |l: &Limb| paired.iter().any(|p| l.is_like(p));
    let kept: Vec<bool> = legs.iter().map(kept).collect();
    let mut keep = kept.into_iter();
    legs.retain(|_| keep.next() == Some(true));
    let longest_m = legs.iter().map(Limb::length_m).fold(0.0, f64::max);
    legs.retain(|l| l.length_m() > LEG_SHARE * longest_m);
    // what ends high above the others is an arm
    let deepest_m = legs.iter().map(|l| l.deepest_m).fold(f64::INFINITY, f64::min);
    legs.retain(|l| l.deepest_m < deepest_m + (1.0 - BENT) * longest_m);
    if legs.len() < 2 || legs.iter().all(Limb::stands) {
        return false;
    }
    let bent = if legs.len() == 2 { BENT_OF_TWO } else { BENT };
    let ground_m = legs.iter().map(|l| l.hip_m[2] - bent * l.length_m());
    let ground_m = ground_m.fold(f64::NEG_INFINITY, f64::max);
    let before = robot.home.clone();
    // two legs must stand below the centre of mass, which moves as they bend
    let mut ahead_m = 0.0;
    for _ in 0..if legs.len() == 2 { 4 } else { 1 } {
        for leg in &legs {
            let q = bend(robot, leg, [ahead_m, ground_m], legs.len());
            let names: Vec<String> = leg.joints(robot).map(|j| j.name.clone()).collect();
            let rounded = q.into_iter().map(|q| (q * 100.0).round() / 100.0);
            robot.home.extend(names.into_iter().zip(rounded));
        }
        let places = places(robot);
        let masses = robot.bodies.iter().zip(&places);
        let masses = masses.filter_map(|(b, at)| Some((b.inertial?, at)));
        let (mass_kg, moment) = masses.fold((0.0, 0.0), |(mass, moment), (i, at)| {
            (mass + i.mass_kg, moment + i.mass_kg * at.point(i.com_m)[0])
        });
        let feet = legs.iter().filter_map(|l| Some(places[*l.chain.last()?].point(l.tip_m)[0]));
        let off_m = moment / mass_kg - feet.sum::<f64>() / legs.len() as f64;
        ahead_m = (ahead_m + off_m).clamp(-AHEAD_MAX * longest_m, AHEAD_MAX * longest_m);
    }
    // what the search did not bring down to the ground is left as the file has it
    let places = places(robot);
    let bent = legs.iter().all(|leg| {
        let end = leg.chain.last().map(|&b| places[b].point(leg.tip_m));
        end.is_some_and(|at| (at[2] - ground_m).abs() < HEIGHT_OFF_MAX * leg.length_m())
    });
    if !bent {
        robot.home = before;
    }
    bent
}

/// Moves joints with a drive that would be at an end of their range, where 0 is or nearest to it, away from there.
pub(super) fn off_the_stops(robot: &mut Robot) {
    let moved = |joint: &Joint| {
        let driven = robot.actuators.iter().any(|a| a.joint == joint.name);
        let (low, high) = joint.range.filter(|_| driven)?;
        let (margin, q) = (MARGIN * (high - low), nominal(robot, joint));
        let at_stop = (q - low).min(high - q) < 0.5 * margin;
        at_stop.then(|| (joint.name.clone(), q.clamp(low + margin, high - margin)))
    };
    let moved: Vec<(String, f64)> = robot.joints().filter_map(moved).collect();
    robot.home.extend(moved);
}

/// Which bodies are of the trunk: the root, and what carries ends on both sides, like a part before a waist.
fn trunk(robot: &Robot, places: &[Pose]) -> Vec<bool> {
    let mut sides = vec![(false, false); places.len()];
    for b in (0..places.len()).rev() {
        let y_m = places[b].pos_m[1];
        if !robot.bodies.iter().any(|body| body.parent == Some(b)) {
            sides[b] = (y_m > ASIDE_LEAST_M, y_m < -ASIDE_LEAST_M);
        }
        if let Some(parent) = robot.bodies[b].parent {
            sides[parent] = (sides[parent].0 || sides[b].0, sides[parent].1 || sides[b].1);
        }
    }
    sides.iter().enumerate().map(|(b, (left, right))| b == 0 || (*left && *right)).collect()
}

/// The limb that ends at a body, if it may be a leg.
fn limb(robot: &Robot, end: usize, trunk: &[bool], places: &[Pose]) -> Option<Limb> {
    let ends = !robot.bodies.iter().any(|b| b.parent == Some(end));
    let (toe, end) = match foot_of(robot, places, end) {
        Some(foot) => (Some(end), foot),
        None => (None, end),
    };
    let mut chain: Vec<usize> = std::iter::successors(Some(end), |&b| robot.bodies[b].parent)
        .take_while(|&b| !trunk[b])
        .collect();
    chain.reverse();
    let carrier = chain.first().and_then(|&b| robot.bodies[b].parent)?;
    let trunk = places[carrier];
    let nowhere = [0.0; 3];
    let mut limb = Limb {
        chain,
        trunk,
        tip_m: nowhere,
        sole: false,
        hip_m: nowhere,
        zero_m: nowhere,
        deepest_m: 0.0,
    };
    let count = limb.joints(robot).count();
    if !ends || !(2..=JOINTS_MAX).contains(&count) {
        return None;
    }
    let (tip_m, wide) = middle(robot, places, end, toe)?;
    limb.tip_m = tip_m;
    let nearest = |j: &Joint| j.range.map_or(0.0, |(low, high)| 0.0f64.clamp(low, high));
    let still: Vec<f64> = limb.joints(robot).map(nearest).collect();
    limb.hip_m = limb.frames(robot, &still)[0].pos_m;
    limb.zero_m = limb.tip(robot, &still);
    let q = search(robot, &limb, |q| limb.tip(robot, q)[2]);
    limb.deepest_m = limb.tip(robot, &q)[2];
    let ankle_m = limb.joints(robot).last().map_or([0.0; 3], |j| j.anchor_m);
    limb.sole = wide && pose::norm(pose::sub(tip_m, ankle_m)) < ANKLE_SHARE * limb.length_m();
    Some(limb)
}

/// Angles that bring a foot so far before its hip, and as high as the ground, of a robot of so many legs.
fn bend(robot: &Robot, leg: &Limb, [ahead_m, ground_m]: [f64; 2], legs: usize) -> Vec<f64> {
    let length_m = leg.length_m();
    let [hip_x, hip_y, _] = leg.hip_m;
    let [out_x, out_y] = leg.out_m();
    let ahead_m = if legs == 2 { ahead_m } else { 0.0 };
    let target = [hip_x + out_x + ahead_m, hip_y + out_y, ground_m];
    // knees of two legs go forward, of more backward
    let forward = if legs == 2 { 1.0 } else { -1.0 };
    let count = leg.joints(robot).count();
    let flat = leg.frames(robot, &vec![0.0; count]).pop().unwrap_or(Pose::IDENTITY);
    let cost = |q: &[f64]| {
        let frames = leg.frames(robot, q);
        let end = frames[frames.len() - 1];
        let off = pose::norm(pose::sub(end.point(leg.tip_m), target)) / length_m;
        let turned: f64 = q.iter().map(|q| q * q).sum::<f64>() / count as f64;
        // what two legs stand on is level and points ahead; of more, a foot of its own joint is level
        let axes: &[[f64; 3]] = match legs {
            2 if leg.sole || count >= 5 => &[[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]],
            _ if count >= 5 => &[[0.0, 0.0, 1.0]],
            _ => &[],
        };
        let off_axis = |axis: &[f64; 3]| 1.0 - pose::dot(flat.rotate(*axis), end.rotate(*axis));
        let sole = axes.iter().map(off_axis).sum::<f64>();
        let knee = frames.iter().map(|f| (f.pos_m[0] - hip_x) / length_m).sum::<f64>();
        off * off + TURN_COST * turned + SOLE_COST * sole - KNEE_COST * forward * knee
    };
    search(robot, leg, cost)
}

/// The least of a cost within the limits: from the best of a grid downhill, a joint at a time.
fn search(robot: &Robot, limb: &Limb, cost: impl Fn(&[f64]) -> f64) -> Vec<f64> {
    let bounds = |j: &Joint| {
        // what slides or has no drive stays where it is
        let turns =
            j.motion == JointMotion::Hinge && robot.actuators.iter().any(|a| a.joint == j.name);
        let half = std::f64::consts::PI;
        let (low, high) = j.range.filter(|_| turns).unwrap_or((0.0, 0.0));
        let (low, high) = (low.max(-half).min(high), high.min(half).max(low));
        let margin = MARGIN * (high - low);
        (low + margin, high - margin)
    };
    let bounds: Vec<(f64, f64)> = limb.joints(robot).map(bounds).collect();
    let grid = (0..BEGIN_RAD.len().pow(bounds.len() as u32)).map(|mut k| {
        let start = |(low, high): &(f64, f64)| {
            let q = BEGIN_RAD[k % BEGIN_RAD.len()].clamp(*low, *high);
            k /= BEGIN_RAD.len();
            q
        };
        let q: Vec<f64> = bounds.iter().map(start).collect();
        (cost(&q), q)
    });
    let (mut best, mut q) = grid.min_by(|a, b| a.0.total_cmp(&b.0)).unwrap_or_default();
    let mut step = 0.4;
    while step > 1e-3 {
        let before = best;
        for j in 0..q.len() {
            for side in [-step, step] {
                let old = q[j];
                q[j] = (old + side).clamp(bounds[j].0, bounds[j].1);
                let now = cost(&q);
                if now < best {
                    best = now;
                } else {
                    q[j] = old;
                }
            }
        }
        if best >= before {
            step *= 0.5;
        }
    }
    q
}
