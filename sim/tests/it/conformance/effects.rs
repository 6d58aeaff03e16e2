//! Effects of the drive-line, each against a number worked by hand. On the pendulum (m·g·l = 0.981 N·m) and
//! the two wheels (0.01 kg·m² each, no gravity) of `robots`.

use std::f64::consts::TAU;
use std::sync::Arc;

use caudata_model::RobotModel;
use caudata_sim::drive::loss::LossMemory;
use caudata_sim::drive::{ServoDrive, filter};
use caudata_sim::{CommandLoss, Engine, EngineConfig, InitialState, JointEffects, LaneParams};

use crate::conformance::{engine, near, periods, robots, run};

/// Gains 15 and 0.3 on XM430's armature, with `change` to every joint's drive-line.
fn geared(model: &Arc<RobotModel>, change: impl Fn(&mut JointEffects)) -> LaneParams {
    let joints = model.actuated().len();
    let mut params = LaneParams {
        kp_nm_per_rad: vec![15.0; joints],
        kd_nms_per_rad: vec![0.3; joints],
        joint_armature_kgm2: vec![0.0022; joints],
        ..LaneParams::nominal(model)
    };
    params.joints.iter_mut().for_each(change);
    params
}

/// An engine with one lane per parameter set.
fn lanes(config: &EngineConfig, model: &Arc<RobotModel>, all: &[LaneParams]) -> Box<dyn Engine> {
    let mut e = engine(config, model, all.len());
    for (lane, params) in all.iter().enumerate() {
        e.set_params(lane, params).unwrap();
        e.reset(lane, &InitialState::nominal(model)).unwrap();
    }
    e
}

fn pos(e: &dyn Engine, lane: usize) -> f64 {
    let joints = e.state().joints;
    f64::from(e.state().joint_pos_rad[lane * joints])
}

/// Held at 1 rad it hangs where 15·(1 − q)·x = 0.981·sin q: with a dead band of 0.05 rad, at twice the
/// winding resistance, and with an integral part; a spring of 5 N·m/rad towards 0.5 rad helps it.
pub fn droop_says_which(config: &EngineConfig) {
    let model = robots::pendulum();
    let all = [
        geared(&model, |j| j.dead_band_rad = 0.05),
        geared(&model, |j| j.winding_scale = 2.0),
        geared(&model, |j| j.ki_nm_per_rad_s = 20.0),
        geared(&model, |j| {
            j.spring_nm_per_rad = 5.0;
            j.spring_rest_rad = 0.5;
        }),
    ];
    let mut e = lanes(config, &model, &all);
    run(e.as_mut(), periods(config, 8.0), &[1.0; 4], |_, _| ());
    let q: Vec<f64> = (0..4).map(|l| pos(e.as_ref(), l)).collect();
    let load = |q: f64| 0.981 * q.sin();
    near("dead band", 15.0 * (0.95 - q[0]), load(q[0]), 2e-3);
    near("resistance", 7.5 * (1.0 - q[1]), load(q[1]), 2e-3);
    near("integral", q[2], 1.0, 1e-3);
    near("spring", 15.0 * (1.0 - q[3]) + 5.0 * (0.5 - q[3]), load(q[3]), 2e-3);
}

/// 0.5 A at 1 N·m/A is 0.5 N·m and not more; a joint that stops at 0.3 rad gets no further; a profile of 1
/// rad/s moves at 1 rad/s.
pub fn limits_limit(config: &EngineConfig) {
    let model = robots::pendulum();
    let all = [
        geared(&model, |j| j.current_limit_a = 0.5),
        geared(&model, |j| j.high_rad = 0.3),
        geared(&model, |j| j.profile_speed_radps = 1.0),
    ];
    let mut e = lanes(config, &model, &all);
    let (mut strongest, mut at_speed) = (0.0_f32, vec![]);
    run(e.as_mut(), periods(config, 3.0), &[2.0; 3], |k, e| {
        strongest = strongest.max(e.state().motor_torque_nm[0]);
        if k == periods(config, 0.5) || k == periods(config, 1.5) {
            at_speed.push(pos(e, 2));
        }
    });
    near("current limit", f64::from(strongest), 0.5, 1e-5);
    // it hangs back by load over gain, more at the end of that second than at its start
    let target: Vec<f64> = at_speed.iter().map(|q| q + 0.981 * q.sin() / 15.0).collect();
    near("speed of the profile", target[1] - target[0], 1.0, 5e-3);
    // limited to 10 N·m, and 15·1.7 wants more; 0.29 N·m of weight; the stop on 0.025 kg·m² has 19·0.025·2632
    // = 1250 N·m/rad
    near("early stop", pos(e.as_ref(), 1), 0.3078, 0.0005);
}

