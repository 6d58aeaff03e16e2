//! The salamander on a stand, on the ground or in water, by the Rapier engine at half the diagnosing
//! simulator's step, with the sensors of a lab around it: encoders, IMU, and motion capture of feet and base.
//!
//! Another engine, another contact model, another joint solver and another way to take drag and added mass
//! than the diagnosis has. Formulas of the drive-line and of water are those of `sim/` (both engines share
//! them), so what is hidden here lies in structure, masses, ground, and in the sizes of what water does.

use std::sync::Arc;

use caudata_model::RobotModel;
use caudata_random::{Key, Purpose, Stream};
use caudata_runlog::{Axis, BaseHold, QuatPart, Signal};
use caudata_sim::drive::{ServoDrive, supply};
use caudata_sim::{
    EngineConfig, EngineKind, InitialState, LaneParams, SimError, TerrainConfig, TerrainKind,
};

use super::sensors::{Row, counted};

/// Step of the engine, s.
const ENGINE_STEP_S: f64 = 0.001;
/// Steps per row (100 Hz).
const STEPS_PER_ROW: u32 = 10;
/// How long the robot stands before the run begins, s, and how long it floats: bobbing dies within a second.
const SETTLE_S: f64 = 1.0;
const FLOAT_S: f64 = 3.0;
/// A pool is never quite still (m/s), and never quite the same to swim in: shares by which drag and buoyancy
/// differ from run to run.
const STIR_MPS: f32 = 0.004;
const DRAG_SHARE: f32 = 0.04;
const BUOYANCY_SHARE: f32 = 0.004;
/// Motion capture: noise (m), and every so many seconds a gap of so many.
const MOCAP_NOISE_M: f64 = 0.0004;
const MOCAP_GAP_EVERY_S: f64 = 4.0;
const MOCAP_GAP_S: f64 = 0.15;
/// White noise of the orientation from motion capture, as parts of the quaternion.
const QUAT_NOISE: f64 = 0.0004;

/// What is recorded.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Channels {
    /// IMU.
    pub imu: bool,
    /// Motion capture of base and feet.
    pub mocap: bool,
}

impl Channels {
    /// An IMU and motion capture.
    pub const ALL: Self = Self { imu: true, mocap: true };
}

/// A robot and its imperfections in one run.
#[derive(Clone, Debug)]
pub struct Session {
    /// Physics.
    pub lane: LaneParams,
    /// Offset of the gyroscope, rad/s.
    pub gyro_bias_radps: [f64; 3],
    /// Offset of the accelerometer, m/s².
    pub acc_bias_mps2: [f64; 3],
}

impl Session {
    /// A careful lab's robot in one run of a given day.
    pub fn of_the_day(
        model: &RobotModel,
        lane: &LaneParams,
        place: BaseHold,
        seed: u64,
        run: u64,
    ) -> Self {
        let key = Key { seed, actor: 11, env: run, episode: 0 };
        let mut s = Stream::new(key, Purpose::Randomisation);
        let mut lane = lane.clone();
        lane.foot_friction *= s.uniform(0.9, 1.1);
        lane.supply_v += s.uniform(-0.4, 0.4);
        for f in &mut lane.joint_friction_nm {
            *f *= s.uniform(0.92, 1.08);
        }
        if place == BaseHold::Water {
            let drag = s.uniform(1.0 - DRAG_SHARE, 1.0 + DRAG_SHARE);
            let lift = s.uniform(1.0 - BUOYANCY_SHARE, 1.0 + BUOYANCY_SHARE);
            for link in &mut lane.water {
                link.quadratic_drag_scale_x *= drag;
                link.quadratic_drag_scale_y *= drag;
                link.quadratic_drag_scale_z *= drag;
                link.quadratic_torque_scale *= drag;
                link.buoyancy_scale *= lift;
            }
            for v in &mut lane.water_current_mps[..2] {
                *v += s.uniform(-STIR_MPS, STIR_MPS);
            }
        }
        // offsets are of the device: the same in all runs
        let mut device = Stream::new(Key { env: 0, actor: 12, ..key }, Purpose::Sensor);
        let imu = model.sensors().imu.as_ref();
        let (gyro, acc) =
            imu.map_or((0.0, 0.0), |i| (0.1 * i.gyro_bias_std_radps, 0.1 * i.acc_bias_std_mps2));
        Self {
            lane,
            // what is left after a lab has subtracted the mean at rest
            gyro_bias_radps: [(); 3].map(|()| gyro * device.normal_f64()),
            acc_bias_mps2: [(); 3].map(|()| acc * device.normal_f64()),
        }
    }
}

