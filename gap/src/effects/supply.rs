//! Supply and heat (A8 to A10).

use super::effect::Reference::One;
use super::effect::{Effect, Layer, PLAIN, needs_motion, one, parameter};
use crate::place::Domain;

const OF_THE_SUPPLY: Effect =
    Effect { layer: Layer::Actuation, domain: Domain::Robot, unseen: needs_motion, ..PLAIN };

pub static SUPPLY_SAG: Effect = Effect {
    id: "supply_sag",
    parameters: &[parameter("resistance_ohm", "Ω", 0.0, (0.0, 5.0), 0.1, One)],
    grid: &one(&[0.2, 0.5, 1.0, 2.0]),
    apply: |plant, _, v| plant.lane.supply_resistance_ohm += v[0] as f32,
    look_alikes: "supply_level voltage_limit",
    corrects: "qd_tau_max_radps qd_max_radps tau_qd_max_nm",
    trial: "all_chirp",
    signature: "all joints lose speed when any of them works; follows the total current within milliseconds",
    ..OF_THE_SUPPLY
};

pub static SUPPLY_LEVEL: Effect = Effect {
    id: "supply_level",
    parameters: &[parameter("scale", "", 1.0, (0.3, 2.0), 0.03, One)],
    grid: &one(&[0.5, 0.7, 0.85, 1.15, 1.4]),
    hinge: true,
    apply: |plant, _, v| plant.lane.supply_v *= v[0] as f32,
    look_alikes: "voltage_limit supply_sag profile_limit duty_supply",
    corrects: "supply.default_v reference_supply_v qd_tau_max_radps qd_max_radps tau_qd_max_nm",
    trial: "steps_large",
    signature: "as a voltage limit, the same in all joints and at any load; the logged voltage shows it",
    ..OF_THE_SUPPLY
};

/// The same where the position loop puts out a duty: a share of the supply, so that its gains go with it. Only
/// back-EMF stays.
pub static DUTY_SUPPLY: Effect = Effect {
    id: "duty_supply",
    hinge: false,
    apply: |plant, _, v| {
        let share = v[0] as f32;
        let lane = &mut plant.lane;
        lane.supply_v *= share;
        let gains = lane.kp_nm_per_rad.iter_mut().chain(&mut lane.kd_nms_per_rad);
        gains.for_each(|gain| *gain *= share);
    },
    look_alikes: "supply_level winding_resistance kp_error torque_constant",
    trial: "holds",
    signature: "gain, torque and speed of all joints are lower by one share, and so are the currents",
    ..SUPPLY_LEVEL
};

pub static THERMAL_DERATING: Effect = Effect {
    id: "thermal_derating",
    domain: Domain::Joints,
    parameters: &[
        parameter("rise_k_per_a2", "K/A²", 0.0, (0.0, 900.0), 5.0, One),
        parameter("time_s", "s", 100.0, (2.0, 1000.0), 10.0, One),
    ],
    grid: &[&[30.0, 20.0], &[30.0, 100.0], &[150.0, 20.0], &[150.0, 100.0], &[400.0, 60.0]],
    apply: |plant, place, v| {
        for &a in &place.items {
            plant.lane.joints[a].thermal_rise_k_per_a2 += v[0] as f32;
            plant.lane.joints[a].thermal_time_s = (v[1] as f32).clamp(0.1, 1e5);
        }
    },
    drifts: true,
    look_alikes: "winding_resistance friction_drift kp_error",
    unseen: |e, place| {
        if e.longest_s < 5.0 {
            Some("the runs are too short to warm anything")
        } else {
            (e.most_torque_share(place) < 0.1).then_some("the servo never works hard in these runs")
        }
    },
    trial: "hot_hold",
    signature: "droop grows with the current squared over the past minute",
    ..OF_THE_SUPPLY
};
