//! What the drive-line computes with, per lane, in the form that costs least per step; [`super::of_lane`]
//! makes it.

use crate::per_lane::per_lane;

/// Stands for "no limit" where a finite number is needed.
pub const NO_LIMIT: f64 = 1e9;

per_lane! {
    /// Spring, damper, friction and end stops of any hinge (of a slide: read m for rad, N for N·m).
    pub struct JointPassive<R> {
        /// Spring, N·m/rad.
        pub stiffness_nm_per_rad: R,
        /// Where the spring is relaxed, rad.
        pub spring_rest_rad: R,
        /// Viscous damping, N·m·s/rad.
        pub damping_nms_per_rad: R,
        /// Coulomb friction, N·m.
        pub friction_nm: R,
        /// Deflection at which friction starts to slide, rad (> 0).
        pub presliding_rad: R,
        /// Lower end stop, rad.
        pub low_rad: R,
        /// Upper end stop, rad.
        pub high_rad: R,
    }
}

per_lane! {
    /// One servo and its gear.
    pub struct ServoDrive<R> {
        /// Proportional gain, N·m/rad.
        pub kp_nm_per_rad: R,
        /// Derivative gain on the joint's velocity, N·m·s/rad.
        pub kd_nms_per_rad: R,
        /// Torque per speed of the target, N·m·s/rad: Kd where it acts on the rate of the error.
        pub command_damping_nms_per_rad: R,
        /// Share of a step over which the target's speed is taken: 1 where it is taken over longer.
        pub rate_share: R,
        /// Part of the way that this speed makes per step where it is taken over longer; else 1.
        pub rate_low_pass_share: R,
        /// Part of the way that the low-pass on the speed that Kd damps makes per step: dt/(dt + τ), so that a speed
        /// that grows evenly is late by τ, however short that is.
        pub speed_low_pass_share: R,
        /// Torque that was commanded beside the position, N·m.
        pub feed_forward_nm: R,
        /// Damping of the motor itself, on the motor's velocity, N·m·s/rad.
        pub kd_min_nms_per_rad: R,
        /// Flat torque limit, N·m.
        pub tau_max_nm: R,
        /// Limit against the motion, N·m.
        pub tau_brake_max_nm: R,
        /// Torque at rest where nothing but the voltage limits it, per volt of bus, N·m/V.
        pub stall_nm_per_volt: R,
        /// What it loses with speed, N·m·s/rad.
        pub taper_nms_per_rad: R,
        /// Factor on Kp while driven back.
        pub back_drive_kp_ratio: R,
        /// 1/k_t: current per torque beyond the dead band, A/(N·m).
        pub per_torque_constant_a_per_nm: R,
        /// Current that gives no torque yet, A.
        pub current_dead_band_a: R,
        /// Torque at the current limit, N·m.
        pub current_limit_nm: R,
        /// The same against the motion, N·m.
        pub braking_current_limit_nm: R,
        /// Command delay with skew, s.
        pub delay_s: R,
        /// Part of the way that the command low-pass makes per step.
        pub low_pass_share: R,
        /// Speed limit of the command profile, rad/s.
        pub profile_speed_radps: R,
        /// Acceleration limit of the command profile, rad/s².
        pub profile_acceleration_radps2: R,
        /// Errors within ± this give no torque, rad.
        pub dead_band_rad: R,
        /// Share of that which errors outside get back.
        pub dead_band_jump: R,
        /// Integral gain, N·m/(rad·s).
        pub ki_nm_per_rad_s: R,
        /// Delay of the torque that the loop wants, in physics steps.
        pub loop_delay_steps: R,
        /// Winding resistance over the nominal one, cold.
        pub winding_scale: R,
        /// Growth of the resistance, 1/K.
        pub resistance_per_k: R,
        /// Steady rise of temperature per current squared, K/A².
        pub thermal_rise_k_per_a2: R,
        /// Part of the way to the steady temperature per step.
        pub thermal_share: R,
        /// Stribeck friction: extra at rest, N·m.
        pub stribeck_nm: R,
        /// Inverse of the speed at which it has fallen to 1/e, s/rad.
        pub per_stribeck_speed_s_per_rad: R,
        /// Friction per load torque, mean of driving and driven.
        pub load_friction_mean: R,
        /// Half of driving minus driven.
        pub load_friction_half_difference: R,
        /// Friction per load torque at rest, on top.
        pub load_stribeck: R,
        /// A motor that would give τ gives τ/(1 + s·|τ|): s, 1/(N·m).
        pub torque_saturation_per_nm: R,
        /// Friction more in the positive, less in the negative direction, N·m.
        pub friction_asymmetry_nm: R,
        /// Amplitude of torque ripple, N·m.
        pub ripple_nm: R,
        /// Its periods per turn of the joint.
        pub ripple_per_turn: R,
        /// Its phase at 0, rad.
        pub ripple_phase_rad: R,
        /// 1 where rotor and joint are two bodies, 0 where they are one.
        pub gear_is_soft: R,
        /// Half of the play, rad.
        pub gear_half_gap_rad: R,
        /// Teeth, N·m/rad.
        pub gear_stiffness_nm_per_rad: R,
        /// Teeth, N·m·s/rad.
        pub gear_damping_nms_per_rad: R,
        /// Rotor inertia seen at the joint, kg·m².
        pub rotor_kgm2: R,
        /// Share of what the rotor is ahead of the joint that the encoder sees; 0 where they are one.
        pub motor_encoder: R,
    }
}
