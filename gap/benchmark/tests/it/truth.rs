//! The truth simulator against closed forms and conservation laws.

use caudata_gap_benchmark::generate::Rig;
use caudata_gap_benchmark::hidden::CATALOGUE;
use caudata_gap_benchmark::truth::drive::{self, AUX, BRISTLE, Firmware, HEAT, ROTOR, ROTOR_SPEED};
use caudata_gap_benchmark::truth::sim::{SAMPLE_S, STEP_S};
use caudata_gap_benchmark::truth::tree::{Scratch, Tree};
use caudata_gap_benchmark::truth::{Commands, Dense, JointSpec, Sim, Spec};

/// The rig with motors, friction and firmware taken out: swings freely.
fn limp(rig: &Rig) -> Spec {
    let mut spec = Spec::nominal(&rig.model);
    for p in &mut spec.joints {
        p.duty_limit = 0.0;
        p.ke_vs_per_rad = 0.0;
        p.coulomb_nm = 0.0;
        p.viscous_nms_per_rad = 0.0;
        p.rotor_kgm2 = 0.0;
        p.stops_rad = (-100.0, 100.0);
    }
    spec
}

fn hold(rad: &[f64], seconds: f64) -> (Commands, f64) {
    let commands = Commands { sent_s: vec![0.0], rows_rad: vec![rad.to_vec()], lost: vec![false] };
    (commands, seconds)
}

fn run(rig: &Rig, spec: &Spec, rad: &[f64], seconds: f64) -> Dense {
    let (commands, seconds) = hold(rad, seconds);
    Sim::new(&rig.model, spec).run(&commands, seconds, &vec![0.0; rad.len()], None)
}

/// Times at which a channel crosses zero upwards, s, in proportion between samples.
fn upward(channel: &[f64]) -> Vec<f64> {
    (1..channel.len())
        .filter(|&k| channel[k - 1] < 0.0 && channel[k] >= 0.0)
        .map(|k| {
            let part = -channel[k - 1] / (channel[k] - channel[k - 1]);
            (k as f64 - 1.0 + part) * SAMPLE_S
        })
        .collect()
}

#[test]
fn a_pendulum_swings_with_its_period() {
    // I = 0.0006 + 0.4·0.1² = 0.0046 kg·m², m·g·l = 0.3924 N·m: T₀ = 2π·√(0.0046/0.3924) = 0.680287 s. At 1
    // rad of amplitude the period is T₀·(1 + 1/16 + 11/3072 + …) = T₀·1.066331 (complete elliptic integral of
    // sin ½).
    let rig = Rig::bench("pendulum").unwrap();
    let dense = run(&rig, &limp(&rig), &[1.0], 8.0);
    let times = upward(&dense.pos_rad[0]);
    let period = (times[times.len() - 1] - times[0]) / (times.len() - 1) as f64;
    // 1/agm(1, cos ½): 1.0663415…
    let (mut a, mut b) = (1.0_f64, 0.5_f64.cos());
    for _ in 0..8 {
        (a, b) = ((a + b) / 2.0, (a * b).sqrt());
    }
    let want = std::f64::consts::TAU * (0.0046_f64 / 0.3924).sqrt() / a;
    assert!((period / want - 1.0).abs() < 1e-5, "{period} against {want}");
}

