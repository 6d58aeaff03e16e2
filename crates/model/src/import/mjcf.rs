//! MJCF: settings, default classes, bodies, shapes, sites, named poses.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use super::geometry::{Inertial, Solid, diagonal};
use super::mesh::Meshes;
use super::parts::{Body, Geom, Robot};
use super::tree::{Element, Remarks};
use super::{actuators, mjcf_joint};
use crate::mjcf::{Compiler, z_to};
use crate::pose::{self, Pose};
use crate::types::{Shape, Softness};

/// MuJoCo's default density, kg/m³.
const DENSITY_KG_PER_M3: f64 = 1000.0;
/// Between these MuJoCo holds impedances.
const IMPEDANCE: (f64, f64) = (1e-4, 0.9999);

/// A tree with at most this part of the robot's drives is not another robot.
const LEFT_OVER: usize = 4;

/// Sections that say nothing of how the robot moves, or nothing that is kept.
const PASSED_OVER: &[(&str, &str)] = &[
    ("asset", "meshes, textures and materials are for the eye"),
    ("visual", "is for the eye"),
    ("statistic", "is for the eye"),
    ("size", "is MuJoCo's own"),
    ("custom", "is MuJoCo's own"),
    ("sensor", "sensors are the robot file's business"),
    ("tendon", "tendons are not simulated"),
    (
        "equality",
        "couplings and closed loops are not simulated; the joints move freely",
    ),
    ("extension", "plugins are not run"),
    ("deformable", "is not simulated"),
];

/// Everything needed to read an element.
pub(super) struct Context<'a> {
    pub compiler: Compiler,
    pub classes: BTreeMap<String, Class>,
    pub meshes: Meshes,
    pub remarks: &'a mut Remarks,
    from_geoms: FromGeoms,
    balance: bool,
    least_mass: f64,
    least_inertia: f64,
}

/// Attributes by element.
type Class = BTreeMap<String, BTreeMap<String, String>>;

#[derive(Clone, Copy, PartialEq)]
enum FromGeoms {
    Never,
    Missing,
    Always,
}

/// Reads `<mujoco>`.
pub(super) fn read(root: &Element, file: &Path, remarks: &mut Remarks) -> Option<Robot> {
    let mut context = Context::new(root, file, remarks);
    let mut robot = Robot {
        name: root.get("model").map(str::to_owned),
        gravity_mps2: [0.0, 0.0, -9.81],
        ..Robot::default()
    };
    for section in &root.children {
        match section.tag.as_str() {
            "compiler" | "default" | "worldbody" | "actuator" | "keyframe" => {}
            "option" => {
                let gravity = section.array("gravity", context.remarks);
                robot.gravity_mps2 = gravity.unwrap_or(robot.gravity_mps2);
                context
                    .remarks
                    .note(section, "<option>: only gravity is kept");
            }
            "contact" => {
                let names =
                    |e: &Element| Some([e.get("body1")?.to_owned(), e.get("body2")?.to_owned()]);
                robot
                    .excluded
                    .extend(section.all("exclude").filter_map(names));
                if section.first("pair").is_some() {
                    context.remarks.note(
                        section,
                        "<contact>: <pair> is not kept; shapes touch by contype and conaffinity",
                    );
                }
            }
            tag => match PASSED_OVER.iter().find(|(known, _)| *known == tag) {
                Some((_, why)) => context.remarks.note(section, format!("<{tag}>: {why}")),
                None => context
                    .remarks
                    .refuse(section, format!("<{tag}> is not known; take it out")),
            },
        }
    }
    let tree = context.tree(root)?;
    context.body(&tree, None, Pose::IDENTITY, None, &mut robot);
    actuators::read(&mut context, root, &mut robot);
    let order = joint_order(&robot);
    home(&mut context, root, &order, &mut robot);
    Some(robot)
}

/// Joint names in the order of MuJoCo's positions.
fn joint_order(robot: &Robot) -> Vec<String> {
    let joints = robot.bodies.iter().flat_map(|b| &b.joints);
    joints.map(|j| j.name.clone()).collect()
}

