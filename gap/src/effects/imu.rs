//! The inertial measurement unit and motion capture (S6 to S9).

use super::Reference::One;
use super::{Domain, Effect, Layer, parameter};
use crate::excitation::Excitation;
use crate::trial::Kind;

fn needs_imu(e: &Excitation) -> Option<&'static str> {
    let any = [Kind::Gyro, Kind::Acceleration, Kind::Gravity]
        .iter()
        .any(|k| e.has(*k));
    (!any).then_some("no IMU was recorded")
}

pub static IMU_TILT: Effect = Effect {
    id: "imu_tilt",
    layer: Layer::Sensing,
    domain: Domain::Robot,
    parameters: &[
        parameter("roll_rad", "rad", 0.0, (-0.4, 0.4), 0.01, One),
        parameter("pitch_rad", "rad", 0.0, (-0.4, 0.4), 0.01, One),
    ],
    grid: &[&[-0.05, 0.0], &[0.05, 0.0], &[0.0, -0.05], &[0.0, 0.05]],
    hinge: false,
    apply: |plant, _, v| {
        plant.sensing.mounting.tilt_rad[0] += v[0] as f32;
        plant.sensing.mounting.tilt_rad[1] += v[1] as f32;
    },
    shows_in: &[Kind::Gyro, Kind::Acceleration, Kind::Gravity],
    look_alikes: &["floor_slope"],
    unseen: |e, _| needs_imu(e),
    trial: "stand_headings",
    signature: "constant in the body's frame; no joint reacts",
};

pub static GYRO_BIAS: Effect = Effect {
    id: "gyro_bias",
    layer: Layer::Sensing,
    domain: Domain::Robot,
    parameters: &[
        parameter("x_radps", "rad/s", 0.0, (-0.5, 0.5), 0.01, One),
        parameter("y_radps", "rad/s", 0.0, (-0.5, 0.5), 0.01, One),
        parameter("z_radps", "rad/s", 0.0, (-0.5, 0.5), 0.01, One),
    ],
    grid: &[&[0.03, 0.0, 0.0], &[0.0, 0.03, 0.0], &[0.0, 0.0, 0.03]],
    hinge: false,
    apply: |plant, _, v| {
        for (bias, v) in plant.sensing.bias.gyro_radps.iter_mut().zip(v) {
            *bias += *v as f32;
        }
    },
    shows_in: &[Kind::Gyro],
    look_alikes: &[],
    unseen: |e, _| (!e.has(Kind::Gyro)).then_some("no gyroscope was recorded"),
    trial: "rest",
    signature: "a rate at rest",
};

pub static IMU_DELAY: Effect = Effect {
    id: "imu_delay",
    layer: Layer::Sensing,
    domain: Domain::Robot,
    parameters: &[
        parameter("delay_s", "s", 0.0, (0.0, 0.1), 0.004, One),
        parameter("lag_s", "s", 0.0, (0.0, 0.1), 0.004, One),
    ],
    grid: &[
        &[0.005, 0.0],
        &[0.01, 0.0],
        &[0.02, 0.0],
        &[0.04, 0.0],
        &[0.0, 0.01],
        &[0.0, 0.03],
    ],
    hinge: false,
    apply: |plant, _, v| {
        plant.sensing.imu_delay_s += v[0] as f32;
        plant.sensing.imu_lag_s += v[1] as f32;
    },
    shows_in: &[Kind::Gyro, Kind::Acceleration, Kind::Gravity],
    look_alikes: &["measurement_delay"],
    unseen: |e, _| needs_imu(e),
    trial: "chirp",
    signature: "the IMU alone comes late; joints do not",
};

pub static MOCAP_FRAME: Effect = Effect {
    id: "mocap_frame",
    layer: Layer::Sensing,
    domain: Domain::Robot,
    parameters: &[
        parameter("delay_s", "s", 0.0, (0.0, 0.1), 0.004, One),
        parameter("yaw_rad", "rad", 0.0, (-0.5, 0.5), 0.01, One),
        parameter("z_m", "m", 0.0, (-0.1, 0.1), 0.002, One),
    ],
    grid: &[
        &[0.01, 0.0, 0.0],
        &[0.03, 0.0, 0.0],
        &[0.0, 0.05, 0.0],
        &[0.0, 0.0, 0.01],
    ],
    hinge: false,
    apply: |plant, _, v| {
        plant.sensing.mocap_delay_s += v[0] as f32;
        plant.sensing.mocap_yaw_rad += v[1] as f32;
        plant.sensing.mocap_offset_m[2] += v[2] as f32;
    },
    shows_in: &[Kind::BasePosition, Kind::BaseVelocity, Kind::BaseAttitude],
    look_alikes: &["imu_delay"],
    unseen: |e, _| (!e.has(Kind::BasePosition)).then_some("no motion capture was recorded"),
    trial: "chirp",
    signature: "only motion capture is off; all onboard signals are as simulated",
};
