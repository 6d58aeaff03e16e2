//! The servo: a position loop behind a torque envelope.
//!
//! The loop is `τ = Kp·(q_des − q) − Kd·q̇ − Kd_min·ω`, with ω the motor's speed (that of the joint unless
//! there is play in the gear). What the motor gives of it depends on speed and direction (envelope of
//! ToddlerBot v2, Shi et al. 2025, arXiv:2502.00893, whose identified numbers the robot file carries):
//!
//! ```text
//!  τ (in the direction of motion)
//!  τ_max ────────────╮                 flat up to q̇_τmax: the current limit
//!                     ╲                linear taper: the supply voltage runs out
//!  τ_q̇max              ╲ at q̇_max
//!  0  ──────────────────╲──────────    beyond, the line goes on: the back-EMF brakes
//!                        ╲
//!  −τ_brake_max ──────────╰────────    against the motion: separate limit
//! ```
//!
//! The line is the motor's at full duty, `k·(V/k_e − q̇)`: its slope is the winding's and stays, and it moves in
//! parallel with the bus voltage over the one at which it was identified. So less voltage leaves less torque at
//! rest once the line's end is below τ_max. Against the motion, back-EMF helps the bridge: there the same line
//! goes on upwards until the braking limit. Where ToddlerBot jumps to full braking beyond q̇_max, it just goes
//! on: that is the same motor, has no jump, and stays a function of joint speed and torque alone.
//!
//! A winding whose resistance is ρ times its nominal one gives 1/ρ of the torque at the same voltage: the
//! position loop and the sloping part of the envelope are divided by ρ, the flat current limit stays.

use super::ServoDrive;
use crate::real::Real;

/// Speed over which a separate limit of the current against the motion fades in, rad/s.
const BRAKING_FADE_RADPS: f64 = 0.1;

/// Speed over which the back-driven gain ratio fades in, rad/s: without it a loaded joint at rest would
/// chatter between two gains.
const BACK_DRIVE_FADE_RADPS: f64 = 0.1;

/// The error that the controller acts on: nothing within ± the dead band, beyond it what is over (steady, so
/// that nothing chatters at the edge) and, where there is a jump, its share of the band.
#[inline(always)]
pub fn dead_band<R: Real>(p: &ServoDrive<R>, error_rad: R) -> R {
    let within = error_rad.clamp(-p.dead_band_rad, p.dead_band_rad);
    let outside = p.dead_band_rad.lt(error_rad.abs());
    error_rad - within + R::select(outside, p.dead_band_jump * within, R::zero())
}

/// Factor on Kp: 1 while the joint moves towards its target or rests, `ratio` while the load drives it away
/// from it.
#[inline(always)]
pub fn back_drive_factor<R: Real>(ratio: R, error_rad: R, qd_radps: R) -> R {
    let away = -(qd_radps * error_rad.signum0());
    let share = (away * R::splat(1.0 / BACK_DRIVE_FADE_RADPS)).clamp(R::zero(), R::one());
    R::one() + (ratio - R::one()) * share
}

/// Clamps a wanted torque to what the motor can give at motor speed `speed_radps` on a bus of `bus_v`, N·m.
/// Beyond the no-load speed it brakes. `per_rho`: nominal over present winding resistance.
#[inline(always)]
pub fn clamp_nm<R: Real>(
    p: &ServoDrive<R>,
    bus_v: R,
    per_rho: R,
    torque_nm: R,
    speed_radps: R,
) -> R {
    let stall_nm = per_rho * p.stall_nm_per_volt * bus_v;
    let fall_nm = per_rho * p.taper_nms_per_rad * speed_radps;
    let brake = p.tau_brake_max_nm;
    let up = R::select(speed_radps.lt(R::zero()), brake, p.tau_max_nm);
    let down = R::select(R::zero().lt(speed_radps), brake, p.tau_max_nm);
    let high = up.min(stall_nm - fall_nm).max(-brake);
    let low = (-down).max(-stall_nm - fall_nm).min(brake);
    torque_nm.clamp(low, high)
}

/// Clamps a torque to what the current limits allow at motor speed `speed_radps`, N·m. At rest nothing
/// brakes: what is allowed against the motion comes with the speed, without which a load between the two
/// limits would be held by chattering between them.
#[inline(always)]
pub fn limit_current_nm<R: Real>(p: &ServoDrive<R>, torque_nm: R, speed_radps: R) -> R {
    let against = -(speed_radps * torque_nm.signum0());
    let share = (against * R::splat(1.0 / BRAKING_FADE_RADPS)).clamp(R::zero(), R::one());
    let limit = (R::one() - share) * p.current_limit_nm + share * p.braking_current_limit_nm;
    torque_nm.clamp(-limit, limit)
}

/// What a motor gives that would give `torque_nm` if its torque were in proportion to its current, N·m.
#[inline(always)]
pub fn saturated_nm<R: Real>(p: &ServoDrive<R>, torque_nm: R) -> R {
    torque_nm / (R::one() + p.torque_saturation_per_nm * torque_nm.abs())
}