/// The pose of the key called home, else stand, else the first.
fn home(context: &mut Context<'_>, root: &Element, order: &[String], robot: &mut Robot) {
    let keys: Vec<&Element> = root.all("keyframe").flat_map(|k| k.all("key")).collect();
    let called = |word: &str| {
        let has = |k: &&&Element| k.get("name").is_some_and(|n| n.contains(word));
        keys.iter().find(has).copied()
    };
    let Some(key) = called("home")
        .or_else(|| called("stand"))
        .or(keys.first().copied())
    else {
        return;
    };
    let Some(numbers) = key.numbers("qpos", context.remarks) else {
        return;
    };
    let base = if robot.free_base { 7 } else { 0 };
    if numbers.len() != base + order.len() {
        let message = format!(
            "{}: has another number of positions; the nominal pose is 0",
            key.label()
        );
        context.remarks.note(key, message);
        return;
    }
    let joints = order.iter().cloned().zip(numbers[base..].iter().copied());
    robot.home = joints.collect();
    let name = key.get("name").unwrap_or("its first");
    context.remarks.note(
        key,
        format!("<keyframe>: the nominal pose is that of `{name}`"),
    );
}

impl<'a> Context<'a> {
    fn new(root: &Element, file: &Path, remarks: &'a mut Remarks) -> Self {
        let mut context = Self {
            compiler: Compiler::default(),
            classes: BTreeMap::from([("main".to_owned(), Class::new())]),
            meshes: Meshes::default(),
            remarks,
            from_geoms: FromGeoms::Missing,
            balance: false,
            least_mass: 0.0,
            least_inertia: 0.0,
        };
        for compiler in root.all("compiler") {
            context.compiler(compiler);
        }
        for default in root.all("default") {
            context.class(default, "main", true);
        }
        let scale = context.classes["main"]
            .get("mesh")
            .cloned()
            .unwrap_or_default();
        context.meshes = Meshes::read(root, file, &scale, context.remarks);
        context
    }

    fn compiler(&mut self, e: &Element) {
        for (key, value) in &e.attributes {
            match (key.as_str(), value.as_str()) {
                ("angle", "radian") => self.compiler.rad_per_unit = 1.0,
                ("angle", "degree") => self.compiler.rad_per_unit = 1f64.to_radians(),
                ("autolimits", on) => self.compiler.autolimits = on != "false",
                ("eulerseq", sequence) if self.compiler.set_euler(sequence) => {}
                ("eulerseq", sequence) => {
                    let what = "is not three of x y z X Y Z";
                    self.remarks
                        .refuse(e, format!("<compiler>: eulerseq `{sequence}` {what}"));
                }
                ("coordinate", "global") => {
                    self.remarks.refuse(e, "<compiler>: coordinate=\"global\" is not read; convert the file to local coordinates");
                }
                ("inertiafromgeom", "true") => self.from_geoms = FromGeoms::Always,
                ("inertiafromgeom", "false") => self.from_geoms = FromGeoms::Never,
                ("balanceinertia", "true") => self.balance = true,
                ("boundmass", _) => self.least_mass = e.number(key, self.remarks).unwrap_or(0.0),
                ("boundinertia", _) => {
                    self.least_inertia = e.number(key, self.remarks).unwrap_or(0.0)
                }
                ("settotalmass", total) if total.parse().is_ok_and(|x: f64| x > 0.0) => {
                    self.remarks.refuse(
                        e,
                        "<compiler>: settotalmass is not read; write the masses themselves",
                    );
                }
                ("discardvisual", "true") => {
                    self.remarks.refuse(e, "<compiler>: discardvisual=\"true\" is not read; take the visual shapes out");
                }
                _ => {}
            }
        }
    }

    /// Reads a class and those inside it.
    fn class(&mut self, e: &Element, parent: &str, outermost: bool) {
        let name = match (e.get("class"), outermost) {
            (Some(name), _) => name.to_owned(),
            (None, true) => "main".to_owned(),
            (None, false) => {
                self.remarks.refuse(e, "<default>: `class` is missing");
                return;
            }
        };
        let base = self.classes.get(&name).or_else(|| self.classes.get(parent));
        let mut class = base.cloned().unwrap_or_default();
        for child in e.children.iter().filter(|c| c.tag != "default") {
            let tag = actuators::default_tag(&child.tag).to_owned();
            let own = class.entry(tag).or_default();
            own.extend(child.attributes.clone());
        }
        self.classes.insert(name.clone(), class);
        for child in e.all("default") {
            self.class(child, &name, false);
        }
    }

