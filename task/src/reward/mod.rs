//! Rewards: named, weighted terms of one control step.
//!
//! `reward = dt · Σ weight · value`: terms that reward have weights ≥ 0, terms that cost have weights ≤ 0,
//! and every value is ≥ 0, so that a wrong sign is refused when the configuration is read.
//!
//! To add a term, write its function in [`terms`] and add one row to the table below.

pub mod terms;

use std::f32::consts::PI;

use serde::{Deserialize, Serialize};

use crate::error::{checks, require_all};
use crate::{COMMAND_DIM, JointTable, PerFoot, TaskError};

/// Whether a term pays or costs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Sense {
    /// Weight ≥ 0.
    Reward,
    /// Weight ≤ 0.
    Cost,
}

impl Sense {
    /// The factor on a term of this sense while costs are multiplied by `cost_scale`.
    fn scale(self, cost_scale: f32) -> f32 {
        match self {
            Self::Reward => 1.0,
            Self::Cost => cost_scale,
        }
    }
}

/// A row of the table of terms.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TermInfo {
    /// Name in configuration and logs.
    pub name: &'static str,
    /// Whether it pays or costs.
    pub sense: Sense,
    /// Unit of its value, before the weight.
    pub unit: &'static str,
    /// Weight unless the configuration says otherwise.
    pub default_weight: f32,
}

