//! Sections, bodies, what stands in them, named poses.

use std::collections::BTreeSet;
use std::path::Path;

use super::context::{Context, FromGeoms, moves};
use super::{actuators, contact, joint, subset};
use crate::geometry::{Inertial, check_inertia, diagonal};
use crate::parts::{Body, Robot};
use crate::pose::Pose;
use crate::tree::{Element, Remarks};
use crate::types::{Geom, Shape};

/// A tree with at most this part of the robot's drives is not another robot.
const LEFT_OVER: usize = 4;
/// A medium as dense is water and no air.
const WATER_LEAST_KG_PER_M3: f64 = 100.0;

/// Sections that say nothing of how the robot moves, or nothing that is kept.
const PASSED_OVER: &[(&str, &str)] = &[
    ("asset", "meshes, textures and materials are for the eye"),
    ("visual", "is for the eye"),
    ("statistic", "is for the eye"),
    ("size", "is MuJoCo's own"),
    ("custom", "is MuJoCo's own"),
    ("sensor", "only where gyroscope and accelerometer sit is kept"),
    ("tendon", "tendons are not simulated"),
    (
        "equality",
        "couplings and closed loops are not simulated, the joints move freely: what only a loop holds up falls",
    ),
    ("extension", "plugins are not run"),
    ("deformable", "is not simulated"),
];

/// Reads `<mujoco>`.
pub(crate) fn read(root: &Element, file: &Path, remarks: &mut Remarks) -> Option<Robot> {
    if !remarks.strict {
        subset::look_over(root, remarks);
    }
    let mut context = Context::new(root, file, remarks);
    let mut robot = Robot {
        name: root.get("model").map(str::to_owned),
        gravity_mps2: [0.0, 0.0, -9.81],
        ..Robot::default()
    };
    for section in &root.children {
        match section.tag.as_str() {
            "compiler" | "default" | "worldbody" | "actuator" | "keyframe" | "contact" => {}
            "option" => {
                let gravity = section.array("gravity", context.remarks);
                robot.gravity_mps2 = gravity.unwrap_or(robot.gravity_mps2);
                if !context.remarks.strict {
                    context.remarks.note(section, "<option>: only gravity is kept");
                    let density = section.number("density", context.remarks);
                    if density.is_some_and(|d| d >= WATER_LEAST_KG_PER_M3) {
                        let message =
                            "its water goes into [water] of the robot file, and terrain.kind";
                        context.remarks.note_of(section, message);
                    }
                }
            }
            tag => match PASSED_OVER.iter().find(|(known, _)| *known == tag) {
                Some((_, why)) => context.remarks.note(section, format!("<{tag}>: {why}")),
                None => {
                    context.remarks.refuse(section, format!("<{tag}> is not known; take it out"))
                }
            },
        }
    }
    let tree = context.tree(root)?;
    if context.remarks.strict {
        robot.world_geoms = context.scenery(root);
    }
    context.body(&tree, None, Pose::IDENTITY, None, &mut robot);
    contact::read(&mut context, root, &mut robot);
    actuators::read(&mut context, root, &mut robot);
    let sensors = root.all("sensor").flat_map(|sensor| &sensor.children);
    robot.sensed = sensors
        .filter(|e| ["gyro", "accelerometer"].contains(&e.tag.as_str()))
        .filter_map(|e| e.get("site").map(str::to_owned))
        .collect();
    home(&mut context, root, &mut robot);
    Some(robot)
}

/// The pose of the key called home, else stand, else the first.
fn home(context: &mut Context<'_>, root: &Element, robot: &mut Robot) {
    let keys: Vec<&Element> = root.all("keyframe").flat_map(|k| k.all("key")).collect();
    let called = |word: &str| {
        let has = |k: &&&Element| k.get("name").is_some_and(|n| n.contains(word));
        keys.iter().find(has).copied()
    };
    let Some(key) = called("home").or_else(|| called("stand")).or(keys.first().copied()) else {
        return;
    };
    let Some(numbers) = key.numbers("qpos", context.remarks) else { return };
    let base = if robot.free_base { 7 } else { 0 };
    if numbers.len() != base + robot.joints().count() {
        let message = "has another number of positions and is not kept";
        context.remarks.note_of(key, message);
        return;
    }
    let joints = robot.joints().zip(&numbers[base..]);
    robot.home = joints.map(|(joint, q)| (joint.name.clone(), q - joint.drawn_at)).collect();
    let name = key.get("name").unwrap_or("its first");
    context.remarks.note(key, format!("<keyframe>: the nominal pose is that of `{name}`"));
}

