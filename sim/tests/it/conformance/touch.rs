//! Contact: weight, friction, impact, slopes. On the table of `robots`: 2 kg on four balls, friction 0.5.

use std::sync::Arc;

use caudata_model::RobotModel;
use caudata_sim::{
    Engine, EngineConfig, InitialState, LaneParams, TerrainConfig, TerrainKind, build,
};

use crate::conformance::{engine, near, periods, robots, run};

const WEIGHT_N: f64 = 2.0 * 9.81;

fn settled(config: &EngineConfig, model: &Arc<RobotModel>) -> Box<dyn Engine> {
    let mut e = engine(config, model, 1);
    run(e.as_mut(), periods(config, 0.5), &[0.0], |_, _| ());
    e
}

fn force_sum(e: &dyn Engine, axis: usize) -> f64 {
    e.state().foot_force_n.chunks(3).map(|f| f64::from(f[axis])).sum()
}

/// Started at 1 m/s it slides v²/(2·μ·g) = 1/(2·0.5·9.81) = 0.1019 m; while it slides, the ground pulls back
/// with μ·m·g. On a plane, and over the cells of a height field that is as level.
pub fn sliding_stops_by_friction(config: &EngineConfig) {
    let field = TerrainConfig { patch_share: 0.0, ..TerrainConfig::of(TerrainKind::Slippery) };
    for ground in [TerrainConfig::default(), field] {
        slide_on(config, &ground);
    }
}

fn slide_on(config: &EngineConfig, ground: &TerrainConfig) {
    let model = robots::table();
    let mut e = build(model.clone(), 1, config, ground, 1, 1).unwrap();
    e.reset(0, &InitialState { base_vel_mps: [0.6, 0.8, 0.0], ..InitialState::nominal(&model) })
        .unwrap();
    let mut pull = Vec::new();
    run(e.as_mut(), periods(config, 1.0), &[0.0], |k, e| {
        if (2..6).contains(&k) {
            pull.push([force_sum(e, 0), force_sum(e, 1)]);
        }
    });
    let s = e.state();
    let slid = f64::from(s.base_pos_m[0]).hypot(f64::from(s.base_pos_m[1]));
    near("way", slid, 0.1019, 0.006);
    near("straight", f64::from(s.base_pos_m[1] / s.base_pos_m[0]), 0.8 / 0.6, 0.05);
    for [x, y] in pull {
        near("friction along x", x, -0.6 * 0.5 * WEIGHT_N, 0.4);
        near("friction along y", y, -0.8 * 0.5 * WEIGHT_N, 0.4);
    }
    near("stopped", f64::from(s.com_vel_mps[0]).hypot(f64::from(s.com_vel_mps[1])), 0.0, 1e-3);
}

/// The limit is μ·m·g = 9.81 N: 8 N do not move it (creep below 2 mm/s), 12 N do, with (12 − 9.81)/2 = 1.095
/// m/s².
pub fn friction_holds_below_its_limit(config: &EngineConfig) {
    let model = robots::table();
    for (push, acceleration) in [(8.0_f32, 0.0), (12.0, 1.095)] {
        let mut e = settled(config, &model);
        let start = f64::from(e.state().com_pos_m[0]);
        let n = periods(config, 1.0);
        for _ in 0..n {
            e.step(&[0.0], &[push, 0.0, 0.0, 0.0, 0.0, 0.0]).unwrap();
        }
        let moved = f64::from(e.state().com_pos_m[0]) - start;
        near("way under a push", moved, 0.5 * acceleration, 0.002 + 0.08 * acceleration);
        if acceleration == 0.0 {
            near("pull", force_sum(e.as_ref(), 0), -f64::from(push), 0.1);
        }
    }
}

/// Pushed with 1 N for 1 s, 2.4 kg on wheels that count as 4·1.25e-4/0.05² = 0.2 kg more come by ½·t²/2.6 = 0.1923
/// m and to 0.3846 m/s; then they roll on, and the axles stay at one height (of a wheel of 16 corners they would go up
/// and down by 1 mm).
pub fn a_wheel_rolls_level(config: &EngineConfig) {
    let model = robots::cart();
    let mut e = engine(config, &model, 1);
    run(e.as_mut(), periods(config, 0.5), &[0.0; 4], |_, _| ());
    let second = periods(config, 1.0);
    let pushed_s = second as f64 * config.control_period_s();
    let (start, axle) = (f64::from(e.state().com_pos_m[0]), f64::from(e.state().com_pos_m[2]));
    for push in [1.0, 0.0] {
        for _ in 0..second {
            e.step(&[0.0; 4], &[push, 0.0, 0.0, 0.0, 0.0, 0.0]).unwrap();
            near("height of the axles", f64::from(e.state().com_pos_m[2]), axle, 5e-5);
        }
        let speed = f64::from(e.state().com_vel_mps[0]);
        near("speed", speed, pushed_s / 2.6, 0.002);
    }
    let way = f64::from(e.state().com_pos_m[0]) - start;
    near("way", way, 1.5 * pushed_s * pushed_s / 2.6, 0.003);
}