/// Columns of a log.
pub fn signals(model: &RobotModel, channels: Channels) -> Vec<Signal> {
    let of_joints: [fn(String) -> Signal; 4] =
        [Signal::Command, Signal::Position, Signal::Velocity, Signal::Current];
    let mut all = Signal::each(&of_joints, &model.actuated_names());
    all.push(Signal::Voltage);
    if channels.imu {
        all.extend(Signal::axes(&[Signal::Gyro, Signal::Acceleration]));
    }
    if channels.mocap {
        all.extend(Axis::ALL.map(Signal::BasePosition));
        all.extend(QuatPart::ALL.map(Signal::BaseQuaternion));
        for foot in model.feet() {
            all.extend(Axis::ALL.map(|a| Signal::Foot(foot.name.clone(), a)));
        }
    }
    all
}

/// Where a run happens, and how it begins.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Beginning {
    /// On a stand, on the ground or in water.
    pub place: BaseHold,
    /// A hand on the trunk that lets go as the run begins: force (N) and torque (N·m), world.
    pub hand: [f32; 6],
}

impl From<BaseHold> for Beginning {
    fn from(place: BaseHold) -> Self {
        Self { place, hand: [0.0; 6] }
    }
}

/// Height of the water above z = 0, m, as `log.toml` of runs in water says.
pub const WATER_LEVEL_M: f64 = 2.0;

fn pool() -> TerrainConfig {
    TerrainConfig { water_level_m: WATER_LEVEL_M, ..TerrainConfig::of(TerrainKind::DeepWater) }
}

/// Moves the robot through `rows_rad` (one command per row) and returns the log's rows.
///
/// # Errors
/// [`SimError`] where parameters are not physical.
pub fn run(
    model: &Arc<RobotModel>,
    session: &Session,
    rows_rad: &[Vec<f64>],
    channels: Channels,
    begins: Beginning,
    stream: &mut Stream,
) -> Result<Vec<Row>, SimError> {
    let config = EngineConfig {
        kind: EngineKind::Rapier,
        dt_s: ENGINE_STEP_S,
        // torque is reported as the mean over a period: a servo reads its current at an instant, not over a
        // whole row
        substeps: 1,
        fixed_base: begins.place == BaseHold::Fixed,
        ..EngineConfig::rapier()
    };
    let (terrain, settle_s) = match begins.place {
        BaseHold::Water => (pool(), FLOAT_S),
        BaseHold::Fixed | BaseHold::Free => (TerrainConfig::default(), SETTLE_S),
    };
    let mut engine = caudata_sim::build(Arc::clone(model), 1, &config, &terrain, 1, 1)?;
    engine.set_params(0, &session.lane)?;
    let narrow = |row: &[f64]| row.iter().map(|&x| x as f32).collect::<Vec<f32>>();
    let mut start = narrow(&rows_rad[0]);
    for q in &mut start {
        *q += 0.004 * stream.normal();
    }
    engine.reset(0, &InitialState { joint_pos_rad: start, ..InitialState::nominal(model) })?;
    let period_s = config.control_period_s() * f64::from(STEPS_PER_ROW);
    for _ in 0..(settle_s / ENGINE_STEP_S) as usize {
        engine.step(&narrow(&rows_rad[0]), &begins.hand)?;
    }
    let mut out = Vec::with_capacity(rows_rad.len());
    for (k, row) in rows_rad.iter().enumerate() {
        let t = k as f64 * period_s;
        let stamp = if k == 0 { 0.0 } else { t + 0.00005 * stream.normal_f64() };
        out.push((stamp, read(model, engine.state(), session, row, t, channels, stream)));
        let targets = narrow(row);
        for _ in 0..STEPS_PER_ROW {
            engine.step(&targets, &[0.0; 6])?;
        }
    }
    Ok(out)
}

