//! Position loop and motor (A1 to A7, A11 to A16, A20).

use super::effect::Reference::{Angle, Damping, Gain, One, Torque};
use super::effect::{Effect, Layer, PLAIN, needs_motion, one, parameter};
use crate::place::Domain;

const OF_SERVOS: Effect = Effect { layer: Layer::Actuation, domain: Domain::Joints, ..PLAIN };

pub static KP_ERROR: Effect = Effect {
    id: "kp_error",
    // a gain noted in another unit is ten times off
    parameters: &[parameter("scale", "", 1.0, (0.05, 20.0), 0.04, One)],
    grid: &one(&[0.5, 0.75, 0.9, 1.1, 1.3, 1.7, 3.0, 8.0]),
    apply: |plant, place, v| place.each(|a| plant.lane.kp_nm_per_rad[a] *= v[0] as f32),
    look_alikes: "kd_error winding_resistance torque_constant controller_dead_band stale_gains duty_supply",
    corrects: "control.kp_nm_per_rad",
    trial: "holds",
    signature: "the droop under load changes; nothing in time touches it",
    ..OF_SERVOS
};

pub static KD_ERROR: Effect = Effect {
    id: "kd_error",
    parameters: &[parameter("extra_nms_per_rad", "N·m·s/rad", 0.0, (-1.5, 6.0), 0.1, Damping)],
    grid: &one(&[-0.5, -0.2, 0.2, 0.6, 1.5, 3.0]),
    apply: |plant, place, v| {
        for &a in &place.items {
            // what the gain does not hold comes off the servo's own damping
            let kd = plant.lane.kd_nms_per_rad[a] + v[0] as f32;
            plant.lane.kd_nms_per_rad[a] = kd.max(0.0);
            let own = &mut plant.lane.joints[a].kd_min_nms_per_rad;
            *own = (*own + kd.min(0.0)).max(0.0);
        }
    },
    look_alikes: "viscous_friction kp_error damping_on_error command_low_pass servo_loop_delay torque_constant supply_level",
    corrects: "control.kd_nm_s_per_rad kd_min_nm_s_per_rad",
    unseen: needs_motion,
    trial: "steps_medium",
    signature: "overshoot changes and the droop does not; friction adds current at constant speed instead",
    ..OF_SERVOS
};

pub static DAMPING_ON_ERROR: Effect = Effect {
    id: "damping_on_error",
    parameters: &[
        parameter("share", "", 0.0, (0.0, 1.0), 0.1, One),
        // over which the loop takes the rate
        parameter("over_s", "s", 0.001, (0.0002, 0.03), 0.01, One),
    ],
    grid: &[&[0.5, 0.001], &[1.0, 0.001], &[0.5, 0.005], &[1.0, 0.005], &[1.0, 0.015]],
    of_servo: |servo| !servo.kd_acts_on_error,
    apply: |plant, place, v| {
        for &a in &place.items {
            let joint = &mut plant.lane.joints[a];
            joint.kd_on_command = (joint.kd_on_command + v[0] as f32).clamp(0.0, 1.0);
            joint.kd_rate_over_s = v[1] as f32;
        }
    },
    look_alikes: "kd_error measurement_delay command_delay command_low_pass",
    corrects: "kd_acts_on_error",
    unseen: needs_motion,
    trial: "steps_medium",
    signature: "the loop damps the rate of the error: a moving command is not braked, and a step of it kicks",
    ..OF_SERVOS
};

