//! What is constant in a robot's sensors and wrong: encoder gain, eccentricity and offset, current gain and
//! bias, IMU tilt and scale.

use caudata_model::ServoParams;
use nalgebra::{Rotation3, Vector3};
use serde::{Deserialize, Serialize};

/// Errors of one encoder: it reads `(1 + gain)·q + A·sin(q + φ) + offset`, rounded to counts.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct EncoderErrors {
    /// Relative error of the angle. 0: none; a few per cent at most in a magnet that sits badly.
    pub gain: f32,
    /// A: amplitude of the once-per-turn error of an off-centre magnet, rad.
    pub eccentricity_rad: f32,
    /// φ, rad.
    pub eccentricity_phase_rad: f32,
    /// Mounting offset, rad.
    pub offset_rad: f32,
}

impl EncoderErrors {
    /// Reading for a true position, rad.
    pub fn read_rad(&self, servo: &ServoParams, true_rad: f32) -> f32 {
        // sixteen sines per reading would be a fiftieth of an environment's step
        let swing = if self.eccentricity_rad == 0.0 {
            0.0
        } else {
            self.eccentricity_rad * (true_rad + self.eccentricity_phase_rad).sin()
        };
        let shown = (1.0 + self.gain) * true_rad + swing + self.offset_rad;
        quantise(shown, servo.encoder_lsb_rad())
    }
}

/// Errors of one servo's current sensing: it reads `(1 + gain)·i + bias`, rounded to its step.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct CurrentErrors {
    /// Relative error.
    pub gain: f32,
    /// Reading without current, A.
    pub bias_a: f32,
}

/// How an IMU sits and scales, besides its [`ImuBias`](super::ImuBias).
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ImuMounting {
    /// The sensor is turned by this rotation vector against where the model has it, rad, in the model's IMU
    /// axes.
    pub tilt_rad: [f32; 3],
    /// Relative error of each axis of the gyroscope.
    pub gyro_gain: [f32; 3],
    /// Relative error of each axis of the accelerometer.
    pub acc_gain: [f32; 3],
}

impl ImuMounting {
    /// A vector in the model's IMU axes as seen along the sensor's own.
    pub fn turned(&self, v: [f32; 3]) -> [f32; 3] {
        let turn = Rotation3::new(Vector3::from(self.tilt_rad.map(f64::from)));
        let seen = turn.inverse() * Vector3::from(v.map(f64::from));
        [0, 1, 2].map(|i| seen[i] as f32)
    }

    /// What the gyroscope's axes get of a rate, rad/s.
    pub fn gyro_radps(&self, true_radps: [f32; 3]) -> [f32; 3] {
        scaled(self.turned(true_radps), self.gyro_gain)
    }

    /// What the accelerometer's axes get of a specific force, m/s².
    pub fn acc_mps2(&self, true_mps2: [f32; 3]) -> [f32; 3] {
        scaled(self.turned(true_mps2), self.acc_gain)
    }
}

fn scaled(v: [f32; 3], gain: [f32; 3]) -> [f32; 3] {
    [0, 1, 2].map(|i| v[i] * (1.0 + gain[i]))
}

/// Current as a servo reports it for a motor torque, A: beyond the dead band proportional to torque, rounded
/// to its step.
///
/// No torque reads as no current, although anything inside the dead band would give none.
pub fn current_a(servo: &ServoParams, torque_nm: f32) -> f32 {
    if torque_nm == 0.0 {
        return 0.0;
    }
    let torque = f64::from(torque_nm);
    let amps = torque.abs() / servo.torque_per_current_nm_per_a + servo.current_dead_band_a;
    quantise((amps * torque.signum()) as f32, servo.current_lsb_a)
}

/// Nearest multiple of `lsb` (0: as it is).
pub(super) fn quantise(value: f32, lsb: f64) -> f32 {
    if lsb > 0.0 {
        // Adding this moves the fraction out of the mantissa: rounds to the nearest whole number, as long as
        // that has less than 51 bits. (`round` is a call into the C library on processors without SSE 4.1.)
        const SHIFT: f64 = 6_755_399_441_055_744.0; // 1.5·2⁵²
        (((f64::from(value) / lsb + SHIFT) - SHIFT) * lsb) as f32
    } else {
        value
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::drive::servo::tests::w210;

    #[track_caller]
    fn near(got: f32, want: f64, tolerance: f64) {
        assert!((f64::from(got) - want).abs() <= tolerance, "got {got}, want {want}");
    }

    #[test]
    fn encoder_gain_eccentricity_and_offset() {
        let e = EncoderErrors {
            gain: 0.02,
            eccentricity_rad: 0.005,
            eccentricity_phase_rad: 0.5,
            offset_rad: -0.01,
        };
        // 1.02·1 + 0.005·sin 1.5 − 0.01 = 1.014987: 661.67 counts, so 662: 1.015496
        near(e.read_rad(&w210(), 1.0), 662.0 * std::f64::consts::TAU / 4096.0, 1e-6);
        // at 0: 0.005·sin 0.5 − 0.01 = −0.007603: −4.96 counts
        near(e.read_rad(&w210(), 0.0), -5.0 * std::f64::consts::TAU / 4096.0, 1e-6);
        near(EncoderErrors::default().read_rad(&w210(), 0.1), 0.099_708_8, 1e-6); // 65 counts
    }

    #[test]
    fn a_tilted_imu_sees_gravity_elsewhere() {
        // nose-up by 0.1 rad about y: at rest (0, 0, 9.81) shows −9.81·sin 0.1 along x, 9.81·cos 0.1 along z
        let m = ImuMounting { tilt_rad: [0.0, 0.1, 0.0], ..ImuMounting::default() };
        let seen = m.acc_mps2([0.0, 0.0, 9.81]);
        near(seen[0], -9.81 * 0.1_f64.sin(), 1e-5);
        near(seen[2], 9.81 * 0.1_f64.cos(), 1e-5);
        // a turn about the axis of the tilt is seen whole, scaled by its axis
        let m = ImuMounting { gyro_gain: [0.0, 0.02, 0.0], ..m };
        near(m.gyro_radps([0.0, 2.0, 0.0])[1], 2.04, 1e-6);
    }
}
