//! The robot itself: stance, joint signs, play, gait.

use std::f64::consts::TAU;

use caudata_model::RobotModel;
use caudata_sim::{
    Engine, EngineConfig, EngineKind, InitialState, LaneParams, TerrainConfig, TerrainKind, build,
};

use crate::conformance::{engine, near, nominal_targets, periods, robots, run};

/// Two seconds in the nominal pose: it settles on feet and tail, stands still, and the ground carries exactly
/// its weight.
pub fn stands_still(config: &EngineConfig) {
    let model = robots::polymander();
    let mut e = engine(config, &model, 1);
    let targets = nominal_targets(&model, 1);
    run(e.as_mut(), periods(config, 1.0), &targets, |_, _| ());
    let settled = f64::from(e.state().base_pos_m[2]);
    let (mut feet, mut trunk, mut tail) = (0.0, 0.0, 0.0);
    let n = periods(config, 1.0);
    run(e.as_mut(), n, &targets, |_, e| {
        let s = e.state();
        near("base height", f64::from(s.base_pos_m[2]), settled, 1e-3);
        feet += s.foot_force_n.chunks(3).map(|f| f64::from(f[2])).sum::<f64>() / n as f64;
        trunk += f64::from(s.trunk_force_n[0]) / n as f64;
        tail += f64::from(s.tail_force_n[0]) / n as f64;
    });
    let weight = model.total_mass_kg() * 9.81;
    near("feet and tail", feet + tail, weight, 0.02 * weight);
    assert_eq!(trunk, 0.0, "head, trunk and girdles are held up");
    assert!(tail > 0.5 && tail < 0.1 * weight, "the tail carries {tail} N");
    assert!(
        e.state().foot_height_m.iter().all(|h| h.abs() < 1.5e-3),
        "{:?}",
        e.state().foot_height_m
    );
    assert!(!e.state().diverged[0]);
}

/// Positive hip: that leg's foot forward, on both sides. Positive knee: foot down. Positive spine: head to
/// the left of the trunk's line means the trunk turns the other way; seen from the head, the hind girdle
/// swings to −y for positive yaw at the neck.
pub fn signs_of_joints(config: &EngineConfig) {
    let model = robots::polymander();
    let mut e = engine(config, &model, 1);
    let feet = |e: &mut dyn Engine, joint: &str, by: f32| {
        let mut init = InitialState { base_z_m: Some(1.0), ..InitialState::nominal(&model) };
        if let Some(a) = model.actuated_names().iter().position(|n| *n == joint) {
            init.joint_pos_rad[a] += by;
        }
        e.reset(0, &init).unwrap();
        e.state().clone()
    };
    let rest = feet(e.as_mut(), "", 0.0);
    for (f, leg) in ["FL", "FR", "HL", "HR"].iter().enumerate() {
        let forward =
            feet(e.as_mut(), &format!("{leg}_hip"), 0.3).foot_pos_m[3 * f] - rest.foot_pos_m[3 * f];
        assert!(forward > 0.02, "{leg} hip moves its foot by {forward}");
        let down = feet(e.as_mut(), &format!("{leg}_knee"), 0.3).foot_pos_m[3 * f + 2]
            - rest.foot_pos_m[3 * f + 2];
        assert!(down < -0.01, "{leg} knee moves its foot by {down}");
    }
    let bent = feet(e.as_mut(), "spine_1", 0.3);
    assert!(
        bent.com_pos_m[1] < rest.com_pos_m[1] - 0.02,
        "yaw about +z at the neck swings the body behind it to −y"
    );

    // And dynamically: told so, the joint goes there.
    let mut targets = nominal_targets(&model, 1);
    targets[9] += 0.3; // FL_knee
    let held = EngineConfig { fixed_base: true, ..config.clone() };
    let mut e = engine(&held, &model, 1);
    run(e.as_mut(), periods(config, 1.0), &targets, |_, _| ());
    let j = model.actuated()[9];
    near("FL_knee", f64::from(e.state().joint_pos_rad[j]), model.nominal_pos_rad()[9] + 0.3, 0.03);
}