/// A riser of 2 cm on a cell of 2 cm, its foot at x = −0.40 m, is a slope of 45°, which a wheel of r = 5 cm meets where
/// its axle is r·tan 22.5° = 2.1 cm before the foot. Pushed with 0.3 N the cart stays there: up such a slope takes 13.
pub fn a_wheel_stops_at_a_riser(config: &EngineConfig) {
    let model = robots::cart();
    let ground = TerrainConfig {
        step_length_m: 0.8,
        height_m: 0.02,
        cell_m: 0.02,
        ..TerrainConfig::of(TerrainKind::Steps)
    };
    let mut e = build(model.clone(), 1, config, &ground, 1, 1).unwrap();
    e.reset(0, &InitialState { base_xy_m: [-0.26, 0.0], ..InitialState::nominal(&model) }).unwrap();
    run(e.as_mut(), periods(config, 0.5), &[0.0; 4], |_, _| ());
    let height = f64::from(e.state().com_pos_m[2]);
    for _ in 0..periods(config, 4.0) {
        e.step(&[0.0; 4], &[-0.3, 0.0, 0.0, 0.0, 0.0, 0.0]).unwrap();
    }
    near("axle behind the foot", f64::from(e.state().base_pos_m[0]) - 0.1, -0.4 + 0.0207, 0.004);
    near("height", f64::from(e.state().com_pos_m[2]), height, 0.002);
}

/// At rest the feet carry 19.62 N, each a quarter, straight up; nothing touches but the feet.
pub fn contact_force_carries_the_weight(config: &EngineConfig) {
    let model = robots::table();
    let e = settled(config, &model);
    let s = e.state();
    near("weight", force_sum(e.as_ref(), 2), WEIGHT_N, 0.05);
    for foot in s.foot_force_n.chunks(3) {
        near("a quarter", f64::from(foot[2]), WEIGHT_N / 4.0, 0.05);
    }
    near(
        "no side force in all",
        force_sum(e.as_ref(), 0).hypot(force_sum(e.as_ref(), 1)),
        0.0,
        0.02,
    );
    assert_eq!(s.trunk_force_n, [0.0]);
    for &h in &s.foot_height_m {
        near("foot height", f64::from(h), 0.0, 1.5e-3);
    }
}

/// Dropped from 0.1 m: the feet's forces minus the weight, integrated, are the momentum taken away,
/// m·√(2·g·h) and more.
pub fn landing_gives_the_momentum_back(config: &EngineConfig) {
    let model = robots::table();
    let mut e = engine(config, &model, 1);
    e.reset(0, &InitialState { base_z_m: Some(0.12), ..InitialState::nominal(&model) }).unwrap();
    let (mut impulse, mut fastest) = (0.0, 0.0_f64);
    let n = periods(config, 1.0);
    run(e.as_mut(), n, &[0.0], |_, e| {
        impulse += force_sum(e, 2) * config.control_period_s();
        fastest = fastest.min(f64::from(e.state().com_vel_mps[2]));
    });
    // Seen at the end of a control period only: within g·20 ms of √(2·9.81·0.1) = 1.4007 m/s.
    assert!((-1.41..-1.2).contains(&fastest), "fell at {fastest} m/s");
    // Rest at the start and the end: the impulse of the ground is the weight's over the whole time.
    near("impulse", impulse, WEIGHT_N * n as f64 * config.control_period_s(), 0.05);
    near("at rest", f64::from(e.state().com_vel_mps[2]), 0.0, 2e-3);
}

