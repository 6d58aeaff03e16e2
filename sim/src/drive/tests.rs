//! The whole drive-line on one joint: a single inertia, stepped as an engine does it.

use super::passive::{self, StopAt};
use super::step::{self, Step};
use super::supply::{self, Supply};
use super::*;
use crate::per_lane::PerLane;
use crate::stop::Stop;

const DT: f64 = 0.001;

#[track_caller]
fn near(what: &str, got: f64, want: f64, tolerance: f64) {
    assert!((got - want).abs() <= tolerance, "{what}: got {got}, want {want} ± {tolerance}");
}

/// A servo without limits, friction or delay: kp 15, kd 0.3, rotor 0.0022 kg·m².
fn servo() -> ServoDrive<f64> {
    ServoDrive {
        kp_nm_per_rad: 15.0,
        kd_nms_per_rad: 0.3,
        tau_max_nm: 1e3,
        tau_brake_max_nm: 1e3,
        stall_nm_per_volt: 1e3,
        back_drive_kp_ratio: 1.0,
        per_torque_constant_a_per_nm: 1.0,
        current_limit_nm: params::NO_LIMIT,
        braking_current_limit_nm: params::NO_LIMIT,
        low_pass_share: 1.0,
        rate_share: 1.0,
        speed_low_pass_share: 1.0,
        rate_low_pass_share: 1.0,
        profile_speed_radps: params::NO_LIMIT,
        profile_acceleration_radps2: params::NO_LIMIT,
        winding_scale: 1.0,
        thermal_share: 1.0,
        per_stribeck_speed_s_per_rad: 10.0,
        rotor_kgm2: 0.0022,
        ..ServoDrive::default()
    }
}

fn hinge() -> JointPassive<f64> {
    JointPassive { presliding_rad: 0.002, low_rad: -1e6, high_rad: 1e6, ..JointPassive::default() }
}

/// A joint with a load of 0.01 kg·m².
struct Rig {
    servo: ServoDrive<f64>,
    hinge: JointPassive<f64>,
    memory: JointMemory<f64>,
    wanted: WantedTorques<f64>,
    volt: f64,
    q: f64,
    qd: f64,
    motor_nm: f64,
    stop: Stop,
    free: f64,
    qdd: f64,
    /// Whether dampers act at the time of the positions.
    centred: bool,
}

impl Rig {
    fn new(servo: ServoDrive<f64>, hinge: JointPassive<f64>) -> Self {
        let mut wanted = WantedTorques::new(1);
        wanted.set_steps(0, servo.loop_delay_steps.ceil() as usize + 1);
        Self {
            wanted,
            // the stop reckons with the load and the rotor
            stop: Stop::new(&Default::default(), 1.0 / (0.01 + servo.rotor_kgm2)),
            free: 0.0,
            qdd: 0.0,
            centred: false,
            servo,
            hinge,
            memory: JointMemory::rest(0.0, 0.0),
            volt: 12.0,
            q: 0.0,
            qd: 0.0,
            motor_nm: 0.0,
        }
    }

    /// One step under a load torque; an engine's part is the implicit solution for q̇⁺.
    fn step(&mut self, command: f64, load: f64) {
        let f = DriveFeatures::of(&self.servo);
        let dt = Step::new(DT, self.centred);
        let m = &mut self.memory;
        self.wanted.begin_step();
        let stop = StopAt { law: &self.stop, free_radps2: self.free };
        let d = step::start(
            f,
            &self.servo,
            &self.hinge,
            m,
            self.wanted.joint(0),
            &dt,
            self.volt,
            command,
            self.q,
            self.qd,
            self.qdd,
            stop,
        );
        self.wanted.end_step();
        let t = d.torque;
        let inertia = 0.01 + self.servo.armature_kgm2() + t.inertia_kgm2;
        let qd = (inertia * self.qd + DT * (load + t.now_nm))
            / (inertia + DT * (t.damping_nms_per_rad + DT * t.stiffness_nm_per_rad));
        step::finish(f, &self.servo, &self.hinge, m, &dt, &d, DT * qd, self.qd, qd);
        let qdd = (qd - self.qd) / DT;
        self.free = passive::free_radps2(&self.hinge, stop, self.q, self.qd, DT * qd, qd, qdd);
        self.q += DT * qd;
        (self.qd, self.qdd) = (qd, qdd);
        self.motor_nm = d.motor_nm;
    }

