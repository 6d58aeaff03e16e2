//! Adam (Kingma & Ba 2015) over the flat parameter vector. libtorch's own optimiser cannot save its state
//! through tch, and a run that resumes without its moments is not the same run.

use tch::{Device, Tensor};

use crate::LearnerError;
use crate::network::zeros;

/// Decay of the first moment (torch's default).
pub const BETA1: f64 = 0.9;
/// Decay of the second moment (torch's default).
pub const BETA2: f64 = 0.999;
/// Added to the root of the second moment (torch's default).
pub const EPSILON: f64 = 1e-8;

/// The optimiser: moments and the number of steps taken.
#[derive(Debug)]
pub struct Adam {
    /// First moment, `[P]`.
    m: Tensor,
    /// Second moment, `[P]`.
    v: Tensor,
    steps: u64,
}

impl Adam {
    /// Before the first step, for `len` parameters.
    pub fn new(len: usize, device: Device) -> Self {
        Self {
            m: zeros(len, device),
            v: zeros(len, device),
            steps: 0,
        }
    }

    /// One step on `parameters` `[P]`, in place, with torch's order of operations: m = β₁m + (1−β₁)g,
    /// v = β₂v + (1−β₂)g², p −= lr/(1−β₁ᵗ) · m / (√v/√(1−β₂ᵗ) + ε). `rates`: number of parameters and their
    /// learning rate, part after part, P in all.
    pub fn step(&mut self, parameters: &Tensor, gradient: &Tensor, rates: &[(usize, f64)]) {
        debug_assert_eq!(
            rates.iter().map(|part| part.0).sum::<usize>(),
            self.m.numel()
        );
        self.steps += 1;
        let t = self.steps as f64;
        let _ = self.m.lerp_(gradient, 1.0 - BETA1);
        let squared = gradient.square().g_mul_scalar_(1.0 - BETA2);
        let _ = self.v.g_mul_scalar_(BETA2).g_add_(&squared);
        let bias1 = 1.0 - BETA1.powf(t);
        let bias2_root = (1.0 - BETA2.powf(t)).sqrt();
        let denominator = self
            .v
            .sqrt()
            .g_div_scalar_(bias2_root)
            .g_add_scalar_(EPSILON);
        let change = &self.m / denominator;
        let mut first = 0;
        for &(len, rate) in rates {
            let part = |t: &Tensor| t.narrow(0, first, len as i64);
            let change = part(&change).g_mul_scalar_(rate / bias1);
            let _ = part(parameters).g_sub_(&change);
            first += len as i64;
        }
    }

    /// The same state in memory of its own.
    pub fn copy(&self) -> Self {
        Self {
            m: self.m.copy(),
            v: self.v.copy(),
            steps: self.steps,
        }
    }

    /// Forgets every step.
    pub fn reset(&mut self) {
        let _ = (self.m.zero_(), self.v.zero_());
        self.steps = 0;
    }

    /// What a checkpoint keeps: first moment, second moment, steps.
    ///
    /// # Errors
    /// When the device does not hand the moments over.
    pub fn state(&self) -> Result<(Vec<f32>, Vec<f32>, u64), LearnerError> {
        let host = |t: &Tensor| Vec::try_from(&t.to_device(Device::Cpu));
        Ok((host(&self.m)?, host(&self.v)?, self.steps))
    }

