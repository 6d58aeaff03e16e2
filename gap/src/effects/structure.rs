//! Play, springs, stops (R1, R3, R4).

use super::effect::Reference::{Angle, Gain, One};
use super::effect::{Effect, Layer, PLAIN, one, parameter};
use crate::place::Domain;
use crate::trial::Kind;

const OF_STRUCTURE: Effect = Effect { layer: Layer::Structure, domain: Domain::Joints, ..PLAIN };

pub static GIRDLE_PLAY: Effect = Effect {
    id: "girdle_play",
    domain: Domain::Play,
    parameters: &[parameter("half_width_rad", "rad", f64::NAN, (0.0, 0.25), 0.004, One)],
    grid: &one(&[0.0, 0.008, 0.017, 0.035, 0.052, 0.07, 0.09, 0.12, 0.16, 0.2]),
    hinge: true,
    apply: |plant, place, v| {
        place.each(|b| plant.lane.backlash_half_width_rad[b] = (v[0] as f32).clamp(0.0, 1.0))
    },
    look_alikes: "imu_tilt contact_friction payload",
    unseen: |e, _| {
        let sees = [Kind::Gyro, Kind::Acceleration, Kind::Gravity, Kind::Foot, Kind::BaseAttitude];
        (!sees.iter().any(|k| e.has(*k))).then_some(
            "play behind the joint encoders is invisible in joint signals; record the IMU, feet or motion capture",
        )
    },
    trial: "rock_x",
    signature: "the body tips between two stops with the sign of its load; joint encoders see nothing",
    ..OF_STRUCTURE
};

pub static PARALLEL_SPRING: Effect = Effect {
    id: "parallel_spring",
    parameters: &[
        parameter("stiffness_nm_per_rad", "N·m/rad", 0.0, (0.0, 3.0), 0.006, Gain),
        parameter("rest_rad", "rad", 0.0, (-2.0, 2.0), 0.03, Angle),
    ],
    grid: &[&[0.02, 0.0], &[0.02, 0.6], &[0.02, -0.6], &[0.08, 0.0], &[0.08, 0.6], &[0.08, -0.6]],
    apply: |plant, place, v| {
        for &a in &place.items {
            let joint = &mut plant.lane.joints[a];
            // two springs in parallel: stiffnesses add, the rest position is their weighted mean
            let (own, rest) = (joint.spring_nm_per_rad, joint.spring_rest_rad);
            let both = own + v[0] as f32;
            if both > 0.0 {
                joint.spring_rest_rad = (own * rest + (v[0] * v[1]) as f32) / both;
            }
            joint.spring_nm_per_rad = both;
        }
    },
    look_alikes: "link_com link_mass encoder_offset direction_asymmetry kp_error",
    trial: "holds",
    signature: "torque where gravity has no lever; the same however the robot is turned",
    ..OF_STRUCTURE
};

/// Measured for itself, where angles pass a stop: no motion within the stops shows it.
pub static PASSED_STOP: Effect = Effect {
    id: "passed_stop",
    parameters: &[
        parameter("below_rad", "rad", 0.0, (0.0, 20.0), 0.005, One),
        parameter("above_rad", "rad", 0.0, (0.0, 20.0), 0.005, One),
    ],
    grid: &[&[0.3, 0.3]],
    hinge: true,
    apply: |plant, place, v| {
        for &a in &place.items {
            let joint = &mut plant.lane.joints[a];
            joint.low_rad -= v[0] as f32;
            joint.high_rad += v[1] as f32;
        }
    },
    trial: "sweep_full",
    signature: "angles are measured beyond the end stop of the robot file",
    ..OF_STRUCTURE
};

/// A stop that is nearer or farther than the file's.
pub static HARD_STOP: Effect = Effect {
    id: "hard_stop",
    parameters: &[
        parameter("low_rad", "rad", -4.0, (-4.0, 4.0), 0.005, One),
        parameter("high_rad", "rad", 4.0, (-4.0, 4.0), 0.005, One),
    ],
    grid: &[
        &[-4.0, 0.2],
        &[-4.0, 0.4],
        &[-4.0, 0.55],
        &[-4.0, 0.7],
        &[-4.0, 0.85],
        &[-4.0, 1.0],
        &[-4.0, 1.2],
        &[-4.0, 1.4],
        &[-4.0, 1.65],
        &[-4.0, 1.9],
        &[-4.0, 2.15],
        &[-0.2, 4.0],
        &[-0.4, 4.0],
        &[-0.55, 4.0],
        &[-0.7, 4.0],
        &[-0.85, 4.0],
        &[-1.0, 4.0],
        &[-1.2, 4.0],
        &[-1.4, 4.0],
        &[-1.65, 4.0],
        &[-1.9, 4.0],
        &[-2.15, 4.0],
    ],
    hinge: true,
    ends: true,
    apply: |plant, place, v| {
        for &a in &place.items {
            let joint = &mut plant.lane.joints[a];
            joint.low_rad = joint.low_rad.max(v[0] as f32);
            joint.high_rad = joint.high_rad.min(v[1] as f32).max(joint.low_rad);
        }
    },
    look_alikes: "torque_limit parallel_spring",
    trial: "sweep_full",
    signature: "the joint never passes an angle, and current surges there",
    ..OF_STRUCTURE
};
