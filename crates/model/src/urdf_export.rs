//! A robot as URDF, for tools that read nothing else.

use crate::model::RobotModel;
use crate::pose::{self, Pose};
use crate::types::{BaseKind, Geom, Joint, JointKind, JointMotion, Shape};
use crate::xml_text::{escaped, line};

/// Mass of a link that only stands between two joints of one body, kg, and its moments, kg·m²: URDF has one
/// joint between two links, and some readers want every link to weigh something.
const BETWEEN_MASS_KG: f64 = 1e-6;
const BETWEEN_INERTIA_KGM2: f64 = 1e-9;
/// Torque and speed that are written for joints without a drive: none, and any.
const FREE_SPEED: f64 = 100.0;

impl RobotModel {
    /// The robot as URDF: links with inertia, joints with limits, damping and friction, shapes as primitives (a
    /// capsule as a cylinder and two balls). Rotor inertia, servos, sensors and water have no place in it. A
    /// robot that is bolted down hangs on a link called `world`.
    pub fn to_urdf(&self) -> String {
        let mut out = String::new();
        let w = &mut out;
        line(w, 0, "<?xml version=\"1.0\"?>");
        line(w, 0, &format!("<robot name=\"{}\">", escaped(self.name())));
        if self.base() == BaseKind::Fixed {
            line(w, 1, "<link name=\"world\"/>");
        }
        for (i, link) in self.links().iter().enumerate() {
            let name = escaped(&link.name);
            self.chain(w, i);
            line(w, 1, &format!("<link name=\"{name}\">"));
            inertial(w, link.mass_kg, link.com_m, link.inertia_kgm2);
            for geom in &link.geoms {
                shape(w, geom);
            }
            line(w, 1, "</link>");
        }
        line(w, 0, "</robot>");
        out
    }

    /// The joints from a link's parent to it, with the links between them.
    fn chain(&self, w: &mut String, index: usize) {
        let link = &self.links()[index];
        let own = escaped(&link.name);
        let mut parent = match link.parent {
            Some(p) => escaped(&self.links()[p].name),
            None if self.base() == BaseKind::Fixed => "world".to_owned(),
            None => return,
        };
        let mut at = link.parent_from_link;
        if link.joints.is_empty() {
            let name = format!("{own}_fixed");
            joint(w, &name, "fixed", [&parent, &own], &at, |_| {});
            return;
        }
        // A URDF joint turns about its child's origin: put that into the anchor. The last child is the link
        // itself, whose origin may lie elsewhere, so what is between is a fixed joint.
        for (k, &j) in link.joints.iter().enumerate() {
            let part = &self.joints()[j];
            let child = format!("{own}__{k}");
            let anchored = at.compose(&Pose::from_pos(part.anchor_m));
            self.moving(w, part, [&parent, &child], &anchored);
            line(w, 1, &format!("<link name=\"{child}\">"));
            let moments = [
                [BETWEEN_INERTIA_KGM2, 0.0, 0.0],
                [0.0, BETWEEN_INERTIA_KGM2, 0.0],
                [0.0, 0.0, BETWEEN_INERTIA_KGM2],
            ];
            inertial(w, BETWEEN_MASS_KG, [0.0; 3], moments);
            line(w, 1, "</link>");
            parent = child;
            at = Pose::from_pos(part.anchor_m.map(|x| -x));
        }
        let name = format!("{own}_fixed");
        joint(w, &name, "fixed", [&parent, &own], &at, |_| {});
    }

    fn moving(&self, w: &mut String, part: &Joint, ends: [&str; 2], at: &Pose) {
        let kind = match (part.motion, part.range_rad) {
            (JointMotion::Slide, _) => "prismatic",
            (JointMotion::Hinge, Some(_)) => "revolute",
            (JointMotion::Hinge, None) => "continuous",
        };
        let (effort, speed) = match part.kind {
            JointKind::Actuated { index } => {
                let servo = self.servo(index);
                (servo.tau_max_nm, servo.qd_max_radps)
            }
            JointKind::Passive | JointKind::Backlash => (0.0, FREE_SPEED),
        };
        joint(w, &escaped(&part.name), kind, ends, at, |w| {
            let [x, y, z] = part.axis;
            line(w, 2, &format!("<axis xyz=\"{x} {y} {z}\"/>"));
            let (low, high) = part.range_rad.unwrap_or((0.0, 0.0));
            let limits = part
                .range_rad
                .map_or(String::new(), |_| format!("lower=\"{low}\" upper=\"{high}\" "));
            line(w, 2, &format!("<limit {limits}effort=\"{effort}\" velocity=\"{speed}\"/>"));
            let (damping, friction) = (part.damping_nm_s_per_rad, part.friction_loss_nm);
            line(w, 2, &format!("<dynamics damping=\"{damping}\" friction=\"{friction}\"/>"));
        });
    }
}

