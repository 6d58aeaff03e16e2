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
//! Both speeds scale with the bus voltage over the voltage at which they were identified. Where ToddlerBot
//! jumps to full braking beyond q̇_max, the line here just goes on: that is the same motor at full duty, has
//! no jump, and stays a function of joint speed and torque alone.
//!
//! A winding whose resistance is ρ times its nominal one gives 1/ρ of the torque at the same voltage: the
//! position loop and the sloping part of the envelope are divided by ρ, the flat current limit stays.

use super::ServoDrive;
use super::supply::Bus;
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

/// Largest torque in the direction of motion at `speed_radps` (≥ 0), N·m. Negative beyond the no-load speed,
/// never below −τ_brake_max. `per_rho`: nominal over present winding resistance.
#[inline(always)]
pub fn driving_limit_nm<R: Real>(p: &ServoDrive<R>, bus: &Bus<R>, per_rho: R, speed_radps: R) -> R {
    let over = speed_radps - p.flat_speed_per_volt * bus.volt_v;
    let line = per_rho * (p.tau_max_nm - p.taper_nms_v_per_rad * bus.per_volt * over);
    p.tau_max_nm.min(line).max(-p.tau_brake_max_nm)
}

/// Clamps a wanted torque to what the motor can give at motor speed `speed_radps`, N·m.
#[inline(always)]
pub fn clamp_nm<R: Real>(
    p: &ServoDrive<R>,
    bus: &Bus<R>,
    per_rho: R,
    torque_nm: R,
    speed_radps: R,
) -> R {
    let driving = driving_limit_nm(p, bus, per_rho, speed_radps.abs());
    let forward = R::zero().lt(speed_radps);
    let backward = speed_radps.lt(R::zero());
    let rest = p.tau_max_nm;
    let high = R::select(forward, driving, R::select(backward, p.tau_brake_max_nm, rest));
    let low = R::select(backward, -driving, R::select(forward, -p.tau_brake_max_nm, -rest));
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
            encoder: None,
        }
    }

    /// Its envelope, every torque limit times `scale`.
    pub(crate) fn envelope(scale: f64) -> ServoDrive<f64> {
        ServoDrive {
            tau_max_nm: 1.94 * scale,
            tau_brake_max_nm: 2.2 * scale,
            flat_speed_per_volt: 0.8 / 12.0,
            // (1.94 − 0.40)/(7.6 − 0.8) at 12 V
            taper_nms_v_per_rad: 1.54 / 6.8 * 12.0 * scale,
            per_torque_constant_a_per_nm: 1.0 / 1.11,
            current_dead_band_a: 0.145,
            ..ServoDrive::default()
        }
    }

    pub(crate) fn check(got: f64, want: f64) {
        assert!((got - want).abs() < 1e-5, "got {got}, want {want}");
    }

    fn limit(volt: f64, speed: f64) -> f64 {
        driving_limit_nm(&envelope(1.0), &Bus::at(volt), 1.0, speed)
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
        let clamp = |torque, speed| clamp_nm(&envelope(1.0), &Bus::at(12.0), 1.0, torque, speed);
        check(clamp(15.0, 0.0), 1.94);
        check(clamp(13.6, 4.2), 1.17);
        check(clamp(16.4, -4.2), 2.2); // brakes
        check(clamp(-16.4, 4.2), -2.2);
        check(clamp(-16.4, -4.2), -1.17);
        check(clamp(0.3, 4.2), 0.3);
    }

    #[test]
    fn speeds_scale_with_supply_and_torques_with_the_scale() {
        // 14 V: flat to 0.8·14/12 = 0.9333, ends at 8.8667 with 0.40 N·m
        check(limit(14.0, 0.9333), 1.94);
        check(limit(14.0, 8.866_667), 0.40);
        check(limit(14.0, 4.9), 1.17);
        let weak = envelope(0.5);
        check(driving_limit_nm(&weak, &Bus::at(12.0), 1.0, 4.2), 0.585);
        check(clamp_nm(&weak, &Bus::at(12.0), 1.0, -9.0, 1.0), -1.1);
    }

    #[test]
    fn a_hot_winding_lowers_the_sloping_part_only() {
        // ρ = 1.25: at 4.2 rad/s the line is 1.17/1.25 = 0.936; at rest 1.94 + 0.8·0.2265 = 2.1212 over 1.25
        // = 1.697 < 1.94
        let p = envelope(1.0);
        check(driving_limit_nm(&p, &Bus::at(12.0), 0.8, 4.2), 0.936);
        check(driving_limit_nm(&p, &Bus::at(12.0), 0.8, 0.0), 1.696_941);
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
            let got = clamp_nm(&p, &Bus::at(volt), 1.0 / rho, torque, speed);
            proptest::prop_assert_eq!(got, -clamp_nm(&p, &Bus::at(volt), 1.0 / rho, -torque, -speed));
            proptest::prop_assert!(got.abs() <= 2.2);
            // along the motion it is never above the flat limit
            proptest::prop_assert!(got * speed.signum() <= 1.94);
        }
    }
}