fn read(
    model: &RobotModel,
    state: &caudata_sim::State,
    session: &Session,
    command: &[f64],
    t: f64,
    channels: Channels,
    s: &mut Stream,
) -> Vec<Option<f64>> {
    let mut row: Vec<Option<f64>> = command.iter().map(|&u| Some(counted(u, 1e-6))).collect();
    let servos = model.actuated();
    for (a, &j) in servos.iter().enumerate() {
        let q = f64::from(state.encoder_pos_rad(0, j, a)) + 0.0002 * s.normal_f64();
        row.push(Some(counted(q, model.servo(a).encoder_lsb_rad())));
    }
    for (a, &j) in servos.iter().enumerate() {
        let v = f64::from(state.encoder_vel_radps(0, j, a)) + 0.01 * s.normal_f64();
        row.push(Some(counted(v, model.servo(a).velocity_lsb_radps)));
    }
    drives(model, state, &session.lane, &mut row, s);
    if channels.imu {
        let imu = model.sensors().imu.as_ref();
        // noise of a band of half the rate
        let band = |density: f64| density * 50.0_f64.sqrt();
        let (gyro, acc) = imu.map_or((0.0, 0.0), |i| {
            (band(i.gyro_noise_radps_per_sqrt_hz), band(i.acc_noise_mps2_per_sqrt_hz))
        });
        for i in 0..3 {
            row.push(Some(
                f64::from(state.imu_gyro_radps[i])
                    + session.gyro_bias_radps[i]
                    + gyro * s.normal_f64(),
            ));
        }
        for i in 0..3 {
            row.push(Some(
                f64::from(state.imu_acc_mps2[i]) + session.acc_bias_mps2[i] + acc * s.normal_f64(),
            ));
        }
    }
    if channels.mocap {
        let hidden = t.rem_euclid(MOCAP_GAP_EVERY_S) > MOCAP_GAP_EVERY_S - MOCAP_GAP_S;
        let mut put = |x: f64, noise: f64| {
            let x = x + noise * s.normal_f64();
            row.push((!hidden).then_some(x));
        };
        state.base_pos_m.iter().for_each(|x| put(f64::from(*x), MOCAP_NOISE_M));
        state.base_quat_wxyz.iter().for_each(|x| put(f64::from(*x), QUAT_NOISE));
        state.foot_pos_m.iter().for_each(|x| put(f64::from(*x), MOCAP_NOISE_M));
    }
    row
}

/// Currents of all servos and the supply, by the robot's own constants, which its lab may not know.
fn drives(
    model: &RobotModel,
    state: &caudata_sim::State,
    lane: &LaneParams,
    row: &mut Vec<Option<f64>>,
    s: &mut Stream,
) {
    let open_v = f64::from(lane.supply_v);
    let mut drawn_a = 0.0;
    for (a, joint) in lane.joints.iter().enumerate() {
        let torque_nm = f64::from(state.motor_torque_nm[a]);
        let qd_radps = f64::from(state.joint_vel_radps[a]);
        // a motor that saturates takes more
        let left = 1.0 - f64::from(joint.torque_saturation_per_nm) * torque_nm.abs();
        let free = torque_nm / (left.max(1e-3) * f64::from(joint.torque_constant_nm_per_a));
        let servo = ServoDrive::new(model, lane, a, ENGINE_STEP_S);
        drawn_a += supply::drawn_a(&servo, open_v, 0.0, torque_nm, qd_radps, free.abs());
        let idle = f64::from(joint.current_dead_band_a);
        let shown = free + idle * (free / 0.01).clamp(-1.0, 1.0);
        let lsb_a = model.servo(a).current_lsb_a;
        row.push(Some(counted(shown + 0.004 * s.normal_f64(), lsb_a)));
    }
    let supply_v = open_v - f64::from(lane.supply_resistance_ohm) * drawn_a;
    row.push(Some(counted(supply_v, 0.1)));
}
