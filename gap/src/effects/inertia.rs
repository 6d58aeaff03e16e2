//! Masses (I1 to I6).

use super::effect::Reference::{Armature, Lever, Mass, One};
use super::effect::{Effect, Layer, PLAIN, needs_motion, one, parameter};
use crate::place::Domain;
use crate::plant::{anchor_m, hang, lever};

const OF_MASSES: Effect = Effect { layer: Layer::Inertia, domain: Domain::Links, ..PLAIN };

/// What was measured is off by no more than so many times its tolerance, which people write as what is usual (GUM, JCGM
/// 100:2008, 6.2: an expanded uncertainty is two standard uncertainties).
const EXPANDED: f64 = 2.0;

pub static LINK_MASS: Effect = Effect {
    id: "link_mass",
    parameters: &[parameter("scale", "", 1.0, (0.2, 4.0), 0.03, One)],
    grid: &one(&[0.7, 0.9, 1.1, 1.3, 1.7]),
    measured: |own, mass_kg| own.mass_kg.map(|tolerance| EXPANDED * tolerance / mass_kg),
    apply: |plant, place, v| place.each(|l| plant.lane.link_mass_scale[l] *= v[0] as f32),
    look_alikes: "link_com point_mass payload torque_constant armature encoder_gain parallel_spring",
    trial: "holds",
    signature: "gravity and inertia of the link grow together",
    ..OF_MASSES
};

pub static LINK_COM: Effect = Effect {
    id: "link_com",
    parameters: &[
        parameter("x_m", "m", 0.0, (-0.1, 0.1), 0.001, One),
        parameter("y_m", "m", 0.0, (-0.1, 0.1), 0.001, One),
        parameter("z_m", "m", 0.0, (-0.1, 0.1), 0.001, One),
    ],
    grid: &[
        &[-0.012, 0.0, 0.0],
        &[0.012, 0.0, 0.0],
        &[0.0, -0.012, 0.0],
        &[0.0, 0.012, 0.0],
        &[0.0, 0.0, -0.012],
        &[0.0, 0.0, 0.012],
    ],
    measured: |own, _| own.com_m.map(|tolerance| EXPANDED * tolerance),
    apply: |plant, place, v| {
        for &l in &place.items {
            for (offset, v) in plant.lane.com_offset_m[l].iter_mut().zip(v) {
                *offset += *v as f32;
            }
        }
    },
    look_alikes: "link_mass point_mass armature encoder_offset parallel_spring link_inertia payload",
    trial: "holds",
    signature: "gravity changes with the lever, inertia with its square; the weight stays",
    ..OF_MASSES
};

pub static POINT_MASS: Effect = Effect {
    id: "point_mass",
    parameters: &[
        // less than nothing: what the robot file has there and the robot does not
        parameter("extra_kg", "kg", 0.0, (-0.8, 6.0), 0.03, Mass),
        parameter("lever_m", "m", 1.0, (0.3, 4.0), 0.1, Lever),
    ],
    grid: &[&[0.3, 0.6], &[0.3, 1.3], &[0.3, 2.0]],
    measured: |own, _| own.mass_kg.map(|tolerance| EXPANDED * tolerance),
    apply: |plant, place, v| {
        for &l in &place.items {
            let (direction, _) = lever(&plant.model, l);
            let anchor_m = anchor_m(&plant.model, l);
            let at_m = [0, 1, 2].map(|i| anchor_m[i] + v[1] * direction[i]);
            hang(&plant.model, &mut plant.lane, l, &[(v[0], at_m)]);
            // a weight that is tried may be more than a light link's inertia can be scaled to
            let scale = &mut plant.lane.link_inertia_scale[l];
            *scale = scale.clamp(0.01, 100.0);
        }
    },
    look_alikes: "torque_constant link_mass link_com link_inertia armature payload",
    trial: "holds",
    signature: "gravity grows with its lever, inertia with the square of it; so they do, nearly alike, where every torque is less",
    ..OF_MASSES
};

pub static LINK_INERTIA: Effect = Effect {
    id: "link_inertia",
    parameters: &[parameter("scale", "", 1.0, (0.05, 20.0), 0.1, One)],
    grid: &one(&[0.4, 1.7, 3.0, 6.0, 12.0]),
    apply: |plant, place, v| place.each(|l| plant.lane.link_inertia_scale[l] *= v[0] as f32),
    look_alikes: "armature link_com link_mass point_mass",
    unseen: needs_motion,
    trial: "chirp_large",
    signature: "shows in fast motion only; no gravity",
    ..OF_MASSES
};

pub static ARMATURE: Effect = Effect {
    id: "armature",
    domain: Domain::Joints,
    parameters: &[parameter("extra_kgm2", "kg·m²", 0.0, (-0.95, 20.0), 0.2, Armature)],
    grid: &one(&[-0.5, 0.5, 1.5, 4.0, 8.0]),
    apply: |plant, place, v| {
        for &a in &place.items {
            let rotor = plant.lane.joint_armature_kgm2[a] + v[0] as f32;
            plant.lane.joint_armature_kgm2[a] = rotor.max(1e-4);
        }
    },
    look_alikes: "link_inertia link_com link_mass damping_lag added_mass",
    corrects: "armature_kgm2",
    unseen: needs_motion,
    trial: "chirp_large",
    signature: "inertia of the joint alone: no gravity, nothing passed on to neighbours",
    ..OF_MASSES
};

pub static PAYLOAD: Effect = Effect {
    id: "payload",
    domain: Domain::Robot,
    parameters: &[
        parameter("mass_kg", "kg", 0.0, (0.0, 5.0), 0.02, One),
        parameter("x_m", "m", 0.0, (-0.25, 0.25), 0.02, One),
        parameter("z_m", "m", 0.0, (-0.25, 0.25), 0.02, One),
    ],
    grid: &[
        &[0.1, 0.0, 0.0],
        &[0.3, 0.0, 0.0],
        &[0.8, 0.0, 0.0],
        &[0.3, 0.1, 0.0],
        &[0.3, -0.1, 0.0],
        &[0.3, 0.0, 0.1],
        &[0.3, 0.0, -0.1],
    ],
    apply: |plant, _, v| {
        plant.lane.payload_kg += v[0] as f32;
        plant.lane.payload_m[0] += v[1] as f32;
        plant.lane.payload_m[2] += v[2] as f32;
    },
    look_alikes: "link_mass link_com buoyancy",
    unseen: |e, _| {
        (!e.on_ground && !e.in_water).then_some("a held trunk does not show what it carries")
    },
    trial: "rest",
    signature: "weight on the trunk: every leg carries more",
    ..OF_MASSES
};

pub static FLOOR_SLOPE: Effect = Effect {
    id: "floor_slope",
    domain: Domain::Robot,
    parameters: &[
        parameter("roll_rad", "rad", 0.0, (-0.4, 0.4), 0.005, One),
        parameter("pitch_rad", "rad", 0.0, (-0.4, 0.4), 0.005, One),
    ],
    grid: &[
        &[-0.03, 0.0],
        &[0.03, 0.0],
        &[0.0, -0.03],
        &[0.0, 0.03],
        &[0.0, -0.1],
        &[0.0, 0.1],
        &[0.1, 0.0],
        &[-0.1, 0.0],
    ],
    apply: |plant, _, v| plant.lane.tilt_floor(v[0] as f32, v[1] as f32),
    look_alikes: "imu_tilt encoder_offset link_com direction_asymmetry",
    trial: "rest",
    signature: "gravity points elsewhere in the world: all joints with a lever change together, and it turns with the heading",
    ..OF_MASSES
};
