//! A link in water, written once over [`Real`]: buoyancy, heave damping, drag, added mass.
//!
//! All of it acts at the link's centre of mass (buoyancy at its own centre) and in proportion to how much of
//! the link is below the surface, a level plane. With s that share, axes i of the link, v and ω relative to
//! the water:
//!
//! | effect | formula | source |
//! |---|---|---|
//! | buoyancy | s·k_b·m·(−g) at the centre of buoyancy | Tian et al., the paper whose robot this is |
//! | heave damping | −s·k_d·v_z, world | the same |
//! | linear drag | −s·3πdβ·v_i, −s·πd³β·ω_i: a ball's Stokes drag, d the box's mean edge | MuJoCo's documentation, "Inertia-box fluid model" |
//! | quadratic drag | −s·½ρ·b_j·b_k·│v_i│·v_i, −s·ρ·b_i(b_j⁴+b_k⁴)/64·│ω_i│·ω_i | the same |
//! | added mass | s·c_i·k_b·m per axis, s·c'_i·k_b·I_ii about each | Newman, "Marine Hydrodynamics", chapter 4 |
//!
//! each axis with its factors from the robot file and the lane. The box has the edges b_i =
//! √(6(I_j+I_k−I_i)/m), the same second moments as the link. Mass and inertia here are those of the *model*:
//! water displaced does not change when a lane's robot is heavier inside.
//!
//! How an engine takes it: [`LinkForces`] holds force and torque now; `damping` is the secant damping D(v)
//! (drag = −D·v), which an engine may take implicitly by adding dt·D to the link's inertia: then no step can
//! overshoot. Added mass goes to the articulated inertia of the link as the diagonal spatial inertia
//! diag(I_a, m_a) in link axes about its centre of mass, on top of the link's own, without weight; its
//! gyroscopic part v ×* (M_a·v) is in the force already. (It multiplies the *spatial* acceleration; from a
//! classical one, ω × v has to be taken off.) (Changing s also changes M_a; the force M_a'·v is left out: it
//! acts only while crossing the surface.)

use caudata_model::{RobotModel, Shape};

use crate::LaneParams;
use crate::batch::vec3::{add, scale, sub};
use crate::per_lane::per_lane;
use crate::real::Real;

/// A link dips in over at least this height, m: thin plates would else jump.
const MIN_HALF_HEIGHT_M: f64 = 1e-3;

per_lane! {
    /// One link in water.
    pub struct WaterLink<R> {
        /// Centre of the link's extents in the link frame, m.
        pub centre_m: [R; 3],
        /// Half its extents along the link's axes, m.
        pub half_m: [R; 3],
        /// How the share under water grows with depth: 0 like an upright box (in proportion), 1 like a ball
        /// (3x² − 2x³).
        pub roundness: R,
        /// Buoyancy of the whole link, as the mass of the displaced water, kg.
        pub displaced_kg: R,
        /// Centre of mass in the link frame, m: drag acts here.
        pub com_m: [R; 3],
        /// Centre of buoyancy in the link frame, m.
        pub buoyancy_m: [R; 3],
        /// k_d, N·s/m.
        pub heave_ns_per_m: R,
        /// N·s/m, along the link's axes.
        pub linear_force: [R; 3],
        /// N·s²/m².
        pub quadratic_force: [R; 3],
        /// N·m·s/rad.
        pub linear_torque: [R; 3],
        /// N·m·s²/rad².
        pub quadratic_torque: [R; 3],
        /// Added mass, kg.
        pub added_mass_kg: [R; 3],
        /// Added inertia about the centre of mass, kg·m².
        pub added_inertia_kgm2: [R; 3],
    }
}

