//! Commanded velocities: how they are drawn and how long each holds.

use caudata_random::Stream;
use serde::{Deserialize, Serialize};

use crate::error::{require, require_range};
use crate::{COMMAND_DIM, TaskError};

/// Table `[task.command]`: what the robot is asked to do, in the heading frame.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct CommandConfig {
    /// Forward velocity, m/s, uniform in [min, max]. Default −0.2 to 0.5: the robot walks at about 0.3,
    /// and a range that it cannot reach teaches it to ignore commands.
    pub vx_mps: [f32; 2],
    /// Velocity to the left, m/s. Default ±0.1.
    pub vy_mps: [f32; 2],
    /// Yaw rate to the left, rad/s. Default ±0.5.
    pub yaw_rate_radps: [f32; 2],
    /// How long a command holds, s, uniform in [min, max]. Default 4 to 8. Too short: nothing but
    /// transitions; too long: few transitions, and a policy that stumbles over them.
    pub resample_s: [f32; 2],
    /// Probability that a command is zero (stand), 0 to 1. Default 0.1 (MuJoCo Playground).
    pub zero_share: f32,
}

impl Default for CommandConfig {
    fn default() -> Self {
        Self {
            vx_mps: [-0.2, 0.5],
            vy_mps: [-0.1, 0.1],
            yaw_rate_radps: [-0.5, 0.5],
            resample_s: [4.0, 8.0],
            zero_share: 0.1,
        }
    }
}

impl CommandConfig {
    /// Checks every value.
    ///
    /// # Errors
    /// [`TaskError::Config`] names the first field that is out of range.
    pub fn validate(&self) -> Result<(), TaskError> {
        let speed = "must be [min, max] within ±5 m/s";
        require_range(self.vx_mps, -5.0, 5.0, "command.vx_mps", speed)?;
        require_range(self.vy_mps, -5.0, 5.0, "command.vy_mps", speed)?;
        require_range(
            self.yaw_rate_radps,
            -20.0,
            20.0,
            "command.yaw_rate_radps",
            "must be [min, max] within ±20 rad/s",
        )?;
        require_range(
            self.resample_s,
            1e-3,
            1e6,
            "command.resample_s",
            "must be [min, max] within 0.001 to 1000000 s",
        )?;
        require(
            (0.0..=1.0).contains(&self.zero_share),
            "command.zero_share",
            self.zero_share,
            "must be 0 to 1",
        )
    }
}

/// The command of one environment, and for how many more control steps it holds.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct CommandState {
    /// vx, vy (m/s), yaw rate (rad/s), heading frame.
    pub value: [f32; COMMAND_DIM],
    /// Control steps until the next draw.
    pub steps_left: u32,
}

impl CommandState {
    /// Draws a command and how long it holds (at least one control step).
    pub fn draw(config: &CommandConfig, control_period_s: f32, stream: &mut Stream) -> Self {
        let [vx, vy, yaw] = [config.vx_mps, config.vy_mps, config.yaw_rate_radps];
        // Always the same number of draws, so that `zero_share` does not shift later commands.
        let drawn = [vx, vy, yaw].map(|[lo, hi]| stream.uniform(lo, hi));
        let zero = stream.chance(config.zero_share);
        let hold_s = stream.uniform(config.resample_s[0], config.resample_s[1]);
        Self {
            value: if zero { [0.0; COMMAND_DIM] } else { drawn },
            steps_left: ((hold_s / control_period_s).round() as u32).max(1),
        }
    }

    /// One control step has passed; draws the next command when this one has run out. True on a change.
    pub fn tick(
        &mut self,
        config: &CommandConfig,
        control_period_s: f32,
        stream: &mut Stream,
    ) -> bool {
        self.steps_left = self.steps_left.saturating_sub(1);
        if self.steps_left > 0 {
            return false;
        }
        *self = Self::draw(config, control_period_s, stream);
        true
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use caudata_random::{Key, Purpose};

    fn stream() -> Stream {
        Stream::new(Key::for_run(3), Purpose::Command)
    }

    #[test]
    fn draws_fill_the_ranges_and_the_zero_share() {
        let config = CommandConfig::default();
        let mut stream = stream();
        let n = 10_000;
        let (mut zeros, mut sum) = (0, 0.0);
        for _ in 0..n {
            let [vx, vy, yaw] = CommandState::draw(&config, 0.02, &mut stream).value;
            assert!((-0.2..=0.5).contains(&vx));
            assert!((-0.1..=0.1).contains(&vy));
            assert!((-0.5..=0.5).contains(&yaw));
            zeros += i32::from([vx, vy, yaw] == [0.0; 3]);
            sum += vx;
        }
        // Zero share 0.1 of 10,000: 1,000, standard deviation 30.
        assert!((zeros - 1000).abs() < 135, "{zeros}");
        // Mean of vx: 0.9·0.15 = 0.135; standard error about 0.2/100.
        assert!((sum / n as f32 - 0.135).abs() < 0.01);
    }

    #[test]
    fn holds_for_the_drawn_time_then_changes() {
        // 0.1 s at 50 Hz are 5 steps: changes at the 5th, 10th … tick.
        let config = CommandConfig {
            resample_s: [0.1, 0.1],
            zero_share: 0.0,
            ..CommandConfig::default()
        };
        let mut stream = stream();
        let mut command = CommandState::draw(&config, 0.02, &mut stream);
        let first = command.value;
        let changes: Vec<_> = (1..=10)
            .filter(|_| command.tick(&config, 0.02, &mut stream))
            .collect();
        assert_eq!(changes, [5, 10]);
        assert_ne!(command.value, first);
    }

    #[test]
    fn the_zero_share_does_not_shift_later_commands() {
        let mut all = CommandConfig {
            zero_share: 0.0,
            ..CommandConfig::default()
        };
        let (mut a, mut b) = (stream(), stream());
        let walking: Vec<_> = (0..50)
            .map(|_| CommandState::draw(&all, 0.02, &mut a))
            .collect();
        all.zero_share = 0.5;
        for expected in walking {
            let found = CommandState::draw(&all, 0.02, &mut b);
            assert!(found.value == expected.value || found.value == [0.0; 3]);
            assert_eq!(found.steps_left, expected.steps_left);
        }
    }

    #[test]
    fn values_out_of_range_are_named() {
        let good = CommandConfig::default();
        good.validate().unwrap();
        let bad = [
            (
                CommandConfig {
                    vx_mps: [0.5, 0.1],
                    ..good
                },
                "command.vx_mps",
            ),
            (
                CommandConfig {
                    vy_mps: [0.0, f32::INFINITY],
                    ..good
                },
                "command.vy_mps",
            ),
            (
                CommandConfig {
                    yaw_rate_radps: [f32::NAN, 0.0],
                    ..good
                },
                "command.yaw_rate_radps",
            ),
            (
                CommandConfig {
                    resample_s: [0.0, 1.0],
                    ..good
                },
                "command.resample_s",
            ),
            (
                CommandConfig {
                    zero_share: 1.5,
                    ..good
                },
                "command.zero_share",
            ),
        ];
        for (config, name) in bad {
            let error = config.validate().unwrap_err();
            assert!(
                matches!(&error, TaskError::Config { field, .. } if *field == name),
                "{error}"
            );
        }
    }
}
