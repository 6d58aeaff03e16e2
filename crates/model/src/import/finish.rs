//! What is worked out of a robot that was read, and the form that the supported subset has.

use std::collections::{BTreeMap, BTreeSet};
use std::f64::consts::TAU;

use crate::geometry::Solid;
use crate::model::IMU_TILT_MAX_RAD;
use crate::parts::{Actuator, Body, Joint, Painted, Robot};
use crate::pose::{self, Pose};
use crate::tree::{Element, Remarks};
use crate::types::{Geom, JointMotion, Shape};

/// Joint positions of the pose that the robot file calls nominal.
pub(super) fn nominal(robot: &Robot, joint: &Joint) -> f64 {
    let (low, high) = joint.range.unwrap_or((f64::NEG_INFINITY, f64::INFINITY));
    let home = robot.home.get(&joint.name).copied().unwrap_or(0.0);
    home.clamp(low, high)
}

/// Tells of joints that nothing holds: a forgotten actuator makes a leg limp.
fn name_undriven(robot: &Robot, remarks: &mut Remarks) {
    let driven: BTreeSet<&str> = robot.actuators.iter().map(|a| a.joint.as_str()).collect();
    let bodies = robot.bodies.iter().filter(|body| !wheel(body));
    let joints = bodies.flat_map(|body| &body.joints);
    let limp = joints.filter(|j| j.stiffness == 0.0 && !driven.contains(j.name.as_str()));
    for joint in limp.filter(|_| !driven.is_empty()) {
        let message = format!(
            "no actuator drives `{}` and no spring holds it, so it swings freely; if it has a motor, add its actuator",
            joint.name
        );
        remarks.note_of(&joint.element, message);
    }
}

/// Brings what was read into the form that the supported subset has.
pub(super) fn finish(robot: &mut Robot, root: &Element, remarks: &mut Remarks) {
    if robot.bodies.is_empty() {
        remarks.refuse(root, "holds no body that moves");
        return;
    }
    while drop_empty_root(robot) {}
    merge_welded(robot);
    while drop_empty_root(robot) {}
    if root.tag == "mujoco" && root.all("actuator").next().is_none() {
        drive_all(robot, root, remarks);
    }
    limit_actuated(robot, remarks);
    name_plainly(robot, remarks);
    for (i, body) in robot.bodies.iter_mut().enumerate() {
        if body.inertial.is_none_or(|i| i.mass_kg <= 0.0) {
            let label = body.element.label();
            let or = if root.tag == "robot" { " with a <mass>" } else { ", or shapes with a mass" };
            if i == 0 && !robot.free_base && body.joints.is_empty() {
                // it does not move: any mass will do
                body.inertial = Some(Solid::unit_ball());
            } else {
                let shell = body.element.all("geom").find_map(|geom| geom.get("mesh"));
                let of_shell =
                    shell.map_or(String::new(), |mesh| format!("; was its mesh `{mesh}` found?"));
                let message =
                    format!("{label} moves and has no mass; give it an <inertial>{or}{of_shell}");
                remarks.refuse(&body.element, message);
            }
        }
    }
    name_undriven(robot, remarks);
    strengthen(robot, root, remarks);
    turn_imu(robot, remarks);
    shape(robot, remarks);
    name_uniquely(robot);
    if robot.actuators.is_empty() {
        remarks.refuse(
            root,
            "has no actuator that drives a joint (what pulls a tendon or a site does not); add <actuator><motor \
             joint=\"…\"/></actuator>",
        );
    }
}

/// Turns the axes of an IMU that is mounted otherwise to forward, left and up, as the robot is drawn: so policies
/// take gravity and turn rates.
fn turn_imu(robot: &mut Robot, remarks: &mut Remarks) {
    let Some((body, name)) = robot.imu().map(|(body, name)| (body, name.to_owned())) else {
        return;
    };
    let mut root_from_body = Pose::IDENTITY;
    let mut at = body;
    while let Some(parent) = robot.bodies[at].parent {
        root_from_body = robot.bodies[at].parent_from_body.compose(&root_from_body);
        at = parent;
    }
    let Body { sites, element, .. } = &mut robot.bodies[body];
    let Some((_, site)) = sites.iter_mut().find(|(own, _)| *own == name) else { return };
    let half_turn = root_from_body.compose(site).quat_wxyz[0].abs();
    if half_turn >= (IMU_TILT_MAX_RAD / 2.0).cos() {
        return;
    }
    site.quat_wxyz = root_from_body.inverse().quat_wxyz;
    let message = format!(
        "the IMU `{name}` is mounted turned by {:.0}°; its axes are made forward, left and up, which is what policies read: \
         `imu.axes` of the wiring file turns what the chip gives, the map of a log what was recorded",
        2.0 * half_turn.min(1.0).acos().to_degrees()
    );
    remarks.note(element, message);
}