/// A low-pass on the speed that the loop damps. A short one is an inertia of −Kd·time.
pub static DAMPING_LAG: Effect = Effect {
    id: "damping_lag",
    parameters: &[
        parameter("time_s", "s", 0.0, (0.0, 0.05), 0.0005, One),
        // 1: the speed that a servo reports is that one; 0: it has no such lag
        parameter("reported", "", 0.0, (0.0, 1.0), 0.2, One),
    ],
    grid: &[
        &[0.0005, 0.0],
        &[0.001, 0.0],
        &[0.002, 0.0],
        &[0.002, 1.0],
        &[0.004, 0.0],
        &[0.004, 1.0],
        &[0.008, 0.0],
        &[0.008, 1.0],
        &[0.016, 0.0],
        &[0.016, 1.0],
    ],
    apply: |plant, place, v| {
        for &a in &place.items {
            // a loop without damping, among those of a robot, filters no speed
            if plant.lane.kd_nms_per_rad[a] > 0.0 {
                plant.lane.joints[a].damping_lag_s += v[0] as f32;
                plant.sensing.velocity_lag_s[a] += (v[0] * v[1]) as f32;
            }
        }
    },
    look_alikes: "armature servo_loop_delay link_inertia kd_error damping_on_error velocity_lag gear_compliance",
    of_runs: |e| e.joints.iter().any(|j| j.kd_nms_per_rad > 0.0),
    unseen: |e, place| {
        let all_free = place.items.iter().all(|&a| e.joints[a].kd_nms_per_rad == 0.0);
        all_free.then_some("the loop does not damp there").or_else(|| needs_motion(e, place))
    },
    trial: "chirp_large",
    signature: "as a lighter rotor, the more the higher Kd; a joint without torque has its full inertia",
    ..OF_SERVOS
};

pub static INTEGRAL_ACTION: Effect = Effect {
    id: "integral_action",
    parameters: &[parameter("ki_nm_per_rad_s", "N·m/(rad·s)", 0.0, (0.0, 10.0), 0.05, Gain)],
    grid: &one(&[0.1, 0.3, 1.0, 3.0]),
    apply: |plant, place, v| place.each(|a| plant.lane.joints[a].ki_nm_per_rad_s += v[0] as f32),
    look_alikes: "kp_error thermal_derating",
    trial: "holds_long",
    signature: "the droop goes away within seconds",
    ..OF_SERVOS
};

pub static TORQUE_CONSTANT: Effect = Effect {
    id: "torque_constant",
    parameters: &[parameter("scale", "", 1.0, (0.4, 2.5), 0.04, One)],
    grid: &one(&[0.6, 0.8, 0.9, 1.1, 1.25, 1.5]),
    apply: |plant, place, v| {
        // volts make current through R, current makes torque through k_t, speed makes volts through the same
        // constant
        let s = v[0] as f32;
        for &a in &place.items {
            plant.lane.kp_nm_per_rad[a] *= s;
            plant.lane.kd_nms_per_rad[a] *= s;
            plant.lane.torque_scale[a] *= s;
            let joint = &mut plant.lane.joints[a];
            joint.kd_min_nms_per_rad *= s * s;
            joint.speed_scale /= s;
            joint.torque_constant_nm_per_a *= s;
        }
    },
    look_alikes: "winding_resistance kp_error current_bias load_dependent_friction link_mass point_mass",
    corrects: "tau_max_nm torque_per_current_nm_per_a qd_max_radps",
    trial: "holds",
    signature: "torque per ampere changes in loaded holds, and the speed without load the other way",
    ..OF_SERVOS
};

pub static WINDING_RESISTANCE: Effect = Effect {
    id: "winding_resistance",
    parameters: &[parameter("scale", "", 1.0, (0.4, 3.0), 0.04, One)],
    grid: &one(&[0.6, 0.8, 0.9, 1.1, 1.3, 1.7]),
    apply: |plant, place, v| place.each(|a| plant.lane.joints[a].winding_scale *= v[0] as f32),
    look_alikes: "torque_saturation kp_error torque_constant load_dependent_friction supply_level stale_gains duty_supply",
    corrects: "qd_tau_max_radps qd_max_radps",
    trial: "steps_loaded",
    signature: "more droop at stall with the same current per torque; the speed without load is as it was",
    ..OF_SERVOS
};

