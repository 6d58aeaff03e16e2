//! Passive joints: pendulums, damping, friction, end stops.

use std::f64::consts::PI;
use std::sync::Arc;

use caudata_model::{Pose, RobotModel};
use caudata_sim::{Engine, EngineConfig, InitialState, LaneParams};

use crate::conformance::{engine, near, periods, robots, run};

/// m·g·l of [`robots::pendulum`], N·m.
const MGL: f64 = 0.981;
/// Its inertia about the pivot, kg·m².
const INERTIA: f64 = 0.025;

/// T = 2π·√(I/mgl)·(1 + θ²/16) = 2π·√(0.025/0.981)·(1 + 0.1²/16) = 1.00366 s
pub fn pendulum_period(config: &EngineConfig) {
    check_period(config, 0.0);
}

/// With 0.03 kg·m² of rotor inertia: 2π·√(0.055/0.981)·1.000625 = 1.48867 s
pub fn pendulum_period_with_armature(config: &EngineConfig) {
    check_period(config, 0.03);
}

fn check_period(config: &EngineConfig, armature: f64) {
    let model = robots::pendulum();
    let mut e = engine(config, &model, 1);
    let params =
        LaneParams { joint_armature_kgm2: vec![armature as f32], ..LaneParams::nominal(&model) };
    e.set_params(0, &params).unwrap();
    e.reset(0, &at(&model, 0.1)).unwrap();
    let mut crossings = Vec::new();
    let mut last = 0.1;
    run(e.as_mut(), periods(config, 8.0), &[0.0], |k, e| {
        let q = f64::from(e.state().joint_pos_rad[0]);
        if last < 0.0 && q >= 0.0 {
            crossings.push((k as f64 + 1.0 - q / (q - last)) * config.control_period_s());
        }
        last = q;
    });
    let measured = (crossings.last().unwrap() - crossings[0]) / (crossings.len() - 1) as f64;
    let want = 2.0 * PI * ((INERTIA + armature) / MGL).sqrt() * (1.0 + 0.01 / 16.0);
    near("period", measured, want, 5e-4 * want);
}

/// Nothing takes or gives energy: the amplitude after 10 s is the one at the start.
pub fn pendulum_keeps_its_energy(config: &EngineConfig) {
    let model = robots::pendulum();
    let mut e = engine(config, &model, 1);
    e.reset(0, &at(&model, 1.0)).unwrap();
    let (mut early, mut late) = (0.0_f64, 0.0_f64);
    let n = periods(config, 10.0);
    run(e.as_mut(), n, &[0.0], |k, e| {
        let q = f64::from(e.state().joint_pos_rad[0]).abs();
        if k < n / 5 {
            early = early.max(q);
        } else if k >= n - n / 5 {
            late = late.max(q);
        }
    });
    near("amplitude", late, early, 0.01);
}

/// Chaotic, in three dimensions, up to 10 rad/s, 5 s: never gains energy. It may lose some: taking Coriolis
/// forces implicitly costs Rapier 23 % here at 4 ms, 13 % at 2, 6 % at 1, 3.5 % at 0.5.
pub fn double_pendulum_gains_no_energy(config: &EngineConfig) {
    let model = robots::double_pendulum();
    let mut e = engine(config, &model, 1);
    e.reset(0, &InitialState { joint_pos_rad: vec![1.8, 1.2], ..InitialState::nominal(&model) })
        .unwrap();
    let start = energy_j(&model, e.as_ref());
    // hanging straight down: centres of mass at 1 − 0.1 and 1 − 0.3 m
    let lowest = 9.81 * (0.5 * 0.9 + 0.3 * 0.7);
    run(e.as_mut(), periods(config, 5.0), &[0.0, 0.0], |_, e| {
        let gained = (energy_j(&model, e) - start) / (start - lowest);
        assert!((-0.3..0.01).contains(&gained), "gained {gained} of its energy");
    });
}