/// A command of 0.02 rad asks for 0.3 N·m. With 25 ms of delay in the loop nothing comes in the first 20 ms
/// and 0.3 N·m for three quarters of the next; what the loop asked for when the wheel began to move is under
/// way until then. Without a delay it comes at once. More than 50 ms is refused.
pub fn a_late_loop_gives_its_torque_later(config: &EngineConfig) {
    let model = robots::wheels();
    let all = [geared(&model, |j| j.loop_delay_s = 0.025), geared(&model, |_| ())];
    let mut e = lanes(config, &model, &all);
    let per_20_ms = periods(config, 0.02);
    for _ in 0..2 {
        // a reset leaves nothing under way
        e.reset(0, &InitialState::nominal(&model)).unwrap();
        run(e.as_mut(), 3 * per_20_ms, &[0.0; 4], |_, _| ());
        let mut torques = [[0.0; 2]; 2];
        run(e.as_mut(), 2 * per_20_ms, &[0.02; 4], |k, e| {
            for lane in [0, 1] {
                let torque = f64::from(e.state().motor_torque_nm[2 * lane]);
                torques[lane][k / per_20_ms] += torque / per_20_ms as f64;
            }
        });
        near("late, first", torques[0][0], 0.0, 1e-6);
        near("late, then", torques[0][1], 0.225, 1e-5);
    }
    let mut at_once = 0.0;
    e.reset(1, &InitialState::nominal(&model)).unwrap();
    run(e.as_mut(), 1, &[0.02; 4], |_, e| {
        at_once = f64::from(e.state().motor_torque_nm[2]);
    });
    assert!(at_once > 0.02, "without a delay: {at_once} N·m");
    let too_long = geared(&model, |j| j.loop_delay_s = 0.06);
    let refused = e.set_params(0, &too_long).unwrap_err().to_string();
    assert!(refused.contains("loop_delay_s"), "{refused}");
}

/// A wheel of 0.0122 kg·m² coasts at 1 rad/s against 0.122 N·m·s/rad. Where that damps a speed 0.1 s old, ω'' + 10·ω' +
/// 100·ω = 0 from ω = 1 and ω' = −10: it swings back to −e^(−2π/3√3) = −0.2984 rad/s. Without the lag it stops.
pub fn lagging_damping_swings_back(config: &EngineConfig) {
    let model = robots::wheels();
    let coasting = |lag_s: f32| LaneParams {
        kp_nm_per_rad: vec![0.0; 2],
        kd_nms_per_rad: vec![0.122; 2],
        ..geared(&model, |j| {
            j.damping_lag_s = lag_s;
            j.kd_min_nms_per_rad = 0.0;
        })
    };
    let mut e = lanes(config, &model, &[coasting(0.1), coasting(0.0)]);
    let mut slowest = [1.0_f64; 2];
    for lane in 0..2 {
        let init = InitialState { joint_vel_radps: vec![1.0; 2], ..InitialState::nominal(&model) };
        e.reset(lane, &init).unwrap();
    }
    run(e.as_mut(), periods(config, 1.0), &[0.0; 4], |_, e| {
        for (lane, slowest) in slowest.iter_mut().enumerate() {
            *slowest = slowest.min(f64::from(e.state().joint_vel_radps[2 * lane]));
        }
    });
    near("late", slowest[0], -0.2984, 0.01);
    near("at once", slowest[1], 0.0, 1e-3);
}

/// 0.5 ms of lag in steps of 2 ms: 2/(2 + 0.5) of the way per step. A speed that grows by 1 per step is then 0.25
/// behind, as long as the lag is of a step. Without one it is the speed itself.
#[test]
fn a_lag_shorter_than_a_step_is_as_late_as_it_says() {
    let model = robots::wheels();
    let share = |lag_s: f32| {
        let p = geared(&model, |j| j.damping_lag_s = lag_s);
        ServoDrive::new(&model, &p, 0, 0.002).speed_low_pass_share
    };
    assert!((share(0.0005) - 0.8).abs() < 1e-7, "{}", share(0.0005));
    let behind = |share: f64| {
        let last = (0..40).fold(0.0, |speed, k| filter::low_pass(speed, f64::from(k), share));
        39.0 - last
    };
    assert!((behind(share(0.0005)) - 0.25).abs() < 1e-6);
    assert_eq!((share(0.0), behind(share(0.0))), (1.0, 0.0));
}

