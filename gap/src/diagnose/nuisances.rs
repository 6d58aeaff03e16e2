//! What differs from run to run in a careful lab, with its tolerances.

use caudata_model::JointMotion;

use crate::effects;
use crate::place::{Domain, Place};
use crate::plant::Plant;
use crate::replay::{Replayer, Term, Variant};

/// Dry and viscous friction may differ by this share from run to run.
const FRICTION_TOLERANCE: f64 = 0.07;
/// Before friction slides, its law is a matter of taste: the way to it by this share.
const PRESLIDING_TOLERANCE: f64 = 0.3;
/// The same of slides: guides spring over ways of all sizes up to the nominal one, and no file has theirs.
const SLIDES_PRESLIDING_TOLERANCE: f64 = 1.0;
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
    /// Joints that have it, each its own; none: it is one of all.
    pub joints: Vec<usize>,
}

/// Effect, parameter, value, tolerances that this is.
type Row = (&'static str, usize, f64, f64);

/// What differs from run to run in a careful lab, and in its pool (`wet`), as candidates on top of `base`.
pub fn nuisances(replayer: &Replayer, base: &[Term], wet: bool) -> Vec<Nuisance> {
    let model = replayer.model();
    let mut rows: Vec<(Row, Vec<usize>)> = Vec::new();
    if wet {
        rows.extend(IN_WATER.map(|row| (row, Vec::new())));
    }
    // hinges, and slides: what one has on average is in another unit than the other
    let is = |motion| move |a: &usize| model.joints()[model.actuated()[*a]].motion == motion;
    for motion in [JointMotion::Hinge, JointMotion::Slide] {
        let joints: Vec<usize> = (0..model.actuated().len()).filter(is(motion)).collect();
        if !joints.is_empty() {
            rows.extend(
                of_joints(replayer, base, &joints).into_iter().map(|r| (r, joints.clone())),
            );
        }
    }
    let of_all = [
        ("command_delay", 0, 3.0 * TIME_TOLERANCE_S, 3.0),
        ("supply_level", 0, 1.0 + 3.0 * SUPPLY_TOLERANCE, 3.0),
    ];
    rows.extend(of_all.map(|row| (row, Vec::new())));
    if !model.feet().is_empty() {
        rows.push((("contact_friction", 0, 1.0 + GROUND_TOLERANCE, 1.0), Vec::new()));
    }
    let nuisance = |((id, parameter, value, tolerances), joints): (Row, Vec<usize>)| {
        let effect = effects::find(id)?;
        let place = match joints.is_empty() {
            true => effect.places(model).into_iter().next()?,
            false => Place { domain: Domain::Joints, items: joints.clone(), names: Vec::new() },
        };
        let mut term = Term::nothing(model, effect, place);
        term.values[parameter] = value;
        let variant = [base, &[term]].concat();
        Some(Nuisance { variant, share: (1.0 / tolerances) as f32, joints })
    };
    rows.into_iter().filter_map(nuisance).collect()
}

/// A few times the tolerance each, scaled back: the trace of a tiny change drowns in rounding.
const IN_WATER: [Row; 4] = [
    ("water_current", 0, 4.0 * STIR_TOLERANCE_MPS, 4.0),
    ("water_current", 1, 4.0 * STIR_TOLERANCE_MPS, 4.0),
    ("quadratic_drag", 1, 1.0 + 3.0 * DRAG_TOLERANCE, 3.0),
    ("buoyancy", 0, 1.0 + 4.0 * BUOYANCY_TOLERANCE, 4.0),
];

/// Those of the servos at `joints` and of these, in proportion to what they have on average.
fn of_joints(replayer: &Replayer, base: &[Term], joints: &[usize]) -> Vec<Row> {
    let model = replayer.model();
    let mut plant = Plant::nominal(model);
    plant.session = 0.5;
    for term in base {
        (term.effect.apply)(&mut plant, &term.place, &term.values);
    }
    let mean = |of: &dyn Fn(usize) -> f64| {
        joints.iter().map(|a| of(*a)).sum::<f64>() / joints.len() as f64
    };
    let lane = &plant.lane;
    let most_nm = mean(&|a| model.servo(a).tau_max_nm);
    let friction_nm = mean(&|a| lane.joint_friction_nm[a].into()).max(0.003 * most_nm);
    let damping = mean(&|a| lane.joint_damping_nms_per_rad[a].into());
    let way = mean(&|a| lane.joints[a].presliding_rad.into());
    let rotor_kgm2 = mean(&|a| lane.joint_armature_kgm2[a].into()).max(1e-4);
    let way_tolerance = match model.joints()[model.actuated()[joints[0]]].motion {
        JointMotion::Hinge => PRESLIDING_TOLERANCE,
        JointMotion::Slide => SLIDES_PRESLIDING_TOLERANCE,
    };
    let mut rows = vec![("coulomb_friction", 0, 3.0 * FRICTION_TOLERANCE * friction_nm, 3.0)];
    if damping > 0.0 {
        rows.push(("viscous_friction", 0, 3.0 * FRICTION_TOLERANCE * damping, 3.0));
    }
    rows.extend([
        ("pre_sliding", 0, way * (1.0 + way_tolerance), 1.0),
        ("kp_error", 0, 1.0 + 3.0 * GAINS_TOLERANCE, 3.0),
        ("servo_loop_delay", 0, 6.0 * LOOP_TOLERANCE_S, 6.0),
        ("armature", 0, ROTOR_TOLERANCE * rotor_kgm2, 1.0),
        ("current_lag", 0, READING_TOLERANCE_S, 1.0),
        ("velocity_lag", 0, READING_TOLERANCE_S, 1.0),
    ]);
    rows
}
