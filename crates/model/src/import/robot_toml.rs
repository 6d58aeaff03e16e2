//! The robot file of an imported robot: what the MJCF says of drives, what of it is taken for feet, and what
//! nobody said, marked as such.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::Path;

use super::finish::{nominal, reaching, two_digits, unsaid_torque_nm, wheel, word};
use super::sole::{FOOT_LEVEL_M, foot_of, lowest, of_the_sole};
use crate::error::Remark;
use crate::parts::{Actuator, Joint, Robot, UNSAID_DAMPING_S};
use crate::pose::{self, Pose};
use crate::tree::{Element, Remarks};
use crate::types::{Geom, JointMotion};

/// Gains that are written where the MJCF commands torque: the whole torque at this error, as legged robots of
/// 12 to 50 kg are run (Unitree, ANYmal), and [`UNSAID_DAMPING_S`] for it.
const UNSAID_ERROR_RAD: f64 = 0.7;
/// Speed, rad/s, at which a drive has no torque left where the file does not say, and the share of it up to
/// which it has all.
const UNSAID_SPEED_RADPS: f64 = 30.0;
const FULL_TORQUE_SHARE: f64 = 2.0 / 3.0;

/// Friction of a shape of which the file says nothing: MuJoCo's; and what stands for that of a trunk.
const DEFAULT_FRICTION: f64 = 1.0;
const UNSAID_FRICTION: f64 = 0.5;

/// What is taken for a foot.
pub(super) struct Foot {
    pub name: String,
    /// The shapes of its sole.
    geoms: Vec<String>,
    friction: f64,
}

pub(super) fn write(name: &str, file: &Path, robot: &Robot, notes: &[Remark]) -> String {
    let mut out = String::new();
    let w = &mut out;
    let source = file.file_name().map(|f| f.to_string_lossy().into_owned()).unwrap_or_default();
    // writing to a string does not fail
    let _ = writeln!(
        w,
        "# Made by `caudata robot import` of {source}. SI units and radians.\n\
         #   [mjcf]  as there (MJCF or URDF)\n\
         #   [ours]  not in there: a placeholder, to be replaced by what the robot has. Figures among them stand in\n\
         #           `assumed` as well: take a name off that list once its figure is the robot's own\n#"
    );
    for note in notes {
        let _ = writeln!(w, "# {note}");
    }
    let _ = writeln!(
        w,
        "\nformat = \"caudata.robot.v1\"\nname = \"{name}\"\nmjcf = \"{name}.xml\"\nbase = \"{}\"",
        if robot.free_base { "free" } else { "fixed" }
    );
    let joints = joints(robot);
    let driven: Vec<&Joint> =
        robot.actuators.iter().filter_map(|a| joints.get(a.joint.as_str()).copied()).collect();
    let (types, of) = drive_types(robot, &driven);
    let _ = writeln!(w, "assumed = [");
    for path in assumed(robot, &types) {
        let _ = writeln!(w, "    \"{path}\",");
    }
    let _ = writeln!(w, "]");
    let _ = writeln!(w, "\n[joints]\nactuated = [");
    for joint in &driven {
        let _ = writeln!(w, "    {},", quoted(&joint.name));
    }
    let source = if robot.home_is_ours {
        "[ours] worked out: feet or wheels below where their legs begin"
    } else {
        "[mjcf] the named pose, or 0, off the ends of ranges"
    };
    let _ = writeln!(w, "]\n\n# {source}\n[pose.nominal_rad]");
    for joint in &driven {
        let _ = writeln!(w, "{} = {:?}", quoted(&joint.name), nominal(robot, joint));
    }
    gains(w, robot, &driven);
    drives(w, &driven, &types, &of);
    let feet = feet(robot);
    let foot_friction = feet.first().map_or(0.8, |f| f.friction);
    let (body_friction, of_body) = match body_friction(robot, &feet) {
        Some(said) => (said, "mjcf"),
        None => (UNSAID_FRICTION, "ours"),
    };
    let _ = writeln!(
        w,
        "\n[supply]                       # [ours]\ndefault_v = 24.0\nbench_v = 24.0\nbattery_full_v = 25.2\n\
         battery_nominal_v = 22.2\n\n[contact]\nfoot_friction = {foot_friction:?}\nbody_friction = {body_friction:?}           # [{of_body}]"
    );
    if !feet.is_empty() {
        let _ = writeln!(
            w,
            "\n# [ours] the lowest shapes at the end of each leg, front to hind, left before right"
        );
    }
    for foot in &feet {
        let _ = writeln!(
            w,
            "[[feet]]\nname = {}\n{}",
            quoted(&foot.name),
            match foot.geoms.as_slice() {
                [geom] => format!("geom = {}", quoted(geom)),
                geoms => format!("geoms = {}", toml::Value::from(geoms.to_vec())),
            }
        );
    }
    frames(w, robot);
    passive(w, robot, &joints);
    out
}

