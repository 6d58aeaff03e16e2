//! Parser for the supported subset of MJCF.
//!
//! | element | attributes |
//! |---|---|
//! | `mujoco` | model |
//! | `compiler` | angle, autolimits, eulerseq, coordinate (local), inertiafromgeom (false, auto), balanceinertia (false) |
//! | `option` | gravity; accepted without effect: timestep, integrator, cone, impratio, solver, iterations, ls_iterations, tolerance |
//! | `default` | class, nested; defaults of joint, geom, site, position, motor |
//! | `worldbody` | geom (fixed scenery, planes), body (one tree) |
//! | `body` | name, pos, quat, euler, childclass; holds inertial (required), freejoint (root), joint, geom, site, body |
//! | `joint`, `geom`, `site`, `inertial` | see `elements.rs`; of `solimp` and `solimplimit`, powers 1 and 2 |
//! | `actuator` | position, motor: name, joint; accepted without effect (the robot file decides): kp, kv, ctrlrange, forcerange |
//! | `contact` | exclude body1, body2 |
//!
//! Everything else is refused by name, attribute and line: nothing in a file is ever passed over in silence.

mod compiler;
mod elements;
mod xml;

use std::collections::BTreeSet;

use roxmltree::{Document, Node};

use crate::error::ModelError;
use crate::pose::Pose;
use crate::types::Geom;

pub(crate) use compiler::Compiler;
pub(crate) use elements::{between, check_inertia, z_to};

use elements::{Actuator, MjJoint, MjSite};
use xml::{DEPTH_LIMIT, Defaults, Source};

/// Most bodies of one robot.
const BODY_LIMIT: usize = 512;
/// Standard gravity of MuJoCo's default, m/s².
const DEFAULT_GRAVITY_MPS2: [f64; 3] = [0.0, 0.0, -9.81];

/// What the MJCF says, before the robot file is applied.
#[derive(Default)]
pub(crate) struct MjModel {
    pub gravity_mps2: [f64; 3],
    pub free_base: bool,
    pub bodies: Vec<MjBody>,
    pub joints: Vec<MjJoint>,
    pub sites: Vec<(usize, MjSite)>,
    pub world_geoms: Vec<Geom>,
    pub actuators: Vec<Actuator>,
    pub excluded: Vec<(usize, usize)>,
}

pub(crate) struct MjBody {
    pub name: String,
    pub parent: Option<usize>,
    pub parent_from_body: Pose,
    pub mass_kg: f64,
    pub com_m: [f64; 3],
    pub inertia_kgm2: [[f64; 3]; 3],
    pub joints: Vec<usize>,
    pub geoms: Vec<Geom>,
}

/// Parses an MJCF text; `file` names it in errors.
pub(crate) fn parse(file: &str, text: &str) -> Result<MjModel, ModelError> {
    let doc = Document::parse(text).map_err(|e| ModelError::Xml {
        file: file.to_owned(),
        message: e.to_string(),
    })?;
    let source = Source { file, doc: &doc };
    let root = doc.root_element();
    if root.tag_name().name() != "mujoco" {
        return source.refuse(root, "is not <mujoco>; this is not an MJCF file");
    }
    source.only_attributes(root, &["model"])?;
    let mut gravity_mps2 = DEFAULT_GRAVITY_MPS2;
    let mut compiler = Compiler::default();
    let mut defaults = Defaults::default();
    let sections = source.children(root)?;
    // settings first: MJCF sections may stand in any order
    for &node in &sections {
        match node.tag_name().name() {
            "compiler" => compiler.read(&source, node)?,
            "default" => defaults.read(&source, node, &elements::attributes_of)?,
            "option" => gravity_mps2 = read_option(&source, &defaults, node)?,
            "worldbody" | "actuator" | "contact" => {}
            _ => return source.refuse(node, "is outside the supported subset"),
        }
    }
    let mut reader = Reader {
        source: &source,
        compiler: &compiler,
        defaults: &defaults,
        out: MjModel {
            gravity_mps2,
            ..MjModel::default()
        },
        names: BTreeSet::new(),
    };
    for &node in sections
        .iter()
        .filter(|n| n.tag_name().name() == "worldbody")
    {
        reader.world(node)?;
    }
    for &node in &sections {
        match node.tag_name().name() {
            "actuator" => reader.actuators(node)?,
            "contact" => reader.contact(node)?,
            _ => {}
        }
    }
    if reader.out.bodies.is_empty() {
        return source.refuse(root, "has no <body> in its <worldbody>");
    }
    Ok(reader.out)
}

