//! The servo: a position loop behind a torque envelope. Pure functions of values.
//!
//! The loop is `τ = Kp·(q_des − q) − (Kd + Kd_min)·q̇`. What the motor gives of it depends on speed and direction
//! (envelope of ToddlerBot v2, Shi et al. 2025, arXiv:2502.00893, whose identified numbers the robot file carries):
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
//! Both speeds scale with the supply voltage over the voltage at which they were identified.
//! Where ToddlerBot jumps to full braking beyond q̇_max, the line here just goes on: that is the same motor at full
//! duty, has no jump, and stays a function of joint speed and torque alone.

use caudata_model::ServoParams;

/// Speed over which the back-driven gain ratio fades in, rad/s: without it a loaded joint at rest would chatter between two gains.
const BACK_DRIVE_FADE_RADPS: f32 = 0.1;

/// A servo's torque limits at one supply voltage, N·m and rad/s.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Envelope {
    tau_max_nm: f32,
    qd_tau_max_radps: f32,
    /// Change of the driving limit per rad/s beyond `qd_tau_max_radps`, N·m·s/rad, ≤ 0.
    slope_nms_per_rad: f32,
    tau_brake_max_nm: f32,
    kd_min_nms_per_rad: f32,
    back_drive_kp_ratio: f32,
}

/// Gains of the position loop at the joint.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Gains {
    /// Proportional gain, N·m/rad.
    pub kp_nm_per_rad: f32,
    /// Derivative gain (on top of the servo's own `kd_min`), N·m·s/rad.
    pub kd_nms_per_rad: f32,
}

impl Envelope {
    /// The envelope of `servo` at `supply_v` (V, > 0), with every torque limit multiplied by `torque_scale`.
    #[must_use]
    pub fn new(servo: &ServoParams, torque_scale: f32, supply_v: f32) -> Self {
        let speed = f64::from(supply_v) / servo.reference_supply_v;
        let flat = servo.qd_tau_max_radps * speed;
        let end = servo.qd_max_radps * speed;
        let slope = (servo.tau_qd_max_nm - servo.tau_max_nm) / (end - flat).max(1e-6);
        Self {
            tau_max_nm: servo.tau_max_nm as f32 * torque_scale,
            qd_tau_max_radps: flat as f32,
            slope_nms_per_rad: slope.min(0.0) as f32 * torque_scale,
            tau_brake_max_nm: servo.tau_brake_max_nm as f32 * torque_scale,
            kd_min_nms_per_rad: servo.kd_min_nm_s_per_rad as f32,
            back_drive_kp_ratio: servo.back_drive_kp_ratio as f32,
        }
    }

    /// Largest torque in the direction of motion at `speed_radps` (≥ 0), N·m. Negative beyond the no-load speed, never
    /// below −τ_brake_max.
    #[must_use]
    pub fn driving_limit_nm(&self, speed_radps: f32) -> f32 {
        let over = (speed_radps - self.qd_tau_max_radps).max(0.0);
        (self.tau_max_nm + self.slope_nms_per_rad * over).max(-self.tau_brake_max_nm)
    }

    /// Clamps a wanted torque to what the motor can give at velocity `qd_radps`, N·m.
    #[must_use]
    pub fn clamp_nm(&self, torque_nm: f32, qd_radps: f32) -> f32 {
        let driving = self.driving_limit_nm(qd_radps.abs());
        if qd_radps > 0.0 {
            torque_nm.clamp(-self.tau_brake_max_nm, driving)
        } else if qd_radps < 0.0 {
            torque_nm.clamp(-driving, self.tau_brake_max_nm)
        } else {
            torque_nm.clamp(-self.tau_max_nm, self.tau_max_nm)
        }
    }
}

/// Torque of the servo at the joint, N·m, before joint friction and damping.
///
/// `q_rad`, `qd_radps`: joint position and velocity; `q_des_rad`: position command.
#[must_use]
pub fn torque_nm(
    envelope: &Envelope,
    gains: Gains,
    q_rad: f32,
    qd_radps: f32,
    q_des_rad: f32,
) -> f32 {
    let error = q_des_rad - q_rad;
    let kd = gains.kd_nms_per_rad + envelope.kd_min_nms_per_rad;
    let kp = gains.kp_nm_per_rad * back_drive_factor(envelope.back_drive_kp_ratio, error, qd_radps);
    envelope.clamp_nm(kp * error - kd * qd_radps, qd_radps)
}

