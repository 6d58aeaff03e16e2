//! Table `[task]`: everything about the task that a run may choose.

use caudata_declare::settings;
use serde::{Deserialize, Serialize};

use crate::TaskError;
use crate::action::ActionConfig;
use crate::command::CommandConfig;
use crate::critic::CriticConfig;
use crate::error::checks;
use crate::noise::ObservationNoiseConfig;
use crate::observation::ObservationConfig;
use crate::phase::PhaseConfig;
use crate::push::PushConfig;
use crate::randomise::RandomisationConfig;
use crate::reset::ResetConfig;
use crate::reward::RewardConfig;
use crate::termination::TerminationConfig;

settings! {
    /// The task. Defaults are the paper's values, and MuJoCo Playground's where the paper gives none.
    #[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
    #[serde(deny_unknown_fields, default)]
    pub struct TaskConfig {
        /// Time between two actions, s; must be a whole number of physics steps. Default 0.02 (50 Hz, paper).
        pub control_period_s: f64 = 0.02,
        /// Time limit of an episode, control steps. Default 1000 (20 s, paper). Reaching it is truncation,
        /// not failure.
        pub episode_steps: u32 = 1000,
        /// Gives the first episode of each environment a random length, so that later they do not all end at
        /// the same step (which would make some batches all starts and others none). Default true.
        pub stagger_first_episode: bool = true,
        /// Appends the medium bit (1 afloat, 0 otherwise) to the observation. Default false.
        pub observe_medium: bool = false,
        /// Height of the centre of mass above the highest ground under a foot or a girdle from which on a
        /// robot in water counts as afloat, m: the medium bit and the rewards of swimming begin there.
        /// Default 0.09 (it stands at 0.073). Smaller: a robot that swims ashore keeps its legs folded and
        /// never stands up; larger: it must get along without swimming where its feet find no ground.
        pub afloat_above_m: f32 = 0.09,
        /// Height of a girdle above the ground under it up to which, in water, its feet are asked to step
        /// (the reward `phase`), m. Default 0.09. Not afloat (the centre of mass is near the highest ground)
        /// and with a girdle higher than this (the other one is over deep water) its feet are asked for
        /// nothing. Larger: feet are judged that reach no ground; smaller: a robot that wades need not step.
        pub feet_reach_m: f32 = 0.09,
        /// What the policy sees.
        pub observation: ObservationConfig,
        /// What the value function sees besides.
        pub critic: CriticConfig,
        /// What an action means.
        pub action: ActionConfig,
        /// The gait clock.
        pub phase: PhaseConfig,
        /// Commanded velocities.
        pub command: CommandConfig,
        /// Rewards.
        pub reward: RewardConfig,
        /// Failing states.
        pub termination: TerminationConfig,
        /// Starts.
        pub reset: ResetConfig,
        /// Randomised physics.
        pub randomisation: RandomisationConfig,
        /// Pushes.
        pub push: PushConfig,
        /// Observation noise.
        pub noise: ObservationNoiseConfig,
    }
}

impl TaskConfig {
    /// Checks every value of every table.
    ///
    /// # Errors
    /// [`TaskError::Config`] names the first field that is out of range.
    pub fn validate(&self) -> Result<(), TaskError> {
        let height = |h: f32| (0.0..=10.0).contains(&h);
        checks! {
            self, "";
            control_period_s: (1e-4..=1.0).contains(&self.control_period_s), "must be 0.0001 to 1 s";
            episode_steps: (1..=10_000_000).contains(&self.episode_steps), "must be 1 to 10000000";
            afloat_above_m: height(self.afloat_above_m), "must be 0 to 10 m";
            feet_reach_m: height(self.feet_reach_m), "must be 0 to 10 m";
        }?;
        self.observation.validate()?;
        self.critic.validate()?;
        self.action.validate()?;
        self.phase.validate()?;
        self.command.validate()?;
        self.reward.validate()?;
        self.termination.validate()?;
        self.reset.validate()?;
        self.randomisation.validate()?;
        self.push.validate()?;
        self.noise.validate()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_defaults_are_valid_and_are_the_papers() {
        let config = TaskConfig::default();
        config.validate().unwrap();
        assert_eq!((config.control_period_s, config.episode_steps), (0.02, 1000));
        let reward = config.reward;
        assert_eq!(
            [reward.lin_vel_sigma, reward.yaw_rate_sigma, reward.phase_sigma],
            [0.25, 0.25, 0.01]
        );
        let weights = reward.weights;
        assert_eq!(
            [weights.tracking_lin_vel, weights.tracking_yaw_rate, weights.power, weights.phase],
            [1.0, 0.5, -1e-3, 1.0]
        );
    }

    #[test]
    fn toml_overrides_single_values_and_refuses_unknown_keys() {
        let config: TaskConfig = toml::from_str(
            "episode_steps = 500\n[reward.weights]\nslip = -1.0\n[command]\nvx_mps = [0.1, 0.35]\n",
        )
        .unwrap();
        assert_eq!(config.episode_steps, 500);
        assert_eq!(config.reward.weights.slip, -1.0);
        assert_eq!(config.reward.weights.phase, 1.0);
        assert_eq!(config.command.vx_mps, [0.1, 0.35]);
        for text in ["episode_step = 500", "[reward.weights]\nslipp = -1.0", "[push]\nforce = 3.0"]
        {
            assert!(toml::from_str::<TaskConfig>(text).is_err(), "{text}");
        }
    }

    #[test]
    fn survives_toml_unchanged() {
        let config =
            TaskConfig { reward: crate::reward::tests::matched(), ..TaskConfig::default() };
        let text = toml::to_string(&config).unwrap();
        assert_eq!(toml::from_str::<TaskConfig>(&text).unwrap(), config);
    }

    #[test]
    fn bad_values_are_found_in_every_table() {
        for (text, field) in [
            ("control_period_s = 0.0", "control_period_s"),
            ("episode_steps = 0", "episode_steps"),
            ("[action]\nscale = -1.0", "action.scale"),
            ("[phase]\nfrequency_hz = [2.0, 1.0]", "phase.frequency_hz"),
            ("[command]\nzero_share = 2.0", "command.zero_share"),
            ("[reward]\nphase_sigma = -0.1", "reward.phase_sigma"),
            ("[termination]\nmax_tilt_rad = 0.0", "termination.max_tilt_rad"),
            ("[reset]\nyaw_range_rad = 7.0", "reset.yaw_range_rad"),
            ("[randomisation]\nkp_scale = [0.0, 1.0]", "randomisation.kp_scale"),
            ("[push]\nforce_n = [-1.0, 1.0]", "push.force_n"),
            ("[noise]\ngravity_std = nan", "noise.gravity_std"),
        ] {
            let config: TaskConfig = toml::from_str(text).unwrap();
            let message = config.validate().unwrap_err().to_string();
            assert!(message.contains(field), "{message}");
        }
    }
}