/// An MJCF without actuators: its users add them in code. As in a URDF, each joint has a drive.
fn drive_all(robot: &mut Robot, root: &Element, remarks: &mut Remarks) {
    let drive = |joint: &Joint| Actuator {
        joint: joint.name.clone(),
        gains: None,
        force_limit: joint.force_limit,
        speed_limit: None,
        element: joint.element.clone(),
    };
    robot.actuators = robot.joints().map(drive).collect();
    let count = robot.actuators.len();
    remarks.note(root, format!("names no actuators; each of the {count} joints is given a drive"));
}

/// A body without a joint becomes part of its parent.
fn merge_welded(robot: &mut Robot) {
    let count = robot.bodies.len();
    let mut into: Vec<usize> = (0..count).collect();
    let mut place: Vec<Pose> = vec![Pose::IDENTITY; count];
    let mut bodies: Vec<Body> = Vec::new();
    for (i, mut body) in std::mem::take(&mut robot.bodies).into_iter().enumerate() {
        let Some(parent) = body.parent else {
            into[i] = bodies.len();
            bodies.push(body);
            continue;
        };
        let at = place[parent].compose(&body.parent_from_body);
        let target = into[parent];
        if !body.joints.is_empty() {
            body.parent = Some(target);
            body.parent_from_body = at;
            into[i] = bodies.len();
            bodies.push(body);
            continue;
        }
        into[i] = target;
        place[i] = at;
        let host = &mut bodies[target];
        robot.merged.insert(body.name.clone(), host.name.clone());
        for mut geom in body.geoms {
            geom.geom.link_from_geom = at.compose(&geom.geom.link_from_geom);
            host.geoms.push(geom);
        }
        for (name, pose) in body.sites {
            host.sites.push((name, at.compose(&pose)));
        }
        if let Some(own) = body.inertial {
            let own = own.seen_from(&at);
            host.inertial = Some(host.inertial.map_or(own, |rest| rest.with(&own)));
        }
    }
    // an MJCF has a world already
    if let Some(body) = bodies.iter_mut().find(|b| b.name == MJCF_WORLD) {
        body.name = format!("{MJCF_WORLD}_link");
        robot.merged.insert(MJCF_WORLD.to_owned(), body.name.clone());
        for host in robot.merged.values_mut().filter(|h| *h == MJCF_WORLD) {
            host.clone_from(&body.name);
        }
    }
    robot.bodies = bodies;
}

const MJCF_WORLD: &str = "world";

/// Whether the root was nothing but a place and gave way to the one body that hangs on it, a free one to what is
/// welded to it.
fn drop_empty_root(robot: &mut Robot) -> bool {
    let mut children = robot.bodies.iter().filter(|b| b.parent == Some(0));
    let root = &robot.bodies[0];
    let has_mass = root.inertial.is_some_and(|i| i.mass_kg > 0.0);
    let empty = root.joints.is_empty() && root.geoms.is_empty() && root.sites.is_empty();
    let (Some(heir), None) = (children.next(), children.next()) else { return false };
    if robot.free_base && !heir.joints.is_empty() || has_mass || !empty {
        return false;
    }
    robot.merged.insert(root.name.clone(), heir.name.clone());
    let root = robot.bodies.remove(0);
    for body in &mut robot.bodies {
        body.parent = match body.parent {
            Some(0) => {
                body.parent_from_body = root.parent_from_body.compose(&body.parent_from_body);
                None
            }
            other => other.map(|p| p - 1),
        };
    }
    true
}

/// Limits of a wheel, rad, either way: no run goes so far.
const WHEEL_RAD: f64 = 1e5;

