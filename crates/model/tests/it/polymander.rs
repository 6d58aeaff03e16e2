//! The shipped robot: mass, length, order, signs, clearance, stance.

use std::f64::consts::FRAC_PI_2;
use std::fs;

use crate::common::{near, polymander, robots};
use caudata_model::{BaseKind, Geom, JointKind, Kinematics, Pose, RobotModel, Shape, pose};

/// Lowest and highest coordinate along world axis `axis` of the geoms that `pick` chooses.
fn extent(
    m: &RobotModel,
    k: &Kinematics,
    axis: usize,
    pick: impl Fn(&str, &Geom) -> bool,
) -> (f64, f64) {
    let mut unit = [0.0; 3];
    unit[axis] = 1.0;
    let (mut lo, mut hi) = (f64::INFINITY, f64::NEG_INFINITY);
    for (link, world_from_link) in m.links().iter().zip(&k.links) {
        for g in link.geoms.iter().filter(|g| pick(&link.name, g)) {
            let world_from_geom = world_from_link.compose(&g.link_from_geom);
            let dir = world_from_geom.inverse().rotate(unit);
            let half = g.shape.half_extent_m(dir);
            lo = lo.min(world_from_geom.pos_m[axis] - half);
            hi = hi.max(world_from_geom.pos_m[axis] + half);
        }
    }
    (lo, hi)
}

/// Kinematics with the base at the origin and the named actuated joints at the given angles.
fn pose_with(m: &RobotModel, set: &[(&str, f64)]) -> Kinematics {
    let mut q = vec![0.0; m.actuated().len()];
    for (name, angle) in set {
        q[m.actuated_names().iter().position(|n| n == name).unwrap()] = *angle;
    }
    m.kinematics(&Pose::IDENTITY, &m.full_pos_rad(&q).unwrap()).unwrap()
}

/// Centres of the foot balls in the world, m.
fn foot_centres_m(m: &RobotModel, k: &Kinematics) -> Vec<[f64; 3]> {
    let feet = m.feet().iter();
    feet.map(|f| k.links[f.link].point(f.centre_m)).collect()
}

#[test]
fn mass_and_length_are_the_robots() {
    let m = polymander();
    near("mass, kg", m.total_mass_kg(), 2.596, 0.0005);
    let k = pose_with(&m, &[]);
    let (tail, nose) = extent(&m, &k, 0, |_, _| true);
    near("nose to tail tip, m", nose - tail, 1.105, 0.0005);
    near("nose, m", nose, 0.0, 1e-9);
    // legs straight out: foot tip at 0.1953 m to each side
    let (right, left) = extent(&m, &k, 1, |_, g| g.collides());
    near("left foot tip, m", left, 0.1953, 1e-9);
    near("right foot tip, m", right, -0.1953, 1e-9);
}

#[test]
fn joints_stand_in_the_documented_order() {
    let m = polymander();
    assert_eq!(m.base(), BaseKind::Free);
    #[rustfmt::skip]
    assert_eq!(m.actuated_names(), [
        "spine_1", "spine_2", "spine_3", "spine_4", "spine_5", "tail_1", "tail_2", "tail_3",
        "FL_hip", "FL_knee", "FR_hip", "FR_knee", "HL_hip", "HL_knee", "HR_hip", "HR_knee",
    ]);
    // 16 actuated + 2 passive + 4 play; with the free base nv = 28
    let names: Vec<&str> = m.joints().iter().map(|j| j.name.as_str()).collect();
    #[rustfmt::skip]
    assert_eq!(names, [
        "spine_1", "FL_hip", "FL_knee", "FR_hip", "FR_knee",
        "backlash_front_x", "backlash_front_y", "spine_2", "spine_3", "spine_4",
        "spine_5", "backlash_hind_x", "backlash_hind_y", "HL_hip", "HL_knee", "HR_hip", "HR_knee",
        "joint_body_05_passive", "tail_1", "tail_2", "tail_3", "joint_body_09_passive",
    ]);
    for (index, &j) in m.actuated().iter().enumerate() {
        assert_eq!(m.joints()[j].kind, JointKind::Actuated { index });
    }
    let feet: Vec<&str> = m.feet().iter().map(|f| f.name.as_str()).collect();
    assert_eq!(feet, ["FL", "FR", "HL", "HR"]);
    assert_eq!(m.links().len(), 19);
    assert_eq!(m.links()[0].name, "body_00");
    assert_eq!(m.links()[m.torso_link()].name, "body_03");
    assert_eq!(m.links()[m.imu_site().unwrap().link].name, "body_01");
}

