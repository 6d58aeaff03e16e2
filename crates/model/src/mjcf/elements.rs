//! Single MJCF elements: joint, geom, site, inertial, actuator.

use crate::error::ModelError;
use crate::pose::{self, Pose};
use crate::types::{Geom, JointMotion, Shape, Softness};

use super::compiler::Compiler;
use super::xml::Element;

pub(crate) struct MjJoint {
    pub name: String,
    pub line: u32,
    pub motion: JointMotion,
    pub axis: [f64; 3],
    pub anchor_m: [f64; 3],
    pub range_rad: Option<(f64, f64)>,
    pub stop: Softness,
    pub stiffness: f64,
    pub spring_ref: f64,
    pub damping: f64,
    pub armature: f64,
    pub friction_loss: f64,
}

pub(crate) struct MjSite {
    pub name: String,
    pub link_from_site: Pose,
}

pub(crate) struct Actuator {
    pub name: String,
    pub line: u32,
    pub joint: String,
}

/// Shapes of links, as MuJoCo calls them.
const SHAPES: [&str; 5] = ["sphere", "capsule", "cylinder", "box", "ellipsoid"];
/// MuJoCo's default sliding friction coefficient.
const DEFAULT_FRICTION: f64 = 1.0;

// Attributes by element. Those after the blank line steer MuJoCo's own solver or viewer; they are accepted
// and have no effect here.
#[rustfmt::skip]
pub(super) const JOINT: &[&str] = &[
    "name", "class", "type", "pos", "axis", "range", "limited", "stiffness", "springref", "damping", "armature", "frictionloss",
    "solreflimit", "solimplimit",

    "group",
];
#[rustfmt::skip]
pub(super) const GEOM: &[&str] = &[
    "name", "class", "type", "size", "pos", "quat", "euler", "fromto", "friction", "contype", "conaffinity",
    "solref", "solimp",

    "priority", "condim", "group", "rgba",
];
#[rustfmt::skip]
pub(super) const SITE: &[&str] = &[
    "name", "class", "pos", "quat", "euler",

    "type", "size", "group", "rgba",
];
pub(super) const INERTIAL: &[&str] =
    &["pos", "quat", "euler", "mass", "diaginertia", "fullinertia"];
#[rustfmt::skip]
pub(super) const ACTUATOR: &[&str] = &[
    "name", "class", "joint",

    "kp", "kv", "ctrlrange", "ctrllimited", "forcerange", "forcelimited", "group",
];

/// Elements that may have defaults, with the attributes that they support.
pub(super) fn attributes_of(tag: &str) -> Option<&'static [&'static str]> {
    match tag {
        "joint" => Some(JOINT),
        "geom" => Some(GEOM),
        "site" => Some(SITE),
        "position" | "motor" => Some(ACTUATOR),
        _ => None,
    }
}

/// Pose from `pos` and `quat` or `euler`.
pub(super) fn pose(e: &Element<'_, '_>, compiler: &Compiler) -> Result<Pose, ModelError> {
    let pos_m = e.array::<3>("pos")?.unwrap_or([0.0; 3]);
    let quat_wxyz = match (e.array::<4>("quat")?, e.array::<3>("euler")?) {
        (Some(_), Some(_)) => {
            return e.refuse("euler", "stands beside `quat`; give one of them");
        }
        (Some(q), None) => pose::quat_normalised(q)
            .ok_or_else(|| e.error("quat", "has length zero; it needs a direction"))?,
        (None, Some(angles)) => compiler.euler_to_quat(angles),
        (None, None) => [1.0, 0.0, 0.0, 0.0],
    };
    Ok(Pose { pos_m, quat_wxyz })
}

