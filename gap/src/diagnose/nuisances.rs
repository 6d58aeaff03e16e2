//! What differs from run to run in a careful lab, with its tolerances.

use crate::effects;
use crate::plant::Plant;
use crate::replay::{Replayer, Term, Variant};

/// Dry and viscous friction may differ by this share from run to run.
const FRICTION_TOLERANCE: f64 = 0.07;
/// Before friction slides, its law is a matter of taste: the way to it by this share.
const PRESLIDING_TOLERANCE: f64 = 0.3;
/// When in its tick a firmware acts, and its current loop, from joint to joint: s.
const LOOP_TOLERANCE_S: f64 = 0.000_12;
/// Rotor inertia by this share.
const ROTOR_TOLERANCE: f64 = 0.05;
/// Stamps, integration and bus: s.
const TIME_TOLERANCE_S: f64 = 0.0007;
/// Gains by this share (supply and temperature act on them).
const GAINS_TOLERANCE: f64 = 0.01;
/// Supply by this share.
const SUPPLY_TOLERANCE: f64 = 0.015;
/// When within its loop a servo reads its current, and over how long: s. Between two commands the torque falls
/// as the joint follows, so that this is a current in proportion to the speed. Its speed is the difference of
/// angles over some periods of the loop, and as late.
const READING_TOLERANCE_S: f64 = 0.002;
/// Ground friction by this share.
const GROUND_TOLERANCE: f64 = 0.1;
/// A pool stirs for minutes after somebody has been in it: m/s, along and across.
const STIR_TOLERANCE_MPS: f64 = 0.005;
/// Drag by this share: a cable, a wall nearby, bubbles on the skin.
const DRAG_TOLERANCE: f64 = 0.05;
/// Buoyancy by this share: temperature, bubbles, what has leaked in.
const BUOYANCY_TOLERANCE: f64 = 0.005;

/// A nuisance: a candidate, and which share of its trace is one tolerance.
pub struct Nuisance {
    /// The candidate.
    pub variant: Variant,
    /// Share of its trace that is one tolerance.
    pub share: f32,
    /// Independent from joint to joint.
    pub per_joint: bool,
}

/// Effect, parameter, value, tolerances that this is, whether each joint has its own.
type Row = (&'static str, usize, f64, f64, bool);

/// What differs from run to run in a careful lab, and in its pool (`wet`), as candidates on top of `base`.
pub fn nuisances(replayer: &Replayer, base: &[Term], wet: bool) -> Vec<Nuisance> {
    let model = replayer.model();
    let mut rows: Vec<Row> = Vec::new();
    if wet {
        rows.extend(IN_WATER);
    }
    rows.extend(of_joints(replayer, base));
    rows.extend([
        ("command_delay", 0, 3.0 * TIME_TOLERANCE_S, 3.0, false),
        ("supply_level", 0, 1.0 + 3.0 * SUPPLY_TOLERANCE, 3.0, false),
    ]);
    if !model.feet().is_empty() {
        rows.push(("contact_friction", 0, 1.0 + GROUND_TOLERANCE, 1.0, false));
    }
    let nuisance = |(id, parameter, value, tolerances, per_joint): Row| {
        let effect = effects::find(id)?;
        let place = effect.places(model).into_iter().next()?;
        let mut term = Term::nothing(model, effect, place);
        term.values[parameter] = value;
        let variant = [base, &[term]].concat();
        Some(Nuisance { variant, share: (1.0 / tolerances) as f32, per_joint })
    };
    rows.into_iter().filter_map(nuisance).collect()
}

/// A few times the tolerance each, scaled back: the trace of a tiny change drowns in rounding.
const IN_WATER: [Row; 4] = [
    ("water_current", 0, 4.0 * STIR_TOLERANCE_MPS, 4.0, false),
    ("water_current", 1, 4.0 * STIR_TOLERANCE_MPS, 4.0, false),
    ("quadratic_drag", 1, 1.0 + 3.0 * DRAG_TOLERANCE, 3.0, false),
    ("buoyancy", 0, 1.0 + 4.0 * BUOYANCY_TOLERANCE, 4.0, false),
];

/// Those of servos and joints, in proportion to what they have on average.
fn of_joints(replayer: &Replayer, base: &[Term]) -> Vec<Row> {
    let model = replayer.model();
    let mut plant = Plant::nominal(model);
    let servos = plant.lane.torque_scale.len();
    plant.session = 0.5;
    for term in base {
        (term.effect.apply)(&mut plant, &term.place, &term.values);
    }
    let mean = |x: &[f32]| x.iter().map(|v| f64::from(*v)).sum::<f64>() / x.len().max(1) as f64;
    let most_nm =
        (0..servos).map(|a| model.servo(a).tau_max_nm).sum::<f64>() / servos.max(1) as f64;
    let friction_nm = mean(&plant.lane.joint_friction_nm).max(0.003 * most_nm);
    let damping = mean(&plant.lane.joint_damping_nms_per_rad);
    let ways: Vec<f32> = plant.lane.joints.iter().map(|j| j.presliding_rad).collect();
    let rotor_kgm2 = mean(&plant.lane.joint_armature_kgm2).max(1e-4);
    let mut rows = vec![("coulomb_friction", 0, 3.0 * FRICTION_TOLERANCE * friction_nm, 3.0, true)];
    if damping > 0.0 {
        rows.push(("viscous_friction", 0, 3.0 * FRICTION_TOLERANCE * damping, 3.0, true));
    }
    rows.extend([
        ("pre_sliding", 0, mean(&ways) * (1.0 + PRESLIDING_TOLERANCE), 1.0, true),
        ("kp_error", 0, 1.0 + 3.0 * GAINS_TOLERANCE, 3.0, true),
        ("servo_loop_delay", 0, 6.0 * LOOP_TOLERANCE_S, 6.0, true),
        ("armature", 0, ROTOR_TOLERANCE * rotor_kgm2, 1.0, true),
        ("current_lag", 0, READING_TOLERANCE_S, 1.0, true),
        ("velocity_lag", 0, READING_TOLERANCE_S, 1.0, true),
    ]);
    rows
}
