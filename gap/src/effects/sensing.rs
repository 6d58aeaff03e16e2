//! Encoders, velocity estimates, current sensing (S1, S2, S4, S5; and a current that is read behind a
//! filter).
//!
//! The encoder is inside the position loop: an offset moves the joint, not the reading.

use super::effect::Reference::{Angle, One};
use super::effect::{Effect, Layer, PLAIN, needs_motion, one, parameter};
use crate::place::Domain;
use crate::trial::Kind;

const OF_SENSORS: Effect = Effect { layer: Layer::Sensing, domain: Domain::Joints, ..PLAIN };

pub static ENCODER_OFFSET: Effect = Effect {
    id: "encoder_offset",
    parameters: &[parameter("offset_rad", "rad", 0.0, (-0.6, 0.6), 0.005, Angle)],
    grid: &one(&[-0.25, -0.05, -0.02, 0.02, 0.05, 0.25]),
    apply: |plant, place, v| place.each(|a| plant.sensing.encoders[a].offset_rad += v[0] as f32),
    look_alikes: "link_com parallel_spring floor_slope direction_asymmetry",
    trial: "holds",
    signature: "the gravity curve of current against angle is shifted; independent of speed and direction",
    ..OF_SENSORS
};

pub static ENCODER_GAIN: Effect = Effect {
    id: "encoder_gain",
    parameters: &[parameter("gain", "", 0.0, (-0.35, 0.35), 0.005, One)],
    grid: &one(&[-0.1, -0.05, -0.02, 0.02, 0.05, 0.1]),
    apply: |plant, place, v| place.each(|a| plant.sensing.encoders[a].gain += v[0] as f32),
    look_alikes: "link_mass link_com point_mass viscous_friction torque_constant",
    unseen: needs_motion,
    trial: "holds",
    signature: "grows with the angle; shows against motion capture, only weakly against current",
    ..OF_SENSORS
};

pub static VELOCITY_LAG: Effect = Effect {
    id: "velocity_lag",
    parameters: &[parameter("time_s", "s", 0.0, (0.0, 0.2), 0.003, One)],
    grid: &one(&[0.005, 0.01, 0.02, 0.04, 0.08]),
    apply: |plant, place, v| place.each(|a| plant.sensing.velocity_lag_s[a] += v[0] as f32),
    look_alikes: "measurement_delay",
    unseen: |e, place| {
        if e.has(Kind::Velocity) {
            needs_motion(e, place)
        } else {
            Some("no velocities were recorded")
        }
    },
    trial: "chirp_medium",
    signature: "the reported velocity lags behind the derivative of the reported position; positions are untouched",
    ..OF_SENSORS
};

pub static CURRENT_BIAS: Effect = Effect {
    id: "current_bias",
    parameters: &[
        parameter("bias_a", "A", 0.0, (-0.5, 0.5), 0.01, One),
        parameter("gain", "", 0.0, (-0.6, 0.6), 0.04, One),
    ],
    grid: &[&[-0.05, 0.0], &[0.05, 0.0], &[0.0, -0.15], &[0.0, 0.15]],
    apply: |plant, place, v| {
        for &a in &place.items {
            plant.sensing.currents[a].bias_a += v[0] as f32;
            plant.sensing.currents[a].gain += v[1] as f32;
        }
    },
    look_alikes: "torque_constant",
    corrects: "torque_per_current_nm_per_a current_dead_band_a",
    unseen: |e, _| (!e.has(Kind::Current)).then_some("no currents were recorded"),
    trial: "holds",
    signature: "only the current reading is off; the motion is as simulated",
    ..OF_SENSORS
};

pub static CURRENT_LAG: Effect = Effect {
    id: "current_lag",
    parameters: &[
        parameter("time_s", "s", 0.0, (0.0, 0.2), 0.005, One),
        parameter("delay_s", "s", 0.0, (-0.01, 0.1), 0.003, One),
    ],
    grid: &[
        &[0.005, 0.0],
        &[0.01, 0.0],
        &[0.02, 0.0],
        &[0.04, 0.0],
        &[0.08, 0.0],
        &[0.0, -0.003],
        &[0.0, 0.005],
        &[0.0, 0.01],
        &[0.0, 0.02],
    ],
    apply: |plant, place, v| {
        for &a in &place.items {
            plant.sensing.current_lag_s[a] += v[0] as f32;
            plant.sensing.current_delay_s[a] += v[1] as f32;
        }
    },
    look_alikes: "torque_constant current_bias measurement_delay",
    unseen: |e, place| {
        if e.has(Kind::Current) {
            needs_motion(e, place)
        } else {
            Some("no currents were recorded")
        }
    },
    trial: "chirp_medium",
    signature: "the current lags behind what the motion needs (behind a filter its peaks are rounded as well); positions are untouched",
    ..OF_SENSORS
};