#[test]
fn limits_and_nominal_pose_are_the_documented_ones() {
    let m = polymander();
    for (i, name) in m.actuated_names().iter().enumerate() {
        let (lo, hi) = m.joint_limits_rad()[i];
        let (want_lo, want_hi, nominal, swimming) = match name.split_once('_').unwrap() {
            ("spine" | "tail", _) => (-90.0, 90.0, 0.0, 0.0),
            (_, "hip") => (-73.0, 73.0, 0.0, -72.0),
            (leg, _) => (-72.0, 105.0, if leg.starts_with('F') { 36.0 } else { 54.0 }, 18.0),
        };
        near(name, lo.to_degrees(), want_lo, 0.01);
        near(name, hi.to_degrees(), want_hi, 0.01);
        near(name, m.nominal_pos_rad()[i].to_degrees(), nominal, 1e-9);
        near(name, m.swimming_pos_rad().unwrap()[i].to_degrees(), swimming, 1e-9);
    }
    for name in ["joint_body_05_passive", "joint_body_09_passive"] {
        let j = &m.joints()[m.joint_index(name).unwrap()];
        assert_eq!(j.kind, JointKind::Passive);
        near(name, j.range_rad.unwrap().1.to_degrees(), 23.0, 0.01);
    }
    assert_eq!(m.backlash().joints.len(), 4);
    for &j in &m.backlash().joints {
        assert_eq!(m.joints()[j].kind, JointKind::Backlash);
        near("play", m.joints()[j].range_rad.unwrap().1.to_degrees(), 4.0, 1e-9);
    }
}

#[test]
fn positive_hips_swing_the_foot_forward_on_both_sides() {
    let m = polymander();
    let zero = foot_centres_m(&m, &pose_with(&m, &[]));
    for (foot, leg) in ["FL", "FR", "HL", "HR"].iter().enumerate() {
        let k = pose_with(&m, &[(&format!("{leg}_hip"), 0.5)]);
        let moved = foot_centres_m(&m, &k)[foot];
        // hip axis to foot centre: 0.0415 + 0.0968 m; forward by its length times sin 0.5 = 0.4794
        near(leg, moved[0] - zero[foot][0], 0.1383 * 0.5f64.sin(), 1e-12);
        assert!(moved[1].abs() < zero[foot][1].abs(), "{leg} also swings inwards");
        near(leg, moved[2], zero[foot][2], 1e-12);
    }
}

#[test]
fn positive_knees_put_the_foot_down() {
    let m = polymander();
    let zero = foot_centres_m(&m, &pose_with(&m, &[]));
    for (foot, leg) in ["FL", "FR", "HL", "HR"].iter().enumerate() {
        let k = pose_with(&m, &[(&format!("{leg}_knee"), 0.5)]);
        let moved = foot_centres_m(&m, &k)[foot];
        near(leg, moved[2] - zero[foot][2], -0.0968 * 0.5f64.sin(), 1e-12);
    }
}

#[test]
fn positive_spine_joints_turn_the_rear_to_the_left_so_it_swings_right() {
    let m = polymander();
    for joint in ["spine_1", "spine_2", "spine_3", "spine_4", "spine_5"] {
        let k = pose_with(&m, &[(joint, 0.3)]);
        let hind = m.site("girdle_hind").unwrap();
        let world_from_hind = k.links[hind.link].compose(&hind.link_from_site);
        let x_axis = world_from_hind.rotate([1.0, 0.0, 0.0]);
        near(joint, x_axis[1].atan2(x_axis[0]), 0.3, 1e-12);
        assert!(
            world_from_hind.pos_m[1] < -0.01,
            "{joint}: rear part is behind, so it moves to -y"
        );
    }
}