/// Where a link is and how it moves. World frame unless said otherwise.
#[derive(Debug, Clone, Copy)]
pub struct LinkMotion<R> {
    /// world_from_link, rows first.
    pub rotation: [[R; 3]; 3],
    /// Height of the link frame's origin, m.
    pub origin_z_m: R,
    /// Velocity of the centre of mass, m/s.
    pub com_vel_mps: [R; 3],
    /// Angular velocity, rad/s.
    pub angvel_radps: [R; 3],
}

/// The water around a lane's robot.
#[derive(Debug, Clone, Copy)]
pub struct Surface<R> {
    /// Height of the surface, world, m.
    pub level_m: R,
    /// Velocity of the water, world, m/s.
    pub current_mps: [R; 3],
    /// Gravity, world, m/s².
    pub gravity_mps2: [R; 3],
}

/// What water does to a link.
#[derive(Debug, Clone, Copy)]
pub struct LinkForces<R> {
    /// Share of the link that is under water, 0..=1.
    pub immersed: R,
    /// Force, world, N.
    pub force_n: [R; 3],
    /// Torque about the centre of mass, world, N·m.
    pub torque_nm: [R; 3],
    /// Secant damping of the drag along the link's axes, N·s/m: part of `force_n` is −D·v.
    pub damping_ns_per_m: [R; 3],
    /// The same about the link's axes, N·m·s/rad.
    pub damping_nms_per_rad: [R; 3],
    /// Damping along the world's vertical, N·s/m, likewise part of `force_n`.
    pub heave_ns_per_m: R,
    /// Added mass along the link's axes, kg.
    pub added_mass_kg: [R; 3],
    /// Added inertia about them, kg·m².
    pub added_inertia_kgm2: [R; 3],
}

/// The forces of water on one link.
#[inline(always)]
pub fn forces<R: Real>(p: &WaterLink<R>, at: &LinkMotion<R>, water: &Surface<R>) -> LinkForces<R> {
    let rot = &at.rotation;
    let s = immersed_share(p, at, water.level_m);

    // motion relative to the water, link axes
    let through = sub(at.com_vel_mps, water.current_mps);
    let v = into_link(rot, through);
    let w = into_link(rot, at.angvel_radps);
    let damping_force = damping(s, p.linear_force, p.quadratic_force, v);
    let damping_torque = damping(s, p.linear_torque, p.quadratic_torque, w);
    let added_mass = scale(p.added_mass_kg, s);
    let added_inertia = scale(p.added_inertia_kgm2, s);

    // −v ×* (M_a·v): torque v × p + ω × l, force ω × p, with the water's momentum p = m_a·v, l = I_a·ω
    let momentum = each(added_mass, v);
    let spin = each(added_inertia, w);
    let (carried, moment) = (cross(w, momentum), add(cross(v, momentum), cross(w, spin)));
    // the engine's acceleration is that in the world, the water's that in the current
    let drift = cross(w, into_link(rot, water.current_mps));
    let held = add(each(damping_force, v), add(carried, each(added_mass, drift)));
    let turned = add(each(damping_torque, w), moment);

    let lift = scale(water.gravity_mps2, -(s * p.displaced_kg));
    let arm = into_world(rot, sub(p.buoyancy_m, p.com_m));
    let heave = s * p.heave_ns_per_m;
    let mut force = sub(lift, into_world(rot, held));
    force[2] -= heave * through[2];
    LinkForces {
        immersed: s,
        force_n: force,
        torque_nm: sub(cross(arm, lift), into_world(rot, turned)),
        damping_ns_per_m: damping_force,
        damping_nms_per_rad: damping_torque,
        heave_ns_per_m: heave,
        added_mass_kg: added_mass,
        added_inertia_kgm2: added_inertia,
    }
}