    fn run(&mut self, seconds: f64, command: impl Fn(f64) -> f64, load: f64) {
        for k in 0..(seconds / DT).round() as usize {
            self.step(command(k as f64 * DT), load);
        }
    }
}

/// Let go at 0.1 rad with kp 15, kd 0.3 and a damper of 0.1 N·m·s/rad on 0.0122 kg·m²: e^(−16.39·t)·(cos ω·t +
/// 16.39/ω·sin ω·t) of it, ω² = 15/0.0122 − 16.39² = 30.99².
#[test]
fn swings_as_the_formula_says_with_dampers_at_the_time_of_the_positions() {
    let sigma = 0.5 * 0.4 / 0.0122;
    let omega = (15.0 / 0.0122 - sigma * sigma).sqrt();
    let worst = |centred: bool| {
        let damped = JointPassive { damping_nms_per_rad: 0.1, ..hinge() };
        let mut rig = Rig::new(servo(), damped);
        rig.centred = centred;
        rig.q = 0.1;
        // at rest at t = 0: half a step before that it moved the other way
        rig.qd = 0.5 * DT * 15.0 * 0.1 / 0.0122;
        rig.qdd = -15.0 * 0.1 / 0.0122;
        let mut worst = 0.0_f64;
        for k in 1..=150 {
            rig.step(0.0, 0.0);
            let t = f64::from(k) * DT;
            let swing = (omega * t).cos() + sigma / omega * (omega * t).sin();
            worst = worst.max((rig.q - 0.1 * (-sigma * t).exp() * swing).abs());
        }
        worst
    };
    let (as_trained, centred) = (worst(false), worst(true));
    assert!(as_trained > 2e-4, "{as_trained}");
    assert!(centred < 2e-5, "{centred}");
}

/// Kd 0.3 with a command that moves at 2 rad/s: on the joint's speed it holds the joint back by 0.3·2/15 rad, on the
/// rate of the error by nothing. 0.5 N·m that are commanded beside it turn the joint by 0.5/15 rad.
#[test]
fn what_is_fed_forward_is_added_to_the_loop() {
    let behind_rad = |servo: ServoDrive<f64>| {
        let mut rig = Rig::new(servo, hinge());
        rig.run(1.0, |t| 2.0 * t, 0.0);
        2.0 * (1.0 - DT) - rig.q
    };
    let on_error = ServoDrive { command_damping_nms_per_rad: 0.3, ..servo() };
    near("on the speed", behind_rad(servo()), 0.04, 2.5e-3);
    near("on the error", behind_rad(on_error), 0.0, 2.5e-3);
    near("fed", behind_rad(ServoDrive { feed_forward_nm: 0.5, ..on_error }), -0.5 / 15.0, 2.5e-3);
    // a step of the command kicks for one step by Kd·0.1 rad/dt, and not at the very beginning
    let mut rig = Rig::new(on_error, hinge());
    rig.step(0.1, 0.0);
    near("begins", rig.motor_nm, 1.5, 1e-9);
    rig.step(0.2, 0.0);
    let kick_nm = rig.motor_nm - (15.0 * (0.2 - 15.0 * 0.1 / 0.0122 * DT * DT));
    near("kick", kick_nm, 0.3 * 0.1 / DT, 0.1);
    // over 9 ms: after a fifth of a low-pass of 4 ms no more than that, and all of it in the end
    let share = filter::lag_share(0.004, DT);
    let mut rig = Rig::new(ServoDrive { rate_low_pass_share: share, ..on_error }, hinge());
    rig.step(0.1, 0.0);
    rig.step(0.2, 0.0);
    let kick_nm = rig.motor_nm - (15.0 * (0.2 - 15.0 * 0.1 / 0.0122 * DT * DT));
    near("spread", kick_nm, share * 0.3 * 0.1 / DT, 0.1);
    // as far as the motor can
    let weak = ServoDrive { tau_max_nm: 4.0, ..on_error };
    let mut rig = Rig::new(weak, hinge());
    rig.step(0.1, 0.0);
    rig.step(0.2, 0.0);
    near("cut", rig.motor_nm, 4.0, 1e-9);
}

