//! The bus that all servos of a robot share: V = V₀ − R·Σ|i|.
//!
//! The voltage follows the load with a short lag (wiring and buffer capacitors). The lag also keeps the loop
//! voltage → torque limit → current stable when many joints at once run along their voltage limit.

use super::filter;
use crate::per_lane::per_lane;
use crate::real::Real;

/// Lowest bus voltage, as a share of the open-circuit voltage: below it servos brown out, which is not
/// modelled.
const LEAST_SHARE: f64 = 0.2;

per_lane! {
    /// One robot's supply.
    pub struct Supply<R> {
        /// V₀, V.
        pub open_v: R,
        /// Resistance of battery and wiring, Ω.
        pub resistance_ohm: R,
        /// Part of the way to the settled voltage that one physics step makes, 0..=1.
        pub share: R,
    }
}

/// Bus voltage after a step in which the motors together drew `current_a` (Σ|i|), V.
#[inline(always)]
pub fn settle_v<R: Real>(p: &Supply<R>, bus_v: R, current_a: R) -> R {
    let settled = (p.open_v - p.resistance_ohm * current_a).max(p.open_v * R::splat(LEAST_SHARE));
    filter::low_pass(bus_v, settled, p.share)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sags_by_resistance_times_current_and_recovers() {
        let p =
            Supply { open_v: 12.0, resistance_ohm: 0.25, share: filter::lag_share(0.005, 0.002) };
        // 8 A through 0.25 Ω: 2 V less, after 5 ms 63 % of it
        let mut v = 12.0;
        for _ in 0..50 {
            v = settle_v(&p, v, 8.0);
        }
        assert!((v - 10.0_f64).abs() < 1e-6);
        let mut v: f64 = 12.0;
        for _ in 0..5 {
            v = settle_v(&p, v, 8.0); // 10 ms: two time constants
        }
        assert!((v - (12.0 - 2.0 * (1.0 - (-2.0_f64).exp()))).abs() < 1e-9);
        for _ in 0..50 {
            v = settle_v(&p, v, 0.0);
        }
        assert!((v - 12.0).abs() < 1e-6);
        // a short circuit ends at the floor
        assert!((settle_v(&Supply { share: 1.0, ..p }, 12.0, 1e6) - 2.4_f64).abs() < 1e-9);
    }
}