pub static TORQUE_LIMIT: Effect = Effect {
    id: "torque_limit",
    parameters: &[
        parameter("limit_nm", "N·m", 1.1, (0.05, 1.1), 0.03, Torque),
        // 0: against the motion as with it (a limit of the current); 1: against the motion what the servo
        // gives without it
        parameter("braking_freed", "", 0.0, (0.0, 1.0), 0.1, One),
    ],
    grid: &[
        &[0.1, 0.0],
        &[0.15, 0.0],
        &[0.15, 1.0],
        &[0.2, 0.0],
        &[0.25, 0.0],
        &[0.25, 1.0],
        &[0.3, 0.0],
        &[0.36, 0.0],
        &[0.36, 1.0],
        &[0.43, 0.0],
        &[0.5, 0.0],
        &[0.5, 1.0],
        &[0.58, 0.0],
        &[0.66, 0.0],
        &[0.66, 1.0],
        &[0.75, 0.0],
        &[0.85, 0.0],
        &[0.85, 1.0],
        &[0.95, 0.0],
    ],
    hinge: true,
    apply: |plant, place, v| {
        for &a in &place.items {
            let servo = plant.model.servo(a);
            let joint = &mut plant.lane.joints[a];
            let (idle_a, constant) = (joint.current_dead_band_a, joint.torque_constant_nm_per_a);
            let at = |torque_nm: f64| idle_a + torque_nm as f32 / constant;
            // against the motion a robot may have a limit of its own
            let own_nm = match f64::from(joint.current_limit_a) {
                own_a if own_a > 0.0 => (own_a - f64::from(idle_a)) * f64::from(constant),
                _ => servo.tau_brake_max_nm,
            };
            let unlimited_nm = own_nm.max(v[0]);
            joint.current_limit_a = at(v[0]);
            joint.braking_current_limit_a = at(v[0] + v[1] * (unlimited_nm - v[0]));
        }
    },
    look_alikes: "voltage_limit motor_torque supply_level profile_limit thermal_derating",
    corrects: "tau_max_nm tau_brake_max_nm",
    unseen: |e, place| {
        (e.most_torque_share(place) < 0.1).then_some("the servo never works hard in these runs")
    },
    trial: "steps_loaded",
    signature: "current is cut flat, at any speed; where the motor brakes perhaps less, or not at all",
    ..OF_SERVOS
};

pub static MOTOR_TORQUE: Effect = Effect {
    id: "motor_torque",
    parameters: &[parameter("scale", "", 1.0, (0.2, 3.0), 0.03, One)],
    grid: &one(&[0.25, 0.35, 0.5, 0.65, 0.8, 0.9, 1.3, 1.8]),
    hinge: true,
    apply: |plant, place, v| place.each(|a| plant.lane.torque_scale[a] *= v[0] as f32),
    look_alikes: "torque_limit winding_resistance voltage_limit supply_level supply_sag torque_saturation",
    corrects: "tau_max_nm tau_brake_max_nm tau_qd_max_nm",
    unseen: |e, place| {
        (e.most_torque_share(place) < 0.1).then_some("the servo never works hard in these runs")
    },
    trial: "steps_large",
    signature: "all limits of torque by one factor, at any speed; the speed without load is as it was",
    ..OF_SERVOS
};

pub static TORQUE_SATURATION: Effect = Effect {
    id: "torque_saturation",
    parameters: &[parameter("drop", "", 0.0, (0.0, 0.8), 0.04, One)],
    grid: &one(&[0.1, 0.2, 0.35, 0.5, 0.65]),
    apply: |plant, place, v| {
        for &a in &place.items {
            // the servo's greatest torque falls by this share, less torque by less
            let drop = v[0].clamp(0.0, 0.9);
            let most_nm = plant.model.servo(a).tau_max_nm * f64::from(plant.lane.torque_scale[a]);
            plant.lane.joints[a].torque_saturation_per_nm =
                (drop / (1.0 - drop) / most_nm.max(1e-6)) as f32;
        }
    },
    look_alikes: "winding_resistance torque_constant torque_limit load_dependent_friction supply_sag voltage_limit",
    corrects: "tau_max_nm",
    unseen: |e, place| {
        (e.most_torque_share(place) < 0.2).then_some("the servo never works hard in these runs")
    },
    trial: "steps_loaded",
    signature: "torque falls behind in proportion to itself: small errors are answered in full, large ones less and less, at any speed",
    ..OF_SERVOS
};

