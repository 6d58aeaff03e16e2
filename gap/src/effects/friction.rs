//! Friction (X1 to X7, X11).

use super::effect::Reference::{Damping, One, Presliding, Speed, Torque};
use super::effect::{Effect, Layer, PLAIN, needs_motion, one, parameter};
use crate::place::{Domain, Place};
use crate::plant::Plant;

const OF_FRICTION: Effect =
    Effect { layer: Layer::Transmission, domain: Domain::Joints, unseen: needs_motion, ..PLAIN };

pub static COULOMB_FRICTION: Effect = Effect {
    id: "coulomb_friction",
    parameters: &[parameter("extra_nm", "N·m", 0.0, (-0.3, 0.5), 0.004, Torque)],
    grid: &one(&[-0.02, -0.008, 0.008, 0.02, 0.05, 0.1, 0.2]),
    apply: |plant, place, v| {
        for &a in &place.items {
            let friction = &mut plant.lane.joint_friction_nm[a];
            *friction = (*friction + v[0] as f32).max(0.0);
        }
    },
    look_alikes: "stribeck_friction viscous_friction load_dependent_friction controller_dead_band pre_sliding",
    corrects: "friction_loss_nm",
    trial: "triangle_slow",
    signature: "a jump of torque at every reversal, the same at any speed and load",
    ..OF_FRICTION
};

pub static VISCOUS_FRICTION: Effect = Effect {
    id: "viscous_friction",
    parameters: &[parameter("extra_nms_per_rad", "N·m·s/rad", 0.0, (-1.0, 4.0), 0.04, Damping)],
    grid: &one(&[-0.1, 0.1, 0.3, 0.8, 2.0]),
    apply: |plant, place, v| {
        for &a in &place.items {
            let damping = plant.lane.joint_damping_nms_per_rad[a] + v[0] as f32;
            plant.lane.joint_damping_nms_per_rad[a] = damping.max(0.0);
        }
    },
    look_alikes: "kd_error load_dependent_friction coulomb_friction torque_constant command_low_pass",
    corrects: "damping_nm_s_per_rad",
    trial: "chirp_medium",
    signature: "torque grows in proportion to speed, with the servo off as well",
    ..OF_FRICTION
};

pub static STRIBECK_FRICTION: Effect = Effect {
    id: "stribeck_friction",
    parameters: &[
        parameter("extra_nm", "N·m", 0.0, (0.0, 0.5), 0.004, Torque),
        parameter("speed_radps", "rad/s", 0.015, (0.001, 0.4), 0.002, Speed),
    ],
    grid: &[
        &[0.02, 0.005],
        &[0.02, 0.015],
        &[0.02, 0.05],
        &[0.06, 0.005],
        &[0.06, 0.015],
        &[0.06, 0.05],
        &[0.06, 0.15],
        &[0.15, 0.015],
        &[0.15, 0.05],
    ],
    hinge: true,
    apply: |plant, place, v| {
        for &a in &place.items {
            plant.lane.joints[a].stribeck_nm += v[0] as f32;
            plant.lane.joints[a].stribeck_speed_radps = (v[1] as f32).clamp(1e-3, 100.0);
        }
    },
    look_alikes: "load_stiction coulomb_friction pre_sliding controller_dead_band gear_backlash",
    trial: "triangle_slow",
    signature: "more friction at rest than in motion: stick and slip at low speed only",
    ..OF_FRICTION
};

/// Friction in proportion to the load, more while the motor drives it and while it drives the motor.
fn rub_under_load(plant: &mut Plant, place: &Place, driving: f64, driven: f64) {
    for &a in &place.items {
        let joint = &mut plant.lane.joints[a];
        let more = |share: f32, by: f64| (share + by as f32).clamp(0.0, 0.95);
        joint.load_friction_driving = more(joint.load_friction_driving, driving);
        joint.load_friction_driven = more(joint.load_friction_driven, driven);
    }
}

pub static LOAD_DEPENDENT_FRICTION: Effect = Effect {
    id: "load_dependent_friction",
    parameters: &[parameter("share", "", 0.0, (0.0, 0.9), 0.02, One)],
    grid: &one(&[0.05, 0.1, 0.2, 0.35, 0.55]),
    apply: |plant, place, v| rub_under_load(plant, place, v[0], v[0]),
    look_alikes: "load_stiction torque_saturation coulomb_friction viscous_friction drive_asymmetry winding_resistance torque_constant",
    trial: "lift_lower",
    signature: "the jump at a reversal grows with the load at the same speed",
    ..OF_FRICTION
};

