//! MJCF: shapes.

use super::context::{Context, softness, within};
use crate::geometry::{Inertial, Solid};
use crate::parts::Painted;
use crate::pose::{self, Pose, z_to};
use crate::tree::Element;
use crate::types::{Geom, Shape};

/// MuJoCo's default density, kg/m³.
const DENSITY_KG_PER_M3: f64 = 1000.0;

impl Context<'_> {
    /// A shape, where it is kept, and its mass.
    pub fn geom(&mut self, e: &Element, frame: &Pose) -> (Option<Painted>, Option<Inertial>) {
        let mut bits = |key: &str| match e.get(key).map(|text| (text, text.trim().parse())) {
            None => 1u32,
            Some((_, Ok(bits))) => bits,
            Some((text, Err(_))) => {
                let message = format!("attribute `{key}`: `{text}` is not a whole number ≥ 0");
                self.remarks.refuse_if_strict(e, message);
                1
            }
        };
        let (contype, conaffinity) = (bits("contype"), bits("conaffinity"));
        let kind = e.get("type").unwrap_or(if e.get("mesh").is_some() { "mesh" } else { "sphere" });
        let collides = contype != 0 || conaffinity != 0;
        let Some((shape, at, solid)) = self.shape(e, kind, collides) else { return (None, None) };
        let at = within(frame, at);
        let mass = e.not_negative("mass", self.remarks);
        let density = e.not_negative("density", self.remarks).unwrap_or(DENSITY_KG_PER_M3);
        let inertial = solid.and_then(|solid: Solid| {
            let mass = mass.unwrap_or(density * solid.volume_m3);
            (mass > 0.0).then(|| solid.with_mass(mass, &at))
        });
        let soft = softness(e, "solref", "solimp", self.remarks);
        let friction = e.some_numbers("friction", 3, self.remarks);
        let friction = friction.and_then(|f| f.first().copied()).unwrap_or(1.0);
        if friction < 0.0 {
            let message = format!("attribute `friction`: is {friction}; it must not be negative");
            self.remarks.refuse_of(e, message);
        }
        let Some(shape) = shape else { return (None, inertial) };
        let geom = Geom {
            name: e.get("name").map(str::to_owned),
            shape,
            link_from_geom: at,
            friction,
            contype,
            conaffinity,
            soft,
        };
        let rgba = e.get("rgba").map(str::to_owned);
        (Some(Painted { geom, rgba }), inertial)
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
            self.remarks
                .note_once(e, "meshes that touch something become the boxes that they fill");
            at = Pose { pos_m: at.point(mesh.middle_m), ..at };
            // the volume is about the mesh's own origin, the box about its middle
            let solid = Solid { centre_m: pose::sub(solid.centre_m, mesh.middle_m), ..solid };
            let half_size_m = mesh.half_size_m.map(|h| h.max(1e-4));
            return Some((Some(Shape::Box { half_size_m }), at, Some(solid)));
        }
        let before = self.remarks.refusals.len();
        let size = e.some_numbers("size", 3, self.remarks);
        let (mut at, mut size) = (self.pose(e), size.unwrap_or_default());
        if let Some(ends) = e.array::<6>("fromto", self.remarks) {
            if !matches!(kind, "capsule" | "cylinder" | "box" | "ellipsoid") {
                let message = format!("attribute `fromto`: is not for a {kind}");
                self.remarks.refuse_if_strict(e, message);
            }
            let (middle, half_length) = between(ends);
            let beside = ["pos", "quat", "euler"];
            if let Some(other) = beside.iter().find(|k| e.get(k).is_some()) {
                let message =
                    format!("attribute `{other}`: stands beside `fromto`; give one of them");
                self.remarks.refuse_if_strict(e, message);
            }
            if half_length < 0.5e-9 {
                self.remarks.refuse_of(e, "attribute `fromto`: its two points coincide");
            }
            let radius = size.first().copied().unwrap_or(0.0);
            size = match kind {
                "box" | "ellipsoid" => vec![radius, radius, half_length],
                _ => vec![radius, half_length],
            };
            at = middle;
        }
        let Some(shape) = Shape::from_mjcf(kind, &size) else {
            // what was refused already is why, a class that there is not may be
            let refusals = &self.remarks.refusals;
            let unclassed = refusals.iter().any(|r| r.message.contains("no default class"));
            if refusals.len() == before && !unclassed {
                self.shapeless(e, kind);
            }
            return None;
        };
        let solid = Solid::of(&shape);
        Some((Some(shape), at, solid))
    }

    /// Says why a geom is no shape.
    fn shapeless(&mut self, e: &Element, kind: &str) {
        let known = ["plane", "hfield", "sphere", "capsule", "cylinder", "box", "ellipsoid"];
        let left_out = matches!(kind, "plane" | "hfield") || e.get("mesh").is_some();
        let message = match kind {
            "plane" if self.remarks.strict => {
                "attribute `type`: a plane belongs in <worldbody>, not on a link".to_owned()
            }
            _ if !known.contains(&kind) => format!("attribute `type`: there is no shape `{kind}`"),
            _ if left_out && !self.remarks.strict => {
                return self.remarks.note_of(e, format!("a {kind} of this size is left out"));
            }
            _ => "attribute `size`: is missing, too short or not above zero".to_owned(),
        };
        self.remarks.refuse_of(e, message);
    }
}

/// The middle of two points, its z axis along them, and half their distance. MuJoCo lets the axis run from the
/// second point to the first; a symmetric shape does not care.
fn between(ends: [f64; 6]) -> (Pose, f64) {
    let (a, b) = ([ends[0], ends[1], ends[2]], [ends[3], ends[4], ends[5]]);
    let along = pose::sub(a, b);
    let length = pose::norm(along);
    let middle = Pose {
        pos_m: pose::add(a, b).map(|x| 0.5 * x),
        quat_wxyz: z_to(along.map(|x| x / length.max(1e-12))),
    };
    (middle, 0.5 * length)
}
