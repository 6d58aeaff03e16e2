//! Cross-validation on the runs that are fitted: what a model would say of a part of them that it was not
//! fitted to.
//!
//! A part is a run (the mean of its repeats, which are never parted), or a third of its time. Leaving one
//! out moves the parameters by what one step of Gauss–Newton says, so that all folds come out of a single
//! set of derivatives: with A = Σ J_fᵀJ_f and b = Σ J_fᵀr_f over folds f, the parameters without fold f are off
//! by (A − A_f + Λ)⁻¹·(b − b_f − Λ·θ), θ their distance from no effect and Λ the precision of a prior that is
//! as wide as that distance: what only one fold has shown is not known without it. (But what acts at a threshold, a
//! stop or a limit, is met where it is met: in a run that was repeated its repeats vouch for it.) For linear models this is
//! exact (D. M. Allen, The relationship between variable selection and data augmentation and a method for
//! prediction, Technometrics 16, 1974).

use std::ops::Range;

use nalgebra::{DMatrix, DVector};

use super::product::dot;
use crate::replay::{Data, Piece};

/// Parts of a run, where a run is more than one.
const PARTS_OF_A_RUN: usize = 3;
/// With so many runs models of angles leave out whole ones: what holds in other motions is asked for then.
const MANY_RUNS: usize = 6;

/// What shows with this share of its square in one fold shows in that alone.
const IN_ONE_FOLD: f64 = 0.9;

/// Which sample is in which fold.
#[derive(Debug, Clone, Default)]
pub struct Folds {
    /// Samples next to each other of one fold.
    spans: Vec<(Range<usize>, usize)>,
    /// Whether each is the mean of several runs. `[F]`
    repeated: Vec<bool>,
}

/// A parameter of a fitted model, in steps of its derivative.
#[derive(Debug, Clone, Copy)]
pub struct Free {
    /// How far it is from no effect.
    pub from_neutral: f64,
    /// How far it may go down and up.
    pub room: (f64, f64),
    /// Whether it acts at a threshold only.
    pub at_a_threshold: bool,
}

impl Folds {
    /// Parts all samples of `data` by thirds of each run: what shows in one run only can still prove itself
    /// there.
    pub fn of(data: &Data) -> Self {
        Self::of_channels(data, PARTS_OF_A_RUN, |_| true).0
    }

    /// Parts the samples of those channels that `keep` keeps, by runs where there are several, else by thirds
    /// of them; as [`Self::of_channels`].
    pub fn of_runs(data: &Data, keep: impl Fn(&Piece) -> bool) -> (Self, Vec<Range<usize>>) {
        let parts = if data.trials.len() < MANY_RUNS { PARTS_OF_A_RUN } else { 1 };
        Self::of_channels(data, parts, keep)
    }

    /// Parts the samples of those channels that `keep` keeps, put one behind the other, and says where they are in
    /// the flat vector.
    fn of_channels(
        data: &Data,
        parts: usize,
        keep: impl Fn(&Piece) -> bool,
    ) -> (Self, Vec<Range<usize>>) {
        let repeated = data.trials.iter().flat_map(|t| vec![!t.members.is_empty(); parts]);
        let mut folds = Self { spans: Vec::new(), repeated: repeated.collect() };
        let mut ranges = Vec::new();
        let mut kept = 0;
        for (number, _) in data.trials.iter().enumerate() {
            let own = || data.segments.iter().filter(|s| s.trial == number);
            let from_s = own().map(|s| s.start_s).fold(f64::INFINITY, f64::min);
            let to_s = own().map(|s| s.end_s).fold(f64::NEG_INFINITY, f64::max);
            let part = |t_s: f64| {
                let share = (t_s - from_s) / (to_s - from_s).max(1e-9);
                ((parts as f64 * share) as usize).min(parts - 1)
            };
            for piece in own().flat_map(|s| &s.pieces).filter(|p| keep(p)) {
                let mut from = kept;
                for k in piece.range.clone() {
                    kept += 1;
                    let here = part(data.time_s[k]);
                    if k + 1 == piece.range.end || part(data.time_s[k + 1]) != here {
                        folds.spans.push((from..kept, parts * number + here));
                        from = kept;
                    }
                }
                ranges.push(piece.range.clone());
            }
        }
        (folds, ranges)
    }