/// On a wall of 15° with friction 0.5 (more than tan 15° = 0.268) it stays where it is put, feet on the
/// ground.
pub fn rests_on_a_slope(config: &EngineConfig) {
    let model = robots::table();
    let valley = TerrainConfig { kind: TerrainKind::Valley, ..TerrainConfig::default() };
    let mut e = build(model.clone(), 2, config, &valley, 1, 1).unwrap();
    let slope = 15.0_f32.to_radians();
    // at y = 2.03 the wall rises towards +y: roll the table by +15° to fit it
    let on_wall = InitialState {
        base_xy_m: [1.02, 2.03],
        base_rpy_rad: [slope, 0.0, 0.0],
        ..InitialState::nominal(&model)
    };
    e.reset(0, &on_wall).unwrap();
    e.set_params(1, &LaneParams { foot_friction: 0.1, ..LaneParams::nominal(&model) }).unwrap();
    e.reset(1, &on_wall).unwrap();
    run(e.as_mut(), periods(config, 0.5), &[0.0; 2], |_, _| ());
    let start = f64::from(e.state().com_pos_m[1]);
    let slippery = f64::from(e.state().com_pos_m[4]);
    run(e.as_mut(), periods(config, 1.0), &[0.0; 2], |_, _| ());
    let s = e.state();
    near("stays", f64::from(s.com_pos_m[1]), start, 0.004);
    assert!(slippery - f64::from(s.com_pos_m[4]) > 0.2, "slides down with friction 0.1");
    // A ball touching a slope stands r·(1/cos 15° − 1) = 0.7 mm over the ground straight below it.
    for &h in &s.foot_height_m[..4] {
        near("foot height", f64::from(h), 0.02 * (1.0 / 15.0_f64.to_radians().cos() - 1.0), 1.5e-3);
    }
    near("weight", force_sum(e.as_ref(), 2).abs() - slippery_share(e.as_ref()), WEIGHT_N, 0.3);
}

/// Vertical foot force of lane 1.
fn slippery_share(e: &dyn Engine) -> f64 {
    e.state().foot_force_n[12..].chunks(3).map(|f| f64::from(f[2])).sum()
}

/// Gravity leans by 15° (tan 0.268) over ground whose every patch has the factor 0.5: friction 0.6 counts as
/// 0.3 and holds, 0.45 counts as 0.225 and slides, with g·(sin 15° − 0.225·cos 15°) = 0.407 m/s².
pub fn slippery_patches_scale_friction(config: &EngineConfig) {
    let model = robots::table();
    let ice = TerrainConfig {
        patch_share: 1.0,
        patch_friction: 0.5,
        ..TerrainConfig::of(TerrainKind::Slippery)
    };
    let mut e = build(model.clone(), 2, config, &ice, 1, 1).unwrap();
    let lean = 15.0_f32.to_radians();
    for (lane, foot_friction) in [(0, 0.6), (1, 0.45)] {
        let params = LaneParams {
            gravity_mps2: [9.81 * lean.sin(), 0.0, -9.81 * lean.cos()],
            foot_friction,
            ..LaneParams::nominal(&model)
        };
        e.set_params(lane, &params).unwrap();
        e.reset(lane, &InitialState::nominal(&model)).unwrap();
    }
    run(e.as_mut(), periods(config, 1.0), &[0.0; 2], |_, _| ());
    let start = [e.state().com_pos_m[0], e.state().com_pos_m[3]].map(f64::from);
    run(e.as_mut(), periods(config, 1.0), &[0.0; 2], |_, _| ());
    let s = e.state();
    near("holds", f64::from(s.com_pos_m[0]), start[0], 0.004);
    let slid = f64::from(s.com_pos_m[3]) - start[1];
    // ½·0.407·(2² − 1²) = 0.61 m after a second of speeding up
    near("slides", slid, 0.61, 0.06);
}

/// Two legs swung towards each other: their feet (radius 3 cm, 0.15 m out, hips 0.2 m apart) meet at
/// asin(0.07/0.15) = 0.4855 rad and press with what 15 N·m/rad give on a lever of 0.15·cos 0.4855 = 0.1327 m:
/// told to go to 0.6 rad, 12.9 N. Without self-collision they pass each other by.
pub fn legs_stop_each_other(config: &EngineConfig) {
    let model = robots::scissors();
    for touches in [true, false] {
        let config = EngineConfig { self_collision: touches, ..config.clone() };
        let mut e = engine(&config, &model, 1);
        let params = LaneParams {
            kp_nm_per_rad: vec![15.0; 2],
            kd_nms_per_rad: vec![0.3; 2],
            joint_armature_kgm2: vec![0.0022; 2],
            ..LaneParams::nominal(&model)
        };
        e.set_params(0, &params).unwrap();
        e.reset(0, &InitialState::nominal(&model)).unwrap();
        run(e.as_mut(), periods(&config, 3.0), &[-0.6, 0.6], |_, _| ());
        let s = e.state();
        let swung = f64::from(s.joint_pos_rad[1]);
        near("the same way", -f64::from(s.joint_pos_rad[0]), swung, 0.01);
        if touches {
            near("angle", swung, 0.4855, 0.02);
            let want = 15.0 * (0.6 - swung) / (0.15 * swung.cos());
            near("on the left foot", f64::from(s.foot_force_n[1]), want, 0.5);
            near("on the right foot", f64::from(s.foot_force_n[4]), -want, 0.5);
        } else {
            near("angle", swung, 0.6, 1e-3);
            assert!(s.foot_force_n.iter().all(|&f| f == 0.0));
        }
        assert_eq!(s.trunk_force_n, [0.0]);
    }
}