/// Every actuated joint needs limits.
fn limit_actuated(robot: &mut Robot, remarks: &mut Remarks) {
    let actuated: BTreeSet<String> = robot.actuators.iter().map(|a| a.joint.clone()).collect();
    let carries: BTreeSet<usize> = robot.bodies.iter().filter_map(|b| b.parent).collect();
    // by what is told of them, since most joints of such a file have none
    let mut told_of: BTreeMap<&str, (Element, Vec<String>)> = BTreeMap::new();
    for (i, body) in robot.bodies.iter_mut().enumerate() {
        let rolls = !carries.contains(&i) && wheel(body);
        let unlimited = |j: &&mut Joint| j.range.is_none() && actuated.contains(&j.name);
        for joint in body.joints.iter_mut().filter(unlimited) {
            let (half, told) = match joint.motion {
                _ if rolls => (WHEEL_RAD, "a wheel and no foot: a policy sets its speed"),
                JointMotion::Hinge => {
                    (TAU, "no limits; ±6.2832 rad written: a joint that turns farther stops there")
                }
                JointMotion::Slide => (1.0, "no limits; ±1.0000 m written"),
            };
            joint.range = Some((-half, half));
            let (_, names) =
                told_of.entry(told).or_insert_with(|| (joint.element.clone(), Vec::new()));
            names.push(format!("`{}`", joint.name));
        }
    }
    for (told, (element, names)) in told_of {
        remarks.note(&element, format!("{}: {told}", names.join(", ")));
    }
}

/// Whether a drive moves a body against its parent.
pub(super) fn driven(robot: &Robot, body: usize) -> bool {
    let joints = robot.bodies[body].joints.iter();
    joints.into_iter().any(|j| robot.actuators.iter().any(|a| a.joint == j.name))
}

/// Whether a body rolls on its joint: all of it round about an axis that it can turn about by more than once, or
/// inside of what is.
pub(super) fn wheel(body: &Body) -> bool {
    let [joint] = body.joints.as_slice() else { return false };
    let turns = joint.range.is_none_or(|(low, high)| high - low > std::f64::consts::TAU);
    let (anchor_m, axis) = (joint.anchor_m, joint.axis);
    let radii = reaching(body).filter_map(|geom| geom.radius_about_m(anchor_m, axis));
    let tyre_m = radii.fold(0.0, f64::max);
    let hub = |geom: &Geom| geom.within_m(anchor_m, axis) <= tyre_m;
    let round = |geom: &Geom| geom.radius_about_m(anchor_m, axis).is_some() || hub(geom);
    turns && joint.motion == JointMotion::Hinge && tyre_m > 0.0 && reaching(body).all(round)
}

/// Shapes that can touch the ground.
pub(super) fn reaching(body: &Body) -> impl Iterator<Item = &Geom> {
    let geoms = body.geoms.iter().map(|painted| &painted.geom);
    geoms.filter(|g| g.collides() && g.shape != Shape::Plane)
}

pub(super) const GRAVITY_MPS2: f64 = 9.81;

/// Weight of all of it.
pub(super) fn weight_n(robot: &Robot) -> f64 {
    let masses = robot.bodies.iter().filter_map(|b| b.inertial);
    GRAVITY_MPS2 * masses.map(|i| i.mass_kg).sum::<f64>()
}

/// How far the longest limb's outermost mass is from the root, along the limb.
pub(super) fn reach_m(robot: &Robot) -> f64 {
    let mut along_m: Vec<f64> = Vec::new();
    let mut farthest_m = 0.0f64;
    for body in &robot.bodies {
        let own = pose::norm(body.parent_from_body.pos_m);
        let at = body.parent.map_or(0.0, |p| along_m[p] + own);
        along_m.push(at);
        let centre = body.inertial.map_or(0.0, |i| pose::norm(i.com_m));
        farthest_m = farthest_m.max(at + centre);
    }
    farthest_m.max(0.01)
}

/// Torque (of a slide force) that is written where nothing limits any drive: it carries the weight at the end of the
/// longest limb.
pub(super) fn unsaid_torque_nm(robot: &Robot, motion: JointMotion) -> f64 {
    let lever_m = if motion == JointMotion::Hinge { reach_m(robot) } else { 1.0 };
    two_digits(weight_n(robot) * lever_m).max(0.01)
}

