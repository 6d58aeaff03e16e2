//! URDF: links, joints, shapes.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use super::options::ImportOptions;
use crate::geometry::Inertial;
use crate::mesh::Meshes;
use crate::parts::{Actuator, Body, Joint, Painted, Robot};
use crate::pose::{self, Pose};
use crate::tree::{Element, Remarks, meant};
use crate::types::{Geom, JointMotion, Shape, Softness};

/// Deepest chain of links.
const CHAIN_LIMIT: usize = 128;

struct Reader<'a> {
    root: &'a Element,
    file: &'a Path,
    links: BTreeMap<&'a str, &'a Element>,
    meshes: Meshes,
    /// Meshes of shapes that touch which cannot be read, and their links.
    lost: Vec<(String, Element)>,
    remarks: &'a mut Remarks,
    robot: Robot,
}

/// Elements, their attributes, and what they hold.
#[rustfmt::skip]
const PARTS: &[(&str, &[&str], &[&str])] = &[
    ("link", &["name"], &["inertial", "visual", "collision"]),
    ("joint", &["name", "type"],
        &["origin", "parent", "child", "axis", "limit", "dynamics", "mimic", "calibration", "safety_controller"]),
    ("inertial", &[], &["origin", "mass", "inertia"]),
    ("visual", &["name"], &["origin", "geometry", "material"]),
    ("collision", &["name"], &["origin", "geometry", "material"]),
    ("geometry", &[], &["box", "sphere", "cylinder", "capsule", "mesh"]),
    ("parent", &["link"], &[]),
    ("child", &["link"], &[]),
    ("origin", &["xyz", "rpy"], &[]),
    ("axis", &["xyz"], &[]),
    ("limit", &["lower", "upper", "effort", "velocity"], &[]),
    ("dynamics", &["damping", "friction"], &[]),
    ("mass", &["value"], &[]),
    ("inertia", &["ixx", "iyy", "izz", "ixy", "ixz", "iyz"], &[]),
    ("box", &["size"], &[]),
    ("sphere", &["radius"], &[]),
    ("cylinder", &["radius", "length"], &[]),
    ("capsule", &["radius", "length"], &[]),
    ("mesh", &["filename", "scale"], &[]),
];

/// Refuses what is one letter off an element or an attribute that is read.
fn slips(e: &Element, remarks: &mut Remarks) {
    let Some((_, attributes, inside)) = PARTS.iter().find(|row| row.0 == e.tag) else { return };
    e.misspelt(attributes, remarks);
    for child in &e.children {
        match meant(&child.tag, inside) {
            _ if inside.contains(&child.tag.as_str()) => slips(child, remarks),
            Some(meant) => {
                remarks.refuse_of(child, format!("is not known; did you mean <{meant}>?"));
            }
            None => {
                remarks.note_once(child, format!("<{}> in a <{}> is not kept", child.tag, e.tag))
            }
        }
    }
}

/// Reads `<robot>`.
pub(super) fn read(
    root: &Element,
    file: &Path,
    options: &ImportOptions,
    remarks: &mut Remarks,
) -> Option<Robot> {
    for other in &root.children {
        match other.tag.as_str() {
            "link" | "joint" => slips(other, remarks),
            "mujoco" | "material" => {}
            tag => remarks.note_once(other, format!("<{tag}> is not kept")),
        }
    }
    let named = root.all("link").filter_map(|l| Some((l.get("name")?, l)));
    let mut reader = Reader {
        root,
        file,
        links: named.collect(),
        meshes: Meshes::default(),
        lost: Vec::new(),
        remarks,
        robot: Robot {
            name: root.get("name").map(str::to_owned),
            gravity_mps2: [0.0, 0.0, -9.81],
            ..Robot::default()
        },
    };
    let Some(base) = reader.base() else {
        // what else is wrong is said all the same
        root.all("link").for_each(|link| _ = reader.inertial(link));
        for element in root.all("joint") {
            reader.joint(element);
        }
        return None;
    };
    reader.link(base, None, Pose::IDENTITY, None, 0);
    if let Some((mesh, first)) = reader.lost.first() {
        let mut links: Vec<&str> =
            reader.lost.iter().filter_map(|(_, link)| link.get("name")).collect();
        links.dedup();
        let message = format!(
            "mesh `{mesh}` cannot be read; looked for beside this file and in the folders above it. Nothing touches in its \
             place; the same goes for all of {}",
            links.join(", ")
        );
        reader.remarks.note(first, message);
    }
    let robot = &mut reader.robot;
    let on_world = matches!(base, "world" | "map");
    robot.free_base = options.free_base.unwrap_or(!on_world && chains(robot) > 1);
    let held = if robot.free_base { "free" } else { "fixed" };
    if options.free_base.is_none() {
        let message = format!(
            "a URDF does not say whether the base is held; taken as {held} (--base free or fixed)"
        );
        reader.remarks.note(root, message);
    }
    Some(reader.robot)
}

