//! Which joint of a leg swings its foot and which lifts it, from where the foot is in the nominal pose.

use caudata_model::pose::{cross, dot, sub};
use caudata_model::{Foot, JointMotion, Kinematics, Pose, RobotModel, Site};

/// A foot that moves by less as a joint does is not moved by it, m per what counts as a radian.
const HARDLY_M: f64 = 1e-3;

/// A joint's motion as a trial needs it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Way {
    /// Policy order.
    pub joint: usize,
    /// 1 where a positive motion brings the foot forward (swings) or up (lifts), else −1.
    pub sign: f64,
}

/// A leg: the joints that only one foot hangs from.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Leg {
    /// From the trunk outwards, policy order.
    pub joints: Vec<usize>,
    /// What brings the foot farthest forward.
    pub swing: Way,
    /// What of the others brings it farthest up; in a leg of one joint that one.
    pub lift: Way,
    /// Whether the foot is on the left.
    pub left: bool,
    /// Whether it is in the front half.
    pub front: bool,
    /// Whether it steps with the foremost foot on the left: legs beside and behind each other take turns.
    pub with_first: bool,
}

impl Leg {
    /// All legs of `robot`, in the order of its feet. A foot whose joints all carry others too has none.
    pub fn all(robot: &RobotModel) -> Vec<Self> {
        let Some(at) = nominal(robot) else {
            return Vec::new();
        };
        let forward = forward(robot, &at);
        let left = [-forward[1], forward[0], 0.0];
        let joints = own_joints(robot);
        let feet: Vec<[f64; 3]> =
            robot.feet().iter().map(|f| at.links[f.link].point(f.centre_m)).collect();
        let along = |i: usize| dot(feet[i], forward);
        let mean = |axis: [f64; 3]| {
            feet.iter().map(|f| dot(*f, axis)).sum::<f64>() / feet.len().max(1) as f64
        };
        let (middle, middle_left) = (mean(forward), mean(left));
        let is_left = |i: usize| dot(feet[i], left) > middle_left;
        let leg = |(i, joints): (usize, Vec<usize>)| {
            let moved = |&a: &usize| per_radian(robot, &at, a, feet[i]);
            let swing = farthest(&joints, |a| dot(moved(a), forward))?;
            let others: Vec<usize> = joints.iter().copied().filter(|&a| a != swing.joint).collect();
            let lifts = farthest(&others, |a| moved(a)[2]);
            let lift = lifts.filter(|l| moved(&l.joint)[2].abs() > HARDLY_M).unwrap_or(swing);
            let ahead = (0..feet.len())
                .filter(|&o| is_left(o) == is_left(i) && along(o) > along(i) + HARDLY_M);
            Some(Self {
                joints,
                swing,
                lift,
                left: is_left(i),
                front: along(i) > middle + HARDLY_M,
                with_first: is_left(i) == ahead.count().is_multiple_of(2),
            })
        };
        joints.into_iter().enumerate().filter_map(leg).collect()
    }
}

/// Where all is in the nominal pose, with the base at the origin.
fn nominal(robot: &RobotModel) -> Option<Kinematics> {
    let joints = robot.full_pos_rad(robot.nominal_pos_rad()).ok()?;
    robot.kinematics(&Pose::IDENTITY, &joints).ok()
}

/// Horizontal unit vector of the heading; x where the robot file has none.
fn forward(robot: &RobotModel, at: &Kinematics) -> [f64; 3] {
    let line = robot.heading_sites().map(|(hind, front)| {
        let of = |s: &Site| at.links[s.link].point(s.link_from_site.pos_m);
        let (from, to) = (of(hind), of(front));
        [to[0] - from[0], to[1] - from[1]]
    });
    let [x, y] = line.unwrap_or([1.0, 0.0]);
    let length = x.hypot(y);
    if length > 1e-9 { [x / length, y / length, 0.0] } else { [1.0, 0.0, 0.0] }
}

