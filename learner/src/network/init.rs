//! First values of the weights, drawn from our own generator: libtorch's global one would make them depend on
//! its version and on whoever else draws from it.

use caudata_random::Stream;
use caudata_task::mirror::SignedPermutation;

/// An orthogonal matrix `[rows, columns]`, row-major, times `gain` (Saxe et al. 2014): its rows are
/// orthonormal when `rows ≤ columns`, its columns otherwise, so that signals neither grow nor fade from layer
/// to layer.
///
/// Normal draws, orthonormalised by Gram–Schmidt applied twice, which is orthogonal to rounding in f64.
pub fn orthogonal(stream: &mut Stream, rows: usize, columns: usize, gain: f64) -> Vec<f32> {
    let (vectors, length) = (rows.min(columns), rows.max(columns));
    let mut basis: Vec<Vec<f64>> = Vec::with_capacity(vectors);
    for _ in 0..vectors {
        basis.push(next_direction(stream, &basis, length));
    }
    let mut matrix = vec![0.0; rows * columns];
    for row in 0..rows {
        for column in 0..columns {
            let (vector, element) = if rows <= columns { (row, column) } else { (column, row) };
            matrix[row * columns + column] = (gain * basis[vector][element]) as f32;
        }
    }
    matrix
}

/// An orthogonal matrix times `gain` that commutes with a mirror: M_rows·W = W·M_columns. What stays the same
/// in the mirror and what changes its sign are spaces of their own on either side; each has an orthogonal
/// matrix.
pub fn equivariant(
    stream: &mut Stream,
    rows: &SignedPermutation,
    columns: &SignedPermutation,
    gain: f64,
) -> Vec<f32> {
    let mut matrix = vec![0.0_f64; rows.len() * columns.len()];
    for (out, input) in parities(rows).iter().zip(&parities(columns)) {
        let block = orthogonal(stream, out.len(), input.len(), gain);
        for (r, row) in out.iter().enumerate() {
            for (c, column) in input.iter().enumerate() {
                let value = f64::from(block[r * input.len() + c]);
                for &(o, a) in row {
                    for &(i, b) in column {
                        matrix[o * columns.len() + i] += a * b * value;
                    }
                }
            }
        }
    }
    matrix.iter().map(|&x| x as f32).collect()
}

/// A unit vector: place and value of what is not zero in it.
type Sparse = Vec<(usize, f64)>;

/// Orthonormal bases of what a mirror leaves as it is, and of what it negates.
fn parities(mirror: &SignedPermutation) -> [Vec<Sparse>; 2] {
    let (mut even, mut odd) = (Vec::new(), Vec::new());
    for (i, (&j, &sign)) in mirror.source.iter().zip(&mirror.sign).enumerate() {
        let (half, sign) = (std::f64::consts::FRAC_1_SQRT_2, f64::from(sign));
        if i == j {
            let basis = if sign > 0.0 { &mut even } else { &mut odd };
            basis.push(vec![(i, 1.0)]);
        } else if i < j {
            even.push(vec![(i, half), (j, sign * half)]);
            odd.push(vec![(i, half), (j, -sign * half)]);
        }
    }
    [even, odd]
}

/// A unit vector orthogonal to all of `basis`, which has fewer vectors than `length`.
fn next_direction(stream: &mut Stream, basis: &[Vec<f64>], length: usize) -> Vec<f64> {
    loop {
        let mut v: Vec<f64> = (0..length).map(|_| stream.normal_f64()).collect();
        for _ in 0..2 {
            for b in basis {
                let dot: f64 = v.iter().zip(b).map(|(x, y)| x * y).sum();
                v.iter_mut().zip(b).for_each(|(x, y)| *x -= dot * y);
            }
        }
        let norm = v.iter().map(|x| x * x).sum::<f64>().sqrt();
        // A draw that lies almost in the span of the others says little about a new direction.
        if norm > 1e-6 {
            v.iter_mut().for_each(|x| *x /= norm);
            return v;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use caudata_random::{Key, Purpose};

    fn stream(seed: u64) -> Stream {
        let key = Key { seed, actor: 0, env: 0, episode: 0 };
        Stream::new(key, Purpose::Init)
    }

    /// Rows of `matrix` times each other: the identity times gain².
    fn check(rows: usize, columns: usize) {
        let matrix = orthogonal(&mut stream(3), rows, columns, 2.0);
        let short = rows.min(columns);
        let at = |vector: usize, element: usize| {
            let index = if rows <= columns {
                vector * columns + element
            } else {
                element * columns + vector
            };
            f64::from(matrix[index])
        };
        for i in 0..short {
            for j in 0..short {
                let dot: f64 = (0..rows.max(columns)).map(|k| at(i, k) * at(j, k)).sum();
                let expected = if i == j { 4.0 } else { 0.0 };
                assert!((dot - expected).abs() < 1e-5, "{i} {j}: {dot}");
            }
        }
    }

    #[test]
    fn wide_tall_and_square_matrices_are_orthogonal() {
        check(5, 9);
        check(9, 5);
        check(16, 16);
        check(1, 3);
    }

    #[test]
    fn equivariant_matrices_are_orthogonal_and_commute_with_the_mirror() {
        let rows = SignedPermutation::reversal(5);
        let columns = SignedPermutation {
            source: vec![1, 0, 2, 3, 5, 4, 6, 7],
            sign: vec![1.0, 1.0, -1.0, 1.0, -1.0, -1.0, -1.0, 1.0],
        };
        let matrix = equivariant(&mut stream(3), &rows, &columns, 1.0);
        let row = |r: usize| &matrix[r * 8..][..8];
        for r in 0..5 {
            for s in 0..5 {
                let dot: f32 = row(r).iter().zip(row(s)).map(|(a, b)| a * b).sum();
                let expected = if r == s { 1.0 } else { 0.0 };
                assert!((dot - expected).abs() < 1e-5, "{r} {s}: {dot}");
            }
            // W·M_columns = M_rows·W, to the bit
            for c in 0..8 {
                let from = row(4 - r)[columns.source[c]] * columns.sign[c];
                assert_eq!(row(r)[c].to_bits() << 1, from.to_bits() << 1);
                assert!(row(r)[c] * from >= 0.0);
            }
        }
    }

    #[test]
    fn the_seed_decides() {
        let a = orthogonal(&mut stream(1), 4, 4, 1.0);
        assert_eq!(a, orthogonal(&mut stream(1), 4, 4, 1.0));
        assert_ne!(a, orthogonal(&mut stream(2), 4, 4, 1.0));
    }
}
