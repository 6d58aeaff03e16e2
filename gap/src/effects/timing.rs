//! When commands arrive and readings were taken (T1 to T8).

use caudata_sim::{MAX_COMMAND_DELAY_S, MAX_LOOP_DELAY_S};

use super::effect::Reference::{One, Speed};
use super::effect::{Effect, Layer, PLAIN, needs_motion, one, parameter};
use crate::excitation::Excitation;
use crate::place::{Domain, Place};

fn needs_commands(e: &Excitation, _: &Place) -> Option<&'static str> {
    (e.fastest_command_radps < 0.2).then_some("commands hardly change in these runs")
}

const OF_TIMING: Effect =
    Effect { layer: Layer::Timing, domain: Domain::Robot, unseen: needs_commands, ..PLAIN };

/// Delays that are tried, s.
const DELAYS_S: [f64; 8] = [0.002, 0.004, 0.008, 0.014, 0.022, 0.035, 0.055, 0.08];

pub static COMMAND_DELAY: Effect = Effect {
    id: "command_delay",
    parameters: &[parameter("delay_s", "s", 0.0, (0.0, 0.1), 0.002, One)],
    grid: &one(&DELAYS_S),
    apply: |plant, _, v| {
        let lane = &mut plant.lane;
        lane.command_delay_s = (lane.command_delay_s + v[0] as f32).clamp(0.0, MAX_COMMAND_DELAY_S);
    },
    look_alikes: "command_low_pass measurement_delay servo_loop_delay bus_skew profile_limit",
    trial: "chirp_medium",
    signature: "phase falls in proportion to frequency with gain 1; what happens without a command is not shifted",
    ..OF_TIMING
};

/// Below zero readings are newer than their stamp: the loop takes the time, sends its commands, and reads.
pub static MEASUREMENT_DELAY: Effect = Effect {
    id: "measurement_delay",
    parameters: &[parameter("delay_s", "s", 0.0, (-0.02, 0.1), 0.002, One)],
    grid: &one(&DELAYS_S),
    apply: |plant, _, v| plant.sensing.measurement_delay_s += v[0] as f32,
    look_alikes: "command_delay command_low_pass clock_drift",
    trial: "drop_high",
    signature: "as a command delay, but what happens without a command is shifted too",
    ..OF_TIMING
};

pub static BUS_SKEW: Effect = Effect {
    id: "bus_skew",
    parameters: &[parameter("per_joint_s", "s", 0.0, (0.0, 0.006), 0.0003, One)],
    grid: &one(&[0.0005, 0.001, 0.002, 0.004]),
    apply: |plant, _, v| {
        for (a, joint) in plant.lane.joints.iter_mut().enumerate() {
            joint.command_skew_s =
                (joint.command_skew_s + a as f32 * v[0] as f32).clamp(0.0, MAX_COMMAND_DELAY_S);
        }
    },
    look_alikes: "command_delay",
    unseen: |e, _| (e.joints.len() < 2).then_some("one joint alone shows no pattern along the bus"),
    trial: "chirp_medium",
    signature: "the lag grows along the bus",
    ..OF_TIMING
};

/// Frames of the command that do not arrive, which a diagnosis also measures by what repeats differ by.
pub static DROPPED_FRAMES: Effect = Effect {
    id: "dropped_frames",
    parameters: &[
        parameter("share", "", 0.0, (0.0, 0.8), 0.03, One),
        parameter("burst", "", 1.0, (1.0, 30.0), 0.5, One),
    ],
    grid: &[&[0.05, 1.0], &[0.15, 1.0], &[0.3, 2.0], &[0.15, 5.0], &[0.3, 5.0]],
    hinge: true,
    apply: |plant, _, v| {
        plant.lane.command_loss.share = (v[0] as f32).clamp(0.0, 0.9);
        plant.lane.command_loss.burst = (v[1] as f32).clamp(1.0, 100.0);
    },
    look_alikes: "command_delay command_low_pass",
    trial: "chirp_medium",
    signature: "the command stands still at single ticks; a delay shifts all of them",
    ..OF_TIMING
};

