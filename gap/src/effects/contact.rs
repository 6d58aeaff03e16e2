//! Contact with the ground (C1, C5).

use super::effect::Reference::One;
use super::effect::{Effect, Layer, PLAIN, one, parameter};
use crate::place::Domain;

const OF_CONTACT: Effect = Effect {
    layer: Layer::Contact,
    domain: Domain::Feet,
    unseen: |e, _| (!e.on_ground).then_some("the robot never stands on the ground in these runs"),
    ..PLAIN
};

pub static CONTACT_FRICTION: Effect = Effect {
    id: "contact_friction",
    parameters: &[parameter("scale", "", 1.0, (0.05, 5.0), 0.07, One)],
    grid: &one(&[0.2, 0.35, 0.5, 0.7, 0.85, 1.2, 1.6]),
    hinge: true,
    apply: |plant, place, v| place.each(|f| plant.lane.foot_friction_scale[f] *= v[0] as f32),
    look_alikes: "belly_friction girdle_play torque_limit",
    corrects: "contact.foot_friction",
    trial: "gait",
    signature: "feet slide: the body is slow although the joints follow",
    ..OF_CONTACT
};

pub static BELLY_FRICTION: Effect = Effect {
    id: "belly_friction",
    domain: Domain::Robot,
    parameters: &[parameter("scale", "", 1.0, (0.0, 8.0), 0.15, One)],
    grid: &one(&[0.3, 0.6, 1.6, 2.5, 4.0]),
    hinge: true,
    apply: |plant, _, v| {
        plant.lane.body_friction = (plant.lane.body_friction * v[0] as f32).clamp(0.0, 10.0);
    },
    look_alikes: "contact_friction",
    corrects: "contact.body_friction",
    trial: "gait_low",
    signature: "resistance in low postures only",
    ..OF_CONTACT
};