#[test]
fn where_an_inertia_is_free_a_mass_does_what_its_centre_does() {
    // the centre 20 mm farther out and a rotor of 0.001: moment of gravity 0.4·0.12 = 0.048 kg·m, inertia about the hinge 0.0006 + 0.4·0.12² + 0.001 = 0.00736;
    // 1.2 of the mass: 0.48·0.1 = 0.048, and 1.2·0.0006 + 0.48·0.1² = 0.00552, which a rotor of 0.00184 makes the same
    let rig = Rig::bench("pendulum").unwrap();
    let arm = Spec::link_of(&rig.model, 0);
    let mut centre = limp(&rig);
    centre.links[arm].com_offset_m = [0.0, 0.0, -0.02];
    centre.joints[0].rotor_kgm2 = 0.001;
    let mut mass = limp(&rig);
    mass.links[arm].mass_scale = 1.2;
    mass.joints[0].rotor_kgm2 = 0.001_84;
    let apart = |a: &Spec, b: &Spec| {
        let [a, b] = [a, b].map(|s| run(&rig, s, &[1.0], 4.0));
        let apart = a.pos_rad[0].iter().zip(&b.pos_rad[0]);
        apart.map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
    };
    assert!(apart(&centre, &mass) < 1e-9);
    // 1.1 of the mass with the same moment: 0.000 66 + 0.048²/0.44 = 0.005 896; the centre 20 mm farther out has
    // that with 0.2273 of its inertia
    let mut both = limp(&rig);
    both.links[arm].mass_scale = 1.1;
    both.links[arm].com_offset_m = [0.0, 0.0, 0.1 - 0.048 / 0.44];
    centre.joints[0].rotor_kgm2 = 0.0;
    centre.links[arm].inertia_scale = (0.000_66 + 0.048 * 0.048 / 0.44 - 0.005_76) / 0.0006;
    assert!(apart(&centre, &both) < 1e-9);
    let h = CATALOGUE.iter().find(|h| h.id == "link_com").unwrap();
    let same = h.same_beside(1, &["link_com", "armature"]);
    assert!(
        same.contains(&("link_mass", "armature")) && same.contains(&("point_mass", "point_mass"))
    );
    assert!(!same.contains(&("link_inertia", "armature")));
    assert!(h.same_beside(1, &["link_com"]).is_empty());
    assert!(h.same_beside(1, &["link_com", "kp_error"]).is_empty());
    assert!(h.same_beside(2, &["link_com", "armature"]).is_empty());
}

#[test]
fn a_double_pendulum_keeps_its_energy() {
    let rig = Rig::bench("arm").unwrap();
    let spec = limp(&rig);
    let tree = Tree::new(&rig.model, &spec.links, spec.gravity_mps2);
    let dense = run(&rig, &spec, &[1.4, 0.9], 10.0);
    let mut scratch = Scratch::default();
    let mut energy = |k: usize| {
        let q = [dense.pos_rad[0][k], dense.pos_rad[1][k]];
        let v = [dense.vel_radps[0][k], dense.vel_radps[1][k]];
        tree.energy(&q, &v, &mut scratch)
    };
    // measured against what could be turned into motion: (0.22·0.08 + 0.18·0.12 + 0.18·0.06)·9.81 = 0.49 J
    let first = energy(0);
    let last = energy(dense.pos_rad[0].len() - 1);
    assert!((last - first).abs() < 1e-6 * 0.49, "{first} to {last}");
}

#[test]
fn a_double_pendulum_starts_as_lagrange_says() {
    // M₂₂ = 0.0003 + 0.18·0.06² = 0.000948; M₁₂ = M₂₂ + 0.18·0.12·0.06·cos q₂; gravity on the second:
    // 0.18·9.81·0.06·sin(q₁ + q₂).
    let rig = Rig::bench("arm").unwrap();
    let spec = limp(&rig);
    let tree = Tree::new(&rig.model, &spec.links, spec.gravity_mps2);
    let (q, v) = ([0.3, 0.8], [1.5, -2.0]);
    let (mut mass, mut bias) = (vec![0.0; 4], vec![0.0; 2]);
    tree.equations(&q, &v, &mut Scratch::default(), &mut mass, &mut bias);
    let h = 0.18 * 0.12 * 0.06;
    let m22 = 0.000_948;
    let m11 = 0.0004
        + 0.22 * 0.08 * 0.08
        + 0.0003
        + 0.18 * (0.12 * 0.12 + 0.06 * 0.06)
        + 2.0 * h * 0.8_f64.cos();
    assert!((mass[3] - m22).abs() < 1e-12);
    assert!((mass[2] - (m22 + h * 0.8_f64.cos())).abs() < 1e-12);
    assert!((mass[0] - m11).abs() < 1e-12);
    let g2 = 0.18 * 9.81 * 0.06 * 1.1_f64.sin();
    let g1 = (0.22 * 0.08 + 0.18 * 0.12) * 9.81 * 0.3_f64.sin() + g2;
    let s = h * 0.8_f64.sin();
    // centrifugal and Coriolis: −h·sin q₂·(2·q̇₁·q̇₂ + q̇₂²) and h·sin q₂·q̇₁²
    assert!((bias[0] - (g1 - s * (2.0 * 1.5 * -2.0 + 4.0))).abs() < 1e-12);
    assert!((bias[1] - (g2 + s * 2.25)).abs() < 1e-12);
}

fn pendulum_joint() -> JointSpec {
    let rig = Rig::bench("pendulum").unwrap();
    Spec::nominal(&rig.model).joints[0].clone()
}