/// Inertia of rotor and gears at the joint for each N·m of the drive, s²: a URDF has no word for it, and a light
/// link without it is too quick for the time step. The least of the servos in `robots/polymander.robot.toml`
/// (XM430-W350: 0.0025 kg·m², 2.95 N·m).
const ROTOR_S2: f64 = 8.5e-4;

/// A drive without a greatest torque and gains gets the median of those that have one; one of a URDF
/// also a rotor.
fn strengthen(robot: &mut Robot, root: &Element, remarks: &mut Remarks) {
    for motion in [JointMotion::Hinge, JointMotion::Slide] {
        let (what, unit, guess) = match motion {
            JointMotion::Hinge => ("torque", "N·m", "the weight times the reach of its limbs"),
            JointMotion::Slide => ("force", "N", "the weight"),
        };
        let such = robot.joints().filter(|j| j.motion == motion);
        let such: BTreeSet<String> = such.map(|j| j.name.clone()).collect();
        let own = robot.actuators.iter().filter(|a| such.contains(&a.joint));
        let mut known: Vec<f64> = own.filter_map(|a| a.force_limit).collect();
        known.sort_by(f64::total_cmp);
        let (torque, source) = match known.get(known.len() / 2) {
            Some(median) => (*median, "the median of the others".to_owned()),
            None => (unsaid_torque_nm(robot, motion), format!("a guess: {guess}")),
        };
        let lacks = |a: &&mut Actuator| a.force_limit.is_none() && a.gains.is_none();
        let mut weak: Vec<&str> = Vec::new();
        for drive in robot.actuators.iter_mut().filter(|a| such.contains(&a.joint)).filter(lacks) {
            drive.force_limit = Some(torque);
            weak.push(&drive.joint);
        }
        if !weak.is_empty() {
            let weak = weak.join(", ");
            let message =
                format!("no greatest {what} of {weak}: {torque} {unit} written, {source}");
            remarks.note(root, message);
        }
    }
    if root.tag == "robot" {
        // every drive of a URDF has a torque by now
        let forces = robot.actuators.iter().map(|a| (a.joint.clone(), a.force_limit));
        let forces: Vec<(String, f64)> = forces.map(|(j, f)| (j, f.unwrap_or_default())).collect();
        for (name, force) in forces {
            let moved = robot.hanging_inertia(&name);
            let mut joints = robot.bodies.iter_mut().flat_map(|b| &mut b.joints);
            if let Some(joint) = joints.find(|j| j.name == name) {
                joint.armature = two_digits(rotor(joint.motion, force, moved));
            }
        }
    }
}

/// Guess of what rotor and gears weigh at a joint: kg·m², of a slide kg. There it turns over what counts as a radian,
/// and no slide is given a drive that weighs more than what it moves: forces of URDFs are often any large number.
fn rotor(motion: JointMotion, force: f64, moved: f64) -> f64 {
    match motion {
        JointMotion::Hinge => ROTOR_S2 * force,
        JointMotion::Slide => (ROTOR_S2 * force / motion.per_radian()).min(moved),
    }
}

/// A lighter body without a shape is not drawn, share of the robot's mass.
const DRAWN_LEAST: f64 = 0.002;

/// Ellipsoids that touch become capsules of their length and their least width; what has no shape is drawn as
/// the box of its inertia.
fn shape(robot: &mut Robot, remarks: &mut Remarks) {
    let least_kg = DRAWN_LEAST * weight_n(robot) / GRAVITY_MPS2;
    for body in &mut robot.bodies {
        let touching = body.geoms.iter_mut().map(|g| &mut g.geom).filter(|g| g.collides());
        for geom in touching {
            if let Shape::Ellipsoid { semi_axes_m } = geom.shape {
                (geom.shape, geom.link_from_geom) = capsule(semi_axes_m, &geom.link_from_geom);
                let message = "ellipsoids touch the ground as capsules, as long and as wide as their least width";
                remarks.note_once(&body.element, message);
            }
        }
        let moves = body.parent.is_some() || robot.free_base;
        let inertial = body.inertial.filter(|i| moves && i.mass_kg > least_kg);
        if let (true, Some(inertial)) = (body.geoms.is_empty(), inertial) {
            body.geoms.push(Painted { geom: inertial.drawn(), rgba: None });
            let message = "a body without a shape is drawn as the box of its inertia";
            remarks.note_once(&body.element, message);
        }
    }
}

