//! Which stages of the drive-line an engine's lanes need at all.

use super::ServoDrive;
use super::params::NO_LIMIT;

/// One flag per stage that is neutral for the nominal robot. A stage that is off costs one branch shared by all lanes; on, it must be
/// neutral for the lanes that do not need it, and is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct DriveFeatures {
    /// Command delay or skew.
    pub delay: bool,
    /// Command low-pass.
    pub low_pass: bool,
    /// Speed or acceleration limit of the command.
    pub profile: bool,
    /// Controller dead band.
    pub dead_band: bool,
    /// Integral gain.
    pub integral: bool,
    /// Delay between loop and torque.
    pub loop_delay: bool,
    /// Gain ratio while driven back.
    pub back_drive: bool,
    /// Winding resistance other than nominal, or warming.
    pub winding: bool,
    /// Warming windings.
    pub thermal: bool,
    /// Current limit.
    pub current_limit: bool,
    /// Stribeck friction.
    pub stribeck: bool,
    /// Load-dependent friction.
    pub load_friction: bool,
    /// Load-dependent friction that is greater at rest.
    pub load_stribeck: bool,
    /// Torque that falls behind the current.
    pub saturation: bool,
    /// Friction that depends on the direction.
    pub asymmetry: bool,
    /// Torque ripple.
    pub ripple: bool,
    /// Play or compliance in the gear.
    pub gear: bool,
}

impl DriveFeatures {
    /// What `servo` needs.
    #[must_use]
    pub fn of(servo: &ServoDrive<f64>) -> Self {
        let thermal = servo.resistance_per_k > 0.0 && servo.thermal_rise_k_per_a2 > 0.0;
        Self {
            delay: servo.delay_s > 0.0,
            low_pass: servo.low_pass_share < 1.0,
            profile: servo.profile_speed_radps < NO_LIMIT
                || servo.profile_acceleration_radps2 < NO_LIMIT,
            dead_band: servo.dead_band_rad > 0.0,
            integral: servo.ki_nm_per_rad_s > 0.0,
            loop_delay: servo.loop_delay_steps > 0.0,
            back_drive: servo.back_drive_kp_ratio != 1.0,
            winding: servo.winding_scale != 1.0 || thermal,
            thermal,
            current_limit: servo.current_limit_nm < NO_LIMIT
                || servo.braking_current_limit_nm < NO_LIMIT,
            stribeck: servo.stribeck_nm > 0.0,
            load_friction: servo.load_friction_mean > 0.0
                || servo.load_friction_half_difference != 0.0
                || servo.load_stribeck > 0.0,
            load_stribeck: servo.load_stribeck > 0.0,
            saturation: servo.torque_saturation_per_nm > 0.0,
            asymmetry: servo.friction_asymmetry_nm != 0.0,
            ripple: servo.ripple_nm > 0.0,
            gear: servo.gear_is_soft > 0.5,
        }
    }

    /// What either needs.
    #[must_use]
    pub fn or(self, other: Self) -> Self {
        Self {
            delay: self.delay | other.delay,
            low_pass: self.low_pass | other.low_pass,
            profile: self.profile | other.profile,
            dead_band: self.dead_band | other.dead_band,
            integral: self.integral | other.integral,
            loop_delay: self.loop_delay | other.loop_delay,
            back_drive: self.back_drive | other.back_drive,
            winding: self.winding | other.winding,
            thermal: self.thermal | other.thermal,
            current_limit: self.current_limit | other.current_limit,
            stribeck: self.stribeck | other.stribeck,
            load_friction: self.load_friction | other.load_friction,
            load_stribeck: self.load_stribeck | other.load_stribeck,
            saturation: self.saturation | other.saturation,
            asymmetry: self.asymmetry | other.asymmetry,
            ripple: self.ripple | other.ripple,
            gear: self.gear | other.gear,
        }
    }
}