/// Kinetic and potential energy, from positions and their numerical derivatives: independent of the engine's
/// own bookkeeping.
fn energy_j(model: &RobotModel, e: &dyn Engine) -> f64 {
    let wide = |v: &[f32]| v.iter().map(|&x| f64::from(x)).collect::<Vec<_>>();
    let (q, qd) = (wide(&e.state().joint_pos_rad), wide(&e.state().joint_vel_radps));
    let h = 1e-6;
    let moved = |sign: f64| {
        let q: Vec<f64> = q.iter().zip(&qd).map(|(q, v)| q + sign * h * v).collect();
        model.kinematics(&Pose::IDENTITY, &q).unwrap()
    };
    let (before, after) = (moved(-1.0), moved(1.0));
    let mut sum = 0.0;
    for (i, link) in model.links().iter().enumerate() {
        let (a, b) = (&before.links[i], &after.links[i]);
        let (ca, cb) = (a.point(link.com_m), b.point(link.com_m));
        let speed2: f64 = (0..3).map(|k| ((cb[k] - ca[k]) / (2.0 * h)).powi(2)).sum();
        sum += 0.5 * link.mass_kg * speed2 + link.mass_kg * 9.81 * 0.5 * (ca[2] + cb[2]);
        // angular velocity in the link's frame from Rᵀ·dR/dt
        let (ra, rb) = (a.rotation(), b.rotation());
        let skew = |r: usize, c: usize| -> f64 {
            (0..3).map(|k| ra[k][r] * (rb[k][c] - ra[k][c])).sum::<f64>() / (2.0 * h)
        };
        let w = [skew(2, 1), skew(0, 2), skew(1, 0)];
        for r in 0..3 {
            for c in 0..3 {
                sum += 0.5 * w[r] * link.inertia_kgm2[r][c] * w[c];
            }
        }
    }
    sum
}

/// With d = 0.01 N·m·s/rad the amplitude falls as exp(−d·t/(2·I)): after 5 s, exp(−0.01·5/0.05) = 0.3679.
pub fn viscous_damping_decays(config: &EngineConfig) {
    let model = robots::pendulum();
    let mut e = engine(config, &model, 1);
    let params =
        LaneParams { joint_damping_nms_per_rad: vec![0.01], ..LaneParams::nominal(&model) };
    e.set_params(0, &params).unwrap();
    e.reset(0, &at(&model, 0.1)).unwrap();
    let mut late = 0.0_f64;
    let n = periods(config, 5.5);
    let from = periods(config, 4.5);
    run(e.as_mut(), n, &[0.0], |k, e| {
        if k >= from {
            // scale back to 5 s
            let t = (k + 1) as f64 * config.control_period_s();
            late = late.max(f64::from(e.state().joint_pos_rad[0]).abs() * (0.2 * (t - 5.0)).exp());
        }
    });
    near("amplitude after 5 s", late / 0.1, 0.3679, 0.012);
}

/// Coulomb friction of 0.1 N·m holds the pendulum at 0.08 rad (0.981·sin 0.08 = 0.0784 N·m) without creep;
/// at 0.3 rad it slides and, per half swing, loses 2·0.1/0.981 = 0.204 rad of amplitude.
pub fn friction_holds_and_brakes(config: &EngineConfig) {
    let model = robots::pendulum();
    let mut e = engine(config, &model, 2);
    let params = LaneParams { joint_friction_nm: vec![0.1], ..LaneParams::nominal(&model) };
    for (lane, q) in [(0, 0.08), (1, 0.4)] {
        e.set_params(lane, &params).unwrap();
        e.reset(lane, &at(&model, q)).unwrap();
    }
    let mut first_reversal = None;
    run(e.as_mut(), periods(config, 10.0), &[0.0; 2], |_, e| {
        if first_reversal.is_none() && e.state().joint_vel_radps[1] > 0.0 {
            first_reversal = Some(f64::from(e.state().joint_pos_rad[1]));
        }
    });
    let s = e.state();
    near("held position", f64::from(s.joint_pos_rad[0]), 0.08, 0.003);
    near("held speed", f64::from(s.joint_vel_radps[0]), 0.0, 1e-4);
    near("first reversal", first_reversal.unwrap(), -(0.4 - 0.204), 0.01);
    let rest = f64::from(s.joint_pos_rad[1]).abs();
    assert!(rest < 0.1 / 0.981 + 0.003, "comes to rest where friction can hold it, not at {rest}");
    near("rest speed", f64::from(s.joint_vel_radps[1]), 0.0, 1e-4);
}

/// A pendulum thrown over the top is caught at its stop of 2.5 rad and does not bounce back with more than it
/// had.
pub fn stops_hold(config: &EngineConfig) {
    let model = robots::pendulum();
    let mut e = engine(config, &model, 1);
    let thrown = InitialState { joint_vel_radps: vec![14.0], ..at(&model, 0.0) };
    e.reset(0, &thrown).unwrap();
    let (mut highest, mut lowest) = (0.0_f64, 0.0_f64);
    run(e.as_mut(), periods(config, 6.0), &[0.0], |_, e| {
        let q = f64::from(e.state().joint_pos_rad[0]);
        highest = highest.max(q);
        lowest = lowest.min(q);
    });
    // It arrives with ½·0.025·v² = ½·0.025·14² − 0.981·(1 + 0.8011) = 0.68 J, v = 7.4 rad/s. The stop
    // (MuJoCo's default of 20 ms with d = 0.95: ω = 50/s, critically damped) lets it in by v·t·exp(−ω·t), at
    // most v/(e·ω) = 0.0544 rad after 20 ms; seen every 20 ms, at least 0.048, less what its weight pulls
    // back.
    assert!((2.545..2.557).contains(&highest), "reached {highest}");
    assert!(lowest > -2.56, "swung back to {lowest}");
}

