//! What an action means: joint offsets, clipped, low-pass filtered, scaled and kept within the joint limits.

use caudata_declare::settings;
use serde::{Deserialize, Serialize};

use crate::error::checks;
use crate::{ACTION_HISTORY, JointTable, PerJoint, TaskError};

/// How far a wheel's target runs on in a control period, of `scale`, for a unit of action: 4 rad/s at a scale of
/// 0.8 and 50 Hz.
const ROLL_SHARE: f32 = 0.1;

settings! {
    /// Table `[task.action]`: `q_des = q_nominal + scale · filter(clip(a))`.
    #[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
    #[serde(deny_unknown_fields, default)]
    pub struct ActionConfig {
        /// Radians of joint offset per unit of action, > 0. Default 0.5 (MuJoCo Playground; the paper gives
        /// none). Too small: the legs cannot reach. Too large: a network's small errors become large motions.
        pub scale: f32 = 0.5,
        /// First-order low pass at the control rate: y ← y + α(a − y), in (0, 1]; 1 is no filter. Default
        /// 0.5. At 50 Hz α = 0.15 passes up to about 1.3 Hz, 0.5 up to about 6 Hz. Too large: policies learn
        /// to vibrate; too small: they cannot react to a push. A wheel (limits more than 100 rad apart) has
        /// none: its target runs on by a tenth of `scale` per unit of action and control period.
        pub filter_alpha: f32 = 0.5,
        /// Actions beyond ± this are cut off before the filter, > 0. Default 5. Far outside what a policy
        /// should want; it keeps the observed past actions bounded when an exploration draw is extreme.
        pub clip: f32 = 5.0,
    }
}

impl ActionConfig {
    /// Checks every value.
    ///
    /// # Errors
    /// [`TaskError::Config`] names the first field that is out of range.
    pub fn validate(&self) -> Result<(), TaskError> {
        checks! {
            self, "action.";
            scale: self.scale > 0.0 && self.scale <= 10.0, "must be above 0 and at most 10 rad";
            filter_alpha: self.filter_alpha > 0.0 && self.filter_alpha <= 1.0, "must be above 0 and at most 1 (1 is no filter)";
            clip: self.clip > 0.0 && self.clip <= 1e3, "must be above 0 and at most 1000";
        }
    }

    /// Puts an action in front of the past ones, of as many joints, as the policy will see it: cut off at
    /// ± `clip`. Not a number becomes 0.
    pub fn remember(&self, action: &[f32], actions: &mut [PerJoint; ACTION_HISTORY]) {
        for past in (1..ACTION_HISTORY).rev() {
            let (newer, older) = actions.split_at_mut(past);
            older[0].set(&newer[past - 1]);
        }
        for (newest, a) in actions[0].iter_mut().zip(action) {
            *newest = if a.is_nan() { 0.0 } else { a.max(-self.clip).min(self.clip) };
        }
    }
}

/// Filter state of one environment (or of the robot): the smoothed action.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ActionFilter {
    smoothed: PerJoint,
}

impl ActionFilter {
    /// At rest in the nominal pose of a robot with that many actuated joints.
    pub fn new(joints: usize) -> Self {
        Self { smoothed: PerJoint::filled(joints, 0.0) }
    }

    /// Where the smoothed action would have the joints, rad, whatever their limits.
    pub fn unlimited_rad(&self, config: &ActionConfig, joints: &JointTable, out: &mut PerJoint) {
        out.refill(joints.len(), |i| self.target_rad(config, joints, i));
    }

    /// Takes one action, as it is [remembered](ActionConfig::remember), and writes the position targets, rad,
    /// within the joint limits. Both of the robot's length.
    pub fn apply(
        &mut self,
        config: &ActionConfig,
        action: &[f32],
        joints: &JointTable,
        targets_rad: &mut [f32],
    ) {
        for (i, (smoothed, action)) in self.smoothed.iter_mut().zip(action).enumerate() {
            *smoothed += match joints.rolls(i) {
                true => ROLL_SHARE * action,
                false => config.filter_alpha * (action - *smoothed),
            };
        }
        for (i, target) in targets_rad.iter_mut().enumerate() {
            let wanted = self.target_rad(config, joints, i);
            // Not `clamp`: that panics on reversed limits; here the upper limit would win.
            *target = wanted.max(joints.lower_rad[i]).min(joints.upper_rad[i]);
        }
    }

