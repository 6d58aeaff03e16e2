//! Rewards: named, weighted terms of one control step.
//!
//! `reward = dt · Σ weight · value`: terms that reward have weights ≥ 0, terms that cost have weights ≤ 0,
//! and every value is ≥ 0, so that a wrong sign is refused when the configuration is read.
//!
//! To add a term, write its function in [`terms`] and add one row to the table below.

mod input;
pub mod own;
pub mod terms;

use std::f32::consts::PI;

use caudata_declare::settings;
use serde::{Deserialize, Serialize};

pub use self::input::RewardInput;
use self::own::{OwnTerm, Programs, StateSignals};
use crate::TaskError;
use crate::error::{checks, require_all};
use crate::expression::Names;
use crate::row::Row;

/// Whether a term pays or costs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Sense {
    /// Weight ≥ 0.
    Reward,
    /// Weight ≥ 0: pays for how the robot is to move, not for what it is to reach.
    Guide,
    /// Weight ≤ 0.
    Cost,
}

impl Sense {
    fn of(weight: f32) -> Self {
        if weight < 0.0 { Self::Cost } else { Self::Reward }
    }
}

/// Factors on the terms at a moment of a run.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Scales {
    /// On those that cost.
    pub costs: f32,
    /// On those that guide.
    pub guides: f32,
}

impl Scales {
    fn on(self, sense: Sense) -> f32 {
        match sense {
            Sense::Reward => 1.0,
            Sense::Guide => self.guides,
            Sense::Cost => self.costs,
        }
    }
}

/// A value per reward term.
pub type PerTerm<T = f32> = Row<T, TERMS_MAX>;

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
    /// Its formula, and what it is for.
    pub about: &'static str,
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
            about: concat!($($doc),+),
        }),+];

        /// Number of terms.
        pub const TERM_COUNT: usize = [$(stringify!($name)),+].len();

        /// Evaluates the terms of the table, weight and `dt_s` included.
        fn built_in(
            config: &RewardConfig,
            input: &RewardInput<'_>,
            dt_s: f32,
            scales: Scales,
        ) -> [f32; TERM_COUNT] {
            let weights = &config.weights;
            [$(
                if weights.$name == 0.0 {
                    0.0
                } else {
                    dt_s * scales.on(Sense::$sense) * weights.$name * terms::$name(config, input)
                }
            ),+]
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
    phase: Guide, "1", 1.0;
    /// 1 in every step: a robot that lives earns it. Default 0 (not in the paper). Where costs outweigh what an
    /// untrained policy earns, to fall at once is best, and training finds that out; with this it is not.
    alive: Reward, "1", 0.0;
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
    body_wave: Guide, "1", 0.0;
    /// Mean over the feet of 1 where a foot bears more than `contact_force_n` in the middle two fifths of its
    /// stance and no more than that in the middle two fifths of its swing, by the gait clock; else 0, and 1 in
    /// between. Default 0 (not in the paper). `phase` asks for a height, and a small hop has some of it at any
    /// frequency; this asks for weight on the one foot while the other is up.
    in_step: Guide, "1", 0.0;
}

fn check_weight(sense: Sense, weight: f32, field: &'static str) -> Result<(), TaskError> {
    let (right, reason) = match sense {
        Sense::Reward | Sense::Guide => {
            ((0.0..=1e4).contains(&weight), "this term rewards, its weight must be 0 to 10000")
        }
        Sense::Cost => {
            ((-1e4..=0.0).contains(&weight), "this term costs, its weight must be -10000 to 0")
        }
    };
    require_all(&[(right, field, &weight, reason)])
}

/// Most terms of a task, its own included.
pub const TERMS_MAX: usize = TERM_COUNT + own::OWN_MAX;

/// Evaluates all terms for one control step of `dt_s` seconds, costs and guides multiplied by `scales`
/// ([`RewardConfig::scales`]). `own` are the compiled terms of the task file. `contributions` (in the
/// order of [`RewardConfig::term_names`]) receives each term's part, weight and `dt_s` included; the sum is
/// the reward.
pub fn evaluate(
    config: &RewardConfig,
    own: &mut Programs,
    input: &RewardInput<'_>,
    dt_s: f32,
    scales: Scales,
    contributions: &mut PerTerm,
) -> f32 {
    let built_in = built_in(config, input, dt_s, scales);
    contributions.set(&built_in);
    if !own.is_empty() {
        let all = TERM_COUNT + own.len();
        contributions.refill(all, |i| built_in.get(i).copied().unwrap_or(0.0));
        let signals = StateSignals::new(input, config.contact_force_n);
        for (which, term) in config.term.iter().enumerate() {
            let sense = Sense::of(term.weight);
            let value = own.value(which, &signals);
            contributions[TERM_COUNT + which] = dt_s * scales.on(sense) * term.weight * value;
        }
    }
    contributions.iter().sum()
}