pub static CLOCK_DRIFT: Effect = Effect {
    id: "clock_drift",
    parameters: &[parameter("drift", "", 0.0, (-0.02, 0.02), 0.000_1, One)],
    grid: &one(&[-0.003, -0.001, -0.0003, 0.0003, 0.001, 0.003]),
    apply: |plant, _, v| plant.sensing.clock_drift += v[0] as f32,
    look_alikes: "measurement_delay command_delay",
    unseen: |e, place| {
        let short = || (e.longest_s < 5.0).then_some("the runs are too short for a drift");
        needs_commands(e, place).or_else(short)
    },
    trial: "gait_long",
    signature: "the lag grows with the time since the start of the run",
    ..OF_TIMING
};

pub static COMMAND_LOW_PASS: Effect = Effect {
    id: "command_low_pass",
    domain: Domain::Joints,
    parameters: &[parameter("time_s", "s", 0.0, (0.0, 0.5), 0.003, One)],
    grid: &one(&[0.003, 0.006, 0.012, 0.025, 0.05, 0.1, 0.2]),
    apply: |plant, place, v| place.each(|a| plant.lane.joints[a].command_low_pass_s += v[0] as f32),
    look_alikes: "command_delay measurement_delay profile_limit kd_error servo_loop_delay",
    unseen: needs_motion,
    trial: "chirp_medium",
    signature: "gain falls with frequency as well as phase; steps are rounded",
    ..OF_TIMING
};

pub static PROFILE_LIMIT: Effect = Effect {
    id: "profile_limit",
    domain: Domain::Joints,
    parameters: &[
        parameter("speed_radps", "rad/s", 4.0, (0.03, 4.0), 0.03, Speed),
        parameter("acceleration_radps2", "rad/s²", 1000.0, (0.2, 1000.0), 0.5, Speed),
    ],
    grid: &[
        &[0.05, 1000.0],
        &[0.1, 1000.0],
        &[0.15, 1000.0],
        &[0.2, 1000.0],
        &[0.3, 1000.0],
        &[0.45, 1000.0],
        &[0.6, 1000.0],
        &[0.8, 1000.0],
        &[1.1, 1000.0],
        &[4.0, 2.0],
        &[4.0, 5.0],
        &[4.0, 12.0],
        &[4.0, 30.0],
        &[0.5, 8.0],
    ],
    hinge: true,
    apply: |plant, place, v| {
        for &a in &place.items {
            plant.lane.joints[a].profile_speed_radps = (v[0] as f32).clamp(0.0, 1000.0);
            plant.lane.joints[a].profile_acceleration_radps2 = (v[1] as f32).clamp(0.0, 1e6);
        }
    },
    look_alikes: "voltage_limit torque_limit command_low_pass supply_level",
    unseen: needs_motion,
    trial: "steps_medium",
    signature: "ramps of one slope after steps of any size, whatever load and voltage",
    ..OF_TIMING
};

pub static SERVO_LOOP_DELAY: Effect = Effect {
    id: "servo_loop_delay",
    domain: Domain::Joints,
    parameters: &[parameter("delay_s", "s", 0.0, (0.0, 0.05), 0.001, One)],
    grid: &one(&[0.001, 0.002, 0.004, 0.008, 0.015, 0.03]),
    apply: |plant, place, v| {
        for &a in &place.items {
            let joint = &mut plant.lane.joints[a];
            joint.loop_delay_s = (joint.loop_delay_s + v[0] as f32).clamp(0.0, MAX_LOOP_DELAY_S);
        }
    },
    look_alikes: "kd_error damping_lag command_low_pass gear_compliance gear_backlash",
    unseen: needs_motion,
    trial: "steps_medium",
    signature: "damping is lost, the more the higher the gain; a delay outside the loop only shifts",
    ..OF_TIMING
};
