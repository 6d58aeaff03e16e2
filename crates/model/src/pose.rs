//! Rigid transforms in plain arrays: what forward kinematics works with.
//!
//! Quaternions are `[w, x, y, z]`, right-handed, active: `rotate` takes a vector from the inner frame to the
//! outer one.

/// A rigid transform `outer_from_inner`: rotate by `quat_wxyz`, then shift by `pos_m`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pose {
    /// Origin of the inner frame, in the outer frame, m.
    pub pos_m: [f64; 3],
    /// Rotation from the inner to the outer frame; unit quaternion w, x, y, z.
    pub quat_wxyz: [f64; 4],
}

impl Pose {
    /// No shift, no rotation.
    pub const IDENTITY: Self = Self { pos_m: [0.0; 3], quat_wxyz: [1.0, 0.0, 0.0, 0.0] };

    /// A pure shift by `pos_m`.
    pub fn from_pos(pos_m: [f64; 3]) -> Self {
        Self { pos_m, quat_wxyz: [1.0, 0.0, 0.0, 0.0] }
    }

    /// `self * inner`: the transform that applies `inner` first.
    pub fn compose(&self, inner: &Self) -> Self {
        Self {
            pos_m: self.point(inner.pos_m),
            quat_wxyz: quat_mul(self.quat_wxyz, inner.quat_wxyz),
        }
    }

    /// A point of the inner frame, m, expressed in the outer frame, m.
    pub fn point(&self, p: [f64; 3]) -> [f64; 3] {
        add(self.pos_m, self.rotate(p))
    }

    /// A free vector of the inner frame expressed in the outer frame.
    pub fn rotate(&self, v: [f64; 3]) -> [f64; 3] {
        quat_rotate(self.quat_wxyz, v)
    }

    /// The inverse transform.
    pub fn inverse(&self) -> Self {
        let [w, x, y, z] = self.quat_wxyz;
        let quat_wxyz = [w, -x, -y, -z];
        let p = quat_rotate(quat_wxyz, self.pos_m);
        Self { pos_m: [-p[0], -p[1], -p[2]], quat_wxyz }
    }

    /// Rotation matrix, rows first: `outer = R · inner`.
    pub fn rotation(&self) -> [[f64; 3]; 3] {
        quat_to_matrix(self.quat_wxyz)
    }
}

/// Sum of two vectors.
pub fn add(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[0] + b[0], a[1] + b[1], a[2] + b[2]]
}

