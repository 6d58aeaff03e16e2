//! Each wrong file gives the error that says so, with its place; and no file makes the loader panic.

use std::fs;

use crate::common::robots;
use caudata_model::{ModelError, RobotModel};
use proptest::prelude::*;

fn files() -> (String, String) {
    let read = |name: &str| fs::read_to_string(robots().join(name)).unwrap();
    (read("polymander.robot.toml"), read("polymander.xml"))
}

fn load(toml: &str, mjcf: &str) -> Result<RobotModel, ModelError> {
    RobotModel::from_bytes("r.toml", toml.as_bytes(), mjcf.as_bytes())
}

/// Replaces the first `from` of one file by `to` and expects an error of one line with all of `parts`.
fn check(which: &str, from: &str, to: &str, parts: &[&str]) {
    let (mut toml, mut mjcf) = files();
    let text = if which == "toml" { &mut toml } else { &mut mjcf };
    assert!(text.contains(from), "`{from}` is not in the file");
    *text = text.replacen(from, to, 1);
    let message = load(&toml, &mjcf).expect_err(to).to_string();
    assert!(!message.contains('\n'), "more than one line: {message}");
    for part in parts {
        assert!(message.contains(part), "`{part}` is not in: {message}");
    }
}

/// Line of the first occurrence of `needle`.
fn line_of(text: &str, needle: &str) -> String {
    let at = text.find(needle).unwrap();
    format!(":{}: ", 1 + text[..at].matches('\n').count())
}

#[test]
fn robot_file_keys_and_types() {
    let (toml, _) = files();
    let kp = line_of(&toml, "kp_nm_per_rad = 15");
    check("toml", "kp_nm_per_rad", "kp", &["r.toml", &kp, "unknown field `kp`", "kp_nm_per_rad"]);
    check("toml", "kd_nm_s_per_rad = 0.15", "", &["missing field `kd_nm_s_per_rad`"]);
    check("toml", "kp_nm_per_rad = 15.0", "kp_nm_per_rad = \"15\"", &[&kp, "expected f64"]);
    check("toml", "[control]", "[control", &["r.toml:"]);
    check(
        "toml",
        "caudata.robot.v1",
        "caudata.robot.v9",
        &["format", "caudata.robot.v9", "caudata.robot.v1"],
    );
    check("toml", "mjcf = \"polymander.xml\"", "mjcf = \"../x.xml\"", &["mjcf", "same folder"]);
    check("toml", "name = \"polymander\"", "name = \"poly mander\"", &["name"]);
}

#[test]
fn robot_file_values() {
    check(
        "toml",
        "kp_nm_per_rad = 15.0",
        "kp_nm_per_rad = -1.0",
        &["control.kp_nm_per_rad", "is -1", "between 0 and"],
    );
    check("toml", "kp_nm_per_rad = 15.0", "kp_nm_per_rad = nan", &["control.kp_nm_per_rad", "NaN"]);
    check(
        "toml",
        "tau_max_nm = 1.94",
        "tau_max_nm = 0.0",
        &["servo.preset.xm430_w210.tau_max_nm", "above zero"],
    );
    check(
        "toml",
        "qd_tau_max_radps = 0.8",
        "qd_tau_max_radps = 9.0",
        &["qd_tau_max_radps", "below qd_max_radps"],
    );
    check(
        "toml",
        "tau_qd_max_nm = 0.40",
        "tau_qd_max_nm = 4.0",
        &["tau_qd_max_nm", "at most tau_max_nm"],
    );
    check(
        "toml",
        "encoder_counts_per_turn = 4096",
        "encoder_counts_per_turn = 0",
        &["encoder_counts_per_turn"],
    );
    check(
        "toml",
        "default_v = 14.0",
        "default_v = 14000.0",
        &["supply.default_v", "between 1 and 100"],
    );
    check(
        "toml",
        "[joints]\n",
        "assumed = [\"servo.preset.xm430_w210.qd_max\"]\n[joints]\n",
        &["assumed", "`servo.preset.xm430_w210.qd_max` is no figure"],
    );
    check("toml", "foot_friction = 0.8", "foot_friction = 8.0", &["contact.foot_friction"]);
    check(
        "toml",
        "half_width_rad = 0.0698",
        "half_width_rad = 4.0698",
        &["backlash.half_width_rad"],
    );
    check(
        "toml",
        "density_kg_per_m3 = 1000.0",
        "density_kg_per_m3 = 0.0",
        &["water.density_kg_per_m3"],
    );
    check(
        "toml",
        "quadratic_force = [0.02",
        "quadratic_force = [-0.02",
        &["water.drag.body.scale.quadratic_force"],
    );
    check(
        "toml",
        "mass = [0.0, 0.0, 0.0]                  # [ours] none",
        "mass = [0.0, -0.5, 0.0]  #",
        &["water.drag.body.added.mass", "between 0 and 20"],
    );
    check("toml", "resistance_ohm = 0.0", "resistance_ohm = -0.1", &["supply.resistance_ohm"]);
    check(
        "toml",
        "stribeck_speed_radps = 0.1",
        "stribeck_speed_radps = 0.0",
        &["servo.preset.xm430_w210.stribeck_speed_radps"],
    );
    check(
        "toml",
        "load_friction_driven = 0.0",
        "load_friction_driven = 1.5",
        &["servo.preset.xm430_w210.load_friction_driven"],
    );
    check(
        "toml",
        "gyro_bias_std_radps = 0.01745",
        "gyro_bias_std_radps = 1e9",
        &["imu.gyro_bias_std_radps"],
    );
    check(
        "toml",
        "stiffness_nm_per_rad = 1.0",
        "stiffness_nm_per_rad = -1.0",
        &["passive.joint.joint_body_05_passive.stiffness"],
    );
}