#[test]
fn a_motor_at_full_voltage_runs_along_its_line() {
    // The envelope of the robot file at 12 V: stall 1.94 + 0.8·1.54/6.8 = 2.121176 N·m beyond the flat limit
    // of 1.94; no load at 9.366 rad/s.
    let p = pendulum_joint();
    let torque = |w: f64| p.kt_nm_per_a * drive::current_a(&p, 12.0, w, 0.0);
    assert!((torque(0.0) - 1.94).abs() < 1e-9);
    assert!((torque(4.2) - 1.17).abs() < 1e-9);
    assert!((torque(7.6) - 0.40).abs() < 1e-9);
    assert!(torque(9.366_234).abs() < 1e-6);
    // a winding 60 K warmer: 1/1.234 of what the voltage leaves
    assert!((p.kt_nm_per_a * drive::current_a(&p, 12.0, 4.2, 60.0) - 1.17 / 1.234).abs() < 1e-9);
    // against the motion the braking limit: 2.2 N·m
    assert!(
        (p.kt_nm_per_a * drive::current_a(&p, 12.0, -4.2, 0.0) - 1.94).abs() < 1e-9
            || p.brake_current_a > p.drive_current_a
    );
    assert!((p.kt_nm_per_a * drive::current_a(&p, -12.0, 4.2, 0.0) + 2.2).abs() < 1e-9);
}

#[test]
fn a_hold_droops_by_load_over_gain() {
    // no friction: kp·(u − q) = m·g·l·sin q; at u = 1.2: q = 1.2 − 0.3924·sin(q)/15
    let rig = Rig::bench("pendulum").unwrap();
    let mut spec = Spec::nominal(&rig.model);
    spec.joints[0].coulomb_nm = 0.0;
    let dense = run(&rig, &spec, &[1.2], 3.0);
    let q = *dense.pos_rad[0].last().unwrap();
    let mut want = 1.2_f64;
    for _ in 0..50 {
        want = 1.2 - 0.3924 * want.sin() / 15.0;
    }
    // within a count of the encoder, on which the loop sits
    assert!((q - want).abs() < 0.0016, "{q} against {want}");
    // the current is what the load asks for: 0.3924·sin(q)/1.11, on average over the steps of encoder and
    // bridge
    let tail = &dense.current_a[0][dense.current_a[0].len() - 500..];
    let mean = tail.iter().sum::<f64>() / tail.len() as f64;
    assert!((mean - 0.3924 * want.sin() / 1.11).abs() < 0.01, "{mean}");
}

#[test]
fn friction_settles_on_the_stribeck_curve() {
    let mut p = pendulum_joint();
    p.coulomb_nm = 0.04;
    p.stribeck_nm = 0.03;
    p.stribeck_speed_radps = 0.1;
    for v in [0.02, 0.1, 0.5, 3.0, -0.1] {
        let bound = drive::friction_bound_nm(&p, v, 0.0, 0.0, 0.0, 0.0);
        let mut z = 0.0;
        let mut force = 0.0;
        // two presliding ways are enough to be dragged along
        let steps = (0.02 / v.abs() / STEP_S) as usize + 200;
        for _ in 0..steps {
            let (f, rate) = drive::lugre(&p, bound, v, z, STEP_S);
            z += STEP_S * rate;
            force = f;
        }
        let want = v.signum() * (0.04 + 0.03 * (-(v / 0.1) * (v / 0.1)).exp()) + 0.0064 * v;
        assert!((force - want).abs() < 2e-4, "at {v}: {force} against {want}");
    }
}

#[test]
fn friction_holds_below_its_bound() {
    // a bristle of 0.038/0.002 = 19 N·m/rad carries 0.02 N·m at 1.05 mrad, and stays there
    let p = pendulum_joint();
    let bound = drive::friction_bound_nm(&p, 0.0, 0.0, 0.0, 0.0, 0.0);
    let (force, rate) = drive::lugre(&p, bound, 0.0, 0.02 / 19.0, STEP_S);
    assert!((force - 0.02).abs() < 1e-12 && rate == 0.0);
}

