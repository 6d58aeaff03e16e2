//! Recordings of a simulated robot, with what real ones have: counts, noise, lost readings, unsteady stamps,
//! repeats that differ.

#![allow(dead_code)]

use std::path::Path;
use std::sync::Arc;

use caudata_gap::excite::Trial;
use caudata_model::RobotModel;
use caudata_random::{Key, Purpose, Stream};
use caudata_runlog::{BaseHold, LogMeta, RunLog, Signal, Table, TableWriter};
use caudata_sim::{EngineConfig, InitialState, LaneParams, TerrainConfig};

/// A robot of this repository.
pub fn robot(name: &str) -> RobotModel {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../robots");
    RobotModel::load(&folder.join(format!("{name}.robot.toml"))).unwrap()
}

/// A force on the torso link for a while.
#[derive(Clone, Copy)]
pub struct Touch {
    pub from_s: f64,
    pub to_s: f64,
    pub force_n: [f32; 3],
    /// Which of the runs is touched.
    pub run: usize,
}

/// State after each row: positions, speeds, motor torques. `[T][A]` each, one set per run.
pub struct Traces {
    pub pos_rad: Vec<Vec<f64>>,
    pub vel_radps: Vec<Vec<f64>>,
    pub torque_nm: Vec<Vec<f64>>,
    pub gyro: Vec<[f64; 3]>,
    pub gravity: Vec<[f64; 3]>,
}

/// Runs `trial` once per seed, in lanes that differ a little, and returns what every lane did.
pub fn simulate(
    robot: &RobotModel,
    trial: &Trial,
    seeds: &[u64],
    touch: Option<Touch>,
) -> Vec<Traces> {
    let substeps = (1.0 / (trial.rate_hz * 0.002)).round() as u32;
    let config = EngineConfig {
        dt_s: 0.002,
        substeps,
        fixed_base: trial.base == BaseHold::Fixed,
        ..EngineConfig::default()
    };
    let mut terrain = TerrainConfig::default();
    if trial.base == BaseHold::Water {
        terrain.kind = caudata_sim::TerrainKind::DeepWater;
    }
    let lanes = seeds.len();
    let mut engine =
        caudata_sim::build(Arc::new(robot.clone()), lanes, &config, &terrain, 1, 1).unwrap();
    let nominal: Vec<LaneParams> = seeds.iter().map(|&seed| varied(robot, seed)).collect();
    for (lane, params) in nominal.iter().enumerate() {
        engine.set_params(lane, params).unwrap();
        engine.reset(lane, &InitialState::nominal(robot)).unwrap();
    }
    let actuated = robot.actuated().len();
    let mut out: Vec<Traces> = (0..lanes)
        .map(|_| Traces {
            pos_rad: vec![],
            vel_radps: vec![],
            torque_nm: vec![],
            gyro: vec![],
            gravity: vec![],
        })
        .collect();
    let mut powered = vec![true; actuated];
    for (k, row) in trial.commands_rad.iter().enumerate() {
        let on: Vec<bool> = trial.on.get(k).cloned().unwrap_or_else(|| vec![true; actuated]);
        if on != powered {
            for (lane, params) in nominal.iter().enumerate() {
                let mut p = params.clone();
                for a in (0..actuated).filter(|a| !on[*a]) {
                    p.kp_nm_per_rad[a] = 0.0;
                    p.kd_nms_per_rad[a] = 0.0;
                    p.joints[a].kd_min_nms_per_rad = 0.0;
                }
                engine.set_params(lane, &p).unwrap();
            }
            powered = on;
        }
        // what is read at a row is the state before its command acts
        let state = engine.state();
        for (lane, run) in out.iter_mut().enumerate() {
            let of = |all: &[f32], i: usize, n: usize| f64::from(all[lane * n + i]);
            let joints = robot.joints().len();
            let each = |all: &[f32]| robot.actuated().iter().map(|&j| of(all, j, joints)).collect();
            run.pos_rad.push(each(&state.joint_pos_rad));
            run.vel_radps.push(each(&state.joint_vel_radps));
            run.torque_nm
                .push((0..actuated).map(|a| of(&state.motor_torque_nm, a, actuated)).collect());
            run.gyro.push([0, 1, 2].map(|i| of(&state.imu_gyro_radps, i, 3)));
            run.gravity.push([0, 1, 2].map(|i| of(&state.imu_gravity, i, 3)));
        }
        let one: Vec<f32> = row.iter().map(|q| *q as f32).collect();
        let mut wrenches = vec![0.0f32; lanes * 6];
        let t = k as f64 / trial.rate_hz;
        if let Some(x) = touch.filter(|x| (x.from_s..x.to_s).contains(&t)) {
            wrenches[x.run * 6..x.run * 6 + 3].copy_from_slice(&x.force_n);
        }
        engine.step(&one.repeat(lanes), &wrenches).unwrap();
        assert!(!engine.state().diverged.contains(&true), "{} diverged at {t} s", trial.name);
    }
    out
}

