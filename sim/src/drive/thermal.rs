//! A motor's winding warms with its current and gives less torque per volt when warm.
//!
//! One thermal mass: T' = (K·i² − T)/τ with T the rise above the surroundings and K the steady rise per A².
//! The resistance grows by about 0.39 % per kelvin (copper), and torque at a given voltage falls with it.

use super::{ServoDrive, filter};
use crate::real::Real;

/// Rise of the winding's temperature after a step at `current_a`, K.
#[inline(always)]
pub fn warm_k<R: Real>(p: &ServoDrive<R>, rise_k: R, current_a: R) -> R {
    filter::low_pass(rise_k, p.thermal_rise_k_per_a2 * current_a * current_a, p.thermal_share)
}

/// Nominal over present winding resistance at a rise of `rise_k`.
#[inline(always)]
pub fn per_rho<R: Real>(p: &ServoDrive<R>, rise_k: R) -> R {
    R::one() / (p.winding_scale * (R::one() + p.resistance_per_k * rise_k))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn warms_and_weakens() {
        // 15 K/A² at 2 A: 60 K in the end; after one time constant (100 s of 10 ms steps) 63 %
        let p = ServoDrive {
            thermal_rise_k_per_a2: 15.0,
            thermal_share: filter::lag_share(100.0, 0.01),
            resistance_per_k: 0.0039,
            winding_scale: 1.0,
            ..ServoDrive::default()
        };
        let mut rise: f64 = 0.0;
        for _ in 0..10_000 {
            rise = warm_k(&p, rise, 2.0);
        }
        assert!((rise - 60.0 * 0.632_120_558_8).abs() < 1e-6);
        // at 60 K: 1/(1 + 0.234) = 0.8104 of the torque
        assert!((per_rho(&p, 60.0_f64) - 0.810_373).abs() < 1e-6);
        assert_eq!(per_rho(&p, 0.0_f64), 1.0);
    }
}
