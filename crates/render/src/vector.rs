//! Vectors, beyond what the model has for them.

pub(crate) type Vec3 = [f64; 3];

pub(crate) fn scale(v: Vec3, s: f64) -> Vec3 {
    v.map(|x| x * s)
}

pub(crate) fn unit(v: Vec3) -> Vec3 {
    let length = caudata_model::pose::norm(v).max(1e-300);
    v.map(|x| x / length)
}

/// `a` at 0, `b` at 1.
pub(crate) fn mix(a: Vec3, b: Vec3, t: f64) -> Vec3 {
    [0, 1, 2].map(|i| a[i] + (b[i] - a[i]) * t)
}
