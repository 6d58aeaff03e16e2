//! What a servo can give at a speed: the torque limits that figures are held against.

use caudata_model::RobotModel;
use serde::Serialize;

/// Share of the limit from which a torque counts as at it: means over a step hardly ever reach it wholly.
const AT_THE_LIMIT: f64 = 0.95;

/// The torque envelope of a joint's servo at the supply that simulations use (`caudata_sim::drive::servo`).
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Envelope {
    /// Largest torque at low speed, N·m.
    pub tau_max_nm: f64,
    /// Speed up to which that is there, rad/s.
    pub flat_to_radps: f64,
    /// A second speed on the line that falls from there, rad/s.
    pub taper_at_radps: f64,
    /// Torque at that speed, N·m.
    pub tau_there_nm: f64,
    /// Largest torque against the motion, N·m.
    pub tau_brake_max_nm: f64,
    /// The supply, V.
    pub supply_v: f64,
}

impl Envelope {
    /// The envelopes of a robot's servos, in policy order.
    pub fn of_each(model: &RobotModel) -> Vec<Self> {
        (0..model.actuated().len()).map(|joint| Self::of(model, joint)).collect()
    }

    fn of(model: &RobotModel, joint: usize) -> Self {
        let servo = model.servo(joint);
        let supply_v = model.supply_v();
        let fall = (servo.tau_max_nm - servo.tau_qd_max_nm)
            / (servo.qd_max_radps - servo.qd_tau_max_radps);
        // the line moves in parallel, by its speed without load at each volt
        let free_radps = servo.qd_tau_max_radps + servo.tau_max_nm / fall;
        let faster_radps = match fall > 0.0 {
            true => (supply_v / servo.reference_supply_v - 1.0) * free_radps,
            false => 0.0,
        };
        // a line that does not fall is met at every speed
        let share = match fall > 0.0 {
            true => 1.0,
            false => (supply_v / servo.reference_supply_v).min(1.0),
        };
        Self {
            tau_max_nm: share * servo.tau_max_nm,
            flat_to_radps: servo.qd_tau_max_radps + faster_radps,
            taper_at_radps: servo.qd_max_radps + faster_radps,
            tau_there_nm: share * servo.tau_qd_max_nm,
            tau_brake_max_nm: servo.tau_brake_max_nm,
            supply_v,
        }
    }

    /// Largest torque in the direction of motion at `speed_radps` (≥ 0), N·m; negative beyond the no-load
    /// speed.
    pub fn driving_limit_nm(&self, speed_radps: f64) -> f64 {
        self.line_nm(speed_radps).clamp(-self.tau_brake_max_nm, self.tau_max_nm)
    }

    /// Largest torque against the motion at `speed_radps` (≥ 0), N·m.
    pub fn braking_limit_nm(&self, speed_radps: f64) -> f64 {
        self.line_nm(-speed_radps).min(self.tau_brake_max_nm)
    }

    /// What the voltage allows in one direction at a speed in that direction, N·m.
    fn line_nm(&self, speed_radps: f64) -> f64 {
        let fall =
            (self.tau_max_nm - self.tau_there_nm) / (self.taper_at_radps - self.flat_to_radps);
        self.tau_max_nm - fall * (speed_radps - self.flat_to_radps)
    }

    /// Whether a motor that gives `torque_nm` at `speed_radps` gives all it can.
    pub fn is_reached(&self, torque_nm: f64, speed_radps: f64) -> bool {
        let limit_nm = match torque_nm * speed_radps < 0.0 {
            true => self.braking_limit_nm(speed_radps.abs()),
            false => self.driving_limit_nm(speed_radps.abs()),
        };
        // beyond the no-load speed nothing drives: the least torque is all there is
        torque_nm.abs() >= AT_THE_LIMIT * limit_nm && torque_nm != 0.0
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    /// XM430-W210 at its reference supply of 12 V.
    pub(crate) const W210: Envelope = Envelope {
        tau_max_nm: 1.94,
        flat_to_radps: 0.8,
        taper_at_radps: 7.6,
        tau_there_nm: 0.40,
        tau_brake_max_nm: 2.2,
        supply_v: 12.0,
    };

    #[test]
    fn limits_by_hand() {
        assert_eq!(W210.driving_limit_nm(0.5), 1.94);
        // half way between 0.8 and 7.6 rad/s: (1.94 + 0.40)/2
        assert!((W210.driving_limit_nm(4.2) - 1.17).abs() < 1e-12);
        // (1.94 − 0.40)/6.8 = 0.2265 N·m·s: zero at 0.8 + 1.94/0.2265 = 9.366 rad/s
        assert!(W210.driving_limit_nm(9.3) > 0.0 && W210.driving_limit_nm(9.4) < 0.0);
    }

    #[test]
    fn reached_by_hand() {
        // 95 % of 1.17 is 1.1115
        assert!(W210.is_reached(1.12, 4.2) && W210.is_reached(-1.12, -4.2));
        assert!(!W210.is_reached(1.10, 4.2));
        // slowly against the motion the line, 1.94 + 0.2265·(0.8 + 0.1) = 2.1438, is below the limit of 2.2
        assert!((W210.braking_limit_nm(0.1) - 2.143_824).abs() < 1e-6);
        // braking: 95 % of 2.2 is 2.09
        assert!(!W210.is_reached(-1.9, 4.2) && W210.is_reached(-2.1, 4.2));
        assert!(!W210.is_reached(0.0, 12.0));
    }
}
