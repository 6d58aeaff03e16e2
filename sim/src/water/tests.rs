//! A single body in water against closed forms.

use std::f64::consts::PI;
use std::path::Path;

use super::*;

const G: f64 = 9.81;
const LEVEL: [[f64; 3]; 3] = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];

#[track_caller]
fn near(what: &str, got: f64, want: f64, tolerance: f64) {
    assert!((got - want).abs() <= tolerance, "{what}: got {got}, want {want} ± {tolerance}");
}

/// A body of half extents `half` around its origin; nothing else.
fn body(half: [f64; 3], roundness: f64, displaced_kg: f64) -> WaterLink<f64> {
    WaterLink { half_m: half, roundness, displaced_kg, ..WaterLink::default() }
}

fn still() -> Surface<f64> {
    Surface { level_m: 0.0, current_mps: [0.0; 3], gravity_mps2: [0.0, 0.0, -G] }
}

fn level_at(z: f64, vel: [f64; 3]) -> LinkMotion<f64> {
    LinkMotion { rotation: LEVEL, origin_z_m: z, com_vel_mps: vel, angvel_radps: [0.0; 3] }
}

/// Height and vertical velocity of a body of `mass` kg after `time` s, semi-implicit steps of `dt`; `each`
/// sees every step.
fn fall(
    p: &WaterLink<f64>,
    mass: f64,
    (mut z, mut v): (f64, f64),
    time: f64,
    mut each: impl FnMut(f64, f64, f64),
) -> (f64, f64) {
    let dt = 2e-4;
    for k in 0..(time / dt).round() as usize {
        let f = forces(p, &level_at(z, [0.0, 0.0, v]), &still());
        let inertia = mass + f.added_mass_kg[2] + dt * (f.damping_ns_per_m[2] + f.heave_ns_per_m);
        v += dt * (f.force_n[2] - mass * G) / inertia;
        z += dt * v;
        each((k + 1) as f64 * dt, z, v);
    }
    (z, v)
}

#[test]
fn terminal_velocity_linear_and_quadratic() {
    // 0.2 kg displacing 0.1: 0.981 N of net weight. Linear 0.5 N·s/m: 1.962 m/s
    let linear = WaterLink { linear_force: [0.0, 0.0, 0.5], ..body([0.05; 3], 0.0, 0.1) };
    near("linear", fall(&linear, 0.2, (-5.0, 0.0), 5.0, |_, _, _| ()).1, -1.962, 1e-3);
    // quadratic 2 N·s²/m²: √(0.981/2) = 0.70036 m/s
    let quadratic = WaterLink { quadratic_force: [0.0, 0.0, 2.0], ..body([0.05; 3], 0.0, 0.1) };
    near("quadratic", fall(&quadratic, 0.2, (-5.0, 0.0), 5.0, |_, _, _| ()).1, -0.700_36, 1e-4);
    // and upwards, lighter than water: the same way round
    near(
        "rises",
        fall(&quadratic, 0.05, (-9.0, 0.0), 3.0, |_, _, _| ()).1,
        (0.05 * G / 2.0_f64).sqrt(),
        1e-4,
    );
}

#[test]
fn box_floats_where_it_displaces_its_weight() {
    // 0.7 of the displaced mass, a box 0.1 m high: 7 cm below the surface, so its centre is at −2 cm
    let p = WaterLink { heave_ns_per_m: 5.0, ..body([0.2, 0.1, 0.05], 0.0, 1.0) };
    near("float line", fall(&p, 0.7, (0.1, 0.0), 20.0, |_, _, _| ()).0, -0.02, 1e-5);
}

#[test]
fn ball_floats_at_its_cubic() {
    // half the density of water: half under
    let p = WaterLink { heave_ns_per_m: 5.0, ..body([0.1; 3], 1.0, 1.0) };
    near("half", fall(&p, 0.5, (0.3, 0.0), 20.0, |_, _, _| ()).0, 0.0, 1e-5);
    // 3x² − 2x³ = 0.7 at x = 0.63668: centre at 0.1 − 0.2·0.63668
    near("0.7", fall(&p, 0.7, (0.3, 0.0), 20.0, |_, _, _| ()).0, 0.1 - 0.2 * 0.636_68, 1e-4);
}