/// With the knee at 90° the lower leg, whose axis runs from the knee to the centre of the foot ball, points
/// straight down.
#[test]
fn belly_clearance_with_vertical_tibiae_is_the_papers() {
    let m = polymander();
    let knees = ["FL_knee", "FR_knee", "HL_knee", "HR_knee"].map(|n| (n, FRAC_PI_2));
    let k = pose_with(&m, &knees);
    for f in m.feet() {
        let tibia = k.links[f.link].rotate(f.centre_m);
        near("tibia is vertical", tibia[2], -0.0968, 1e-12);
    }
    let (ground, _) = extent(&m, &k, 2, |link, g| link.ends_with("_lower") && g.collides());
    let trunk = ["body_01", "body_02", "body_03", "body_04", "body_05"];
    let (belly, _) = extent(&m, &k, 2, |link, _| trunk.contains(&link));
    let clearance = belly - ground;
    // feet: 0.00025 + 0.01 + 0.1158 below the head's frame; belly: 0.00025 + 0.0229 (hind girdle)
    near("belly clearance, m", clearance, 0.1029, 1e-9);
    assert!((0.102..=0.103).contains(&clearance));
    // the contact balls alone say the same
    let (balls, _) = extent(&m, &k, 2, |link, g| trunk.contains(&link) && g.collides());
    near("belly of the contact balls, m", balls, belly, 2e-4);
}

#[test]
fn it_stands_in_the_nominal_pose() {
    let m = polymander();
    let q = m.full_pos_rad(m.nominal_pos_rad()).unwrap();
    let k = m.kinematics(&Pose::IDENTITY, &q).unwrap();
    let f = foot_centres_m(&m, &k);
    // All balls have one radius, so the ground is parallel to the plane through the four centres.
    let normal = pose::cross(pose::sub(f[0], f[3]), pose::sub(f[2], f[1]));
    let up = normal.map(|x| x / pose::norm(normal) * normal[2].signum());
    for c in &f {
        near("feet lie in one plane", pose::dot(up, pose::sub(*c, f[0])), 0.0, 1e-4);
    }
    // nose down: fore feet 0.0968 (sin 54° − sin 36°) = 21.4 mm higher than the hind ones, 328.5 mm apart:
    // 3.7°
    near("pitch, degrees", up[0].atan2(up[2]).to_degrees(), -3.73, 0.02);
    let com = m.centre_of_mass_m(&k);
    // support polygon FL, HL, HR, FR (counter-clockwise seen from above): the CoM is left of every edge
    let corners = [f[0], f[2], f[3], f[1]];
    for i in 0..4 {
        let (a, b) = (corners[i], corners[(i + 1) % 4]);
        let edge = pose::sub(b, a);
        let left = pose::cross(up, edge);
        let margin = pose::dot(pose::sub(com, a), left) / pose::norm(left);
        assert!(margin > 0.05, "CoM is {margin} m inside edge {i}");
    }
}

#[test]
fn nothing_on_the_robot_collides_with_the_robot_and_everything_with_the_floor() {
    let m = polymander();
    let geoms: Vec<&Geom> =
        m.links().iter().flat_map(|l| &l.geoms).filter(|g| g.collides()).collect();
    assert_eq!(geoms.len(), 20);
    let floor = &m.world_geoms()[0];
    assert_eq!(floor.shape, Shape::Plane);
    for (i, a) in geoms.iter().enumerate() {
        assert!(a.collides_with(floor));
        assert!(matches!(a.shape, Shape::Sphere { .. }));
        assert!(geoms[i + 1..].iter().all(|b| !a.collides_with(b)));
    }
    for f in m.feet() {
        assert_eq!(m.links()[f.link].geoms[f.geoms[0]].friction, 0.8);
        near("foot radius", f.radius_m(), 0.019, 0.0);
    }
}

#[test]
fn switches_lock_their_joints() {
    let toml = fs::read_to_string(robots().join("polymander.robot.toml")).unwrap();
    let mjcf = fs::read(robots().join("polymander.xml")).unwrap();
    let locked = |from: &str, to: &str| -> Vec<String> {
        let changed = toml.replacen(from, to, 1);
        assert_ne!(changed, toml);
        let m = RobotModel::from_bytes("t", changed.as_bytes(), &mjcf).unwrap();
        m.joints().iter().filter(|j| j.locked).map(|j| j.name.clone()).collect()
    };
    assert_eq!(
        locked("locked = false", "locked = true"),
        ["joint_body_05_passive", "joint_body_09_passive"]
    );
    assert_eq!(
        locked("enabled = true", "enabled = false"),
        ["backlash_front_x", "backlash_front_y", "backlash_hind_x", "backlash_hind_y"]
    );
    assert!(polymander().joints().iter().all(|j| !j.locked));
}