/// Friction that the file says of what touches the ground and is no foot: wheels, else the trunk. MuJoCo's own default
/// says nothing.
fn body_friction(robot: &Robot, feet: &[Foot]) -> Option<f64> {
    let of_a_foot = |g: &Geom| {
        let name = g.name.as_ref();
        name.is_some_and(|name| feet.iter().any(|f| f.geoms.contains(name)))
    };
    let wheels = robot.bodies.iter().filter(|b| wheel(b));
    let shapes = wheels.chain(robot.bodies.first()).flat_map(reaching).filter(|g| !of_a_foot(g));
    shapes.map(|g| g.friction).find(|&f| f != DEFAULT_FRICTION)
}

fn quoted(text: &str) -> String {
    toml::Value::String(text.to_owned()).to_string()
}

fn joints(robot: &Robot) -> BTreeMap<&str, &Joint> {
    let all = robot.bodies.iter().flat_map(|b| &b.joints);
    all.map(|j| (j.name.as_str(), j)).collect()
}

/// Figures of a type of servo that no MJCF says.
const UNSAID_OF_SERVOS: [&str; 7] = [
    "qd_tau_max_radps",
    "tau_qd_max_nm",
    "reference_supply_v",
    "encoder_counts_per_turn",
    "velocity_lsb_radps",
    "current_lsb_a",
    "torque_per_current_nm_per_a",
];

/// Paths of the figures that are placeholders.
fn assumed(robot: &Robot, types: &[DriveType]) -> Vec<String> {
    let mut out: Vec<String> = Vec::new();
    if robot.actuators.iter().any(|a| a.gains.is_none()) {
        out.extend(["kp_nm_per_rad", "kd_nm_s_per_rad"].map(|key| format!("control.{key}")));
    }
    for (k, drive) in types.iter().enumerate() {
        let guessed = [
            (drive.torque_guessed, "tau_max_nm"),
            (drive.torque_guessed, "tau_brake_max_nm"),
            (drive.speed_guessed, "qd_max_radps"),
            (drive.rotor_guessed, "armature_kgm2"),
        ];
        let guessed = guessed.into_iter().filter(|g| g.0).map(|g| g.1);
        let all = guessed.chain(UNSAID_OF_SERVOS);
        out.extend(all.map(|key| format!("servo.preset.drive_{k}.{key}")));
    }
    let supply = ["default_v", "bench_v", "battery_full_v", "battery_nominal_v"];
    out.extend(supply.map(|key| format!("supply.{key}")));
    if body_friction(robot, &feet(robot)).is_none() {
        out.push("contact.body_friction".to_owned());
    }
    out
}

/// A type of servo, as far as the MJCF tells one from another.
#[derive(PartialEq)]
struct DriveType {
    motion: JointMotion,
    torque_nm: f64,
    speed_radps: f64,
    armature_kgm2: f64,
    damping: f64,
    friction_nm: f64,
    torque_guessed: bool,
    speed_guessed: bool,
    rotor_guessed: bool,
}

