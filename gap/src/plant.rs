//! A candidate robot: physical parameters of a lane, what its sensors do wrong, and what happens to its
//! commands and clocks.

use std::sync::Arc;

use caudata_model::RobotModel;
use caudata_runlog::Payload;
use caudata_sim::LaneParams;
use caudata_sim::sensors::{CurrentErrors, EncoderErrors, ImuBias, ImuMounting};
use serde::{Deserialize, Serialize};

use crate::trial::Trial;

/// Where the joint that carries link `l` has its anchor, in the link's frame, m; its origin without one.
pub(crate) fn anchor_m(model: &RobotModel, l: usize) -> [f64; 3] {
    let joint = model.links()[l].joints.last();
    joint.map_or([0.0; 3], |&j| model.joints()[j].anchor_m)
}

/// From the joint of link `l` to its centre of mass: the direction in the link's frame, and how far, m (a
/// millimetre at least).
pub(crate) fn lever(model: &RobotModel, l: usize) -> ([f64; 3], f64) {
    let (com_m, anchor_m) = (model.links()[l].com_m, anchor_m(model, l));
    let along = [0, 1, 2].map(|i| com_m[i] - anchor_m[i]);
    let far_m = along.iter().map(|x| x * x).sum::<f64>().sqrt();
    (along.map(|x| x / far_m.max(1e-3)), far_m.max(1e-3))
}

/// Fastens `weights` (mass, kg; place in the link's frame, m) to link `l` as `lane` has it: mass, centre and
/// inertia. A link's inertia has one factor, so that what weights add to it is spread over its axes as the
/// link's own is. A weight may be less than nothing, and all of them together not take the link away.
pub(crate) fn hang(
    model: &RobotModel,
    lane: &mut LaneParams,
    l: usize,
    weights: &[(f64, [f64; 3])],
) {
    let link = &model.links()[l];
    let factor = |x: f32| f64::from(x);
    let bare_kg = link.mass_kg * factor(lane.link_mass_scale[l]);
    let mass_kg = bare_kg + weights.iter().map(|w| w.0).sum::<f64>();
    if mass_kg == bare_kg || mass_kg < 0.01 * bare_kg {
        return;
    }
    let own_m = [0, 1, 2].map(|i| link.com_m[i] + factor(lane.com_offset_m[l][i]));
    let parts = || weights.iter().copied().chain([(bare_kg, own_m)]);
    let com_m = [0, 1, 2].map(|i| parts().map(|(m, at)| m * at[i]).sum::<f64>() / mass_kg);
    let squared = |at: [f64; 3]| (0..3).map(|i| (at[i] - com_m[i]).powi(2)).sum::<f64>();
    // traces: a point at distance d adds 2·m·d² to that of an inertia
    let trace: f64 = (0..3).map(|i| link.inertia_kgm2[i][i]).sum();
    let bare = trace * factor(lane.link_mass_scale[l]) * factor(lane.link_inertia_scale[l]);
    let moved: f64 = parts().map(|(m, at)| 2.0 * m * squared(at)).sum();
    lane.link_mass_scale[l] = (mass_kg / link.mass_kg) as f32;
    lane.link_inertia_scale[l] =
        ((bare + moved).max(0.05 * bare) * link.mass_kg / (trace * mass_kg)) as f32;
    for (i, offset) in lane.com_offset_m[l].iter_mut().enumerate() {
        *offset = (com_m[i] - link.com_m[i]) as f32;
    }
}

/// Fastens the weights that a run notes to their links.
pub fn carry(model: &RobotModel, payload: &[Payload], lane: &mut LaneParams) {
    for (l, link) in model.links().iter().enumerate() {
        let own = payload.iter().filter(|p| p.link == link.name);
        let own: Vec<(f64, [f64; 3])> = own.map(|p| (p.mass_kg, p.at_m)).collect();
        hang(model, lane, l, &own);
    }
}