    /// Residuals of each fold with the parameters that the others ask for. `columns`: derivatives of the
    /// prediction by each parameter. `[P][N]`, `[N]`, `[P]` to `[N]`
    pub fn left_out(&self, columns: &[Vec<f32>], residual: &[f32], free: &[Free]) -> Vec<f32> {
        self.left_out_with(columns, residual, free).0
    }

    /// What each fold adds to the mean absolute value of `left`: they sum up to it. `[F]`
    pub fn shares(&self, left: &[f32]) -> Vec<f64> {
        let mut shares = vec![0.0; self.repeated.len()];
        for (range, fold) in &self.spans {
            let sum: f64 = left[range.clone()].iter().map(|v| f64::from(v.abs())).sum();
            shares[*fold] += sum / left.len() as f64;
        }
        shares
    }

    /// The same with the change of the parameters without each fold, in steps. `([N], [F][P])`
    pub fn left_out_with(
        &self,
        columns: &[Vec<f32>],
        residual: &[f32],
        free: &[Free],
    ) -> (Vec<f32>, Vec<DVector<f64>>) {
        let n = columns.len();
        let mut out = residual.to_vec();
        if n == 0 {
            return (out, Vec::new());
        }
        let count = self.repeated.len();
        let mut grams = vec![DMatrix::<f64>::zeros(n, n); count];
        let mut slopes = vec![DVector::<f64>::zeros(n); count];
        for (range, fold) in &self.spans {
            for i in 0..n {
                let own = &columns[i][range.clone()];
                slopes[*fold][i] += dot(own, &residual[range.clone()]);
                for j in 0..=i {
                    grams[*fold][(i, j)] += dot(own, &columns[j][range.clone()]);
                }
            }
        }
        for gram in &mut grams {
            gram.fill_upper_triangle_with_lower_triangle();
        }
        let gram: DMatrix<f64> = grams.iter().fold(DMatrix::zeros(n, n), |sum, g| sum + g);
        let slope: DVector<f64> = slopes.iter().fold(DVector::zeros(n), |sum, s| sum + s);
        let vouched = |g: &DMatrix<f64>, repeated: bool| -> Vec<bool> {
            let here_alone = |i: usize| g[(i, i)] > IN_ONE_FOLD * gram[(i, i)];
            (0..n).map(|i| repeated && free[i].at_a_threshold && here_alone(i)).collect()
        };
        let shifts: Vec<DVector<f64>> = (grams.iter().zip(&slopes).zip(&self.repeated))
            .map(|((g, s), repeated)| {
                without(&(&gram - g), &(&slope - s), free, &vouched(g, *repeated))
            })
            .collect();
        for (range, fold) in &self.spans {
            for (column, by) in columns.iter().zip(shifts[*fold].iter()) {
                let by = *by as f32;
                for (r, c) in (out[range.clone()].iter_mut()).zip(&column[range.clone()]) {
                    *r -= by * c;
                }
            }
        }
        (out, shifts)
    }
}

/// Whether what `before` sums up to falls to that of `after` by more than its standard error over the folds (the rule of
/// one standard error, for paired errors: L. Breiman et al., Classification and Regression Trees, 1984, section 3.4.3).
/// What falls in one fold only does not. `[F]`, `[F]`
pub fn falls(before: &[f64], after: &[f64]) -> bool {
    let by: Vec<f64> = before.iter().zip(after).map(|(b, a)| b - a).collect();
    let folds = by.len() as f64;
    let (sum, square) = by.iter().fold((0.0, 0.0), |(s, q), d| (s + d, q + d * d));
    let variance = folds / f64::max(folds - 1.0, 1.0) * (square - sum * sum / folds);
    // a hair more: all in one fold is exactly one standard error
    sum > 1.001 * variance.max(0.0).sqrt()
}

/// Standard deviations of parameters by the jackknife over folds, SI, from their `shifts` without each fold, in
/// `steps`.
pub fn jackknife(shifts: &[DVector<f64>], steps: &[f64]) -> Vec<f64> {
    let folds = shifts.len().max(1) as f64;
    let deviation = |(p, step): (usize, &f64)| {
        let mean = shifts.iter().map(|s| s[p]).sum::<f64>() / folds;
        let square: f64 = shifts.iter().map(|s| (s[p] - mean).powi(2)).sum();
        step * (square * (folds - 1.0) / folds).sqrt()
    };
    steps.iter().enumerate().map(deviation).collect()
}

