//! Which stages of the drive-line an engine's lanes need at all.

use super::ServoDrive;
use super::params::NO_LIMIT;

/// Declares [`DriveFeatures`]: each flag with what tells that a servo needs the stage.
macro_rules! features {
    ($servo:ident; $($(#[$about:meta])* $flag:ident: $needed:expr,)+) => {
        /// One flag per stage that is neutral for the nominal robot. A stage that is off costs one branch
        /// shared by all lanes; on, it must be neutral for the lanes that do not need it, and is.
        #[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
        pub struct DriveFeatures {
            $($(#[$about])* pub $flag: bool,)+
        }

        impl DriveFeatures {
            /// What `servo` needs.
            pub fn of($servo: &ServoDrive<f64>) -> Self {
                Self { $($flag: $needed,)+ }
            }

            /// What either needs.
            pub fn or(self, other: Self) -> Self {
                Self { $($flag: self.$flag | other.$flag,)+ }
            }
        }
    };
}

features! {
    servo;
    /// Command delay or skew.
    delay: servo.delay_s > 0.0,
    /// Command low-pass.
    low_pass: servo.low_pass_share < 1.0,
    /// Speed or acceleration limit of the command.
    profile: servo.profile_speed_radps < NO_LIMIT || servo.profile_acceleration_radps2 < NO_LIMIT,
    /// Damping that acts on the rate of the error.
    command_damping: servo.command_damping_nms_per_rad > 0.0,
    /// Low-pass on the speed that the loop damps.
    speed_low_pass: servo.speed_low_pass_share < 1.0,
    /// Torque that is commanded.
    feed_forward: servo.feed_forward_nm != 0.0,
    /// Controller dead band.
    dead_band: servo.dead_band_rad > 0.0,
    /// Integral gain.
    integral: servo.ki_nm_per_rad_s > 0.0,
    /// Delay between loop and torque.
    loop_delay: servo.loop_delay_steps > 0.0,
    /// Gain ratio while driven back.
    back_drive: servo.back_drive_kp_ratio != 1.0,
    /// Winding resistance other than nominal, or warming.
    winding: servo.winding_scale != 1.0 || warms(servo),
    /// Warming windings.
    thermal: warms(servo),
    /// Current limit.
    current_limit: servo.current_limit_nm < NO_LIMIT || servo.braking_current_limit_nm < NO_LIMIT,
    /// Stribeck friction.
    stribeck: servo.stribeck_nm > 0.0,
    /// Load-dependent friction.
    load_friction: servo.load_friction_mean > 0.0
        || servo.load_friction_half_difference != 0.0
        || servo.load_stribeck > 0.0,
    /// Load-dependent friction that is greater at rest.
    load_stribeck: servo.load_stribeck > 0.0,
    /// Torque that falls behind the current.
    saturation: servo.torque_saturation_per_nm > 0.0,
    /// Friction that depends on the direction.
    asymmetry: servo.friction_asymmetry_nm != 0.0,
    /// Torque ripple.
    ripple: servo.ripple_nm > 0.0,
    /// Play or compliance in the gear.
    gear: servo.gear_is_soft > 0.5,
    /// An encoder on the motor, behind that.
    motor_encoder: servo.motor_encoder > 0.0,
}

fn warms(servo: &ServoDrive<f64>) -> bool {
    servo.resistance_per_k > 0.0 && servo.thermal_rise_k_per_a2 > 0.0
}