/// One type for all drives that are alike, and which each drive is.
fn drive_types(robot: &Robot, driven: &[&Joint]) -> (Vec<DriveType>, Vec<usize>) {
    let mut types: Vec<DriveType> = Vec::new();
    let mut of = Vec::new();
    for (joint, drive) in driven.iter().zip(&robot.actuators) {
        let own = DriveType {
            motion: joint.motion,
            torque_nm: drive.force_limit.unwrap_or_else(|| unsaid_torque_nm(robot, joint.motion)),
            speed_radps: (drive.speed_limit)
                .unwrap_or(UNSAID_SPEED_RADPS * joint.motion.per_radian()),
            armature_kgm2: joint.armature,
            damping: joint.damping,
            friction_nm: joint.friction_loss,
            torque_guessed: drive.force_limit.is_none(),
            speed_guessed: drive.speed_limit.is_none(),
            rotor_guessed: joint.armature > 0.0 && joint.element.get("armature").is_none(),
        };
        let known = types.iter().position(|t| *t == own);
        of.push(known.unwrap_or_else(|| {
            types.push(own);
            types.len() - 1
        }));
    }
    (types, of)
}

/// Gains.
fn gains(w: &mut String, robot: &Robot, driven: &[&Joint]) {
    // where a drive has no gains, it has a torque by now
    let gains_of = |(joint, drive): (&&Joint, &Actuator)| {
        drive.gains.unwrap_or_else(|| {
            let error = UNSAID_ERROR_RAD * joint.motion.per_radian();
            let kp = two_digits(drive.force_limit.unwrap_or_default() / error);
            (kp, two_digits(kp * UNSAID_DAMPING_S))
        })
    };
    let gains: Vec<(f64, f64)> = driven.iter().zip(&robot.actuators).map(gains_of).collect();
    let common = gains.first().copied().unwrap_or_default();
    let source = if robot.actuators.iter().all(|a| a.gains.is_some()) {
        "[mjcf]"
    } else {
        "[ours] from the torque, where it commands torque"
    };
    let _ = writeln!(
        w,
        "\n# {source}\n[control]\nkp_nm_per_rad = {:?}\nkd_nm_s_per_rad = {:?}",
        common.0,
        common.1.max(0.0)
    );
    for (joint, (kp, kd)) in driven.iter().zip(&gains).filter(|(_, g)| **g != common) {
        let _ = writeln!(
            w,
            "[control.joint.{}]\nkp_nm_per_rad = {kp:?}\nkd_nm_s_per_rad = {:?}",
            quoted(&joint.name),
            kd.max(0.0)
        );
    }
}

/// Servo types, and which joint has which.
fn drives(w: &mut String, driven: &[&Joint], types: &[DriveType], of: &[usize]) {
    let _ = writeln!(w, "\n[servo]\ndefault = \"drive_0\"\n[servo.joint]");
    for (joint, k) in driven.iter().zip(of).filter(|(_, k)| **k > 0) {
        let _ = writeln!(w, "{} = \"drive_{k}\"", quoted(&joint.name));
    }
    let mark = |ours: bool| if ours { "[ours]" } else { "[mjcf]" };
    for (k, t) in types.iter().enumerate() {
        let full = two_digits(t.speed_radps * FULL_TORQUE_SHARE);
        let (of_torque, of_speed) = (mark(t.torque_guessed), mark(t.speed_guessed));
        let of_rotor = mark(t.rotor_guessed);
        // of a slide, steps that are as fine in what counts as a radian
        let (counts, speed_step) = match t.motion {
            JointMotion::Hinge => (16_384, 0.001),
            JointMotion::Slide => (163_840, 0.0001),
        };
        let DriveType {
            torque_nm: torque,
            speed_radps: speed,
            armature_kgm2: armature,
            damping,
            friction_nm: friction,
            ..
        } = t;
        let _ = writeln!(
            w,
            "\n[servo.preset.drive_{k}]\ntau_max_nm = {torque:?}                # {of_torque}\n\
             qd_tau_max_radps = {full:?}           # [ours]\nqd_max_radps = {speed:?}               # {of_speed}\ntau_qd_max_nm = 0.0               # [ours]\n\
             tau_brake_max_nm = {torque:?}          # {of_torque}\nkd_min_nm_s_per_rad = 0.0\nback_drive_kp_ratio = 1.0\n\
             friction_loss_nm = {friction:?}          # [mjcf]\ndamping_nm_s_per_rad = {damping:?}      # [mjcf]\narmature_kgm2 = {armature:?}             # {of_rotor}\n\
             reference_supply_v = 24.0         # [ours]\nencoder_counts_per_turn = {counts}   # [ours]\nvelocity_lsb_radps = {speed_step:?}        # [ours]\n\
             current_lsb_a = 0.01              # [ours]\ntorque_per_current_nm_per_a = 1.0 # [ours]\ncurrent_dead_band_a = 0.0\ngear_backlash_rad = 0.0"
        );
    }
}

