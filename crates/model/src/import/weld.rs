//! Joints that stay where they are: an arm that a dog carries, a gripper, a head.

use std::collections::BTreeSet;

use super::finish::{nominal, wheel, word};
use super::options::Weld;
use super::robot_toml::feet;
use crate::parts::{Joint, Robot};
use crate::pose::{Pose, quat_from_axis_angle, sub};
use crate::tree::{Element, Remarks};
use crate::types::JointMotion;

/// Takes the joints of `welds` out, so that their bodies become part of their parents.
pub(super) fn weld(robot: &mut Robot, welds: &[Weld], root: &Element, remarks: &mut Remarks) {
    for weld in welds {
        // by its name in the file, or as that is rewritten
        let is = |j: &Joint| j.name == weld.joint || word(&j.name) == weld.joint;
        let body = robot.bodies.iter().position(|b| b.joints.iter().any(is));
        let Some(body) = body else {
            let names: Vec<&str> = robot.joints().map(|j| j.name.as_str()).collect();
            let message =
                format!("has no joint `{}` to weld; it has {}", weld.joint, names.join(", "));
            remarks.refuse(root, message);
            continue;
        };
        let k = robot.bodies[body].joints.iter().position(is).unwrap_or(0);
        let drawn_at = robot.bodies[body].joints[k].drawn_at;
        // here positions count from where the file draws the joint, in the file from its `ref`
        let at = match weld.at {
            Some(at) => at - drawn_at,
            None => nominal(robot, &robot.bodies[body].joints[k]),
        };
        let body = &mut robot.bodies[body];
        let joint = body.joints.remove(k);
        if let Some((low, high)) = joint.range.filter(|(low, high)| !(*low..=*high).contains(&at)) {
            let message = format!(
                "is welded at {}, outside of its range ({} to {}): positions are in rad (m)",
                at + drawn_at,
                low + drawn_at,
                high + drawn_at
            );
            remarks.refuse(&joint.element, message);
        }
        let moved = motion(&joint, at);
        // the others of the body that move before it see it the other way round
        let back = moved.inverse();
        for before in &mut body.joints[..k] {
            before.axis = back.rotate(before.axis);
            before.anchor_m = back.point(before.anchor_m);
        }
        body.parent_from_body = body.parent_from_body.compose(&moved);
        robot.actuators.retain(|a| a.joint != joint.name);
        robot.home.remove(&joint.name);
    }
}

/// How a joint that is `way`, rad or m, from where it is drawn has moved its body.
fn motion(joint: &Joint, way: f64) -> Pose {
    match joint.motion {
        JointMotion::Hinge => {
            let turn = Pose {
                quat_wxyz: quat_from_axis_angle(joint.axis, way),
                ..Pose::from_pos(joint.anchor_m)
            };
            Pose { pos_m: sub(joint.anchor_m, turn.rotate(joint.anchor_m)), ..turn }
        }
        JointMotion::Slide => Pose::from_pos(joint.axis.map(|c| c * way)),
    }
}

/// Tells of driven joints of a robot on feet from which no foot hangs: policies drive them too.
pub(super) fn name_others(robot: &Robot, root: &Element, remarks: &mut Remarks) {
    let feet: BTreeSet<String> = feet(robot).into_iter().map(|foot| foot.name).collect();
    let mut carries = vec![false; robot.bodies.len()];
    for (i, body) in robot.bodies.iter().enumerate() {
        let mut at = Some(i).filter(|_| feet.contains(&word(&body.name)));
        while let Some(link) = at {
            carries[link] = true;
            at = robot.bodies[link].parent;
        }
    }
    let driven = |j: &&Joint| robot.actuators.iter().any(|a| a.joint == j.name);
    let others = robot.bodies.iter().zip(&carries).filter(|(b, carries)| !*carries && !wheel(b));
    let names: Vec<&str> = others
        .flat_map(|(body, _)| body.joints.iter().filter(driven))
        .map(|joint| joint.name.as_str())
        .collect();
    if !feet.is_empty() && !names.is_empty() {
        let message = format!(
            "no foot hangs from {}: policies drive them as they do legs; to hold them still, import with `--weld {}`",
            names.join(", "),
            names.join(" ")
        );
        remarks.note(root, message);
    }
}