#[test]
fn joint_roles_and_order() {
    // the robot file's order against the MJCF's
    check(
        "toml",
        "\"FL_hip\", \"FL_knee\"",
        "\"FL_knee\", \"FL_hip\"",
        &[
            "polymander.xml:",
            "<position name=\"FL_hip\">",
            "drives `FL_hip`",
            "has `FL_knee` (place 9)",
            "one order",
        ],
    );
    check(
        "mjcf",
        "joint=\"tail_2\"",
        "joint=\"tail_3\"",
        &["drives `tail_3`", "`tail_2` (place 7)"],
    );
    check("toml", "\"spine_3\", ", "", &["drives `spine_3`", "`spine_4` (place 3)"]);
    check(
        "toml",
        "\"HL_hip\", \"HL_knee\", \"HR_hip\", \"HR_knee\",",
        "\"HL_hip\", \"HL_knee\", \"HR_hip\",",
        &["joints.actuated", "lacks `HR_knee`"],
    );
    check("toml", "\"spine_3\", ", "\"spine_x\", ", &["joints.actuated", "no joint `spine_x`"]);
    check("toml", "\"spine_3\", ", "\"spine_2\", ", &["joints.actuated", "`spine_2` twice"]);
    check(
        "mjcf",
        "name=\"spine_3\" axis",
        "name=\"spine_x\" axis",
        &["attribute `joint`", "no joint `spine_3`"],
    );
    check(
        "toml",
        "[passive.joint.joint_body_05_passive]",
        "[passive.joint.joint_body_06_passive]",
        &["passive.joint", "joint_body_05_passive", "neither actuated"],
    );
    check("toml", "\"backlash_front_x\", ", "", &["passive.joint", "backlash_front_x"]);
    check(
        "toml",
        "\"backlash_front_x\"",
        "\"spine_1\"",
        &["backlash.joints", "already has a role"],
    );
    check("toml", "base = \"free\"", "base = \"fixed\"", &["base", "has a <freejoint>"]);
    check("mjcf", "<freejoint name=\"base\"/>", "", &["base", "no <freejoint>"]);
}

#[test]
fn poses_limits_and_servos() {
    check("toml", "spine_4 = 0.0", "", &["pose.nominal_rad", "lacks `spine_4`"]);
    check(
        "toml",
        "spine_4 = 0.0",
        "spine_6 = 0.0",
        &["pose.nominal_rad", "`spine_6` is not an actuated joint"],
    );
    check(
        "toml",
        "FL_knee = 0.628",
        "FL_knee = 36.628",
        &["pose.nominal_rad.FL_knee", "outside the joint's limits"],
    );
    check("toml", "FL_hip = -1.2566", "FL_hip = -1.3566", &["pose.swimming_rad.FL_hip"]);
    check(
        "mjcf",
        "name=\"spine_1\" axis=\"0 0 1\" range=\"-1.5708 1.5708\"",
        "name=\"spine_1\" axis=\"0 0 1\"",
        &["joint name=\"spine_1\"", "needs limits"],
    );
    check(
        "toml",
        "default = \"xm430_w210\"",
        "default = \"xm540\"",
        &["servo.default", "`xm540`", "known: xm430_w210, xm430_w350"],
    );
    check(
        "toml",
        "[servo.preset.xm430_w350]",
        "[servo.joint]\nspine_9 = \"xm430_w350\"\n[servo.preset.xm430_w350]",
        &["servo.joint", "spine_9"],
    );
}

