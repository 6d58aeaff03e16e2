//! Inner products of long single-precision traces.

use nalgebra::DMatrix;

/// Σ x·y in f64.
pub fn dot(x: &[f32], y: &[f32]) -> f64 {
    // eight partial sums: the order of addition is fixed, and the loop is a vector loop
    let mut sums = [0.0_f64; 8];
    let (xs, xr) = x.as_chunks::<8>();
    let (ys, yr) = y.as_chunks::<8>();
    for (a, b) in xs.iter().zip(ys) {
        for i in 0..8 {
            sums[i] += f64::from(a[i]) * f64::from(b[i]);
        }
    }
    let rest: f64 = xr.iter().zip(yr).map(|(a, b)| f64::from(*a) * f64::from(*b)).sum();
    sums.iter().sum::<f64>() + rest
}

/// Takes off `x` what lies along the orthonormal vectors of `basis`.
pub fn project(basis: &[Vec<f32>], x: &mut [f32]) {
    for q in basis {
        let along = dot(q, x) as f32;
        for (x, q) in x.iter_mut().zip(q) {
            *x -= along * q;
        }
    }
}

/// Adds what of `column` lies along none of `basis` to it, if that is anything: a millionth of its square, and
/// more than `least`.
pub fn widen(basis: &mut Vec<Vec<f32>>, mut column: Vec<f32>, least: f64) {
    let before = dot(&column, &column);
    project(basis, &mut column);
    let square = dot(&column, &column);
    if square > (1e-6 * before).max(least) {
        let length = square.sqrt() as f32;
        column.iter_mut().for_each(|x| *x /= length);
        basis.push(column);
    }
}

/// Inner products of all pairs of columns. `[P][N]` to `[P, P]`
pub fn gram(columns: &[Vec<f32>]) -> DMatrix<f64> {
    let n = columns.len();
    let mut out = DMatrix::zeros(n, n);
    for i in 0..n {
        for j in 0..=i {
            out[(i, j)] = dot(&columns[i], &columns[j]);
            out[(j, i)] = out[(i, j)];
        }
    }
    out
}

/// Adds a share of the largest entry that keeps the matrix definite to each entry of the diagonal.
pub fn stiffen(gram: &mut DMatrix<f64>) {
    let most = gram.diagonal().iter().copied().fold(1e-12, f64::max);
    for i in 0..gram.nrows() {
        gram[(i, i)] += 1e-9 * most;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn dot_adds_everything() {
        let x: Vec<f32> = (0..19).map(|k| k as f32).collect();
        assert_eq!(dot(&x, &[2.0; 19]), 342.0);
    }

    #[test]
    fn a_stiffened_gram_has_an_inverse() {
        // two columns that are the same
        let mut gram = gram(&[vec![1.0, 0.0], vec![1.0, 0.0]]);
        assert!(gram.clone().cholesky().is_none());
        stiffen(&mut gram);
        assert!(gram.cholesky().is_some());
    }
}
