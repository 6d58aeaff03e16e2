//! The one place where our arrays and Rapier's glam types meet.

use caudata_model::Pose as ModelPose;
use nalgebra::{Matrix3, SymmetricEigen};
use rapier3d::math::{Matrix, Pose, Rotation, Vector};
use rapier3d::prelude::MassProperties;

pub(super) fn vector(v: [f64; 3]) -> Vector {
    Vector::new(v[0] as f32, v[1] as f32, v[2] as f32)
}

pub(super) fn array(v: Vector) -> [f64; 3] {
    [f64::from(v.x), f64::from(v.y), f64::from(v.z)]
}

pub(super) fn rotation(quat_wxyz: [f64; 4]) -> Rotation {
    let [w, x, y, z] = quat_wxyz.map(|c| c as f32);
    Rotation::from_xyzw(x, y, z, w).normalize()
}

pub(super) fn pose(p: &ModelPose) -> Pose {
    Pose::from_parts(vector(p.pos_m), rotation(p.quat_wxyz))
}

/// With the quaternion brought back to unit length (it drifts in f32).
pub(super) fn model_pose(p: &Pose) -> ModelPose {
    let q = [p.rotation.w, p.rotation.x, p.rotation.y, p.rotation.z].map(f64::from);
    let length = q.iter().map(|c| c * c).sum::<f64>().sqrt();
    ModelPose { pos_m: array(p.translation), quat_wxyz: q.map(|c| c / length) }
}

/// Rotation that takes the x axis to the unit vector `axis`.
pub(super) fn rotation_from_x(axis: [f64; 3]) -> Rotation {
    Rotation::from_rotation_arc(Vector::X, vector(axis).normalize())
}

/// Mass properties about the body frame's origin. The eigenvalues are taken in f64: links of some 1e-5 kg·m²
/// are within the tolerance of an f32 decomposition.
pub(super) fn mass_properties(mass_kg: f64, inertia_kgm2: &Matrix3<f64>) -> MassProperties {
    let eigen = SymmetricEigen::new(*inertia_kgm2);
    let mut axes = eigen.eigenvectors;
    if axes.determinant() < 0.0 {
        axes.column_mut(0).neg_mut();
    }
    let column = |c: usize| vector([axes[(0, c)], axes[(1, c)], axes[(2, c)]]);
    let frame = Rotation::from_mat3(&Matrix::from_cols(column(0), column(1), column(2)));
    let principal = vector(eigen.eigenvalues.map(|e| e.max(0.0)).into());
    MassProperties::with_principal_inertia_frame(
        Vector::ZERO,
        mass_kg as f32,
        principal,
        frame.normalize(),
    )
}