#[test]
fn references_between_the_files() {
    check("toml", "geom = \"FL_foot\"", "geom = \"FL_paw\"", &["feet.FL", "no geom `FL_paw`"]);
    check("mjcf", "name=\"HR_foot\"", "name=\"HR_paw\"", &["feet.HR", "no geom `HR_foot`"]);
    check("toml", "geom = \"FR_foot\"", "geom = \"FL_foot\"", &["feet.FR", "twice"]);
    check(
        "mjcf",
        "<geom class=\"foot\" name=\"FL_foot\"",
        "<geom class=\"foot\" name=\"FL_foot\" contype=\"0\" conaffinity=\"0\"",
        &["feet.FL", "touches nothing"],
    );
    check("toml", "site = \"imu\"", "site = \"imu2\"", &["imu.site", "no site `imu2`"]);
    check("toml", "torso = \"body_03\"", "torso = \"trunk\"", &["frames.torso", "no body `trunk`"]);
    check("toml", "heading_front = \"girdle_front\"", "", &["frames", "go together"]);
    check("toml", "\"body_06\", ", "", &["water.drag", "`body_06`", "exactly one group"]);
    check("toml", "\"body_06\", ", "\"body_66\", ", &["water.drag.body.links", "`body_66`"]);
}

#[test]
fn mjcf_outside_the_subset() {
    let (_, mjcf) = files();
    let nose = line_of(&mjcf, "name=\"head_front\"");
    check(
        "mjcf",
        "name=\"head_front\"",
        "name=\"head_front\" gap=\"0.1\"",
        &[
            "polymander.xml",
            &nose,
            "<geom name=\"head_front\">",
            "attribute `gap`",
            "outside the supported subset",
        ],
    );
    check(
        "mjcf",
        "<geom class=\"body_contact\" name=\"head_front\"",
        "<geom class=\"body_contact\" type=\"mesh\" name=\"head_front\"",
        &[&nose, "`mesh` is not supported"],
    );
    check(
        "mjcf",
        "<worldbody>",
        "<asset/><worldbody>",
        &["<asset>", "outside the supported subset"],
    );
    check(
        "mjcf",
        "<worldbody>",
        "<worldbody><light/>",
        &["<light>", "not supported inside <worldbody>"],
    );
    check(
        "mjcf",
        "<freejoint name=\"base\"/>",
        "<freejoint name=\"base\"/><camera/>",
        &["<camera>", "not supported inside <body>"],
    );
    check(
        "mjcf",
        "</worldbody>",
        "<body name=\"two\"/></worldbody>",
        &["<body name=\"two\">", "second tree"],
    );
    let deep = format!("{}{}</worldbody>", "<body>".repeat(400), "</body>".repeat(400));
    check("mjcf", "</worldbody>", &deep, &["polymander.xml", "nest more than 68 deep"]);
    check("mjcf", "integrator=", "wind=\"1 0 0\" integrator=", &["<option>", "attribute `wind`"]);
    check(
        "mjcf",
        "autolimits=\"true\"",
        "autolimits=\"true\" inertiagrouprange=\"0 1\"",
        &["<compiler>", "inertiagrouprange"],
    );
    check(
        "mjcf",
        "<position class=\"servo\" name=\"spine_1\"",
        "<general name=\"spine_1\"",
        &["<general name=\"spine_1\">", "position, motor"],
    );
    check("mjcf", "<site group=\"4\"/>", "<tendon/>", &["<tendon>", "inside <default>"]);
    // a value of a default class is refused where that says it
    check(
        "mjcf",
        "<joint damping=\"0.0064\"",
        "<joint damping=\"soft\"",
        &[
            &line_of(&mjcf, "damping=\"0.0064\""),
            "<joint> of a default: attribute `damping`: `soft` is not",
        ],
    );
    check(
        "mjcf",
        "<freejoint name=\"base\"/>",
        "<freejoint name=\"base\"><light/></freejoint>",
        &["<light>", "not supported inside <freejoint> (it holds nothing)"],
    );
    check(
        "mjcf",
        "class=\"foot\" name=\"FL_foot\"",
        "class=\"feet\" name=\"FL_foot\"",
        &["attribute `class`", "no default class `feet`"],
    );
    check(
        "mjcf",
        "childclass=\"polymander\"",
        "childclass=\"salamander\"",
        &["childclass", "`salamander`"],
    );
    let lines = files().1.trim_end().lines().count() - 1;
    let unclosed = format!("polymander.xml:{lines}: not well-formed XML, at its end: the root");
    check("mjcf", "</mujoco>", "", &[&unclosed]);
    check("mjcf", "<mujoco model", "<robot model", &["not well-formed XML"]);
}

