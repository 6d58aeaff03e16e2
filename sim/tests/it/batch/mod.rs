//! The batch engine beyond the conformance suite: its dynamics against an independent formulation and MuJoCo,
//! its widths against each other, its determinism.

mod against_mujoco;
mod bits;
mod contact;
mod correct;
mod drift;
mod dynamics;
mod plain;
mod readout;
mod trees;

use caudata_model::{Pose, RobotModel};
use caudata_random::Stream;
use caudata_sim::batch::smooth::Motion;

/// The largest magnitude; NaN where any is.
pub(crate) fn largest(values: impl IntoIterator<Item = f64>) -> f64 {
    // `f64::max` would forget a NaN
    let fold = |most: f64, v: f64| {
        if most.is_nan() || v.is_nan() { f64::NAN } else { most.max(v.abs()) }
    };
    values.into_iter().fold(0.0, fold)
}

/// A random motion of a robot: joints within ±`reach`, everything moving at about 1 rad/s and 1 m/s, torques
/// of about 1 N·m.
fn random_motion(model: &RobotModel, reach: f64, stream: &mut Stream) -> Motion {
    let joints = model.joints().len();
    let mut many = |n: usize, most: f64| -> Vec<f64> {
        (0..n).map(|_| stream.uniform_f64(-most, most)).collect()
    };
    let three = |v: Vec<f64>| [v[0], v[1], v[2]];
    let quat = {
        let v = many(4, 1.0);
        let norm = v.iter().map(|x| x * x).sum::<f64>().sqrt().max(1e-3);
        [v[0] / norm, v[1] / norm, v[2] / norm, v[3] / norm]
    };
    let norm = quat.iter().map(|x| x * x).sum::<f64>().sqrt();
    Motion {
        world_from_base: Pose { pos_m: three(many(3, 1.0)), quat_wxyz: quat.map(|x| x / norm) },
        base_vel_mps: three(many(3, 1.0)),
        base_angvel_radps: three(many(3, 2.0)),
        joint_pos_rad: many(joints, reach),
        joint_vel_radps: many(joints, 3.0),
        joint_torque_nm: many(joints, 1.0),
    }
}