fn frames(w: &mut String, robot: &Robot) {
    let root = &robot.bodies[0];
    let _ = writeln!(w, "\n[frames]\ntorso = {}", quoted(&root.name));
    if let Some((_, name)) = robot.imu() {
        let _ = writeln!(
            w,
            "\n[imu]\nsite = {}                      # [mjcf]\ngyro_noise_radps_per_sqrt_hz = 2.44e-4   # [ours]\n\
             acc_noise_mps2_per_sqrt_hz = 1.72e-3     # [ours]\ngyro_bias_std_radps = 0.01745            # [ours]\nacc_bias_std_mps2 = 0.1961               # [ours]",
            quoted(name)
        );
    }
}

/// Joints without a drive.
fn passive(w: &mut String, robot: &Robot, joints: &BTreeMap<&str, &Joint>) {
    let moved = |name: &str| robot.actuators.iter().any(|a| a.joint == name);
    let free: Vec<&&Joint> = joints.values().filter(|j| !moved(&j.name)).collect();
    if free.is_empty() {
        return;
    }
    let _ = writeln!(w, "\n# [mjcf] joints without a drive\n[passive]\nlocked = false");
    for joint in free {
        let _ = writeln!(
            w,
            "[passive.joint.{}]\nstiffness_nm_per_rad = {:?}\ndamping_nm_s_per_rad = {:?}\nfriction_loss_nm = {:?}",
            quoted(&joint.name),
            joint.stiffness,
            joint.damping,
            joint.friction_loss
        );
    }
}

/// The lowest shape of each chain that ends on the ground in the nominal pose; none for a robot that lies on
/// its root link there.
pub(super) fn feet(robot: &Robot) -> Vec<Foot> {
    if !robot.free_base {
        return Vec::new();
    }
    let places = places(robot);
    let lowest = |i: usize| lowest(robot, &places, i);
    let mut found: Vec<([f64; 3], f64, Foot)> = Vec::new();
    for end in 1..robot.bodies.len() {
        if robot.bodies.iter().any(|b| b.parent == Some(end)) {
            continue;
        }
        if wheel(&robot.bodies[end]) {
            continue;
        }
        let i = foot_of(robot, &places, end).unwrap_or(end);
        let Some((at, z, geom)) = lowest(i) else { continue };
        let geoms = reaching(&robot.bodies[i]).filter(|g| of_the_sole(&places[i], geom, g));
        let foot = Foot {
            name: word(&robot.bodies[i].name),
            geoms: geoms.filter_map(|g| g.name.clone()).collect(),
            friction: geom.friction,
        };
        if !found.iter().any(|(_, _, f)| f.name == foot.name) {
            found.push((at, z, foot));
        }
    }
    let ground = found.iter().map(|f| f.1).fold(f64::INFINITY, f64::min);
    let lies = lowest(0).is_some_and(|(_, z, _)| z - ground <= FOOT_LEVEL_M);
    found.retain(|f| !lies && f.1 - ground <= FOOT_LEVEL_M);
    // front to hind in steps of a hand's breadth, left before right
    let row = |x: f64| (-x / 0.1).round() as i64;
    found.sort_by(|(a, _, _), (b, _, _)| row(a[0]).cmp(&row(b[0])).then(b[1].total_cmp(&a[1])));
    found.into_iter().map(|(_, _, foot)| foot).collect()
}

