//! Every lane parameter does what it says.

use caudata_sim::{EngineConfig, InitialState, LaneParams, SimError};

use crate::conformance::{engine, near, nominal_targets, periods, robots, run};

/// One lane per parameter, changed; lane 0 is nominal. Each must move its own observable, in its own
/// direction. (Delay, friction of joints, armature, damping, torque limit and play have tests of their own
/// with numbers.)
pub fn each_parameter_acts(config: &EngineConfig) {
    let model = robots::table();
    let nominal = LaneParams {
        kp_nm_per_rad: vec![2.0],
        kd_nms_per_rad: vec![0.05],
        ..LaneParams::nominal(&model)
    };
    let changed: [(&str, LaneParams); 7] = [
        ("nominal", nominal.clone()),
        ("mass", LaneParams { link_mass_scale: vec![1.5, 1.0], ..nominal.clone() }),
        ("com", LaneParams { com_offset_m: vec![[0.02, 0.0, 0.0], [0.0; 3]], ..nominal.clone() }),
        ("gravity", LaneParams { gravity_mps2: [0.0, 0.0, -1.62], ..nominal.clone() }),
        ("foot friction", LaneParams { foot_friction: 0.05, ..nominal.clone() }),
        ("kp", LaneParams { kp_nm_per_rad: vec![0.5], ..nominal.clone() }),
        ("kd", LaneParams { kd_nms_per_rad: vec![0.5], ..nominal.clone() }),
    ];
    let lanes = changed.len();
    let mut e = engine(config, &model, lanes);
    for (lane, (_, params)) in changed.iter().enumerate() {
        e.set_params(lane, params).unwrap();
        e.reset(
            lane,
            &InitialState { base_vel_mps: [0.3, 0.0, 0.0], ..InitialState::nominal(&model) },
        )
        .unwrap();
    }
    let mut wheel_at_60_ms = vec![0.0; lanes];
    let three = periods(config, 0.06);
    run(e.as_mut(), periods(config, 1.0), &vec![0.5; lanes], |k, e| {
        if k + 1 == three {
            wheel_at_60_ms = e.state().joint_pos_rad.iter().map(|&q| f64::from(q)).collect();
        }
    });
    let s = e.state();
    let weight = |lane: usize| -> f64 {
        s.foot_force_n[12 * lane..12 * lane + 12].chunks(3).map(|f| f64::from(f[2])).sum()
    };
    near("nominal weight", weight(0), 19.62, 0.1);
    // 1.9·1.5 + 0.1 = 2.95 kg
    near("scaled weight", weight(1), 2.95 * 9.81, 0.1);
    near("weight on the moon", weight(3), 2.0 * 1.62, 0.1);
    // 1.9 kg moved 2 cm towards the front feet, which are 0.2 m before the hind ones: front share 0.5 +
    // 1.9·0.02/(2·0.2) = 0.595
    let front: f64 = s.foot_force_n[24..30].chunks(3).map(|f| f64::from(f[2])).sum();
    near("front share", front / weight(2), 0.595, 0.01);
    // 0.3²/(2·0.5·9.81) = 9 mm against ten times that
    let way = |lane: usize| f64::from(s.base_pos_m[3 * lane]);
    near("way", way(0), 0.0092, 0.004);
    near("way on ice", way(4), 0.092, 0.01);
    assert!(
        wheel_at_60_ms[5] < 0.5 * wheel_at_60_ms[0],
        "a quarter of the gain is slower: {wheel_at_60_ms:?}"
    );
    assert!(
        wheel_at_60_ms[6] < 0.5 * wheel_at_60_ms[0],
        "ten times the damping is slower: {wheel_at_60_ms:?}"
    );

    // Body friction and supply voltage show on the Polymander: belly down on a slide; a fast swing of the
    // tail in the air.
    let model = robots::polymander();
    let nominal = LaneParams::nominal(&model);
    let mut e = engine(config, &model, 2);
    let legs_up: Vec<f32> = model
        .actuated_names()
        .iter()
        .map(|n| if n.ends_with("knee") { -1.2 } else { 0.0 })
        .collect();
    for (lane, friction) in [(0, 0.3), (1, 0.03)] {
        e.set_params(
            lane,
            &LaneParams { body_friction: friction, foot_friction: friction, ..nominal.clone() },
        )
        .unwrap();
        let init = InitialState {
            base_vel_mps: [0.5, 0.0, 0.0],
            joint_pos_rad: legs_up.clone(),
            ..InitialState::nominal(&model)
        };
        e.reset(lane, &init).unwrap();
    }
    let start = [e.state().com_pos_m[0], e.state().com_pos_m[3]];
    run(e.as_mut(), periods(config, 1.0), &legs_up.repeat(2), |_, _| ());
    let slid = [e.state().com_pos_m[0] - start[0], e.state().com_pos_m[3] - start[1]];
    assert!(slid[1] > 2.0 * slid[0] && slid[0] > 0.01, "slides by {slid:?}");

    let held = EngineConfig { fixed_base: true, ..config.clone() };
    let mut e = engine(&held, &model, 2);
    e.set_params(1, &LaneParams { supply_v: 6.0, ..nominal }).unwrap();
    let mut targets = nominal_targets(&model, 1);
    targets[13] -= 1.5; // HL_knee
    let j = model.actuated()[13];
    let mut fastest = [0.0_f32; 2];
    run(e.as_mut(), periods(config, 0.5), &targets.repeat(2), |_, e| {
        for (lane, most) in fastest.iter_mut().enumerate() {
            *most = most.max(e.state().joint_vel_radps[lane * model.joints().len() + j].abs());
        }
    });
    assert!(fastest[1] < 0.8 * fastest[0], "6 V reaches {fastest:?} rad/s");
}