/// 18 N·m·s/rad on 0.0122 kg·m² take away 1.5 of the velocity in a step of 1 ms.
#[test]
fn looking_ahead_makes_no_strong_damper_swing() {
    for kd_nms_per_rad in [4.0, 9.0, 18.0] {
        let damped = ServoDrive { kd_nms_per_rad, ..servo() };
        let mut rig = Rig::new(damped, hinge());
        (rig.centred, rig.q) = (true, 0.1);
        rig.run(0.1, |_| 0.0, 0.0);
        // it creeps home with kp/kd
        let want = -15.0 / kd_nms_per_rad * rig.q;
        near("speed", rig.qd, want, 0.1 * want.abs());
    }
}

#[test]
fn droops_by_load_over_gain_and_integral_takes_it_out() {
    // 0.6 N·m on 15 N·m/rad: 0.04 rad
    let mut rig = Rig::new(servo(), hinge());
    rig.run(2.0, |_| 0.5, -0.6);
    near("droop", rig.q, 0.46, 1e-6);
    let mut rig = Rig::new(ServoDrive { ki_nm_per_rad_s: 30.0, ..servo() }, hinge());
    // slow pole: Ki/Kp = 2 /s; after 4 s 0.04·e⁻⁸ is left
    rig.run(4.0, |_| 0.5, -0.6);
    near("creeps home", rig.q, 0.5, 5e-5);
}

#[test]
fn resistance_doubles_the_droop_and_dead_band_adds_to_it() {
    let mut rig = Rig::new(ServoDrive { winding_scale: 2.0, ..servo() }, hinge());
    rig.run(3.0, |_| 0.5, -0.6);
    near("twice the resistance", rig.q, 0.42, 1e-6);
    let mut rig = Rig::new(ServoDrive { dead_band_rad: 0.01, ..servo() }, hinge());
    rig.run(3.0, |_| 0.5, -0.6);
    near("dead band", rig.q, 0.45, 1e-6);
}

#[test]
fn integral_does_not_wind_up() {
    // limit 0.5 N·m against a load of 0.6: sinks onto its stop
    let mut rig = Rig::new(
        ServoDrive {
            ki_nm_per_rad_s: 30.0,
            current_limit_nm: 0.5,
            braking_current_limit_nm: 0.5,
            ..servo()
        },
        JointPassive { low_rad: -0.2, ..hinge() },
    );
    rig.run(5.0, |_| 0.0, -0.6);
    // 0.1 N·m on the stop: d = 0.91, 0.91/0.09·0.0122·0.91·2770 = 311 N·m/rad
    near("rests on its stop", rig.q, -0.2003, 5e-5);
    near("current limit", rig.motor_nm, 0.5, 1e-9);
    // the error of 0.2 rad alone would have gathered 30·0.2·5 = 30 N·m
    near("integral", rig.memory.integral_nm, 0.0, 0.1);
}

#[test]
fn low_pass_lags_by_its_phase() {
    // τ = 50 ms at 2 Hz: gain 1/√(1 + 0.3948) = 0.8467, phase atan(0.6283) = 32.1°
    let tau = 0.05;
    let p = ServoDrive { low_pass_share: filter::lag_share(tau, DT), ..servo() };
    let w = 2.0 * std::f64::consts::TAU;
    let respond = |p: ServoDrive<f64>| {
        let mut rig = Rig::new(p, hinge());
        let (mut sin, mut cos) = (0.0, 0.0);
        for k in 0..3000 {
            let t = f64::from(k) * DT;
            rig.step((w * t).sin(), 0.0);
            if k >= 2000 {
                sin += rig.q * (w * t).sin() * 2.0 * DT;
                cos += rig.q * (w * t).cos() * 2.0 * DT;
            }
        }
        (sin.hypot(cos), cos.atan2(sin))
    };
    let (plain, slow) = (respond(servo()), respond(p));
    near("gain", slow.0 / plain.0, 0.8467, 0.003);
    // the discrete filter is half a step ahead of the continuous one
    near("phase", plain.1 - slow.1, 0.5610, w * 0.6 * DT);
}

