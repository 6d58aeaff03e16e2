//! Adam (Kingma & Ba 2015) over the flat parameter vector, on the host: a run that resumes without its moments is
//! not the same run, and libtorch's own optimiser cannot save them through tch.

use caudata_lanes::simd::{AnyWidth, Lanes, widest};

use crate::LearnerError;

/// Decay of the first moment (torch's default).
pub const BETA1: f64 = 0.9;
/// Decay of the second moment (torch's default).
pub const BETA2: f64 = 0.999;
/// Added to the root of the second moment (torch's default).
pub const EPSILON: f64 = 1e-8;

/// The optimiser: moments and the number of steps taken.
#[derive(Clone, Debug, PartialEq)]
pub struct Adam {
    /// First moment, `[P]`.
    m: Vec<f32>,
    /// Second moment, `[P]`.
    v: Vec<f32>,
    steps: u64,
}

impl Adam {
    /// Before the first step, for `len` parameters.
    pub fn new(len: usize) -> Self {
        Self { m: vec![0.0; len], v: vec![0.0; len], steps: 0 }
    }

    /// One step on `parameters` `[P]`, in place, with torch's order of operations: m = β₁m + (1−β₁)g,
    /// v = β₂v + (1−β₂)g², p −= lr/(1−β₁ᵗ) · m / (√v/√(1−β₂ᵗ) + ε), where g is `gradient` times
    /// `gradient_scale`. `rates`: number of parameters and their learning rate, part after part, P in all.
    pub fn step(
        &mut self,
        parameters: &mut [f32],
        (gradient, gradient_scale): (&[f32], f64),
        rates: &[(usize, f64)],
    ) {
        debug_assert_eq!(rates.iter().map(|part| part.0).sum::<usize>(), self.m.len());
        let (bias1, bias2_root) = self.count();
        let mut first = 0;
        for &(len, rate) in rates {
            let part = first..first + len;
            widest(Step {
                parameters: &mut parameters[part.clone()],
                gradient: &gradient[part.clone()],
                m: &mut self.m[part.clone()],
                v: &mut self.v[part],
                gradient_scale,
                rate: rate / bias1,
                bias2_root,
            });
            first += len;
        }
    }

    /// Counts a step, and answers what its moments are divided by: 1 − β₁ᵗ and √(1 − β₂ᵗ).
    pub fn count(&mut self) -> (f64, f64) {
        self.steps += 1;
        let t = self.steps as f64;
        (1.0 - BETA1.powf(t), (1.0 - BETA2.powf(t)).sqrt())
    }

    /// Forgets every step.
    pub fn reset(&mut self) {
        *self = Self::new(self.m.len());
    }

    /// What a checkpoint keeps: first moment, second moment, steps.
    pub fn state(&self) -> (Vec<f32>, Vec<f32>, u64) {
        (self.m.clone(), self.v.clone(), self.steps)
    }

    /// Goes on from a saved state.
    ///
    /// # Errors
    /// [`LearnerError::Setting`] when the moments are not those of this many parameters.
    pub fn restore(&mut self, m: &[f32], v: &[f32], steps: u64) -> Result<(), LearnerError> {
        let len = self.m.len();
        if m.len() != len || v.len() != len {
            return Err(LearnerError::setting(format!(
                "optimiser state for {} and {} parameters given to a network with {len}",
                m.len(),
                v.len()
            )));
        }
        (self.m, self.v, self.steps) = (m.to_vec(), v.to_vec(), steps);
        Ok(())
    }
}

/// A step of some parameters with one learning rate.
struct Step<'a> {
    parameters: &'a mut [f32],
    gradient: &'a [f32],
    m: &'a mut [f32],
    v: &'a mut [f32],
    gradient_scale: f64,
    rate: f64,
    bias2_root: f64,
}

impl AnyWidth for Step<'_> {
    type Output = ();

    #[inline(always)]
    fn run<R: Lanes<Elem = f32>>(mut self) {
        let whole = self.m.len() / R::LANES * R::LANES;
        let mut at = 0;
        while at < whole {
            self.at::<R>(at);
            at += R::LANES;
        }
        while at < self.m.len() {
            self.at::<f32>(at);
            at += 1;
        }
    }
}

