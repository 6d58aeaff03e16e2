//! From a lane's [`LaneParams`] to what its drive-lines compute with.

use caudata_model::{Joint, JointKind, JointMotion, RobotModel};

use super::command::MAX_COMMAND_DELAY_S;
use super::gear::TOOTH_STIFFNESS_NM_PER_RAD;
use super::params::{JointPassive, NO_LIMIT, ServoDrive};
use super::supply::Supply;
use super::{filter, friction, loop_delay};
use crate::LaneParams;
use crate::params::backlash_joints;
use crate::stop::Stop;

impl ServoDrive<f64> {
    /// The drives of a lane, one for each actuated joint.
    pub fn all(model: &RobotModel, params: &LaneParams, dt_s: f64) -> Vec<Self> {
        (0..model.actuated().len()).map(|a| Self::new(model, params, a, dt_s)).collect()
    }

    /// Servo `a` (policy order) of a lane with parameters `params`, for physics steps of `dt_s`.
    pub fn new(model: &RobotModel, params: &LaneParams, a: usize, dt_s: f64) -> Self {
        let servo = model.servo(a);
        let e = &params.joints[a];
        let wide = |x: f32| f64::from(x);
        let unlimited = |x: f32| if x > 0.0 { wide(x) } else { NO_LIMIT };
        let scale = wide(params.torque_scale[a]);
        let span = (servo.qd_max_radps - servo.qd_tau_max_radps).max(1e-6);
        let slope = ((servo.tau_max_nm - servo.tau_qd_max_nm) / span).max(0.0);
        let stall_nm = servo.tau_max_nm + slope * servo.qd_tau_max_radps;
        let speed = wide(e.speed_scale);
        let soft = e.gear_half_gap_rad > 0.0 || e.gear_stiffness_nm_per_rad > 0.0;
        let motor_encoder = if soft { wide(e.motor_encoder) } else { 0.0 };
        // the loop's damping acts on the rotor of the step before: one that is lighter would rattle
        let least = motor_encoder * dt_s * wide(params.kd_nms_per_rad[a] + e.kd_min_nms_per_rad);
        let rotor = wide(params.joint_armature_kgm2[a]).max(least);
        let teeth = match wide(e.gear_stiffness_nm_per_rad) {
            given if given > 0.0 => given,
            _ => {
                let joint = &model.joints()[model.actuated()[a]];
                TOOTH_STIFFNESS_NM_PER_RAD / joint.per_radian().powi(2)
            }
        };
        let constant = wide(e.torque_constant_nm_per_a);
        let at_limit = |limit_a: f32| constant * wide(limit_a - e.current_dead_band_a).max(0.0);
        let current_limit_nm =
            if e.current_limit_a > 0.0 { at_limit(e.current_limit_a) } else { NO_LIMIT };
        let braking_current_limit_nm = if e.braking_current_limit_a > 0.0 {
            at_limit(e.braking_current_limit_a)
        } else {
            current_limit_nm
        };
        let (driving, driven) = (wide(e.load_friction_driving), wide(e.load_friction_driven));
        Self {
            kp_nm_per_rad: wide(params.kp_nm_per_rad[a]),
            kd_nms_per_rad: wide(params.kd_nms_per_rad[a]),
            command_damping_nms_per_rad: wide(params.kd_nms_per_rad[a] * e.kd_on_command),
            rate_share: (wide(e.kd_rate_over_s) / dt_s).min(1.0),
            rate_low_pass_share: mean_share(wide(e.kd_rate_over_s) - dt_s, dt_s),
            speed_low_pass_share: dt_s / (dt_s + wide(e.damping_lag_s)),
            feed_forward_nm: 0.0,
            kd_min_nms_per_rad: wide(e.kd_min_nms_per_rad),
            tau_max_nm: servo.tau_max_nm * scale,
            tau_brake_max_nm: servo.tau_brake_max_nm * scale * wide(e.brake_scale),
            stall_nm_per_volt: stall_nm / servo.reference_supply_v * scale * wide(e.voltage_share),
            taper_nms_per_rad: slope / speed * scale,
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
            motor_encoder,
        }
    }

    /// Friction beside Coulomb's, at most, N·m.
    fn extra_friction_nm(&self) -> f64 {
        let per_load = self.load_friction_mean.abs()
            + self.load_friction_half_difference.abs()
            + self.load_stribeck;
        self.stribeck_nm + self.friction_asymmetry_nm.abs() + per_load * self.tau_max_nm
    }

    /// Rotor inertia that the engine adds to the joint, kg·m²: none where the rotor is a body of its own
    /// ([`super::gear`]).
    pub fn armature_kgm2(&self) -> f64 {
        self.rotor_kgm2 * (1.0 - self.gear_is_soft)
    }
}

/// Part of the way per step of a low-pass that stands for a mean over `time_s`: it is half of that late, as the mean is.
fn mean_share(time_s: f64, dt_s: f64) -> f64 {
    filter::lag_share(0.5 * time_s.max(0.0), dt_s)
}

impl JointPassive<f64> {
    /// This one, of `joint`, with friction that springs over no shorter way than steps of `dt_s` can follow;
    /// `servos` are the lane's. Hinges stay as they are: over 2 mrad even 0.6 N·m on 1.1e-3 kg·m² does not push
    /// them in steps of 2 ms.
    pub fn stepped(
        self,
        joint: &Joint,
        stop: &Stop,
        servos: &[ServoDrive<f64>],
        dt_s: f64,
    ) -> Self {
        if joint.motion == JointMotion::Hinge {
            return self;
        }
        let extra_nm = match joint.kind {
            JointKind::Actuated { index } => servos[index].extra_friction_nm(),
            JointKind::Passive | JointKind::Backlash => 0.0,
        };
        let bound_nm = self.friction_nm + extra_nm;
        let least_rad = friction::least_presliding_rad(bound_nm, stop.mobility(), dt_s);
        Self { presliding_rad: self.presliding_rad.max(least_rad), ..self }
    }

    /// All hinges of a lane with parameters `params`, model order. `[J]`
    pub fn all(model: &RobotModel, params: &LaneParams) -> Vec<Self> {
        let wide = |x: f32| f64::from(x);
        let mut hinges = params.hinges.iter();
        let mut all: Vec<Self> = model
            .joints()
            .iter()
            .map(|j| {
                let presliding_rad = friction::presliding_rad(j);
                let bare = Self { presliding_rad, ..Self::default() };
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
    pub fn new(params: &LaneParams, dt_s: f64) -> Self {
        Self {
            open_v: f64::from(params.supply_v),
            resistance_ohm: f64::from(params.supply_resistance_ohm),
            share: filter::lag_share(f64::from(params.supply_lag_s), dt_s),
        }
    }
}

/// How many steps a lane with parameters `params` has to remember of what its loops asked for, the present
/// one among them; 0 where none of them is late.
pub fn loop_memory_steps(params: &LaneParams, dt_s: f64) -> usize {
    let most =
        (params.joints.iter()).map(|j| loop_delay::steps(j.loop_delay_s, dt_s)).fold(0.0, f64::max);
    if most > 0.0 { most.ceil() as usize + 1 } else { 0 }
}
