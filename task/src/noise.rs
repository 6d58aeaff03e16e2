//! Noise on what the policy sees, per part of the observation.

use caudata_declare::settings;
use caudata_random::Stream;
use serde::{Deserialize, Serialize};

use crate::error::checks;
use crate::{PerJoint, TaskError};

settings! {
    /// Table `[task.noise]`: noise on the observation, bell-shaped with the given standard deviations (and
    /// never beyond 3.45 of them).
    ///
    /// It comes on top of the sensors' own quantisation and noise from the robot file (`sensor_models`), and
    /// stands for what those leave out: filtering, mounting, vibration, the attitude estimator. Too small:
    /// the policy trusts single readings; too large: it stops using them.
    #[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
    #[serde(deny_unknown_fields, default)]
    pub struct ObservationNoiseConfig {
        /// Whether observations carry any noise, that of the sensor models included. Default true.
        pub enabled: bool = true,
        /// Whether encoders and IMU are modelled as the robot file describes them (steps, noise, bias).
        /// Default true.
        pub sensor_models: bool = true,
        /// On joint velocities, rad/s. Default 0.1 (four steps of the servo's velocity reading).
        pub joint_vel_std_radps: f32 = 0.1,
        /// On joint positions, rad. Default 0.005.
        pub joint_pos_std_rad: f32 = 0.005,
        /// Constant offset of each joint's position per episode, rad. Default 0.01: horns sit on a spline and
        /// are zeroed by eye.
        pub joint_offset_std_rad: f32 = 0.01,
        /// On the angular velocity, rad/s. Default 0.05.
        pub gyro_std_radps: f32 = 0.05,
        /// On each component of the gravity direction, which is normalised again. Default 0.02 (about 1°).
        pub gravity_std: f32 = 0.02,
    }
}

impl ObservationNoiseConfig {
    /// Checks every value.
    ///
    /// # Errors
    /// [`TaskError::Config`] names the first field that is out of range.
    pub fn validate(&self) -> Result<(), TaskError> {
        let right = |std: f32| (0.0..=10.0).contains(&std);
        checks! {
            self, "noise.";
            joint_vel_std_radps: right(self.joint_vel_std_radps), "must be 0 to 10";
            joint_pos_std_rad: right(self.joint_pos_std_rad), "must be 0 to 10";
            joint_offset_std_rad: right(self.joint_offset_std_rad), "must be 0 to 10";
            gyro_std_radps: right(self.gyro_std_radps), "must be 0 to 10";
            gravity_std: right(self.gravity_std), "must be 0 to 10";
        }
    }

    /// Draws the constant offsets of the positions of `joints` joints for one episode, rad.
    pub fn draw_joint_offsets(&self, joints: usize, stream: &mut Stream) -> PerJoint {
        let mut offsets = PerJoint::filled(joints, 0.0);
        if self.enabled {
            add_noise(&mut offsets, self.joint_offset_std_rad, stream);
        }
        offsets
    }

    /// Adds noise to one set of readings, in place. A standard deviation of 0 takes nothing from the stream.
    pub fn add(&self, readings: &mut Readings, stream: &mut Stream) {
        if !self.enabled {
            return;
        }
        add_noise(&mut readings.joint_vel_radps, self.joint_vel_std_radps, stream);
        add_noise(&mut readings.joint_pos_rad, self.joint_pos_std_rad, stream);
        add_noise(&mut readings.gyro_radps, self.gyro_std_radps, stream);
        if self.gravity_std > 0.0 {
            add_noise(&mut readings.gravity, self.gravity_std, stream);
            let norm = readings.gravity.iter().map(|g| g * g).sum::<f32>().sqrt();
            if norm > 1e-6 {
                readings.gravity = readings.gravity.map(|g| g / norm);
            }
        }
    }
}

/// One set of sensor readings.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Readings {
    /// Joint velocities, rad/s, policy order.
    pub joint_vel_radps: PerJoint,
    /// Joint positions, rad, policy order.
    pub joint_pos_rad: PerJoint,
    /// Angular velocity, rad/s, body.
    pub gyro_radps: [f32; 3],
    /// Direction of gravity, unit vector, body.
    pub gravity: [f32; 3],
}

fn add_noise(values: &mut [f32], std: f32, stream: &mut Stream) {
    if std > 0.0 {
        stream.add_bell_noise(values, std);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const ACT_DIM: usize = 16;
    use caudata_random::{Key, Purpose};

    fn stream() -> Stream {
        Stream::new(Key::for_run(2), Purpose::Sensor)
    }

    fn level() -> Readings {
        Readings {
            joint_vel_radps: [1.0; ACT_DIM].into(),
            joint_pos_rad: [2.0; ACT_DIM].into(),
            gyro_radps: [3.0; 3],
            gravity: [0.0, 0.0, -1.0],
        }
    }

    #[test]
    fn each_part_gets_its_own_standard_deviation() {
        let config = ObservationNoiseConfig::default();
        let mut stream = stream();
        let n = 4000;
        let (mut vel, mut pos, mut gyro, mut tilt) = (0.0, 0.0, 0.0, 0.0);
        for _ in 0..n {
            let mut readings = level();
            config.add(&mut readings, &mut stream);
            vel += (readings.joint_vel_radps[4] - 1.0).powi(2);
            pos += (readings.joint_pos_rad[9] - 2.0).powi(2);
            gyro += (readings.gyro_radps[1] - 3.0).powi(2);
            tilt += readings.gravity[0].powi(2);
            let norm: f32 = readings.gravity.iter().map(|g| g * g).sum();
            assert!((norm - 1.0).abs() < 1e-5);
        }
        // A standard deviation from 4,000 samples is good to 1/√8000 = 1.1 %; five times that.
        for (sum, std) in [(vel, 0.1), (pos, 0.005), (gyro, 0.05), (tilt, 0.02)] {
            let found = (sum / n as f32).sqrt();
            assert!((found / std - 1.0).abs() < 0.056, "{found} for {std}");
        }
    }

    #[test]
    fn switched_off_changes_nothing_and_takes_nothing() {
        let config = ObservationNoiseConfig { enabled: false, ..ObservationNoiseConfig::default() };
        let mut stream = stream();
        let mut readings = level();
        config.add(&mut readings, &mut stream);
        assert_eq!(readings, level());
        assert_eq!(config.draw_joint_offsets(ACT_DIM, &mut stream), [0.0; ACT_DIM]);
        assert_eq!(stream.word_position(), 0);
    }

    #[test]
    fn joint_offsets_are_drawn_per_joint() {
        let offsets = ObservationNoiseConfig::default().draw_joint_offsets(ACT_DIM, &mut stream());
        assert!(offsets.iter().all(|o| o.abs() < 0.035));
        assert_ne!(offsets[0], offsets[1]);
    }

    #[test]
    fn negative_noise_is_refused_by_name() {
        let config =
            ObservationNoiseConfig { gyro_std_radps: -0.1, ..ObservationNoiseConfig::default() };
        assert_eq!(
            config.validate().unwrap_err().to_string(),
            "task.noise.gyro_std_radps is -0.1: must be 0 to 10"
        );
    }
}
