//! First values of the weights, drawn from our own generator: libtorch's global one would make them depend on
//! its version and on whoever else draws from it.

use caudata_random::Stream;

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
            let (vector, element) = if rows <= columns {
                (row, column)
            } else {
                (column, row)
            };
            matrix[row * columns + column] = (gain * basis[vector][element]) as f32;
        }
    }
    matrix
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
        let key = Key {
            seed,
            actor: 0,
            env: 0,
            episode: 0,
        };
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
    fn the_seed_decides() {
        let a = orthogonal(&mut stream(1), 4, 4, 1.0);
        assert_eq!(a, orthogonal(&mut stream(1), 4, 4, 1.0));
        assert_ne!(a, orthogonal(&mut stream(2), 4, 4, 1.0));
    }
}
