//! Commanded velocities: how they are drawn and how long each holds.

use std::f32::consts::PI;

use caudata_declare::settings;
use caudata_random::Stream;
use serde::{Deserialize, Serialize};

use crate::error::{checks, within};
use crate::phase::wrap_angle;
use crate::{COMMAND_DIM, TaskError};

/// Yaw rate that is asked for per radian off the course, 1/s: slow against a stride, in which the trunk
/// sways.
pub const COURSE_GAIN_PER_S: f32 = 1.0;

settings! {
    /// Table `[task.command]`: what the robot is asked to do, in the heading frame.
    #[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
    #[serde(deny_unknown_fields, default)]
    pub struct CommandConfig {
        /// Forward velocity, m/s, uniform in [min, max]. Default −0.2 to 0.5: the robot walks at about 0.3,
        /// and a range that it cannot reach teaches it to ignore commands.
        pub vx_mps: [f32; 2] = [-0.2, 0.5],
        /// Velocity to the left, m/s. Default ±0.1.
        pub vy_mps: [f32; 2] = [-0.1, 0.1],
        /// Yaw rate to the left, rad/s. Default ±0.5.
        pub yaw_rate_radps: [f32; 2] = [-0.5, 0.5],
        /// How long a command holds, s, uniform in [min, max]. Default 4 to 8. Too short: nothing but
        /// transitions; too long: few transitions, and a policy that stumbles over them.
        pub resample_s: [f32; 2] = [4.0, 8.0],
        /// Probability that a command is zero (stand), 0 to 1. Default 0.1 (MuJoCo Playground).
        pub zero_share: f32 = 0.1,
        /// Probability that a command other than zero holds a course, as a person with a joystick would, 0 to
        /// 1: a heading is drawn, the yaw rate is 1 s⁻¹ times the missing angle within `yaw_rate_radps`
        /// (which must hold 0 then), and `tracking_lin_vel` looks at the velocity along that course and
        /// across it, whatever the robot's heading. Default 0. Without it a robot that a beach has turned
        /// aside follows its command perfectly, in its own frame; too large: free turns are trained too
        /// little.
        pub course_share: f32 = 0.0,
        /// Courses are drawn within ± this of the present heading, rad, 0 to π. Default π/3.
        pub course_within_rad: f32 = std::f32::consts::FRAC_PI_3,
    }
}

impl CommandConfig {
    /// Checks every value.
    ///
    /// # Errors
    /// [`TaskError::Config`] names the first field that is out of range.
    pub fn validate(&self) -> Result<(), TaskError> {
        let [least, most] = self.yaw_rate_radps;
        let unit = |share: f32| (0.0..=1.0).contains(&share);
        let speed = "must be [min, max] within ±5 m/s";
        checks! {
            self, "command.";
            vx_mps: within(self.vx_mps, -5.0, 5.0), speed;
            vy_mps: within(self.vy_mps, -5.0, 5.0), speed;
            yaw_rate_radps: within(self.yaw_rate_radps, -20.0, 20.0), "must be [min, max] within ±20 rad/s";
            resample_s: within(self.resample_s, 1e-3, 1e6), "must be [min, max] within 0.001 to 1000000 s";
            zero_share: unit(self.zero_share), "must be 0 to 1";
            course_share: unit(self.course_share), "must be 0 to 1";
            course_within_rad: (0.0..=PI).contains(&self.course_within_rad), "must be 0 to π";
            course_share: self.course_share == 0.0 || (least <= 0.0 && most >= 0.0), "needs a yaw_rate_radps that holds 0: a course is held with none";
        }
    }
}

/// The command of one environment, and for how many more control steps it holds.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct CommandState {
    /// vx, vy (m/s), yaw rate (rad/s), heading frame.
    pub value: [f32; COMMAND_DIM],
    /// Control steps until the next draw.
    pub steps_left: u32,
    /// The heading that is to be held, world, rad, if there is one.
    pub course_rad: Option<f32>,
}

/// A velocity in the heading frame as it is along the course and to the left of it, `off_course_rad` being
/// how far the heading is to the left of the course.
pub fn along_course([x, y, _]: [f32; 3], off_course_rad: f32) -> [f32; 2] {
    let (sin, cos) = off_course_rad.sin_cos();
    [cos * x - sin * y, sin * x + cos * y]
}

/// Yaw rate that a person with a joystick would ask for to come from `heading_rad` to `course_rad`, within
/// `range_radps`.
pub fn yaw_rate_towards(course_rad: f32, heading_rad: f32, [least, most]: [f32; 2]) -> f32 {
    (COURSE_GAIN_PER_S * wrap_angle(course_rad - heading_rad)).max(least).min(most)
}

impl CommandState {
    /// Draws a command and how long it holds (at least one control step), for a robot that heads
    /// `heading_rad`.
    pub fn draw(
        config: &CommandConfig,
        control_period_s: f32,
        heading_rad: f32,
        stream: &mut Stream,
    ) -> Self {
        let [vx, vy, yaw] = [config.vx_mps, config.vy_mps, config.yaw_rate_radps];
        // Always the same number of draws, so that `zero_share` does not shift later commands. (A
        // `course_share` above 0 does: at 0 tasks without courses keep their bits.)
        let drawn = [vx, vy, yaw].map(|[lo, hi]| stream.uniform(lo, hi));
        let zero = stream.chance(config.zero_share);
        let hold_s = stream.uniform(config.resample_s[0], config.resample_s[1]);
        let mut course_rad = None;
        if config.course_share > 0.0 {
            let within = config.course_within_rad;
            let held = stream.chance(config.course_share);
            let turn_rad = stream.uniform(-within, within);
            course_rad = (held && !zero).then(|| wrap_angle(heading_rad + turn_rad));
        }
        let mut command = Self {
            value: if zero { [0.0; COMMAND_DIM] } else { drawn },
            steps_left: ((hold_s / control_period_s).round() as u32).max(1),
            course_rad,
        };
        command.steer(config, heading_rad);
        command
    }