    /// The element with what its class adds.
    pub fn resolved(&mut self, e: &Element, childclass: Option<&str>) -> Element {
        let name = e.get("class").or(childclass).unwrap_or("main");
        let Some(class) = self.classes.get(name) else {
            let label = e.label();
            self.remarks
                .refuse(e, format!("{label}: there is no default class `{name}`"));
            return e.clone();
        };
        let mut out = Element {
            children: Vec::new(),
            ..e.clone()
        };
        for (key, value) in class
            .get(actuators::default_tag(&e.tag))
            .into_iter()
            .flatten()
        {
            // one way of saying where something lies replaces the other
            let said = |other: &&str| e.attributes.contains_key(*other);
            let turns = ["quat", "euler", "axisangle", "xyaxes", "zaxis"];
            if turns.contains(&key.as_str()) && turns.iter().any(said) {
                continue;
            }
            out.attributes
                .entry(key.clone())
                .or_insert_with(|| value.clone());
        }
        out
    }

    /// The one tree of bodies that is the robot.
    fn tree(&mut self, root: &Element) -> Option<Element> {
        let worlds: Vec<&Element> = root.all("worldbody").collect();
        for other in worlds.iter().flat_map(|w| &w.children) {
            match other.tag.as_str() {
                "body" | "light" | "camera" | "frame" => {}
                "geom" => self.remarks.note_once(
                    other,
                    "what is fixed to the world is not kept; the ground is a plane",
                ),
                tag => self
                    .remarks
                    .note(other, format!("<{tag}> of the world is not kept")),
            }
        }
        for frame in worlds.iter().flat_map(|w| w.all("frame")) {
            self.remarks.refuse(
                frame,
                "<frame> around the robot is not read; put its pose into the body",
            );
        }
        let trees = worlds.iter().flat_map(|w| w.all("body"));
        let (moving, still): (Vec<&Element>, Vec<&Element>) = trees.partition(|b| moves(b));
        for body in still {
            self.remarks.note(
                body,
                format!("{}: does not move and is not kept", body.label()),
            );
        }
        let driven = actuators::joints(root);
        let drives = |b: &Element| driven_joints(b, &driven);
        let most = moving.iter().map(|b| drives(b)).max().unwrap_or(0);
        // what is driven by far less beside a robot is no second one, but something left over
        let counts = |b: &&&Element| drives(b) * LEFT_OVER > most || most == 0;
        let robots: Vec<&Element> = moving.iter().filter(counts).copied().collect();
        for body in moving
            .iter()
            .filter(|b| !robots.iter().any(|r| std::ptr::eq(*r, **b)))
        {
            self.remarks.note(
                body,
                format!("{}: stands beside the robot and is not kept", body.label()),
            );
        }
        match robots.as_slice() {
            [one] => Some((*one).clone()),
            [] => {
                self.remarks
                    .refuse(root, "has no body that moves in its <worldbody>");
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
            self.remarks.refuse(
                e,
                format!("{}: mocap bodies are not read; take it out", e.label()),
            );
        }
        if e.get("gravcomp").is_some_and(|g| g.trim() != "0") {
            self.remarks.note_once(
                e,
                "gravcomp is not simulated: the robot carries its own weight",
            );
        }
        let index = robot.bodies.len();
        let name = e
            .get("name")
            .map_or_else(|| format!("body_{index}"), str::to_owned);
        let childclass = e.get("childclass").or(childclass);
        let placed = frame.compose(&self.pose(e));
        robot.bodies.push(Body {
            name,
            parent,
            parent_from_body: placed,
            inertial: None,
            joints: Vec::new(),
            geoms: Vec::new(),
            sites: Vec::new(),
            element: Element {
                children: Vec::new(),
                ..e.clone()
            },
        });
        let mut solids = Vec::new();
        self.contents(e, index, Pose::IDENTITY, childclass, robot, &mut solids);
        let own = e.first("inertial").and_then(|i| self.inertial(i));
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
                    let inner = frame.compose(&self.pose(child));
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
                    let inner = frame.compose(&self.pose(child));
                    let class = child.get("childclass").or(childclass);
                    self.contents(child, index, inner, class, robot, solids);
                }
                "joint" | "freejoint" => {
                    let resolved = self.resolved(child, childclass);
                    mjcf_joint::read(self, &resolved, index, &frame, robot);
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
                        let at = frame.compose(&self.pose(&resolved));
                        robot.bodies[index].sites.push((name.to_owned(), at));
                    }
                }
                "camera" | "light" => self
                    .remarks
                    .note_once(child, "cameras and lights are not kept"),
                tag => self.remarks.refuse(
                    child,
                    format!("<{tag}> inside <body> is not read; take it out"),
                ),
            }
        }
    }

    /// Place and orientation of an element.
    pub fn pose(&mut self, e: &Element) -> Pose {
        let pos_m = e.array("pos", self.remarks).unwrap_or([0.0; 3]);
        let mut quat_wxyz = Pose::IDENTITY.quat_wxyz;
        if let Some(q) = e.array::<4>("quat", self.remarks) {
            quat_wxyz = pose::quat_normalised(q).unwrap_or(quat_wxyz);
        } else if let Some(angles) = e.array::<3>("euler", self.remarks) {
            quat_wxyz = self.compiler.euler_to_quat(angles);
        } else if let Some([x, y, z, angle]) = e.array::<4>("axisangle", self.remarks) {
            let length = pose::norm([x, y, z]).max(1e-12);
            let axis = [x, y, z].map(|c| c / length);
            quat_wxyz = pose::quat_from_axis_angle(axis, angle * self.compiler.rad_per_unit);
        } else if let Some([a, b, c, d, e2, f]) = e.array::<6>("xyaxes", self.remarks) {
            quat_wxyz = pose::quat_from_axes([a, b, c], [d, e2, f]).unwrap_or(quat_wxyz);
        } else if let Some(z) = e.array::<3>("zaxis", self.remarks) {
            let length = pose::norm(z).max(1e-12);
            quat_wxyz = z_to(z.map(|c| c / length));
        }
        Pose { pos_m, quat_wxyz }
    }

    fn inertial(&mut self, e: &Element) -> Option<Inertial> {
        let at = self.pose(e);
        let mass_kg = e.number("mass", self.remarks)?;
        let own = if let Some(d) = e.array::<3>("diaginertia", self.remarks) {
            diagonal(d)
        } else {
            let [xx, yy, zz, xy, xz, yz] = e.array::<6>("fullinertia", self.remarks)?;
            [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]
        };
        let own = Inertial {
            mass_kg,
            com_m: [0.0; 3],
            inertia_kgm2: own,
        };
        let own = if self.balance { own.balanced() } else { own };
        Some(own.seen_from(&at))
    }

    fn bounded(&self, mut inertial: Inertial) -> Inertial {
        inertial.mass_kg = inertial.mass_kg.max(self.least_mass);
        for i in 0..3 {
            let moment = &mut inertial.inertia_kgm2[i][i];
            *moment = moment.max(self.least_inertia);
        }
        inertial
    }

    /// A shape, where it is kept, and its mass.
    fn geom(&mut self, e: &Element, frame: &Pose) -> (Option<Geom>, Option<Inertial>) {
        let bits = |key: &str| {
            e.get(key)
                .and_then(|t| t.trim().parse().ok())
                .unwrap_or(1u32)
        };
        let (contype, conaffinity) = (bits("contype"), bits("conaffinity"));
        let kind = e.get("type").unwrap_or(if e.get("mesh").is_some() {
            "mesh"
        } else {
            "sphere"
        });
        let collides = contype != 0 || conaffinity != 0;
        let Some((shape, at, solid)) = self.shape(e, kind, collides) else {
            return (None, None);
        };
        let at = frame.compose(&at);
        let mass = e.number("mass", self.remarks);
        let density = e
            .number("density", self.remarks)
            .unwrap_or(DENSITY_KG_PER_M3);
        let inertial = solid.and_then(|solid: Solid| {
            let mass = mass.unwrap_or(density * solid.volume_m3);
            (mass > 0.0).then(|| solid.with_mass(mass, &at))
        });
        let soft = softness(e, "solref", "solimp", self.remarks);
        let friction = e
            .numbers("friction", self.remarks)
            .and_then(|f| f.first().copied());
        let Some(shape) = shape else {
            return (None, inertial);
        };
        let geom = Geom {
            name: e.get("name").map(str::to_owned),
            shape,
            link_from_geom: at,
            friction: friction.unwrap_or(1.0),
            contype,
            conaffinity,
            soft,
            rgba: e.get("rgba").map(str::to_owned),
        };
        (Some(geom), inertial)
    }

    /// The shape of a geom, its place, and its volume. A mesh that collides becomes the box that it fills.
    fn shape(
        &mut self,
        e: &Element,
        kind: &str,
        collides: bool,
    ) -> Option<(Option<Shape>, Pose, Option<Solid>)> {
        if matches!(kind, "mesh" | "sdf") {
            let mut at = self.pose(e);
            let name = e.get("mesh").unwrap_or_default();
            let Some(mesh) = self.meshes.find(name) else {
                let what = format!(
                    "{}: mesh `{name}` cannot be read; the shape is left out",
                    e.label()
                );
                if collides {
                    self.remarks.note(e, what);
                }
                return None;
            };
            let solid = mesh.solid;
            if !collides {
                return Some((None, at, Some(solid)));
            }
            self.remarks.note_once(
                e,
                "meshes that touch something become the boxes that they fill",
            );
            at = Pose {
                pos_m: at.point(mesh.middle_m),
                ..at
            };
            // the volume is about the mesh's own origin, the box about its middle
            let solid = Solid {
                centre_m: pose::sub(solid.centre_m, mesh.middle_m),
                ..solid
            };
            let half_size_m = mesh.half_size_m.map(|h| h.max(1e-4));
            return Some((Some(Shape::Box { half_size_m }), at, Some(solid)));
        }
        let size = e.numbers("size", self.remarks).unwrap_or_default();
        let (mut at, mut size) = (self.pose(e), size);
        if let Some(ends) = e.array::<6>("fromto", self.remarks) {
            let (a, b) = ([ends[0], ends[1], ends[2]], [ends[3], ends[4], ends[5]]);
            let along = pose::sub(a, b);
            let length = pose::norm(along);
            let radius = size.first().copied().unwrap_or(0.0);
            size = match kind {
                "box" | "ellipsoid" => vec![radius, radius, 0.5 * length],
                _ => vec![radius, 0.5 * length],
            };
            at = Pose {
                pos_m: pose::add(a, b).map(|x| 0.5 * x),
                quat_wxyz: z_to(along.map(|x| x / length.max(1e-12))),
            };
        }
        let Some(shape) = primitive(kind, &size) else {
            if matches!(kind, "plane" | "hfield") || collides {
                let label = e.label();
                self.remarks
                    .note(e, format!("{label}: a {kind} of this size is left out"));
            }
            return None;
        };
        let solid = Solid::of(&shape);
        Some((Some(shape), at, solid))
    }
}

