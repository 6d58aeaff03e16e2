//! Dynamics written plainly: mass matrix and bias forces from Jacobians, solved densely. Shares nothing with
//! the engine but the model's forward kinematics.

use caudata_model::{BaseKind, JointMotion, RobotModel};
use caudata_sim::batch::smooth::{Accelerations, Motion};
use nalgebra::{DMatrix, DVector, Matrix3, Vector3};

/// Angular and linear velocity of a link's centre of mass per unit of one coordinate.
type Column = (Vector3<f64>, Vector3<f64>);

/// What [`caudata_sim::batch::smooth::accelerations`] should give.
pub fn accelerations(model: &RobotModel, held: bool, at: &Motion) -> Accelerations {
    let free = model.base() == BaseKind::Free && !held;
    let places = model.kinematics(&at.world_from_base, &at.joint_pos_rad).unwrap();
    let joints = model.joints().len();
    let first = if free { 6 } else { 0 };
    let n = first + joints;
    // lane parameters are f32: so are gravity and rotor inertia here
    let gravity = Vector3::from(model.gravity_mps2().map(|g| f64::from(g as f32)));
    let base = Vector3::from(at.world_from_base.pos_m);
    let (mut mass, mut force) = (DMatrix::zeros(n, n), DVector::zeros(n));
    for (l, link) in model.links().iter().enumerate() {
        let pose = &places.links[l];
        let com = Vector3::from(pose.point(link.com_m));
        let rotation = Matrix3::from_fn(|r, c| pose.rotation()[r][c]);
        let inertia =
            rotation * Matrix3::from_fn(|r, c| link.inertia_kgm2[r][c]) * rotation.transpose();
        let moved_by = path(model, l);
        // velocity and bias acceleration of the material point at the centre of mass, walking out along the
        // joints
        let (mut w, mut alpha, mut v, mut a, mut point) = if free {
            let spin = Vector3::from(at.base_angvel_radps);
            (spin, Vector3::zeros(), Vector3::from(at.base_vel_mps), Vector3::zeros(), base)
        } else {
            let o = Vector3::zeros();
            (o, o, o, o, base)
        };
        let mut columns: Vec<Column> = vec![(Vector3::zeros(), Vector3::zeros()); n];
        if free {
            for k in 0..3 {
                let unit = Vector3::ith(k, 1.0);
                columns[k] = (Vector3::zeros(), unit);
                columns[3 + k] = (unit, unit.cross(&(com - base)));
            }
        }
        for &j in &moved_by {
            let frame = places.joints[j];
            let (axis, anchor) = (Vector3::from(frame.axis), Vector3::from(frame.anchor_m));
            let qd = at.joint_vel_radps[j];
            let arm = anchor - point;
            a += alpha.cross(&arm) + w.cross(&w.cross(&arm));
            v += w.cross(&arm);
            point = anchor;
            match model.joints()[j].motion {
                JointMotion::Hinge => {
                    alpha += w.cross(&axis) * qd;
                    w += axis * qd;
                    columns[first + j] = (axis, axis.cross(&(com - anchor)));
                }
                JointMotion::Slide => {
                    // Coriolis of the sliding point; its anchor moves with it, so the arm to what follows
                    // starts there
                    a += w.cross(&axis) * (2.0 * qd);
                    v += axis * qd;
                    point += axis * at.joint_pos_rad[j];
                    let moved = axis * at.joint_pos_rad[j];
                    a += alpha.cross(&moved) + w.cross(&w.cross(&moved));
                    v += w.cross(&moved);
                    columns[first + j] = (Vector3::zeros(), axis);
                }
            }
        }
        let arm = com - point;
        a += alpha.cross(&arm) + w.cross(&w.cross(&arm));
        let push = (a - gravity) * link.mass_kg;
        let twist = inertia * alpha + w.cross(&(inertia * w));
        for r in 0..n {
            let (wr, vr) = columns[r];
            force[r] -= wr.dot(&twist) + vr.dot(&push);
            for c in 0..n {
                let (wc, vc) = columns[c];
                mass[(r, c)] += link.mass_kg * vr.dot(&vc) + wr.dot(&(inertia * wc));
            }
        }
    }
    for (j, joint) in model.joints().iter().enumerate() {
        mass[(first + j, first + j)] += f64::from(joint.armature_kgm2 as f32);
        force[first + j] += at.joint_torque_nm[j];
    }
    let x = mass.lu().solve(&force).unwrap();
    let three = |k: usize| {
        if free { [x[k], x[k + 1], x[k + 2]] } else { [0.0; 3] }
    };
    Accelerations {
        base_mps2: three(0),
        base_radps2: three(3),
        joint_radps2: (0..joints).map(|j| x[first + j]).collect(),
    }
}

/// Joints between the base and a link, outermost first.
fn path(model: &RobotModel, link: usize) -> Vec<usize> {
    let mut all = match model.links()[link].parent {
        Some(p) => path(model, p),
        None => Vec::new(),
    };
    all.extend(&model.links()[link].joints);
    all
}