/// A capsule along an ellipsoid's longest axis, as long as that and as wide as the shortest; a ball where both
/// are alike.
fn capsule(semi_axes_m: [f64; 3], link_from_geom: &Pose) -> (Shape, Pose) {
    let radius_m = semi_axes_m.into_iter().fold(f64::INFINITY, f64::min);
    let longest_m = semi_axes_m.into_iter().fold(0.0, f64::max);
    let half_length_m = longest_m - radius_m;
    if half_length_m < 1e-6 {
        return (Shape::Sphere { radius_m }, *link_from_geom);
    }
    let along = semi_axes_m.iter().position(|a| *a == longest_m).unwrap_or(2);
    let axis = |k: usize| [0, 1, 2].map(|i| f64::from(u8::from(i == (along + k) % 3)));
    let quat_wxyz = pose::quat_from_axes(axis(1), axis(2));
    let quat_wxyz = quat_wxyz.unwrap_or(Pose::IDENTITY.quat_wxyz);
    let turned = Pose { quat_wxyz, ..Pose::IDENTITY };
    (Shape::Capsule { radius_m, half_length_m }, link_from_geom.compose(&turned))
}

/// Two digits of a number: it is a guess.
pub(super) fn two_digits(x: f64) -> f64 {
    format!("{x:.1e}").parse().unwrap_or(x)
}

/// Letters, digits, _ and - only.
pub(super) fn word(text: &str) -> String {
    let mut out = String::new();
    for c in text.chars() {
        match c {
            'a'..='z' | 'A'..='Z' | '0'..='9' | '-' => out.push(c),
            'ä' | 'ö' | 'ü' | 'ß' | 'Ä' | 'Ö' | 'Ü' => {
                let two = ["ae", "oe", "ue", "ss", "Ae", "Oe", "Ue"];
                out.push_str("äöüßÄÖÜ".chars().position(|u| u == c).map_or("_", |i| two[i]));
            }
            _ => out.push('_'),
        }
    }
    out
}

/// Gives joints names that policies and logs can carry.
fn name_plainly(robot: &mut Robot, remarks: &mut Remarks) {
    let mut taken: BTreeSet<String> = robot.joints().map(|j| j.name.clone()).collect();
    for joint in robot.bodies.iter_mut().flat_map(|b| &mut b.joints) {
        let mut short = word(&joint.name);
        if short.len() > NAME_MAX {
            short = short.trim_end_matches("_joint").to_owned();
        }
        if short.len() > NAME_MAX {
            short.replace_range(NAME_MAX / 2..short.len() - NAME_MAX / 2 + 1, "_");
        }
        if short == joint.name {
            continue;
        }
        let mut count = 2;
        let stem = short.clone();
        while taken.contains(&short) {
            let end = format!("_{count}");
            short = format!("{}{end}", &stem[..stem.len().min(NAME_MAX - end.len())]);
            count += 1;
        }
        taken.insert(short.clone());
        let message = format!(
            "{} is called `{short}` here: a name is 1 to {NAME_MAX} letters (a to z), digits, _ and -",
            joint.element.label()
        );
        remarks.note(&joint.element, message);
        if let Some(q) = robot.home.remove(&joint.name) {
            robot.home.insert(short.clone(), q);
        }
        for drive in robot.actuators.iter_mut().filter(|a| a.joint == joint.name) {
            drive.joint.clone_from(&short);
        }
        joint.name = short;
    }
}

/// The longest name of a joint that a policy can carry.
const NAME_MAX: usize = 32;

/// Gives shapes of the same name others, so that each can be spoken of.
fn name_uniquely(robot: &mut Robot) {
    let mut names = BTreeSet::new();
    let all = robot.bodies.iter_mut().flat_map(|b| &mut b.geoms);
    for geom in all.map(|painted| &mut painted.geom) {
        if let Some(name) = &geom.name
            && !names.insert(name.clone())
        {
            geom.name = None;
        }
    }
    for body in &mut robot.bodies {
        let colliding = body
            .geoms
            .iter_mut()
            .map(|painted| &mut painted.geom)
            .filter(|g| g.collides() && g.name.is_none());
        for (i, geom) in colliding.enumerate() {
            let name = format!("{}_shape_{i}", body.name);
            if names.insert(name.clone()) {
                geom.name = Some(name);
            }
        }
    }
}
