//! MJCF: joints.

use super::context::{Context, softness};
use crate::parts::{Joint, Robot};
use crate::pose::{self, Pose};
use crate::tree::Element;
use crate::types::JointMotion;

/// Reads a joint of the body at `index`; `frame`: where it is written.
pub(super) fn read(
    context: &mut Context<'_>,
    e: &Element,
    index: usize,
    frame: &Pose,
    robot: &mut Robot,
) {
    if e.tag == "freejoint" || e.get("type") == Some("free") {
        free(context, e, index, robot);
        return;
    }
    let motion = match e.get("type").unwrap_or("hinge") {
        "hinge" => JointMotion::Hinge,
        "slide" => JointMotion::Slide,
        other => {
            let message = format!(
                "attribute `type`: a {other} joint is not simulated; write it as hinges, or weld it"
            );
            context.remarks.refuse_of(e, message);
            return;
        }
    };
    let unit = match motion {
        JointMotion::Hinge => context.compiler.rad_per_unit,
        JointMotion::Slide => 1.0,
    };
    let axis = e.array::<3>("axis", context.remarks).unwrap_or([0.0, 0.0, 1.0]);
    let length = pose::norm(axis);
    if length < 1e-9 {
        context.remarks.refuse_of(e, "attribute `axis`: has no direction");
    }
    let anchor = e.array::<3>("pos", context.remarks).unwrap_or([0.0; 3]);
    // positions are counted from where the file draws the joint
    let start = e.number("ref", context.remarks).unwrap_or(0.0) * unit;
    if start != 0.0 {
        context.remarks.note_of(e, "`ref` is taken off: its positions count from 0");
    }
    if index == 0 && robot.free_base {
        context.remarks.refuse_if_strict(e, "stands beside <freejoint>");
    }
    let number = |context: &mut Context<'_>, key: &str| e.number(key, context.remarks);
    if e.get("springdamper").is_some_and(|s| s.split_whitespace().any(|w| w != "0")) {
        context.remarks.refuse_of(e, "springdamper is not read; write stiffness and damping");
    }
    let spring_ref = number(context, "springref").map_or(0.0, |s| s * unit) - start;
    let force_limit = e.array::<2>("actuatorfrcrange", context.remarks);
    let range = range(context, e, unit).map(|(low, high)| (low - start, high - start));
    let stop = softness(e, "solreflimit", "solimplimit", context.remarks);
    let mut not_negative = |key: &str| e.not_negative(key, context.remarks).unwrap_or(0.0);
    let joint = Joint {
        name: name(e, robot),
        motion,
        axis: frame.rotate(axis.map(|a| a / length.max(1e-9))),
        anchor_m: frame.point(anchor),
        range,
        drawn_at: start,
        stop,
        stiffness: not_negative("stiffness"),
        spring_ref,
        damping: not_negative("damping"),
        armature: not_negative("armature"),
        friction_loss: not_negative("frictionloss"),
        force_limit: force_limit.map(|[low, high]| low.abs().max(high.abs())),
        element: e.clone(),
    };
    robot.bodies[index].joints.push(joint);
}

/// The joint of a free base.
fn free(context: &mut Context<'_>, e: &Element, index: usize, robot: &mut Robot) {
    if robot.bodies[index].parent.is_some() {
        let message = "a free joint belongs to the root body; move this body to the world";
        context.remarks.refuse_of(e, message);
    }
    if robot.free_base || !robot.bodies[index].joints.is_empty() {
        context.remarks.refuse_if_strict(e, "must be the only joint of its body");
    }
    let drags = ["damping", "armature", "frictionloss"];
    let dragged = |key: &&str| e.get(key).is_some_and(|v| v.trim() != "0");
    if e.tag == "joint" && drags.iter().any(dragged) {
        let message = "damping, armature and friction of a free joint are not kept; MuJoCo has them (write <freejoint/>)";
        context.remarks.note_of(e, message);
    }
    robot.free_base = true;
}

fn name(e: &Element, robot: &Robot) -> String {
    let given = e.get("name").map(str::to_owned);
    given.unwrap_or_else(|| format!("joint_{}", robot.joints().count()))
}

/// Limits, where there are any.
fn range(context: &mut Context<'_>, e: &Element, unit: f64) -> Option<(f64, f64)> {
    let range = e.array::<2>("range", context.remarks);
    let limited = match e.get("limited").unwrap_or("auto") {
        "true" => true,
        "false" => false,
        _ => context.compiler.autolimits && range.is_some(),
    };
    if limited && range.is_none() {
        let message = "attribute `range`: is missing on a limited joint";
        context.remarks.refuse_if_strict(e, message);
    }
    if range.is_some()
        && !context.compiler.autolimits
        && e.get("limited").is_none_or(|l| l == "auto")
    {
        let message = "attribute `limited`: must be given beside `range` when autolimits is off";
        context.remarks.refuse_if_strict(e, message);
    }
    let (low, high) = range.filter(|_| limited).map(|[a, b]| (a * unit, b * unit))?;
    if low < high {
        return Some((low, high));
    }
    let message = "attribute `range`: its lower end is not below its upper end";
    context.remarks.refuse_of(e, message);
    None
}