#[test]
fn bobs_at_its_frequency_and_dies_at_its_rate() {
    // box 0.4 × 0.2 × 0.1 m of water 8 kg, itself 5.6 kg: restoring ρ·A·g = 1000·0.08·9.81 = 784.8 N/m. With
    // k_d = 12 N·s/m at 0.7 immersion: decay k_d·0.7/(2m) = 0.75 /s, ω = √(784.8/5.6 − 0.5625) = 11.814
    // rad/s. Small bobs (5 mm).
    let p = WaterLink { heave_ns_per_m: 12.0, ..body([0.2, 0.1, 0.05], 0.0, 8.0) };
    let (period, decay) = bob(&p, 5.6);
    near("period", period, 2.0 * PI / 11.814, 0.01 * 2.0 * PI / 11.814);
    near("decay", decay, 0.75, 0.0075);
}

#[test]
fn added_mass_slows_the_bob() {
    // as above, and 1.0 of the displaced water carried at 0.7 immersion: 5.6 + 5.6 kg: ω = √(784.8/11.2 −
    // 0.14) = 8.362, decay 0.375
    let p = WaterLink {
        heave_ns_per_m: 12.0,
        added_mass_kg: [0.0, 0.0, 8.0],
        ..body([0.2, 0.1, 0.05], 0.0, 8.0)
    };
    let (period, decay) = bob(&p, 5.6);
    near("period", period, 2.0 * PI / 8.362, 0.01 * 2.0 * PI / 8.362);
    near("decay", decay, 0.375, 0.01);
}

/// Period and decay rate of small bobs about the float line (centre at −0.02 m).
fn bob(p: &WaterLink<f64>, mass: f64) -> (f64, f64) {
    let mut peaks = Vec::new();
    let mut last = (0.0_f64, 0.0_f64);
    fall(p, mass, (-0.015, 0.0), 5.0, |t, z, v| {
        if last.1 > 0.0 && v <= 0.0 {
            peaks.push((t, z + 0.02));
        }
        last = (z, v);
    });
    let (first, end) = (peaks[0], peaks[4]);
    let span = end.0 - first.0;
    (span / 4.0, (first.1 / end.1).ln() / span)
}

#[test]
fn drag_works_in_link_axes() {
    // the link's x points along world y: moving along world y meets the x coefficient
    let turned = [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]];
    let p = WaterLink {
        linear_force: [0.1, 0.2, 0.3],
        quadratic_force: [1.0, 2.0, 3.0],
        linear_torque: [0.01, 0.02, 0.03],
        quadratic_torque: [0.1, 0.2, 0.3],
        ..body([0.05; 3], 0.0, 0.0)
    };
    let at = LinkMotion {
        rotation: turned,
        origin_z_m: -1.0,
        com_vel_mps: [0.0, 2.0, 0.0],
        angvel_radps: [3.0, 0.0, 0.0],
    };
    let f = forces(&p, &at, &still());
    // −(0.1·2 + 1·4)
    near("force", f.force_n[1], -4.2, 1e-12);
    // world x is the link's −y: −(0.02·3 + 0.2·9)
    near("torque", f.torque_nm[0], -1.86, 1e-12);
    near("secant damping", f.damping_ns_per_m[0], 0.1 + 1.0 * 2.0, 1e-12);
    near("secant damping", f.damping_nms_per_rad[1], 0.02 + 0.2 * 3.0, 1e-12);
    assert_eq!((f.force_n[0], f.force_n[2], f.torque_nm[1]), (0.0, 0.0, 0.0));
}

#[test]
fn moving_water_takes_along() {
    let p = WaterLink { quadratic_force: [1.0; 3], ..body([0.05; 3], 0.0, 0.0) };
    let stream = Surface { current_mps: [0.5, 0.0, 0.0], ..still() };
    near("at rest", forces(&p, &level_at(-1.0, [0.0; 3]), &stream).force_n[0], 0.25, 1e-12);
    near("with it", forces(&p, &level_at(-1.0, [0.5, 0.0, 0.0]), &stream).force_n[0], 0.0, 1e-12);
}

#[test]
fn centre_of_buoyancy_rights() {
    // 2 cm above the centre of mass, heeled by 0.1 rad about x: −m·g·h·sin 0.1
    let (s, c) = 0.1_f64.sin_cos();
    let p = WaterLink { buoyancy_m: [0.0, 0.0, 0.02], ..body([0.05; 3], 0.0, 2.0) };
    let at = LinkMotion {
        rotation: [[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]],
        ..level_at(-1.0, [0.0; 3])
    };
    let f = forces(&p, &at, &still());
    near("righting", f.torque_nm[0], -2.0 * G * 0.02 * s, 1e-12);
    near("lift", f.force_n[2], 2.0 * G, 1e-12);
}

