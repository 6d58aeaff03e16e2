//! A robot as a file describes it: bodies, joints, shapes, actuators.

use std::collections::{BTreeMap, BTreeSet};

use crate::error::Remark;
use crate::geometry::{Inertial, check_inertia, nearest_inertia};
use crate::pose::{self, Pose};
use crate::tree::Element;
use crate::types::{Geom, JointMotion, Softness};

/// Damping over stiffness of a position loop of which a file says only one, or neither, s.
pub(crate) const UNSAID_DAMPING_S: f64 = 0.025;

/// A robot as it was read.
#[derive(Default)]
pub(crate) struct Robot {
    pub name: Option<String>,
    pub gravity_mps2: [f64; 3],
    pub free_base: bool,
    /// A parent always comes before its children.
    pub bodies: Vec<Body>,
    pub actuators: Vec<Actuator>,
    /// What the file fixes to the world.
    pub world_geoms: Vec<Geom>,
    /// A bit of what touches the ground alone, 0 where nothing does.
    pub ground_bit: u32,
    /// Pairs of bodies that never touch, by name.
    pub excluded: Vec<[String; 2]>,
    /// Joint positions of a named pose.
    pub home: BTreeMap<String, f64>,
    /// Whether that pose stands in no file.
    pub home_is_ours: bool,
    /// Sites that a gyroscope or an accelerometer sits at.
    pub sensed: BTreeSet<String>,
    /// Bodies of an inertia that none has, and what is said where it makes one that is refused.
    pub impossible: Vec<(String, Remark)>,
    /// Bodies that became part of others, and of which.
    pub merged: BTreeMap<String, String>,
}

impl Robot {
    /// The body that carries the IMU, and the name of its site: the one of a gyroscope, else one that is called so.
    pub fn imu(&self) -> Option<(usize, &str)> {
        let bodies = self.bodies.iter().enumerate();
        let sites =
            || bodies.clone().flat_map(|(i, b)| b.sites.iter().map(move |s| (i, s.0.as_str())));
        let called = |(_, name): &(usize, &str)| name.to_lowercase().contains("imu");
        sites().find(|(_, name)| self.sensed.contains(*name)).or_else(|| sites().find(called))
    }

    /// Joints in model order.
    pub fn joints(&self) -> impl Iterator<Item = &Joint> {
        self.bodies.iter().flat_map(|body| &body.joints)
    }

    /// What a joint moves with all others still, in the pose of the file, kg·m² (kg where it slides).
    pub fn hanging_inertia(&self, joint: &str) -> f64 {
        let mut at: Vec<Option<Pose>> = Vec::new();
        let (mut moved, mut of) = (0.0, None);
        for (i, body) in self.bodies.iter().enumerate() {
            let own = body.joints.iter().find(|j| j.name == joint);
            of = of.or(own);
            let above = body.parent.and_then(|p| at[p]).map(|p| p.compose(&body.parent_from_body));
            at.push(above.or(own.map(|_| Pose::IDENTITY)));
            let (Some(joint), Some(at), Some(inertial)) = (of, at[i], body.inertial) else {
                continue;
            };
            let seen = inertial.seen_from(&at);
            moved += match joint.motion {
                JointMotion::Slide => seen.mass_kg,
                JointMotion::Hinge => {
                    let arm = pose::cross(joint.axis, pose::sub(seen.com_m, joint.anchor_m));
                    let turned = seen.inertia_kgm2.map(|row| pose::dot(row, joint.axis));
                    pose::dot(joint.axis, turned) + seen.mass_kg * pose::dot(arm, arm)
                }
            };
        }
        moved + of.map_or(0.0, |joint| joint.armature)
    }

    /// Keeps in mind that no body has this inertia, and what is nearest to it: `[xx, yy, zz, xy, xz, yz]` in words.
    pub fn weigh(
        &mut self,
        (name, element): (&str, &Element),
        inertia: [[f64; 3]; 3],
        words: impl Fn([String; 6]) -> String,
    ) {
        let Err(why) = check_inertia(inertia) else { return };
        let [[xx, xy, xz], [_, yy, yz], [_, _, zz]] = nearest_inertia(inertia);
        let near = words([xx, yy, zz, xy, xz, yz].map(|x| format!("{x:.8e}")));
        let message = format!("{why}; the nearest that one has is {near}");
        self.impossible.push((name.to_owned(), element.remark_of(message)));
    }
}

pub(crate) struct Body {
    pub name: String,
    pub parent: Option<usize>,
    pub parent_from_body: Pose,
    pub inertial: Option<Inertial>,
    pub joints: Vec<Joint>,
    pub geoms: Vec<Painted>,
    pub sites: Vec<(String, Pose)>,
    pub element: Element,
}

pub(crate) struct Joint {
    pub name: String,
    pub motion: JointMotion,
    pub axis: [f64; 3],
    pub anchor_m: [f64; 3],
    pub range: Option<(f64, f64)>,
    /// What the file calls the position that it is drawn in; all here counts from there.
    pub drawn_at: f64,
    pub stop: Softness,
    pub stiffness: f64,
    pub spring_ref: f64,
    pub damping: f64,
    pub armature: f64,
    pub friction_loss: f64,
    /// Largest torque of its drive, where the joint says so.
    pub force_limit: Option<f64>,
    pub element: Element,
}

/// A shape, and the colour that its file gives it.
pub(crate) struct Painted {
    pub geom: Geom,
    pub rgba: Option<String>,
}

/// The drive of a joint.
pub(crate) struct Actuator {
    pub joint: String,
    /// Gains of its position loop; `None`: it commands torque.
    pub gains: Option<(f64, f64)>,
    pub force_limit: Option<f64>,
    /// Speed that it cannot pass, rad/s.
    pub speed_limit: Option<f64>,
    pub element: Element,
}
