//! What sensors make of a state: offsets, quantisation, noise, bias. Pure functions of values and a random
//! stream.
//!
//! What is constant and wrong is in [`errors`]: a reading is error, then noise.
//!
//! Draw a robot's own imperfections once per episode ([`ImuBias::draw`]), then measure every control period.
//! A white noise of density n (unit/√Hz, one-sided, as data sheets give it) sampled every `period_s` and
//! band-limited to half the sampling rate has standard deviation n·√(1/(2·period_s)).

pub mod errors;

use caudata_model::{ImuParams, RobotModel, ServoParams};
use caudata_random::Stream;
use serde::{Deserialize, Serialize};

use errors::quantise;
pub use errors::{CurrentErrors, EncoderErrors, ImuMounting, current_a};

use crate::State;

/// Standard gravity, m/s².
const G_MPS2: f32 = 9.806_65;

/// Position as a servo reports it: the true one plus its mounting offset, rounded to encoder counts, rad.
pub fn encoder_pos_rad(servo: &ServoParams, true_rad: f32, offset_rad: f32) -> f32 {
    let errors = EncoderErrors { offset_rad, ..EncoderErrors::default() };
    errors.read_rad(servo, true_rad)
}

/// Velocity as a servo reports it, rounded to its step, rad/s.
pub fn encoder_vel_radps(servo: &ServoParams, true_radps: f32) -> f32 {
    quantise(true_radps, servo.velocity_lsb_radps)
}

/// Offsets of an IMU that stay from power-up to power-down.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct ImuBias {
    /// Gyroscope, IMU frame, rad/s.
    pub gyro_radps: [f32; 3],
    /// Accelerometer, IMU frame, m/s².
    pub acc_mps2: [f32; 3],
}

impl ImuBias {
    /// Normal offsets with the standard deviations of `imu`.
    pub fn draw(imu: &ImuParams, stream: &mut Stream) -> Self {
        let mut axes = |std: f64| [(); 3].map(|()| std as f32 * stream.normal());
        Self { gyro_radps: axes(imu.gyro_bias_std_radps), acc_mps2: axes(imu.acc_bias_std_mps2) }
    }
}

/// What a gyroscope (rad/s) or an accelerometer (specific force, m/s²) reads, IMU frame: `truth` plus `bias` plus
/// white noise of one-sided density `noise_per_sqrt_hz`, sampled every `period_s`.
pub fn reading(
    truth: [f32; 3],
    bias: [f32; 3],
    noise_per_sqrt_hz: f64,
    period_s: f64,
    stream: &mut Stream,
) -> [f32; 3] {
    let std = (noise_per_sqrt_hz * (0.5 / period_s).sqrt()) as f32;
    [0, 1, 2].map(|i| truth[i] + bias[i] + std * stream.normal())
}

/// What the gyroscope (rad/s) and the accelerometer (m/s²) of the first lane's robot read, IMU frame; of a robot
/// file without IMU, what is true. Before the first step, where no force is known, the robot is at rest.
pub fn imu(
    model: &RobotModel,
    state: &State,
    bias: &ImuBias,
    stepped: bool,
    period_s: f64,
    stream: &mut Stream,
) -> ([f32; 3], [f32; 3]) {
    let three = |v: &[f32]| [v[0], v[1], v[2]];
    let gyro = three(&state.imu_gyro_radps);
    let acc = match stepped {
        true => three(&state.imu_acc_mps2),
        false => three(&state.imu_gravity).map(|g| -G_MPS2 * g),
    };
    match &model.sensors().imu {
        Some(imu) => (
            reading(gyro, bias.gyro_radps, imu.gyro_noise_radps_per_sqrt_hz, period_s, stream),
            reading(acc, bias.acc_mps2, imu.acc_noise_mps2_per_sqrt_hz, period_s, stream),
        ),
        None => (gyro, acc),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::drive::servo::tests::w210;
    use caudata_random::{Key, Purpose};

    fn imu() -> ImuParams {
        ImuParams {
            site: "imu".to_owned(),
            gyro_noise_radps_per_sqrt_hz: 6.6323e-5,
            acc_noise_mps2_per_sqrt_hz: 6.865e-4,
            gyro_bias_std_radps: 0.01745,
            acc_bias_std_mps2: 0.1961,
        }
    }

    fn stream(env: u64) -> Stream {
        Stream::new(Key { env, ..Key::for_run(5) }, Purpose::Sensor)
    }

    #[test]
    fn encoder_rounds_to_counts() {
        // 2π/4096 = 0.00153398 rad; 0.1 + 0.001 is 65.84 counts → 66 → 0.101243
        assert!((encoder_pos_rad(&w210(), 0.1, 0.001) - 0.101_243).abs() < 1e-6);
        // 1.0/0.02398 = 41.70 → 42 → 1.00716
        assert!((encoder_vel_radps(&w210(), 1.0) - 1.007_16).abs() < 1e-5);
        assert_eq!(encoder_vel_radps(&w210(), -0.011), 0.0);
    }

    #[test]
    fn current_has_a_dead_band() {
        // 1.11 N·m → 1 + 0.145 A = 425.65 steps of 2.69 mA → 426 → 1.14594 A
        assert!((current_a(&w210(), 1.11) - 1.145_94).abs() < 1e-5);
        assert!((current_a(&w210(), -1.11) + 1.145_94).abs() < 1e-5);
        assert_eq!(current_a(&w210(), 0.0), 0.0);
    }

    #[test]
    fn imu_noise_has_the_data_sheets_spread() {
        // at 50 Hz: gyro 6.6323e-5·√25 = 3.316e-4 rad/s, acc 6.865e-4·5 = 3.4325e-3 m/s²
        let imu = imu();
        let mut s = stream(0);
        const N: usize = 20_000;
        let (mut gyro, mut acc) = (0.0, 0.0);
        for _ in 0..N {
            let mut square = |noise| -> f64 {
                let read = reading([0.0; 3], [0.0; 3], noise, 0.02, &mut s);
                read.iter().map(|v| f64::from(v * v)).sum()
            };
            gyro += square(imu.gyro_noise_radps_per_sqrt_hz);
            acc += square(imu.acc_noise_mps2_per_sqrt_hz);
        }
        // the spread of 60,000 samples is known to 0.3 %
        assert!(((gyro / 6e4).sqrt() / 3.316e-4 - 1.0).abs() < 0.012);
        assert!(((acc / 6e4).sqrt() / 3.4325e-3 - 1.0).abs() < 0.012);
    }

    #[test]
    fn bias_is_a_constant_offset_drawn_per_robot() {
        let imu = ImuParams { gyro_noise_radps_per_sqrt_hz: 0.0, ..imu() };
        let bias = ImuBias::draw(&imu, &mut stream(1));
        assert_eq!(bias, ImuBias::draw(&imu, &mut stream(1)));
        assert_ne!(bias, ImuBias::draw(&imu, &mut stream(2)));
        let read = reading([1.0, 0.0, 0.0], bias.gyro_radps, 0.0, 0.02, &mut stream(3));
        assert_eq!(read, [1.0 + bias.gyro_radps[0], bias.gyro_radps[1], bias.gyro_radps[2]]);
        // spread over robots: 0.01745 rad/s
        let sum: f64 = (0..2000)
            .flat_map(|e| ImuBias::draw(&imu, &mut stream(e)).gyro_radps)
            .map(|b| f64::from(b * b))
            .sum();
        assert!(((sum / 6000.0).sqrt() / 0.01745 - 1.0).abs() < 0.04);
    }
}
