//! What the state reports: IMU, heading, whole-body motion.

use caudata_sim::{EngineConfig, InitialState, LaneParams};

use crate::conformance::{engine, near, periods, robots, run};

fn vector(field: &[f32]) -> [f64; 3] {
    [f64::from(field[0]), f64::from(field[1]), f64::from(field[2])]
}

/// At rest and level the IMU feels +9.81 along z and sees gravity along −z; in free fall it feels nothing.
pub fn imu_at_rest_and_in_fall(config: &EngineConfig) {
    let model = robots::table();
    let mut e = engine(config, &model, 2);
    near("after a reset", f64::from(e.state().imu_acc_mps2[2]), 9.81, 1e-5);
    e.reset(
        1,
        &InitialState {
            base_z_m: Some(20.0),
            base_rpy_rad: [0.4, -0.3, 1.0],
            ..InitialState::nominal(&model)
        },
    )
    .unwrap();
    let before = e.state().imu_gravity[3..].to_vec();
    run(e.as_mut(), periods(config, 0.5), &[0.0; 2], |_, _| ());
    let s = e.state();
    near("rest", f64::from(s.imu_acc_mps2[2]), 9.81, 0.02);
    near(
        "rest, across",
        f64::from(s.imu_acc_mps2[0]).hypot(f64::from(s.imu_acc_mps2[1])),
        0.0,
        0.02,
    );
    assert_eq!(s.imu_gravity[2], -1.0);
    for a in vector(&s.imu_acc_mps2[3..]) {
        near("fall", a, 0.0, 0.02);
    }
    // Rz(yaw)·Ry(pitch)·Rx(roll): gravity in the body is (sin p, −cos p·sin r, −cos p·cos r) with p = −0.3, r
    // = 0.4
    let (p, r) = (-0.3_f64, 0.4_f64);
    let want = [p.sin(), -p.cos() * r.sin(), -p.cos() * r.cos()];
    for (got, want) in before.iter().zip(want) {
        near("gravity direction", f64::from(*got), want, 1e-6);
    }
}

/// Spun about its own z at 2 rad/s in free flight, the gyro reads it, the IMU 5 cm off the axis feels ω²·r
/// inwards: the centre of mass is on the axis, so −2²·0.05 = −0.2 m/s² along x.
pub fn gyro_follows_rotation(config: &EngineConfig) {
    let model = robots::table();
    let mut e = engine(config, &model, 1);
    e.set_params(0, &LaneParams { gravity_mps2: [0.0; 3], ..LaneParams::nominal(&model) }).unwrap();
    let spun = InitialState {
        base_z_m: Some(5.0),
        base_rpy_rad: [0.5, 0.2, -0.7],
        base_angvel_radps: [0.0, 0.0, 2.0],
        ..InitialState::nominal(&model)
    };
    e.reset(0, &spun).unwrap();
    run(e.as_mut(), 5, &[0.0], |_, _| ());
    let s = e.state();
    for (got, want) in vector(&s.imu_gyro_radps).iter().zip([0.0, 0.0, 2.0]) {
        near("gyro", *got, want, 2e-3);
    }
    // the mean over a period lags half a period: 0.02 rad of turn, 0.004 m/s² across
    for (got, want) in vector(&s.imu_acc_mps2).iter().zip([-0.2, 0.0, 0.0]) {
        near("centripetal", *got, want, 0.01);
    }
}

/// The Polymander's heading is its girdle line's yaw, whatever its neck does.
pub fn heading_is_the_girdle_line(config: &EngineConfig) {
    let model = robots::polymander();
    let mut e = engine(config, &model, 1);
    for (yaw, want) in [(0.7_f32, 0.7), (-3.0, -3.0), (4.0, 4.0 - std::f64::consts::TAU)] {
        e.reset(
            0,
            &InitialState { base_rpy_rad: [0.0, 0.0, yaw], ..InitialState::nominal(&model) },
        )
        .unwrap();
        near("straight", f64::from(e.state().heading_rad[0]), want, 1e-5);
    }
    // The neck (spine_1) bent by 0.5: the trunk then points 0.5 to the other side or the same, exactly.
    let mut bent = InitialState::nominal(&model);
    bent.joint_pos_rad[0] = 0.5;
    e.reset(0, &bent).unwrap();
    near("bent neck", f64::from(e.state().heading_rad[0]), 0.5, 1e-5);
}

/// A rigid robot that rotates and moves reports that rotation as its whole-body one; a wheel spinning alone
/// adds its momentum.
pub fn whole_body_spin(config: &EngineConfig) {
    let model = robots::table();
    let mut e = engine(config, &model, 1);
    let moving = InitialState {
        base_z_m: Some(5.0),
        base_vel_mps: [0.3, 0.1, -0.2],
        base_angvel_radps: [0.4, -0.3, 0.8],
        ..InitialState::nominal(&model)
    };
    e.reset(0, &moving).unwrap();
    for (got, want) in vector(&e.state().com_angvel_radps).iter().zip([0.4, -0.3, 0.8]) {
        near("rigid", *got, want, 1e-6);
    }
    // centre of mass 1 cm up: v + ω × (0, 0, 0.01) = (0.3 − 0.003, 0.1 − 0.004, −0.2)
    for (got, want) in vector(&e.state().com_vel_mps).iter().zip([0.297, 0.096, -0.2]) {
        near("velocity", *got, want, 1e-6);
    }
    // wheel alone at 11 rad/s: L = 0.002·11 over I = 0.022 → 1 rad/s
    let wheel = InitialState {
        base_z_m: Some(5.0),
        joint_vel_radps: vec![11.0],
        ..InitialState::nominal(&model)
    };
    e.reset(0, &wheel).unwrap();
    near("wheel", f64::from(e.state().com_angvel_radps[2]), 1.0, 1e-6);
}