#[test]
fn friction_sets_the_steady_speed() {
    // 0.3 N·m against Coulomb 0.1 and viscous 0.05: (0.3 − 0.1)/0.05 = 4 rad/s
    let free = ServoDrive { kp_nm_per_rad: 0.0, kd_nms_per_rad: 0.0, ..servo() };
    let mut rig =
        Rig::new(free, JointPassive { friction_nm: 0.1, damping_nms_per_rad: 0.05, ..hinge() });
    rig.run(3.0, |_| 0.0, 0.3);
    near("speed", rig.qd, 4.0, 1e-3);
    // 0.02 heavier forwards, lighter backwards
    let uneven = ServoDrive { friction_asymmetry_nm: 0.02, ..free };
    let rubbing = rig.hinge;
    let mut rig = Rig::new(uneven, rubbing);
    rig.run(3.0, |_| 0.0, 0.3);
    near("forwards", rig.qd, 3.6, 1e-3);
    let mut rig = Rig::new(uneven, rubbing);
    rig.run(3.0, |_| 0.0, -0.3);
    near("backwards", rig.qd, -4.4, 1e-3);
}

#[test]
fn stribeck_holds_more_than_it_rubs() {
    // Coulomb 0.1, 0.05 more at rest: 0.14 N·m is held, 0.16 breaks away, and then accelerates by 0.06 on
    // 0.0122 kg·m²
    let p = ServoDrive { kp_nm_per_rad: 0.0, kd_nms_per_rad: 0.0, stribeck_nm: 0.05, ..servo() };
    let rough = JointPassive { friction_nm: 0.1, ..hinge() };
    let mut rig = Rig::new(p, rough);
    for k in 0..2000 {
        rig.step(0.0, 0.14 * f64::from(k) / 2000.0); // slowly: a sudden load would swing the bristle through
    }
    rig.run(1.0, |_| 0.0, 0.14);
    // 0.14 of 0.15 N·m: the bristle is bent to 0.14/0.15 of 2 mrad
    near("held", rig.q, 0.002 * 0.14 / 0.15, 1e-5);
    near("still", rig.qd, 0.0, 1e-3);
    rig.run(1.0, |_| 0.0, 0.16);
    near("sliding", rig.qd, 0.06 / 0.0122, 0.25);
    // 0.12 keeps it sliding although it would not have started it
    let before = rig.qd;
    rig.run(0.5, |_| 0.0, 0.12);
    near("goes on", rig.qd - before, 0.02 / 0.0122 * 0.5, 0.01);
}

#[test]
fn load_friction_lifts_and_lowers() {
    // 20 % driving, 40 % driven: lifting 0.5 N·m takes 0.5/0.8, as friction is a share of what passes on … to
    // the load: 0.5·1.2 = 0.6; lowering it takes 0.5·(1 − 0.4) = 0.3. Slow ramps: 0.1 rad/s, with viscous 0
    // and kd·0.1 = 0.03 N·m in the loop's torque already.
    let p = ServoDrive { load_friction_mean: 0.3, load_friction_half_difference: -0.1, ..servo() };
    let mut rig = Rig::new(p, hinge());
    rig.run(4.0, |t| 0.1 * t, -0.5);
    near("lifting", rig.motor_nm, 0.6, 0.003);
    let up = rig.q;
    rig.run(4.0, |t| up - 0.1 * t, -0.5);
    near("lowering", rig.motor_nm, 0.3, 0.003);
}

