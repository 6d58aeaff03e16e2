//! The servo in the loop: sag, saturation, work, delay. On the pendulum of `robots`, m·g·l = 0.981 N·m.

use std::sync::Arc;

use caudata_model::RobotModel;
use caudata_sim::{EngineConfig, InitialState, LaneParams};

use crate::conformance::{engine, near, periods, robots, run};

/// Gains 15 and 0.3, XM430's armature: kd·dt/I stays small on every step the engines use.
fn geared(model: &Arc<RobotModel>) -> LaneParams {
    LaneParams {
        kp_nm_per_rad: vec![15.0],
        kd_nms_per_rad: vec![0.3],
        joint_armature_kgm2: vec![0.0022],
        ..LaneParams::nominal(model)
    }
}

/// Told to hold 1 rad, it hangs where 15·(1 − q) = 0.981·sin q: q = 0.9466 (15·0.0534 = 0.801 = 0.981·0.8114…
/// checked below).
pub fn sags_by_load_over_gain(config: &EngineConfig) {
    let model = robots::pendulum();
    let mut e = engine(config, &model, 1);
    e.set_params(0, &geared(&model)).unwrap();
    e.reset(0, &InitialState::nominal(&model)).unwrap();
    run(e.as_mut(), periods(config, 3.0), &[1.0], |_, _| ());
    let q = f64::from(e.state().joint_pos_rad[0]);
    near("balance", 15.0 * (1.0 - q), 0.981 * q.sin(), 1e-3);
    near("position", q, 0.9466, 1e-3);
}

/// At rest the reported torque is the load's: 0.981·sin q.
pub fn reports_the_torque_it_gives(config: &EngineConfig) {
    let model = robots::pendulum();
    let mut e = engine(config, &model, 1);
    e.set_params(0, &geared(&model)).unwrap();
    e.reset(0, &InitialState::nominal(&model)).unwrap();
    run(e.as_mut(), periods(config, 3.0), &[-0.7], |_, _| ());
    let s = e.state();
    near(
        "torque",
        f64::from(s.motor_torque_nm[0]),
        0.981 * f64::from(s.joint_pos_rad[0]).sin(),
        1e-3,
    );
    near("power at rest", f64::from(s.mech_power_w[0]), 0.0, 1e-4);
}

/// A tenth of 10 N·m: the flat limit of 1 N·m carries the pendulum to where 0.981·sin q = 1 cannot be held,
/// past the top of the load; at 0.05 N·m it hangs at asin(0.05/0.981) = 0.05099 rad.
pub fn saturates_at_its_envelope(config: &EngineConfig) {
    let model = robots::pendulum();
    let mut e = engine(config, &model, 2);
    for (lane, scale) in [(0, 0.1), (1, 0.005)] {
        let params = LaneParams {
            torque_scale: vec![scale],
            joint_damping_nms_per_rad: vec![0.05],
            ..geared(&model)
        };
        e.set_params(lane, &params).unwrap();
        e.reset(lane, &InitialState::nominal(&model)).unwrap();
    }
    let mut strongest = [0.0_f32; 2];
    run(e.as_mut(), periods(config, 6.0), &[2.4, 2.4], |_, e| {
        for (most, torque) in strongest.iter_mut().zip(&e.state().motor_torque_nm) {
            *most = most.max(torque.abs());
        }
    });
    near("limit", f64::from(strongest[0]), 1.0, 1e-5);
    near("limit", f64::from(strongest[1]), 0.05, 1e-6);
    assert!(e.state().joint_pos_rad[0] > 2.2, "1 N·m lifts it over the load");
    near("hangs at its limit", f64::from(e.state().joint_pos_rad[1]), 0.050_99, 1e-3);
}

/// The integral of reported power is the energy gained: lifted from 0 to 1.5 rad and held still, m·g·l·(1 −
/// cos q).
pub fn power_is_work_done(config: &EngineConfig) {
    let model = robots::pendulum();
    let mut e = engine(config, &model, 1);
    e.set_params(0, &geared(&model)).unwrap();
    e.reset(0, &InitialState::nominal(&model)).unwrap();
    let mut work = 0.0;
    run(e.as_mut(), periods(config, 4.0), &[1.5], |_, e| {
        work += f64::from(e.state().mech_power_w[0]) * config.control_period_s();
    });
    let gained = 0.981 * (1.0 - f64::from(e.state().joint_pos_rad[0]).cos());
    near("work", work, gained, 0.02 * gained);
}

/// With 30 ms of delay the pendulum does what it does without, 30 ms later; with 3 ms (less than a step), a
/// little later.
pub fn commands_arrive_delayed(config: &EngineConfig) {
    let model = robots::pendulum();
    let delays = [0.0, 0.003, 0.02, 0.03];
    let mut e = engine(config, &model, delays.len());
    for (lane, &delay) in delays.iter().enumerate() {
        let params = LaneParams { command_delay_s: delay, ..geared(&model) };
        e.set_params(lane, &params).unwrap();
        e.reset(lane, &InitialState::nominal(&model)).unwrap();
    }
    let n = periods(config, 0.2);
    let mut track: Vec<Vec<f64>> = vec![vec![]; delays.len()];
    run(e.as_mut(), n, &[0.5; 4], |_, e| {
        for (lane, q) in e.state().joint_pos_rad.iter().enumerate() {
            track[lane].push(f64::from(*q));
        }
    });
    // 20 ms is one whole period: the same motion, one period later. Before its command arrives it hangs
    // still.
    if (config.control_period_s() - 0.02).abs() < 1e-9 {
        near("waits", track[2][0], 0.0, 1e-6);
        near("waits", track[3][0], 0.0, 1e-6);
        for (late, prompt) in track[2][1..].iter().zip(&track[0]) {
            near("one period late", *late, *prompt, 1e-5);
        }
    }
    let crossing = |q: &[f64]| {
        let k = q.iter().position(|&q| q > 0.25).unwrap();
        (k as f64 - (q[k] - 0.25) / (q[k] - q[k - 1])) * config.control_period_s()
    };
    // read off between periods, so to about a millisecond or two
    let t0 = crossing(&track[0]);
    near("3 ms", crossing(&track[1]) - t0, 0.003, 0.002);
    near("30 ms", crossing(&track[3]) - t0, 0.03, 0.004);
}