/// How many joints hang on the root link and on what is fixed to it.
fn chains(robot: &Robot) -> usize {
    let mut fixed: Vec<bool> = Vec::new();
    let mut count = 0;
    for body in &robot.bodies {
        let on_trunk = body.parent.is_none_or(|p| fixed[p]);
        fixed.push(on_trunk && body.joints.is_empty());
        count += usize::from(on_trunk && !body.joints.is_empty());
    }
    count
}

/// Link names that stand for the world.
const WORLD: &[&str] = &["world", "map", "base_footprint"];

impl<'a> Reader<'a> {
    /// The link that no joint carries, if all joints lie between links.
    fn base(&mut self) -> Option<&'a str> {
        let before = self.remarks.refusals.len();
        let mut carried: Vec<&str> = Vec::new();
        for joint in self.root.all("joint") {
            for tag in ["parent", "child"] {
                match joint.first(tag).and_then(|e| e.get("link")) {
                    Some(link) if self.links.contains_key(link) => {
                        if tag == "child" && carried.contains(&link) {
                            let message = format!("`{link}` hangs on another joint already");
                            self.remarks.refuse_of(joint, message);
                        } else if tag == "child" {
                            carried.push(link);
                        }
                    }
                    Some(link) => {
                        self.remarks.refuse_of(joint, format!("there is no link `{link}`"))
                    }
                    None => self.remarks.refuse_of(joint, format!("<{tag}> names no link")),
                }
            }
        }
        for tag in ["link", "joint"] {
            let mut names = BTreeSet::new();
            for element in self.root.all(tag).filter(|e| !names.insert(e.get("name"))) {
                let message = "there is another of this name";
                self.remarks.refuse_of(element, message);
            }
        }
        let roots: Vec<&str> =
            self.links.keys().filter(|l| !carried.contains(l)).copied().collect();
        if let [one] = roots.as_slice() {
            self.loops(one);
        }
        match roots.as_slice() {
            [one] if self.remarks.refusals.len() == before => return Some(one),
            [] => self
                .remarks
                .refuse(self.root, "every link hangs on a joint: there is a loop, or no link"),
            [_] => {}
            [_, _, ..] => {
                let message = format!(
                    "has {} links that no joint carries: {}; one belongs",
                    roots.len(),
                    roots.join(", ")
                );
                self.remarks.refuse(self.root, message);
            }
        }
        None
    }

    /// Refuses links that carry each other and hang on nothing.
    fn loops(&mut self, base: &str) {
        let joints = self.root.all("joint");
        let ends = joints.filter_map(|j| {
            let link = |tag| j.first(tag).and_then(|e| e.get("link"));
            Some((link("parent")?, link("child")?))
        });
        let ends: Vec<(&str, &str)> = ends.collect();
        let mut reached = BTreeSet::from([base]);
        loop {
            let next = ends.iter().filter(|(parent, _)| reached.contains(parent));
            let next: Vec<&str> = next.map(|e| e.1).filter(|c| !reached.contains(c)).collect();
            if next.is_empty() {
                break;
            }
            reached.extend(next);
        }
        let lost = self.links.keys().filter(|link| !reached.contains(*link));
        let lost: Vec<&str> = lost.copied().collect();
        // a joint between links that are not there is refused for itself
        if !lost.is_empty()
            && lost.iter().all(|l| ends.iter().any(|e| e.1 == *l && lost.contains(&e.0)))
        {
            let message =
                format!("{} carry each other in a loop and hang on nothing", lost.join(", "));
            self.remarks.refuse(self.root, message);
        }
    }

    /// Says what becomes of a link that has no mass of its own.
    fn weightless(&mut self, element: &'a Element, name: &str) {
        let shapes = element.first("collision").or(element.first("visual"));
        let what = match shapes {
            Some(_) => "no <inertial>; it weighs nothing but what is fixed to it",
            None if WORLD.contains(&name) => "holds nothing; it becomes part of the first link",
            None => return,
        };
        self.remarks.note_of(element, what);
    }

    fn link(
        &mut self,
        name: &'a str,
        parent: Option<usize>,
        at: Pose,
        joint: Option<Joint>,
        depth: usize,
    ) {
        let Some(element) = self.links.get(name).copied() else { return };
        if depth > CHAIN_LIMIT {
            self.remarks
                .refuse_of(element, format!("a chain of more than {CHAIN_LIMIT} links, or a loop"));
            return;
        }
        let index = self.robot.bodies.len();
        let inertial = self.inertial(element);
        let shapes: Vec<&Element> = element.children.iter().collect();
        let mut geoms = Vec::new();
        for shape in shapes {
            if matches!(shape.tag.as_str(), "visual" | "collision") {
                geoms.extend(self.shape(shape, element));
            }
        }
        self.robot.bodies.push(Body {
            name: name.to_owned(),
            parent,
            parent_from_body: at,
            inertial,
            joints: joint.into_iter().collect(),
            geoms,
            sites: if name.to_lowercase().contains("imu") {
                vec![(name.to_owned(), Pose::IDENTITY)]
            } else {
                Vec::new()
            },
            element: Element { children: Vec::new(), ..element.clone() },
        });
        if inertial.is_none() {
            self.weightless(element, name);
        }
        let own = |j: &&Element| j.first("parent").and_then(|p| p.get("link")) == Some(name);
        let children: Vec<&'a Element> = self.root.all("joint").filter(own).collect();
        for element in children {
            let Some(child) = element.first("child").and_then(|c| c.get("link")) else { continue };
            let at = self.origin(element);
            let joint = self.joint(element);
            self.link(child, Some(index), at, joint, depth + 1);
        }
    }

    fn joint(&mut self, e: &Element) -> Option<Joint> {
        let (motion, limited) = match e.get("type").unwrap_or_default() {
            "revolute" => (JointMotion::Hinge, true),
            "continuous" => (JointMotion::Hinge, false),
            "prismatic" => (JointMotion::Slide, true),
            "fixed" => return None,
            "" => {
                self.remarks.refuse_of(e, "attribute `type`: is missing");
                return None;
            }
            "floating" => {
                let message = "a floating joint is the base's own; name its child as the root link";
                self.remarks.refuse_of(e, message);
                return None;
            }
            other => {
                self.remarks.refuse_of(
                    e,
                    format!(
                        "a {other} joint is not simulated; write it as revolute and prismatic ones"
                    ),
                );
                return None;
            }
        };
        let axis = e
            .first("axis")
            .and_then(|a| a.array::<3>("xyz", self.remarks))
            .unwrap_or([1.0, 0.0, 0.0]);
        let length = pose::norm(axis);
        if length < 1e-9 {
            self.remarks.refuse_of(e, "its axis has no direction");
        }
        if e.first("mimic").is_some() {
            self.remarks.note_of(e, "<mimic> is not simulated; the joint has a drive of its own");
        }
        let range = e.first("limit").filter(|_| limited).and_then(|limit| self.range(limit));
        let mut of = |tag: &str, key: &str| {
            let element = e.first(tag)?;
            // what some exporters write for no limit
            let none = element.get(key).and_then(|t| t.trim().parse().ok()) == Some(-1.0);
            if tag == "limit" && none { None } else { element.not_negative(key, self.remarks) }
        };
        let effort = of("limit", "effort").filter(|t| *t > 0.0);
        let speed = of("limit", "velocity").filter(|v| *v > 0.0);
        let damping = of("dynamics", "damping").unwrap_or(0.0);
        let friction_loss = of("dynamics", "friction").unwrap_or(0.0);
        let name = e.get("name").unwrap_or("joint").to_owned();
        self.robot.actuators.push(Actuator {
            joint: name.clone(),
            gains: None,
            force_limit: effort,
            speed_limit: speed,
            element: e.clone(),
        });
        Some(Joint {
            name,
            motion,
            axis: axis.map(|a| a / length.max(1e-9)),
            anchor_m: [0.0; 3],
            range,
            drawn_at: 0.0,
            stop: Softness::default(),
            stiffness: 0.0,
            spring_ref: 0.0,
            damping,
            armature: 0.0,
            friction_loss,
            force_limit: effort,
            element: e.clone(),
        })
    }

    /// As MuJoCo and Bullet have it: two ends that are the same, or none, are no limit.
    fn range(&mut self, limit: &Element) -> Option<(f64, f64)> {
        let mut end = |key: &str| limit.number(key, self.remarks).unwrap_or(0.0);
        let (low, high) = (end("lower"), end("upper"));
        let written = ["lower", "upper"].iter().all(|key| limit.get(key).is_some());
        if high == -1.0 && (low == 0.0 || low == 1.0) {
            let message = "`lower` above `upper` of -1 is Bullet's way to write no limit";
            self.remarks.note_once(limit, message);
        } else if low > high && written {
            let message = format!(
                "attribute `lower`: is {low}, above `upper`, {high}; a joint without limits is continuous"
            );
            self.remarks.refuse_of(limit, message);
        }
        (low < high).then_some((low, high))
    }

    /// `<origin xyz rpy>`: turned about fixed axes, x first.
    fn origin(&mut self, e: &Element) -> Pose {
        let Some(origin) = e.first("origin") else { return Pose::IDENTITY };
        let pos_m = origin.array("xyz", self.remarks).unwrap_or([0.0; 3]);
        let rpy = origin.array::<3>("rpy", self.remarks).unwrap_or([0.0; 3]);
        let mut quat_wxyz = Pose::IDENTITY.quat_wxyz;
        for (axis, angle) in rpy.into_iter().enumerate() {
            let mut unit = [0.0; 3];
            unit[axis] = 1.0;
            quat_wxyz = pose::quat_mul(pose::quat_from_axis_angle(unit, angle), quat_wxyz);
        }
        Pose { pos_m, quat_wxyz }
    }

    fn inertial(&mut self, link: &Element) -> Option<Inertial> {
        let e = link.first("inertial")?;
        let at = self.origin(e);
        let mass = e.first("mass")?;
        let mut mass_kg = mass.number("value", self.remarks)?;
        if mass_kg < 0.0 {
            mass_kg = mass.no_mass("value", self.remarks);
        }
        let tensor = e.first("inertia");
        let mut of = |key: &str| tensor.and_then(|i| i.number(key, self.remarks)).unwrap_or(0.0);
        let (xx, yy, zz) = (of("ixx"), of("iyy"), of("izz"));
        let (xy, xz, yz) = (of("ixy"), of("ixz"), of("iyz"));
        let own = Inertial {
            mass_kg,
            com_m: [0.0; 3],
            inertia_kgm2: [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]],
        };
        let place = (link.get("name").unwrap_or_default(), link);
        self.robot.weigh(place, own.inertia_kgm2, |near| {
            let keys = ["ixx", "iyy", "izz", "ixy", "ixz", "iyz"].into_iter().zip(near);
            keys.map(|(key, x)| format!("{key}=\"{x}\"")).collect::<Vec<_>>().join(" ")
        });
        Some(own.seen_from(&at))
    }

    fn shape(&mut self, e: &Element, link: &Element) -> Option<Painted> {
        let collides = e.tag == "collision";
        let mut at = self.origin(e);
        let geometry = e.first("geometry")?.children.first()?.clone();
        let number = |key: &str, remarks: &mut Remarks| {
            let found = geometry.not_negative(key, remarks);
            if collides && (found == Some(0.0) || geometry.get(key).is_none()) {
                let message = format!("has no {key} above 0; the shape is left out");
                remarks.note_of(&geometry, message);
            }
            found.filter(|x| *x > 0.0)
        };
        let shape = match geometry.tag.as_str() {
            "sphere" => Shape::Sphere { radius_m: number("radius", self.remarks)? },
            "box" => {
                let size = geometry.array::<3>("size", self.remarks)?;
                Shape::Box { half_size_m: size.map(|s| (0.5 * s).max(1e-6)) }
            }
            kind @ ("cylinder" | "capsule") => {
                let radius_m = number("radius", self.remarks)?;
                let half_length_m = 0.5 * number("length", self.remarks)?;
                match kind {
                    "capsule" => Shape::Capsule { radius_m, half_length_m },
                    _ => Shape::Cylinder { radius_m, half_length_m },
                }
            }
            "mesh" if !collides => {
                self.remarks.note_once(&geometry, "meshes for the eye are not kept");
                return None;
            }
            "mesh" => {
                let name = geometry.get("filename").unwrap_or_default();
                let scale = geometry.array("scale", self.remarks).unwrap_or([1.0; 3]);
                self.meshes.add(name, self.path(name), scale);
                let Some(mesh) = self.meshes.find(name) else {
                    self.lost.push((name.to_owned(), link.clone()));
                    return None;
                };
                self.remarks.note_once(
                    &geometry,
                    "meshes that touch something become the boxes that they fill",
                );
                at = Pose { pos_m: at.point(mesh.middle_m), ..at };
                Shape::Box { half_size_m: mesh.half_size_m.map(|h| h.max(1e-4)) }
            }
            other => {
                self.remarks.refuse(&geometry, format!("<{other}> is not a shape that is read"));
                return None;
            }
        };
        let bits = u32::from(collides);
        let geom = Geom {
            name: None,
            shape,
            link_from_geom: at,
            friction: 1.0,
            contype: bits,
            conaffinity: bits,
            soft: Softness::default(),
        };
        Some(Painted { geom, rgba: None })
    }

    /// A mesh's file: beside the URDF, or under a folder above it that holds the package.
    fn path(&self, name: &str) -> PathBuf {
        let name = name.strip_prefix("file://").unwrap_or(name);
        let beside = self.file.with_file_name("");
        let Some(inside) = name.strip_prefix("package://") else { return beside.join(name) };
        let below = inside.split_once('/').map_or(inside, |(_, rest)| rest);
        let folders = beside.ancestors().map(Path::to_owned).collect::<Vec<_>>();
        let tries = folders.iter().flat_map(|f| [f.join(inside), f.join(below)]);
        tries.into_iter().find(|p| p.is_file()).unwrap_or_else(|| beside.join(inside))
    }
}