/// Pushed with 0.3 N·m (its flat limit) a wheel reaches the speed at which friction takes it: viscous 0.05
/// alone 6 rad/s, with Coulomb 0.1 4 rad/s, with 0.02 more in this direction 3.6 rad/s.
pub fn friction_sets_the_speed(config: &EngineConfig) {
    let model = robots::wheels();
    let push = |friction: f32, asymmetry: f32| {
        let mut p = geared(&model, |j| j.friction_asymmetry_nm = asymmetry);
        p.joint_friction_nm = vec![friction; 2];
        p.joint_damping_nms_per_rad = vec![0.05; 2];
        p.torque_scale = vec![0.03; 2];
        p.kd_nms_per_rad = vec![0.0; 2];
        p
    };
    let all = [push(0.0, 0.0), push(0.1, 0.0), push(0.1, 0.02)];
    let mut e = lanes(config, &model, &all);
    run(e.as_mut(), periods(config, 4.0), &[900.0; 6], |_, _| ());
    for (lane, want) in [6.0, 4.0, 3.6].into_iter().enumerate() {
        near("speed", f64::from(e.state().joint_vel_radps[2 * lane]), want, 0.02);
    }
}

/// Lifting 0.981·sin q slowly takes the load and 20 % of it; lowering it, the load less 40 %. (Kd takes
/// 0.3·0.1 N·m of what the loop gives, which is in the motor's torque already.)
pub fn load_friction_lifts_and_lowers(config: &EngineConfig) {
    let model = robots::pendulum();
    let p = geared(&model, |j| {
        j.load_friction_driving = 0.2;
        j.load_friction_driven = 0.4;
    });
    let mut e = lanes(config, &model, &[p]);
    let wrench = [0.0; 6];
    let ramp = |e: &mut dyn Engine, from: f64, to: f64| {
        let n = periods(config, (to - from).abs() / 0.1);
        for k in 0..n {
            let target = from + (to - from) * (k + 1) as f64 / n as f64;
            e.step(&[target as f32], &wrench).unwrap();
        }
        f64::from(e.state().motor_torque_nm[0]) / (0.981 * pos(e, 0).sin())
    };
    near("lifting", ramp(e.as_mut(), 0.0, 1.0), 1.2, 0.02);
    near("lowering", ramp(e.as_mut(), 1.0, 0.6), 0.6, 0.02);
}

/// Held back by Coulomb 0.1 and 0.05 N·m more at rest: from 0.14 rad (0.1369 N·m) it stays; without the extra
/// it creeps to where Coulomb holds it, asin(0.1/0.981) = 0.1021 rad; from 0.17 rad (0.166 N·m) it breaks
/// away and, as slow as 2 N·m·s/rad let it be, is held at asin(0.15/0.981) = 0.1535 rad.
pub fn stribeck_grips_at_rest(config: &EngineConfig) {
    let model = robots::pendulum();
    let cases = [(0.05, 0.14, 0.14), (0.0, 0.14, 0.1021), (0.05, 0.17, 0.1535)];
    let mut e = engine(config, &model, cases.len());
    for (lane, (extra, start, _)) in cases.iter().enumerate() {
        let mut p = LaneParams {
            joint_friction_nm: vec![0.1],
            joint_damping_nms_per_rad: vec![2.0],
            ..LaneParams::nominal(&model)
        };
        p.joints[0].stribeck_nm = *extra;
        p.joints[0].stribeck_speed_radps = 1.0;
        e.set_params(lane, &p).unwrap();
        let init = InitialState { joint_pos_rad: vec![*start], ..InitialState::nominal(&model) };
        e.reset(lane, &init).unwrap();
    }
    run(e.as_mut(), periods(config, 15.0), &[0.0; 3], |_, _| ());
    for (lane, (_, _, want)) in cases.iter().enumerate() {
        near("rest", pos(e.as_ref(), lane), *want, 0.0025);
    }
}

/// ±0.01 rad of play, rotor held by friction: gravity turned from one side (0.1 N·m) to the other moves the
/// joint by 0.02 rad and twice the teeth's bend of 0.1/1000 rad.
pub fn play_has_its_width(config: &EngineConfig) {
    let model = robots::pendulum();
    let tilted = |g: f32| {
        let mut p = geared(&model, |j| {
            j.gear_half_gap_rad = 0.01;
            j.presliding_rad = 1e-5;
        });
        p.kp_nm_per_rad = vec![0.0];
        p.kd_nms_per_rad = vec![0.0];
        p.joint_friction_nm = vec![50.0];
        p.gravity_mps2 = [g, 0.0, 0.0];
        p
    };
    let mut e = lanes(config, &model, &[tilted(1.0)]);
    run(e.as_mut(), periods(config, 4.0), &[0.0], |_, _| ());
    let one = pos(e.as_ref(), 0);
    e.set_params(0, &tilted(-1.0)).unwrap();
    run(e.as_mut(), periods(config, 6.0), &[0.0], |_, _| ());
    near("travel", (one - pos(e.as_ref(), 0)).abs(), 0.0202, 2e-4);
}