#[test]
fn mjcf_values() {
    check(
        "mjcf",
        "mass=\"0.328768\"",
        "mass=\"0\"",
        &["<inertial>", "attribute `mass`", "above zero"],
    );
    check(
        "mjcf",
        "mass=\"0.328768\"",
        "mass=\"heavy\"",
        &["attribute `mass`", "`heavy` is not a usable number"],
    );
    check(
        "mjcf",
        "mass=\"0.328768\"",
        "mass=\"inf\"",
        &["attribute `mass`", "not a usable number"],
    );
    check("mjcf", "mass=\"0.328768\" ", "", &["attribute `mass`", "is missing"]);
    // Ixx + Izz = 0.000744 < Iyy
    check(
        "mjcf",
        "0.000134798 0.000636069",
        "0.000134798 0.000836069",
        &["fullinertia", "triangle inequality"],
    );
    check(
        "mjcf",
        "0.000134798 0.000636069",
        "-0.000134798 0.000636069",
        &["fullinertia", "above zero"],
    );
    check(
        "mjcf",
        "<inertial pos=\"-0.0874556",
        "<inertial quat=\"0 1 0 0\" pos=\"-0.0874556",
        &["fullinertia", "stands beside `quat`"],
    );
    check(
        "mjcf",
        "axis=\"0 0 -1\"",
        "axis=\"0 0 0\"",
        &["joint name=\"FL_hip\"", "attribute `axis`", "no direction"],
    );
    check(
        "mjcf",
        "axis=\"0 0 -1\"",
        "axis=\"0 0\"",
        &["attribute `axis`", "has 2 numbers where 3 belong"],
    );
    check(
        "mjcf",
        "range=\"-1.27409 1.27409\"",
        "range=\"1.27409 -1.27409\"",
        &["attribute `range`", "not below"],
    );
    check(
        "mjcf",
        "name=\"FL_knee\" axis",
        "name=\"FL_hip\" axis",
        &["already a joint called `FL_hip`"],
    );
    check(
        "mjcf",
        "<body name=\"FL_upper\"",
        "<body name=\"body_00\"",
        &["already a body called `body_00`"],
    );
    check(
        "mjcf",
        "<joint class=\"servo\" name=\"FL_hip\"",
        "<joint class=\"servo\" type=\"ball\" name=\"FL_hip\"",
        &["attribute `type`", "`ball`"],
    );
    check(
        "mjcf",
        "name=\"FL_knee_ball\" pos=\"0 0 0\" size=\"0.0307\"",
        "name=\"FL_knee_ball\" size=\"-1\"",
        &["attribute `size`", "not above zero"],
    );
    check("mjcf", "friction=\"0.8\"", "friction=\"-0.8\"", &["attribute `friction`", "negative"]);
    check(
        "mjcf",
        "joint=\"spine_1\"",
        "joint=\"spine_0\"",
        &["attribute `joint`", "no joint `spine_0`"],
    );
}

#[test]
fn missing_and_unreadable_files() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("r.robot.toml");
    let e = RobotModel::load(&path).unwrap_err();
    assert!(matches!(e, ModelError::Read { .. }));
    let (toml, mjcf) = files();
    fs::write(&path, &toml).unwrap();
    let e = RobotModel::load(&path).unwrap_err().to_string();
    assert!(e.contains("cannot read") && e.contains("polymander.xml"), "{e}");
    fs::write(dir.path().join("polymander.xml"), &mjcf).unwrap();
    assert_eq!(RobotModel::load(&path).unwrap().hash(), load(&toml, &mjcf).unwrap().hash());
    fs::write(&path, b"name = \"\xff\"").unwrap();
    let e = RobotModel::load(&path).unwrap_err().to_string();
    assert!(e.contains("not UTF-8"), "{e}");
}

#[test]
fn the_hash_follows_every_byte_of_both_files() {
    let (toml, mjcf) = files();
    let hash = |t: &str, x: &str| load(t, x).unwrap().hash_hex();
    let original = hash(&toml, &mjcf);
    assert_eq!(original.len(), 64);
    assert_eq!(original, hash(&toml, &mjcf));
    assert_ne!(original, hash(&format!("{toml}\n"), &mjcf));
    assert_ne!(original, hash(&toml, &format!("{mjcf}\n")));
    // a line moved from the start of one file to the end of the other is another robot
    let a = hash(&format!("{toml}\n"), &mjcf);
    let b = hash(&toml, &format!("\n{mjcf}"));
    assert_ne!(a, b);
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(300))]

    /// Cutting, doubling or overwriting any part of a file gives a robot or an error, never a panic.
    #[test]
    fn damaged_files_never_panic(which in 0..2, at in 0.0..1.0f64, len in 0usize..60, junk in "[ -~\n]{0,8}") {
        let (mut toml, mut mjcf) = files();
        let text = if which == 0 { &mut toml } else { &mut mjcf };
        let mut start = (at * text.len() as f64) as usize;
        while !text.is_char_boundary(start) { start -= 1; }
        let mut end = (start + len).min(text.len());
        while !text.is_char_boundary(end) { end += 1; }
        text.replace_range(start..end, &junk);
        if let Err(e) = load(&toml, &mjcf) {
            prop_assert!(!e.to_string().is_empty());
        }
    }
}