settings! {
    /// Table `[task.reward]`: shapes of the terms; their weights are in `[task.reward.weights]`.
    #[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
    #[serde(deny_unknown_fields, default)]
    pub struct RewardConfig {
        /// σ_v of `tracking_lin_vel`, (m/s)². Default 0.25 (MuJoCo Playground, for robots that do 1 m/s). On a
        /// 0.3 m/s robot standing still then earns exp(−0.09/0.25) = 70 %; 0.04 to 0.07 makes it walk.
        /// Too small: no gradient from a standstill.
        pub lin_vel_sigma: f32 = 0.25,
        /// σ_ω of `tracking_yaw_rate`, (rad/s)². Default 0.25 (MuJoCo Playground); 0.1 to 0.15 follows turns
        /// better.
        pub yaw_rate_sigma: f32 = 0.25,
        /// σ_phase of `phase`, m². Default 0.01 (MuJoCo Playground), that is 10 cm over all feet together; 0.004
        /// with a swing of 5 cm makes the feet follow.
        pub phase_sigma: f32 = 0.01,
        /// Vertical force from which a foot counts as in contact, N. Default 1: a foot carries about 6 N
        /// standing.
        pub contact_force_n: f32 = 1.0,
        /// Force on the trunk that counts as full `trunk_contact`, N. Default 5, a fifth of the robot's weight.
        pub trunk_force_n: f32 = 5.0,
        /// How far from folded a leg joint earns nothing of `leg_fold`, rad. Default π: a hip that stands as for
        /// walking is 1.3 rad from folded and earns 59 %. Smaller: a leg that hangs, 2.5 rad off, is not pulled.
        pub leg_fold_within_rad: f32 = PI,
        /// Height of the travelling wave of `body_wave` at 0.3 m/s, head and tail, rad; in between linear, and
        /// proportional to the commanded speed up to 1.5 times that. Default 0.14 and 0.22, with which the
        /// nominal robot swims at about 0.3 m/s open loop. Larger: faster and more power.
        pub wave_amplitude_rad: [f32; 2] = [0.14, 0.22],
        /// Phase by which each body joint lags behind the one ahead of it, rad. Default 0.7: eight joints make
        /// nine tenths of a wave.
        pub wave_lag_rad: f32 = 0.7,
        /// How far each joint of the wave is bent to the side for a commanded yaw rate of 1 rad/s, rad: a swimmer
        /// turns towards the side to which its body is bent. Default 0: straight waves, which cannot be steered.
        /// 0.2 bends eight joints by 46° in all at 0.5 rad/s.
        pub wave_turn_rad: f32 = 0.0,
        /// σ of `body_wave`, rad². Default 0.05: a straight body earns three quarters at 0.3 m/s with the default
        /// height. Smaller: nothing pulls a joint that is far from the wave; larger: a straight body earns nearly
        /// all.
        pub wave_sigma: f32 = 0.05,
        /// Share of each joint's range, about its middle, within which `joint_limits` is zero. Default 0.95.
        pub soft_limit_share: f32 = 0.95,
        /// Factor on all costs at the start of a run, 0 to 1; it grows to 1 in proportion over
        /// `costs_full_after_env_steps`. Default 1. Full costs from the start make standing still pay before the
        /// robot has found out how to walk, above all where small commands are among those drawn.
        pub costs_at_start: f32 = 1.0,
        /// Environment steps of the whole run after which costs count in full, and guides (`guides_at_start`)
        /// once. Default 0: from the start.
        pub costs_full_after_env_steps: u64 = 0,
        /// Factor on guides (`phase`, `in_step`, `body_wave`) at the start of a run, 1 to 10; it falls to 1 in
        /// proportion over `costs_full_after_env_steps`, and does nothing where that is 0. Default 1. Where many
        /// commands are slow, or go both ways, stepping does not pay at first, and some seeds settle for standing; 2.3
        /// makes them step in place before they follow a command.
        pub guides_at_start: f32 = 1.0,
        /// Terms of one's own, beside the built-in ones. Default none.
        pub term: Vec<OwnTerm>,
        /// Weight of each term.
        pub weights: RewardWeights,
    }
}

impl RewardConfig {
    /// Factors on costs and guides after `env_steps` environment steps of the whole run.
    pub fn scales(&self, env_steps: u64) -> Scales {
        if env_steps >= self.costs_full_after_env_steps {
            return Scales { costs: 1.0, guides: 1.0 };
        }
        let share = (env_steps as f64 / self.costs_full_after_env_steps as f64) as f32;
        let at = |start: f32| start + (1.0 - start) * share;
        Scales { costs: at(self.costs_at_start), guides: at(self.guides_at_start) }
    }

    /// Checks every value.
    ///
    /// # Errors
    /// [`TaskError::Config`] names the first field that is out of range.
    pub fn validate(&self) -> Result<(), TaskError> {
        let above_zero = |value: f32| value > 0.0 && value <= 1e6;
        let reason = "must be above 0 and at most 1000000";
        let share = self.soft_limit_share > 0.0 && self.soft_limit_share <= 1.0;
        let wave = self.wave_amplitude_rad.iter().all(|a| (0.0..=2.0).contains(a));
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
            guides_at_start: (1.0..=10.0).contains(&self.guides_at_start), "must be 1 to 10";
        }?;
        let weight = |term: &&OwnTerm| !(-1e4..=1e4).contains(&term.weight);
        if let Some(term) = self.term.iter().find(weight) {
            let reason = "has a weight that is not -10000 to 10000".to_owned();
            return Err(TaskError::term(TERM_TABLE, &term.name, reason));
        }
        own::check(TERM_TABLE, TERMS.iter().map(|term| term.name), self.own())?;
        self.weights.validate()
    }

    fn own(&self) -> impl Iterator<Item = (&str, &str)> {
        self.term.iter().map(|term| (term.name.as_str(), term.value.as_str()))
    }

    /// The terms of the task file, compiled for a robot.
    ///
    /// # Errors
    /// [`TaskError::Term`] names the first that is wrong.
    pub fn programs(&self, names: Names<'_>) -> Result<Programs, TaskError> {
        Programs::new(TERM_TABLE, self.own(), names)
    }

    /// Names of all terms, in the order of all per-term arrays: those of the table, then its own.
    pub fn term_names(&self) -> Vec<String> {
        let built_in = TERMS.iter().map(|term| term.name.to_owned());
        built_in.chain(self.term.iter().map(|term| term.name.clone())).collect()
    }
}

const TERM_TABLE: &str = "task.reward.term";

#[cfg(test)]
pub(crate) mod tests;
