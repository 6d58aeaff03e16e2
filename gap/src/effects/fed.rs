//! What is commanded beside positions, and what pushes from outside, is not what the log says (A17 to A19).

use super::effect::Reference::One;
use super::effect::{Effect, Layer, PLAIN, ParameterSpec, one, parameter};
use crate::place::Domain;

/// The share of what is noted that acts. Shares add up, so that one in a robot file can be undone.
const SHARE: &[ParameterSpec] = &[parameter("share", "", 1.0, (-2.0, 3.0), 0.05, One)];

/// The other way round, nothing of it, a part, more.
const NOTED_SHARES: [f64; 6] = [-1.0, 0.0, 0.5, 0.8, 1.25, 2.0];

const OF_COMMANDS: Effect =
    Effect { layer: Layer::Actuation, domain: Domain::Joints, hinge: true, ..PLAIN };

pub static FED_TORQUE: Effect = Effect {
    id: "fed_torque",
    parameters: SHARE,
    grid: &one(&NOTED_SHARES),
    apply: |plant, place, v| place.each(|a| plant.fed_torque[a] += v[0] - 1.0),
    look_alikes: "link_mass link_com point_mass torque_constant kp_error",
    of_runs: |e| e.joints.iter().any(|j| j.fed_nm > 0.0),
    unseen: |e, place| {
        let any_bare = place.items.iter().any(|&a| e.joints[a].fed_nm == 0.0);
        any_bare.then_some("no torque is commanded there")
    },
    trial: "holds",
    signature: "what is off goes with the commanded torque, whatever the joint does",
    ..OF_COMMANDS
};

pub static FED_SPEED: Effect = Effect {
    id: "fed_speed",
    parameters: SHARE,
    grid: &one(&NOTED_SHARES),
    apply: |plant, place, v| place.each(|a| plant.fed_speed[a] += v[0] - 1.0),
    look_alikes: "kd_error damping_on_error command_delay viscous_friction",
    of_runs: |e| e.joints.iter().any(|j| j.fed_radps > 0.0),
    unseen: |e, place| {
        let any_bare = place.items.iter().any(|&a| e.joints[a].fed_radps == 0.0);
        any_bare.then_some("no speed is commanded there")
    },
    trial: "chirp_medium",
    signature: "what is off goes with the commanded speed; a damping that is off goes with the joint's",
    ..OF_COMMANDS
};

pub static OUTER_FORCE: Effect = Effect {
    id: "outer_force",
    layer: Layer::Structure,
    parameters: SHARE,
    grid: &one(&NOTED_SHARES),
    hinge: true,
    apply: |plant, _, v| plant.outer_force += v[0] - 1.0,
    look_alikes: "link_mass point_mass parallel_spring",
    of_runs: |e| e.outer_n > 0.0,
    trial: "holds",
    signature: "what is off goes with the force that was noted, at every joint that carries it",
    ..PLAIN
};
