//! The bus that all servos of a robot share: V = V₀ − R·Σ d·i.
//!
//! A bridge that is driven by pulse width puts a motor on the bus for a part d of the time, its duty, and so takes d
//! times the motor's current i from it (what the bus gives, V·d·i, is what the motor gets). A motor that holds
//! still takes little although its current is large, and one that brakes gives some back: as to a battery, or
//! to a supply that takes it.
//!
//! The voltage follows the load with a short lag (wiring and buffer capacitors). The lag also keeps the loop
//! voltage → torque limit → current stable when many joints at once run along their voltage limit.

use super::{ServoDrive, filter, thermal};
use crate::per_lane::per_lane;
use crate::real::{Mask, Real};

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

impl<R: Real> Supply<R> {
    /// Whether the voltage follows the load in any lane.
    #[inline(always)]
    pub fn sags(&self) -> bool {
        R::zero().lt(self.resistance_ohm).any()
    }
}

/// What servo `p` takes from a bus of `bus_v`, A, where its motor gives `torque_nm` at `motor_radps` with a current
/// of magnitude `current_a` and is `rise_k` warm. Its duty is where it is on its line at full duty
/// ([`super::servo`]); an envelope without a taper does not say, and there the current counts in full.
#[inline(always)]
pub fn drawn_a<R: Real>(
    p: &ServoDrive<R>,
    bus_v: R,
    rise_k: R,
    torque_nm: R,
    motor_radps: R,
    current_a: R,
) -> R {
    let per_rho = thermal::per_rho(p, rise_k);
    let needed_nm = torque_nm / per_rho + p.taper_nms_per_rad * motor_radps;
    let duty = (needed_nm / (p.stall_nm_per_volt * bus_v)).clamp(-R::one(), R::one());
    let along = torque_nm.signum0();
    current_a * along * R::select(R::zero().lt(p.taper_nms_per_rad), duty, along)
}

/// Bus voltage after a step in which the motors together took `drawn_a` from it ([`drawn_a`]), V.
#[inline(always)]
pub fn settle_v<R: Real>(p: &Supply<R>, bus_v: R, drawn_a: R) -> R {
    let settled = (p.open_v - p.resistance_ohm * drawn_a).max(p.open_v * R::splat(LEAST_SHARE));
    filter::low_pass(bus_v, settled, p.share)
}

#[cfg(test)]
mod tests {
    use super::super::servo::current_a;
    use super::super::servo::tests::{check, envelope};
    use super::*;

    /// The XM430's line at 12 V: 2.12118 N·m at rest, 0.226471 N·m less per rad/s.
    #[test]
    fn the_bus_feels_the_current_times_the_duty() {
        let p = ServoDrive { winding_scale: 1.0, ..envelope(1.0) };
        let drawn = |torque, speed| drawn_a(&p, 12.0, 0.0, torque, speed, current_a(&p, torque));
        // stalled with 1.11 N·m: 1.145 A, 1.11/2.12118 of the time
        check(drawn(1.11, 0.0), 1.145 * 0.523_294);
        check(drawn(-1.11, 0.0), 1.145 * 0.523_294);
        // driving at 4 rad/s: 0.905882 N·m of back-EMF more
        check(drawn(1.11, 4.0), 1.145 * 0.950_361);
        // braking at 6 rad/s: 1.358824 N·m of back-EMF, of which 0.117306 of full duty come back
        check(drawn(-1.11, 6.0), -1.145 * 0.117_305);
        // nothing given, nothing taken; never more than the current
        check(drawn(0.0, 5.0), 0.0);
        check(drawn(1.94, 7.0), current_a(&p, 1.94));
        // a winding of twice the resistance takes twice the duty
        let hot = ServoDrive { winding_scale: 2.0, ..p };
        check(drawn_a(&hot, 12.0, 0.0, 0.5, 0.0, 1.0), 2.0 * 0.5 / 2.121_176);
        // no taper: in full
        let bare = ServoDrive { taper_nms_per_rad: 0.0, ..p };
        check(drawn_a(&bare, 12.0, 0.0, -0.5, 3.0, 0.45), 0.45);
    }

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