#[test]
fn another_servo_can_be_chosen_for_all_or_for_one() {
    let toml = fs::read_to_string(robots().join("polymander.robot.toml")).unwrap();
    let mjcf = fs::read(robots().join("polymander.xml")).unwrap();
    let m = polymander();
    assert_eq!(m.servo(0).tau_max_nm, 1.94);
    near("encoder step, rad", m.servo(0).encoder_lsb_rad(), 1.534e-3, 1e-6);
    let all = toml.replace("default = \"xm430_w210\"", "default = \"xm430_w350\"");
    let all = RobotModel::from_bytes("t", all.as_bytes(), &mjcf).unwrap();
    assert_eq!((all.servo(0).tau_max_nm, all.servo(15).tau_max_nm), (2.95, 2.95));
    assert_eq!(all.joints()[all.actuated()[3]].armature_kgm2, 0.0025);
    let one = toml.replace(
        "[servo.preset.xm430_w350]",
        "[servo.joint]\nFL_knee = \"xm430_w350\"\n[servo.preset.xm430_w350]",
    );
    let one = RobotModel::from_bytes("t", one.as_bytes(), &mjcf).unwrap();
    assert_eq!((one.servo(8).tau_max_nm, one.servo(9).tau_max_nm), (1.94, 2.95));
}

/// Where both files carry a number, caudata takes the robot file's; MuJoCo users must not get another robot.
#[test]
fn the_mjcf_carries_the_robot_files_numbers() {
    let m = polymander();
    let text = fs::read_to_string(robots().join("polymander.xml")).unwrap();
    let doc = roxmltree::Document::parse(&text).unwrap();
    let number = |class: &str, tag: &str, attribute: &str| -> f64 {
        let class = doc
            .descendants()
            .find(|n| n.has_tag_name("default") && n.attribute("class") == Some(class))
            .unwrap();
        let e = class.children().find(|n| n.has_tag_name(tag)).unwrap();
        e.attribute(attribute).unwrap().split_whitespace().last().unwrap().parse().unwrap()
    };
    let servo = m.servo(0);
    near("servo damping", number("servo", "joint", "damping"), servo.damping_nm_s_per_rad, 0.0);
    near("armature", number("servo", "joint", "armature"), servo.armature_kgm2, 0.0);
    near("servo friction", number("servo", "joint", "frictionloss"), servo.friction_loss_nm, 0.0);
    near("kp", number("servo", "position", "kp"), m.kp_nm_per_rad(0), 0.0);
    let kv = m.kd_nm_s_per_rad(0) + servo.kd_min_nm_s_per_rad;
    near("kv", number("servo", "position", "kv"), kv, 1e-12);
    near("torque", number("servo", "position", "forcerange"), servo.tau_max_nm, 0.0);
    let passive = &m.joints()[m.joint_index("joint_body_05_passive").unwrap()];
    near("spring", number("passive", "joint", "stiffness"), passive.stiffness_nm_per_rad, 0.0);
    near("damper", number("passive", "joint", "damping"), passive.damping_nm_s_per_rad, 0.0);
    let play = m.backlash();
    near("play", number("backlash", "joint", "range"), play.half_width_rad, 1e-6);
    near("play damping", number("backlash", "joint", "damping"), play.damping_nm_s_per_rad, 0.0);
    near("play friction", number("backlash", "joint", "frictionloss"), play.friction_loss_nm, 0.0);
    near(
        "body friction",
        number("body_contact", "geom", "friction"),
        m.contact().body_friction,
        0.0,
    );
    near("foot friction", number("foot", "geom", "friction"), m.contact().foot_friction, 0.0);
}

#[test]
fn trunk_and_legs_carry_feet_and_the_tail_does_not() {
    let model = polymander();
    let without: Vec<&str> = (0..model.links().len())
        .filter(|&l| !model.carries_feet(l))
        .map(|l| model.links()[l].name.as_str())
        .collect();
    assert_eq!(without, ["body_06", "body_07", "body_08", "body_09", "body_10"]);
}