impl Step<'_> {
    #[inline(always)]
    fn at<R: Lanes<Elem = f32>>(&mut self, at: usize) {
        let g = R::read(&self.gradient[at..]) * R::splat(self.gradient_scale);
        let m = R::read(&self.m[at..]);
        let m = m + (g - m) * R::splat(1.0 - BETA1);
        let v = R::read(&self.v[at..]) * R::splat(BETA2) + g * g * R::splat(1.0 - BETA2);
        let root = v.sqrt() / R::splat(self.bias2_root) + R::splat(EPSILON);
        let change = m / root * R::splat(self.rate);
        (R::read(&self.parameters[at..]) - change).write(&mut self.parameters[at..]);
        m.write(&mut self.m[at..]);
        v.write(&mut self.v[at..]);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tch::nn::{self, OptimizerConfig};
    use tch::{Device, Kind, Tensor};

    #[test]
    fn the_first_two_steps_by_hand() {
        // g = 2 twice, lr 0.1. Step 1: m = 0.2, v = 0.004; m/(1−0.9) = 2, v/(1−0.999) = 4, change 0.1·2/2 =
        // 0.1. Step 2: m = 0.38, v = 0.007996; 0.38/0.19 = 2, 0.007996/0.001999 = 4: again 0.1.
        let mut p = [1.0];
        let mut adam = Adam::new(1);
        for expected in [0.9, 0.8] {
            adam.step(&mut p, (&[4.0], 0.5), &[(1, 0.1)]);
            assert!((p[0] - expected).abs() < 1e-6);
        }
    }

    #[test]
    fn it_walks_the_same_path_as_torchs_adam() {
        // Minimise Σ aᵢ(xᵢ − bᵢ)² from the same start with both; the gradient is 2a(x − b).
        const LEN: usize = 21;
        let a: Vec<f32> = (0..LEN).map(|i| 0.1 + i as f32).collect();
        let b: Vec<f32> = (0..LEN).map(|i| 0.3 * i as f32 - 2.0).collect();
        let vars = nn::VarStore::new(Device::Cpu);
        let theirs = vars.root().zeros("x", &[LEN as i64]);
        let mut torch = nn::Adam::default().build(&vars, 0.05).unwrap();
        let mut own = vec![0.0_f32; LEN];
        let mut adam = Adam::new(LEN);
        for step in 0..200 {
            let off = &theirs - &Tensor::from_slice(&b);
            torch.backward_step(&(off.square() * Tensor::from_slice(&a)).sum(Kind::Float));
            let gradient: Vec<f32> = (0..LEN).map(|i| 2.0 * a[i] * (own[i] - b[i])).collect();
            adam.step(&mut own, (&gradient, 1.0), &[(LEN, 0.05)]);
            let found = Tensor::from_slice(&own);
            let off = (found - &theirs).abs().max().double_value(&[]);
            assert!(off < 2e-5, "step {step}: off by {off}");
        }
    }

    #[test]
    fn restoring_goes_on_with_the_same_bits() {
        let g = [0.3, -1.0];
        let mut p = [0.0; 2];
        let mut adam = Adam::new(2);
        adam.step(&mut p, (&g, 1.0), &[(2, 0.1)]);
        let (m, v, steps) = adam.state();
        let mut q = p;
        let mut other = Adam::new(2);
        other.restore(&m, &v, steps).unwrap();
        adam.step(&mut p, (&g, 1.0), &[(2, 0.1)]);
        other.step(&mut q, (&g, 1.0), &[(2, 0.1)]);
        assert_eq!(p, q);
        assert!(other.restore(&[0.0], &v, 1).is_err());
    }

    #[test]
    fn parts_have_their_own_rates_and_a_reset_forgets() {
        // As above, every first step has the size of its rate.
        let mut p = [0.0; 3];
        let g = [3.0, -2.0, 5.0];
        let rates = [(2, 0.1), (1, 0.01)];
        let mut adam = Adam::new(3);
        let near = |p: &[f32], expected: [f32; 3]| {
            let off = p.iter().zip(expected).map(|(f, e)| (f - e).abs());
            assert!(off.fold(0.0, f32::max) < 1e-6, "{p:?}");
        };
        adam.step(&mut p, (&g, 1.0), &rates);
        near(&p, [-0.1, 0.1, -0.01]);
        adam.reset();
        assert_eq!(adam.state().2, 0);
        adam.step(&mut p, (&g, -7.0), &rates);
        near(&p, [0.0; 3]);
    }
}
