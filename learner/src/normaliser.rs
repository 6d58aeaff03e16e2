//! Running mean and variance of the observations, merged exactly, and the transformation made from them.
//!
//! The statistics grow with every accepted chunk, in the batch's order. The transformation that a policy is
//! trained and run with is a snapshot of them that changes only with the policy version: [`Scaling`] travels
//! inside the ONNX graph, so actor, learner and robot can never disagree about it.

use caudata_task::mirror::SignedPermutation;
use serde::{Deserialize, Serialize};

/// Smallest standard deviation that a component is divided by, in the component's own unit. A component that
/// hardly moves (a command that is always zero) would otherwise amplify its sensor noise without limit.
pub const STD_MIN: f64 = 1e-2;

/// Count, mean and sum of squared deviations per component, in f64.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Moments {
    /// Observations counted.
    pub count: u64,
    /// Mean, `[D]`.
    pub mean: Vec<f64>,
    /// Sum of squared deviations from the mean, `[D]`.
    pub m2: Vec<f64>,
}

impl Moments {
    /// Nothing counted yet, `dim` components.
    pub fn new(dim: usize) -> Self {
        Self { count: 0, mean: vec![0.0; dim], m2: vec![0.0; dim] }
    }

    /// The two-pass moments of `rows`, row-major `[n, dim]`: what merging must add up to.
    pub fn of(rows: &[f32], dim: usize) -> Self {
        let mut moments = Self::new(dim);
        let Some(n) = rows.len().checked_div(dim).filter(|&n| n > 0) else { return moments };
        moments.count = n as u64;
        for row in rows.chunks_exact(dim) {
            (0..dim).for_each(|d| moments.mean[d] += f64::from(row[d]));
        }
        moments.mean.iter_mut().for_each(|mean| *mean /= n as f64);
        for row in rows.chunks_exact(dim) {
            for d in 0..dim {
                moments.m2[d] += (f64::from(row[d]) - moments.mean[d]).powi(2);
            }
        }
        moments
    }

    /// Adds the observations behind `other` (Chan, Golub, LeVeque 1979, eq. 2.1):
    /// δ = mean_b − mean_a; mean += δ·n_b/n; M2 += M2_b + δ²·n_a·n_b/n.
    pub fn merge(&mut self, other: &Moments) {
        debug_assert_eq!(self.mean.len(), other.mean.len());
        let n = self.count + other.count;
        if other.count == 0 {
            return;
        }
        let (na, nb) = (self.count as f64, other.count as f64);
        let total = n as f64;
        for d in 0..self.mean.len() {
            let delta = other.mean[d] - self.mean[d];
            self.mean[d] += delta * (nb / total);
            self.m2[d] += other.m2[d] + delta * delta * (na * nb / total);
        }
        self.count = n;
    }

    /// What these observations and their mirror images have in common, each counted for half: mean (a + b)/2,
    /// and M2 (M2_a + M2_b)/2 + n·(a − b)²/4. Exactly symmetric, to the bit.
    pub fn with_image(&self, mirror: &SignedPermutation) -> Self {
        debug_assert_eq!(self.mean.len(), mirror.len());
        let mut both = self.clone();
        for (d, (&from, &sign)) in mirror.source.iter().zip(&mirror.sign).enumerate() {
            let image = f64::from(sign) * self.mean[from];
            let apart = self.mean[d] - image;
            both.mean[d] = 0.5 * (self.mean[d] + image);
            both.m2[d] =
                0.5 * (self.m2[d] + self.m2[from]) + 0.25 * self.count as f64 * apart * apart;
        }
        both
    }

    /// The transformation that these statistics give; the identity while fewer than two observations are
    /// counted.
    pub fn scaling(&self, clip: f32) -> Scaling {
        if self.count < 2 {
            return Scaling::identity(self.mean.len(), clip);
        }
        let std = |m2: &f64| (m2 / self.count as f64).sqrt().max(STD_MIN) as f32;
        Scaling {
            mean: self.mean.iter().map(|&mean| mean as f32).collect(),
            std: self.m2.iter().map(std).collect(),
            clip,
        }
    }
}

impl From<caudata_proto::Moments> for Moments {
    fn from(wire: caudata_proto::Moments) -> Self {
        Self { count: wire.count, mean: wire.mean, m2: wire.m2 }
    }
}

/// `clip((x − mean)/std, ±clip)` per component.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Scaling {
    /// `[D]`.
    pub mean: Vec<f32>,
    /// `[D]`, at least [`STD_MIN`].
    pub std: Vec<f32>,
    /// Largest magnitude after scaling.
    pub clip: f32,
}

impl Scaling {
    /// Only clips.
    pub fn identity(dim: usize, clip: f32) -> Self {
        Self { mean: vec![0.0; dim], std: vec![1.0; dim], clip }
    }