/// Twice the inertia turns half as fast under the same torque; a payload of 0.5 kg at the front feet weighs
/// on them; a floor that rises by 0.1 rad towards +x makes it slide back where friction is below tan 0.1;
/// slippery left feet turn it while it slides.
pub fn inertia_payload_tilt_and_feet_act(config: &EngineConfig) {
    let model = robots::wheels();
    let push = |scale: f32| {
        let mut p = LaneParams {
            kp_nm_per_rad: vec![15.0; 2],
            torque_scale: vec![0.001; 2],
            ..LaneParams::nominal(&model)
        };
        p.link_inertia_scale = vec![scale; 3];
        p
    };
    let mut e = engine(config, &model, 2);
    for (lane, scale) in [(0, 1.0), (1, 2.0)] {
        e.set_params(lane, &push(scale)).unwrap();
        e.reset(lane, &InitialState::nominal(&model)).unwrap();
    }
    run(e.as_mut(), periods(config, 1.0), &[900.0; 4], |_, _| ());
    // 0.01 N·m on 0.01 and 0.02 kg·m²
    let speed = |i: usize| f64::from(e.state().joint_vel_radps[i]);
    near("nominal", speed(0), 1.0, 0.01);
    near("heavy", speed(2), 0.5, 0.01);

    let model = robots::table();
    let loaded =
        LaneParams { payload_kg: 0.5, payload_m: [0.1, 0.0, 0.0], ..LaneParams::nominal(&model) };
    let mut tilted = LaneParams { foot_friction: 0.05, ..LaneParams::nominal(&model) };
    tilted.tilt_floor(0.0, 0.1);
    let uneven =
        LaneParams { foot_friction_scale: vec![0.1, 1.0, 0.1, 1.0], ..LaneParams::nominal(&model) };
    let mut e = engine(config, &model, 3);
    for (lane, (params, speed)) in [(loaded, 0.0), (tilted, 0.0), (uneven, 0.5)].iter().enumerate()
    {
        e.set_params(lane, params).unwrap();
        let init =
            InitialState { base_vel_mps: [*speed, 0.0, 0.0], ..InitialState::nominal(&model) };
        e.reset(lane, &init).unwrap();
    }
    run(e.as_mut(), periods(config, 1.0), &[0.0; 3], |_, _| ());
    let s = e.state();
    let on = |feet: std::ops::Range<usize>| -> f64 {
        feet.map(|f| f64::from(s.foot_force_n[3 * f + 2])).sum()
    };
    near("all feet", on(0..4), 2.5 * 9.81, 0.1);
    near("front feet", on(0..2), (1.0 + 0.5) * 9.81, 0.1);
    // (sin 0.1 − 0.05·cos 0.1)·9.81 = 0.4913 m/s²
    near("slides", f64::from(s.base_vel_mps[3]), -0.4913, 0.02);
    assert!(s.heading_rad[2] < -0.1, "the right feet hold it back: {}", s.heading_rad[2]);
}