/// Held in the air with the spine rolled, the girdle play opens to its stop: half-width, and no further than
/// a degree beyond.
pub fn play_is_free_then_stops(config: &EngineConfig) {
    let model = robots::polymander();
    let held = EngineConfig { fixed_base: true, ..config.clone() };
    let mut e = engine(&held, &model, 2);
    let narrow =
        LaneParams { backlash_half_width_rad: vec![0.01; 4], ..LaneParams::nominal(&model) };
    e.set_params(1, &narrow).unwrap();
    e.reset(1, &InitialState::nominal(&model)).unwrap();
    // Held by the head, the trunk's weight bends the front girdle's pitch play downwards.
    run(e.as_mut(), periods(config, 3.0), &nominal_targets(&model, 2), |_, _| ());
    let j = model.joint_index("backlash_front_y").unwrap();
    let joints = model.joints().len();
    for (lane, half) in [(0, 0.0698), (1, 0.01)] {
        let open = f64::from(e.state().joint_pos_rad[lane * joints + j]).abs();
        assert!((half..half + 0.012).contains(&open), "play of {half} opens to {open}");
    }
}

/// With `lock_backlash` the play hinges keep their places in the state and stay at zero.
pub fn play_can_be_locked(config: &EngineConfig) {
    let model = robots::polymander();
    let locked = EngineConfig { lock_backlash: true, ..config.clone() };
    let mut e = engine(&locked, &model, 1);
    run(e.as_mut(), periods(config, 1.0), &nominal_targets(&model, 1), |_, _| ());
    let s = e.state();
    for &j in &model.backlash().joints {
        assert_eq!((s.joint_pos_rad[j], s.joint_vel_radps[j]), (0.0, 0.0));
    }
    let weight = model.total_mass_kg() * 9.81;
    let feet: f64 = s.foot_force_n.chunks(3).map(|f| f64::from(f[2])).sum();
    near("feet and tail", feet + f64::from(s.tail_force_n[0]), weight, 0.02 * weight);
}

/// Ten seconds of an open-loop trot. MuJoCo 3 on the same MJCF with the same servo, converged in step size,
/// travels 2.13 m and spends 6.93 W (elliptic cone, 0.5 ms). Rapier gives 2.05 to 2.15 m between 5 and 0.5
/// ms. MuJoCo's watts depend on how soft its constraints are: 6.67 with contacts of 5 instead of 20 ms, 6.64
/// with joint stops of 2 instead of 5 ms; Rapier's contacts are stiffer than either: 6.65 W is what it should
/// be near (6.53 at 4 ms).
pub fn walks_like_mujoco(config: &EngineConfig) {
    let model = robots::polymander();
    let mut e = engine(config, &model, 1);
    let start = f64::from(e.state().com_pos_m[0]);
    let mut power = 0.0;
    let n = periods(config, 10.0);
    for k in 0..n {
        let targets = trot(&model, k as f64 * config.control_period_s());
        e.step(&targets, &[0.0; 6]).unwrap();
        power += e.state().mech_power_w.iter().map(|p| f64::from(p.abs())).sum::<f64>() / n as f64;
    }
    near("travel", f64::from(e.state().com_pos_m[0]) - start, 2.13, 0.2);
    let (watts, within) = match config.kind {
        EngineKind::Batch | EngineKind::Mujoco => (6.93, 0.4),
        EngineKind::Rapier => (6.65, 0.3),
    };
    near("power", power, watts, within);
    near("sideways", f64::from(e.state().com_pos_m[1]), 0.0, 0.3);
}

/// 1.3 Hz, diagonal legs together: hips swing ±0.35 rad, knees lift 0.5 rad in swing, the spine bends with
/// the gait.
fn trot(model: &RobotModel, t_s: f64) -> Vec<f32> {
    let phase = TAU * 1.3 * t_s;
    let nominal = model.nominal_pos_rad();
    let offset = |name: &str| {
        let leg = if name.starts_with("FL") || name.starts_with("HR") {
            phase
        } else {
            phase + TAU / 2.0
        };
        match name {
            n if n.ends_with("hip") => 0.35 * leg.cos(),
            n if n.ends_with("knee") => -0.5 * (-leg.sin()).max(0.0),
            n if n.starts_with("spine") => 0.1 * phase.cos(),
            _ => 0.0,
        }
    };
    model.actuated_names().iter().zip(nominal).map(|(name, q)| (q + offset(name)) as f32).collect()
}

