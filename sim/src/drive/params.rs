//! What the drive-line computes with, per lane: made from [`LaneParams`] once, in the form that costs least per step.

use caudata_model::{JointKind, RobotModel};

use super::command::MAX_COMMAND_DELAY_S;
use super::gear::TOOTH_STIFFNESS_NM_PER_RAD;
use super::supply::Supply;
use super::{filter, friction, loop_delay};
use crate::LaneParams;
use crate::lanes::per_lane;
use crate::params::backlash_joints;

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
        /// Damping of the motor itself, on the motor's velocity, N·m·s/rad.
        pub kd_min_nms_per_rad: R,
        /// Flat torque limit, N·m.
        pub tau_max_nm: R,
        /// Limit against the motion, N·m.
        pub tau_brake_max_nm: R,
        /// Speed up to which the limit is flat, per volt of bus, rad/s/V.
        pub flat_speed_per_volt: R,
        /// Torque lost per speed beyond, times bus voltage, N·m·s·V/rad.
        pub taper_nms_v_per_rad: R,
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
    }
}

impl ServoDrive<f64> {
    /// Servo `a` (policy order) of a lane with parameters `params`, for physics steps of `dt_s`.
    #[must_use]
    pub fn new(model: &RobotModel, params: &LaneParams, a: usize, dt_s: f64) -> Self {
        let servo = model.servo(a);
        let e = &params.joints[a];
        let wide = |x: f32| f64::from(x);
        let unlimited = |x: f32| if x > 0.0 { wide(x) } else { NO_LIMIT };
        let scale = wide(params.torque_scale[a]);
        let span = (servo.qd_max_radps - servo.qd_tau_max_radps).max(1e-6);
        let slope = ((servo.tau_max_nm - servo.tau_qd_max_nm) / span).max(0.0);
        let speed = wide(e.speed_scale);
        let rotor = wide(params.joint_armature_kgm2[a]);
        let soft = e.gear_half_gap_rad > 0.0 || e.gear_stiffness_nm_per_rad > 0.0;
        let teeth = match wide(e.gear_stiffness_nm_per_rad) {
            given if given > 0.0 => given,
            _ => TOOTH_STIFFNESS_NM_PER_RAD,
        };
        let constant = wide(e.torque_constant_nm_per_a);
        let at_limit = |limit_a: f32| constant * wide(limit_a - e.current_dead_band_a).max(0.0);
        let current_limit_nm = if e.current_limit_a > 0.0 {
            at_limit(e.current_limit_a)
        } else {
            NO_LIMIT
        };
        let braking_current_limit_nm = if e.braking_current_limit_a > 0.0 {
            at_limit(e.braking_current_limit_a)
        } else {
            current_limit_nm
        };
        let (driving, driven) = (wide(e.load_friction_driving), wide(e.load_friction_driven));
        Self {
            kp_nm_per_rad: wide(params.kp_nm_per_rad[a]),
            kd_nms_per_rad: wide(params.kd_nms_per_rad[a]),
            kd_min_nms_per_rad: wide(e.kd_min_nms_per_rad),
            tau_max_nm: servo.tau_max_nm * scale,
            tau_brake_max_nm: servo.tau_brake_max_nm * scale * wide(e.brake_scale),
            flat_speed_per_volt: servo.qd_tau_max_radps / servo.reference_supply_v * speed,
            taper_nms_v_per_rad: slope * servo.reference_supply_v / speed * scale,
            back_drive_kp_ratio: wide(e.back_drive_kp_ratio),
            per_torque_constant_a_per_nm: 1.0 / constant,
            current_dead_band_a: wide(e.current_dead_band_a),
            current_limit_nm,
            braking_current_limit_nm,
            delay_s: wide((params.command_delay_s + e.command_skew_s).min(MAX_COMMAND_DELAY_S)),
            low_pass_share: filter::lag_share(wide(e.command_low_pass_s), dt_s),
            profile_speed_radps: unlimited(e.profile_speed_radps),
            profile_acceleration_radps2: unlimited(e.profile_acceleration_radps2),
            dead_band_rad: wide(e.dead_band_rad),
            dead_band_jump: wide(e.dead_band_jump),
            ki_nm_per_rad_s: wide(e.ki_nm_per_rad_s),
            loop_delay_steps: loop_delay::steps(e.loop_delay_s, dt_s),
            winding_scale: wide(e.winding_scale),
            resistance_per_k: wide(e.resistance_per_k),
            thermal_rise_k_per_a2: wide(e.thermal_rise_k_per_a2),
            thermal_share: filter::lag_share(wide(e.thermal_time_s), dt_s),
            stribeck_nm: wide(e.stribeck_nm),
            per_stribeck_speed_s_per_rad: 1.0 / wide(e.stribeck_speed_radps),
            load_friction_mean: 0.5 * (driving + driven),
            load_friction_half_difference: 0.5 * (driving - driven),
            load_stribeck: wide(e.load_stribeck),
            torque_saturation_per_nm: wide(e.torque_saturation_per_nm),
            friction_asymmetry_nm: wide(e.friction_asymmetry_nm),
            ripple_nm: wide(e.ripple_nm),
            ripple_per_turn: wide(e.ripple_per_turn),
            ripple_phase_rad: wide(e.ripple_phase_rad),
            gear_is_soft: f64::from(u8::from(soft)),
            gear_half_gap_rad: wide(e.gear_half_gap_rad),
            gear_stiffness_nm_per_rad: teeth,
            gear_damping_nms_per_rad: 2.0 * wide(e.gear_damping_ratio) * (teeth * rotor).sqrt(),
            rotor_kgm2: rotor,
        }
    }