/// The inverse of [`saturated_nm`], N·m.
#[inline(always)]
pub fn unsaturated_nm<R: Real>(p: &ServoDrive<R>, given_nm: R) -> R {
    /// Part of the torque that is left at least: beyond it no finite current gives more.
    const LEAST: f64 = 1e-3;
    let left = R::one() - p.torque_saturation_per_nm * given_nm.abs();
    given_nm / left.max(R::splat(LEAST))
}

/// Magnitude of the motor current behind a motor torque, A: beyond the dead band in proportion to the torque;
/// no torque, no current.
#[inline(always)]
pub fn current_a<R: Real>(p: &ServoDrive<R>, torque_nm: R) -> R {
    let size = torque_nm.abs();
    let idle = R::select(R::zero().lt(size), p.current_dead_band_a, R::zero());
    size * p.per_torque_constant_a_per_nm + idle
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use caudata_model::ServoParams;

    /// XM430-W210 as identified for ToddlerBot v2 (figures in the robot file), at 12 V.
    pub(crate) fn w210() -> ServoParams {
        ServoParams {
            tau_max_nm: 1.94,
            qd_tau_max_radps: 0.8,
            qd_max_radps: 7.6,
            tau_qd_max_nm: 0.40,
            tau_brake_max_nm: 2.2,
            kd_min_nm_s_per_rad: 0.183,
            back_drive_kp_ratio: 1.0,
            friction_loss_nm: 0.038,
            damping_nm_s_per_rad: 0.0064,
            armature_kgm2: 0.0022,
            reference_supply_v: 12.0,
            encoder_counts_per_turn: 4096,
            velocity_lsb_radps: 0.02398,
            current_lsb_a: 0.00269,
            torque_per_current_nm_per_a: 1.11,
            current_dead_band_a: 0.145,
            gear_backlash_rad: 0.004_363,
            current_limit_a: 0.0,
            stribeck_nm: 0.0,
            stribeck_speed_radps: 0.1,
            load_friction_driving: 0.0,
            load_friction_driven: 0.0,
            kd_acts_on_error: false,
            kd_rate_over_s: 0.001,
            encoder: None,
        }
    }

    /// Its envelope, every torque limit times `scale`.
    pub(crate) fn envelope(scale: f64) -> ServoDrive<f64> {
        ServoDrive {
            tau_max_nm: 1.94 * scale,
            tau_brake_max_nm: 2.2 * scale,
            // (1.94 − 0.40)/(7.6 − 0.8), and 0.8 rad/s of it above 1.94 at 12 V
            taper_nms_per_rad: 1.54 / 6.8 * scale,
            stall_nm_per_volt: (1.94 + 0.8 * 1.54 / 6.8) / 12.0 * scale,
            per_torque_constant_a_per_nm: 1.0 / 1.11,
            current_dead_band_a: 0.145,
            ..ServoDrive::default()
        }
    }

    pub(crate) fn check(got: f64, want: f64) {
        assert!((got - want).abs() < 1e-5, "got {got}, want {want}");
    }

    /// The most that drives at `speed`.
    fn limit(volt: f64, speed: f64) -> f64 {
        clamp_nm(&envelope(1.0), volt, 1.0, 100.0, speed)
    }

    #[test]
    fn torque_falls_behind_the_current_and_back() {
        let p = ServoDrive { torque_saturation_per_nm: 0.5, ..envelope(1.0) };
        // 1/(1 + 0.5) and −2/(1 + 1)
        check(saturated_nm(&p, 1.0), 2.0 / 3.0);
        check(saturated_nm(&p, -2.0), -1.0);
        check(unsaturated_nm(&p, saturated_nm(&p, 0.7)), 0.7);
    }

    #[test]
    fn the_limit_of_the_current_may_differ_against_the_motion() {
        let p =
            ServoDrive { current_limit_nm: 0.5, braking_current_limit_nm: 1.2, ..envelope(1.0) };
        let limited = |torque, speed| limit_current_nm(&p, torque, speed);
        check(limited(0.9, 3.0), 0.5); // drives
        check(limited(0.9, -3.0), 0.9); // brakes, within its limit
        check(limited(-2.0, 3.0), -1.2); // brakes
        check(limited(-2.0, -3.0), -0.5);
        check(limited(0.9, 0.0), 0.5); // at rest nothing brakes
        check(limited(0.9, -0.02), 0.64); // a fifth of the way from 0.5 to 1.2
    }

    #[test]
    fn driving_limit_is_flat_then_tapers() {
        check(limit(12.0, 0.0), 1.94);
        check(limit(12.0, 0.8), 1.94);
        // half way along the taper: (1.94 + 0.40)/2 at (0.8 + 7.6)/2
        check(limit(12.0, 4.2), 1.17);
        check(limit(12.0, 7.6), 0.40);
        // slope −1.54/6.8 = −0.226471; zero at 0.8 + 1.94/0.226471 = 9.36623 rad/s
        check(limit(12.0, 9.366_234), 0.0);
        // 0.634 rad/s further: −0.14353
        check(limit(12.0, 10.0), -0.143_529);
        check(limit(12.0, 1000.0), -2.2);
    }

    #[test]
    fn saturates_by_direction() {
        let clamp = |torque, speed| clamp_nm(&envelope(1.0), 12.0, 1.0, torque, speed);
        check(clamp(15.0, 0.0), 1.94);
        check(clamp(13.6, 4.2), 1.17);
        check(clamp(16.4, -4.2), 2.2); // brakes
        check(clamp(-16.4, 4.2), -2.2);
        check(clamp(-16.4, -4.2), -1.17);
        check(clamp(0.3, 4.2), 0.3);
        // slowly backward the line, 2.1212 + 0.1·0.2265, is below the braking limit
        check(clamp(16.4, -0.1), 2.143_824);
    }

    #[test]
    fn the_line_moves_in_parallel_with_the_supply_and_torques_with_the_scale() {
        // 14 V: 1/6 of the speed without load, 9.36623/6 = 1.56104 rad/s, further: flat to 2.36104
        check(limit(14.0, 2.361), 1.94);
        check(limit(14.0, 4.2 + 1.561_039), 1.17);
        // 6 V: half of 2.121176 N·m at rest, half of the speed without load; and half, and 0.4529 more, against
        // 2 rad/s
        check(limit(6.0, 0.0), 1.060_588);
        check(limit(6.0, 4.683_117), 0.0);
        check(limit(6.0, -2.0), 1.513_529);
        check(clamp_nm(&envelope(1.0), 6.0, 1.0, -100.0, 0.0), -1.060_588);
        let weak = envelope(0.5);
        check(clamp_nm(&weak, 12.0, 1.0, 9.0, 4.2), 0.585);
        check(clamp_nm(&weak, 12.0, 1.0, -9.0, 1.0), -1.1);
    }

    #[test]
    fn a_hot_winding_lowers_the_sloping_part_only() {
        // ρ = 1.25: at 4.2 rad/s the line is 1.17/1.25 = 0.936; at rest 1.94 + 0.8·0.2265 = 2.1212 over 1.25
        // = 1.697 < 1.94
        let p = envelope(1.0);
        check(clamp_nm(&p, 12.0, 0.8, 9.0, 4.2), 0.936);
        check(clamp_nm(&p, 12.0, 0.8, 9.0, 0.0), 1.696_941);
    }

    #[test]
    fn back_driven_gain_fades_in() {
        // at rest and towards the target: full gain; driven away at 0.05 rad/s: 0.75; at 0.1 and beyond: 0.5
        check(back_drive_factor(0.5, 0.1, 0.0), 1.0);
        check(back_drive_factor(0.5, 0.1, 0.1), 1.0);
        check(back_drive_factor(0.5, 0.1, -0.05), 0.75);
        check(back_drive_factor(0.5, -0.1, 0.3), 0.5);
    }

    #[test]
    fn dead_band_swallows_small_errors() {
        let acts_on = |error, dead_band_rad, dead_band_jump| {
            let p = ServoDrive { dead_band_rad, dead_band_jump, ..envelope(1.0) };
            dead_band(&p, error)
        };
        check(acts_on(0.01, 0.02, 0.0), 0.0);
        check(acts_on(0.05, 0.02, 0.0), 0.03);
        check(acts_on(-0.05, 0.02, 0.0), -0.03);
        check(acts_on(-0.05, 0.0, 0.0), -0.05);
        // the whole error, a half of the band less, and nothing within it
        check(acts_on(0.05, 0.02, 1.0), 0.05);
        check(acts_on(-0.05, 0.02, 0.5), -0.04);
        check(acts_on(-0.019, 0.02, 1.0), 0.0);
    }

    #[test]
    fn current_behind_a_torque() {
        // 1.11 N·m: 1 A and the dead band
        check(current_a(&envelope(1.0), 1.11), 1.145);
        check(current_a(&envelope(1.0), -1.11), 1.145);
        check(current_a(&envelope(1.0), 0.0), 0.0);
    }

    proptest::proptest! {
        /// Turning everything round turns the torque round; no torque is beyond the larger limit.
        #[test]
        fn symmetric_and_bounded(torque in -30.0_f64..30.0, speed in -20.0_f64..20.0, volt in 5.0_f64..15.0, rho in 0.5_f64..2.0) {
            let p = envelope(1.0);
            let got = clamp_nm(&p, volt, 1.0 / rho, torque, speed);
            proptest::prop_assert_eq!(got, -clamp_nm(&p, volt, 1.0 / rho, -torque, -speed));
            proptest::prop_assert!(got.abs() <= 2.2);
            // along the motion it is never above the flat limit
            proptest::prop_assert!(got * speed.signum() <= 1.94);
        }
    }
}