/// A change of one value.
type Change = fn(&mut LaneParams);

/// Each refusal says which value, and leaves the parameters as they were.
pub fn refuses_bad_values(config: &EngineConfig) {
    let model = robots::polymander();
    let mut e = engine(config, &model, 2);
    let good = LaneParams::nominal(&model);
    let bad: [(&str, Change); 18] = [
        ("foot_friction", |p| p.foot_friction = f32::NAN),
        ("foot_friction_scale", |p| p.foot_friction_scale.truncate(3)),
        ("supply_v", |p| p.supply_v = 0.0),
        ("supply_resistance_ohm", |p| p.supply_resistance_ohm = -0.1),
        ("command_delay_s", |p| p.command_delay_s = 0.2),
        ("command_loss.share", |p| p.command_loss.share = 1.0),
        ("link_mass_scale", |p| p.link_mass_scale = vec![1.0]),
        ("link_inertia_scale", |p| p.link_inertia_scale[3] = 0.0),
        ("payload_kg", |p| p.payload_kg = -1.0),
        ("kp_nm_per_rad", |p| p.kp_nm_per_rad = vec![-1.0; 16]),
        ("backlash_half_width_rad", |p| p.backlash_half_width_rad.clear()),
        ("joints", |p| p.joints.truncate(15)),
        ("dead_band_rad", |p| p.joints[7].dead_band_rad = -0.01),
        ("high_rad", |p| p.joints[7].high_rad = p.joints[7].low_rad - 0.1),
        ("joint_armature_kgm2", |p| {
            p.joints[2].gear_half_gap_rad = 0.002;
            p.joint_armature_kgm2[2] = 0.0;
        }),
        ("friction_nm", |p| p.hinges[0].friction_nm = f32::INFINITY),
        ("added_mass_y", |p| p.water[5].added_mass_y = -1.0),
        ("water_current_mps", |p| p.water_current_mps[1] = f32::NAN),
    ];
    for (name, change) in bad {
        let mut params = good.clone();
        change(&mut params);
        let message = e.set_params(1, &params).unwrap_err().to_string();
        assert!(message.starts_with(name), "{message}");
    }
    assert_eq!(e.params(1), &good);
    assert!(matches!(e.set_params(2, &good), Err(SimError::Lane { lane: 2, lanes: 2 })));
    let far = InitialState { base_xy_m: [f32::INFINITY, 0.0], ..InitialState::nominal(&model) };
    assert!(e.reset(0, &far).unwrap_err().to_string().starts_with("base_xy_m"));
}

/// Set in the middle of a motion, parameters act from the next step on and the motion goes on from where it
/// is.
pub fn set_params_acts_at_once(config: &EngineConfig) {
    let model = robots::tumbler();
    let mut e = engine(config, &model, 1);
    let init = InitialState {
        base_z_m: Some(3.0),
        base_vel_mps: [0.5, 0.2, 0.0],
        base_angvel_radps: [0.3, 0.2, 0.6],
        joint_vel_radps: vec![0.7],
        ..InitialState::nominal(&model)
    };
    e.set_params(0, &LaneParams { gravity_mps2: [0.0; 3], ..LaneParams::nominal(&model) }).unwrap();
    e.reset(0, &init).unwrap();
    run(e.as_mut(), 10, &[0.0], |_, _| ());
    let before = e.state().clone();
    e.set_params(0, &LaneParams::nominal(&model)).unwrap();
    assert_eq!(e.params(0), &LaneParams::nominal(&model));
    assert_eq!(e.state(), &before);
    run(e.as_mut(), 1, &[0.0], |_, _| ());
    let (s, period) = (e.state(), config.control_period_s());
    near("falls now", f64::from(s.com_vel_mps[2] - before.com_vel_mps[2]), -9.81 * period, 2e-3);
    near("goes on", f64::from(s.com_vel_mps[0]), f64::from(before.com_vel_mps[0]), 2e-3);
    near(
        "joint goes on",
        f64::from(s.joint_pos_rad[0]),
        f64::from(before.joint_pos_rad[0]) + 0.7 * period,
        0.02,
    );
}