#[test]
fn in_the_gap_nothing_is_passed_on() {
    let mut p = pendulum_joint();
    p.half_gap_rad = 0.01;
    assert_eq!(drive::gear_nm(&p, 0.0099, 3.0), 0.0);
    assert_eq!(drive::gear_nm(&p, -0.0099, -3.0), 0.0);
    // 1 mrad into the teeth at rest: 1.5 N·m; leaving them it never pulls
    assert!((drive::gear_nm(&p, 0.011, 0.0) - 1.5).abs() < 1e-9);
    assert_eq!(drive::gear_nm(&p, 0.011, -10.0), 0.0);
    assert!((drive::gear_nm(&p, -0.011, 0.0) + 1.5).abs() < 1e-9);
    // the flow of a link in the middle of the gap: gravity alone
    let x = {
        let mut x = [0.0; AUX];
        x[ROTOR] = 0.5;
        x[ROTOR_SPEED] = 0.2;
        x
    };
    assert_eq!(drive::flow(&p, 0.5, 0.0, &x, 6.0, 0.0, 0.0, STEP_S).on_link_nm, 0.0);
}

#[test]
fn free_travel_at_the_output_is_the_gap() {
    // The rotor is stuck (friction far beyond the load); gravity lays the pendulum against one flank left of
    // the vertical, the other right of it.
    let rig = Rig::bench("pendulum").unwrap();
    let at = |u: f64| {
        let mut spec = Spec::nominal(&rig.model);
        spec.joints[0].half_gap_rad = 0.01;
        spec.joints[0].duty_limit = 0.0;
        spec.joints[0].coulomb_nm = 20.0;
        spec.joints[0].rotor_kgm2 = 1.0;
        let dense = run(&rig, &spec, &[u], 4.0);
        dense.pos_rad[0].last().unwrap() - u
    };
    // bend of teeth 0.3924·sin(0.6)/1500 and of the bristle (10,000 N·m/rad) on top
    let bend = 0.3924 * 0.6_f64.sin() * (1.0 / 1500.0 + 1.0 / 10_000.0);
    assert!((at(0.6) + 0.01 + bend).abs() < 5e-5, "{}", at(0.6));
    assert!((at(-0.6) - 0.01 - bend).abs() < 5e-5, "{}", at(-0.6));
}

#[test]
fn impacts_on_the_teeth_lose_energy() {
    let mut p = pendulum_joint();
    p.half_gap_rad = 0.01;
    p.coulomb_nm = 0.0;
    p.viscous_nms_per_rad = 0.0;
    p.duty_limit = 0.0;
    p.ke_vs_per_rad = 0.0;
    // rotor against a link of 0.0046 kg·m², no gravity: semi-implicit steps of a twentieth
    let (mut q, mut v, mut x) = (0.0_f64, -0.4_f64, [0.0; AUX]);
    x[ROTOR_SPEED] = 1.0;
    let energy = |v: f64, w: f64| 0.5 * 0.0046 * v * v + 0.5 * 0.0022 * w * w;
    let start = energy(v, x[ROTOR_SPEED]);
    let mut most = 0.0_f64;
    let dt = STEP_S / 20.0;
    for _ in 0..200_000 {
        let flow = drive::flow(&p, q, v, &x, 0.0, 0.0, 0.0, dt);
        v += dt * flow.on_link_nm / 0.0046;
        x[ROTOR_SPEED] += dt * flow.rate[ROTOR_SPEED];
        q += dt * v;
        x[ROTOR] += dt * x[ROTOR_SPEED];
        if drive::gear_nm(&p, x[ROTOR] - q, x[ROTOR_SPEED] - v) == 0.0 {
            most = most.max(energy(v, x[ROTOR_SPEED]));
        }
    }
    assert!(most <= start * 1.001, "{most} from {start}");
    // momentum is kept: 0.0022 − 0.00184
    let momentum = 0.0046 * v + 0.0022 * x[ROTOR_SPEED];
    assert!((momentum - 0.000_36).abs() < 1e-6, "{momentum}");
    assert!(energy(v, x[ROTOR_SPEED]) < 0.5 * start);
}

