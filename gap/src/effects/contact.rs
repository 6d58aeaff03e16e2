//! Contact with the ground (C1, C5).

use super::Reference::One;
use super::{BODY_SIGNALS, Domain, Effect, Layer, parameter};

pub static CONTACT_FRICTION: Effect = Effect {
    id: "contact_friction",
    layer: Layer::Contact,
    domain: Domain::Feet,
    parameters: &[parameter("scale", "", 1.0, (0.05, 5.0), 0.07, One)],
    grid: &[&[0.2], &[0.35], &[0.5], &[0.7], &[0.85], &[1.2], &[1.6]],
    hinge: true,
    apply: |plant, place, v| {
        for &f in &place.items {
            plant.lane.foot_friction_scale[f] *= v[0] as f32;
        }
    },
    shows_in: BODY_SIGNALS,
    look_alikes: &["belly_friction", "girdle_play", "torque_limit"],
    unseen: |e, _| (!e.on_ground).then_some("the robot never stands on the ground in these runs"),
    trial: "gait_two_speeds",
    signature: "feet slide: the body is slow although the joints follow",
};

pub static BELLY_FRICTION: Effect = Effect {
    id: "belly_friction",
    layer: Layer::Contact,
    domain: Domain::Robot,
    parameters: &[parameter("scale", "", 1.0, (0.0, 8.0), 0.15, One)],
    grid: &[&[0.3], &[0.6], &[1.6], &[2.5], &[4.0]],
    hinge: true,
    apply: |plant, _, v| {
        plant.lane.body_friction = (plant.lane.body_friction * v[0] as f32).clamp(0.0, 10.0);
    },
    shows_in: BODY_SIGNALS,
    look_alikes: &["contact_friction"],
    unseen: |e, _| (!e.on_ground).then_some("the robot never stands on the ground in these runs"),
    trial: "low_gait",
    signature: "resistance in low postures only",
};