    /// Sets the yaw rate of a command that holds a course.
    fn steer(&mut self, config: &CommandConfig, heading_rad: f32) {
        if let Some(course_rad) = self.course_rad {
            self.value[2] = yaw_rate_towards(course_rad, heading_rad, config.yaw_rate_radps);
        }
    }

    /// How far `heading_rad` is to the left of the course, rad; 0 where none is held.
    pub fn off_course_rad(&self, heading_rad: f32) -> f32 {
        self.course_rad.map_or(0.0, |course_rad| wrap_angle(heading_rad - course_rad))
    }

    /// One control step has passed; draws the next command when this one has run out. True on a change.
    pub fn tick(
        &mut self,
        config: &CommandConfig,
        control_period_s: f32,
        heading_rad: f32,
        stream: &mut Stream,
    ) -> bool {
        self.steps_left = self.steps_left.saturating_sub(1);
        if self.steps_left > 0 {
            self.steer(config, heading_rad);
            return self.course_rad.is_some();
        }
        *self = Self::draw(config, control_period_s, heading_rad, stream);
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
            let [vx, vy, yaw] = CommandState::draw(&config, 0.02, 0.0, &mut stream).value;
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
        let config =
            CommandConfig { resample_s: [0.1, 0.1], zero_share: 0.0, ..CommandConfig::default() };
        let mut stream = stream();
        let mut command = CommandState::draw(&config, 0.02, 0.0, &mut stream);
        let first = command.value;
        let changes: Vec<_> =
            (1..=10).filter(|_| command.tick(&config, 0.02, 0.0, &mut stream)).collect();
        assert_eq!(changes, [5, 10]);
        assert_ne!(command.value, first);
    }

    #[test]
    fn the_zero_share_does_not_shift_later_commands() {
        let mut all = CommandConfig { zero_share: 0.0, ..CommandConfig::default() };
        let (mut a, mut b) = (stream(), stream());
        let walking: Vec<_> =
            (0..50).map(|_| CommandState::draw(&all, 0.02, 0.0, &mut a)).collect();
        all.zero_share = 0.5;
        for expected in walking {
            let found = CommandState::draw(&all, 0.02, 0.0, &mut b);
            assert!(found.value == expected.value || found.value == [0.0; 3]);
            assert_eq!(found.steps_left, expected.steps_left);
        }
    }

    #[test]
    fn a_course_is_held_with_the_yaw_rate_of_the_missing_angle() {
        let config = CommandConfig {
            yaw_rate_radps: [-0.6, 0.4],
            zero_share: 0.0,
            course_share: 1.0,
            course_within_rad: 0.5,
            ..CommandConfig::default()
        };
        let mut stream = stream();
        for _ in 0..200 {
            // Headings beyond π are those from −π on.
            let mut command = CommandState::draw(&config, 0.02, 3.0, &mut stream);
            let course_rad = command.course_rad.unwrap();
            assert!(wrap_angle(course_rad - 3.0).abs() <= 0.5);
            assert!(course_rad.abs() <= std::f32::consts::PI + 1e-6);
            // 0.1 to the right of the course: 0.1 rad/s to the left, and −0.1 rad off it.
            let heading_rad = course_rad - 0.1;
            assert!(command.tick(&config, 0.02, heading_rad, &mut stream));
            assert!((command.value[2] - 0.1).abs() < 1e-5);
            assert!((command.off_course_rad(heading_rad) + 0.1).abs() < 1e-5);
        }
        // Two radians off: as fast as commands may be, either way.
        assert_eq!(yaw_rate_towards(2.0, 0.0, config.yaw_rate_radps), 0.4);
        assert_eq!(yaw_rate_towards(-2.0, 0.0, config.yaw_rate_radps), -0.6);
        // A command to stand holds nothing.
        let standing = CommandConfig { zero_share: 1.0, ..config };
        let command = CommandState::draw(&standing, 0.02, 3.0, &mut stream);
        assert_eq!((command.value, command.course_rad), ([0.0; 3], None));
        assert_eq!(command.off_course_rad(1.0), 0.0);
    }

    #[test]
    fn values_out_of_range_are_named() {
        let good = CommandConfig::default();
        good.validate().unwrap();
        let bad = [
            (CommandConfig { vx_mps: [0.5, 0.1], ..good }, "command.vx_mps"),
            (CommandConfig { vy_mps: [0.0, f32::INFINITY], ..good }, "command.vy_mps"),
            (CommandConfig { yaw_rate_radps: [f32::NAN, 0.0], ..good }, "command.yaw_rate_radps"),
            (CommandConfig { resample_s: [0.0, 1.0], ..good }, "command.resample_s"),
            (CommandConfig { zero_share: 1.5, ..good }, "command.zero_share"),
            (CommandConfig { course_share: f32::NAN, ..good }, "command.course_share"),
            (
                CommandConfig { course_share: 0.5, yaw_rate_radps: [0.2, 0.5], ..good },
                "command.course_share",
            ),
            (CommandConfig { course_within_rad: 3.2, ..good }, "command.course_within_rad"),
        ];
        for (config, name) in bad {
            let error = config.validate().unwrap_err();
            assert!(matches!(&error, TaskError::Config { field, .. } if *field == name), "{error}");
        }
    }
}
