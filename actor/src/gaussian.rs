//! The behaviour policy: independent normal distributions around the network's output.

use caudata_random::Stream;

/// ½·ln 2π.
const HALF_LN_TAU: f64 = 0.918_938_533_204_672_8;

/// Draws `action[i] = mean[i] + exp(log_std[i])·z`, `z ~ N(0, 1)` from `noise`, one draw per component in
/// order.
pub fn sample(mean: &[f32], std: &[f32], noise: &mut Stream, action: &mut [f32]) {
    for ((action, &mean), &std) in action.iter_mut().zip(mean).zip(std) {
        *action = mean + std * noise.normal();
    }
}

/// Log-probability density of `action`, natural logarithm:
///
/// `Σ_i [ −½·((a_i − μ_i)/σ_i)² − ln σ_i − ½·ln 2π ]`, `σ_i = exp(log_std_i)`.
pub fn log_prob(action: &[f32], mean: &[f32], log_std: &[f32]) -> f32 {
    Density::new(log_std).log_prob(action, mean)
}

/// [`log_prob`] for many actions of one policy: what depends on the spread alone is worked out once.
///
/// Computed in f64 from the f32 values that travel in the chunk, so that the learner, who has the same
/// values, finds the same number to the last bits of f32.
#[derive(Clone, Debug)]
pub struct Density {
    /// `(1/σ_i, ln σ_i)`.
    components: Vec<(f64, f64)>,
}

impl Density {
    /// The density of the distributions with these `ln σ_i`.
    pub fn new(log_std: &[f32]) -> Self {
        let component = |&log_std: &f32| {
            let log_std = f64::from(log_std);
            ((-log_std).exp(), log_std)
        };
        Self { components: log_std.iter().map(component).collect() }
    }

    /// Log-probability density of `action` around `mean`.
    pub fn log_prob(&self, action: &[f32], mean: &[f32]) -> f32 {
        let total: f64 = action
            .iter()
            .zip(mean)
            .zip(&self.components)
            .map(|((&action, &mean), &(inverse_std, log_std))| {
                let z = (f64::from(action) - f64::from(mean)) * inverse_std;
                -0.5 * z * z - log_std - HALF_LN_TAU
            })
            .sum();
        total as f32
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use caudata_random::{Key, Purpose};

    #[test]
    fn log_prob_by_hand() {
        // Standard normal at its mean: −½·ln 2π = −0.918939.
        assert_eq!(log_prob(&[0.0], &[0.0], &[0.0]), -0.918_938_5);
        // One standard deviation off with σ = ½: −½ − ln ½ − 0.918939 = −0.725791.
        let half = 0.5f32.ln();
        assert!((log_prob(&[1.5], &[1.0], &[half]) - (-0.725_791_4)).abs() < 1e-6);
        // Components add up: −0.918939 − 0.725791 = −1.644730.
        let both = log_prob(&[0.0, 1.5], &[0.0, 1.0], &[0.0, half]);
        assert!((both - (-1.644_729_9)).abs() < 1e-6, "{both}");
    }

    #[test]
    fn samples_have_the_mean_and_spread_asked_for() {
        let mut noise = Stream::new(Key::for_run(3), Purpose::Action);
        let (n, mean, std) = (20_000, 0.3f32, 0.5f32);
        let draws: Vec<f64> = (0..n)
            .map(|_| {
                let mut out = [0.0];
                sample(&[mean], &[std], &mut noise, &mut out);
                f64::from(out[0])
            })
            .collect();
        let average = draws.iter().sum::<f64>() / f64::from(n);
        let variance = draws.iter().map(|x| (x - average).powi(2)).sum::<f64>() / f64::from(n);
        // Five standard errors: 5·0.5/√20,000 = 0.018; of the deviation 5·0.5/√40,000 = 0.0125.
        assert!((average - 0.3).abs() < 0.018, "{average}");
        assert!((variance.sqrt() - 0.5).abs() < 0.0125, "{variance}");
    }
}