/// `a - b`.
pub fn sub(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

/// Dot product.
pub fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

/// Cross product.
pub fn cross(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

/// Euclidean length.
pub fn norm(a: [f64; 3]) -> f64 {
    dot(a, a).sqrt()
}

/// Quaternion of a turn by `angle_rad` about the unit vector `axis`.
pub fn quat_from_axis_angle(axis: [f64; 3], angle_rad: f64) -> [f64; 4] {
    let (s, c) = (0.5 * angle_rad).sin_cos();
    [c, s * axis[0], s * axis[1], s * axis[2]]
}

/// Hamilton product `a · b` (b is applied first).
pub fn quat_mul(a: [f64; 4], b: [f64; 4]) -> [f64; 4] {
    [
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    ]
}

/// Rotates `v` by the unit quaternion `q`.
pub fn quat_rotate(q: [f64; 4], v: [f64; 3]) -> [f64; 3] {
    // v + 2 w (u × v) + 2 u × (u × v), with q = (w, u)
    let u = [q[1], q[2], q[3]];
    let t = cross(u, v);
    let t2 = cross(u, t);
    [
        v[0] + 2.0 * (q[0] * t[0] + t2[0]),
        v[1] + 2.0 * (q[0] * t[1] + t2[1]),
        v[2] + 2.0 * (q[0] * t[2] + t2[2]),
    ]
}

/// Rotation matrix (rows first) of a unit quaternion.
pub fn quat_to_matrix(q: [f64; 4]) -> [[f64; 3]; 3] {
    let cols = [
        quat_rotate(q, [1.0, 0.0, 0.0]),
        quat_rotate(q, [0.0, 1.0, 0.0]),
        quat_rotate(q, [0.0, 0.0, 1.0]),
    ];
    let mut m = [[0.0; 3]; 3];
    for r in 0..3 {
        for c in 0..3 {
            m[r][c] = cols[c][r];
        }
    }
    m
}

/// The unit quaternion in the direction of `q`; `None` where `q` is (nearly) zero or not finite.
pub fn quat_normalised(q: [f64; 4]) -> Option<[f64; 4]> {
    let n = q.iter().map(|x| x * x).sum::<f64>().sqrt();
    (n.is_finite() && n > 1e-9).then(|| q.map(|x| x / n))
}

/// Orientation of a frame whose x axis is along `x` and whose y axis is in the plane of `x` and `y`; `None`
/// where these make no plane.
pub fn quat_from_axes(x: [f64; 3], y: [f64; 3]) -> Option<[f64; 4]> {
    let unit = |v: [f64; 3]| {
        let n = norm(v);
        (n > 1e-9).then(|| v.map(|c| c / n))
    };
    let x = unit(x)?;
    let along = dot(x, y);
    let y = unit(sub(y, x.map(|c| c * along)))?;
    let z = cross(x, y);
    // columns x, y, z: the largest of the four squares decides which part is taken first
    let m = [[x[0], y[0], z[0]], [x[1], y[1], z[1]], [x[2], y[2], z[2]]];
    let trace = m[0][0] + m[1][1] + m[2][2];
    let quat = if trace > 0.0 {
        [1.0 + trace, m[2][1] - m[1][2], m[0][2] - m[2][0], m[1][0] - m[0][1]]
    } else {
        let i = (0..3).fold(0, |best, i| if m[i][i] > m[best][best] { i } else { best });
        let (j, k) = ((i + 1) % 3, (i + 2) % 3);
        let mut q = [m[k][j] - m[j][k], 0.0, 0.0, 0.0];
        q[1 + i] = 1.0 + m[i][i] - m[j][j] - m[k][k];
        q[1 + j] = m[j][i] + m[i][j];
        q[1 + k] = m[k][i] + m[i][k];
        q
    };
    quat_normalised(quat)
}

/// `R · m · Rᵀ`: a symmetric tensor `m` of the inner frame expressed in the outer frame.
pub fn rotate_tensor(q: [f64; 4], m: [[f64; 3]; 3]) -> [[f64; 3]; 3] {
    turn_tensor(&quat_to_matrix(q), &m)
}

/// [`rotate_tensor`] by a rotation matrix.
pub fn turn_tensor(r: &[[f64; 3]; 3], m: &[[f64; 3]; 3]) -> [[f64; 3]; 3] {
    let mut out = [[0.0; 3]; 3];
    for i in 0..3 {
        for j in 0..3 {
            for k in 0..3 {
                for l in 0..3 {
                    out[i][j] += r[i][k] * m[k][l] * r[j][l];
                }
            }
        }
    }
    out
}

/// The shortest turn that takes the z axis to the unit vector `d`.
pub(crate) fn z_to(d: [f64; 3]) -> [f64; 4] {
    let w = 1.0 + d[2];
    if w < 1e-12 {
        return [0.0, 1.0, 0.0, 0.0]; // half a turn about x
    }
    // (1 + z·d, z × d), normalised
    quat_normalised([w, -d[1], d[0], 0.0]).unwrap_or([1.0, 0.0, 0.0, 0.0])
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::FRAC_PI_2;

    fn close(a: [f64; 3], b: [f64; 3]) {
        for i in 0..3 {
            assert!((a[i] - b[i]).abs() < 1e-12, "{a:?} is not {b:?}");
        }
    }

    #[test]
    fn a_quarter_turn_about_z_takes_x_to_y() {
        let pose = Pose {
            pos_m: [1.0, 2.0, 3.0],
            quat_wxyz: quat_from_axis_angle([0.0, 0.0, 1.0], FRAC_PI_2),
        };
        close(pose.rotate([1.0, 0.0, 0.0]), [0.0, 1.0, 0.0]);
        close(pose.point([1.0, 0.0, 0.0]), [1.0, 3.0, 3.0]);
        close(pose.inverse().point([1.0, 3.0, 3.0]), [1.0, 0.0, 0.0]);
        let m = pose.rotation();
        // R = [[0,-1,0],[1,0,0],[0,0,1]]
        close(m[0], [0.0, -1.0, 0.0]);
        close(m[1], [1.0, 0.0, 0.0]);
    }

    #[test]
    fn axes_give_the_turn_that_has_them() {
        for q in [[0.3, -0.4, 0.5, 0.7], [0.01, 0.9, 0.1, -0.2], [0.0, 0.0, 0.0, 1.0]] {
            let q = quat_normalised(q).unwrap();
            let m = |v: [f64; 3]| quat_rotate(q, v);
            let found = quat_from_axes(m([2.0, 0.0, 0.0]), m([0.5, 3.0, 0.0])).unwrap();
            close(quat_rotate(found, [1.0, 2.0, 3.0]), m([1.0, 2.0, 3.0]));
        }
        assert!(quat_from_axes([1.0, 0.0, 0.0], [2.0, 0.0, 0.0]).is_none());
    }

    #[test]
    fn compose_applies_the_inner_pose_first() {
        let turn = Pose {
            pos_m: [0.0, 0.0, 1.0],
            quat_wxyz: quat_from_axis_angle([0.0, 1.0, 0.0], FRAC_PI_2),
        };
        // shift by x, then turn about y: x goes to -z, and one up again
        close(turn.compose(&Pose::from_pos([1.0, 0.0, 0.0])).pos_m, [0.0, 0.0, 0.0]);
    }

    #[test]
    fn a_tensor_turned_a_quarter_about_z_swaps_its_x_and_y_parts() {
        let q = quat_from_axis_angle([0.0, 0.0, 1.0], FRAC_PI_2);
        let m = [[1.0, 0.1, 0.2], [0.1, 2.0, 0.3], [0.2, 0.3, 3.0]];
        // x' = y, y' = -x: xx' = yy... worked: new xx = old yy, new xy = -old xy, new xz = -old yz, new yz =
        // old xz
        let t = rotate_tensor(q, m);
        close(t[0], [2.0, -0.1, -0.3]);
        close(t[1], [-0.1, 1.0, 0.2]);
        close(t[2], [-0.3, 0.2, 3.0]);
    }

    #[test]
    fn z_to_points_the_z_axis() {
        for d in
            [[0.0, 0.0, 1.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.6, 0.0, -0.8], [0.0, -0.6, 0.8]]
        {
            let z = quat_rotate(z_to(d), [0.0, 0.0, 1.0]);
            for i in 0..3 {
                assert!((z[i] - d[i]).abs() < 1e-12, "{d:?} gave {z:?}");
            }
        }
    }
}