    #[inline]
    fn target_rad(&self, config: &ActionConfig, joints: &JointTable, joint: usize) -> f32 {
        joints.nominal_rad[joint] + config.scale * self.smoothed[joint]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const ACT_DIM: usize = 16;

    fn applied(filter: &mut ActionFilter, config: &ActionConfig, action: f32) -> [f32; ACT_DIM] {
        let mut actions = [PerJoint::filled(ACT_DIM, 0.0); ACTION_HISTORY];
        config.remember(&[action; ACT_DIM], &mut actions);
        let mut targets = [0.0; ACT_DIM];
        filter.apply(config, &actions[0], &joints(), &mut targets);
        targets
    }

    fn joints() -> JointTable {
        JointTable {
            nominal_rad: [0.1; ACT_DIM].into(),
            lower_rad: [-0.5; ACT_DIM].into(),
            upper_rad: [0.4; ACT_DIM].into(),
        }
    }

    #[test]
    fn low_pass_scale_and_offset() {
        let config = ActionConfig { scale: 0.5, filter_alpha: 0.25, clip: 5.0 };
        let mut filter = ActionFilter::new(ACT_DIM);
        // y1 = 0 + 0.25·(0.8 − 0) = 0.2;      target 0.1 + 0.5·0.2 = 0.2
        // y2 = 0.2 + 0.25·(0.8 − 0.2) = 0.35; target 0.1 + 0.5·0.35 = 0.275
        // y3 = 0.35 + 0.25·(−0.8 − 0.35) = 0.0625; target 0.13125
        for (action, expected) in [(0.8, 0.2), (0.8, 0.275), (-0.8, 0.13125)] {
            let targets = applied(&mut filter, &config, action);
            for target in targets {
                assert!((target - expected).abs() < 1e-6, "{target} for {expected}");
            }
        }
        assert!((filter.smoothed[3] - 0.0625).abs() < 1e-6);
    }

    /// 0.8·0.1·0.5 = 0.04 rad a period, past where a leg's filter would have stopped it.
    #[test]
    fn the_action_of_a_wheel_is_its_speed() {
        let config = ActionConfig { scale: 0.8, filter_alpha: 0.25, clip: 5.0 };
        let mut table = joints();
        (table.lower_rad[1], table.upper_rad[1]) = (-1e5, 1e5);
        let mut filter = ActionFilter::new(ACT_DIM);
        let mut targets = [0.0; ACT_DIM];
        for _ in 0..100 {
            filter.apply(&config, &[0.5; ACT_DIM], &table, &mut targets);
        }
        assert!((targets[1] - 4.1).abs() < 1e-3 && targets[0] == 0.4, "{targets:?}");
    }

    #[test]
    fn actions_are_clipped_and_targets_stay_within_limits() {
        let config = ActionConfig { scale: 1.0, filter_alpha: 1.0, clip: 2.0 };
        let mut filter = ActionFilter::new(ACT_DIM);
        // 100 is cut to 2: y = 2, target 2.1, upper limit 0.4.
        assert_eq!(applied(&mut filter, &config, 100.0), [0.4; ACT_DIM]);
        assert_eq!(filter.smoothed, [2.0; ACT_DIM]);
        assert_eq!(applied(&mut filter, &config, f32::NEG_INFINITY), [-0.5; ACT_DIM]);
        // Not a number counts as no offset.
        assert_eq!(applied(&mut filter, &config, f32::NAN), [0.1; ACT_DIM]);
    }

    #[test]
    fn past_actions_are_the_clipped_ones_newest_first() {
        let mut actions = [PerJoint::filled(2, 0.0); ACTION_HISTORY];
        for action in [[1.0, -7.0], [2.0, f32::NAN], [3.0, 0.5]] {
            ActionConfig::default().remember(&action, &mut actions);
        }
        assert_eq!(actions, [[3.0, 0.5], [2.0, 0.0], [1.0, -5.0]]);
    }

    #[test]
    fn values_out_of_range_are_named() {
        let good = ActionConfig::default();
        good.validate().unwrap();
        let bad = [
            (ActionConfig { scale: 0.0, ..good }, "action.scale"),
            (ActionConfig { filter_alpha: 1.1, ..good }, "action.filter_alpha"),
            (ActionConfig { filter_alpha: f32::NAN, ..good }, "action.filter_alpha"),
            (ActionConfig { clip: -1.0, ..good }, "action.clip"),
        ];
        for (config, name) in bad {
            let error = config.validate().unwrap_err();
            assert!(matches!(&error, TaskError::Config { field, .. } if *field == name), "{error}");
        }
    }
}
