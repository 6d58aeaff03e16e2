//! A report of less than everything: the same bits, and nothing else moves.

use std::sync::Arc;

use caudata_sim::batch::{BatchEngine, Readout};
use caudata_sim::{Engine, EngineConfig, InitialState, State, Terrain, TerrainConfig};

use crate::conformance::robots;

/// Steps of 2 ms that are reported one by one.
const STEPS: usize = 60;

fn engine(substeps: u32) -> BatchEngine {
    let config = EngineConfig { substeps, ..EngineConfig::default() };
    let terrain = Terrain::generate(&TerrainConfig::default(), 1).unwrap();
    let model = robots::polymander();
    BatchEngine::new(model, 3, config, Arc::new(terrain), 1).unwrap()
}

fn walk(engine: &mut BatchEngine, step: usize) {
    let nominal = engine.model().nominal_pos_rad().to_vec();
    let mut targets = Vec::new();
    for lane in 0..engine.lanes() {
        let swing = 0.3 * (0.1 * step as f64 + lane as f64).sin();
        targets.extend(nominal.iter().map(|q| (q + swing) as f32));
    }
    let wrenches = vec![0.0; 6 * engine.lanes()];
    engine.step(&targets, &wrenches).unwrap();
}

fn base(state: &State) -> [&[f32]; 4] {
    [&state.base_pos_m, &state.base_quat_wxyz, &state.base_vel_mps, &state.base_angvel_radps]
}

fn imu(state: &State) -> [&[f32]; 3] {
    [&state.imu_gyro_radps, &state.imu_acc_mps2, &state.imu_gravity]
}

#[test]
fn what_is_read_out_is_the_same_and_the_rest_stays() {
    let joints = Readout::JOINTS;
    for readout in [
        joints,
        Readout { base: true, ..joints },
        Readout { imu: true, ..joints },
        Readout { feet: true, ..joints },
        Readout { rest: true, ..joints },
        Readout { rest: false, ..Readout::ALL },
    ] {
        let (mut whole, mut part) = (engine(1), engine(1));
        let start = part.state().clone();
        part.report_only(readout);
        for step in 0..STEPS {
            walk(&mut whole, step);
            walk(&mut part, step);
            let (all, some) = (whole.state(), part.state());
            let or_start = |on: bool| if on { all } else { &start };
            assert_eq!(some.joint_pos_rad, all.joint_pos_rad, "{readout:?} {step}");
            assert_eq!(some.joint_vel_radps, all.joint_vel_radps);
            assert_eq!(some.motor_torque_nm, all.motor_torque_nm);
            assert_eq!(base(some), base(or_start(readout.base)), "{readout:?} {step}");
            assert_eq!(imu(some), imu(or_start(readout.imu)), "{readout:?} {step}");
            assert_eq!(some.foot_pos_m, or_start(readout.feet).foot_pos_m);
            assert_eq!(some.foot_vel_mps, or_start(readout.rest).foot_vel_mps);
            assert_eq!(some.foot_height_m, or_start(readout.rest).foot_height_m);
            assert_eq!(some.foot_force_n, or_start(readout.rest).foot_force_n);
            assert_eq!(some.com_angvel_radps, or_start(readout.rest).com_angvel_radps);
            assert_eq!(some.heading_rad, or_start(readout.rest).heading_rad);
            assert_eq!(some.mech_power_w, or_start(readout.rest).mech_power_w);
        }
    }
}

#[test]
fn a_reset_reports_everything_and_the_imu_goes_on_from_it() {
    let (mut whole, mut part) = (engine(2), engine(2));
    part.report_only(Readout::JOINTS);
    for step in 0..STEPS {
        walk(&mut whole, step);
        walk(&mut part, step);
    }
    part.report_only(Readout::ALL);
    let init = InitialState::nominal(whole.model());
    for lane in 0..whole.lanes() {
        whole.reset(lane, &init).unwrap();
        part.reset(lane, &init).unwrap();
    }
    assert_eq!(part.state(), whole.state());
    for step in 0..3 {
        walk(&mut whole, step);
        walk(&mut part, step);
        assert_eq!(part.state(), whole.state());
    }
}