fn joint(
    w: &mut String,
    name: &str,
    kind: &str,
    ends: [&str; 2],
    at: &Pose,
    more: impl FnOnce(&mut String),
) {
    line(w, 1, &format!("<joint name=\"{name}\" type=\"{kind}\">"));
    line(w, 2, &format!("<parent link=\"{}\"/><child link=\"{}\"/>", ends[0], ends[1]));
    line(w, 2, &origin(at));
    more(w);
    line(w, 1, "</joint>");
}

fn inertial(w: &mut String, mass_kg: f64, com_m: [f64; 3], i: [[f64; 3]; 3]) {
    line(w, 2, "<inertial>");
    line(w, 3, &origin(&Pose::from_pos(com_m)));
    line(w, 3, &format!("<mass value=\"{mass_kg}\"/>"));
    line(
        w,
        3,
        &format!(
            "<inertia ixx=\"{}\" ixy=\"{}\" ixz=\"{}\" iyy=\"{}\" iyz=\"{}\" izz=\"{}\"/>",
            i[0][0], i[0][1], i[0][2], i[1][1], i[1][2], i[2][2]
        ),
    );
    line(w, 2, "</inertial>");
}

/// A shape as collision if it touches something, else as visual.
fn shape(w: &mut String, geom: &Geom) {
    let tag = if geom.collides() { "collision" } else { "visual" };
    let at = &geom.link_from_geom;
    let mut put = |text: String, at: &Pose| {
        line(w, 2, &format!("<{tag}>{}<geometry>{text}</geometry></{tag}>", origin(at)));
    };
    match geom.shape {
        Shape::Sphere { radius_m } => put(format!("<sphere radius=\"{radius_m}\"/>"), at),
        Shape::Box { half_size_m } => {
            let [x, y, z] = half_size_m.map(|h| 2.0 * h);
            put(format!("<box size=\"{x} {y} {z}\"/>"), at);
        }
        Shape::Cylinder { radius_m, half_length_m } => {
            let length = 2.0 * half_length_m;
            put(format!("<cylinder radius=\"{radius_m}\" length=\"{length}\"/>"), at);
        }
        Shape::Capsule { radius_m, half_length_m } => {
            let length = 2.0 * half_length_m;
            put(format!("<cylinder radius=\"{radius_m}\" length=\"{length}\"/>"), at);
            for z in [-half_length_m, half_length_m] {
                let end = at.compose(&Pose::from_pos([0.0, 0.0, z]));
                put(format!("<sphere radius=\"{radius_m}\"/>"), &end);
            }
        }
        Shape::Ellipsoid { semi_axes_m } => {
            let [x, y, z] = semi_axes_m.map(|a| 2.0 * a);
            put(format!("<box size=\"{x} {y} {z}\"/>"), at);
        }
        Shape::Plane => {}
    }
}

/// `<origin>`; angles about fixed x, y, z.
fn origin(at: &Pose) -> String {
    let [x, y, z] = at.pos_m;
    let m = pose::quat_to_matrix(at.quat_wxyz);
    let level = m[0][0].hypot(m[1][0]);
    let pitch = (-m[2][0]).atan2(level);
    let (roll, yaw) = if level > 1e-9 {
        (m[2][1].atan2(m[2][2]), m[1][0].atan2(m[0][0]))
    } else {
        // nose up or down: one of the two is free
        ((-m[1][2]).atan2(m[1][1]), 0.0)
    };
    format!("<origin xyz=\"{x} {y} {z}\" rpy=\"{roll} {pitch} {yaw}\"/>")
}