pub(super) fn joint(e: &Element<'_, '_>, compiler: &Compiler) -> Result<MjJoint, ModelError> {
    e.source.only_attributes(e.node, JOINT)?;
    e.source.no_children(e.node)?;
    let motion = match e.text("type").unwrap_or("hinge") {
        "hinge" => JointMotion::Hinge,
        "slide" => JointMotion::Slide,
        "free" => return e.refuse("type", "write the free joint as <freejoint/>"),
        other => {
            return e.refuse(
                "type",
                format!("`{other}` is not supported (hinge or slide)"),
            );
        }
    };
    let unit = match motion {
        JointMotion::Hinge => compiler.rad_per_unit,
        JointMotion::Slide => 1.0,
    };
    let range = e
        .array::<2>("range")?
        .map(|[lo, hi]| (lo * unit, hi * unit));
    if let Some((lo, hi)) = range
        && lo >= hi
    {
        return e.refuse("range", "its lower end is not below its upper end");
    }
    let limited = match e.text("limited").unwrap_or("auto") {
        "true" => true,
        "false" => false,
        "auto" if compiler.autolimits => range.is_some(),
        "auto" if range.is_none() => false,
        "auto" => {
            return e.refuse(
                "limited",
                "must be given beside `range` when autolimits is off",
            );
        }
        other => return e.refuse("limited", format!("`{other}` is not true, false or auto")),
    };
    if limited && range.is_none() {
        return e.refuse("range", "is missing on a limited joint");
    }
    Ok(MjJoint {
        name: e.required_text("name")?.to_owned(),
        line: e.source.doc.text_pos_at(e.node.range().start).row,
        motion,
        axis: e.direction("axis")?.unwrap_or([0.0, 0.0, 1.0]),
        anchor_m: e.array::<3>("pos")?.unwrap_or([0.0; 3]),
        range_rad: range.filter(|_| limited),
        stop: softness(e, "solreflimit", "solimplimit")?,
        stiffness: e.non_negative("stiffness")?,
        spring_ref: e.number("springref")?.unwrap_or(0.0) * unit,
        damping: e.non_negative("damping")?,
        armature: e.non_negative("armature")?,
        friction_loss: e.non_negative("frictionloss")?,
    })
}

/// How a constraint gives way; values left out are MuJoCo's.
fn softness(
    e: &Element<'_, '_>,
    solref: &'static str,
    solimp: &'static str,
) -> Result<Softness, ModelError> {
    let mut out = Softness::default();
    if let Some(given) = e.numbers(solref, 1, 2)? {
        out.solref[..given.len()].copy_from_slice(&given);
    }
    if let Some(given) = e.numbers(solimp, 1, 5)? {
        out.solimp[..given.len()].copy_from_slice(&given);
    }
    if !out.is_usable() {
        let message =
            "must be a time constant and a damping ratio above zero, or -stiffness and -damping";
        return e.refuse(solref, message);
    }
    let [low, high, width, middle, power] = out.solimp;
    if !([low, high, middle].iter().all(|x| (0.0..1.0).contains(x)) && width >= 0.0) {
        return e.refuse(
            solimp,
            "must be two shares below one, a width, a share below one",
        );
    }
    if power != 1.0 && power != 2.0 {
        return e.refuse(
            solimp,
            "has a power other than 1 and 2, which are those supported",
        );
    }
    Ok(out)
}

pub(super) fn geom(
    e: &Element<'_, '_>,
    compiler: &Compiler,
    in_world: bool,
) -> Result<Geom, ModelError> {
    e.source.only_attributes(e.node, GEOM)?;
    e.source.no_children(e.node)?;
    let kind = e.text("type").unwrap_or("sphere");
    let (shape, link_from_geom) = match e.array::<6>("fromto")? {
        Some(ends) => segment(e, kind, ends)?,
        None if kind == "plane" => (Shape::Plane, pose(e, compiler)?),
        None => {
            let sizes = e.numbers("size", 1, 3)?.unwrap_or_default();
            (shape(e, kind, &sizes)?, pose(e, compiler)?)
        }
    };
    if shape == Shape::Plane && !in_world {
        return e.refuse("type", "a plane belongs in <worldbody>, not on a link");
    }
    let friction = e
        .numbers("friction", 1, 3)?
        .map_or(DEFAULT_FRICTION, |f| f[0]);
    if friction < 0.0 {
        return e.refuse(
            "friction",
            format!("is {friction}; it must not be negative"),
        );
    }
    Ok(Geom {
        name: e.node.attribute("name").map(str::to_owned),
        shape,
        link_from_geom,
        friction,
        contype: e.bits("contype", 1)?,
        conaffinity: e.bits("conaffinity", 1)?,
        soft: softness(e, "solref", "solimp")?,
    })
}

fn shape(e: &Element<'_, '_>, kind: &str, sizes: &[f64]) -> Result<Shape, ModelError> {
    if !SHAPES.contains(&kind) {
        let known = SHAPES.join(", ");
        let message = format!("`{kind}` is not supported ({known}; plane in the world)");
        return e.refuse("type", message);
    }
    Shape::from_mjcf(kind, sizes)
        .ok_or_else(|| e.error("size", "is missing, too short or not above zero"))
}