#[test]
fn a_command_arrives_after_its_delay_and_its_filter() {
    let rig = Rig::bench("pendulum").unwrap();
    let step = |change: &dyn Fn(&mut Spec)| {
        let mut spec = Spec::nominal(&rig.model);
        change(&mut spec);
        let commands = Commands {
            sent_s: vec![0.0, 0.1],
            rows_rad: vec![vec![0.0], vec![0.5]],
            lost: vec![false; 2],
        };
        Sim::new(&rig.model, &spec).run(&commands, 1.0, &[0.0], None)
    };
    let begins =
        |d: &Dense| d.pos_rad[0].iter().position(|q| *q > 0.005).unwrap() as f64 * SAMPLE_S;
    let plain = begins(&step(&|_| ()));
    let late = begins(&step(&|s| s.command_delay_s = 0.023));
    assert!((late - plain - 0.023).abs() < 0.0011, "{late} after {plain}");
    // a lost frame: nothing ever moves
    let mut spec = Spec::nominal(&rig.model);
    spec.joints[0].coulomb_nm = 0.0;
    let commands = Commands {
        sent_s: vec![0.0, 0.1],
        rows_rad: vec![vec![0.0], vec![0.5]],
        lost: vec![false, true],
    };
    let still = Sim::new(&rig.model, &spec).run(&commands, 1.0, &[0.0], None);
    assert!(still.pos_rad[0].iter().all(|q| q.abs() < 1e-3));
    // low-pass of 50 ms in the firmware: after 50 ms 1 − 1/e of the step is in the volts (no speed, no
    // friction)
    let mut p = pendulum_joint();
    p.low_pass_s = 0.05;
    p.duty_steps = 1e9;
    let mut firmware = Firmware::at_rest(0.0, 0.0);
    let mut volts = 0.0;
    for _ in 0..100 {
        volts = firmware.tick(&p, 0.0005, 0.01, 0.0, 0.0, 12.0, 1.0);
    }
    let want = 15.0 * 0.01 * (1.0 - (-1.0_f64).exp()) * p.volt_per_nm;
    assert!((volts - want).abs() < 1e-6, "{volts} against {want}");
}

#[test]
fn the_integrator_takes_the_droop_away() {
    let rig = Rig::bench("pendulum").unwrap();
    let mut spec = Spec::nominal(&rig.model);
    spec.joints[0].coulomb_nm = 0.0;
    spec.joints[0].ki_nm_per_rad_s = 60.0;
    let dense = run(&rig, &spec, &[1.2], 4.0);
    assert!((dense.pos_rad[0].last().unwrap() - 1.2).abs() < 0.0016);
}

#[test]
fn supply_sags_by_resistance_times_what_the_bridges_take() {
    let rig = Rig::bench("pendulum").unwrap();
    let mut spec = Spec::nominal(&rig.model);
    spec.supply_ohm = 10.0;
    let dense = run(&rig, &spec, &[1.57], 2.0);
    let bus = dense.bus_v.last().unwrap();
    let i = dense.current_a[0].last().unwrap();
    // at rest all of the motor's voltage is across its winding
    let duty = i * spec.joints[0].resistance_ohm / bus;
    assert!((bus - (12.0 - 10.0 * i * duty)).abs() < 0.02, "{bus} with {i}, {duty}");
    assert!(i.abs() > 0.25 && *bus < 11.8, "{bus} with {i}");
}

#[test]
fn a_winding_warms_to_its_steady_rise() {
    let mut p = pendulum_joint();
    p.thermal_rise_k_per_a2 = 15.0;
    p.thermal_time_s = 0.5;
    let mut x = [0.0; AUX];
    let mut last = 0.0;
    for _ in 0..200_000 {
        let flow = drive::flow(&p, 0.0, 0.0, &x, 5.0, 0.0, 0.0, STEP_S);
        x[HEAT] += 1e-4 * flow.rate[HEAT];
        x[BRISTLE] = 0.0;
        last = flow.current_a;
    }
    assert!((x[HEAT] - 15.0 * last * last).abs() < 1e-6);
}

#[test]
fn the_salamander_hangs_in_the_air_and_stays_finite() {
    // The whole robot held at its head: 16 servos, springs and play at once.
    let root =
        std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../../robots/polymander.robot.toml");
    let model = caudata_model::RobotModel::load(&root).unwrap();
    let mut spec = Spec::nominal(&model);
    spec.supply_v = 14.0;
    let commands = Commands {
        sent_s: vec![0.0],
        rows_rad: vec![model.nominal_pos_rad().to_vec()],
        lost: vec![false],
    };
    let mut sim = Sim::new(&model, &spec);
    let dense = sim.run(&commands, 0.2, &[0.0; 16], None);
    assert!(dense.sane);
    // yaw joints carry nothing while the robot hangs straight; a fore knee carries its lower leg: within the
    // droop that 0.2 N·m make
    for (a, (q, want)) in dense.pos_rad.iter().zip(model.nominal_pos_rad()).enumerate() {
        assert!((q.last().unwrap() - want).abs() < 0.05, "joint {a}");
    }
}