/// Friction, supply and gains as they vary from day to day.
fn varied(robot: &RobotModel, seed: u64) -> LaneParams {
    let mut s = Stream::new(Key::for_run(seed), Purpose::Randomisation);
    let mut p = LaneParams::nominal(robot);
    for a in 0..robot.actuated().len() {
        p.joint_friction_nm[a] *= s.uniform(0.9, 1.1);
        p.joint_damping_nms_per_rad[a] *= s.uniform(0.9, 1.1);
    }
    p.supply_v *= s.uniform(0.97, 1.03);
    p
}

/// The log of a simulated run.
pub fn record(robot: &RobotModel, trial: &Trial, traces: &Traces, seed: u64) -> RunLog {
    let mut s = Stream::new(Key::for_run(seed), Purpose::Sensor);
    let named = |of: fn(String) -> Signal| trial.columns.iter().cloned().map(of);
    let imu = robot.imu_site().is_some();
    let mut signals: Vec<Signal> = named(Signal::Command)
        .chain(named(Signal::Position))
        .chain(named(Signal::Velocity))
        .chain(named(Signal::Current))
        .collect();
    if !trial.on.is_empty() {
        signals.extend(named(Signal::Enabled));
    }
    if imu {
        for of in [Signal::Gyro, Signal::Acceleration, Signal::Gravity] {
            signals.extend(caudata_runlog::Axis::ALL.map(of));
        }
    }
    let count = |x: f64, step: f64| (x / step).round() * step;
    let mut table = TableWriter::new(Vec::new(), &signals, f64::INFINITY).unwrap();
    let mut last = f64::NEG_INFINITY;
    for (k, row) in trial.commands_rad.iter().enumerate() {
        let t = (k as f64 / trial.rate_hz + 2e-4 * s.normal_f64()).max(last + 1e-5);
        last = t;
        let lost = s.chance(0.001);
        let mut values: Vec<Option<f64>> = row.iter().map(|q| Some(*q)).collect();
        let mut put = |x: f64| values.push((!lost).then_some(x));
        for (a, q) in traces.pos_rad[k].iter().enumerate() {
            put(count(*q, robot.servo(a).encoder_lsb_rad()));
        }
        for (a, v) in traces.vel_radps[k].iter().enumerate() {
            put(count(v + 0.01 * s.normal_f64(), robot.servo(a).velocity_lsb_radps));
        }
        for (a, torque) in traces.torque_nm[k].iter().enumerate() {
            let servo = robot.servo(a);
            put(count(
                torque / servo.torque_per_current_nm_per_a + 0.004 * s.normal_f64(),
                servo.current_lsb_a,
            ));
        }
        if let Some(on) = trial.on.get(k) {
            values.extend(on.iter().map(|on| Some(f64::from(u8::from(*on)))));
        }
        if imu {
            let (w, g) = (traces.gyro[k], traces.gravity[k]);
            values.extend(w.map(|w| Some(w + 0.005 * s.normal_f64())));
            values.extend(g.map(|g| Some(-9.81 * g + 0.05 * s.normal_f64())));
            values.extend(g.map(Some));
        }
        table.row(t, &values).unwrap();
    }
    let mut meta = LogMeta::new(robot.name(), trial.base, trial.rate_hz);
    meta.notes = trial.name.clone();
    let csv = table.finish().unwrap();
    RunLog::new(meta, Table::parse("log.csv", csv.as_slice()).unwrap())
}

/// The same log with its cells changed: `change(signal, row, t, value)`.
pub fn changed(
    log: &RunLog,
    change: impl Fn(&Signal, usize, f64, Option<f64>) -> Option<f64>,
) -> RunLog {
    let signals = log.table.signals().to_vec();
    rebuilt(log, &signals, |k, t| {
        let row = log.table.row(k).unwrap();
        (t, row.iter().zip(&signals).map(|(v, s)| change(s, k, t, *v)).collect())
    })
}

/// The same log with other columns and rows.
pub fn rebuilt(
    log: &RunLog,
    signals: &[Signal],
    row: impl Fn(usize, f64) -> (f64, Vec<Option<f64>>),
) -> RunLog {
    let mut table = TableWriter::new(Vec::new(), signals, f64::INFINITY).unwrap();
    for (k, &t) in log.table.time_s().iter().enumerate() {
        let (t, values) = row(k, t);
        table.row(t, &values).unwrap();
    }
    let csv = table.finish().unwrap();
    RunLog::new(log.meta.clone(), Table::parse("log.csv", csv.as_slice()).unwrap())
}