/// A capsule or cylinder given by its end points.
fn segment(e: &Element<'_, '_>, kind: &str, ends: [f64; 6]) -> Result<(Shape, Pose), ModelError> {
    for other in ["pos", "quat", "euler"] {
        if e.node.attribute(other).is_some() {
            return e.refuse(other, "stands beside `fromto`; give one of them");
        }
    }
    if !matches!(kind, "capsule" | "cylinder") {
        return e.refuse("fromto", "is only supported on capsules and cylinders");
    }
    let (middle, half_length_m) = between(ends);
    if half_length_m < 0.5e-9 {
        return e.refuse("fromto", "its two points coincide");
    }
    let sizes = e.numbers("size", 1, 3)?.unwrap_or_default();
    let sizes: Vec<f64> = sizes.into_iter().take(1).chain([half_length_m]).collect();
    Ok((shape(e, kind, &sizes)?, middle))
}

/// The middle of two points, its z axis along them, and half their distance. MuJoCo lets the axis run from the
/// second point to the first; a symmetric shape does not care.
pub(crate) fn between(ends: [f64; 6]) -> (Pose, f64) {
    let (a, b) = ([ends[0], ends[1], ends[2]], [ends[3], ends[4], ends[5]]);
    let along = pose::sub(a, b);
    let length = pose::norm(along);
    let middle = Pose {
        pos_m: pose::add(a, b).map(|x| 0.5 * x),
        quat_wxyz: z_to(along.map(|x| x / length.max(1e-12))),
    };
    (middle, 0.5 * length)
}

/// The shortest turn that takes the z axis to the unit vector `d`.
pub(crate) fn z_to(d: [f64; 3]) -> [f64; 4] {
    let w = 1.0 + d[2];
    if w < 1e-12 {
        return [0.0, 1.0, 0.0, 0.0]; // half a turn about x
    }
    // (1 + z·d, z × d), normalised
    pose::quat_normalised([w, -d[1], d[0], 0.0]).unwrap_or([1.0, 0.0, 0.0, 0.0])
}

pub(super) fn site(e: &Element<'_, '_>, compiler: &Compiler) -> Result<MjSite, ModelError> {
    e.source.only_attributes(e.node, SITE)?;
    e.source.no_children(e.node)?;
    Ok(MjSite {
        name: e.required_text("name")?.to_owned(),
        link_from_site: pose(e, compiler)?,
    })
}

/// Mass (kg), centre of mass (m) and inertia about it in link axes (kg·m²).
pub(super) type Inertial = (f64, [f64; 3], [[f64; 3]; 3]);

