//! Contact against numbers worked by hand.

use caudata_random::{Key, Purpose, Stream};
use caudata_sim::{EngineConfig, InitialState, LaneParams, TerrainConfig, build};

use crate::conformance::robots;

/// With gravity tilted by θ the flat ground is an incline: it holds below tan θ = μ and slides above, within
/// half a degree.
#[test]
fn slides_where_the_tangent_is_the_friction() {
    slides_at_its_angle(&EngineConfig::default());
}

/// So it does with MuJoCo's friction, whose lift changes the load of the feet only while the slip changes.
#[test]
fn slides_at_the_same_angle_with_convex_friction() {
    slides_at_its_angle(&EngineConfig { convex_friction: true, ..EngineConfig::default() });
}

/// A table that slides at 1 m/s lifts with MuJoCo's friction (v_n follows μ·v_t until the contact opens, a
/// tenth of a millimetre higher), and does not with Coulomb's.
#[test]
fn a_sliding_foot_lifts_itself_with_convex_friction_only() {
    let model = robots::table();
    let highest = |convex_friction: bool| {
        let config = EngineConfig { convex_friction, ..EngineConfig::default() };
        let mut e = build(model.clone(), 1, &config, &TerrainConfig::default(), 1, 1).unwrap();
        let sliding =
            InitialState { base_vel_mps: [1.0, 0.0, 0.0], ..InitialState::nominal(&model) };
        e.reset(0, &sliding).unwrap();
        let start = e.state().com_pos_m[2];
        let mut highest = 0.0_f32;
        for _ in 0..10 {
            e.step(&[0.0], &[0.0; 6]).unwrap();
            highest = highest.max(e.state().com_pos_m[2] - start);
        }
        highest
    };
    let (coulomb, convex) = (highest(false), highest(true));
    assert!(coulomb < 1e-5, "with Coulomb's friction it rose by {coulomb} m");
    assert!(convex > 5e-5, "with MuJoCo's it rose by {convex} m only");
}

fn slides_at_its_angle(config: &EngineConfig) {
    let model = robots::table();
    let mu = 0.5_f64;
    let edge = mu.atan().to_degrees(); // 26.57°
    let angles = [edge - 0.5, edge + 0.5];
    let mut e = build(model.clone(), 2, config, &TerrainConfig::default(), 1, 1).unwrap();
    for (lane, degrees) in angles.iter().enumerate() {
        let (sin, cos) = degrees.to_radians().sin_cos();
        let tilted = LaneParams {
            gravity_mps2: [(9.81 * sin) as f32, 0.0, (-9.81 * cos) as f32],
            ..LaneParams::nominal(&model)
        };
        e.set_params(lane, &tilted).unwrap();
        e.reset(lane, &InitialState::nominal(&model)).unwrap();
    }
    let mut at_one_second = [0.0; 2];
    for period in 0..150 {
        e.step(&[0.0; 2], &[0.0; 12]).unwrap();
        if period == 49 {
            at_one_second = [e.state().com_pos_m[0], e.state().com_pos_m[3]].map(f64::from);
        }
    }
    let slid = [e.state().com_pos_m[0], e.state().com_pos_m[3]].map(f64::from);
    let (held, gone) = (slid[0] - at_one_second[0], slid[1] - at_one_second[1]);
    assert!(held < 1e-3, "half a degree below, it crept {held} m in 2 s");
    // half a degree above: g·(sin θ − μ·cos θ) = 9.81·sin 0.5°/cos 26.57° = 0.0957 m/s², from the start:
    // ½·0.0957·(3² − 1²) = 0.383 m
    assert!((gone - 0.383).abs() < 0.02, "half a degree above, it slid {gone} m");
}

/// Spawned 5 cm deep in the ground, the robot is pushed out without breaking down or flying off, and ends up
/// standing as it does otherwise.
#[test]
fn a_deep_start_is_pushed_out() {
    let model = robots::polymander();
    let config = EngineConfig::default();
    let mut e = build(model.clone(), 2, &config, &TerrainConfig::default(), 1, 1).unwrap();
    let deep = InitialState {
        base_z_m: Some(e.state().base_pos_m[2] - 0.05),
        ..InitialState::nominal(&model)
    };
    e.reset(1, &deep).unwrap();
    let targets = deep.joint_pos_rad.repeat(2);
    let mut highest = 0.0_f32;
    for _ in 0..150 {
        e.step(&targets, &[0.0; 12]).unwrap();
        highest = highest.max(e.state().com_pos_m[5]);
    }
    let s = e.state();
    assert!(!s.diverged[1]);
    // the centre of mass stands at about 0.1 m
    assert!(highest < 0.3, "it flew to {highest} m");
    let (normal, pushed_out) = (s.base_pos_m[2], s.base_pos_m[5]);
    assert!((pushed_out - normal).abs() < 0.01, "it stands at {pushed_out} instead of {normal} m");
}

/// In its nominal pose the robot stands as high as in MuJoCo 3.17 on the same MJCF with the same servo:
/// centre of mass at 73.27 mm after 2 s (elliptic cone, impratio 100, 0.5 ms; its feet sink in by 0.48 mm).
#[test]
fn stands_as_high_as_in_mujoco() {
    let model = robots::polymander();
    let config = EngineConfig::default();
    let mut e = build(model.clone(), 1, &config, &TerrainConfig::default(), 1, 1).unwrap();
    let targets = InitialState::nominal(&model).joint_pos_rad;
    for _ in 0..100 {
        e.step(&targets, &[0.0; 6]).unwrap();
    }
    let height = f64::from(e.state().com_pos_m[2]);
    println!("centre of mass at {:.2} mm", 1e3 * height);
    assert!((height - 0.073_27).abs() < 1e-3, "it stands at {height} m");
}

/// A spring that answers `h` times as fast is h² as stiff: on ground four times as hard a table at rest sinks
/// in by a sixteenth, give or take the impedance, which grows with the depth.
#[test]
fn harder_ground_gives_way_less() {
    let model = robots::table();
    let sinks = |contact_hardness: f64| {
        let config = EngineConfig { contact_hardness, ..EngineConfig::default() };
        let mut e = build(model.clone(), 1, &config, &TerrainConfig::default(), 1, 1).unwrap();
        for _ in 0..100 {
            e.step(&[0.0], &[0.0; 6]).unwrap();
        }
        -f64::from(e.state().foot_height_m[0])
    };
    let (soft, hard) = (sinks(1.0), sinks(4.0));
    assert!((12.0..20.0).contains(&(soft / hard)), "{soft} m, {hard} m");
}

/// Six light legs end in flat cylinders, under targets that jump. They shook until joints turned at 200 rad/s where
/// each of the 16 points of a rim held the ground as hard as a ball does, which is four times what it does.
#[test]
fn light_legs_that_end_in_cylinders_do_not_shake() {
    let model = robots::six_cylinders();
    let lanes = 16;
    let shaken = |times: f64| {
        let mut config = EngineConfig::default();
        config.bristle_stiffness_n_per_m *= times;
        config.bristle_damping_ns_per_m *= times;
        let mut e = build(model.clone(), lanes, &config, &TerrainConfig::default(), 1, 1).unwrap();
        let mut stream = Stream::new(Key::for_run(1), Purpose::Action);
        let mut targets = vec![0.0; lanes * 12];
        for _ in 0..100 {
            targets.fill_with(|| 0.4 * stream.normal());
            e.step(&targets, &vec![0.0; lanes * 6]).unwrap();
        }
        e.state().diverged.iter().filter(|broken| **broken).count()
    };
    assert_eq!(shaken(1.0), 0);
    assert!(shaken(4.0) > 0);
}
