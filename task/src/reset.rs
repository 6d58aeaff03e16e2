//! Where an episode starts: the nominal or the swimming pose with some noise.

use std::f32::consts::PI;

use caudata_declare::settings;
use caudata_random::Stream;
use serde::{Deserialize, Serialize};

use crate::error::checks;
use crate::{JointTable, PerJoint, TaskError};

settings! {
    /// Table `[task.reset]`: how far episodes start from the nominal pose at rest.
    #[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
    #[serde(deny_unknown_fields, default)]
    pub struct ResetConfig {
        /// Joint positions start within ± this of the pose (kept within the limits), rad. Default 0.1.
        /// Too large: episodes start with a fall.
        pub joint_pos_noise_rad: f32 = 0.1,
        /// Joint velocities start within ± this, rad/s. Default 0.
        pub joint_vel_noise_radps: f32 = 0.0,
        /// The base starts with a horizontal velocity within ± this along x and y, m/s. Default 0.1.
        pub base_vel_noise_mps: f32 = 0.1,
        /// Heading within ± this, rad. Default π: any direction, which matters on uneven ground.
        pub yaw_range_rad: f32 = PI,
        /// The base starts within ± this along x and y, m. Default 0; on uneven ground choose it so that
        /// different episodes meet different ground.
        pub spawn_half_extent_m: f32 = 0.0,
        /// Share of the episodes that start in the robot file's swimming pose, on land too, 0 to 1. Default 0. A
        /// policy that swims must learn to unfold its legs where the ground comes up, and meets that too rarely
        /// when every episode begins on its feet; too large: little else is trained.
        pub swimming_pose_share: f32 = 0.0,
        /// Share of the episodes that start in any attitude, with every joint anywhere between its limits, 0 to 1.
        /// Default 0. For robots that are to get up again; `task.termination.max_tilt_rad` must then be large.
        pub fallen_share: f32 = 0.0,
    }
}

impl ResetConfig {
    /// Checks every value.
    ///
    /// # Errors
    /// [`TaskError::Config`] names the first field that is out of range.
    pub fn validate(&self) -> Result<(), TaskError> {
        let up_to = |value: f32, most: f32| (0.0..=most).contains(&value);
        checks! {
            self, "reset.";
            joint_pos_noise_rad: up_to(self.joint_pos_noise_rad, PI), "must be 0 to π";
            joint_vel_noise_radps: up_to(self.joint_vel_noise_radps, 50.0), "must be 0 to 50";
            base_vel_noise_mps: up_to(self.base_vel_noise_mps, 10.0), "must be 0 to 10";
            yaw_range_rad: up_to(self.yaw_range_rad, PI), "must be 0 to π";
            spawn_half_extent_m: up_to(self.spawn_half_extent_m, 1e3), "must be 0 to 1000";
            swimming_pose_share: up_to(self.swimming_pose_share, 1.0), "must be 0 to 1";
            fallen_share: up_to(self.fallen_share, 1.0), "must be 0 to 1";
        }
    }
}

/// One drawn start.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ResetDraw {
    /// Base position, m, world x and y.
    pub base_xy_m: [f32; 2],
    /// Roll and pitch, rad.
    pub roll_pitch_rad: [f32; 2],
    /// Heading, rad.
    pub yaw_rad: f32,
    /// Velocity of the base, m/s, world x and y.
    pub base_vel_mps: [f32; 2],
    /// Joint positions, rad, within the limits.
    pub joint_pos_rad: PerJoint,
    /// Joint velocities, rad/s.
    pub joint_vel_radps: PerJoint,
}

/// Draws a start. `swimming_rad` is the pose of [`ResetConfig::swimming_pose_share`].
pub fn draw(
    config: &ResetConfig,
    joints: &JointTable,
    swimming_rad: &PerJoint,
    stream: &mut Stream,
) -> ResetDraw {
    let folded = config.swimming_pose_share > 0.0 && stream.chance(config.swimming_pose_share);
    let pose_rad = if folded { swimming_rad } else { &joints.nominal_rad };
    let fallen = config.fallen_share > 0.0 && stream.chance(config.fallen_share);
    let mut around_zero = |half: f32| stream.uniform(-half, half);
    let mut start = ResetDraw {
        base_xy_m: std::array::from_fn(|_| around_zero(config.spawn_half_extent_m)),
        roll_pitch_rad: [0.0; 2],
        yaw_rad: around_zero(config.yaw_range_rad),
        base_vel_mps: std::array::from_fn(|_| around_zero(config.base_vel_noise_mps)),
        joint_pos_rad: PerJoint::from_fn(joints.len(), |i| {
            (pose_rad[i] + around_zero(config.joint_pos_noise_rad))
                .max(joints.lower_rad[i])
                .min(joints.upper_rad[i])
        }),
        joint_vel_radps: PerJoint::from_fn(joints.len(), |_| {
            around_zero(config.joint_vel_noise_radps)
        }),
    };
    if fallen {
        // as often on its back as on its feet; pitch by its sine, as a ball thrown up would lie
        start.roll_pitch_rad = [around_zero(PI), around_zero(1.0).asin()];
        for (i, q) in start.joint_pos_rad.iter_mut().enumerate().filter(|(i, _)| !joints.rolls(*i))
        {
            *q = stream.uniform(joints.lower_rad[i], joints.upper_rad[i]);
        }
    }
    start
}