    /// Goes on from a saved state.
    ///
    /// # Errors
    /// [`LearnerError::Setting`] when the moments are not those of this many parameters.
    pub fn restore(&mut self, m: &[f32], v: &[f32], steps: u64) -> Result<(), LearnerError> {
        let len = self.m.numel();
        if m.len() != len || v.len() != len {
            return Err(LearnerError::setting(format!(
                "optimiser state for {} and {} parameters given to a network with {len}",
                m.len(),
                v.len()
            )));
        }
        self.m.copy_(&Tensor::from_slice(m));
        self.v.copy_(&Tensor::from_slice(v));
        self.steps = steps;
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tch::Kind;
    use tch::nn::{self, OptimizerConfig};

    #[test]
    fn the_first_two_steps_by_hand() {
        // g = 2 twice, lr 0.1. Step 1: m = 0.2, v = 0.004; m/(1−0.9) = 2, v/(1−0.999) = 4, change 0.1·2/2 =
        // 0.1. Step 2: m = 0.38, v = 0.007996; 0.38/0.19 = 2, 0.007996/0.001999 = 4: again 0.1.
        let p = Tensor::from_slice(&[1.0_f32]);
        let g = Tensor::from_slice(&[2.0_f32]);
        let mut adam = Adam::new(1, Device::Cpu);
        adam.step(&p, &g, &[(1, 0.1)]);
        assert!((p.double_value(&[0]) - 0.9).abs() < 1e-6);
        adam.step(&p, &g, &[(1, 0.1)]);
        assert!((p.double_value(&[0]) - 0.8).abs() < 1e-6);
    }

    #[test]
    fn it_walks_the_same_path_as_torchs_adam() {
        // Minimise Σ aᵢ(xᵢ − bᵢ)² from the same start with both; the gradient is 2a(x − b).
        let a = Tensor::from_slice(&[1.0_f32, 10.0, 0.1]);
        let b = Tensor::from_slice(&[0.3_f32, -2.0, 5.0]);
        let vars = nn::VarStore::new(Device::Cpu);
        let theirs = vars.root().zeros("x", &[3]);
        let mut torch = nn::Adam::default().build(&vars, 0.05).unwrap();
        let own = Tensor::zeros([3], (Kind::Float, Device::Cpu));
        let mut adam = Adam::new(3, Device::Cpu);
        for step in 0..200 {
            torch.backward_step(&((&theirs - &b).square() * &a).sum(Kind::Float));
            adam.step(&own, &((&own - &b) * &a * 2.0), &[(3, 0.05)]);
            let off = (&own - &theirs).abs().max().double_value(&[]);
            assert!(off < 2e-5, "step {step}: off by {off}");
        }
    }

    #[test]
    fn restoring_goes_on_with_the_same_bits() {
        let g = Tensor::from_slice(&[0.3_f32, -1.0]);
        let p = Tensor::from_slice(&[0.0_f32, 0.0]);
        let mut adam = Adam::new(2, Device::Cpu);
        adam.step(&p, &g, &[(2, 0.1)]);
        let (m, v, steps) = adam.state().unwrap();
        let q = p.copy();
        let mut other = Adam::new(2, Device::Cpu);
        other.restore(&m, &v, steps).unwrap();
        adam.step(&p, &g, &[(2, 0.1)]);
        other.step(&q, &g, &[(2, 0.1)]);
        assert!(p.equal(&q));
        assert!(other.restore(&[0.0], &v, 1).is_err());
    }

    #[test]
    fn parts_have_their_own_rates_and_a_reset_forgets() {
        // As above, every first step has the size of its rate.
        let p = Tensor::from_slice(&[0.0_f32, 0.0, 0.0]);
        let g = Tensor::from_slice(&[3.0_f32, -2.0, 5.0]);
        let mut adam = Adam::new(3, Device::Cpu);
        let near = |p: &Tensor, expected: [f32; 3]| {
            let found: Vec<f32> = Vec::try_from(p).unwrap();
            let off = found.iter().zip(expected).map(|(f, e)| (f - e).abs());
            assert!(off.fold(0.0, f32::max) < 1e-6, "{found:?}");
        };
        adam.step(&p, &g, &[(2, 0.1), (1, 0.01)]);
        near(&p, [-0.1, 0.1, -0.01]);
        adam.reset();
        assert_eq!(adam.state().unwrap().2, 0);
        adam.step(&p, &(&g * -7.0), &[(2, 0.1), (1, 0.01)]);
        near(&p, [0.0; 3]);
    }
}
