//! The inertial measurement unit and motion capture (S6 to S9).

use super::effect::Reference::One;
use super::effect::{Effect, Layer, PLAIN, parameter};
use crate::excitation::Excitation;
use crate::place::{Domain, Place};
use crate::trial::Kind;

fn needs_imu(e: &Excitation, _: &Place) -> Option<&'static str> {
    let any = [Kind::Gyro, Kind::Acceleration, Kind::Gravity].iter().any(|k| e.has(*k));
    (!any).then_some("no IMU was recorded")
}

const OF_THE_IMU: Effect =
    Effect { layer: Layer::Sensing, domain: Domain::Robot, unseen: needs_imu, ..PLAIN };

pub static IMU_TILT: Effect = Effect {
    id: "imu_tilt",
    parameters: &[
        parameter("roll_rad", "rad", 0.0, (-0.4, 0.4), 0.01, One),
        parameter("pitch_rad", "rad", 0.0, (-0.4, 0.4), 0.01, One),
    ],
    grid: &[&[0.05, 0.0], &[0.0, 0.05]],
    apply: |plant, _, v| {
        plant.sensing.mounting.tilt_rad[0] += v[0] as f32;
        plant.sensing.mounting.tilt_rad[1] += v[1] as f32;
    },
    look_alikes: "floor_slope",
    trial: "rest",
    signature: "constant in the body's frame; no joint reacts",
    ..OF_THE_IMU
};

pub static GYRO_BIAS: Effect = Effect {
    id: "gyro_bias",
    parameters: &[
        parameter("x_radps", "rad/s", 0.0, (-0.5, 0.5), 0.01, One),
        parameter("y_radps", "rad/s", 0.0, (-0.5, 0.5), 0.01, One),
        parameter("z_radps", "rad/s", 0.0, (-0.5, 0.5), 0.01, One),
    ],
    grid: &[&[0.03, 0.0, 0.0], &[0.0, 0.03, 0.0], &[0.0, 0.0, 0.03]],
    apply: |plant, _, v| {
        for (bias, v) in plant.sensing.bias.gyro_radps.iter_mut().zip(v) {
            *bias += *v as f32;
        }
    },
    unseen: |e, _| (!e.has(Kind::Gyro)).then_some("no gyroscope was recorded"),
    trial: "rest",
    signature: "a rate at rest",
    ..OF_THE_IMU
};

pub static IMU_DELAY: Effect = Effect {
    id: "imu_delay",
    parameters: &[
        parameter("delay_s", "s", 0.0, (0.0, 0.1), 0.004, One),
        parameter("lag_s", "s", 0.0, (0.0, 0.1), 0.004, One),
    ],
    grid: &[&[0.005, 0.0], &[0.01, 0.0], &[0.02, 0.0], &[0.04, 0.0], &[0.0, 0.01], &[0.0, 0.03]],
    apply: |plant, _, v| {
        plant.sensing.imu_delay_s += v[0] as f32;
        plant.sensing.imu_lag_s += v[1] as f32;
    },
    look_alikes: "measurement_delay",
    trial: "chirp_medium",
    signature: "the IMU alone comes late; joints do not",
    ..OF_THE_IMU
};

pub static MOCAP_FRAME: Effect = Effect {
    id: "mocap_frame",
    parameters: &[
        parameter("delay_s", "s", 0.0, (0.0, 0.1), 0.004, One),
        parameter("yaw_rad", "rad", 0.0, (-0.5, 0.5), 0.01, One),
        parameter("z_m", "m", 0.0, (-0.1, 0.1), 0.002, One),
    ],
    grid: &[&[0.01, 0.0, 0.0], &[0.03, 0.0, 0.0], &[0.0, 0.05, 0.0], &[0.0, 0.0, 0.01]],
    apply: |plant, _, v| {
        plant.sensing.mocap_delay_s += v[0] as f32;
        plant.sensing.mocap_yaw_rad += v[1] as f32;
        plant.sensing.mocap_offset_m[2] += v[2] as f32;
    },
    look_alikes: "imu_delay",
    unseen: |e, _| (!e.has(Kind::BasePosition)).then_some("no motion capture was recorded"),
    trial: "chirp_medium",
    signature: "only motion capture is off; all onboard signals are as simulated",
    ..OF_THE_IMU
};
