//! When an episode ends by failing. Reaching the time limit is not failing: that is truncation, and the
//! learner goes on from the value of the last observation.

use caudata_declare::settings;
use serde::{Deserialize, Serialize};

use crate::TaskError;
use crate::error::{checks, within};
use crate::expression::Names;
use crate::reward::TERMS;
use crate::reward::own::{self, OwnCondition, Programs};

settings! {
    /// Table `[task.termination]`: states that end an episode.
    #[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
    #[serde(deny_unknown_fields, default)]
    pub struct TerminationConfig {
        /// Largest angle between the body's z axis and the vertical, rad, above 0 to π. Default 1.0 (57°):
        /// steeper than the hardest terrain (25°) plus the trunk's roll in a step. Too small: episodes end on
        /// slopes.
        pub max_tilt_rad: f32 = 1.0,
        /// Allowed height of the whole-body centre of mass above the ground under the feet, m, [min, max].
        /// Default −0.1 to 1.0, which catches falling through the ground and flying off; lying on the belly
        /// (about 0.04) is allowed, because the robot can crawl and swim that way. Over water the second counts
        /// from the surface.
        pub com_height_m: [f32; 2] = [-0.1, 1.0],
        /// Further states that end an episode. Default none.
        pub when: Vec<OwnCondition>,
    }
}

impl TerminationConfig {
    /// Checks every value.
    ///
    /// # Errors
    /// [`TaskError::Config`] names the first field that is out of range.
    pub fn validate(&self) -> Result<(), TaskError> {
        let tilt = self.max_tilt_rad > 0.0 && self.max_tilt_rad <= std::f32::consts::PI;
        let height = within(self.com_height_m, -100.0, 100.0);
        checks! {
            self, "termination.";
            max_tilt_rad: tilt, "must be above 0 and at most π";
            com_height_m: height, "must be [min, max] within ±100 m";
        }?;
        own::check(WHEN_TABLE, TERMS.iter().map(|term| term.name), self.own())
    }

    fn own(&self) -> impl Iterator<Item = (&str, &str)> {
        self.when.iter().map(|when| (when.name.as_str(), when.value.as_str()))
    }

    /// The conditions of the task file, compiled for a robot.
    ///
    /// # Errors
    /// [`TaskError::Term`] names the first that is wrong.
    pub fn programs(&self, names: Names<'_>) -> Result<Programs, TaskError> {
        Programs::new(WHEN_TABLE, self.own(), names)
    }
}

const WHEN_TABLE: &str = "task.termination.when";

/// Why an episode ended by failing. The numbers go over the wire, where 0 stands for the time limit: never
/// renumber them.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[repr(u8)]
pub enum TerminationReason {
    /// The simulation broke down or gave a value that is not finite.
    Diverged = 1,
    /// The body's z axis points below the horizontal.
    UpsideDown = 2,
    /// The body leans more than `max_tilt_rad`.
    Tilted = 3,
    /// The centre of mass is too low.
    TooLow = 4,
    /// The centre of mass is too high.
    TooHigh = 5,
    /// A condition of the task file holds.
    Condition = 6,
}

impl TerminationReason {
    /// Every reason, in the order of their numbers.
    pub const ALL: [Self; 6] = [
        Self::Diverged,
        Self::UpsideDown,
        Self::Tilted,
        Self::TooLow,
        Self::TooHigh,
        Self::Condition,
    ];

    /// Name used in logs and counters.
    pub fn name(self) -> &'static str {
        match self {
            Self::Diverged => "diverged",
            Self::UpsideDown => "upside_down",
            Self::Tilted => "tilted",
            Self::TooLow => "too_low",
            Self::TooHigh => "too_high",
            Self::Condition => "condition",
        }
    }
}

/// What the check looks at.
#[derive(Clone, Copy, Debug)]
pub struct TerminationInput {
    /// The engine gave the lane up, or a value was not finite.
    pub diverged: bool,
    /// Direction of gravity, unit vector, body (upright: 0, 0, −1). True, without sensor noise.
    pub gravity: [f32; 3],
    /// Height of the whole-body centre of mass above the ground under the feet, m.
    pub com_height_m: f32,
    /// Its height above the water's surface, m; infinite where there is no water.
    pub com_above_water_m: f32,
}