/// On rugged ground every foot ends up on the ground it stands over, wherever the robot is put.
pub fn stands_on_rugged_ground(config: &EngineConfig) {
    let model = robots::polymander();
    let rugged = TerrainConfig { kind: TerrainKind::Rugged, ..TerrainConfig::default() };
    const LANES: usize = 6;
    let mut e = build(model.clone(), LANES, config, &rugged, 3, 1).unwrap();
    for lane in 0..LANES {
        let init = InitialState {
            base_xy_m: [lane as f32 * 0.83 - 2.0, 1.3 - lane as f32 * 0.41],
            base_rpy_rad: [0.0, 0.0, lane as f32],
            ..InitialState::nominal(&model)
        };
        e.reset(lane, &init).unwrap();
        assert!(
            e.state().foot_height_m[4 * lane..4 * lane + 4].iter().all(|&h| h > -1e-3),
            "starts above ground"
        );
    }
    run(e.as_mut(), periods(config, 2.0), &nominal_targets(&model, LANES), |_, _| ());
    let s = e.state();
    assert!(s.diverged.iter().all(|d| !d));
    let weight = model.total_mass_kg() * 9.81;
    for lane in 0..LANES {
        // up to 22° of slope: a touching ball is up to 1.5 mm over the ground straight below
        let heights = &s.foot_height_m[4 * lane..4 * lane + 4];
        assert!(heights.iter().all(|&h| h > -1.5e-3), "lane {lane}: a foot is {heights:?} deep");
        assert!(
            heights.iter().filter(|&&h| h < 3e-3).count() >= 3,
            "lane {lane}: stands on {heights:?}"
        );
        let feet: f64 =
            s.foot_force_n[12 * lane..12 * lane + 12].chunks(3).map(|f| f64::from(f[2])).sum();
        assert!(feet > 0.7 * weight, "lane {lane}: the feet carry {feet} N");
    }
}

/// Work of the motor of `tail_1` per cycle (J) while it wags by 0.3 rad at 0.5 Hz, with so much friction
/// below the tail, standing with such a heading.
fn wag(config: &EngineConfig, belly_friction: f32, heading_rad: f32) -> f64 {
    let model = robots::polymander();
    let mut e = engine(config, &model, 1);
    let params = LaneParams { body_friction: belly_friction, ..LaneParams::nominal(&model) };
    e.set_params(0, &params).unwrap();
    let init =
        InitialState { base_rpy_rad: [0.0, 0.0, heading_rad], ..InitialState::nominal(&model) };
    e.reset(0, &init).unwrap();
    let tail = model.actuated_names().iter().position(|n| *n == "tail_1");
    let tail = tail.unwrap();
    let mut targets = nominal_targets(&model, 1);
    run(e.as_mut(), periods(config, 1.0), &targets, |_, _| ());
    let (centre, mut work_j) = (f64::from(targets[tail]), 0.0);
    for k in 0..periods(config, 4.0) {
        let t_s = k as f64 * config.control_period_s();
        targets[tail] = (centre + 0.3 * t_s.min(1.0) * (0.5 * TAU * t_s).sin()) as f32;
        e.step(&targets, &[0.0; 6]).unwrap();
        if t_s > 2.0 {
            work_j += f64::from(e.state().mech_power_w[tail]) * config.control_period_s();
        }
    }
    work_j
}

/// A tail's tip is light sideways and heavy lengthwise; what drags it back is friction × load against the way
/// it goes, wherever the robot faces. MuJoCo 3 at 0.5 ms: 0.308 J per cycle, of them 0.256 J friction.
pub fn a_tail_drags_the_same_wherever_it_faces(config: &EngineConfig) {
    let smooth = wag(config, 0.0, 0.0);
    for heading_rad in [0.0, 0.4, std::f32::consts::FRAC_PI_4, 1.2] {
        let drag = wag(config, 0.3, heading_rad) - smooth;
        near(&format!("drag at {heading_rad} rad"), drag, 0.256, 0.06 * 0.256);
    }
}
