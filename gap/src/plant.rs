//! A candidate robot: physical parameters of a lane, what its sensors do wrong, and what happens to its
//! commands and clocks.

use std::sync::Arc;

use caudata_model::RobotModel;
use caudata_sim::LaneParams;
use caudata_sim::sensors::{CurrentErrors, EncoderErrors, ImuBias, ImuMounting};
use serde::{Deserialize, Serialize};

use crate::trial::Trial;

/// What sensors and clocks do wrong. All zero: nothing.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Sensing {
    /// Encoders, inside the position loop. `[A]`
    pub encoders: Vec<EncoderErrors>,
    /// Current sensing. `[A]`
    pub currents: Vec<CurrentErrors>,
    /// Time constant of each servo's velocity estimate, s. `[A]`
    pub velocity_lag_s: Vec<f32>,
    /// Time constant of each servo's reading of its current, s. `[A]`
    pub current_lag_s: Vec<f32>,
    /// How the IMU sits and scales.
    pub mounting: ImuMounting,
    /// Its offsets.
    pub bias: ImuBias,
    /// How late it reports, s.
    pub imu_delay_s: f32,
    /// Time constant of its low-pass, s.
    pub imu_lag_s: f32,
    /// How late everything measured is stamped, s.
    pub measurement_delay_s: f32,
    /// By how much stamps run ahead of time, s/s: what is stamped t was measured at t·(1 − drift).
    pub clock_drift: f32,
    /// Shift of motion capture, world, m.
    pub mocap_offset_m: [f32; 3],
    /// Turn of motion capture about the vertical, rad.
    pub mocap_yaw_rad: f32,
    /// How late motion capture is, s.
    pub mocap_delay_s: f32,
}

/// A candidate robot.
#[derive(Debug, Clone)]
pub struct Plant {
    /// What it is built from.
    pub model: Arc<RobotModel>,
    /// Physics.
    pub lane: LaneParams,
    /// Sensors and clocks.
    pub sensing: Sensing,
    /// Where in the session the run is, 0 (first) to 1 (last).
    pub session: f64,
    /// Dry friction that a joint has at the beginning of every run and loses (or gains) while it moves. `[A]`
    pub run_in: Vec<RunIn>,
}

/// Friction that goes away within a run: `extra_nm·e^(−t/time_s)`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RunIn {
    /// At the run's beginning, N·m.
    pub extra_nm: f64,
    /// Time in which it falls to 1/e, s.
    pub time_s: f64,
}

impl Plant {
    /// The robot file's robot, without the effects of its extension.
    #[must_use]
    pub fn nominal(model: &Arc<RobotModel>) -> Self {
        let joints = model.actuated().len();
        Self {
            model: Arc::clone(model),
            lane: LaneParams::bare(model),
            sensing: Sensing {
                encoders: vec![EncoderErrors::default(); joints],
                currents: vec![CurrentErrors::default(); joints],
                velocity_lag_s: vec![0.0; joints],
                current_lag_s: vec![0.0; joints],
                ..Sensing::default()
            },
            session: 0.0,
            run_in: vec![
                RunIn {
                    extra_nm: 0.0,
                    time_s: 1.0
                };
                joints
            ],
        }
    }

    /// The robot under the circumstances of a run: its gains, its supply.
    #[must_use]
    pub fn in_trial(model: &Arc<RobotModel>, trial: &Trial) -> Self {
        let mut plant = Self::nominal(model);
        let lane = &mut plant.lane;
        if let Some(kp) = trial.kp_nm_per_rad {
            lane.kp_nm_per_rad.fill(kp as f32);
        }
        if let Some(kd) = trial.kd_nms_per_rad {
            lane.kd_nms_per_rad.fill(kd as f32);
        }
        if let Some(volt) = trial.supply_v {
            lane.supply_v = volt as f32;
            // the envelope's speeds go with the supply by themselves; its torques are given for one supply
            for a in 0..plant.lane.torque_scale.len() {
                let share = volt / model.servo(a).reference_supply_v;
                if share < 1.0 {
                    plant.less_voltage(a, share as f32);
                }
            }
        }
        plant
    }

    /// Torque limits of joint `a` where the motor gets `share` of its voltage: the line through stall torque
    /// and speed without load moves in parallel (the speeds are the caller's). Against the motion, back-EMF
    /// helps the bridge, so that the motor brakes harder than it drives, but not harder than its current
    /// limit for braking allows.
    pub(crate) fn less_voltage(&mut self, a: usize, share: f32) {
        /// Braking torque over stall torque: back-EMF is about half the voltage where a joint begins to
        /// brake.
        const BRAKING: f64 = 1.5;
        let servo = self.model.servo(a);
        let before = self.lane.torque_scale[a];
        self.lane.torque_scale[a] *= share;
        let joint = &mut self.lane.joints[a];
        let allowed_nm = servo.tau_brake_max_nm as f32 * before * joint.brake_scale;
        let possible_nm = (BRAKING * servo.tau_max_nm) as f32 * before * share;
        joint.brake_scale *= allowed_nm.min(possible_nm) / (allowed_nm * share).max(1e-9);
    }
}
