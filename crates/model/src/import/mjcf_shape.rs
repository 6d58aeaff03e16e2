//! MJCF: shapes.

use super::geometry::{Inertial, Solid};
use super::mjcf_context::{Context, softness};
use super::parts::Geom;
use super::tree::Element;
use crate::mjcf::between;
use crate::pose::{self, Pose};
use crate::types::Shape;

/// MuJoCo's default density, kg/m³.
const DENSITY_KG_PER_M3: f64 = 1000.0;
impl Context<'_> {
    /// A shape, where it is kept, and its mass.
    pub fn geom(&mut self, e: &Element, frame: &Pose) -> (Option<Geom>, Option<Inertial>) {
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
                let what = format!("mesh `{name}` cannot be read; the shape is left out");
                if collides {
                    self.remarks.note_of(e, what);
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
            let (middle, half_length) = between(ends);
            let radius = size.first().copied().unwrap_or(0.0);
            size = match kind {
                "box" | "ellipsoid" => vec![radius, radius, half_length],
                _ => vec![radius, half_length],
            };
            at = middle;
        }
        let Some(shape) = Shape::from_mjcf(kind, &size) else {
            if matches!(kind, "plane" | "hfield") || collides {
                self.remarks
                    .note_of(e, format!("a {kind} of this size is left out"));
            }
            return None;
        };
        let solid = Solid::of(&shape);
        Some((Some(shape), at, solid))
    }
}