/// What sensors and clocks do wrong. All zero: nothing.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Sensing {
    /// Encoders, inside the position loop. `[A]`
    pub encoders: Vec<EncoderErrors>,
    /// Current sensing. `[A]`
    pub currents: Vec<CurrentErrors>,
    /// Time constant of each servo's velocity estimate, s. `[A]`
    pub velocity_lag_s: Vec<f32>,
    /// Time constant of each servo's reading of its current, s. `[A]`
    pub current_lag_s: Vec<f32>,
    /// How much later than its angle each servo's current was measured, s. `[A]`
    pub current_delay_s: Vec<f32>,
    /// How the IMU sits and scales.
    pub mounting: ImuMounting,
    /// Its offsets.
    pub bias: ImuBias,
    /// How late it reports, s.
    pub imu_delay_s: f32,
    /// Time constant of its low-pass, s.
    pub imu_lag_s: f32,
    /// How late everything measured is stamped, s.
    pub measurement_delay_s: f32,
    /// By how much stamps run ahead of time, s/s: what is stamped t was measured at t·(1 − drift).
    pub clock_drift: f32,
    /// Shift of motion capture, world, m.
    pub mocap_offset_m: [f32; 3],
    /// Turn of motion capture about the vertical, rad.
    pub mocap_yaw_rad: f32,
    /// How late motion capture is, s.
    pub mocap_delay_s: f32,
}

/// A candidate robot.
#[derive(Debug, Clone)]
pub struct Plant {
    /// What it is built from.
    pub model: Arc<RobotModel>,
    /// Physics.
    pub lane: LaneParams,
    /// Sensors and clocks.
    pub sensing: Sensing,
    /// Where in the session the run is, 0 (first) to 1 (last).
    pub session: f64,
    /// Dry friction that a joint has at the beginning of every run and loses (or gains) while it moves. `[A]`
    pub run_in: Vec<RunIn>,
    /// Share of the torque that is commanded beside its position which a joint's drive applies. `[A]`
    pub fed_torque: Vec<f64>,
    /// The same of the speed. `[A]`
    pub fed_speed: Vec<f64>,
    /// Share of the forces from outside which there was.
    pub outer_force: f64,
}

/// Friction that goes away within a run: `extra_nm·e^(−t/time_s)`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RunIn {
    /// At the run's beginning, N·m.
    pub extra_nm: f64,
    /// Time in which it falls to 1/e, s.
    pub time_s: f64,
}

impl Plant {
    /// The robot file's robot, without the effects of its extension.
    pub fn nominal(model: &Arc<RobotModel>) -> Self {
        let joints = model.actuated().len();
        Self {
            model: Arc::clone(model),
            lane: LaneParams::bare(model),
            sensing: Sensing {
                encoders: vec![EncoderErrors::default(); joints],
                currents: vec![CurrentErrors::default(); joints],
                velocity_lag_s: vec![0.0; joints],
                current_lag_s: vec![0.0; joints],
                current_delay_s: vec![0.0; joints],
                ..Sensing::default()
            },
            session: 0.0,
            run_in: vec![RunIn { extra_nm: 0.0, time_s: 1.0 }; joints],
            fed_torque: vec![1.0; joints],
            fed_speed: vec![1.0; joints],
            outer_force: 1.0,
        }
    }