/// Held at 1 rad with ±0.01 rad of play, on whose flank gravity keeps it: the encoder comes to rest where
/// 15·(1 − x)·= 0.981·sin q, and on the motor it is 0.01 rad and the teeth's bend ahead of the joint.
pub fn an_encoder_on_the_motor_does_not_see_play(config: &EngineConfig) {
    let model = robots::pendulum();
    let on = |motor: f32| {
        geared(&model, |j| {
            j.gear_half_gap_rad = 0.01;
            j.motor_encoder = motor;
        })
    };
    // a rotor so light that the loop's damping would rattle it, were it not held heavier
    let light = LaneParams { joint_armature_kgm2: vec![1e-4], ..on(1.0) };
    let mut e = lanes(config, &model, &[on(0.0), on(1.0), light]);
    run(e.as_mut(), periods(config, 8.0), &[1.0; 3], |_, _| ());
    let ahead = |lane: usize| f64::from(e.state().encoder_ahead_rad[lane]);
    let load = |lane: usize| 0.981 * pos(e.as_ref(), lane).sin();
    assert_eq!(ahead(0), 0.0);
    for lane in 1..3 {
        near("ahead", ahead(lane), 0.01 + load(lane) / 1000.0, 1e-4);
    }
    for lane in 0..3 {
        let seen = pos(e.as_ref(), lane) + ahead(lane);
        near("loop", 15.0 * (1.0 - seen), load(lane), 2e-3);
        near("speed", f64::from(e.state().encoder_ahead_radps[lane]), 0.0, 1e-3);
    }
}

/// Joint A runs free at 15 rad/s on 12 V; joint B presses its stop with 5 A. On 10 V that is 5 of 12.5 N·m, so
/// the bus gives 2 A, of which 1 Ω takes 2 V: A slows down to 12.5 rad/s.
pub fn one_joints_load_slows_another(config: &EngineConfig) {
    let model = robots::wheels();
    let on = |ohm: f32| {
        let mut p = geared(&model, |j| j.speed_scale = 0.05);
        p.kd_nms_per_rad = vec![0.0; 2];
        p.supply_resistance_ohm = ohm;
        p.joints[1].high_rad = 0.1;
        p.joints[1].current_limit_a = 5.0;
        p
    };
    let mut e = lanes(config, &model, &[on(0.0), on(1.0)]);
    let wrenches = [0.0; 12];
    for _ in 0..periods(config, 3.0) {
        e.step(&[900.0; 4], &wrenches).unwrap();
    }
    // flat to 5 rad/s, then 5 N·m less per 5 rad/s: 10 N·m are gone at 15 rad/s
    let speed = |lane: usize| f64::from(e.state().joint_vel_radps[2 * lane]);
    near("stiff supply", speed(0), 15.0, 0.02);
    near("soft supply", speed(1), 12.5, 0.02);
}

/// Response of each lane's first joint to 0.3·sin at 2 Hz, against lane 0: gain and lag in rad.
fn against_first(config: &EngineConfig, e: &mut dyn Engine, joint: usize) -> Vec<(f64, f64)> {
    let (n, joints) = (e.lanes(), e.state().joints);
    let w = 2.0 * TAU;
    let (settle, measure) = (periods(config, 2.0), periods(config, 2.0));
    let mut sums = vec![(0.0, 0.0); n];
    let wrenches = vec![0.0; 6 * n];
    for k in 0..settle + measure {
        let t = k as f64 * config.control_period_s();
        let targets = vec![(0.3 * (w * t).sin()) as f32; n * joints];
        e.step(&targets, &wrenches).unwrap();
        if k >= settle {
            for (lane, (sin, cos)) in sums.iter_mut().enumerate() {
                let q = f64::from(e.state().joint_pos_rad[lane * joints + joint]);
                *sin += q * (w * t).sin();
                *cos += q * (w * t).cos();
            }
        }
    }
    let polar = |(s, c): (f64, f64)| (s.hypot(c), c.atan2(s));
    let (gain, phase) = polar(sums[0]);
    sums.iter().map(|&s| (polar(s).0 / gain, phase - polar(s).1)).collect()
}

