//! The elements, attributes and words that a robot's own MJCF may have.

use std::collections::BTreeSet;

use crate::tree::{Element, Remarks};

/// Most bodies of one robot.
const BODY_LIMIT: usize = 512;

/// An element, its attributes, and what it may hold.
type Row = (&'static str, &'static [&'static str], &'static [&'static str]);

// Attributes after the blank line steer MuJoCo's own solver or viewer, or are the robot file's to say; they
// are accepted and have no effect here.
#[rustfmt::skip]
const ELEMENTS: &[Row] = &[
    ("mujoco", &["model"], &["compiler", "option", "default", "worldbody", "actuator", "contact"]),
    ("compiler", &["angle", "autolimits", "eulerseq", "coordinate", "inertiafromgeom", "balanceinertia"], &[]),
    ("option", &[
        "gravity",

        "timestep", "integrator", "cone", "impratio", "solver", "iterations", "ls_iterations", "tolerance",
    ], &[]),
    ("default", &["class"], &["default", "joint", "geom", "site", "position", "motor"]),
    ("worldbody", &[], &["geom", "body"]),
    ("body", &["name", "pos", "quat", "euler", "childclass"],
        &["inertial", "freejoint", "joint", "geom", "site", "body"]),
    ("inertial", &["pos", "quat", "euler", "mass", "diaginertia", "fullinertia"], &[]),
    ("freejoint", &["name"], &[]),
    ("joint", &[
        "name", "class", "type", "pos", "axis", "range", "limited", "stiffness", "springref", "damping", "armature",
        "frictionloss", "solreflimit", "solimplimit",

        "group",
    ], &[]),
    ("geom", &[
        "name", "class", "type", "size", "pos", "quat", "euler", "fromto", "friction", "contype", "conaffinity",
        "solref", "solimp",

        "priority", "condim", "group", "rgba",
    ], &[]),
    ("site", &[
        "name", "class", "pos", "quat", "euler",

        "type", "size", "group", "rgba",
    ], &[]),
    ("actuator", &[], &["position", "motor"]),
    ("position", ACTUATOR, &[]),
    ("motor", ACTUATOR, &[]),
    ("contact", &[], &["exclude"]),
    ("exclude", &["name", "body1", "body2"], &[]),
];
#[rustfmt::skip]
const ACTUATOR: &[&str] = &[
    "name", "class", "joint",

    "kp", "kv", "ctrlrange", "ctrllimited", "forcerange", "forcelimited", "group",
];

/// Attributes that have few words.
#[rustfmt::skip]
const WORDS: &[Row] = &[
    ("compiler", &["angle"], &["radian", "degree"]),
    ("compiler", &["autolimits"], &["true", "false"]),
    ("compiler", &["coordinate"], &["local"]),
    ("compiler", &["inertiafromgeom"], &["false", "auto"]),
    ("compiler", &["balanceinertia"], &["false"]),
    ("joint", &["type"], &["hinge", "slide"]),
    ("joint", &["limited"], &["true", "false", "auto"]),
    ("geom", &["type"], &["sphere", "capsule", "cylinder", "box", "ellipsoid", "plane"]),
];

/// Attributes that say the same in two ways.
const EITHER: &[(&str, &str)] = &[
    ("euler", "quat"),
    ("fullinertia", "diaginertia"),
    ("fullinertia", "quat"),
    ("fullinertia", "euler"),
];

/// Attributes that an element must have, outside of `<default>`.
const REQUIRED: &[(&str, &str)] = &[
    ("body", "name"),
    ("joint", "name"),
    ("site", "name"),
    ("position", "joint"),
    ("motor", "joint"),
];

/// Refuses what is outside the subset.
pub(super) fn check(root: &Element, remarks: &mut Remarks) {
    if root.tag != "mujoco" {
        remarks.refuse_of(root, "is not <mujoco>; this is not an MJCF file");
        return;
    }
    let mut trees = root.all("worldbody").flat_map(|world| world.all("body"));
    if let Some(second) = trees.nth(1) {
        let message = "is a second tree in <worldbody>; a robot is one tree";
        remarks.refuse_of(second, message);
    }
    let mut names = Names::default();
    names.element(root, remarks);
    if names.bodies > BODY_LIMIT {
        remarks.refuse_of(root, format!("has more than {BODY_LIMIT} bodies"));
    }
}

/// Attributes that are read in a file of another tool alone.
#[rustfmt::skip]
const MORE: &[(&str, &[&str])] = &[
    ("compiler", &["boundmass", "boundinertia", "settotalmass", "discardvisual", "meshdir", "assetdir"]),
    ("body", &["axisangle", "xyaxes", "zaxis", "gravcomp", "mocap"]),
    ("inertial", &["axisangle", "xyaxes", "zaxis"]),
    ("joint", &["actuatorfrcrange", "springdamper", "ref"]),
    ("geom", &["mass", "density", "mesh", "axisangle", "xyaxes", "zaxis"]),
    ("site", &["axisangle", "xyaxes", "zaxis"]),
    ("position", &["inheritrange", "dampratio", "timeconst"]),
    ("velocity", ACTUATOR),
    ("general", &["name", "joint", "class", "forcerange", "ctrlrange", "gainprm", "biasprm", "gaintype", "biastype"]),
    ("pair", &["name", "class", "geom1", "geom2", "friction", "condim", "solref", "solimp", "margin", "gap"]),
];

/// Attributes of any element that nothing here follows from, or that the reader speaks of itself.
#[rustfmt::skip]
const QUIET: &[&str] = &[
    "user", "group", "material", "rgba", "margin", "gap", "condim", "priority", "solmix", "hfield", "fromto", "align",
    "gear", "ctrllimited", "forcelimited", "actuatorfrclimited", "jointinparent", "tendon", "site", "refsite", "body",
    "cranksite", "slidersite", "cranklength", "lengthrange", "texturedir", "strippath", "usethread", "fusestatic",
    "solreffriction", "dyntype", "dynprm",
];

/// Looks over a file of another tool: refuses second things of one name and what is one letter off an attribute that
/// is read, since MuJoCo has neither, and notes attributes that are not read.
pub(super) fn look_over(root: &Element, remarks: &mut Remarks) {
    let read = ["compiler", "default", "worldbody", "actuator", "contact"];
    let mut taken = BTreeSet::new();
    for section in root.children.iter().filter(|section| read.contains(&section.tag.as_str())) {
        looked_over(section, &mut taken, remarks);
    }
}

fn looked_over<'a>(
    e: &'a Element,
    taken: &mut BTreeSet<(&'a str, &'a str)>,
    remarks: &mut Remarks,
) {
    let own = ELEMENTS.iter().find(|row| row.0 == e.tag).map(|row| row.1);
    let more = MORE.iter().find(|row| row.0 == e.tag).map(|row| row.1);
    if own.or(more).is_some() {
        e.misspelt(&[own.unwrap_or_default(), more.unwrap_or_default(), QUIET].concat(), remarks);
    }
    let unique = ["body", "joint", "site"].contains(&e.tag.as_str());
    if let Some(name) = e.get("name").filter(|_| unique)
        && !taken.insert((&e.tag, name))
    {
        remarks.refuse_of(e, "there is another of this name");
    }
    for child in &e.children {
        looked_over(child, taken, remarks);
    }
}

/// Names that were met, by the kind of what is called so.
#[derive(Default)]
struct Names<'a> {
    taken: BTreeSet<(&'a str, &'a str)>,
    bodies: usize,
}

impl<'a> Names<'a> {
    fn element(&mut self, e: &'a Element, remarks: &mut Remarks) {
        attributes(e, remarks);
        if e.has_text {
            remarks.refuse_of(e, "holds text; MJCF has only elements and attributes");
        }
        let row = ELEMENTS.iter().find(|row| row.0 == e.tag);
        let inside = row.map_or(&[][..], |row| row.2);
        for child in &e.children {
            let tag = child.tag.as_str();
            if !inside.contains(&tag) {
                let known = match inside {
                    [] => "it holds nothing".to_owned(),
                    _ => format!("supported: {}", inside.join(", ")),
                };
                let message = format!(
                    "is outside the supported subset: not supported inside <{}> ({known})",
                    e.tag
                );
                remarks.refuse_of(child, message);
            } else if e.tag == "default" && tag != "default" {
                attributes(child, remarks);
                if child.get("name").or(child.get("class")).is_some() {
                    remarks.refuse_of(child, "`name` and `class` do not belong in a default");
                }
            } else {
                self.named(child, remarks);
                self.element(child, remarks);
            }
        }
        if e.tag == "body" {
            self.body(e, remarks);
        }
    }

    /// Refuses a second thing of one kind and name, and what lacks a word that it must have.
    fn named(&mut self, e: &'a Element, remarks: &mut Remarks) {
        let kind = match e.tag.as_str() {
            "position" | "motor" => "actuator",
            "default" => return,
            tag => tag,
        };
        let must = REQUIRED.iter().filter(|(tag, _)| *tag == e.tag);
        for (_, key) in must.filter(|(_, key)| e.get(key).is_none_or(|t| t.trim().is_empty())) {
            remarks.refuse_of(e, format!("attribute `{key}`: is missing"));
        }
        let name = e.get("name").or(e.get("joint"));
        if let Some(name) = name.filter(|name| !self.taken.insert((kind, name))) {
            let message = format!("attribute `name`: there is already a {kind} called `{name}`");
            remarks.refuse_of(e, message);
        }
    }

    fn body(&mut self, e: &Element, remarks: &mut Remarks) {
        self.bodies += 1;
        match e.all("inertial").count() {
            0 => remarks.refuse_of(e, "has no <inertial>; every link needs one"),
            1 => {}
            _ => remarks.refuse_of(e, "has more than one <inertial>"),
        }
        for child in e.all("body").filter(|child| child.first("joint").is_none()) {
            let message = "has no joint, so it is welded to its parent; merge it into the parent";
            remarks.refuse_of(child, message);
        }
    }
}

/// Refuses attributes and words that are not of the subset.
fn attributes(e: &Element, remarks: &mut Remarks) {
    let Some((_, known, _)) = ELEMENTS.iter().find(|row| row.0 == e.tag) else { return };
    for (key, value) in &e.attributes {
        if !known.contains(&key.as_str()) {
            let known = match known {
                [] => "it has none".to_owned(),
                _ => format!("supported: {}", known.join(", ")),
            };
            let message = format!("attribute `{key}`: is outside the supported subset ({known})");
            remarks.refuse_of(e, message);
        }
        let few = WORDS.iter().find(|row| row.0 == e.tag && row.1 == [key]);
        if let Some((_, _, words)) = few.filter(|row| !row.2.contains(&value.as_str())) {
            let words = words.join(", ");
            let hint = match value.as_str() {
                "free" => "; a free joint is written <freejoint/>",
                _ => "",
            };
            let message = format!("attribute `{key}`: `{value}` is not supported ({words}{hint})");
            remarks.refuse_of(e, message);
        }
    }
    for (one, other) in EITHER {
        if e.get(one).is_some() && e.get(other).is_some() {
            let message = format!("attribute `{one}`: stands beside `{other}`; give one of them");
            remarks.refuse_of(e, message);
        }
    }
}