#[cfg(test)]
mod tests {
    use super::*;
    use caudata_random::{Key, Purpose};

    const ACT_DIM: usize = 16;

    fn joints() -> JointTable {
        JointTable {
            nominal_rad: [0.5; ACT_DIM].into(),
            lower_rad: [-1.0; ACT_DIM].into(),
            upper_rad: [0.55; ACT_DIM].into(),
        }
    }

    fn swimming_rad() -> PerJoint {
        PerJoint::filled(ACT_DIM, -0.5)
    }

    #[test]
    fn the_asked_share_starts_in_the_swimming_pose() {
        let config = ResetConfig {
            joint_pos_noise_rad: 0.1,
            swimming_pose_share: 0.25,
            ..ResetConfig::default()
        };
        let mut stream = Stream::new(Key::for_run(4), Purpose::Reset);
        let folded = (0..1000).filter(|_| {
            let start = draw(&config, &joints(), &swimming_rad(), &mut stream);
            let near = |pose: f32| start.joint_pos_rad.iter().all(|q| (q - pose).abs() <= 0.1);
            assert!(near(0.5) || near(-0.5));
            near(-0.5)
        });
        // 250 of 1,000, standard deviation 14.
        let folded = folded.count() as i32;
        assert!((folded - 250).abs() < 70, "{folded}");
    }

    #[test]
    fn the_asked_share_starts_in_any_attitude() {
        let config = ResetConfig { fallen_share: 0.5, ..ResetConfig::default() };
        let mut stream = Stream::new(Key::for_run(5), Purpose::Reset);
        let starts: Vec<_> =
            (0..1000).map(|_| draw(&config, &joints(), &swimming_rad(), &mut stream)).collect();
        let fallen: Vec<_> = starts.iter().filter(|s| s.roll_pitch_rad != [0.0; 2]).collect();
        // 500 of 1,000, standard deviation 16
        assert!(fallen.len().abs_diff(500) < 80, "{}", fallen.len());
        // the body's z axis points up in the world by cos(roll)·cos(pitch)
        let up = |s: &&ResetDraw| s.roll_pitch_rad.map(f32::cos).iter().product::<f32>();
        let on_the_back = fallen.iter().filter(|s| up(s) < 0.0).count();
        assert!(on_the_back.abs_diff(fallen.len() / 2) < 60, "{on_the_back}");
        let inside = |q: &f32| (-1.0..=0.55).contains(q);
        assert!(starts.iter().all(|s| s.joint_pos_rad.iter().all(inside)));
        assert!(fallen.iter().any(|s| s.joint_pos_rad[0] < -0.5));
    }

    #[test]
    fn draws_stay_within_noise_and_limits() {
        let config = ResetConfig {
            joint_vel_noise_radps: 2.0,
            spawn_half_extent_m: 3.0,
            ..ResetConfig::default()
        };
        let mut stream = Stream::new(Key::for_run(1), Purpose::Reset);
        let mut at_limit = 0;
        for _ in 0..100 {
            let start = draw(&config, &joints(), &swimming_rad(), &mut stream);
            for q in start.joint_pos_rad {
                // 0.5 ± 0.1, cut at the limit 0.55.
                assert!((0.4..=0.55).contains(&q));
                at_limit += i32::from(q == 0.55);
            }
            assert!(start.joint_vel_radps.iter().all(|v| v.abs() <= 2.0));
            assert!(start.base_xy_m.iter().all(|x| x.abs() <= 3.0));
            assert!(start.base_vel_mps.iter().all(|v| v.abs() <= 0.1));
            assert!(start.yaw_rad.abs() <= PI);
        }
        // A quarter of 1,600 lies beyond the limit, standard deviation 17.
        assert!((at_limit - 400).abs() < 78, "{at_limit}");
    }

    #[test]
    fn no_noise_is_exactly_the_nominal_pose_at_the_origin() {
        let config = ResetConfig {
            joint_pos_noise_rad: 0.0,
            joint_vel_noise_radps: 0.0,
            base_vel_noise_mps: 0.0,
            yaw_range_rad: 0.0,
            spawn_half_extent_m: 0.0,
            swimming_pose_share: 0.0,
            fallen_share: 0.0,
        };
        let start = draw(
            &config,
            &joints(),
            &swimming_rad(),
            &mut Stream::new(Key::for_run(1), Purpose::Reset),
        );
        assert_eq!(start.joint_pos_rad, joints().nominal_rad);
        assert_eq!(start.joint_vel_radps, [0.0; ACT_DIM]);
        assert_eq!((start.base_xy_m, start.base_vel_mps, start.yaw_rad), ([0.0; 2], [0.0; 2], 0.0));
    }
}