/// By how much the parameters change where `gram` and `slope` are all that is known, beside those that stay.
fn without(
    gram: &DMatrix<f64>,
    slope: &DVector<f64>,
    free: &[Free],
    stay: &[bool],
) -> DVector<f64> {
    let mut gram = gram.clone();
    let mut slope = slope.clone();
    for (i, f) in free.iter().enumerate() {
        if stay[i] {
            gram.row_mut(i).fill(0.0);
            gram.column_mut(i).fill(0.0);
            gram[(i, i)] = 1.0;
            slope[i] = 0.0;
            continue;
        }
        let size = f.from_neutral.abs().max(1e-3);
        let precision = 1.0 / (size * size);
        gram[(i, i)] += precision;
        slope[i] -= precision * f.from_neutral;
    }
    let mut shift =
        gram.cholesky().map_or_else(|| DVector::zeros(slope.len()), |c| c.solve(&slope));
    for (s, f) in shift.iter_mut().zip(free) {
        // no further than to no effect, or to twice of it: there a straight line says nothing any more
        let most = f.from_neutral.abs();
        *s = s.clamp(f.room.0.max(-most).min(0.0), f.room.1.min(most).max(0.0));
    }
    shift
}

#[cfg(test)]
mod tests {
    use super::*;

    fn folds(count: usize, each: usize) -> Folds {
        let spans = (0..count).map(|f| (f * each..(f + 1) * each, f)).collect();
        Folds { spans, repeated: vec![false; count] }
    }

    const FREE: Free = Free { from_neutral: 2.0, room: (-1e9, 1e9), at_a_threshold: false };

    #[test]
    fn what_a_fold_says_of_itself_is_left_out() {
        // y = 2·x in three folds but for one that is off by 3: mean of the others without it
        let columns = [vec![1.0_f32; 6]];
        let measured = [2.0_f32, 2.0, 2.0, 2.0, 5.0, 5.0];
        // fitted to all: 3
        let residual: Vec<f32> = measured.iter().map(|y| y - 3.0).collect();
        let free = Free { from_neutral: 3.0, ..FREE };
        let left = folds(3, 2).left_out(&columns, &residual, &[free]);
        // the last fold by the mean of the first two, which a prior of width 3 draws to nothing:
        // (4·2)/(4 + 1/9) = 1.946
        assert!((left[4] - (5.0 - 1.946)).abs() < 2e-3, "{left:?}");
        // the first by the others: (2·2 + 2·5)/(4 + 1/9) = 3.405
        assert!((left[0] - (2.0 - 3.405)).abs() < 2e-3, "{left:?}");
    }

    #[test]
    fn what_falls_in_one_fold_only_does_not_fall() {
        assert_eq!(folds(3, 2).shares(&[1.0, -2.0, 0.0, 0.0, 0.0, 3.0]), [0.5, 0.0, 0.5]);
        let before = [1.0; 4];
        assert!(!falls(&before, &[0.2, 1.0, 1.0, 1.0]));
        assert!(falls(&before, &[0.9; 4]));
        // by 0.5, 0.3, 0.1 and −0.1: 0.8 in all, its standard error √(4/3·(0.36 − 0.16)) = 0.516
        assert!(falls(&before, &[0.5, 0.7, 0.9, 1.1]));
        // by 0.5, 0.1, −0.1 and −0.1: 0.4 in all, its standard error √(4/3·(0.28 − 0.04)) = 0.566
        assert!(!falls(&before, &[0.5, 0.9, 1.1, 1.1]));
    }

    #[test]
    fn what_only_one_fold_shows_is_not_known_without_it() {
        let columns = [vec![0.0_f32, 0.0, 1.0, 1.0, 0.0, 0.0]];
        let residual = [0.0_f32; 6];
        let left = folds(3, 2).left_out(&columns, &residual, &[FREE]);
        // without the second fold the parameter is back at nothing, 2 steps away
        assert_eq!(left[2..4], [2.0, 2.0]);
        assert_eq!(left[..2], [0.0, 0.0]);
    }

    #[test]
    fn repeats_vouch_for_a_threshold_that_one_motion_meets() {
        let columns = [vec![0.0_f32, 0.0, 1.0, 1.0, 0.0, 0.0]];
        let left = |repeated: bool, at_a_threshold: bool| {
            let folds = Folds { repeated: vec![repeated; 3], ..folds(3, 2) };
            folds.left_out(&columns, &[0.0; 6], &[Free { at_a_threshold, ..FREE }])[2]
        };
        assert_eq!([left(true, true), left(false, true), left(true, false)], [0.0, 2.0, 2.0]);
    }
}