pub(super) fn inertial(e: &Element<'_, '_>, compiler: &Compiler) -> Result<Inertial, ModelError> {
    e.source.only_attributes(e.node, INERTIAL)?;
    e.source.no_children(e.node)?;
    e.required_text("pos")?;
    let link_from_inertial = pose(e, compiler)?;
    let mass = e
        .number("mass")?
        .ok_or_else(|| e.error("mass", "is missing"))?;
    if mass <= 0.0 {
        return e.refuse("mass", format!("is {mass} kg; it must be above zero"));
    }
    let turned = link_from_inertial.quat_wxyz != [1.0, 0.0, 0.0, 0.0];
    let (attribute, inertia) = match (e.array::<3>("diaginertia")?, e.array::<6>("fullinertia")?) {
        (Some(_), Some(_)) => {
            return e.refuse(
                "fullinertia",
                "stands beside `diaginertia`; give one of them",
            );
        }
        (None, None) => return e.refuse("diaginertia", "is missing (or `fullinertia`)"),
        (Some([x, y, z]), None) => ("diaginertia", [[x, 0.0, 0.0], [0.0, y, 0.0], [0.0, 0.0, z]]),
        (None, Some(_)) if turned => {
            return e.refuse(
                "fullinertia",
                "cannot stand beside an orientation (as in MuJoCo)",
            );
        }
        // MJCF order: xx, yy, zz, xy, xz, yz
        (None, Some([xx, yy, zz, xy, xz, yz])) => {
            ("fullinertia", [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        }
    };
    check_inertia(inertia).map_err(|m| e.error(attribute, m))?;
    let inertia = pose::rotate_tensor(link_from_inertial.quat_wxyz, inertia);
    Ok((mass, link_from_inertial.pos_m, inertia))
}

/// Whether an inertia tensor can belong to a body.
///
/// The second moments Σ = ½·tr(I)·E − I = ∫ r rᵀ dm must be positive semi-definite: that is the triangle
/// inequality of the principal moments (each at most the sum of the other two). A 3×3 matrix is, when all its
/// principal minors are ≥ 0.
pub(crate) fn check_inertia(i: [[f64; 3]; 3]) -> Result<(), String> {
    let half_trace = 0.5 * (i[0][0] + i[1][1] + i[2][2]);
    if !(i[0][0] > 0.0 && i[1][1] > 0.0 && i[2][2] > 0.0) {
        return Err("the moments of inertia must be above zero".to_owned());
    }
    // scaled to trace 1, so that the tolerance is relative
    let s = |r: usize, c: usize| {
        (if r == c {
            half_trace - i[r][c]
        } else {
            -i[r][c]
        }) / (2.0 * half_trace)
    };
    let minor2 = |a: usize, b: usize| s(a, a) * s(b, b) - s(a, b) * s(b, a);
    let det = s(0, 0) * minor2(1, 2) - s(0, 1) * (s(1, 0) * s(2, 2) - s(1, 2) * s(2, 0))
        + s(0, 2) * (s(1, 0) * s(2, 1) - s(1, 1) * s(2, 0));
    let minors = [
        s(0, 0),
        s(1, 1),
        s(2, 2),
        minor2(0, 1),
        minor2(0, 2),
        minor2(1, 2),
        det,
    ];
    const TOLERANCE: f64 = 1e-9;
    if minors.iter().any(|m| *m < -TOLERANCE) {
        return Err(
            "no body has this inertia: a principal moment exceeds the sum of the other two \
                    (triangle inequality)"
                .to_owned(),
        );
    }
    Ok(())
}

pub(super) fn actuator(e: &Element<'_, '_>) -> Result<Actuator, ModelError> {
    e.source.only_attributes(e.node, ACTUATOR)?;
    e.source.no_children(e.node)?;
    for attribute in ["kp", "kv"] {
        e.non_negative(attribute)?;
    }
    for attribute in ["ctrlrange", "forcerange"] {
        e.array::<2>(attribute)?;
    }
    let joint = e.required_text("joint")?.to_owned();
    Ok(Actuator {
        name: e.text("name").unwrap_or(&joint).to_owned(),
        line: e.source.doc.text_pos_at(e.node.range().start).row,
        joint,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn inertia_of_a_thin_rod_is_the_limit_of_what_exists() {
        let diag = |a: f64, b: f64, c: f64| [[a, 0.0, 0.0], [0.0, b, 0.0], [0.0, 0.0, c]];
        // thin rod along x: (0, m l²/12, m l²/12); nearly that is fine
        assert!(check_inertia(diag(1e-9, 1.0, 1.0)).is_ok());
        // disc: Izz = Ixx + Iyy, the other limit
        assert!(check_inertia(diag(1.0, 1.0, 2.0)).is_ok());
        assert!(check_inertia(diag(1.0, 1.0, 2.001)).is_err());
        assert!(check_inertia(diag(0.0, 1.0, 1.0)).is_err());
        // positive diagonal, but not a tensor of anything: off-diagonal larger than the diagonal allows
        assert!(check_inertia([[1.0, 0.9, 0.0], [0.9, 1.0, 0.0], [0.0, 0.0, 1.0]]).is_err());
        // Σ = [[0.5, -0.4, 0], [-0.4, 0.5, 0], [0, 0, 0.5]] is positive definite
        assert!(check_inertia([[1.0, 0.4, 0.0], [0.4, 1.0, 0.0], [0.0, 0.0, 1.0]]).is_ok());
    }

    #[test]
    fn z_to_points_the_z_axis() {
        for d in [
            [0.0, 0.0, 1.0],
            [0.0, 0.0, -1.0],
            [1.0, 0.0, 0.0],
            [0.6, 0.0, -0.8],
            [0.0, -0.6, 0.8],
        ] {
            let z = pose::quat_rotate(z_to(d), [0.0, 0.0, 1.0]);
            for i in 0..3 {
                assert!((z[i] - d[i]).abs() < 1e-12, "{d:?} gave {z:?}");
            }
        }
    }
}
