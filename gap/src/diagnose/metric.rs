//! Whitening of one trial against its nuisances.

use std::ops::Range;

use nalgebra::{DMatrix, DVector, SymmetricEigen};

use super::product::dot;

/// κ: a nuisance of so many tolerances is as large as the floor. Of a healthy salamander's on a stand one in
/// ten is beyond 0.7 (current) to 3.9 (loop).
const TOLERANCES: f64 = 4.0;
/// A nuisance that does less than this (its share of the floor at κ tolerances) does nothing.
const LEAST_TRACE: f64 = 1e-5;

/// A nuisance's trace in a trial, where it is not zero.
pub struct Column {
    /// Places from the trial's first sample, and values: those of one tolerance times `unit`.
    pub parts: Vec<(usize, Vec<f32>)>,
    /// κ/√n.
    pub unit: f32,
    /// Which nuisance, and of which joint where each has its own: the same in all trials.
    pub of: (usize, usize),
}

impl Column {
    /// From the trace of one tolerance, which shows in `n` samples.
    pub fn new(mut parts: Vec<(usize, Vec<f32>)>, n: usize, of: (usize, usize)) -> Self {
        let unit = (TOLERANCES / (n.max(1) as f64).sqrt()) as f32;
        for x in parts.iter_mut().flat_map(|(_, v)| v) {
            *x *= unit;
        }
        Self { parts, unit, of }
    }

    /// Σ over its places of its values times `x`.
    fn dot(&self, x: &[f32]) -> f64 {
        self.parts.iter().map(|(at, v)| dot(v, &x[*at..at + v.len()])).sum()
    }

    /// Σ of products with another.
    fn times(&self, other: &Self) -> f64 {
        let mut sum = 0.0;
        for (a, x) in &self.parts {
            for (b, y) in &other.parts {
                let (low, high) = ((*a).max(*b), (a + x.len()).min(b + y.len()));
                if low < high {
                    sum += dot(&x[low - a..high - a], &y[low - b..high - b]);
                }
            }
        }
        sum
    }

    /// Takes `c` times itself off `x`.
    fn take_off(&self, c: f32, x: &mut [f32]) {
        for (at, v) in &self.parts {
            for (x, v) in x[*at..at + v.len()].iter_mut().zip(v) {
                *x -= c * v;
            }
        }
    }
}

/// Whitening of one trial.
pub struct TrialMetric {
    /// Its samples.
    pub range: Range<usize>,
    /// Nuisance traces in units of noise. `[K]`
    pub columns: Vec<Column>,
    /// V·diag((1 − 1/√(1+s))/s)·Vᵀ of the Gram matrix V·S·Vᵀ. `[K, K]`
    shrink: DMatrix<f64>,
}

impl TrialMetric {
    /// The metric of the trial whose samples are in `range`.
    pub fn new(range: Range<usize>, mut columns: Vec<Column>) -> Self {
        columns.retain(|c| c.times(c) > LEAST_TRACE);
        let k = columns.len();
        let factor = |s: f64| match s > 1e-9 {
            true => (1.0 - 1.0 / (1.0 + s).sqrt()) / s,
            false => 0.5,
        };
        // of nothing there is no decomposition
        let shrink = if k == 0 {
            DMatrix::zeros(0, 0)
        } else {
            let gram = DMatrix::from_fn(k, k, |i, j| columns[i].times(&columns[j]));
            let eigen = SymmetricEigen::try_new(gram, f64::EPSILON, 100 * k);
            eigen.map_or_else(
                || DMatrix::zeros(k, k),
                |mut eigen| {
                    eigen.eigenvalues.apply(|s| *s = factor(*s));
                    eigen.recompose()
                },
            )
        };
        Self { range, columns, shrink }
    }

    /// Whitens the trial's samples.
    pub fn apply(&self, x: &mut [f32]) {
        let along = self.columns.iter().map(|c| c.dot(x));
        let along = DVector::from_iterator(self.columns.len(), along);
        let shares = &self.shrink * along;
        for (column, c) in self.columns.iter().zip(shares.iter()) {
            column.take_off(*c as f32, x);
        }
    }
}