fn read_option(
    source: &Source<'_>,
    defaults: &Defaults,
    node: Node<'_, '_>,
) -> Result<[f64; 3], ModelError> {
    #[rustfmt::skip]
    source.only_attributes(node, &[
        "gravity", "timestep", "integrator", "cone", "impratio", "solver", "iterations", "ls_iterations", "tolerance",
    ])?;
    source.no_children(node)?;
    let e = defaults.element(source, node, None)?;
    Ok(e.array::<3>("gravity")?.unwrap_or(DEFAULT_GRAVITY_MPS2))
}

struct Reader<'a> {
    source: &'a Source<'a>,
    compiler: &'a Compiler,
    defaults: &'a Defaults,
    out: MjModel,
    names: BTreeSet<(&'static str, String)>,
}

impl Reader<'_> {
    fn unique(
        &mut self,
        node: Node<'_, '_>,
        kind: &'static str,
        name: &str,
    ) -> Result<(), ModelError> {
        if self.names.insert((kind, name.to_owned())) {
            return Ok(());
        }
        Err(self.source.error(
            node,
            Some("name"),
            format!("there is already a {kind} called `{name}`"),
        ))
    }

    fn world(&mut self, node: Node<'_, '_>) -> Result<(), ModelError> {
        self.source.only_attributes(node, &[])?;
        for child in self.source.children(node)? {
            match child.tag_name().name() {
                "geom" => {
                    let e = self.defaults.element(self.source, child, None)?;
                    self.out
                        .world_geoms
                        .push(elements::geom(&e, self.compiler, true)?);
                }
                "body" if !self.out.bodies.is_empty() => {
                    return self.source.refuse(
                        child,
                        "is a second tree in <worldbody>; a robot is one tree",
                    );
                }
                "body" => self.body(child, None, None, 0)?,
                _ => {
                    return self.source.refuse(child, "is not supported in <worldbody>");
                }
            }
        }
        Ok(())
    }

    fn body(
        &mut self,
        node: Node<'_, '_>,
        parent: Option<usize>,
        childclass: Option<&str>,
        depth: usize,
    ) -> Result<(), ModelError> {
        let source = self.source;
        source.only_attributes(node, &["name", "pos", "quat", "euler", "childclass"])?;
        if depth > DEPTH_LIMIT || self.out.bodies.len() >= BODY_LIMIT {
            return source.refuse(
                node,
                format!("exceeds {DEPTH_LIMIT} nested or {BODY_LIMIT} bodies in all"),
            );
        }
        let childclass = node.attribute("childclass").or(childclass);
        let e = self.defaults.element(source, node, childclass)?;
        let name = e.required_text("name")?.to_owned();
        let parent_from_body = elements::pose(&e, self.compiler)?;
        self.unique(node, "body", &name)?;
        let index = self.out.bodies.len();
        let children = source.children(node)?;
        let inertials: Vec<_> = children
            .iter()
            .filter(|c| c.tag_name().name() == "inertial")
            .collect();
        let (mass_kg, com_m, inertia_kgm2) = match inertials.as_slice() {
            [one] => {
                elements::inertial(&self.defaults.element(source, **one, None)?, self.compiler)?
            }
            [] => return source.refuse(node, "has no <inertial>; every link needs one"),
            [_, second, ..] => {
                return source.refuse(**second, "stands twice in one body");
            }
        };
        self.out.bodies.push(MjBody {
            name,
            parent,
            parent_from_body,
            mass_kg,
            com_m,
            inertia_kgm2,
            joints: Vec::new(),
            geoms: Vec::new(),
        });
        // a link's own joints come before those of its children, whatever the order in the file
        for &child in children.iter().filter(|c| c.tag_name().name() != "body") {
            self.part(child, index, childclass)?;
        }
        if parent.is_some() && self.out.bodies[index].joints.is_empty() {
            return source.refuse(
                node,
                "has no joint, so it is welded to its parent; merge it into the parent",
            );
        }
        for &child in children.iter().filter(|c| c.tag_name().name() == "body") {
            self.body(child, Some(index), childclass, depth + 1)?;
        }
        Ok(())
    }

    fn part(
        &mut self,
        node: Node<'_, '_>,
        body: usize,
        childclass: Option<&str>,
    ) -> Result<(), ModelError> {
        let source = self.source;
        let e = self.defaults.element(source, node, childclass)?;
        match node.tag_name().name() {
            "inertial" => {}
            "freejoint" => {
                source.only_attributes(node, &["name"])?;
                if self.out.bodies[body].parent.is_some() {
                    return source.refuse(node, "belongs in the root body only");
                }
                if self.out.free_base || !self.out.bodies[body].joints.is_empty() {
                    return source.refuse(node, "must be the only joint of its body");
                }
                self.out.free_base = true;
            }
            "joint" => {
                let joint = elements::joint(&e, self.compiler)?;
                if self.out.free_base && self.out.bodies[body].parent.is_none() {
                    return source.refuse(node, "stands beside <freejoint>");
                }
                self.unique(node, "joint", &joint.name)?;
                self.out.bodies[body].joints.push(self.out.joints.len());
                self.out.joints.push(joint);
            }
            "geom" => {
                let geom = elements::geom(&e, self.compiler, false)?;
                if let Some(name) = &geom.name {
                    self.unique(node, "geom", name)?;
                }
                self.out.bodies[body].geoms.push(geom);
            }
            "site" => {
                let site = elements::site(&e, self.compiler)?;
                self.unique(node, "site", &site.name)?;
                self.out.sites.push((body, site));
            }
            _ => return source.refuse(node, "is not supported inside <body>"),
        }
        Ok(())
    }

    fn actuators(&mut self, node: Node<'_, '_>) -> Result<(), ModelError> {
        self.source.only_attributes(node, &[])?;
        for child in self.source.children(node)? {
            if !matches!(child.tag_name().name(), "position" | "motor") {
                return self
                    .source
                    .refuse(child, "is not a supported actuator (position or motor)");
            }
            let e = self.defaults.element(self.source, child, None)?;
            let actuator = elements::actuator(&e)?;
            self.unique(child, "actuator", &actuator.name)?;
            if !self.out.joints.iter().any(|j| j.name == actuator.joint) {
                return self.source.refuse_attribute(
                    child,
                    "joint",
                    format!("there is no joint `{}`", actuator.joint),
                );
            }
            self.out.actuators.push(actuator);
        }
        Ok(())
    }

    fn contact(&mut self, node: Node<'_, '_>) -> Result<(), ModelError> {
        self.source.only_attributes(node, &[])?;
        for child in self.source.children(node)? {
            if child.tag_name().name() != "exclude" {
                return self
                    .source
                    .refuse(child, "is not supported in <contact> (exclude)");
            }
            self.source
                .only_attributes(child, &["name", "body1", "body2"])?;
            let mut pair = [0; 2];
            for (slot, attribute) in pair.iter_mut().zip(["body1", "body2"]) {
                let name = child
                    .attribute(attribute)
                    .ok_or_else(|| self.source.error(child, Some(attribute), "is missing"))?;
                *slot = self
                    .out
                    .bodies
                    .iter()
                    .position(|b| b.name == name)
                    .ok_or_else(|| {
                        self.source.error(
                            child,
                            Some(attribute),
                            format!("there is no body `{name}`"),
                        )
                    })?;
            }
            self.out.excluded.push((pair[0], pair[1]));
        }
        Ok(())
    }
}
