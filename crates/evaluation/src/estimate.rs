//! A mean and how well it is known.

use serde::{Deserialize, Serialize};

/// A mean with its 95 % confidence interval (normal approximation, ±1.96 standard errors).
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Estimate {
    /// Mean.
    pub mean: f64,
    /// Lower end of the interval.
    pub ci_low: f64,
    /// Upper end of the interval.
    pub ci_high: f64,
}

/// Half the width of the interval in standard errors.
const Z_95: f64 = 1.96;

impl Estimate {
    /// Mean of the values and its standard error `s/√n`, with `s² = Σ(x − mean)²/(n − 1)`. No width for a
    /// single value.
    pub fn of(values: &[f64]) -> Self {
        if values.is_empty() {
            return Self::default();
        }
        let n = values.len() as f64;
        let mean = values.iter().sum::<f64>() / n;
        let squares: f64 = values.iter().map(|x| (x - mean).powi(2)).sum();
        let error = if values.len() > 1 { (squares / (n - 1.0) / n).sqrt() } else { 0.0 };
        Self { mean, ci_low: mean - Z_95 * error, ci_high: mean + Z_95 * error }
    }

    /// A share of `count` out of `total`, with Wilson's interval, which also holds near 0 and 1; it lies
    /// within them.
    pub fn share(count: usize, total: usize) -> Self {
        if total == 0 {
            return Self::default();
        }
        let (n, p) = (total as f64, count as f64 / total as f64);
        let z2 = Z_95 * Z_95;
        let centre = (p + z2 / (2.0 * n)) / (1.0 + z2 / n);
        let half = Z_95 / (1.0 + z2 / n) * (p * (1.0 - p) / n + z2 / (4.0 * n * n)).sqrt();
        Self {
            mean: p,
            // At 0 and 1 the ends meet them but for rounding.
            ci_low: (centre - half).max(0.0),
            ci_high: (centre + half).min(1.0),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn means_by_hand() {
        // 1, 2, 6: mean 3, s² = (4 + 1 + 9)/2 = 7, standard error √(7/3) = 1.527525
        let e = Estimate::of(&[1.0, 2.0, 6.0]);
        assert_eq!(e.mean, 3.0);
        let standard_error = (e.ci_high - e.ci_low) / (2.0 * Z_95);
        assert!((standard_error - 1.527_525_231_651_947).abs() < 1e-12);
        let single = Estimate::of(&[5.0]);
        assert_eq!((single.ci_low, single.mean, single.ci_high), (5.0, 5.0, 5.0));
    }

    #[test]
    fn shares_by_hand() {
        // Wilson at 0 of 10: low 0, high z²/(n + z²) = 3.8416/13.8416
        let none = Estimate::share(0, 10);
        assert_eq!(none.mean, 0.0);
        assert!(none.ci_low.abs() < 1e-12);
        for total in 1..=600 {
            let (none, all) = (Estimate::share(0, total), Estimate::share(total, total));
            assert!(none.ci_low >= 0.0 && all.ci_high <= 1.0, "{total}");
        }
        assert!((none.ci_high - 3.8416 / 13.8416).abs() < 1e-12);
        // 5 of 10 is symmetric about one half
        let half = Estimate::share(5, 10);
        assert!((half.ci_low + half.ci_high - 1.0).abs() < 1e-12);
    }
}
