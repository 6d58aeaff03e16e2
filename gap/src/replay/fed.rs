//! What acts beside the position commands: speeds and torques that are commanded with them, and forces from outside.

use caudata_model::{BaseKind, JointMotion, Kinematics, Pose, pose};
use caudata_sim::batch::BatchEngine;
use caudata_sim::sensors::EncoderErrors;
use caudata_sim::{Engine, State};

use super::commands::Reader;
use crate::plant::Plant;
use crate::trial::{Force, Steps, Trial};

/// Those of one lane, read in order of time.
pub(super) struct Fed<'a> {
    /// By actuated joint: what Kd sees of a speed command, rad/s.
    speeds: Vec<Option<Reader<'a>>>,
    /// By actuated joint: what the loop adds, N·m.
    torques: Vec<Option<Reader<'a>>>,
    forces: &'a [Force],
    /// Commanded beside the positions. `[A]`
    commanded_nm: Vec<f32>,
    /// From outside, model order. `[J]`
    outer_nm: Vec<f32>,
    places: Kinematics,
}

impl<'a> Fed<'a> {
    /// What `trial` has of it between the times of `window_s`, late as the other commands of `plant` are by
    /// `delay_s`; `None` where it has nothing.
    pub fn new(
        trial: &'a Trial,
        plant: &Plant,
        delay_s: impl Fn(usize) -> f64,
        window_s: (f64, f64),
    ) -> Option<Self> {
        if trial.has_positions_alone() {
            return None;
        }
        let reader = |(a, steps): (usize, &'a Option<Steps>)| {
            let loss = &plant.lane.command_loss;
            let right = EncoderErrors::default();
            steps.as_ref().map(|steps| Reader::new(steps, delay_s(a), right, loss, window_s))
        };
        Some(Self {
            speeds: trial.speeds.iter().enumerate().map(reader).collect(),
            torques: trial.torques.iter().enumerate().map(reader).collect(),
            forces: &trial.forces,
            commanded_nm: vec![0.0; plant.model.actuated().len()],
            outer_nm: vec![0.0; plant.model.joints().len()],
            places: Kinematics::default(),
        })
    }

    /// Gives lane `lane` what it has on average from `from_s` to `to_s`, which follows the last time; what acts on
    /// the torso goes into `wrench` (force and torque at its centre of mass, world). Whether it could.
    pub fn feed(
        &mut self,
        engine: &mut BatchEngine,
        lane: usize,
        plant: &Plant,
        (from_s, to_s): (f64, f64),
        wrench: &mut [f32],
    ) -> bool {
        for (a, commanded_nm) in self.commanded_nm.iter_mut().enumerate() {
            let read = |of: &mut [Option<Reader<'a>>]| {
                of.get_mut(a).and_then(Option::as_mut).map_or(0.0, |r| r.mean(from_s, to_s))
            };
            let joint = &plant.lane.joints[a];
            // a drive makes currents of torques by the constant that it knows
            let constant = f64::from(joint.torque_constant_nm_per_a)
                / plant.model.servo(a).torque_per_current_nm_per_a;
            let kd = f64::from(plant.lane.kd_nms_per_rad[a]);
            let speed_radps = plant.fed_speed[a] * read(&mut self.speeds);
            let torque_nm = plant.fed_torque[a] * read(&mut self.torques);
            *commanded_nm = (kd * speed_radps + constant * torque_nm) as f32;
        }
        if !self.forces.is_empty()
            && !self.push(engine.state(), lane, plant, 0.5 * (from_s + to_s), wrench)
        {
            return false;
        }
        engine.feed(lane, &self.commanded_nm, &self.outer_nm).is_ok()
    }

    /// Works out what the forces at `t_s` come to: a wrench on the torso that carries all of them, and at each joint
    /// what they have beyond it there.
    fn push(
        &mut self,
        state: &State,
        lane: usize,
        plant: &Plant,
        t_s: f64,
        wrench: &mut [f32],
    ) -> bool {
        let model = &plant.model;
        let joints = model.joints().len();
        let row = |values: &[f32], width: usize| -> Vec<f64> {
            values[width * lane..width * (lane + 1)].iter().map(|&x| f64::from(x)).collect()
        };
        let base = match model.base() {
            // joints between the world and its first link turn that
            BaseKind::Fixed => Pose::IDENTITY,
            BaseKind::Free => {
                let (at, turn) = (row(&state.base_pos_m, 3), row(&state.base_quat_wxyz, 4));
                let (pos_m, quat_wxyz) = ([0, 1, 2].map(|i| at[i]), [0, 1, 2, 3].map(|i| turn[i]));
                Pose { pos_m, quat_wxyz }
            }
        };
        let pos = row(&state.joint_pos_rad, joints);
        if model.kinematics_into(&base, &pos, &mut self.places).is_err() {
            return false;
        }
        let torso = model.torso_link();
        let torso_m = self.places.links[torso].point(model.links()[torso].com_m);
        self.outer_nm.fill(0.0);
        wrench.fill(0.0);
        for force in self.forces {
            let force_n = force.at(t_s).map(|f| plant.outer_force * f);
            let place_m = self.places.links[force.link].point(force.at_m);
            let turning = pose::cross(pose::sub(place_m, torso_m), force_n);
            for (to, own) in wrench.iter_mut().zip(force_n.iter().chain(&turning)) {
                *to += *own as f32;
            }
            for (link, sign) in [(force.link, 1.0), (torso, -1.0)] {
                let carried = std::iter::successors(Some(link), |&l| model.links()[l].parent);
                for &j in carried.flat_map(|l| &model.links()[l].joints) {
                    let frame = &self.places.joints[j];
                    let along = match model.joints()[j].motion {
                        JointMotion::Slide => force_n,
                        JointMotion::Hinge => {
                            pose::cross(pose::sub(place_m, frame.anchor_m), force_n)
                        }
                    };
                    self.outer_nm[j] += (sign * pose::dot(frame.axis, along)) as f32;
                }
            }
        }
        true
    }
}
