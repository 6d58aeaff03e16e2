//! What a salamander can hide, and how its robot differs then.

use caudata_gap::effects;
use caudata_model::RobotModel;
use caudata_sim::{LaneParams, LinkWater};

use crate::case::{TrueEffect, TrueValue};

/// What is hidden. What acts on the ground or in water alone is no effect elsewhere.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Hides {
    /// Nothing.
    Nothing,
    /// Play at one hinge of the girdles (order of the robot file), half width in degrees.
    Play {
        /// Which of the robot file's play hinges.
        hinge: usize,
        /// Degrees, each side.
        half_width_deg: f64,
    },
    /// Sliding friction of the feet, as a factor.
    Friction(f64),
    /// Mass on the trunk, kg.
    Payload(f64),
    /// The floor rises forward by so many degrees.
    Slope(f64),
    /// The joints of the left front leg have so much of their gain.
    WeakLeg(f64),
    /// The paper's robot: play of so many degrees at all girdle hinges, a command low-pass (s) and a weaker
    /// envelope (factor).
    Paper {
        /// Degrees, each side.
        half_width_deg: f64,
        /// s.
        low_pass_s: f64,
        /// Factor on torques.
        torque: f64,
    },
    /// Quadratic drag across all links, and against turning, as a factor.
    Drag(f64),
    /// Linear drag of all links, as a factor.
    LinearDrag(f64),
    /// Added mass and inertia across all links, as a share of the water displaced.
    AddedMass(f64),
    /// Buoyancy of all links, as a factor.
    Buoyancy(f64),
    /// The centre of buoyancy of each link is so many metres higher.
    BuoyancyCentre(f64),
    /// Heave damping of each link, N·s/m more.
    Heave(f64),
    /// The water flows along x, m/s.
    Current(f64),
}

/// Joints of the weak leg.
const WEAK_LEG: &str = "FL_";

/// Does the same to each link in water.
fn links(lane: &mut LaneParams, change: impl Fn(&mut LinkWater)) {
    lane.water.iter_mut().for_each(change);
}

/// The robot with what is hidden.
pub(crate) fn lane_of(model: &RobotModel, hidden: Hides) -> LaneParams {
    let mut lane = LaneParams::nominal(model);
    let rad = |deg: f64| deg.to_radians() as f32;
    match hidden {
        Hides::Nothing => {}
        Hides::Play { hinge, half_width_deg } => {
            lane.backlash_half_width_rad[hinge] = rad(half_width_deg)
        }
        Hides::Friction(factor) => lane.foot_friction *= factor as f32,
        Hides::Payload(kg) => {
            lane.payload_kg = kg as f32;
            lane.payload_m = model.links()[model.torso_link()].com_m.map(|x| x as f32);
        }
        Hides::Slope(deg) => lane.tilt_floor(0.0, rad(deg)),
        Hides::WeakLeg(share) => {
            for (kp, name) in lane.kp_nm_per_rad.iter_mut().zip(model.actuated_names()) {
                if name.starts_with(WEAK_LEG) {
                    *kp *= share as f32;
                }
            }
        }
        Hides::Paper { half_width_deg, low_pass_s, torque } => {
            lane.backlash_half_width_rad.fill(rad(half_width_deg));
            lane.torque_scale.fill(torque as f32);
            for j in &mut lane.joints {
                j.command_low_pass_s = low_pass_s as f32;
            }
        }
        Hides::Current(mps) => lane.water_current_mps[0] += mps as f32,
        Hides::Drag(f) => links(&mut lane, |link| {
            link.quadratic_drag_scale_y *= f as f32;
            link.quadratic_drag_scale_z *= f as f32;
            link.quadratic_torque_scale *= f as f32;
        }),
        Hides::LinearDrag(f) => links(&mut lane, |link| link.linear_drag_scale *= f as f32),
        Hides::AddedMass(share) => links(&mut lane, |link| {
            link.added_mass_y += share as f32;
            link.added_mass_z += share as f32;
            link.added_inertia_y += share as f32;
            link.added_inertia_z += share as f32;
        }),
        Hides::Buoyancy(f) => links(&mut lane, |link| link.buoyancy_scale *= f as f32),
        Hides::BuoyancyCentre(up_m) => links(&mut lane, |link| link.buoyancy_z_m += up_m as f32),
        Hides::Heave(more) => links(&mut lane, |link| link.heave_damping_ns_per_m += more as f32),
    }
    lane
}

/// What a perfect diagnosis would report.
pub(crate) fn truth(model: &RobotModel, hidden: Hides) -> Vec<TrueEffect> {
    let play =
        |joint: &str, deg: f64| true_effect("girdle_play", joint, &["half"], deg.to_radians(), 0.0);
    let robot = |effect, names: &[&str], value, nominal| {
        vec![true_effect(effect, "", names, value, nominal)]
    };
    match hidden {
        Hides::Nothing => Vec::new(),
        Hides::Play { hinge, half_width_deg } => {
            let joint = &model.joints()[model.backlash().joints[hinge]];
            vec![play(&joint.name, half_width_deg)]
        }
        Hides::Friction(f) => {
            let nominal = model.contact().foot_friction;
            robot("contact_friction", &["scale", "friction"], f * nominal, nominal)
        }
        Hides::Payload(kg) => robot("payload", &["mass"], kg, 0.0),
        Hides::Slope(deg) => robot("floor_slope", &["pitch"], deg.to_radians(), 0.0),
        Hides::WeakLeg(share) => model
            .actuated_names()
            .into_iter()
            .filter(|name| name.starts_with(WEAK_LEG))
            .map(|name| true_effect("kp_error", name, &["scale"], share, 1.0))
            .collect(),
        Hides::Paper { half_width_deg, low_pass_s, torque } => {
            let most_nm = model.servo(0).tau_max_nm;
            vec![
                play("", half_width_deg),
                true_effect("command_low_pass", "", &["time"], low_pass_s, 0.0),
                true_effect("torque_limit", "", &["limit", "scale"], torque * most_nm, most_nm),
            ]
        }
        Hides::Drag(f) => robot("quadratic_drag", &["across"], f, 1.0),
        Hides::LinearDrag(f) => robot("linear_drag", &["scale"], f, 1.0),
        Hides::AddedMass(share) => robot("added_mass", &["across"], share, 0.0),
        Hides::Buoyancy(f) => robot("buoyancy", &["scale"], f, 1.0),
        Hides::BuoyancyCentre(m) => robot("buoyancy_centre", &["z_m"], m, 0.0),
        Hides::Heave(more) => robot("heave_damping", &["extra"], more, 0.0),
        Hides::Current(mps) => robot("water_current", &["x_mps"], mps, 0.0),
    }
}

/// An effect of the catalogue at a joint (empty: the robot); layer and unit are the catalogue's.
fn true_effect(effect: &str, joint: &str, names: &[&str], value: f64, nominal: f64) -> TrueEffect {
    let known = effects::find(effect);
    let unit = known.and_then(|e| {
        let named = |p: &&effects::ParameterSpec| names.iter().any(|n| p.name.contains(n));
        e.parameters.iter().find(named)
    });
    TrueEffect {
        effect: effect.to_owned(),
        layer: known.map_or("", |e| e.layer.name()).to_owned(),
        joint: joint.to_owned(),
        size: value,
        d: 0.0,
        equivalent: Vec::new(),
        equivalent_beside: Vec::new(),
        parameters: vec![TrueValue {
            names: names.iter().map(|n| (*n).to_owned()).collect(),
            unit: unit.map_or("", |p| p.unit).to_owned(),
            value,
            nominal,
        }],
    }
}