/// Share of the link's volume below `level_m`: exact for a ball or an ellipsoid in any attitude and for an
/// upright box; a lying cylinder within 1 % of its volume.
#[inline(always)]
fn immersed_share<R: Real>(p: &WaterLink<R>, at: &LinkMotion<R>, level_m: R) -> R {
    let up = at.rotation[2];
    let centre_z = at.origin_z_m + dot(up, p.centre_m);
    // half the vertical extent, of a box and of an ellipsoid
    let reach = each(up, p.half_m);
    let boxed = reach[0].abs() + reach[1].abs() + reach[2].abs();
    let round = dot(reach, reach).sqrt();
    let half = (boxed + p.roundness * (round - boxed)).max(R::splat(MIN_HALF_HEIGHT_M));
    let x = ((level_m - centre_z + half) / (half + half)).clamp(R::zero(), R::one());
    let ball = x * x * (R::splat(3.0) - (x + x));
    x + p.roundness * (ball - x)
}

#[inline(always)]
fn dot<R: Real>(a: [R; 3], b: [R; 3]) -> R {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

/// Component by component.
#[inline(always)]
fn each<R: Real>(a: [R; 3], b: [R; 3]) -> [R; 3] {
    [a[0] * b[0], a[1] * b[1], a[2] * b[2]]
}

/// Secant damping of linear and quadratic drag at velocity `v`.
#[inline(always)]
fn damping<R: Real>(s: R, linear: [R; 3], quadratic: [R; 3], v: [R; 3]) -> [R; 3] {
    [
        s * (linear[0] + quadratic[0] * v[0].abs()),
        s * (linear[1] + quadratic[1] * v[1].abs()),
        s * (linear[2] + quadratic[2] * v[2].abs()),
    ]
}

#[inline(always)]
pub(crate) fn cross<R: Real>(a: [R; 3], b: [R; 3]) -> [R; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

#[inline(always)]
pub(crate) fn into_world<R: Real>(rot: &[[R; 3]; 3], v: [R; 3]) -> [R; 3] {
    [dot(rot[0], v), dot(rot[1], v), dot(rot[2], v)]
}

#[inline(always)]
fn into_link<R: Real>(rot: &[[R; 3]; 3], v: [R; 3]) -> [R; 3] {
    add(scale(rot[0], v[0]), add(scale(rot[1], v[1]), scale(rot[2], v[2])))
}

impl WaterLink<f64> {
    /// All links of a lane with parameters `params`; `None` for a robot without water in its file. `[L]`
    pub fn all(model: &RobotModel, params: &LaneParams) -> Option<Vec<Self>> {
        let water = model.water()?;
        let links = model.links().iter().zip(&params.water).enumerate();
        Some(
            links
                .map(|(l, (link, lane))| {
                    let wide = |x: f32| f64::from(x);
                    let drag = &water.drag[l];
                    let displaced = water.buoyancy_ratio * link.mass_kg;
                    let inertia = [0, 1, 2].map(|i| link.inertia_kgm2[i][i]);
                    let edges = box_edges_m(link.mass_kg, inertia);
                    let mean = edges.iter().sum::<f64>() / 3.0;
                    let linear = wide(lane.linear_drag_scale);
                    let stokes = std::f64::consts::PI * water.viscosity_pa_s * linear;
                    let quadratic = [
                        lane.quadratic_drag_scale_x,
                        lane.quadratic_drag_scale_y,
                        lane.quadratic_drag_scale_z,
                    ]
                    .map(wide);
                    let torque = wide(lane.quadratic_torque_scale) * water.density_kg_per_m3;
                    let added = [lane.added_mass_x, lane.added_mass_y, lane.added_mass_z];
                    let added_inertia =
                        [lane.added_inertia_x, lane.added_inertia_y, lane.added_inertia_z];
                    let offset = [lane.buoyancy_x_m, lane.buoyancy_y_m, lane.buoyancy_z_m];
                    let (centre_m, half_m, roundness) = extents(&link.geoms, link.com_m, edges);
                    Self {
                        centre_m,
                        half_m,
                        roundness,
                        displaced_kg: displaced * wide(lane.buoyancy_scale),
                        com_m: [0, 1, 2].map(|i| link.com_m[i] + wide(params.com_offset_m[l][i])),
                        buoyancy_m: [0, 1, 2].map(|i| link.com_m[i] + wide(offset[i])),
                        heave_ns_per_m: wide(lane.heave_damping_ns_per_m),
                        linear_force: drag.linear_force.map(|k| k * 3.0 * mean * stokes),
                        quadratic_force: [0, 1, 2].map(|i| {
                            let (j, k) = others(i);
                            let area = edges[j] * edges[k];
                            0.5 * water.density_kg_per_m3
                                * area
                                * drag.quadratic_force[i]
                                * quadratic[i]
                        }),
                        linear_torque: drag.linear_torque.map(|k| k * mean.powi(3) * stokes),
                        quadratic_torque: [0, 1, 2].map(|i| {
                            let (j, k) = others(i);
                            let fourth = edges[j].powi(4) + edges[k].powi(4);
                            torque * edges[i] * fourth / 64.0 * drag.quadratic_torque[i]
                        }),
                        added_mass_kg: added.map(|c| wide(c) * displaced),
                        added_inertia_kgm2: [0, 1, 2]
                            .map(|i| wide(added_inertia[i]) * water.buoyancy_ratio * inertia[i]),
                    }
                })
                .collect(),
        )
    }
}

fn others(i: usize) -> (usize, usize) {
    ((i + 1) % 3, (i + 2) % 3)
}

/// Edges of the box with the given mass and moments of inertia about its axes, m.
fn box_edges_m(mass_kg: f64, inertia_kgm2: [f64; 3]) -> [f64; 3] {
    [0, 1, 2].map(|i| {
        let (j, k) = others(i);
        let second = inertia_kgm2[j] + inertia_kgm2[k] - inertia_kgm2[i];
        (6.0 * second.max(0.0) / mass_kg).sqrt()
    })
}

/// Centre, half extents along the link's axes and roundness of a link's shapes together; of its inertia box
/// where it has none.
fn extents(
    geoms: &[caudata_model::Geom],
    com_m: [f64; 3],
    edges_m: [f64; 3],
) -> ([f64; 3], [f64; 3], f64) {
    let mut low = [f64::INFINITY; 3];
    let mut high = [f64::NEG_INFINITY; 3];
    let (mut round, mut weight) = (0.0, 0.0);
    for geom in geoms.iter().filter(|g| g.shape != Shape::Plane) {
        let mut size = 1.0;
        for axis in 0..3 {
            // the link's axis in the shape's frame
            let mut dir = [0.0; 3];
            dir[axis] = 1.0;
            let half = (geom.shape).half_extent_m(geom.link_from_geom.inverse().rotate(dir));
            let centre = geom.link_from_geom.pos_m[axis];
            low[axis] = low[axis].min(centre - half);
            high[axis] = high[axis].max(centre + half);
            size *= half;
        }
        round += size * roundness(geom.shape);
        weight += size;
    }
    if weight <= 0.0 {
        return (com_m, edges_m.map(|b| 0.5 * b), 0.0);
    }
    (
        [0, 1, 2].map(|i| 0.5 * (low[i] + high[i])),
        [0, 1, 2].map(|i| 0.5 * (high[i] - low[i])),
        round / weight,
    )
}

/// See [`WaterLink::roundness`]. A lying cylinder's share is (acos(1−2x) − (1−2x)·√(4x−4x²))/π: 0.196 at a
/// quarter of its height, between 0.25 of a box and 0.156 of a ball, at 0.58 of the way.
fn roundness(shape: Shape) -> f64 {
    match shape {
        Shape::Sphere { .. } | Shape::Ellipsoid { .. } => 1.0,
        Shape::Capsule { .. } | Shape::Cylinder { .. } => 0.58,
        Shape::Box { .. } | Shape::Plane => 0.0,
    }
}

#[cfg(test)]
mod tests;