/// Free fall on a slide: −½·g·t² after 0.2 s is −0.1962 m; then the stop at −0.5 m carries 0.4 kg.
pub fn slide_falls_and_stops(config: &EngineConfig) {
    let model = robots::slider();
    let mut e = engine(config, &model, 1);
    e.reset(0, &at(&model, 0.0)).unwrap();
    run(e.as_mut(), periods(config, 0.2), &[0.0], |_, _| ());
    near(
        "fallen",
        f64::from(e.state().joint_pos_rad[0]),
        -0.1962,
        9.81 * 0.2 * config.dt_s / 2.0 + 1e-3,
    );
    near("weight", f64::from(e.state().com_pos_m[2]), 2.0 - 0.1962, 0.006);
    run(e.as_mut(), periods(config, 3.0), &[0.0], |_, _| ());
    near("resting on the stop", f64::from(e.state().joint_pos_rad[0]), -0.5, 1e-3);
    near("at rest", f64::from(e.state().joint_vel_radps[0]), 0.0, 0.01);
}

/// Friction of 5 N carries 0.4 kg (3.92 N). Thrown up by 0.5 m/s it brakes with 9.81 + 12.5 = 22.3 m/s², gets
/// 0.5²/(2·22.3) = 5.6 mm up, less half a step's way, and hangs 1 + 3.92/5 = 1.78 ways of its bristle lower; the
/// way that steps of dt can follow is (dt + 20 ms)·dt·5/0.4. There it stays. Friction of 50 N, which would turn it
/// round in one step, does not push it about either.
pub fn slide_with_friction_stops_and_stays(config: &EngineConfig) {
    let model = robots::slider();
    let mut e = engine(config, &model, 2);
    let thrown = InitialState { joint_vel_radps: vec![0.5], ..at(&model, 0.0) };
    for (lane, friction_n) in [(0, 5.0), (1, 50.0)] {
        let nominal = LaneParams::nominal(&model);
        let params = LaneParams { joint_friction_nm: vec![friction_n], ..nominal };
        e.set_params(lane, &params).unwrap();
        e.reset(lane, &thrown).unwrap();
    }
    let mut back_mps = 0.0_f32;
    run(e.as_mut(), periods(config, 0.1), &[0.0; 2], |_, _| ());
    let stood = e.state().joint_pos_rad.clone();
    let way_m = (config.dt_s + 0.02) * config.dt_s * 5.0 / 0.4;
    let want_m = 0.0056 - 0.5 * config.dt_s / 2.0 - 1.78 * way_m;
    near("stands", f64::from(stood[0]), want_m, 2e-4);
    run(e.as_mut(), periods(config, 2.0), &[0.0; 2], |_, e| {
        back_mps = e.state().joint_vel_radps.iter().fold(back_mps, |most, v| most.max(v.abs()));
    });
    assert!(back_mps < 1e-3, "friction moves it by {back_mps} m/s");
    for (now, then) in e.state().joint_pos_rad.iter().zip(&stood) {
        near("stays", f64::from(*now), f64::from(*then), 3e-4);
    }
}

/// A held robot does not fall, and its base reports no motion.
pub fn held_robot_hangs(config: &EngineConfig) {
    let model = robots::polymander();
    let held = EngineConfig { fixed_base: true, ..config.clone() };
    let mut e = engine(&held, &model, 1);
    let init = InitialState {
        base_z_m: Some(0.7),
        base_xy_m: [0.2, -0.1],
        base_rpy_rad: [0.0, 0.0, 1.0],
        ..InitialState::nominal(&model)
    };
    e.reset(0, &init).unwrap();
    run(
        e.as_mut(),
        periods(config, 4.0),
        &crate::conformance::nominal_targets(&model, 1),
        |_, _| (),
    );
    let s = e.state();
    assert_eq!(s.base_pos_m, [0.2, -0.1, 0.7]);
    near("yaw", 2.0 * f64::from(s.base_quat_wxyz[3]).asin(), 1.0, 1e-6);
    assert_eq!(s.base_vel_mps, [0.0; 3]);
    assert!(s.com_vel_mps.iter().all(|v| v.abs() < 0.03), "still swinging: {:?}", s.com_vel_mps);
    assert!(!s.diverged[0] && s.foot_force_n.iter().all(|&f| f == 0.0));
}

fn at(model: &Arc<RobotModel>, q: f32) -> InitialState {
    InitialState { joint_pos_rad: vec![q], ..InitialState::nominal(model) }
}