#[test]
fn play_in_the_gear_is_free_and_has_its_width() {
    // ±0.01 rad of play, rotor held by its friction: 0.05 N·m either way moves the joint by 0.02 rad and the
    // teeth's bend
    let p = ServoDrive {
        kp_nm_per_rad: 0.0,
        kd_nms_per_rad: 0.0,
        gear_is_soft: 1.0,
        gear_half_gap_rad: 0.01,
        gear_stiffness_nm_per_rad: 1000.0,
        gear_damping_nms_per_rad: 0.6 * (1000.0_f64 * 0.0022).sqrt(),
        ..servo()
    };
    let held = JointPassive { friction_nm: 50.0, presliding_rad: 1e-5, ..hinge() };
    let mut rig = Rig::new(p, held);
    rig.run(2.0, |_| 0.0, 0.05);
    let one = rig.q;
    rig.run(2.0, |_| 0.0, -0.05);
    near("travel", one - rig.q, 0.0201, 3e-5);
}

#[test]
fn stiff_gear_moves_like_no_gear() {
    let mut rigid = Rig::new(servo(), hinge());
    let mut geared = Rig::new(
        ServoDrive {
            gear_is_soft: 1.0,
            gear_stiffness_nm_per_rad: 1e6,
            gear_damping_nms_per_rad: 10.0,
            ..servo()
        },
        hinge(),
    );
    for k in 0..500 {
        let command = if k < 250 { 0.3 } else { -0.1 };
        rigid.step(command, 0.05);
        geared.step(command, 0.05);
        near("same motion", geared.q, rigid.q, 2e-4);
    }
}

#[test]
fn warm_motor_droops_more() {
    // 0.6 A for 0.6 N·m; 100 K/A² · 0.36 = 36 K; 0.39 %/K: ρ = 1.1404, droop 0.04·1.1404
    let mut rig = Rig::new(
        ServoDrive {
            thermal_rise_k_per_a2: 100.0,
            thermal_share: filter::lag_share(0.5, DT),
            resistance_per_k: 0.0039,
            ..servo()
        },
        hinge(),
    );
    rig.run(6.0, |_| 0.5, -0.6);
    near("rise", rig.memory.rise_k, 36.0, 0.01);
    near("droop", 0.5 - rig.q, 0.04 * 1.1404, 1e-5);
}

/// `p` with a loop that is late by `delay_s`.
fn late(p: ServoDrive<f64>, delay_s: f64) -> ServoDrive<f64> {
    ServoDrive { loop_delay_steps: delay_s / DT, ..p }
}

#[test]
fn torque_arrives_after_the_loops_delay() {
    // an error of 0.1 rad asks for 1.5 N·m. After 2.25 steps: nothing in two, three quarters in the third
    // (the rest is still what was asked for before)
    let mut rig = Rig::new(late(servo(), 0.00225), hinge());
    rig.run(0.01, |_| 0.0, 0.0);
    for want in [0.0, 0.0, 1.125, 1.5, 1.5] {
        rig.step(0.1, 0.0);
        near("torque", rig.motor_nm, want, 1e-12);
    }
    // back-EMF is no part of the loop: it brakes at once
    let coasting =
        ServoDrive { kp_nm_per_rad: 0.0, kd_nms_per_rad: 0.0, kd_min_nms_per_rad: 0.2, ..servo() };
    let mut rig = Rig::new(late(coasting, 0.01), hinge());
    rig.qd = 2.0;
    rig.step(0.0, 0.0);
    near("back-EMF", rig.motor_nm, -0.4, 1e-12);
}

