//! Gears (X8 to X10).

use super::effect::Reference::{Angle, AngleSquared, One, Torque};
use super::effect::{Effect, Layer, PLAIN, needs_motion, one, parameter, rows};
use crate::place::Domain;

const OF_GEARS: Effect =
    Effect { layer: Layer::Transmission, domain: Domain::Joints, unseen: needs_motion, ..PLAIN };

pub static GEAR_BACKLASH: Effect = Effect {
    id: "gear_backlash",
    parameters: &[parameter("gap_rad", "rad", 0.0, (0.0, 0.3), 0.002, Angle)],
    grid: &one(&[0.003, 0.006, 0.01, 0.015, 0.022, 0.032, 0.045, 0.065, 0.1]),
    hinge: true,
    apart: true,
    apply: |plant, place, v| {
        for &a in &place.items {
            plant.lane.joints[a].gear_half_gap_rad += 0.5 * v[0] as f32;
            let rotor = &mut plant.lane.joint_armature_kgm2[a];
            *rotor = rotor.max(1e-4);
        }
    },
    look_alikes: "gear_compliance controller_dead_band pre_sliding servo_loop_delay",
    corrects: "gear_backlash_rad",
    trial: "micro",
    signature: "free travel without torque, of the same width at any load; current reverses before the joint does",
    ..OF_GEARS
};

pub static PLAY_BEHIND_ENCODER: Effect = Effect {
    id: "play_behind_encoder",
    of_servo: |servo| servo.encoder.is_none(),
    apply: |plant, place, v| {
        (GEAR_BACKLASH.apply)(plant, place, v);
        place.each(|a| plant.lane.joints[a].motor_encoder = 1.0);
    },
    look_alikes: "gear_backlash gear_compliance pre_sliding servo_loop_delay armature",
    signature: "the same where the encoder is on the motor: what hangs on the joint follows late and unseen, a light motor before it",
    ..GEAR_BACKLASH
};

pub static GEAR_COMPLIANCE: Effect = Effect {
    id: "gear_compliance",
    parameters: &[
        parameter("compliance_rad_per_nm", "rad/(N·m)", 0.0, (0.0005, 0.5), 0.002, AngleSquared),
        // of the rotor on that spring, of critical
        parameter("damping_ratio", "", 0.3, (0.0, 3.0), 0.05, One),
    ],
    grid: &[
        &[0.003, 0.3],
        &[0.01, 0.1],
        &[0.01, 0.3],
        &[0.02, 0.1],
        &[0.02, 0.3],
        &[0.04, 0.1],
        &[0.04, 0.3],
        &[0.08, 0.1],
        &[0.08, 0.3],
        &[0.15, 0.1],
        &[0.15, 0.3],
    ],
    hinge: true,
    apart: true,
    apply: |plant, place, v| {
        for &a in &place.items {
            let joint = &mut plant.lane.joints[a];
            joint.gear_stiffness_nm_per_rad = (1.0 / v[0].max(1e-5)) as f32;
            joint.gear_damping_ratio = v[1] as f32;
            let rotor = &mut plant.lane.joint_armature_kgm2[a];
            *rotor = rotor.max(1e-4);
        }
    },
    look_alikes: "gear_backlash pre_sliding servo_loop_delay armature",
    trial: "chirp_medium",
    signature: "deflection in proportion to torque; a resonance that moves with the load's inertia",
    ..OF_GEARS
};

/// Ripples that are tried: so many in a turn, each a quarter of its period on from the one before (what points
/// the other way is a negative share of these).
const RIPPLES: [[f64; 3]; 20] = {
    let per_turn = [4.0, 6.0, 8.0, 10.0, 12.0, 14.0, 16.0, 20.0, 24.0, 32.0];
    let mut all = [[0.0; 3]; 20];
    let mut k = 0;
    while k < all.len() {
        let [sin, cos] = [[0.02, 0.0], [0.0, 0.02]][k % 2];
        all[k] = [sin, cos, per_turn[k / 2]];
        k += 1;
    }
    all
};

pub static COGGING: Effect = Effect {
    id: "cogging",
    parameters: &[
        parameter("sin_nm", "N·m", 0.0, (-0.3, 0.3), 0.006, Torque),
        parameter("cos_nm", "N·m", 0.0, (-0.3, 0.3), 0.006, Torque),
        parameter("per_turn", "", 1.0, (3.0, 100.0), 0.05, One),
    ],
    grid: &rows(&RIPPLES),
    apply: |plant, place, v| {
        // A·sin(n·q + φ) = s·sin(n·q) + c·cos(n·q)
        for &a in &place.items {
            let joint = &mut plant.lane.joints[a];
            joint.ripple_nm = v[0].hypot(v[1]) as f32;
            joint.ripple_phase_rad = v[1].atan2(v[0]) as f32;
            joint.ripple_per_turn = v[2] as f32;
        }
    },
    look_alikes: "parallel_spring encoder_gain stribeck_friction",
    trial: "sweep_full",
    signature: "a torque that repeats with the angle, at any speed",
    ..OF_GEARS
};