    /// Raw observations `[M, D]` to normalised ones, in the same order of operations as the ONNX graph.
    pub fn apply(&self, raw: &tch::Tensor) -> tch::Tensor {
        let device = raw.device();
        let mean = tch::Tensor::from_slice(&self.mean).to_device(device);
        let std = tch::Tensor::from_slice(&self.std).to_device(device);
        let clip = f64::from(self.clip);
        (raw - mean).g_div_(&std).clamp_(-clip, clip)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn merging_two_halves_by_hand() {
        // {1, 3}: mean 2, M2 2. {5, 7, 9}: mean 7, M2 8.
        // Together: δ = 5, mean = 2 + 5·3/5 = 5, M2 = 2 + 8 + 25·2·3/5 = 40. Direct: 16+4+0+4+16 = 40.
        let mut a = Moments::of(&[1.0, 3.0], 1);
        assert_eq!((a.mean[0], a.m2[0]), (2.0, 2.0));
        a.merge(&Moments::of(&[5.0, 7.0, 9.0], 1));
        assert_eq!((a.count, a.mean[0], a.m2[0]), (5, 5.0, 40.0));
        // Variance 40/5 = 8.
        assert_eq!(a.scaling(10.0).std[0], 8.0_f32.sqrt());
    }

    #[test]
    fn moments_with_their_image_are_those_of_both() {
        // exchanges the first two, negates the third
        let mirror = SignedPermutation { source: vec![1, 0, 2], sign: vec![1.0, 1.0, -1.0] };
        let rows = [1.0_f32, 4.0, 0.5, 2.0, -3.0, 1.5, 0.0, 1.0, -0.25];
        let images: Vec<f32> = rows.chunks(3).flat_map(|row| mirror.apply(row)).collect();
        let both = Moments::of(&[&rows[..], &images].concat(), 3);
        let found = Moments::of(&rows, 3).with_image(&mirror);
        for d in 0..3 {
            assert!((found.mean[d] - both.mean[d]).abs() < 1e-12);
            // as many observations as before, half of either
            assert!((found.m2[d] - 0.5 * both.m2[d]).abs() < 1e-12);
        }
        assert_eq!((found.mean[0], found.mean[2]), (found.mean[1], 0.0));
        assert_eq!(found.m2[0], found.m2[1]);
    }

    #[test]
    fn scaling_shifts_divides_and_clips() {
        let scaling = Scaling { mean: vec![1.0, 0.0], std: vec![2.0, 0.5], clip: 3.0 };
        let raw = tch::Tensor::from_slice(&[5.0_f32, -9.0, -1.0, 0.25]).view([2, 2]);
        let out: Vec<f32> = Vec::try_from(scaling.apply(&raw).view([-1])).unwrap();
        // (5−1)/2 = 2; −9/0.5 = −18 → −3; (−1−1)/2 = −1; 0.25/0.5 = 0.5.
        assert_eq!(out, [2.0, -3.0, -1.0, 0.5]);
    }

    #[test]
    fn a_component_that_never_moves_is_not_blown_up() {
        let moments = Moments::of(&[0.3, 0.3, 0.3], 1);
        assert_eq!(moments.scaling(10.0).std[0], STD_MIN as f32);
        assert_eq!(Moments::new(2).scaling(5.0), Scaling::identity(2, 5.0));
    }

    proptest! {
        #[test]
        fn merging_any_split_equals_the_two_pass_result(
            rows in prop::collection::vec(-100.0_f32..100.0, 2..120),
            cuts in prop::collection::vec(0_usize..120, 0..5),
            offset in -1e4_f32..1e4,
        ) {
            let dim = 2;
            let rows: Vec<f32> = rows.iter().map(|x| x + offset).collect();
            let rows = &rows[..rows.len() / dim * dim];
            let mut cuts: Vec<usize> = cuts.iter().map(|c| c.min(&(rows.len() / dim)) * dim).collect();
            cuts.extend([0, rows.len()]);
            cuts.sort_unstable();
            let mut merged = Moments::new(dim);
            for pair in cuts.windows(2) {
                merged.merge(&Moments::of(&rows[pair[0]..pair[1]], dim));
            }
            let direct = Moments::of(rows, dim);
            prop_assert_eq!(merged.count, direct.count);
            for d in 0..dim {
                prop_assert!((merged.mean[d] - direct.mean[d]).abs() <= 1e-12 * direct.mean[d].abs().max(1.0));
                // M2 is a sum over n numbers of size up to (100)²; the offset cancels in the deviations.
                prop_assert!((merged.m2[d] - direct.m2[d]).abs() <= 1e-9 * direct.m2[d].max(1.0));
            }
        }
    }
}