/// Factor on Kp: 1 while the joint moves towards its target or rests, `ratio` while the load drives it away from it.
fn back_drive_factor(ratio: f32, error_rad: f32, qd_radps: f32) -> f32 {
    let away = -qd_radps * error_rad.signum();
    let share = (away / BACK_DRIVE_FADE_RADPS).clamp(0.0, 1.0);
    1.0 + (ratio - 1.0) * share
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    /// XM430-W210 as identified for ToddlerBot v2 (DESIGN section 3), at 12 V.
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
        }
    }

    const PD: Gains = Gains {
        kp_nm_per_rad: 15.0,
        kd_nms_per_rad: 0.15,
    };

    fn check(got: f32, want: f32) {
        assert!((got - want).abs() < 1e-4, "got {got}, want {want}");
    }

    #[test]
    fn inside_the_envelope_it_is_a_pd_loop_with_extra_damping() {
        let e = Envelope::new(&w210(), 1.0, 12.0);
        // 15·0.1 − (0.15 + 0.183)·0.5 = 1.5 − 0.1665
        check(torque_nm(&e, PD, 0.2, 0.5, 0.3), 1.3335);
        check(torque_nm(&e, PD, -0.2, -0.5, -0.3), -1.3335);
    }

    #[test]
    fn driving_limit_is_flat_then_tapers() {
        let e = Envelope::new(&w210(), 1.0, 12.0);
        check(e.driving_limit_nm(0.0), 1.94);
        check(e.driving_limit_nm(0.8), 1.94);
        // half way along the taper: (1.94 + 0.40)/2 at (0.8 + 7.6)/2
        check(e.driving_limit_nm(4.2), 1.17);
        check(e.driving_limit_nm(7.6), 0.40);
        // slope −1.54/6.8 = −0.226471; zero at 0.8 + 1.94/0.226471 = 9.36623 rad/s
        check(e.driving_limit_nm(9.366_234), 0.0);
        // 0.634 rad/s further: −0.1435
        check(e.driving_limit_nm(10.0), -0.143_53);
        check(e.driving_limit_nm(1000.0), -2.2);
    }

    #[test]
    fn saturates_by_direction() {
        let e = Envelope::new(&w210(), 1.0, 12.0);
        check(torque_nm(&e, PD, 0.0, 0.0, 1.0), 1.94);
        check(torque_nm(&e, PD, 0.0, 4.2, 1.0), 1.17); // wants 13.6, drives at 4.2 rad/s
        check(torque_nm(&e, PD, 0.0, -4.2, 1.0), 2.2); // wants 16.4, brakes
        check(torque_nm(&e, PD, 0.0, 4.2, -1.0), -2.2);
    }

    #[test]
    fn speeds_scale_with_supply_and_torques_with_the_scale() {
        // 14 V: flat to 0.8·14/12 = 0.9333, ends at 8.8667 with 0.40 N·m
        let e = Envelope::new(&w210(), 1.0, 14.0);
        check(e.driving_limit_nm(0.9333), 1.94);
        check(e.driving_limit_nm(8.866_667), 0.40);
        check(e.driving_limit_nm(4.9), 1.17);
        let weak = Envelope::new(&w210(), 0.5, 12.0);
        check(weak.driving_limit_nm(4.2), 0.585);
        check(weak.clamp_nm(-9.0, 1.0), -1.1);
    }

    #[test]
    fn back_driven_gain_fades_in() {
        let mut p = w210();
        p.back_drive_kp_ratio = 0.5;
        let e = Envelope::new(&p, 1.0, 12.0);
        // at rest and towards the target: full gain. 15·0.1 = 1.5; − 0.333·0.1 when moving
        check(torque_nm(&e, PD, 0.0, 0.0, 0.1), 1.5);
        check(torque_nm(&e, PD, 0.0, 0.1, 0.1), 1.4667);
        // driven away at 0.05 rad/s: factor 0.75 → 1.125 + 0.01665; at 0.1 and beyond: 0.5 → 0.75 + 0.0333
        check(torque_nm(&e, PD, 0.0, -0.05, 0.1), 1.14165);
        check(torque_nm(&e, PD, 0.0, -0.1, 0.1), 0.7833);
    }

    proptest::proptest! {
        /// Turning everything round turns the torque round; no torque is beyond the larger limit.
        #[test]
        fn symmetric_and_bounded(q in -3.0_f32..3.0, qd in -20.0_f32..20.0, q_des in -3.0_f32..3.0, volt in 5.0_f32..15.0) {
            let e = Envelope::new(&w210(), 1.0, volt);
            let torque = torque_nm(&e, PD, q, qd, q_des);
            proptest::prop_assert_eq!(torque, -torque_nm(&e, PD, -q, -qd, -q_des));
            proptest::prop_assert!(torque.abs() <= 2.2);
            // along the motion it is never above the flat limit
            proptest::prop_assert!(torque * qd.signum() <= 1.94);
        }
    }
}
