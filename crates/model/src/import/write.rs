//! The MJCF of an imported robot.

use std::fmt::Write as _;

use crate::geometry::principal;
use crate::parts::{Actuator, Body, Joint, Painted, Robot};
use crate::pose::Pose;
use crate::types::{JointMotion, Softness};
use crate::xml_text::{escaped, line};

/// Writes everything out: no classes, radians, inertia of every body.
pub(super) fn mjcf(name: &str, robot: &Robot) -> String {
    let mut out = String::new();
    let w = &mut out;
    let [gx, gy, gz] = robot.gravity_mps2;
    line(w, 0, &format!("<mujoco model=\"{name}\">"));
    line(w, 1, "<compiler angle=\"radian\" autolimits=\"true\" inertiafromgeom=\"false\"/>");
    line(w, 1, &format!("<option gravity=\"{gx} {gy} {gz}\" integrator=\"implicitfast\"/>"));
    line(w, 1, "<worldbody>");
    let contype = match robot.ground_bit {
        0 => String::new(),
        bit => format!(" contype=\"{}\"", 1 | bit),
    };
    line(w, 2, &format!("<geom name=\"floor\" type=\"plane\" size=\"0 0 0.05\"{contype}/>"));
    body(w, robot, 0, 2);
    line(w, 1, "</worldbody>");
    let pairs: Vec<[&str; 2]> = robot.excluded.iter().filter_map(|p| pair(robot, p)).collect();
    if !pairs.is_empty() {
        line(w, 1, "<contact>");
        for [a, b] in pairs {
            line(w, 2, &format!("<exclude body1=\"{}\" body2=\"{}\"/>", escaped(a), escaped(b)));
        }
        line(w, 1, "</contact>");
    }
    line(w, 1, "<actuator>");
    for drive in &robot.actuators {
        actuator(w, robot, drive);
    }
    line(w, 1, "</actuator>");
    line(w, 0, "</mujoco>");
    out
}

/// Two bodies that never touch, by the names that they have now; `None`: they are one.
fn pair<'a>(robot: &'a Robot, names: &'a [String; 2]) -> Option<[&'a str; 2]> {
    let now = |name: &'a String| robot.merged.get(name).unwrap_or(name).as_str();
    let [a, b] = [now(&names[0]), now(&names[1])];
    let known = |n: &str| robot.bodies.iter().any(|body| body.name == n);
    (a != b && known(a) && known(b)).then_some([a, b])
}

fn body(w: &mut String, robot: &Robot, index: usize, depth: usize) {
    let own: &Body = &robot.bodies[index];
    let place = pose(&own.parent_from_body);
    line(w, depth, &format!("<body name=\"{}\"{place}>", escaped(&own.name)));
    if index == 0 && robot.free_base {
        line(w, depth + 1, "<freejoint/>");
    }
    if let Some(i) = &own.inertial {
        let [x, y, z] = i.com_m;
        // principal axes: MuJoCo's own search for them is good to seven digits
        let ([a, b, c], [qw, qx, qy, qz]) = principal(i.inertia_kgm2);
        let quat = format!("quat=\"{qw} {qx} {qy} {qz}\"");
        let mass = i.mass_kg;
        let text = format!(
            "<inertial pos=\"{x} {y} {z}\" {quat} mass=\"{mass}\" diaginertia=\"{a} {b} {c}\"/>"
        );
        line(w, depth + 1, &text);
    }
    for joint in &own.joints {
        write_joint(w, joint, depth + 1);
    }
    for geom in &own.geoms {
        write_geom(w, geom, depth + 1);
    }
    for (name, at) in &own.sites {
        line(w, depth + 1, &format!("<site name=\"{}\"{}/>", escaped(name), pose(at)));
    }
    for (child, _) in robot.bodies.iter().enumerate().filter(|(_, b)| b.parent == Some(index)) {
        body(w, robot, child, depth + 1);
    }
    line(w, depth, "</body>");
}