    /// Rotor inertia that the engine adds to the joint, kg·m²: none where the rotor is a body of its own ([`super::gear`]).
    #[must_use]
    pub fn armature_kgm2(&self) -> f64 {
        self.rotor_kgm2 * (1.0 - self.gear_is_soft)
    }
}

impl JointPassive<f64> {
    /// All hinges of a lane with parameters `params`, model order. `[J]`
    #[must_use]
    pub fn all(model: &RobotModel, params: &LaneParams) -> Vec<Self> {
        let wide = |x: f32| f64::from(x);
        let mut hinges = params.hinges.iter();
        let mut all: Vec<Self> = model
            .joints()
            .iter()
            .map(|j| {
                let bare = Self {
                    presliding_rad: friction::PRESLIDING_RAD,
                    ..Self::default()
                };
                match j.kind {
                    JointKind::Actuated { index } => {
                        let e = &params.joints[index];
                        Self {
                            stiffness_nm_per_rad: wide(e.spring_nm_per_rad),
                            spring_rest_rad: wide(e.spring_rest_rad),
                            damping_nms_per_rad: wide(params.joint_damping_nms_per_rad[index]),
                            friction_nm: wide(params.joint_friction_nm[index]),
                            presliding_rad: wide(e.presliding_rad),
                            low_rad: wide(e.low_rad),
                            high_rad: wide(e.high_rad),
                        }
                    }
                    JointKind::Passive | JointKind::Backlash => match hinges.next() {
                        Some(h) => Self {
                            stiffness_nm_per_rad: wide(h.spring_nm_per_rad),
                            spring_rest_rad: wide(h.spring_rest_rad),
                            damping_nms_per_rad: wide(h.damping_nms_per_rad),
                            friction_nm: wide(h.friction_nm),
                            low_rad: wide(h.low_rad),
                            high_rad: wide(h.high_rad),
                            ..bare
                        },
                        None => bare,
                    },
                }
            })
            .collect();
        for (j, &half) in backlash_joints(model).zip(&params.backlash_half_width_rad) {
            all[j].low_rad = -wide(half);
            all[j].high_rad = wide(half);
        }
        all
    }
}

impl Supply<f64> {
    /// The supply of a lane with parameters `params`, for physics steps of `dt_s`.
    #[must_use]
    pub fn new(params: &LaneParams, dt_s: f64) -> Self {
        Self {
            open_v: f64::from(params.supply_v),
            resistance_ohm: f64::from(params.supply_resistance_ohm),
            share: filter::lag_share(f64::from(params.supply_lag_s), dt_s),
        }
    }
}