    /// The robot under the conditions of a run: its gains, its supply. What it carries comes last, by [`carry`]: a link
    /// that is heavier than its file says does not make the weight on it heavier.
    pub fn in_trial(model: &Arc<RobotModel>, trial: &Trial) -> Self {
        let mut plant = Self::nominal(model);
        let lane = &mut plant.lane;
        for (a, joint) in model.actuated_names().into_iter().enumerate() {
            let (kp, kd) = trial.meta.gains(joint);
            if let Some(kp) = kp {
                lane.kp_nm_per_rad[a] = kp as f32;
            }
            if let Some(kd) = kd {
                lane.kd_nms_per_rad[a] = kd as f32;
            }
            let own = trial.meta.joint.get(joint);
            if let Some(added) = own.and_then(|c| c.added_inertia_kgm2) {
                lane.joint_armature_kgm2[a] += added as f32;
            }
        }
        if let Some(volt) = trial.supply_v {
            lane.supply_v = volt as f32;
        }
        plant
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use caudata_runlog::BaseHold;

    use super::*;

    #[test]
    fn a_weight_moves_mass_centre_and_inertia_of_its_link() {
        let file = concat!(env!("CARGO_MANIFEST_DIR"), "/../robots/xl330_pendulum.robot.toml");
        let model = Arc::new(RobotModel::load(file.as_ref()).unwrap());
        let (l, link) = model.links().iter().enumerate().next_back().unwrap();
        let mut run = Trial::bare(BaseHold::Fixed, 1.0, Vec::new());
        let mut at_m = link.com_m;
        at_m[0] += 0.1;
        run.meta.payload.push(Payload { link: link.name.clone(), mass_kg: link.mass_kg, at_m });
        run.meta.joint.entry("swing".to_owned()).or_default().kp = Some(0.5);
        let carrying = |run: &Trial| {
            let mut lane = Plant::in_trial(&model, run).lane;
            carry(&model, &run.meta.payload, &mut lane);
            lane
        };
        let lane = carrying(&run);
        // as heavy again, 0.1 m off: the centre moves by half of that
        assert!((lane.link_mass_scale[l] - 2.0).abs() < 1e-6);
        assert!((lane.com_offset_m[l][0] - 0.05).abs() < 1e-6);
        // 2·m·0.05² for each of the two, in the trace; the factor goes with a mass that has doubled
        let bare: f64 = (0..3).map(|i| link.inertia_kgm2[i][i]).sum();
        let want = (bare + 4.0 * link.mass_kg * 0.05 * 0.05) / (2.0 * bare);
        assert!((f64::from(lane.link_inertia_scale[l]) / want - 1.0).abs() < 1e-5);
        assert_eq!(lane.kp_nm_per_rad, [0.5]);
        // the effect of the catalogue is the same weight
        let mut plant = Plant::nominal(&model);
        let (direction, _) = super::lever(&model, l);
        let (anchor_m, own_m) =
            (super::anchor_m(&model, l), [0, 1, 2].map(|i| direction[i] * 0.04));
        run.meta.payload[0].at_m = [0, 1, 2].map(|i| anchor_m[i] + own_m[i]);
        let place = crate::place::places(&model, crate::place::Domain::Links).swap_remove(l);
        let effect = crate::effects::find("point_mass").unwrap();
        (effect.apply)(&mut plant, &place, &[link.mass_kg, 0.04]);
        let hung = carrying(&run);
        assert_eq!(plant.lane.com_offset_m, hung.com_offset_m);
        assert_eq!(plant.lane.link_inertia_scale, hung.link_inertia_scale);
        // and takes no more of the link away than there is
        (effect.apply)(&mut plant, &place, &[-3.0 * link.mass_kg, 0.04]);
        assert_eq!(plant.lane.link_mass_scale, hung.link_mass_scale);
    }

    /// A link of one and a half times its mass with a weight as heavy as its file says: 2.5 times that, not 3.
    #[test]
    fn a_heavier_link_does_not_make_the_weight_on_it_heavier() {
        let file = concat!(env!("CARGO_MANIFEST_DIR"), "/../robots/xl330_pendulum.robot.toml");
        let model = Arc::new(RobotModel::load(file.as_ref()).unwrap());
        let (l, link) = model.links().iter().enumerate().next_back().unwrap();
        let mut run = Trial::bare(BaseHold::Fixed, 1.0, Vec::new());
        let (mass_kg, at_m) = (link.mass_kg, link.com_m);
        run.meta.payload.push(Payload { link: link.name.clone(), mass_kg, at_m });
        let place = crate::place::places(&model, crate::place::Domain::Links).swap_remove(l);
        let effect = crate::effects::find("link_mass").unwrap();
        let heavier = crate::replay::Term { effect, place, values: vec![1.5] };
        let replayer = crate::replay::Replayer::new(Arc::clone(&model), 1).unwrap();
        let lane = replayer.plant(&run, &[heavier]).lane;
        assert!((lane.link_mass_scale[l] - 2.5).abs() < 1e-6, "{:?}", lane.link_mass_scale);
    }
}