fn write_joint(w: &mut String, joint: &Joint, depth: usize) {
    let mut text = format!("<joint name=\"{}\"", escaped(&joint.name));
    if joint.motion == JointMotion::Slide {
        text.push_str(" type=\"slide\"");
    }
    let [x, y, z] = joint.axis;
    let _ = write!(text, " axis=\"{x} {y} {z}\"");
    if joint.anchor_m != [0.0; 3] {
        let [x, y, z] = joint.anchor_m;
        let _ = write!(text, " pos=\"{x} {y} {z}\"");
    }
    if let Some((low, high)) = joint.range {
        let _ = write!(text, " range=\"{low} {high}\"");
        soft(&mut text, &joint.stop, "solreflimit", "solimplimit");
    }
    for (key, value) in [
        ("stiffness", joint.stiffness),
        ("springref", joint.spring_ref),
        ("damping", joint.damping),
        ("armature", joint.armature),
        ("frictionloss", joint.friction_loss),
    ] {
        if value != 0.0 {
            let _ = write!(text, " {key}=\"{value}\"");
        }
    }
    line(w, depth, &format!("{text}/>"));
}

fn write_geom(w: &mut String, Painted { geom, rgba }: &Painted, depth: usize) {
    let Some((kind, size)) = geom.shape.mjcf() else { return };
    let size: Vec<String> = size.iter().map(f64::to_string).collect();
    let mut text = "<geom".to_owned();
    if let Some(name) = &geom.name {
        let _ = write!(text, " name=\"{}\"", escaped(name));
    }
    let _ =
        write!(text, " type=\"{kind}\" size=\"{}\"{}", size.join(" "), pose(&geom.link_from_geom));
    for (key, value) in [("contype", geom.contype), ("conaffinity", geom.conaffinity)] {
        if value != 1 {
            let _ = write!(text, " {key}=\"{value}\"");
        }
    }
    if geom.collides() {
        let _ = write!(text, " friction=\"{}\"", geom.friction.max(0.0));
        soft(&mut text, &geom.soft, "solref", "solimp");
    }
    if let Some(rgba) = rgba {
        let _ = write!(text, " rgba=\"{}\"", escaped(rgba));
    }
    line(w, depth, &format!("{text}/>"));
}

fn soft(text: &mut String, given: &Softness, solref: &str, solimp: &str) {
    let default = Softness::default();
    let list = |values: &[f64]| values.iter().map(f64::to_string).collect::<Vec<_>>().join(" ");
    if given.solref != default.solref {
        let _ = write!(text, " {solref}=\"{}\"", list(&given.solref));
    }
    if given.solimp != default.solimp {
        let _ = write!(text, " {solimp}=\"{}\"", list(&given.solimp));
    }
}

fn actuator(w: &mut String, robot: &Robot, drive: &Actuator) {
    let joint = escaped(&drive.joint);
    let mut text = match drive.gains {
        Some((kp, kd)) => format!(
            "<position name=\"{joint}\" joint=\"{joint}\" kp=\"{kp}\" kv=\"{}\"",
            kd.max(0.0)
        ),
        None => format!("<motor name=\"{joint}\" joint=\"{joint}\""),
    };
    let range = |j: &&Joint| j.name == drive.joint;
    let joints = robot.bodies.iter().flat_map(|b| &b.joints);
    if let (Some(_), Some((low, high))) =
        (drive.gains, joints.into_iter().find(range).and_then(|j| j.range))
    {
        let _ = write!(text, " ctrlrange=\"{low} {high}\"");
    }
    if let Some(limit) = drive.force_limit {
        let _ = write!(text, " forcerange=\"{} {limit}\"", -limit);
    }
    line(w, 2, &format!("{text}/>"));
}

fn pose(at: &Pose) -> String {
    let mut out = String::new();
    if at.pos_m != [0.0; 3] {
        let [x, y, z] = at.pos_m.map(unsigned);
        let _ = write!(out, " pos=\"{x} {y} {z}\"");
    }
    if at.quat_wxyz != Pose::IDENTITY.quat_wxyz {
        let [qw, x, y, z] = at.quat_wxyz.map(unsigned);
        let _ = write!(out, " quat=\"{qw} {x} {y} {z}\"");
    }
    out
}

/// Without the sign of a zero, which is for no reader.
fn unsigned(x: f64) -> f64 {
    x + 0.0
}
