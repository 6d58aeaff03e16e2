//! A lane that is put to what was measured, in the middle of its motion: what nobody can measure stays.

use std::path::Path;
use std::sync::Arc;

use caudata_model::RobotModel;
use caudata_sim::batch::BatchEngine;
use caudata_sim::{Engine, EngineConfig, InitialState, State, Terrain, TerrainConfig};

/// What of a lane can be measured.
fn measured(model: &RobotModel, state: &State, lane: usize) -> InitialState {
    let three = |x: &[f32]| [x[3 * lane], x[3 * lane + 1], x[3 * lane + 2]];
    let q = [0, 1, 2, 3].map(|i| f64::from(state.base_quat_wxyz[4 * lane + i]));
    let [w, x, y, z] = q;
    let roll = (2.0 * (w * x + y * z)).atan2(1.0 - 2.0 * (x * x + y * y));
    let pitch = (2.0 * (w * y - z * x)).asin();
    let yaw = (2.0 * (w * z + x * y)).atan2(1.0 - 2.0 * (y * y + z * z));
    let pos = three(&state.base_pos_m);
    let driven = |x: &[f32]| -> Vec<f32> {
        let of = |j: &usize| x[lane * state.joints + j];
        model.actuated().iter().map(of).collect()
    };
    InitialState {
        base_xy_m: [pos[0], pos[1]],
        base_z_m: Some(pos[2]),
        base_rpy_rad: [roll, pitch, yaw].map(|a| a as f32),
        base_vel_mps: three(&state.base_vel_mps),
        base_angvel_radps: three(&state.base_angvel_radps),
        joint_pos_rad: driven(&state.joint_pos_rad),
        joint_vel_radps: driven(&state.joint_vel_radps),
    }
}

/// Two lanes that rocked on the ground for 0.6 s, the same in both.
fn rocked() -> (Arc<RobotModel>, BatchEngine, impl Fn(usize) -> Vec<f32>) {
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("../robots/polymander.robot.toml");
    let model = Arc::new(RobotModel::load(&file).unwrap());
    let config = EngineConfig::default();
    let ground = Arc::new(Terrain::generate(&TerrainConfig::default(), 1).unwrap());
    let mut engine = BatchEngine::new(Arc::clone(&model), 2, config, ground, 1).unwrap();
    let nominal = model.nominal_pos_rad().to_vec();
    let targets = move |k: usize| -> Vec<f32> {
        let swing = 0.15 * (0.02 * k as f64).sin();
        let one = nominal.iter().map(|q| (q + swing) as f32);
        one.clone().chain(one).collect()
    };
    for k in 0..300 {
        engine.step(&targets(k), &[0.0; 12]).unwrap();
    }
    (model, engine, targets)
}

#[test]
fn its_own_measurement_changes_nothing() {
    let (model, mut engine, targets) = rocked();
    let hinges = |s: &State, lane: usize| -> Vec<f32> {
        (0..s.joints)
            .filter(|j| !model.actuated().contains(j))
            .map(|j| s.joint_pos_rad[lane * s.joints + j])
            .collect()
    };
    let before = hinges(engine.state(), 1);
    // play of 4° hangs at its stops: were it put back to the middle, the robot would drop
    assert!(before.iter().any(|q| q.abs() > 0.03), "{before:?}");
    let own = measured(&model, engine.state(), 1);
    engine.correct(1, &own).unwrap();
    assert_eq!(hinges(engine.state(), 1), before);
    for k in 300..350 {
        engine.step(&targets(k), &[0.0; 12]).unwrap();
    }
    let s = engine.state();
    let (one, other) = s.joint_pos_rad.split_at(s.joints);
    for (j, (a, b)) in one.iter().zip(other).enumerate() {
        assert!((a - b).abs() < 1e-3, "hinge {j}: {a} and {b}");
    }
    for (a, b) in s.base_pos_m[..3].iter().zip(&s.base_pos_m[3..]) {
        assert!((a - b).abs() < 5e-4, "base: {a} and {b}");
    }
}

#[test]
fn what_was_measured_is_taken_over_and_the_other_lane_goes_on() {
    let (model, mut engine, _) = rocked();
    let other = measured(&model, engine.state(), 0);
    let mut to = measured(&model, engine.state(), 1);
    to.joint_pos_rad[3] += 0.1;
    to.joint_vel_radps[3] = 0.5;
    to.base_xy_m[0] += 0.2;
    engine.correct(1, &to).unwrap();
    let s = engine.state();
    let at = s.joints + model.actuated()[3];
    assert!((s.joint_pos_rad[at] - to.joint_pos_rad[3]).abs() < 1e-6);
    assert!((s.joint_vel_radps[at] - 0.5).abs() < 1e-6);
    assert!((s.base_pos_m[3] - to.base_xy_m[0]).abs() < 1e-6);
    assert_eq!(measured(&model, s, 0), other);
    assert!(engine.correct(2, &to).is_err());
}
