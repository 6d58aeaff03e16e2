//! How easily the robot gives way at its joints and links: diagonals of the inverse of its inertia, in the
//! zero pose.
//!
//! MuJoCo calls them `dof_invweight0` and `body_invweight0` and scales soft constraints with them (its
//! documentation, "Computation", "Constraint model"), so that one time constant suits a fin and a trunk.
//! Worked out once per engine, from the model's own masses: a stop belongs to the joint as it was built, and
//! a payload does not change it.

use caudata_model::pose::{cross, sub};
use caudata_model::{JointMotion, Kinematics, Pose, RobotModel};
use nalgebra::{DMatrix, Matrix3};

use crate::{EngineConfig, SimError};

/// Smallest inverse inertia that is used: MuJoCo's `mjMINVAL`.
const LEAST_INVERSE: f64 = 1e-15;

/// Inverse inertias in the zero pose.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Mobility {
    /// Acceleration of each joint per torque on it, 1/(kg·m²) (slides: 1/kg), model order; 0 where it is
    /// held.
    pub joints: Vec<f64>,
    /// Acceleration of each link's centre of mass per force on it, mean over directions, 1/kg; 0 where it is
    /// held.
    pub links: Vec<f64>,
}

impl Mobility {
    /// The mobility of `model` as `config` lets it move.
    ///
    /// # Errors
    /// [`SimError::Model`] where its inertia is singular: a joint that moves nothing.
    pub fn of(model: &RobotModel, config: &EngineConfig) -> Result<Self, SimError> {
        let refused = |e: caudata_model::ModelError| SimError::Model(e.to_string());
        let zero = vec![0.0; model.joints().len()];
        let places = model.kinematics(&Pose::IDENTITY, &zero).map_err(refused)?;
        let base = if config.frees_base(model) { 6 } else { 0 };
        // column of each joint in the inertia
        let mut columns = vec![None; model.joints().len()];
        let mut size = base;
        for (j, joint) in model.joints().iter().enumerate() {
            if !config.holds(joint) {
                columns[j] = Some(size);
                size += 1;
            }
        }
        let mut inertia = DMatrix::<f64>::zeros(size, size);
        let mut jacobians = Vec::with_capacity(model.links().len());
        for (i, link) in model.links().iter().enumerate() {
            let jacobian = jacobian(model, &places, i, base, &columns, size);
            let turn =
                caudata_model::pose::rotate_tensor(places.links[i].quat_wxyz, link.inertia_kgm2);
            let own = Matrix3::from_fn(|r, c| turn[r][c]);
            let (lin, ang) = (jacobian.rows(0, 3), jacobian.rows(3, 3));
            inertia += link.mass_kg * lin.transpose() * lin + ang.transpose() * own * ang;
            jacobians.push(jacobian);
        }
        for (joint, column) in model.joints().iter().zip(&columns) {
            if let Some(c) = *column {
                inertia[(c, c)] += joint.armature_kgm2;
            }
        }
        let singular = || SimError::Model("a joint moves no inertia".to_owned());
        let inverse = inertia.cholesky().ok_or_else(singular)?.inverse();
        let joints =
            (columns.iter().map(|c| c.map_or(0.0, |c| inverse[(c, c)].max(LEAST_INVERSE))))
                .collect();
        let links = jacobians
            .iter()
            .map(|jacobian| {
                let lin = jacobian.rows(0, 3);
                let give = (lin * &inverse * lin.transpose()).trace() / 3.0;
                if give > 0.0 { give.max(LEAST_INVERSE) } else { 0.0 }
            })
            .collect();
        Ok(Self { joints, links })
    }
}

/// How the coordinates move link `i`. Rows: velocity of its centre of mass, angular velocity; columns: `base`
/// of the base, then the joints' `columns`.
fn jacobian(
    model: &RobotModel,
    places: &Kinematics,
    i: usize,
    base: usize,
    columns: &[Option<usize>],
    size: usize,
) -> DMatrix<f64> {
    let com = places.links[i].point(model.links()[i].com_m);
    let mut jacobian = DMatrix::<f64>::zeros(6, size);
    let mut put = |column: usize, lin: [f64; 3], ang: [f64; 3]| {
        for c in 0..3 {
            jacobian[(c, column)] = lin[c];
            jacobian[(3 + c, column)] = ang[c];
        }
    };
    for c in 0..base {
        let mut unit = [0.0; 3];
        unit[c % 3] = 1.0;
        if c < 3 {
            put(c, unit, [0.0; 3]);
        } else {
            put(c, cross(unit, sub(com, places.links[0].pos_m)), unit);
        }
    }
    let mut at = Some(i);
    while let Some(k) = at {
        for &j in &model.links()[k].joints {
            let Some(column) = columns[j] else { continue };
            let frame = &places.joints[j];
            match model.joints()[j].motion {
                JointMotion::Hinge => {
                    let arm = sub(com, frame.anchor_m);
                    put(column, cross(frame.axis, arm), frame.axis);
                }
                JointMotion::Slide => put(column, frame.axis, [0.0; 3]),
            }
        }
        at = model.links()[k].parent;
    }
    jacobian
}

#[cfg(test)]
mod tests {
    use super::*;

    /// MuJoCo 3.17's `dof_invweight0` and `body_invweight0` of the same MJCF.
    #[test]
    fn as_mujoco_has_them() {
        let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../robots/polymander.robot.toml");
        let model = RobotModel::load(std::path::Path::new(path)).unwrap();
        let found = Mobility::of(&model, &EngineConfig::default()).unwrap();
        let near = |what: &str, got: f64, want: f64| {
            assert!((got / want - 1.0).abs() < 1e-6, "{what}: {got}, MuJoCo {want}");
        };
        for (name, want) in [
            ("spine_1", 327.779_737_660_525_37),
            ("backlash_front_x", 15_468.153_931_602_82),
            ("backlash_hind_y", 2_287.327_902_256_725_3),
            ("FL_hip", 326.345_475_961_274),
            ("FL_knee", 412.630_192_634_761_44),
            ("joint_body_09_passive", 830.994_222_870_507_9),
        ] {
            near(name, found.joints[model.joint_index(name).unwrap()], want);
        }
        for (name, want) in [
            ("body_00", 1.603_876_33),
            ("FL_lower", 2.411_292_83),
            ("HR_lower", 2.446_419_97),
            ("body_10", 2.807_313_25),
        ] {
            let link = model.links().iter().position(|l| l.name == name).unwrap();
            near(name, found.links[link], want);
        }
    }
}
