//! Water (H1 to H8).

use super::effect::Reference::One;
use super::effect::{Effect, Layer, PLAIN, one, parameter};
use crate::excitation::Excitation;
use crate::place::{Domain, Place};

fn needs_water(e: &Excitation, _: &Place) -> Option<&'static str> {
    (!e.in_water).then_some("the robot is never in the water in these runs")
}

const OF_WATER: Effect =
    Effect { layer: Layer::Water, domain: Domain::AllLinks, unseen: needs_water, ..PLAIN };

pub static LINEAR_DRAG: Effect = Effect {
    id: "linear_drag",
    parameters: &[parameter("scale", "", 1.0, (0.0, 90.0), 1.0, One)],
    grid: &one(&[5.0, 20.0, 60.0]),
    apply: |plant, place, v| place.each(|l| plant.lane.water[l].linear_drag_scale *= v[0] as f32),
    look_alikes: "quadratic_drag viscous_friction heave_damping",
    trial: "coast",
    signature: "loss per cycle grows with the amplitude squared",
    ..OF_WATER
};

pub static QUADRATIC_DRAG: Effect = Effect {
    id: "quadratic_drag",
    parameters: &[
        parameter("along", "", 1.0, (0.0, 30.0), 0.3, One),
        parameter("across", "", 1.0, (0.0, 8.0), 0.07, One),
    ],
    grid: &[&[4.0, 1.0], &[12.0, 1.0], &[1.0, 0.6], &[1.0, 1.4], &[1.0, 2.0]],
    apply: |plant, place, v| {
        for &l in &place.items {
            let water = &mut plant.lane.water[l];
            water.quadratic_drag_scale_x *= v[0] as f32;
            water.quadratic_drag_scale_y *= v[1] as f32;
            water.quadratic_drag_scale_z *= v[1] as f32;
            water.quadratic_torque_scale *= v[1] as f32;
        }
    },
    look_alikes: "linear_drag added_mass",
    trial: "swim_sizes",
    signature: "loss per cycle grows with the cube of the amplitude",
    ..OF_WATER
};

pub static ADDED_MASS: Effect = Effect {
    id: "added_mass",
    parameters: &[parameter("across_share", "", 0.0, (0.0, 5.0), 0.05, One)],
    grid: &one(&[0.2, 0.6, 1.2]),
    apply: |plant, place, v| {
        for &l in &place.items {
            let water = &mut plant.lane.water[l];
            water.added_mass_y += v[0] as f32;
            water.added_mass_z += v[0] as f32;
            water.added_inertia_y += v[0] as f32;
            water.added_inertia_z += v[0] as f32;
        }
    },
    look_alikes: "quadratic_drag armature link_mass",
    trial: "swim_sizes",
    signature: "shifts the phase without net work, in water only",
    ..OF_WATER
};

pub static BUOYANCY: Effect = Effect {
    id: "buoyancy",
    parameters: &[parameter("scale", "", 1.0, (0.3, 3.0), 0.03, One)],
    grid: &one(&[0.75, 0.9, 1.1, 1.3]),
    apply: |plant, place, v| place.each(|l| plant.lane.water[l].buoyancy_scale *= v[0] as f32),
    look_alikes: "water_level payload link_mass",
    trial: "float",
    signature: "floats higher or deeper at rest",
    ..OF_WATER
};

pub static BUOYANCY_CENTRE: Effect = Effect {
    id: "buoyancy_centre",
    parameters: &[
        parameter("x_m", "m", 0.0, (-0.1, 0.1), 0.002, One),
        parameter("z_m", "m", 0.0, (-0.1, 0.1), 0.002, One),
    ],
    grid: &[&[-0.01, 0.0], &[0.01, 0.0], &[0.0, -0.01], &[0.0, 0.01]],
    apply: |plant, place, v| {
        for &l in &place.items {
            let water = &mut plant.lane.water[l];
            water.buoyancy_x_m += v[0] as f32;
            water.buoyancy_z_m += v[1] as f32;
        }
    },
    look_alikes: "link_com payload",
    trial: "float",
    signature: "the attitude at rest in the water changes",
    ..OF_WATER
};

pub static HEAVE_DAMPING: Effect = Effect {
    id: "heave_damping",
    parameters: &[parameter("extra_ns_per_m", "N·s/m", 0.0, (-1.0, 50.0), 0.2, One)],
    grid: &one(&[-0.8, 1.0, 3.0, 10.0]),
    apply: |plant, place, v| {
        for &l in &place.items {
            let damping = &mut plant.lane.water[l].heave_damping_ns_per_m;
            *damping = (*damping + v[0] as f32).max(0.0);
        }
    },
    look_alikes: "linear_drag quadratic_drag",
    trial: "bob",
    signature: "how fast bobbing dies",
    ..OF_WATER
};

pub static WATER_CURRENT: Effect = Effect {
    id: "water_current",
    domain: Domain::Robot,
    parameters: &[
        parameter("x_mps", "m/s", 0.0, (-2.0, 2.0), 0.01, One),
        parameter("y_mps", "m/s", 0.0, (-2.0, 2.0), 0.01, One),
    ],
    grid: &[&[-0.05, 0.0], &[0.05, 0.0], &[0.0, -0.05], &[0.0, 0.05]],
    apply: |plant, _, v| {
        plant.lane.water_current_mps[0] += v[0] as f32;
        plant.lane.water_current_mps[1] += v[1] as f32;
    },
    look_alikes: "quadratic_drag",
    trial: "coast",
    signature: "the robot drifts without doing anything",
    ..OF_WATER
};

pub static WATER_LEVEL: Effect = Effect {
    id: "water_level",
    domain: Domain::Robot,
    parameters: &[parameter("offset_m", "m", 0.0, (-0.3, 0.3), 0.004, One)],
    grid: &one(&[-0.03, -0.01, 0.01, 0.03]),
    apply: |plant, _, v| plant.lane.water_level_offset_m += v[0] as f32,
    look_alikes: "buoyancy",
    trial: "float",
    signature: "everything wet begins at another depth",
    ..OF_WATER
};