/// A delay of 13 ms lags by exactly 2π·2·0.013 = 0.1634 rad at 2 Hz with gain 1; 5 ms and 8 ms of skew of the
/// first joint do the same there and 0.0628 rad at the second.
pub fn delay_and_skew_shift_the_phase(config: &EngineConfig) {
    let model = robots::wheels();
    let none = geared(&model, |_| ());
    let late = LaneParams { command_delay_s: 0.013, ..none.clone() };
    let mut skewed = LaneParams { command_delay_s: 0.005, ..none.clone() };
    skewed.joints[0].command_skew_s = 0.008;
    let all = [none, late, skewed];
    // A fraction of a step is blended into one, which is right for the impulse and up to a sixteenth of a
    // step off in phase.
    let slack = 2.0 * TAU * config.dt_s / 16.0;
    let first = against_first(config, lanes(config, &model, &all).as_mut(), 0);
    for (gain, lag) in &first[1..] {
        near("gain", *gain, 1.0, 1e-3);
        near("lag", *lag, 2.0 * TAU * 0.013, slack);
    }
    let second = against_first(config, lanes(config, &model, &all).as_mut(), 1);
    near("lag", second[1].1, 2.0 * TAU * 0.013, slack);
    near("lag", second[2].1, 2.0 * TAU * 0.005, slack);
}

/// A low-pass of 50 ms at 2 Hz: gain 1/√(1 + 0.3948) = 0.8467, lag atan(0.6283) = 0.5610 rad, less half a
/// physics step or so.
pub fn low_pass_lags_and_damps(config: &EngineConfig) {
    let model = robots::wheels();
    let all = [geared(&model, |_| ()), geared(&model, |j| j.command_low_pass_s = 0.05)];
    let (gain, lag) = against_first(config, lanes(config, &model, &all).as_mut(), 0)[1];
    near("gain", gain, 0.8467, 0.01);
    near("lag", lag, 0.5610, 2.0 * TAU * config.dt_s);
}

/// A lane that loses frames moves as one that is sent the frame before again, and the frames lost are those
/// that seed and count say.
pub fn lost_frames_are_held(config: &EngineConfig) {
    let model = robots::wheels();
    let loss = CommandLoss { share: 0.4, burst: 2.0, seed: 7 };
    let none = geared(&model, |_| ());
    let losing = LaneParams { command_loss: loss, ..none.clone() };
    let mut e = lanes(config, &model, &[losing, none]);
    let mut memory = LossMemory::default();
    let mut held = [0.0_f32; 2];
    let mut lost = 0;
    for k in 0..100 {
        let sent = [(0.1 * k as f32).sin(), 0.3];
        if memory.next(&loss) {
            lost += 1;
        } else {
            held = sent;
        }
        e.step(&[sent, held].concat(), &[0.0; 12]).unwrap();
        let q = &e.state().joint_pos_rad;
        assert_eq!(q[..2], q[2..], "period {k}");
    }
    assert!((20..60).contains(&lost), "{lost} of 100 lost");
}

/// 15·(c − q) + 0.05·sin(16·q) = 0 wherever it is told to stand.
pub fn ripple_goes_with_the_angle(config: &EngineConfig) {
    let model = robots::wheels();
    let all = [geared(&model, |j| {
        j.ripple_nm = 0.05;
        j.ripple_per_turn = 16.0;
    })];
    let mut e = lanes(config, &model, &all);
    for command in [0.05, 1.8, -1.3] {
        run(e.as_mut(), periods(config, 2.0), &[command; 2], |_, _| ());
        let q = pos(e.as_ref(), 0);
        near("balance", 15.0 * (f64::from(command) - q) + 0.05 * (16.0 * q).sin(), 0.0, 1e-3);
    }
}

/// 0.5 A of load warm the winding by 200·0.25 = 50 K, its resistance grows by a fifth: the droop with it.
pub fn a_warm_motor_droops_more(config: &EngineConfig) {
    let model = robots::pendulum();
    let p = geared(&model, |j| {
        j.thermal_rise_k_per_a2 = 200.0;
        j.thermal_time_s = 1.0;
        j.resistance_per_k = 0.004;
    });
    let mut e = lanes(config, &model, &[p]);
    let target = 0.6_f32;
    run(e.as_mut(), periods(config, 0.3), &[target], |_, _| ());
    run(e.as_mut(), periods(config, 10.0), &[target], |_, _| ());
    let q = pos(e.as_ref(), 0);
    let load = 0.981 * q.sin();
    let rho = 1.0 + 0.004 * 200.0 * load * load;
    near("droop", 15.0 * (f64::from(target) - q), load * rho, 3e-3);
    assert!(rho > 1.15, "it does get warm: {rho}");
}