#[test]
fn share_under_water() {
    let share = |p: &WaterLink<f64>, rotation, z: f64| {
        let at = LinkMotion { rotation, ..level_at(z, [0.0; 3]) };
        forces(p, &at, &still()).immersed
    };
    let flat = body([0.2, 0.1, 0.05], 0.0, 1.0);
    near("box", share(&flat, LEVEL, 0.025), 0.25, 1e-12);
    assert_eq!((share(&flat, LEVEL, 0.06), share(&flat, LEVEL, -0.06)), (0.0, 1.0));
    // stood on end (x up): 0.4 m high
    let on_end = [[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]];
    near("on end", share(&flat, on_end, 0.1), 0.25, 1e-12);
    // a ball in any attitude: x = 1/4 gives 3/16 − 1/32 = 0.15625
    let ball = body([0.1; 3], 1.0, 1.0);
    let (s, c) = 0.7_f64.sin_cos();
    let tilted = [[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]];
    near("ball", share(&ball, tilted, 0.05), 0.156_25, 1e-12);
    // a lying cylinder: 0.19550 at a quarter, 0.5 in the middle, 0.0520 at a tenth
    let log = body([0.3, 0.1, 0.1], 0.58, 1.0);
    for (z, want) in [(0.05, 0.195_5), (0.0, 0.5), (0.08, 0.052_0)] {
        near("log", share(&log, LEVEL, z), want, 0.01);
    }
}

#[test]
fn added_mass_keeps_the_energy_of_the_water() {
    // the gyroscopic force does no work: v·f + ω·τ = 0
    let p = WaterLink {
        added_mass_kg: [0.1, 1.0, 0.7],
        added_inertia_kgm2: [0.01, 0.03, 0.02],
        ..body([0.05; 3], 0.0, 0.0)
    };
    let at = LinkMotion {
        com_vel_mps: [0.3, -0.8, 0.5],
        angvel_radps: [1.0, -2.0, 0.4],
        ..level_at(-1.0, [0.0; 3])
    };
    let f = forces(&p, &at, &still());
    near("power", dot(f.force_n, at.com_vel_mps) + dot(f.torque_nm, at.angvel_radps), 0.0, 1e-12);
    // Munk's moment: moving askew, a body turns broadside: τ_z = −(m_y − m_x)·v_x·v_y
    let askew = forces(&p, &level_at(-1.0, [0.5, 0.2, 0.0]), &still());
    near("Munk", askew.torque_nm[2], -(1.0 - 0.1) * 0.5 * 0.2, 1e-12);
}

#[test]
fn polymander_has_the_drag_its_file_says() {
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("../robots/polymander.robot.toml");
    let model = RobotModel::load(&file).unwrap();
    let links = WaterLink::all(&model, &LaneParams::nominal(&model)).unwrap();
    // robot file: 0.011, 2.0, 2.0 N·s²/m² on a trunk link
    let trunk = &links[model.link_index("body_02").unwrap()];
    near("axial", trunk.quadratic_force[0], 0.011, 0.001);
    near("lateral", trunk.quadratic_force[1], 2.0, 0.1);
    near("vertical", trunk.quadratic_force[2], 2.0, 0.1);
    // it floats: 1.43 of its mass displaced
    let displaced: f64 = links.iter().map(|l| l.displaced_kg).sum();
    near("displaced", displaced / model.total_mass_kg(), 1.43, 1e-9);
    assert!(links.iter().all(|l| l.half_m.iter().all(|&h| h > 0.002 && h < 0.2)));
}

#[test]
fn one_lane_in_single_precision_agrees() {
    use crate::per_lane::PerLane;
    let p = WaterLink {
        quadratic_force: [1.0, 2.0, 3.0],
        heave_ns_per_m: 1.0,
        ..body([0.1, 0.05, 0.04], 0.58, 0.7)
    };
    let single: WaterLink<f32> = PerLane::splat(&p);
    let at = level_at(0.01, [0.3, -0.2, 0.1]);
    let f = forces(&p, &at, &still());
    let g = forces(
        &single,
        &LinkMotion {
            rotation: at.rotation.map(|r| r.map(|x| x as f32)),
            origin_z_m: 0.01_f32,
            com_vel_mps: at.com_vel_mps.map(|x| x as f32),
            angvel_radps: [0.0_f32; 3],
        },
        &Surface { level_m: 0.0_f32, current_mps: [0.0; 3], gravity_mps2: [0.0, 0.0, -G as f32] },
    );
    for i in 0..3 {
        near("force", f64::from(g.force_n[i]), f.force_n[i], 1e-5);
    }
}