/// Raises a held robot that would be stuck in the ground: nothing of it that moves reaches the ground then.
pub(super) fn raise(robot: &mut Robot, root: &Element, remarks: &mut Remarks) {
    let places = places(robot);
    let mut stuck: Option<(f64, String)> = None;
    // how far from the root's origin the farthest point of each body can be, and whether it moves
    let (mut origins_m, mut moves): (Vec<f64>, Vec<bool>) = (Vec::new(), Vec::new());
    let mut reach_m = 0.0f64;
    for (i, body) in robot.bodies.iter().enumerate() {
        let parent =
            body.parent.map_or(0.0, |p| origins_m[p] + pose::norm(body.parent_from_body.pos_m));
        let travel = |j: &Joint| match (j.motion, j.range) {
            (JointMotion::Slide, Some((low, high))) => low.abs().max(high.abs()),
            _ => 2.0 * pose::norm(j.anchor_m),
        };
        origins_m.push(parent + body.joints.iter().map(travel).sum::<f64>());
        moves.push(!body.joints.is_empty() || body.parent.is_some_and(|p| moves[p]));
        for geom in reaching(body).filter(|_| moves[i]) {
            let at = places[i].compose(&geom.link_from_geom);
            let extent_m = |axis| geom.shape.half_extent_m(axis);
            let z = at.pos_m[2] - extent_m(at.inverse().rotate([0.0, 0.0, 1.0]));
            if z < 0.0 && stuck.as_ref().is_none_or(|(lowest, _)| z < *lowest) {
                stuck = Some((z, geom.name.clone().unwrap_or_else(|| body.name.clone())));
            }
            let size_m = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]].map(extent_m);
            reach_m = reach_m
                .max(origins_m[i] + pose::norm(geom.link_from_geom.pos_m) + pose::norm(size_m));
        }
    }
    let Some((z, geom)) = stuck.filter(|_| !robot.free_base) else { return };
    let at = &mut robot.bodies[0].parent_from_body.pos_m[2];
    let up_m = ((reach_m - *at) * 100.0).ceil() / 100.0;
    *at += up_m;
    let message = format!(
        "`{geom}` is {:.3} m below the ground (z = 0) in the nominal pose of a fixed base; the whole robot is raised by \
         {up_m} m, out of its reach",
        -z
    );
    remarks.note(root, message);
}

/// Where each body is in the nominal pose.
pub(super) fn places(robot: &Robot) -> Vec<Pose> {
    let mut out: Vec<Pose> = Vec::new();
    for body in &robot.bodies {
        let mut at = match body.parent {
            Some(parent) => out[parent].compose(&body.parent_from_body),
            // where a free base stands in the file is not how it stands
            None if robot.free_base => Pose::IDENTITY,
            None => body.parent_from_body,
        };
        for joint in &body.joints {
            at = at.compose(&moved(joint, nominal(robot, joint)));
        }
        out.push(at);
    }
    out
}

/// How a joint at `q` moves its body.
pub(super) fn moved(joint: &Joint, q: f64) -> Pose {
    match joint.motion {
        JointMotion::Slide => Pose::from_pos(joint.axis.map(|a| a * q)),
        JointMotion::Hinge => {
            let turn =
                Pose { pos_m: [0.0; 3], quat_wxyz: pose::quat_from_axis_angle(joint.axis, q) };
            Pose { pos_m: pose::sub(joint.anchor_m, turn.rotate(joint.anchor_m)), ..turn }
        }
    }
}