impl Context<'_> {
    /// The one tree of bodies that is the robot.
    fn tree(&mut self, root: &Element) -> Option<Element> {
        let worlds: Vec<&Element> = root.all("worldbody").collect();
        for other in worlds.iter().flat_map(|w| &w.children) {
            match other.tag.as_str() {
                "body" | "light" | "camera" | "frame" => {}
                "geom" if self.remarks.strict => {}
                "geom" => self.remarks.note_once(
                    other,
                    "what is fixed to the world is not kept; the ground is a plane",
                ),
                tag => self.remarks.note(other, format!("<{tag}> of the world is not kept")),
            }
        }
        for frame in worlds.iter().flat_map(|w| w.all("frame")) {
            self.remarks
                .refuse(frame, "<frame> around the robot is not read; put its pose into the body");
        }
        let trees = worlds.iter().flat_map(|w| w.all("body"));
        let (moving, still): (Vec<&Element>, Vec<&Element>) = trees.partition(|b| moves(b));
        for body in still {
            self.remarks.note_of(body, "does not move and is not kept");
        }
        let driven = actuators::joints(root);
        let drives = |b: &Element| driven_joints(b, &driven);
        let most = moving.iter().map(|b| drives(b)).max().unwrap_or(0);
        // what is driven by far less beside a robot is no second one, but something left over
        let counts = |b: &&&Element| drives(b) * LEFT_OVER > most || most == 0;
        let robots: Vec<&Element> = moving.iter().filter(counts).copied().collect();
        for body in moving.iter().filter(|b| !robots.iter().any(|r| std::ptr::eq(*r, **b))) {
            self.remarks.note_of(body, "stands beside the robot and is not kept");
        }
        match robots.as_slice() {
            [one] => Some((*one).clone()),
            [] => {
                // what is in a frame is refused for that
                if worlds.iter().all(|world| world.first("frame").is_none()) {
                    self.remarks.refuse(root, "has no body that moves in its <worldbody>");
                }
                None
            }
            [_, second, ..] => {
                let count = robots.len();
                self.remarks.refuse(
                    second,
                    format!("is one of {count} robots in <worldbody>; a file is for one"),
                );
                None
            }
        }
    }

    /// The shapes that are fixed to the world.
    fn scenery(&mut self, root: &Element) -> Vec<Geom> {
        let mut shapes = Vec::new();
        for e in root.all("worldbody").flat_map(|w| w.all("geom")) {
            let mut e = self.resolved(e, None);
            let plane = e.get("type") == Some("plane");
            if plane {
                // all else of a plane is read as of a ball
                e.attributes.insert("type".to_owned(), "sphere".to_owned());
                e.attributes.insert("size".to_owned(), "1".to_owned());
            }
            shapes.extend(self.geom(&e, &Pose::IDENTITY).0.map(|found| match plane {
                true => Geom { shape: Shape::Plane, ..found.geom },
                false => found.geom,
            }));
        }
        shapes
    }

    /// Adds a body and what hangs on it.
    fn body(
        &mut self,
        e: &Element,
        parent: Option<usize>,
        frame: Pose,
        childclass: Option<&str>,
        robot: &mut Robot,
    ) {
        if e.get("mocap").is_some_and(|m| m == "true") {
            self.remarks.refuse_of(e, "mocap bodies are not read; take it out");
        }
        if e.get("gravcomp").is_some_and(|g| g.trim() != "0") {
            self.remarks
                .note_once(e, "gravcomp is not simulated: the robot carries its own weight");
        }
        let index = robot.bodies.len();
        let name = e.get("name").filter(|name| !name.trim().is_empty());
        let name = name.map_or_else(|| format!("body_{index}"), str::to_owned);
        if let Some(class) = e.get("childclass").filter(|c| !self.classes.contains_key(*c)) {
            let message = format!("attribute `childclass`: there is no default class `{class}`");
            self.remarks.refuse_of(e, message);
        }
        let childclass = e.get("childclass").or(childclass);
        let placed = self.place(e, &frame);
        robot.bodies.push(Body {
            name,
            parent,
            parent_from_body: placed,
            inertial: None,
            joints: Vec::new(),
            geoms: Vec::new(),
            sites: Vec::new(),
            element: Element { children: Vec::new(), ..e.clone() },
        });
        let mut solids = Vec::new();
        self.contents(e, index, Pose::IDENTITY, childclass, robot, &mut solids);
        let own = e.first("inertial").and_then(|i| self.inertial(i, index, robot));
        let from_geoms = || solids.into_iter().reduce(|a: Inertial, b| a.with(&b));
        let inertial = match self.from_geoms {
            FromGeoms::Never => own,
            FromGeoms::Always => from_geoms(),
            FromGeoms::Missing => own.or_else(from_geoms),
        };
        robot.bodies[index].inertial = inertial.map(|i| self.bounded(i));
        self.children(e, index, Pose::IDENTITY, childclass, robot);
    }

    /// The bodies that hang on a body, through frames.
    fn children(
        &mut self,
        e: &Element,
        index: usize,
        frame: Pose,
        childclass: Option<&str>,
        robot: &mut Robot,
    ) {
        for child in &e.children {
            match child.tag.as_str() {
                "body" => self.body(child, Some(index), frame, childclass, robot),
                "frame" => {
                    let inner = self.place(child, &frame);
                    let class = child.get("childclass").or(childclass);
                    self.children(child, index, inner, class, robot);
                }
                _ => {}
            }
        }
    }

    /// Joints, shapes and sites of a body, through frames.
    fn contents(
        &mut self,
        e: &Element,
        index: usize,
        frame: Pose,
        childclass: Option<&str>,
        robot: &mut Robot,
        solids: &mut Vec<Inertial>,
    ) {
        for child in &e.children {
            match child.tag.as_str() {
                "body" | "inertial" => {}
                "frame" => {
                    let inner = self.place(child, &frame);
                    let class = child.get("childclass").or(childclass);
                    self.contents(child, index, inner, class, robot, solids);
                }
                "joint" | "freejoint" => {
                    let resolved = self.resolved(child, childclass);
                    joint::read(self, &resolved, index, &frame, robot);
                }
                "geom" => {
                    let resolved = self.resolved(child, childclass);
                    let (geom, solid) = self.geom(&resolved, &frame);
                    robot.bodies[index].geoms.extend(geom);
                    solids.extend(solid);
                }
                "site" => {
                    let resolved = self.resolved(child, childclass);
                    if let Some(name) = child.get("name") {
                        let at = self.place(&resolved, &frame);
                        robot.bodies[index].sites.push((name.to_owned(), at));
                    }
                }
                "camera" | "light" => {
                    self.remarks.note_once(child, "cameras and lights are not kept")
                }
                "replicate" | "composite" | "flexcomp" | "attach" => {
                    let message = "is not read; let MuJoCo expand it (mujoco.mj_saveLastXML), then import that";
                    self.remarks.refuse_of(child, message);
                }
                tag => self
                    .remarks
                    .refuse(child, format!("<{tag}> inside <body> is not read; take it out")),
            }
        }
    }

    fn inertial(&mut self, e: &Element, index: usize, robot: &mut Robot) -> Option<Inertial> {
        let at = self.pose(e);
        let inertia = e.get("diaginertia").or(e.get("fullinertia"));
        let needed = [("pos", e.get("pos")), ("mass", e.get("mass")), ("diaginertia", inertia)];
        for (key, _) in needed.iter().filter(|(_, text)| text.is_none()) {
            let or = if *key == "diaginertia" { " (or `fullinertia`)" } else { "" };
            let message = format!("attribute `{key}`: is missing{or}");
            self.remarks.refuse_if_strict(e, message);
        }
        let mut mass_kg = e.number("mass", self.remarks)?;
        if mass_kg < 0.0 || mass_kg == 0.0 && self.remarks.strict {
            mass_kg = e.no_mass("mass", self.remarks);
        }
        let (key, own) = if let Some(d) = e.array::<3>("diaginertia", self.remarks) {
            ("diaginertia", diagonal(d))
        } else {
            let [xx, yy, zz, xy, xz, yz] = e.array::<6>("fullinertia", self.remarks)?;
            ("fullinertia", [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        };
        if let Err(why) = check_inertia(own) {
            self.remarks.refuse_if_strict(e, format!("attribute `{key}`: {why}"));
        }
        let own = Inertial { mass_kg, com_m: [0.0; 3], inertia_kgm2: own };
        let own = if self.balance { own.balanced() } else { own };
        let body = robot.bodies[index].element.clone();
        robot.weigh((&robot.bodies[index].name.clone(), &body), own.inertia_kgm2, |near| {
            let count = if key == "diaginertia" { 3 } else { 6 };
            format!("{key}=\"{}\"", near[..count].join(" "))
        });
        Some(own.seen_from(&at))
    }
}

/// How many joints in it are among `names`.
fn driven_joints(e: &Element, names: &BTreeSet<String>) -> usize {
    let own = e.tag == "joint" && e.get("name").is_some_and(|n| names.contains(n));
    let below = e.children.iter().map(|c| driven_joints(c, names));
    usize::from(own) + below.sum::<usize>()
}