/// The first reason to end the episode, if any. A value that is not a number counts as failed, never as
/// fine; the tilt test is signed, so that lying on the back is not mistaken for standing.
pub fn check(config: &TerminationConfig, input: &TerminationInput) -> Option<TerminationReason> {
    let upright = -input.gravity[2];
    let height = input.com_height_m;
    if input.diverged || upright.is_nan() || height.is_nan() {
        Some(TerminationReason::Diverged)
    } else if upright < config.max_tilt_rad.cos() {
        Some(if upright < 0.0 { TerminationReason::UpsideDown } else { TerminationReason::Tilted })
    } else if height < config.com_height_m[0] {
        Some(TerminationReason::TooLow)
    } else if height.min(input.com_above_water_m) > config.com_height_m[1] {
        Some(TerminationReason::TooHigh)
    } else {
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const STANDING: TerminationInput = TerminationInput {
        diverged: false,
        gravity: [0.0, 0.0, -1.0],
        com_height_m: 0.12,
        com_above_water_m: f32::INFINITY,
    };

    /// Gravity seen by a body rolled by `roll`: (0, −sin, −cos).
    fn rolled(roll: f32) -> TerminationInput {
        TerminationInput { gravity: [0.0, -roll.sin(), -roll.cos()], ..STANDING }
    }

    #[test]
    fn each_reason() {
        let config = TerminationConfig::default();
        let check = |input: TerminationInput| check(&config, &input);
        assert_eq!(check(STANDING), None);
        // 45° = 0.785 rad is below the limit of 1 rad, 60° = 1.047 rad is beyond.
        assert_eq!(check(rolled(0.785)), None);
        assert_eq!(check(rolled(1.047)), Some(TerminationReason::Tilted));
        assert_eq!(check(rolled(-1.047)), Some(TerminationReason::Tilted));
        // 170° and exactly upside down: |g_z| is as large as when standing, only the sign differs.
        assert_eq!(check(rolled(2.967)), Some(TerminationReason::UpsideDown));
        let on_its_back = TerminationInput { gravity: [0.0, 0.0, 1.0], ..STANDING };
        assert_eq!(check(on_its_back), Some(TerminationReason::UpsideDown));
        assert_eq!(
            check(TerminationInput { com_height_m: -0.2, ..STANDING }),
            Some(TerminationReason::TooLow)
        );
        assert_eq!(
            check(TerminationInput { com_height_m: 1.5, ..STANDING }),
            Some(TerminationReason::TooHigh)
        );
        // below the surface of deep water, and above it: the surface is nearer than the ground
        for com_above_water_m in [-0.1, 0.2] {
            let swimming = TerminationInput { com_height_m: 1.9, com_above_water_m, ..STANDING };
            assert_eq!(check(swimming), None);
        }
        let thrown = TerminationInput { com_height_m: 3.0, com_above_water_m: 1.1, ..STANDING };
        assert_eq!(check(thrown), Some(TerminationReason::TooHigh));
        assert_eq!(
            check(TerminationInput { diverged: true, ..STANDING }),
            Some(TerminationReason::Diverged)
        );
    }

    #[test]
    fn a_tilt_limit_beyond_ninety_degrees_works() {
        // With π nothing is too tilted, not even upside down.
        let config = TerminationConfig {
            max_tilt_rad: std::f32::consts::PI,
            ..TerminationConfig::default()
        };
        assert_eq!(check(&config, &rolled(3.1)), None);
    }

    #[test]
    fn not_a_number_is_a_failure() {
        let config = TerminationConfig::default();
        let tilt = TerminationInput { gravity: [0.0, 0.0, f32::NAN], ..STANDING };
        let height = TerminationInput { com_height_m: f32::NAN, ..STANDING };
        for input in [tilt, height] {
            assert_eq!(check(&config, &input), Some(TerminationReason::Diverged));
        }
    }

    #[test]
    fn reasons_have_fixed_numbers_and_distinct_names() {
        assert_eq!(TerminationReason::ALL.map(|reason| reason as u8), [1, 2, 3, 4, 5, 6]);
        let mut names = TerminationReason::ALL.map(TerminationReason::name).to_vec();
        names.sort_unstable();
        names.dedup();
        assert_eq!(names.len(), TerminationReason::ALL.len());
    }
}