pub static VOLTAGE_LIMIT: Effect = Effect {
    id: "voltage_limit",
    parameters: &[parameter("duty", "", 1.05, (0.1, 1.3), 0.03, One)],
    grid: &one(&[0.15, 0.22, 0.3, 0.38, 0.46, 0.54, 0.62, 0.7, 0.8, 0.9, 1.2]),
    hinge: true,
    apply: |plant, place, v| place.each(|a| plant.lane.joints[a].voltage_share *= v[0] as f32),
    look_alikes: "supply_level torque_limit profile_limit supply_sag",
    corrects: "qd_tau_max_radps qd_max_radps tau_qd_max_nm",
    unseen: needs_motion,
    trial: "steps_large",
    signature: "torque is cut along a line that falls with speed",
    ..OF_SERVOS
};

pub static CONTROLLER_DEAD_BAND: Effect = Effect {
    id: "controller_dead_band",
    parameters: &[
        parameter("half_width_rad", "rad", 0.0, (0.0, 0.2), 0.001, Angle),
        // 0: outside the band the controller acts on what is over; 1: on the whole error
        parameter("jump", "", 0.0, (0.0, 1.0), 0.1, One),
    ],
    grid: &[
        &[0.002, 0.0],
        &[0.002, 1.0],
        &[0.004, 0.0],
        &[0.004, 1.0],
        &[0.007, 0.0],
        &[0.007, 1.0],
        &[0.012, 0.0],
        &[0.012, 1.0],
        &[0.02, 0.0],
        &[0.02, 1.0],
        &[0.035, 0.0],
        &[0.035, 1.0],
        &[0.06, 0.0],
        &[0.06, 1.0],
        &[0.1, 0.0],
        &[0.1, 1.0],
    ],
    hinge: true,
    apply: |plant, place, v| {
        for &a in &place.items {
            let joint = &mut plant.lane.joints[a];
            joint.dead_band_rad += v[0] as f32;
            joint.dead_band_jump = v[1] as f32;
        }
    },
    look_alikes: "coulomb_friction kp_error gear_backlash stribeck_friction",
    trial: "triangle_slow",
    signature: "a steady error without current, up to the same width whatever the gain",
    ..OF_SERVOS
};

pub static BRAKING_ASYMMETRY: Effect = Effect {
    id: "braking_asymmetry",
    parameters: &[
        parameter("brake_scale", "", 1.0, (0.02, 1.5), 0.05, One),
        parameter("back_drive_kp_ratio", "", 1.0, (0.1, 3.0), 0.05, One),
    ],
    grid: &[
        &[0.1, 1.0],
        &[0.2, 1.0],
        &[0.3, 1.0],
        &[0.4, 1.0],
        &[0.55, 1.0],
        &[0.7, 1.0],
        &[1.0, 0.5],
        &[1.0, 0.8],
        &[1.0, 1.3],
        &[1.0, 1.8],
    ],
    hinge: true,
    apply: |plant, place, v| {
        for &a in &place.items {
            let joint = &mut plant.lane.joints[a];
            joint.brake_scale *= v[0] as f32;
            joint.back_drive_kp_ratio *= v[1] as f32;
        }
    },
    look_alikes: "drive_asymmetry torque_limit viscous_friction",
    corrects: "tau_brake_max_nm back_drive_kp_ratio",
    unseen: needs_motion,
    trial: "reversals_fast",
    signature: "only where torque is against the motion",
    ..OF_SERVOS
};

pub static STALE_GAINS: Effect = Effect {
    id: "stale_gains",
    parameters: &[parameter("ratio", "", 1.0, (0.1, 8.0), 0.1, One)],
    grid: &one(&[0.25, 0.5, 2.0, 4.0]),
    hinge: true,
    apply: |plant, place, v| {
        for &a in &place.items {
            plant.lane.kp_nm_per_rad[a] *= v[0] as f32;
            plant.lane.kd_nms_per_rad[a] *= v[0] as f32;
        }
    },
    look_alikes: "kp_error winding_resistance",
    corrects: "control.kp_nm_per_rad control.kd_nm_s_per_rad",
    trial: "steps_medium",
    signature: "both gains by one factor, as of another register",
    ..OF_SERVOS
};