pub static LOAD_STICTION: Effect = Effect {
    id: "load_stiction",
    parameters: &[
        parameter("share", "", 0.0, (0.0, 0.9), 0.03, One),
        parameter("speed_radps", "rad/s", 0.02, (0.001, 0.4), 0.004, Speed),
    ],
    grid: &[
        &[0.1, 0.005],
        &[0.1, 0.03],
        &[0.25, 0.005],
        &[0.25, 0.03],
        &[0.3, 0.2],
        &[0.5, 0.01],
        &[0.5, 0.05],
    ],
    hinge: true,
    apply: |plant, place, v| {
        for &a in &place.items {
            let joint = &mut plant.lane.joints[a];
            joint.load_stribeck = (joint.load_stribeck + v[0] as f32).clamp(0.0, 0.95);
            joint.stribeck_speed_radps = (v[1] as f32).clamp(1e-3, 100.0);
        }
    },
    look_alikes: "stribeck_friction load_dependent_friction coulomb_friction drive_asymmetry",
    trial: "lift_lower",
    signature: "a joint sticks the harder the more it carries, and lets go with a jerk; without load it does not stick",
    ..OF_FRICTION
};

pub static DRIVE_ASYMMETRY: Effect = Effect {
    id: "drive_asymmetry",
    parameters: &[
        parameter("driving", "", 0.0, (0.0, 0.9), 0.02, One),
        parameter("driven", "", 0.0, (0.0, 0.9), 0.02, One),
    ],
    grid: &[&[0.1, 0.0], &[0.3, 0.0], &[0.0, 0.1], &[0.0, 0.3], &[0.1, 0.3], &[0.3, 0.1]],
    apply: |plant, place, v| rub_under_load(plant, place, v[0], v[1]),
    look_alikes: "load_dependent_friction braking_asymmetry torque_constant direction_asymmetry",
    trial: "lift_lower",
    signature: "lifting and lowering the same load at the same speed lose differently",
    ..OF_FRICTION
};

pub static DIRECTION_ASYMMETRY: Effect = Effect {
    id: "direction_asymmetry",
    parameters: &[parameter("difference_nm", "N·m", 0.0, (-0.3, 0.3), 0.004, Torque)],
    grid: &one(&[-0.06, -0.015, 0.015, 0.06]),
    apply: |plant, place, v| {
        for &a in &place.items {
            let joint = &mut plant.lane.joints[a];
            joint.friction_asymmetry_nm += v[0] as f32;
            // friction cannot drive: what the heavy direction has more than the mean allows is added to the
            // mean
            let mean = &mut plant.lane.joint_friction_nm[a];
            *mean = mean.max(joint.friction_asymmetry_nm.abs());
        }
    },
    look_alikes: "encoder_offset parallel_spring floor_slope link_com drive_asymmetry",
    trial: "triangle_slow",
    signature: "heavier one way than the other, in every pose",
    ..OF_FRICTION
};

pub static PRE_SLIDING: Effect = Effect {
    id: "pre_sliding",
    parameters: &[parameter("way_rad", "rad", 0.002, (0.0002, 0.2), 0.002, Presliding)],
    grid: &one(&[0.0006, 0.006, 0.012, 0.025, 0.05, 0.1]),
    apply: |plant, place, v| {
        place.each(|a| plant.lane.joints[a].presliding_rad = (v[0] as f32).clamp(1e-7, 1.0))
    },
    look_alikes: "coulomb_friction stribeck_friction gear_compliance gear_backlash",
    trial: "micro",
    signature: "friction comes on like a spring after a reversal",
    ..OF_FRICTION
};

pub static FRICTION_DRIFT: Effect = Effect {
    id: "friction_drift",
    parameters: &[
        parameter("change_nm", "N·m", 0.0, (-0.3, 0.3), 0.006, Torque),
        parameter("run_in_nm", "N·m", 0.0, (-0.2, 0.3), 0.006, Torque),
        parameter("run_in_s", "s", 4.0, (0.5, 30.0), 0.5, One),
    ],
    grid: &[
        &[-0.05, 0.0, 4.0],
        &[-0.015, 0.0, 4.0],
        &[0.015, 0.0, 4.0],
        &[0.05, 0.0, 4.0],
        &[0.0, 0.03, 4.0],
        &[0.0, 0.1, 4.0],
        &[0.0, -0.02, 4.0],
    ],
    apply: |plant, place, v| {
        for &a in &place.items {
            let friction = &mut plant.lane.joint_friction_nm[a];
            *friction = (*friction + (v[0] * (plant.session - 0.5)) as f32).max(0.0);
            let run_in = &mut plant.run_in[a];
            run_in.extra_nm += v[1];
            run_in.time_s = v[2].max(0.05);
        }
    },
    drifts: true,
    look_alikes: "thermal_derating coulomb_friction",
    unseen: |e, place| {
        if e.runs < 3 && e.longest_s < 5.0 {
            Some(
                "a drift shows in runs of several seconds, or from the first to the last of three or more",
            )
        } else {
            needs_motion(e, place)
        }
    },
    trial: "gait_long",
    signature: "friction changes within every run as the joint warms, or from the first to the last run of the session",
    ..OF_FRICTION
};
