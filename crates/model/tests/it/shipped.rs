//! What holds for every robot that ships.

use std::path::PathBuf;

use crate::common::robots;
use caudata_model::{Ball, BaseKind, JointKind, Pose, RobotModel, pose};

fn shipped() -> Vec<(PathBuf, RobotModel)> {
    let files = std::fs::read_dir(robots()).unwrap();
    let mut found: Vec<PathBuf> = files.map(|f| f.unwrap().path()).collect();
    found.retain(|f| f.to_string_lossy().ends_with(".robot.toml"));
    found.sort();
    let load = |file: PathBuf| (file.clone(), RobotModel::load(&file).unwrap());
    found.into_iter().map(load).collect()
}

fn named(name: &str) -> RobotModel {
    RobotModel::load(&robots().join(format!("{name}.robot.toml"))).unwrap()
}

#[test]
fn each_robot_is_called_like_its_file_and_stands_within_its_limits() {
    let all = shipped();
    assert!(all.len() >= 6);
    for (file, model) in &all {
        let stem = file.file_name().unwrap().to_string_lossy().into_owned();
        assert_eq!(stem, format!("{}.robot.toml", model.name()));
        assert!(model.total_mass_kg() > 0.1, "{stem}");
        for (a, q) in model.nominal_pos_rad().iter().enumerate() {
            let (low, high) = model.joint_limits_rad()[a];
            assert!(low < *q && *q < high, "{stem}: joint {a}");
            // a loop that is stiffer than its servo can push: full torque within half a turn
            let stiff = model.servo(a).tau_max_nm / model.kp_nm_per_rad(a);
            assert!(stiff > 0.05, "{stem}: joint {a} saturates at {stiff} rad");
        }
    }
}

/// The robots that walk: in the nominal pose all feet are at one height, and the centre of mass is over them.
#[test]
fn legged_robots_stand_on_their_feet_in_the_nominal_pose() {
    for name in ["quadruped", "biped", "hexapod"] {
        let model = named(name);
        assert_eq!(model.base(), BaseKind::Free);
        let pos = model.full_pos_rad(model.nominal_pos_rad()).unwrap();
        let places = model.kinematics(&Pose::IDENTITY, &pos).unwrap();
        let mut soles = Vec::new();
        for foot in model.feet() {
            let link = &places.links[foot.link];
            let low = |ball: &Ball| link.point(ball.centre_m)[2] - ball.radius_m;
            let mut lowest: Vec<f64> = foot.balls.iter().map(low).collect();
            lowest.sort_by(f64::total_cmp);
            soles.push(lowest[0]);
            // a sole lies flat: its four lower corners are at one height
            if lowest.len() == 8 {
                assert!((lowest[3] - lowest[0]).abs() < 1e-9, "{name}");
            }
        }
        let spread = soles.iter().map(|z| (z - soles[0]).abs());
        assert!(spread.fold(0.0, f64::max) < 1e-3, "{name}: {soles:?}");
        let com = model.centre_of_mass_m(&places);
        let centre = |axis: usize| {
            let of = |f: &caudata_model::Foot| places.links[f.link].point(f.centre_m)[axis];
            model.feet().iter().map(of).sum::<f64>() / model.feet().len() as f64
        };
        let off = (com[0] - centre(0)).hypot(com[1] - centre(1));
        assert!(off < 0.03, "{name}: the centre of mass is {off} m off");
    }
}

#[test]
fn sizes_and_servos_are_those_of_the_description() {
    let quadruped = named("quadruped");
    assert_eq!((quadruped.actuated().len(), quadruped.feet().len()), (12, 4));
    // 0.10094 N·m/A · 6.33 · 37.1 A = 23.7 N·m; 1.118e-4 kg·m² · 6.33² = 4.48e-3
    let hip = quadruped.servo(0);
    assert!((hip.tau_max_nm - 23.7).abs() < 0.05);
    assert!((hip.armature_kgm2 - 4.48e-3).abs() < 1e-5);
    assert_eq!(quadruped.servo_name(2), "calf_motor");
    assert_eq!((quadruped.kp_nm_per_rad(0), quadruped.kp_nm_per_rad(2)), (40.0, 60.0));
    assert!(quadruped.common_gains().is_none());

    let biped = named("biped");
    assert_eq!((biped.actuated().len(), biped.feet().len()), (14, 2));
    assert!((biped.total_mass_kg() - 0.8).abs() < 1e-9);
    assert_eq!(biped.servo_name(0), "xl330_m288");
    assert!(!biped.feet()[0].is_ball() && biped.feet()[0].balls.len() == 8);

    let hexapod = named("hexapod");
    assert_eq!((hexapod.actuated().len(), hexapod.feet().len()), (18, 6));

    let snake = named("snake");
    assert_eq!((snake.actuated().len(), snake.feet().len()), (12, 0));
    assert_eq!((snake.servo_name(0), snake.servo_name(1)), ("xm430_w350", "xm430_w210"));
    assert!(snake.water().is_some() && snake.swimming_pos_rad().is_some());
}

#[test]
fn the_heading_of_a_single_site_is_its_x_axis() {
    let model = named("biped");
    let (hind, front) = model.heading_sites().unwrap();
    let line = pose::sub(front.link_from_site.pos_m, hind.link_from_site.pos_m);
    assert!(line[0] > 0.0 && line[1] == 0.0 && line[2] == 0.0);
    assert_eq!(front.link, hind.link);
}

#[test]
fn every_joint_has_a_role() {
    for (file, model) in shipped() {
        for (a, &j) in model.actuated().iter().enumerate() {
            let kind = model.joints()[j].kind;
            assert_eq!(kind, JointKind::Actuated { index: a }, "{}", file.display());
        }
    }
}