#[test]
fn damping_follows_its_low_pass() {
    // ω rises by 2 rad/s a step; kd 0.5; a third of the way per step. From rest at speed 0: ω_f = 0, 2/3, 16/9
    let p = ServoDrive { kp_nm_per_rad: 0.0, kd_nms_per_rad: 0.5, ..servo() };
    let mut rig = Rig::new(ServoDrive { speed_low_pass_share: 1.0 / 3.0, ..p }, hinge());
    for (speed_radps, want_nm) in [(0.0, 0.0), (2.0, -1.0 / 3.0), (4.0, -8.0 / 9.0)] {
        rig.qd = speed_radps;
        rig.step(0.0, 0.0);
        near("damping", rig.motor_nm, want_nm, 1e-12);
    }
    // back-EMF is no part of the loop
    let coasting = ServoDrive { kd_nms_per_rad: 0.0, kd_min_nms_per_rad: 0.2, ..p };
    let mut rig = Rig::new(ServoDrive { speed_low_pass_share: 1.0 / 3.0, ..coasting }, hinge());
    rig.qd = 2.0;
    rig.step(0.0, 0.0);
    near("back-EMF", rig.motor_nm, -0.4, 1e-12);
}

#[test]
fn late_damping_is_stable_up_to_a_quarter_turn() {
    // ω' = −kd/J·ω(t − d) rings for good at kd·d/J = π/2. 20 ms and half a step (torque holds for one), J =
    // 0.0122 kg·m²: kd = 0.9349 N·m·s/rad. 2 % off: its growth is π/2/(1 + π²/4)·Δ(kd/J) = 0.453·1.53 = 0.69
    // /s, e^2.8 = 16 in 4 s
    let limit = 0.5 * std::f64::consts::PI * 0.0122 / 0.0205;
    let growth = |kd: f64| {
        let p = ServoDrive { kp_nm_per_rad: 0.0, kd_nms_per_rad: kd, ..servo() };
        let mut rig = Rig::new(late(p, 0.02), hinge());
        // in a step of its own: it did not move before
        rig.step(0.0, 0.0);
        rig.qd = 1.0;
        let mut greatest = |from: f64| {
            rig.run(from, |_| 0.0, 0.0);
            let mut most = 0.0_f64;
            for _ in 0..100 {
                rig.step(0.0, 0.0);
                most = most.max(rig.qd.abs());
            }
            most
        };
        let first = greatest(1.0);
        greatest(3.9) / first
    };
    let (dies, grows) = (growth(0.98 * limit), growth(1.02 * limit));
    near("dies", dies, 1.0 / 16.0, 0.02);
    near("grows", grows, 16.0, 4.0);
}

#[test]
fn a_late_loop_rings_beyond_its_phase_margin() {
    // |kp + i·kd·ω| = J·ω² at ω = 39.6 rad/s, where kd gives atan(0.792) = 0.670 rad: that is 16.9 ms, half a step of them the step's own
    let left = |delay_s: f64| {
        let mut rig = Rig::new(late(servo(), delay_s), hinge());
        rig.run(2.0, |_| 0.01, 0.0);
        let mut most = 0.0_f64;
        for _ in 0..500 {
            rig.step(0.01, 0.0);
            most = most.max((rig.q - 0.01).abs());
        }
        most
    };
    assert!(left(0.0) < 1e-7);
    assert!(left(0.013) < 1e-3, "well within it dies: {}", left(0.013));
    assert!(left(0.020) > 0.1, "beyond it grows: {}", left(0.020));
}

#[test]
fn short_delays_are_smooth() {
    // with 1 µs, 1 % of a step and 1 step the motion changes in proportion to the delay
    let after = |delay_s: f64| {
        let mut rig = Rig::new(late(servo(), delay_s), hinge());
        rig.run(0.05, |t| if t < 0.005 { 0.0 } else { 0.1 }, 0.0);
        rig.q
    };
    let none = after(0.0);
    let per_s = (after(1e-6) - none) / 1e-6;
    near("1 %", (after(1e-5) - none) / 1e-5, per_s, 1e-3 * per_s.abs());
    near("a step", (after(1e-3) - none) / 1e-3, per_s, 0.1 * per_s.abs());
}