/// A primitive with positive sizes.
fn primitive(kind: &str, size: &[f64]) -> Option<Shape> {
    let at = |i: usize| size.get(i).copied().filter(|x| *x > 0.0);
    Some(match kind {
        "sphere" => Shape::Sphere { radius_m: at(0)? },
        "capsule" => Shape::Capsule {
            radius_m: at(0)?,
            half_length_m: at(1)?,
        },
        "cylinder" => Shape::Cylinder {
            radius_m: at(0)?,
            half_length_m: at(1)?,
        },
        "box" => Shape::Box {
            half_size_m: [at(0)?, at(1)?, at(2)?],
        },
        "ellipsoid" => Shape::Ellipsoid {
            semi_axes_m: [at(0)?, at(1)?, at(2)?],
        },
        _ => return None,
    })
}

/// How a constraint gives way, held within MuJoCo's limits.
pub(super) fn softness(e: &Element, solref: &str, solimp: &str, remarks: &mut Remarks) -> Softness {
    let mut out = Softness::default();
    for (slot, x) in out
        .solref
        .iter_mut()
        .zip(e.numbers(solref, remarks).unwrap_or_default())
    {
        *slot = x;
    }
    for (slot, x) in out
        .solimp
        .iter_mut()
        .zip(e.numbers(solimp, remarks).unwrap_or_default())
    {
        *slot = x;
    }
    let [time, damping] = out.solref;
    if !(time > 0.0 && damping > 0.0 || time < 0.0 && damping <= 0.0) {
        out.solref = Softness::default().solref;
        remarks.note(
            e,
            format!(
                "{}: {solref} is not usable; MuJoCo's default is written",
                e.label()
            ),
        );
    }
    for i in [0, 1, 3] {
        out.solimp[i] = out.solimp[i].clamp(IMPEDANCE.0, IMPEDANCE.1);
    }
    out.solimp[2] = out.solimp[2].max(0.0);
    let power = out.solimp[4];
    if power != 1.0 && power != 2.0 {
        out.solimp[4] = if power < 1.5 { 1.0 } else { 2.0 };
        remarks.note_once(
            e,
            format!("{solimp}: the power {power} is rounded to 1 or 2"),
        );
    }
    out
}

/// Whether there is a joint in it.
fn moves(e: &Element) -> bool {
    let own = |c: &Element| matches!(c.tag.as_str(), "joint" | "freejoint");
    e.children.iter().any(|c| own(c) || moves(c))
}

/// How many joints in it are among `names`.
fn driven_joints(e: &Element, names: &BTreeSet<String>) -> usize {
    let own = e.tag == "joint" && e.get("name").is_some_and(|n| names.contains(n));
    let below = e.children.iter().map(|c| driven_joints(c, names));
    usize::from(own) + below.sum::<usize>()
}
