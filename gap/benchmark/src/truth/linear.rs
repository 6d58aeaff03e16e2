//! The little linear algebra that the truth needs, in double precision.

/// A vector.
pub type V3 = [f64; 3];
/// A matrix, rows first.
pub type M3 = [[f64; 3]; 3];

pub use caudata_model::pose::{add, cross, dot, norm, sub, turn_tensor as turn};

/// `s·a`.
pub fn scale(a: V3, s: f64) -> V3 {
    a.map(|x| x * s)
}

/// `m·v`.
pub fn mul(m: &M3, v: V3) -> V3 {
    [dot(m[0], v), dot(m[1], v), dot(m[2], v)]
}

/// `a + b`.
pub fn add3(a: &M3, b: &M3) -> M3 {
    let mut out = *a;
    for r in 0..3 {
        for c in 0..3 {
            out[r][c] += b[r][c];
        }
    }
    out
}

/// Inertia of a point mass `m` at `r`: m·(r²·1 − r rᵀ).
pub fn point_inertia(m: f64, r: V3) -> M3 {
    let rr = dot(r, r);
    let mut out = [[0.0; 3]; 3];
    for i in 0..3 {
        for j in 0..3 {
            out[i][j] = -m * r[i] * r[j];
        }
        out[i][i] += m * rr;
    }
    out
}

/// Solves `a·x = b` for a symmetric positive definite `a` (`[n, n]`, rows first, overwritten by its factor);
/// `b` becomes `x`.
///
/// Returns whether `a` was positive definite; if not, `b` is not to be used.
pub fn solve_spd(a: &mut [f64], b: &mut [f64]) -> bool {
    let n = b.len();
    for j in 0..n {
        let mut d = a[j * n + j];
        for k in 0..j {
            d -= a[j * n + k] * a[j * n + k];
        }
        if d.is_nan() || d <= 0.0 {
            return false;
        }
        let d = d.sqrt();
        a[j * n + j] = d;
        for i in j + 1..n {
            let mut s = a[i * n + j];
            for k in 0..j {
                s -= a[i * n + k] * a[j * n + k];
            }
            a[i * n + j] = s / d;
        }
    }
    for i in 0..n {
        for k in 0..i {
            b[i] -= a[i * n + k] * b[k];
        }
        b[i] /= a[i * n + i];
    }
    for i in (0..n).rev() {
        for k in i + 1..n {
            b[i] -= a[k * n + i] * b[k];
        }
        b[i] /= a[i * n + i];
    }
    true
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn solves_a_small_system() {
        // [4 2; 2 3]·[1; −1] = [2; −1]
        let mut a = [4.0, 2.0, 2.0, 3.0];
        let mut b = [2.0, -1.0];
        assert!(solve_spd(&mut a, &mut b));
        assert!((b[0] - 1.0).abs() < 1e-12 && (b[1] + 1.0).abs() < 1e-12);
        assert!(!solve_spd(&mut [1.0, 2.0, 2.0, 1.0], &mut [1.0, 1.0]));
    }
}