/// By foot the joints that it hangs from, from the trunk outwards, policy order. `[F]`
pub(super) fn carried(robot: &RobotModel) -> Vec<Vec<usize>> {
    let carrying = |foot: &Foot| -> Vec<usize> {
        let links = robot.links();
        let chain: Vec<usize> =
            std::iter::successors(Some(foot.link), |&l| links[l].parent).collect();
        let on_chain = |a: &usize| chain.contains(&robot.joints()[robot.actuated()[*a]].child_link);
        (0..robot.actuated().len()).filter(on_chain).collect()
    };
    robot.feet().iter().map(carrying).collect()
}

/// By foot the joints that no other foot hangs from. `[F]`
fn own_joints(robot: &RobotModel) -> Vec<Vec<usize>> {
    let feet = carried(robot);
    let beyond = |a: &usize| feet.iter().filter(|c| c.contains(a)).count();
    feet.iter().map(|c| c.iter().copied().filter(|a| beyond(a) == 1).collect()).collect()
}

/// What a foot at `foot_m` moves by as joint `a` moves by what counts as a radian, m.
fn per_radian(robot: &RobotModel, at: &Kinematics, a: usize, foot_m: [f64; 3]) -> [f64; 3] {
    let j = robot.actuated()[a];
    let frame = &at.joints[j];
    if robot.joints()[j].motion == JointMotion::Slide {
        return frame.axis.map(|x| x * robot.per_radian(a));
    }
    cross(frame.axis, sub(foot_m, frame.anchor_m))
}

/// The joint of which `of` is largest either way; of equals the first.
fn farthest(joints: &[usize], of: impl Fn(&usize) -> f64) -> Option<Way> {
    let size = |a: &&usize| of(a).abs();
    let joint = joints.iter().rev().max_by(|a, b| size(a).total_cmp(&size(b)))?;
    Some(Way { joint: *joint, sign: if of(joint) < 0.0 { -1.0 } else { 1.0 } })
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use super::*;

    fn legs(robot: &str) -> (RobotModel, Vec<Leg>) {
        let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../robots");
        let path = format!("{folder}/{robot}.robot.toml");
        let robot = RobotModel::load(std::path::Path::new(&path)).unwrap();
        let legs = Leg::all(&robot);
        (robot, legs)
    }

    /// Names of what swings and lifts each leg, with their signs.
    fn ways(robot: &str) -> Vec<String> {
        let (robot, legs) = legs(robot);
        let name = |w: Way| {
            let sign = if w.sign > 0.0 { '+' } else { '-' };
            format!("{sign}{}", robot.actuated_names()[w.joint])
        };
        legs.iter().map(|l| format!("{} {}", name(l.swing), name(l.lift))).collect()
    }

    #[test]
    fn a_sprawling_leg_swings_about_its_upright_hip_and_is_lifted_by_its_knee() {
        let of = ["FL", "FR", "HL", "HR"].map(|l| format!("+{l}_hip -{l}_knee"));
        assert_eq!(ways("polymander"), of);
    }

    #[test]
    fn a_dogs_leg_swings_about_its_thigh_and_is_lifted_by_its_calf() {
        // legs hang down: about an axis to the left a positive turn brings what is below backward
        let of = ["FL", "FR", "HL", "HR"].map(|l| format!("-{l}_thigh -{l}_calf"));
        assert_eq!(ways("quadruped"), of);
    }

    #[test]
    fn an_insects_leg_swings_about_its_coxa_and_is_lifted_by_its_femur() {
        let of = |l: &String| l.contains("_coxa ") && l.ends_with("_femur");
        let ways = ways("hexapod");
        assert!(ways.len() == 6 && ways.iter().all(of), "{ways:?}");
    }

    #[test]
    fn diagonal_legs_of_four_and_three_of_six_step_together() {
        let with_first = |robot| legs(robot).1.iter().map(|l| l.with_first).collect::<Vec<_>>();
        assert_eq!(with_first("polymander"), [true, false, false, true]);
        assert_eq!(with_first("quadruped"), [true, false, false, true]);
        let (_, six) = legs("hexapod");
        assert_eq!(six.iter().filter(|l| l.with_first).count(), 3);
        assert_eq!(six.iter().filter(|l| l.with_first && l.left).count(), 2);
    }
}
