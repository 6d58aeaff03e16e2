//! MJCF: `<contact>`: bodies that never touch, shapes that do whatever their bits are.

use std::collections::BTreeSet;

use super::context::{Context, moves, softness};
use crate::parts::Robot;
use crate::tree::{Element, meant};

/// Attributes of a `<pair>` that are kept, or say nothing.
const KEPT: &[&str] = &["name", "class", "geom1", "geom2", "friction", "solref", "solimp"];

/// What a name in a `<pair>` stands for.
enum Named {
    Robot,
    /// What is fixed to the world, or stands in another file.
    Ground,
    /// A shape that was left out, or of a body that was.
    Nothing,
}

/// Reads all of `<contact>`.
pub(super) fn read(context: &mut Context<'_>, root: &Element, robot: &mut Robot) {
    let (mut known, mut fixed) = (BTreeSet::new(), BTreeSet::new());
    names(root, &mut known);
    let scenery = root.all("worldbody").flat_map(|world| &world.children);
    scenery.filter(|e| e.tag != "body" || !moves(e)).for_each(|e| names(e, &mut fixed));
    for e in root.all("contact").flat_map(|contact| &contact.children) {
        match e.tag.as_str() {
            "exclude" => exclude(context, e, robot),
            "pair" => pair(context, e, (&fixed, &known), robot),
            _ => context.remarks.note_of(e, "is not known and not kept"),
        }
    }
}

/// Names of all shapes.
fn names<'a>(e: &'a Element, into: &mut BTreeSet<&'a str>) {
    into.extend(e.get("name").filter(|_| e.tag == "geom"));
    e.children.iter().for_each(|child| names(child, into));
}

fn exclude(context: &mut Context<'_>, e: &Element, robot: &mut Robot) {
    for key in ["body1", "body2"] {
        let name = e.get(key).unwrap_or_default();
        if !robot.bodies.iter().any(|b| b.name == name) {
            let message = format!("attribute `{key}`: there is no body `{name}`");
            context.remarks.refuse_if_strict(e, &message);
            if !context.remarks.strict && name != "world" {
                let message = format!("{message} in the robot; not kept");
                context.remarks.note_of(e, message);
            }
        }
    }
    let names = [e.get("body1"), e.get("body2")];
    if let [Some(one), Some(other)] = names {
        robot.excluded.push([one.to_owned(), other.to_owned()]);
    }
}

/// What a name in a `<pair>` stands for; `None`: it is refused.
fn named(
    context: &mut Context<'_>,
    e: &Element,
    key: &str,
    (fixed, known): (&BTreeSet<&str>, &BTreeSet<&str>),
    robot: &Robot,
) -> Option<Named> {
    let Some(name) = e.get(key) else {
        context.remarks.refuse_of(e, format!("attribute `{key}`: is missing"));
        return None;
    };
    let mut own = robot.bodies.iter().flat_map(|b| &b.geoms);
    if own.any(|g| g.geom.name.as_deref() == Some(name)) {
        return Some(Named::Robot);
    }
    if fixed.contains(name) {
        return Some(Named::Ground);
    }
    if known.contains(name) {
        return Some(Named::Nothing);
    }
    let message = format!("attribute `{key}`: there is no geom `{name}`");
    let known: Vec<&str> = known.iter().copied().collect();
    if let Some(meant) = meant(name, &known) {
        context.remarks.refuse_of(e, format!("{message}; did you mean `{meant}`?"));
        return None;
    }
    let message = format!("<pair>: {message} in this file; it is taken for the ground");
    context.remarks.note_once(e, message);
    Some(Named::Ground)
}

/// Keeps that a shape of the robot touches the ground, and how.
fn pair(
    context: &mut Context<'_>,
    e: &Element,
    file: (&BTreeSet<&str>, &BTreeSet<&str>),
    robot: &mut Robot,
) {
    let e = &context.resolved(e, None);
    let [one, other] = ["geom1", "geom2"].map(|key| named(context, e, key, file, robot));
    let (Some(one), Some(other)) = (one, other) else { return };
    let name = match (one, other) {
        (Named::Robot, Named::Ground) => e.get("geom1"),
        (Named::Ground, Named::Robot) => e.get("geom2"),
        (Named::Robot, Named::Robot) => {
            let message = "<pair>: two parts of the robot; whether parts touch each other is engine.self_collision's to \
                           say, for all of them";
            return context.remarks.note_once(e, message);
        }
        _ => {
            let message = "names no shape that is kept beside the ground; it is not kept";
            return context.remarks.note_of(e, message);
        }
    };
    let lost = |(key, value): &(&String, &String)| {
        !(KEPT.contains(&key.as_str()) || *key == "condim" && value.trim() == "3")
    };
    let lost: Vec<&str> = e.attributes.iter().filter(lost).map(|(key, _)| key.as_str()).collect();
    if !lost.is_empty() {
        let message = format!("<pair>: not kept: {}", lost.join(", "));
        context.remarks.note_once(e, message);
    }
    let friction = e.some_numbers("friction", 5, context.remarks).unwrap_or_default();
    let friction = friction.first().copied();
    if friction.is_some_and(|f| f < 0.0) {
        context.remarks.refuse_of(e, "attribute `friction`: must not be negative");
    }
    let soft = softness(e, "solref", "solimp", context.remarks);
    let ground_bit = ground_bit(robot);
    let geoms = robot.bodies.iter_mut().flat_map(|body| &mut body.geoms);
    for geom in geoms.map(|painted| &mut painted.geom).filter(|g| g.name.as_deref() == name) {
        // the ground's own bits are 1 and 1
        if (geom.contype | geom.conaffinity) & 1 == 0 {
            geom.conaffinity |= ground_bit;
            robot.ground_bit = ground_bit;
        }
        geom.friction = friction.unwrap_or(geom.friction);
        if e.get("solref").is_some() {
            geom.soft.solref = soft.solref;
        }
        if e.get("solimp").is_some() {
            geom.soft.solimp = soft.solimp;
        }
    }
}

/// A bit that no shape of the robot has, but for those that a pair gave it to: what it lets touch the ground touches
/// nothing else.
fn ground_bit(robot: &Robot) -> u32 {
    let geoms = robot.bodies.iter().flat_map(|body| &body.geoms).map(|painted| &painted.geom);
    let bits = geoms.fold(1, |bits, g| bits | g.contype | g.conaffinity & !robot.ground_bit);
    // MuJoCo's bits are those of a signed number
    if bits.trailing_ones() < 31 { 1 << bits.trailing_ones() } else { 1 }
}