#[test]
fn ripple_repeats_with_the_angle() {
    // held by 15 N·m/rad against 0.05·sin(16 q): 15·(c − q) + 0.05·sin(16·q) = 0
    let mut rig =
        Rig::new(ServoDrive { ripple_nm: 0.05, ripple_per_turn: 16.0, ..servo() }, hinge());
    for command in [0.05, 0.8, -1.3] {
        rig.run(2.0, |_| command, 0.0);
        near("balance", 15.0 * (command - rig.q) + 0.05 * (16.0 * rig.q).sin(), 0.0, 1e-6);
    }
}

#[test]
fn working_neighbours_slow_a_joint_down() {
    // Envelope of the XM430 at 12 V with kd_min 0 runs free at 9.366 rad/s (the line's end); 4 A of
    // neighbours through 0.5 Ω leave 10 V: 7.805 rad/s
    let p = ServoDrive {
        kd_nms_per_rad: 0.0,
        tau_max_nm: 1.94,
        tau_brake_max_nm: 2.2,
        stall_nm_per_volt: (1.94 + 0.8 * 1.54 / 6.8) / 12.0,
        taper_nms_per_rad: 1.54 / 6.8,
        ..servo()
    };
    let supply = Supply { open_v: 12.0, resistance_ohm: 0.5, share: filter::lag_share(0.005, DT) };
    for (others, want) in [(0.0, 9.3662), (4.0, 7.8052)] {
        let mut rig = Rig::new(p, hinge());
        for _ in 0..2000 {
            rig.volt = supply::settle_v(&supply, rig.volt, others);
            rig.step(1e3, 0.0);
        }
        near("free speed", rig.qd, want, 1e-3);
    }
}

#[test]
fn a_lane_that_does_not_need_a_stage_is_not_touched_by_it() {
    // every feature switched on for a servo that has none of them: the same bits as without
    let all = DriveFeatures {
        delay: true,
        low_pass: true,
        profile: true,
        command_damping: true,
        speed_low_pass: true,
        feed_forward: true,
        dead_band: true,
        integral: true,
        loop_delay: true,
        back_drive: true,
        winding: true,
        thermal: true,
        current_limit: true,
        stribeck: true,
        load_friction: true,
        load_stribeck: true,
        saturation: true,
        asymmetry: true,
        ripple: true,
        gear: true,
        motor_encoder: true,
    };
    assert_eq!(DriveFeatures::of(&servo()), DriveFeatures::default());
    assert_eq!(all.or(DriveFeatures::default()), all);
    let p: ServoDrive<f32> = PerLane::splat(&servo());
    let h: JointPassive<f32> = PerLane::splat(&JointPassive {
        friction_nm: 0.038,
        damping_nms_per_rad: 0.0064,
        ..hinge()
    });
    let (dt, bus_v) = (Step::<f32>::new(DT, false), 12.0_f32);
    let stop = Stop::new(&Default::default(), 1.0 / 0.0122);
    let mut memories: [JointMemory<f32>; 2] = [PerLane::splat(&JointMemory::rest(0.0, 0.0)); 2];
    let mut at = [(0.0_f32, 0.0_f32); 2];
    let mut late = WantedTorques::new(1);
    late.set_steps(0, 5); // as a neighbour's delay of four steps makes it
    for k in 0..400 {
        let command = (k as f32 * 0.02).sin();
        late.begin_step();
        for (i, f) in [DriveFeatures::default(), all].into_iter().enumerate() {
            let (q, qd) = at[i];
            let m = &mut memories[i];
            let stop = StopAt { law: &stop, free_radps2: 0.0 };
            let d = step::start(f, &p, &h, m, late.joint(0), &dt, bus_v, command, q, qd, 0.0, stop);
            let t = d.torque;
            let next = (0.0122 * qd + dt.dt_s * t.now_nm)
                / (0.0122 + dt.dt_s * (t.damping_nms_per_rad + dt.dt_s * t.stiffness_nm_per_rad));
            step::finish(f, &p, &h, m, &dt, &d, dt.dt_s * next, qd, next);
            at[i] = (q + dt.dt_s * next, next);
        }
        late.end_step();
        // the profile's own rounding is all that may differ
        assert!((at[0].0 - at[1].0).abs() < 1e-5, "step {k}: {at:?}");
    }
}
