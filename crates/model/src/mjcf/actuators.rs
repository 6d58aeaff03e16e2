//! MJCF: actuators.

use std::collections::BTreeSet;

use super::context::Context;
use crate::parts::{Actuator, Robot, UNSAID_DAMPING_S};
use crate::tree::Element;

fn elements(root: &Element) -> impl Iterator<Item = &Element> {
    root.all("actuator").flat_map(|a| &a.children)
}

/// Joints that some actuator names.
pub(super) fn joints(root: &Element) -> BTreeSet<String> {
    elements(root).filter_map(driven).map(str::to_owned).collect()
}

/// The joint that an actuator names.
fn driven(e: &Element) -> Option<&str> {
    e.get("joint").or(e.get("jointinparent"))
}

/// Whether it damps a joint that another actuator drives: it is read after that.
fn damps(root: &Element, e: &Element) -> bool {
    let drives = |other: &Element| other.tag != "velocity" && driven(other) == driven(e);
    e.tag == "velocity" && elements(root).any(drives)
}

/// Whether a joint of this name stands anywhere in the file.
fn named(e: &Element, joint: &str) -> bool {
    let own = e.tag == "joint" && e.get("name") == Some(joint);
    let inside = |c: &Element| c.tag != "equality" && named(c, joint);
    own || e.children.iter().any(inside)
}

/// Reads the actuators of joints that the robot has.
pub(super) fn read(context: &mut Context<'_>, root: &Element, robot: &mut Robot) {
    let (last, first): (Vec<_>, Vec<_>) = elements(root).partition(|e| damps(root, e));
    for element in first.into_iter().chain(last) {
        let e = context.resolved(element, None);
        let Some(joint) = driven(&e).map(str::to_owned) else {
            context.remarks.note_of(&e, "drives no joint and is not kept");
            continue;
        };
        let own = robot.joints().find(|j| j.name == joint);
        let Some(own_limit) = own.map(|j| j.force_limit) else {
            let message = format!("attribute `joint`: there is no joint `{joint}`");
            if named(root, &joint) {
                let message = format!("{message} in the robot; the actuator is not kept");
                context.remarks.note_of(&e, message);
            } else {
                context.remarks.refuse_of(&e, message);
            }
            continue;
        };
        let gear = e.numbers("gear", context.remarks).and_then(|g| g.first().copied());
        let gear = gear.unwrap_or(1.0).abs();
        // a robot's own file is held against the order of the robot file, which says more
        let first = robot.actuators.iter_mut().find(|a| a.joint == joint);
        if let Some(first) = first.filter(|_| !context.remarks.strict) {
            if let (Some((_, kd)), "velocity") = (&mut first.gains, e.tag.as_str()) {
                *kd += e.not_negative("kv", context.remarks).unwrap_or(1.0) * gear * gear;
                let message =
                    "a velocity actuator beside one of position: its kv is added to the kd";
                context.remarks.note_once(&e, message);
            } else {
                let message = format!("`{joint}` has an actuator already; this one is not kept");
                context.remarks.note_of(&e, message);
            }
            continue;
        }
        // a range that is switched off limits nothing
        let limit = |context: &mut Context<'_>, key: &str, limited: &str| {
            let range = e.array::<2>(key, context.remarks)?;
            let most = range[0].abs().max(range[1].abs()) * gear;
            Some(most).filter(|x| *x > 0.0 && e.get(limited) != Some("false"))
        };
        let gains = gains(context, &e).map(|(kp, kd, ratio)| {
            let kp = kp * gear * gear;
            let critical = 2.0 * (kp.max(0.0) * robot.hanging_inertia(&joint)).sqrt();
            (kp, kd * gear * gear + ratio * critical)
        });
        if e.get("dyntype").is_some_and(|kind| kind != "none") {
            context.remarks.note_once(&e, "dyntype: the lag of the actuator is not kept");
        }
        for key in ["kp", "kv"] {
            e.not_negative(key, context.remarks);
        }
        let force = limit(context, "forcerange", "forcelimited");
        let control = limit(context, "ctrlrange", "ctrllimited");
        // what a torque can be asked to be, before the range of forces cuts it
        let plain = |key: &str, word: &str| e.get(key).is_none_or(|kind| kind == word);
        let gain = match e.tag.as_str() {
            "motor" => Some(1.0),
            "general"
                if plain("biastype", "none")
                    && plain("dyntype", "none")
                    && plain("gaintype", "fixed") =>
            {
                let gain = e.numbers("gainprm", context.remarks);
                Some(gain.and_then(|g| g.first().copied()).unwrap_or(1.0).abs())
            }
            _ => None,
        };
        let asked = control.zip(gain.filter(|_| gains.is_none())).map(|(most, gain)| most * gain);
        let asked = asked.filter(|x| *x > 0.0);
        let force_limit = [own_limit.or(force), asked].into_iter().flatten().reduce(f64::min);
        robot.actuators.push(Actuator { joint, gains, force_limit, speed_limit: None, element: e });
    }
}

/// Gains of a position loop, and how much of the critical damping comes on top.
fn gains(context: &mut Context<'_>, e: &Element) -> Option<(f64, f64, f64)> {
    let first = |numbers: Option<Vec<f64>>, at: usize| numbers.and_then(|n| n.get(at).copied());
    let gain = e.numbers("gainprm", context.remarks);
    let bias = e.numbers("biasprm", context.remarks);
    let kind = e.tag.as_str();
    match kind {
        // a class of the one kind is a default of the other
        "position" | "general" if kind == "position" || gain.is_none() && e.get("kp").is_some() => {
            let kp = e.number("kp", context.remarks).or(first(gain, 0)).unwrap_or(1.0);
            let kv = e.number("kv", context.remarks).or(first(bias, 2).map(|b| (-b).max(0.0)));
            let kv = kv.unwrap_or(0.0);
            let ratio = e.not_negative("dampratio", context.remarks).unwrap_or(0.0);
            if e.number("timeconst", context.remarks).is_some_and(|t| t > 0.0) {
                context.remarks.note_once(e, "timeconst: the filter of the command is not kept");
            }
            if ratio > 0.0 {
                let message = "dampratio: gains follow from what hangs on each joint, the trunk held; MuJoCo, whose trunk \
                               gives way, makes up to a third less of it (actuator_biasprm)";
                context.remarks.note_once(e, message);
            }
            Some((kp, kv, ratio))
        }
        "general" if e.get("biastype") == Some("affine") => {
            let kp = first(gain, 0).unwrap_or(1.0);
            let (back, kv) = (first(bias.clone(), 1).unwrap_or(0.0), first(bias, 2).unwrap_or(0.0));
            let servo = (kp + back).abs() <= 1e-9 * kp.abs() && kp > 0.0;
            if !servo {
                let message = "a general actuator that holds no position is read as one of torque";
                context.remarks.note_once(e, message);
            }
            // as dampratio is compiled
            servo.then_some((kp, (-kv).max(0.0), kv.max(0.0)))
        }
        "velocity" => {
            let kv = e.number("kv", context.remarks).filter(|kv| *kv > 0.0).unwrap_or(1.0);
            let message = format!(
                "a velocity actuator is read as one of position, with its kv as damping and a stiffness of ours: a joint \
                 follows its target {:.0} ms late",
                1e3 * UNSAID_DAMPING_S
            );
            context.remarks.note_once(e, message);
            Some((kv / UNSAID_DAMPING_S, kv, 0.0))
        }
        "motor" | "general" => None,
        other => {
            context.remarks.note_once(e, format!("a {other} actuator is read as one of torque"));
            None
        }
    }
}
