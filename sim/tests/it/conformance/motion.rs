//! Free motion: fall, momentum, pushes.

use caudata_sim::{EngineConfig, InitialState, LaneParams};

use crate::conformance::{engine, near, periods, robots, run};

/// z = −g·t²/2 and v = −g·t, for the centre of mass of a robot that tumbles meanwhile.
pub fn falls_by_the_book(config: &EngineConfig) {
    let model = robots::tumbler();
    let mut e = engine(config, &model, 1);
    let init = InitialState {
        base_z_m: Some(50.0),
        base_angvel_radps: [1.0, -2.0, 0.5],
        joint_vel_radps: vec![1.5],
        ..InitialState::nominal(&model)
    };
    e.reset(0, &init).unwrap();
    let (z0, v0) = (f64::from(e.state().com_pos_m[2]), f64::from(e.state().com_vel_mps[2]));
    run(e.as_mut(), periods(config, 1.0), &[0.0], |_, _| ());
    near("speed after 1 s", f64::from(e.state().com_vel_mps[2]) - v0, -9.81, 0.01);
    // A step of dt that takes the new velocity falls g·t·dt/2 too far: 2 cm at 4 ms.
    let drop = f64::from(e.state().com_pos_m[2]) - z0 - v0;
    near("drop after 1 s", drop, -4.905, 9.81 * config.dt_s / 2.0 + 0.01);
}

/// Without gravity, the momentum of a tumbling chain stays.
pub fn tumbling_keeps_momentum(config: &EngineConfig) {
    let model = robots::tumbler();
    let mut e = engine(config, &model, 1);
    e.set_params(0, &weightless(&LaneParams::nominal(&model))).unwrap();
    let init = InitialState {
        base_z_m: Some(1.0),
        base_vel_mps: [0.3, -0.2, 0.1],
        base_angvel_radps: [1.0, 2.0, -1.5],
        joint_vel_radps: vec![2.0],
        ..InitialState::nominal(&model)
    };
    e.reset(0, &init).unwrap();
    let start = e.state().clone();
    run(e.as_mut(), periods(config, 2.0), &[0.0], |_, _| ());
    let seconds = config.control_period_s() * periods(config, 2.0) as f64;
    for i in 0..3 {
        let v = f64::from(start.com_vel_mps[i]);
        near("velocity", f64::from(e.state().com_vel_mps[i]), v, 2e-3);
        let moved = f64::from(e.state().com_pos_m[i] - start.com_pos_m[i]);
        near("way", moved, v * seconds, 0.01);
    }
}

/// A push of F for t on the torso gives the whole robot F·t/m, its torque turns the robot.
pub fn push_moves_the_mass_it_acts_on(config: &EngineConfig) {
    let model = robots::table();
    let mut e = engine(config, &model, 2);
    for lane in 0..2 {
        e.set_params(lane, &weightless(&LaneParams::nominal(&model))).unwrap();
        e.reset(lane, &InitialState { base_z_m: Some(1.0), ..InitialState::nominal(&model) })
            .unwrap();
    }
    // lane 0: 3 N along +y; lane 1: 0.05 N·m about z
    let wrenches = [0.0, 3.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.05];
    let n = periods(config, 0.1);
    for _ in 0..n {
        e.step(&[0.0; 2], &wrenches).unwrap();
    }
    let t = n as f64 * config.control_period_s();
    let s = e.state();
    // 2 kg in all
    near("speed along the push", f64::from(s.com_vel_mps[1]), 3.0 * t / 2.0, 1e-4);
    near("speed across", f64::from(s.com_vel_mps[0]), 0.0, 1e-5);
    // The wheel turns freely about the same axis, so only the table's 0.02 kg·m² turns: 0.05·0.1/0.02 = 0.25
    // rad/s
    near("spin", f64::from(s.base_angvel_radps[3 + 2]), 0.05 * t / 0.02, 1e-4);
    near("wheel stays behind", f64::from(s.joint_vel_radps[1]), -0.05 * t / 0.02, 1e-4);
    near("no drift", f64::from(s.com_vel_mps[3]), 0.0, 1e-5);
}

/// Reported velocities are the time derivatives of reported positions.
pub fn velocity_is_the_change_of_position(config: &EngineConfig) {
    let model = robots::tumbler();
    let mut e = engine(config, &model, 1);
    let init = InitialState {
        base_z_m: Some(1.0),
        base_angvel_radps: [0.5, -1.0, 0.7],
        joint_vel_radps: vec![1.0],
        ..InitialState::nominal(&model)
    };
    e.set_params(0, &weightless(&LaneParams::nominal(&model))).unwrap();
    e.reset(0, &init).unwrap();
    run(e.as_mut(), 5, &[0.0], |_, _| ());
    let a = e.state().clone();
    run(e.as_mut(), 1, &[0.0], |_, _| ());
    let b = e.state();
    let period = config.control_period_s();
    let middle = |x: f32, y: f32| 0.5 * (f64::from(x) + f64::from(y));
    for i in 0..3 {
        let moved = f64::from(b.base_pos_m[i] - a.base_pos_m[i]) / period;
        near("base", moved, middle(a.base_vel_mps[i], b.base_vel_mps[i]), 3e-3);
        let moved = f64::from(b.com_pos_m[i] - a.com_pos_m[i]) / period;
        near("centre of mass", moved, middle(a.com_vel_mps[i], b.com_vel_mps[i]), 3e-3);
    }
    let moved = f64::from(b.joint_pos_rad[0] - a.joint_pos_rad[0]) / period;
    near("joint", moved, middle(a.joint_vel_radps[0], b.joint_vel_radps[0]), 3e-3);
}

fn weightless(params: &LaneParams) -> LaneParams {
    LaneParams { gravity_mps2: [0.0; 3], ..params.clone() }
}
