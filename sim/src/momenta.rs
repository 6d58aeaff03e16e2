//! Momentum and kinetic energy of a lane's robot, for conservation checks. In f64, from what an engine reports in
//! f32.

use caudata_model::{Pose, RobotModel};

use crate::observe::{Coordinates, Motion, WholeBody, link_masses};
use crate::{LaneParams, SimError, State};

/// Momentum and kinetic energy of one robot.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Momenta {
    /// Total mass times the velocity of the centre of mass, world, N·s.
    pub linear_ns: [f64; 3],
    /// About the centre of mass, world, N·m·s.
    pub angular_nms: [f64; 3],
    /// Kinetic energy of the links and of the rotors (½·armature·q̇²), J.
    pub kinetic_j: f64,
}

impl Momenta {
    /// Momenta and kinetic energy of lane `lane` of `state`, with the lane's `params`.
    ///
    /// # Errors
    /// [`SimError`] where the lane does not exist or the state belongs to another model.
    pub fn of(
        model: &RobotModel,
        params: &LaneParams,
        state: &State,
        lane: usize,
    ) -> Result<Self, SimError> {
        if lane >= state.lanes {
            let lanes = state.lanes;
            return Err(SimError::Lane { lane, lanes });
        }
        let row = |v: &[f32], k: usize| -> Vec<f64> {
            let part = &v[lane * k..(lane + 1) * k];
            part.iter().map(|&x| f64::from(x)).collect()
        };
        let three = |v: &[f32]| -> [f64; 3] { std::array::from_fn(|i| f64::from(v[lane * 3 + i])) };
        let quat: [f64; 4] = std::array::from_fn(|i| f64::from(state.base_quat_wxyz[lane * 4 + i]));
        let world_from_base = Pose {
            pos_m: three(&state.base_pos_m),
            quat_wxyz: caudata_model::pose::quat_normalised(quat).unwrap_or([1.0, 0.0, 0.0, 0.0]),
        };
        let at = Coordinates {
            base_vel_mps: three(&state.base_vel_mps),
            base_angvel_radps: world_from_base.rotate(three(&state.base_angvel_radps)),
            world_from_base,
            joint_pos_rad: row(&state.joint_pos_rad, state.joints),
            joint_vel_radps: row(&state.joint_vel_radps, state.joints),
        };
        let masses = link_masses(model, params);
        let mut motion = Motion::default();
        motion.update(model, &at)?;
        let whole = WholeBody::of(&motion, &masses);
        let mut out = Self { linear_ns: [0.0; 3], angular_nms: [0.0; 3], kinetic_j: 0.0 };
        for (i, m) in masses.iter().enumerate() {
            let (p, v) = motion.point(i, m.com_m);
            let pose = &motion.places.links[i];
            let w = motion.angvel_radps[i];
            let own = pose.inverse().rotate(w);
            let spin = m.inertia_kgm2 * nalgebra::Vector3::from(own);
            let spin_world = pose.rotate(spin.into());
            let arm: [f64; 3] = std::array::from_fn(|k| p[k] - whole.com_m[k]);
            let momentum = v.map(|x| x * m.mass_kg);
            let orbit = caudata_model::pose::cross(arm, momentum);
            for k in 0..3 {
                out.linear_ns[k] += momentum[k];
                out.angular_nms[k] += spin_world[k] + orbit[k];
                out.kinetic_j += 0.5 * momentum[k] * v[k] + 0.5 * spin_world[k] * w[k];
            }
        }
        let mut armature: Vec<f64> = model.joints().iter().map(|j| j.armature_kgm2).collect();
        for (&j, own) in model.actuated().iter().zip(&params.joint_armature_kgm2) {
            armature[j] = f64::from(*own);
        }
        for (armature_kgm2, vel_radps) in armature.iter().zip(&at.joint_vel_radps) {
            out.kinetic_j += 0.5 * armature_kgm2 * vel_radps.powi(2);
        }
        Ok(out)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The Polymander, joints still, moving at 2 m/s along x and turning at 3 rad/s about z: p = m·v, T =
    /// ½·m·v_com² + ½·I·ω².
    #[test]
    fn a_stiff_robot_is_one_rigid_body() {
        let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../robots/polymander.robot.toml");
        let model = RobotModel::load(std::path::Path::new(path)).unwrap();
        let params = LaneParams::nominal(&model);
        let mut state = State::zeros(1, model.joints().len(), model.actuated().len(), 4);
        state.base_quat_wxyz[0] = 1.0;
        state.base_vel_mps[0] = 2.0;
        let straight = Momenta::of(&model, &params, &state, 0).unwrap();
        let mass = model.total_mass_kg();
        assert!((straight.linear_ns[0] - 2.0 * mass).abs() < 1e-6);
        assert!((straight.kinetic_j - 2.0 * mass).abs() < 1e-6);
        state.base_vel_mps[0] = 0.0;
        state.base_angvel_radps[2] = 3.0;
        let spinning = Momenta::of(&model, &params, &state, 0).unwrap();
        // about the centre of mass, L = I·ω; with it T = ½·L·ω + ½·p²/m
        let p2: f64 = spinning.linear_ns.iter().map(|p| p * p).sum();
        let turning = 0.5 * spinning.angular_nms[2] * 3.0 + 0.5 * p2 / mass;
        assert!((spinning.kinetic_j - turning).abs() < 1e-6);
        assert!(Momenta::of(&model, &params, &state, 1).is_err());
    }
}
