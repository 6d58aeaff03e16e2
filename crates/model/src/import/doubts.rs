//! What a file says that can hardly be so: degrees, grams and millimetres where radians, kilograms and metres
//! belong, and inertias that no body has.

use super::finish::{GRAVITY_MPS2, reach_m, weight_n, wheel};
use crate::error::Remark;
use crate::geometry::{check_inertia, principal};
use crate::parts::{Body, Joint, Robot};
use crate::tree::{Element, Remarks};
use crate::types::JointMotion;

/// Two turns: farther off a limit is in degrees, or of a joint that turns without end.
const FAR_RAD: f64 = 4.0 * std::f64::consts::PI;
/// Two turns, written in radians and read as degrees: most limits nearer to each other are hardly meant.
const NARROW_RAD: f64 = 0.22;
/// How far past a limit an angle of the key frame is more than rounding.
const PAST_RAD: f64 = 0.01;
/// The strongest drive's share of weight times reach, beyond which either is in another unit. Legged robots and
/// arms have 0.1 to 3.
const TORQUE_SHARE: (f64, f64) = (0.01, 100.0);
/// How far from its centre the mass of a link lies, of the reach of the whole robot, and m; no mass lies as far
/// as the last of these.
const GYRATION_SHARE: f64 = 2.0;
const GYRATION_LEAST_M: f64 = 1e-4;
const GYRATION_MOST: f64 = 10.0;

/// Refuses what no body can have, and notes what is hardly meant.
pub(super) fn say(robot: &Robot, root: &Element, remarks: &mut Remarks) {
    let reach_m = reach_m(robot);
    let mut beyond = Vec::new();
    for body in &robot.bodies {
        inertia(robot, body, reach_m, remarks);
        let turns = |j: &&Joint| j.motion == JointMotion::Hinge && !wheel(body);
        for joint in body.joints.iter().filter(turns) {
            if let Some((low, high)) = joint.range.filter(|(l, h)| l.min(-h) < -FAR_RAD) {
                let message =
                    format!("limits of {low} and {high} rad: are they degrees? {RADIANS}");
                remarks.note_of(&joint.element, message);
            }
            let home = robot.home.get(&joint.name).zip(joint.range);
            if home.is_some_and(|(q, (low, high))| *q < low - PAST_RAD || *q > high + PAST_RAD) {
                beyond.push(joint.name.as_str());
            }
        }
    }
    let limits = || {
        let joints = robot.joints().filter(|j| j.motion == JointMotion::Hinge);
        joints.filter_map(|j| j.range).filter(|(low, high)| low < high)
    };
    let narrow = limits().filter(|(low, high)| high - low < NARROW_RAD).count();
    let in_degrees = |e: &Element| e.attributes.get("angle").is_none_or(|angle| angle != "radian");
    let mut compilers = root.children.iter().filter(|e| e.tag == "compiler");
    if root.tag == "mujoco" && compilers.all(in_degrees) && 2 * narrow > limits().count() {
        let message = format!(
            "of hinges {narrow} have limits less than {NARROW_RAD} rad apart: are they radians that count as degrees? {RADIANS}"
        );
        remarks.note(root, message);
    }
    if !beyond.is_empty() {
        let message = format!(
            "the key frame has {} beyond the limits, at which the nominal pose stops: qpos is in radians, limits are in \
             what <compiler angle> says, degrees without it",
            beyond.join(", ")
        );
        remarks.note(root, message);
    }
    let turns =
        |name: &str| robot.joints().any(|j| j.name == name && j.motion == JointMotion::Hinge);
    let drives = robot.actuators.iter().filter(|a| turns(&a.joint));
    let strongest_nm = drives.filter_map(|a| a.force_limit).fold(0.0, f64::max);
    let load_nm = weight_n(robot) * reach_m;
    let share = strongest_nm / load_nm;
    if strongest_nm > 0.0 && !(TORQUE_SHARE.0..TORQUE_SHARE.1).contains(&share) {
        let message = format!(
            "{:.3} kg that reach {reach_m:.3} m, and {strongest_nm} N·m at the strongest joint: is a mass in grams, a \
             length in mm, a torque in another unit? kg, m and N·m belong",
            weight_n(robot) / GRAVITY_MPS2
        );
        remarks.note(root, message);
    }
}

const RADIANS: &str = "A URDF has radians, an MJCF what its <compiler angle> says";

fn inertia(robot: &Robot, body: &Body, reach_m: f64, remarks: &mut Remarks) {
    let Some(inertial) = body.inertial.filter(|i| i.mass_kg > 0.0) else { return };
    let moments = principal(inertial.inertia_kgm2).0;
    let shown = moments.map(|m| format!("{m:.3e}")).join(", ");
    let largest = moments.into_iter().fold(0.0, |a: f64, m| a.max(m.abs()));
    let radius_m = (largest / inertial.mass_kg).sqrt();
    let mass_kg = inertial.mass_kg;
    let far = radius_m > GYRATION_SHARE * reach_m || radius_m < GYRATION_LEAST_M;
    let unit = format!(
        "{mass_kg} kg with moments of {shown} kg·m² lie {radius_m:.1e} m from their centre: is one in another unit (g, \
         g·mm²)? kg and kg·m² belong"
    );
    match check_inertia(inertial.inertia_kgm2) {
        Err(why) if far => remarks.refuse_of(&body.element, format!("{why}; {unit}")),
        Err(why) => {
            let host = |name: &String| robot.merged.get(name).unwrap_or(name) == &body.name;
            let own = robot.impossible.iter().filter(|(name, _)| host(name));
            let own: Vec<Remark> = own.map(|(_, remark)| remark.clone()).collect();
            if own.is_empty() {
                let message = format!(
                    "{why}; its principal moments are {shown} kg·m², with what is fixed to it"
                );
                remarks.refuse_of(&body.element, message);
            }
            remarks.refusals.extend(own);
        }
        Ok(()) if radius_m > GYRATION_MOST * reach_m => remarks.refuse_of(&body.element, unit),
        Ok(()) if far => remarks.note_of(&body.element, unit),
        Ok(()) => {}
    }
}