/// Makes, from one row per term: the weights (with their documentation), the table and the evaluation.
macro_rules! reward_terms {
    ($($(#[doc = $doc:literal])+ $name:ident: $sense:ident, $unit:literal, $default:literal;)+) => {
        /// Table `[task.reward.weights]`: weight of each term; 0 switches a term off (it is then not
        /// computed).
        #[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
        #[serde(deny_unknown_fields, default)]
        pub struct RewardWeights {
            $($(#[doc = $doc])+ pub $name: f32,)+
        }

        impl Default for RewardWeights {
            fn default() -> Self {
                Self { $($name: $default,)+ }
            }
        }

        impl RewardWeights {
            /// Checks that each weight is finite and has its term's sign.
            ///
            /// # Errors
            /// [`TaskError::Config`] names the first weight that is wrong.
            pub fn validate(&self) -> Result<(), TaskError> {
                $(check_weight(Sense::$sense, self.$name, concat!("reward.weights.", stringify!($name)))?;)+
                Ok(())
            }

            /// The weights in the order of [`TERMS`].
            pub fn to_array(&self) -> [f32; TERM_COUNT] {
                [$(self.$name),+]
            }
        }

        /// Every term, in the order of all per-term arrays.
        pub const TERMS: &[TermInfo] = &[$(TermInfo {
            name: stringify!($name),
            sense: Sense::$sense,
            unit: $unit,
            default_weight: $default,
        }),+];

        /// Number of terms.
        pub const TERM_COUNT: usize = [$(stringify!($name)),+].len();

        /// Evaluates all terms for one control step of `dt_s` seconds, costs multiplied by `cost_scale`
        /// ([`RewardConfig::cost_scale`]). `contributions` (in the order of
        /// [`TERMS`]) receives each term's part, weight and `dt_s` included; the sum is the reward.
        pub fn evaluate(
            config: &RewardConfig,
            input: &RewardInput<'_>,
            dt_s: f32,
            cost_scale: f32,
            contributions: &mut [f32; TERM_COUNT],
        ) -> f32 {
            let weights = &config.weights;
            *contributions = [$(
                if weights.$name == 0.0 {
                    0.0
                } else {
                    dt_s * Sense::$sense.scale(cost_scale) * weights.$name * terms::$name(config, input)
                }
            ),+];
            contributions.iter().sum()
        }
    };
}

reward_terms! {
    /// exp(−‖v_cmd − v_xy‖²/`lin_vel_sigma`): follow the commanded velocity, along the course where one is
    /// held. Default 1.0 (paper).
    tracking_lin_vel: Reward, "1", 1.0;
    /// exp(−(ω_cmd − ω_z)²/`yaw_rate_sigma`): follow the commanded yaw rate. Default 0.5 (paper).
    tracking_yaw_rate: Reward, "1", 0.5;
    /// exp(−Σ (z_j − z_ref(φ_j))²/`phase_sigma`): lift the feet with the gait clock, those that can reach the
    /// ground; 1 afloat. Default 1.0 (paper); too small: the policy shuffles or vibrates.
    phase: Reward, "1", 1.0;
    /// Σ|q̇τ|, mechanical power of all motors in either direction. Default −1e-3 (paper); −3e-3 curbs
    /// vibration; too strong: standing still pays more than walking.
    power: Cost, "W", -1e-3;
    /// Σ(a_t − a_{t−1})², of the actions as the policy gave them (clipped). Default 0 (not in the paper).
    action_rate: Cost, "1", 0.0;
    /// Σ τ², motor torques. Default 0 (not in the paper).
    torque: Cost, "N²m²", 0.0;
    /// Σ((q̇_t − q̇_{t−1})/dt)², joint accelerations. Default 0 (not in the paper).
    joint_acceleration: Cost, "rad²/s⁴", 0.0;
    /// Σ over joints of how far they are beyond `soft_limit_share` of their range, rad. Default 0.
    joint_limits: Cost, "rad", 0.0;
    /// Σ over joints of how far the smoothed target lies outside the joint's range before it is cut off
    /// there, rad. Default 0. A policy whose target is a radian beyond a limit feels nothing of what it does
    /// with that joint any more, and learns nothing. With -0.1 such legs stayed there for 1,200 iterations,
    /// with -0.6 they came back within 1,000 (docs/reference/learning.md).
    target_limits: Cost, "rad", 0.0;
    /// Sum of the horizontal speeds of the feet that are in contact. Default 0 (not in the paper).
    slip: Cost, "m/s", 0.0;
    /// g_x² + g_y² of the gravity direction in the body frame: lean and roll. Default 0.
    orientation: Cost, "1", 0.0;
    /// Contact force on trunk and legs but not the feet (a trailing tail is free), as a share of
    /// `trunk_force_n`, at most 1; free in water, where a robot lands on its belly. Default 0.
    trunk_contact: Cost, "1", 0.0;
    /// v_z² of the whole body: hopping. Default 0.
    vertical_velocity: Cost, "m²/s²", 0.0;
    /// ω_x² + ω_y² in the body frame: rocking. Default 0.
    rocking: Cost, "rad²/s²", 0.0;
    /// Σ|q − q_nominal| while the command is to stand. Default 0.
    stand_still: Cost, "rad", 0.0;
    /// Σ(q − q_nominal)² of the body joints, those that move no leg; free afloat. A bend is cheapest where
    /// all joints share it, and a tail that is carried to one side, or swung for nothing, costs for ever.
    /// Default 0 (not in the paper); too strong: a stiff trunk.
    bend: Cost, "rad²", 0.0;
    /// Afloat, mean over the leg joints of max(0, 1 − |q − q_swimming|/`leg_fold_within_rad`): legs folded
    /// back as in the robot file's swimming pose; 1 on land and in shallow water, so that nothing is lost by
    /// leaving the water. Too small: a leg hangs, and stops the robot where it meets the ground. Default 0
    /// (not in the paper).
    leg_fold: Reward, "1", 0.0;
    /// Afloat, mean over the body joints of exp(−(q − q_wave)²/`wave_sigma`): a wave that travels from head
    /// to tail with the gait clock, as high as the commanded forward speed asks for; 1 on land and in shallow
    /// water. What `phase` is to walking. Default 0 (not in the paper); without it the policy does not find
    /// out how to swim: independent noise in eight joints makes no travelling wave.
    body_wave: Reward, "1", 0.0;
}

fn check_weight(sense: Sense, weight: f32, field: &'static str) -> Result<(), TaskError> {
    let (right, reason) = match sense {
        Sense::Reward => (
            (0.0..=1e4).contains(&weight),
            "this term rewards, its weight must be 0 to 10000",
        ),
        Sense::Cost => (
            (-1e4..=0.0).contains(&weight),
            "this term costs, its weight must be -10000 to 0",
        ),
    };
    require_all(&[(right, field, &weight, reason)])
}

/// Table `[task.reward]`: shapes of the terms; their weights are in `[task.reward.weights]`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RewardConfig {
    /// σ_v of `tracking_lin_vel`, (m/s)². Default 0.25 (MuJoCo Playground, for robots that do 1 m/s). On a
    /// 0.3 m/s robot standing still then earns exp(−0.09/0.25) = 70 %; 0.04 to 0.07 makes it walk.
    /// Too small: no gradient from a standstill.
    pub lin_vel_sigma: f32,
    /// σ_ω of `tracking_yaw_rate`, (rad/s)². Default 0.25 (MuJoCo Playground); 0.1 to 0.15 follows turns
    /// better.
    pub yaw_rate_sigma: f32,
    /// σ_phase of `phase`, m². Default 0.01 (MuJoCo Playground), that is 10 cm over all feet together; 0.004
    /// with a swing of 5 cm makes the feet follow.
    pub phase_sigma: f32,
    /// Vertical force from which a foot counts as in contact, N. Default 1: a foot carries about 6 N
    /// standing.
    pub contact_force_n: f32,
    /// Force on the trunk that counts as full `trunk_contact`, N. Default 5, a fifth of the robot's weight.
    pub trunk_force_n: f32,
    /// How far from folded a leg joint earns nothing of `leg_fold`, rad. Default π: a hip that stands as for
    /// walking is 1.3 rad from folded and earns 59 %. Smaller: a leg that hangs, 2.5 rad off, is not pulled.
    pub leg_fold_within_rad: f32,
    /// Height of the travelling wave of `body_wave` at 0.3 m/s, head and tail, rad; in between linear, and
    /// proportional to the commanded speed up to 1.5 times that. Default 0.14 and 0.22, with which the
    /// nominal robot swims at about 0.3 m/s open loop. Larger: faster and more power.
    pub wave_amplitude_rad: [f32; 2],
    /// Phase by which each body joint lags behind the one ahead of it, rad. Default 0.7: eight joints make
    /// nine tenths of a wave.
    pub wave_lag_rad: f32,
    /// How far each joint of the wave is bent to the side for a commanded yaw rate of 1 rad/s, rad: a swimmer
    /// turns towards the side to which its body is bent. Default 0: straight waves, which cannot be steered.
    /// 0.2 bends eight joints by 46° in all at 0.5 rad/s.
    pub wave_turn_rad: f32,
    /// σ of `body_wave`, rad². Default 0.05: a straight body earns three quarters at 0.3 m/s with the default
    /// height. Smaller: nothing pulls a joint that is far from the wave; larger: a straight body earns nearly
    /// all.
    pub wave_sigma: f32,
    /// Share of each joint's range, about its middle, within which `joint_limits` is zero. Default 0.95.
    pub soft_limit_share: f32,
    /// Factor on all costs at the start of a run, 0 to 1; it grows to 1 in proportion over
    /// `costs_full_after_env_steps`. Default 1. Full costs from the start make standing still pay before the
    /// robot has found out how to walk, above all where small commands are among those drawn.
    pub costs_at_start: f32,
    /// Environment steps of the whole run after which costs count in full. Default 0: from the start.
    pub costs_full_after_env_steps: u64,
    /// Weight of each term.
    pub weights: RewardWeights,
}

impl Default for RewardConfig {
    fn default() -> Self {
        Self {
            lin_vel_sigma: 0.25,
            yaw_rate_sigma: 0.25,
            phase_sigma: 0.01,
            contact_force_n: 1.0,
            trunk_force_n: 5.0,
            leg_fold_within_rad: PI,
            wave_amplitude_rad: [0.14, 0.22],
            wave_lag_rad: 0.7,
            wave_turn_rad: 0.0,
            wave_sigma: 0.05,
            soft_limit_share: 0.95,
            costs_at_start: 1.0,
            costs_full_after_env_steps: 0,
            weights: RewardWeights::default(),
        }
    }
}

impl RewardConfig {
    /// Factor on all costs after `env_steps` environment steps of the whole run.
    pub fn cost_scale(&self, env_steps: u64) -> f32 {
        if env_steps >= self.costs_full_after_env_steps {
            return 1.0;
        }
        let share = env_steps as f64 / self.costs_full_after_env_steps as f64;
        self.costs_at_start + (1.0 - self.costs_at_start) * share as f32
    }

    /// Checks every value.
    ///
    /// # Errors
    /// [`TaskError::Config`] names the first field that is out of range.
    pub fn validate(&self) -> Result<(), TaskError> {
        let above_zero = |value: f32| value > 0.0 && value <= 1e6;
        let reason = "must be above 0 and at most 1000000";
        let share = self.soft_limit_share > 0.0 && self.soft_limit_share <= 1.0;
        let wave = self
            .wave_amplitude_rad
            .iter()
            .all(|a| (0.0..=2.0).contains(a));
        checks! {
            self, "reward.";
            lin_vel_sigma: above_zero(self.lin_vel_sigma), reason;
            yaw_rate_sigma: above_zero(self.yaw_rate_sigma), reason;
            phase_sigma: above_zero(self.phase_sigma), reason;
            contact_force_n: above_zero(self.contact_force_n), reason;
            trunk_force_n: above_zero(self.trunk_force_n), reason;
            leg_fold_within_rad: above_zero(self.leg_fold_within_rad), reason;
            wave_sigma: above_zero(self.wave_sigma), reason;
            soft_limit_share: share, "must be above 0 and at most 1";
            wave_amplitude_rad: wave, "must be 0 to 2 rad";
            wave_lag_rad: (-PI..=PI).contains(&self.wave_lag_rad), "must be -π to π";
            wave_turn_rad: (0.0..=1.0).contains(&self.wave_turn_rad), "must be 0 to 1 rad";
            costs_at_start: (0.0..=1.0).contains(&self.costs_at_start), "must be 0 to 1";
        }?;
        self.weights.validate()
    }
}

/// What the terms look at: the true state after a control step, without sensor noise.
#[derive(Clone, Copy, Debug)]
pub struct RewardInput<'a> {
    /// The joints' nominal pose and limits.
    pub joints: &'a JointTable,
    /// Length of the control step, s.
    pub dt_s: f32,
    /// Height of the foot reference at the top of the swing, m.
    pub swing_height_m: f32,
    /// Command that held during the step: vx, vy (m/s), yaw rate (rad/s).
    pub command: [f32; COMMAND_DIM],
    /// Whether that command is to stand.
    pub standing: bool,
    /// Phase of each foot (of the clock without feet) after the step, rad, (−π, π].
    pub phase_rad: PerFoot,
    /// How far the heading is to the left of the course that the command holds, rad; 0 where it holds none.
    pub off_course_rad: f32,
    /// Velocity of the whole body's centre of mass, m/s, heading frame.
    pub com_vel_mps: [f32; 3],
    /// Yaw rate of the whole body's equivalent rotation, rad/s.
    pub yaw_rate_radps: f32,
    /// Angular velocity of the body, rad/s, body frame.
    pub gyro_radps: [f32; 3],
    /// Direction of gravity, unit vector, body frame.
    pub gravity: [f32; 3],
    /// Joint positions, rad.
    pub joint_pos_rad: &'a [f32],
    /// Joint velocities, rad/s.
    pub joint_vel_radps: &'a [f32],
    /// Joint velocities after the step before, rad/s.
    pub previous_joint_vel_radps: &'a [f32],
    /// Motor torques, mean over the step, N·m.
    pub motor_torque_nm: &'a [f32],
    /// Mechanical power of each motor, mean over the step, signed, W.
    pub mech_power_w: &'a [f32],
    /// Height of each foot's lowest point above the ground, m.
    pub foot_height_m: &'a [f32],
    /// Velocity of each foot, m/s, world.
    pub foot_vel_mps: &'a [[f32; 3]],
    /// Contact force on each foot, mean over the step, N, world.
    pub foot_force_n: &'a [[f32; 3]],
    /// Sum of contact forces on everything but the feet, N.
    pub trunk_force_n: f32,
    /// 1 while the whole body's centre of mass is below the water's surface, 0 otherwise.
    pub submerged: f32,
    /// 1 while it is that and the ground is out of reach (`task.afloat_above_m`), 0 otherwise.
    pub afloat: f32,
    /// Which feet can be asked to walk, 1 or 0: all of them on land, and in water those with the ground in
    /// reach.
    pub on_ground: PerFoot,
    /// Which joints move a leg.
    pub in_leg: &'a [bool],
    /// Joint positions of the swimming pose, rad.
    pub swimming_rad: &'a [f32],
    /// Position targets of this step before they are cut off at the limits, rad.
    pub target_rad: &'a [f32],
    /// The action of this step, clipped.
    pub action: &'a [f32],
    /// The action of the step before, clipped.
    pub previous_action: &'a [f32],
}

#[cfg(test)]
pub(crate) mod tests;
