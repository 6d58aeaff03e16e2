//! Other robots than the Polymander: a pendulum, an arm with slides, and the corners of the MJCF subset.
//! Numbers worked by hand.

use std::f64::consts::FRAC_PI_2;

use crate::common::near;
use caudata_model::{BaseKind, EncoderSide, JointKind, JointMotion, Pose, RobotModel, Shape};

/// A robot file for `joints` (all actuated, nominal 0) with an optional tail of tables.
fn robot_toml(joints: &[&str], tail: &str) -> String {
    let names = joints.iter().map(|j| format!("\"{j}\"")).collect::<Vec<_>>().join(", ");
    let nominal = joints.iter().map(|j| format!("{j} = 0.0\n")).collect::<String>();
    format!(
        r#"
format = "caudata.robot.v1"
name = "test"
mjcf = "test.xml"
base = "fixed"
[joints]
actuated = [{names}]
[pose.nominal_rad]
{nominal}
[control]
kp_nm_per_rad = 1.0
kd_nm_s_per_rad = 0.1
[servo]
default = "s"
[servo.preset.s]
tau_max_nm = 1.0
qd_tau_max_radps = 1.0
qd_max_radps = 2.0
tau_qd_max_nm = 0.5
tau_brake_max_nm = 1.0
kd_min_nm_s_per_rad = 0.0
back_drive_kp_ratio = 1.0
friction_loss_nm = 0.01
damping_nm_s_per_rad = 0.02
armature_kgm2 = 0.03
reference_supply_v = 12.0
encoder_counts_per_turn = 4096
velocity_lsb_radps = 0.024
current_lsb_a = 0.0027
torque_per_current_nm_per_a = 1.0
current_dead_band_a = 0.0
gear_backlash_rad = 0.0
[supply]
default_v = 12.0
bench_v = 12.0
battery_full_v = 12.6
battery_nominal_v = 11.1
[contact]
foot_friction = 0.8
body_friction = 0.3
{tail}"#
    )
}

fn load(joints: &[&str], tail: &str, mjcf: &str) -> RobotModel {
    RobotModel::from_bytes("test.robot.toml", robot_toml(joints, tail).as_bytes(), mjcf.as_bytes())
        .unwrap()
}

fn at(m: &RobotModel, q: &[f64], link: &str, point: [f64; 3]) -> [f64; 3] {
    let k = m.kinematics(&Pose::IDENTITY, q).unwrap();
    k.links[m.link_index(link).unwrap()].point(point)
}

fn close(got: [f64; 3], want: [f64; 3]) {
    for i in 0..3 {
        assert!((got[i] - want[i]).abs() < 1e-12, "{got:?} is not {want:?}");
    }
}

#[test]
fn a_pendulum_on_the_world() {
    // degrees are MJCF's default
    let m = load(
        &["swing"],
        "",
        r#"<mujoco>
          <option gravity="0 0 -1.62"/>
          <worldbody><body name="rod" pos="0 0 2">
            <inertial pos="0 0 -0.5" mass="2" diaginertia="0.1667 0.1667 0.001"/>
            <joint name="swing" axis="0 2 0" range="-90 90"/>
            <geom type="capsule" fromto="0 0 0 0 0 -1" size="0.02"/>
          </body></worldbody>
          <actuator><motor joint="swing"/></actuator>
        </mujoco>"#,
    );
    assert_eq!(m.base(), BaseKind::Fixed);
    assert_eq!(m.gravity_mps2(), [0.0, 0.0, -1.62]);
    assert_eq!(m.total_mass_kg(), 2.0);
    assert!(m.feet().is_empty() && m.imu_site().is_none() && m.water().is_none());
    let j = &m.joints()[0];
    assert_eq!(
        (j.axis, j.parent_link, j.kind),
        ([0.0, 1.0, 0.0], None, JointKind::Actuated { index: 0 })
    );
    assert_eq!((j.damping_nm_s_per_rad, j.armature_kgm2), (0.02, 0.03), "from the servo preset");
    near("limit", m.joint_limits_rad()[0].1, FRAC_PI_2, 1e-15);
    // a quarter turn about y takes the tip from below the pivot to -x
    close(at(&m, &[FRAC_PI_2], "rod", [0.0, 0.0, -1.0]), [-1.0, 0.0, 2.0]);
    let g = &m.links()[0].geoms[0];
    assert_eq!(g.shape, Shape::Capsule { radius_m: 0.02, half_length_m: 0.5 });
    close(g.link_from_geom.pos_m, [0.0, 0.0, -0.5]);
}

#[test]
fn an_arm_with_slides_anchors_classes_and_several_joints_per_link() {
    let m = load(
        &["lift", "turn", "reach"],
        "[passive]\nlocked = false\n[passive.joint.wobble]\nstiffness_nm_per_rad = 3.0\ndamping_nm_s_per_rad = 0.4\nfriction_loss_nm = 0.0\n",
        r#"<mujoco>
          <compiler angle="radian" eulerseq="XYZ"/>
          <default>
            <joint damping="9"/>
            <default class="rail"><joint type="slide" range="-0.2 0.2"/></default>
          </default>
          <worldbody>
            <geom name="table" type="box" size="1 1 0.1"/>
            <body name="stand" pos="0 0 1">
              <inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>
              <body name="carriage" pos="0 0 0.5" childclass="rail" euler="0 0 1.5707963267948966">
                <inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>
                <joint name="lift" axis="0 0 1"/>
                <joint name="turn" class="main" axis="0 0 1" pos="0.1 0 0" range="-2 2"/>
                <body name="tool" pos="0.3 0 0">
                  <inertial pos="0 0 0" mass="1" diaginertia="1 2 3" quat="1 0 0 1"/>
                  <joint name="reach" axis="1 0 0"/>
                  <joint name="wobble" class="main" axis="0 0 1"/>
                </body>
              </body>
            </body>
          </worldbody>
          <contact><exclude body1="stand" body2="tool"/></contact>
          <actuator><motor joint="lift"/><motor joint="turn"/><motor joint="reach"/></actuator>
        </mujoco>"#,
    );
    let [lift, turn, reach, wobble] = [0, 1, 2, 3].map(|i| &m.joints()[i]);
    assert_eq!((lift.motion, turn.motion), (JointMotion::Slide, JointMotion::Hinge));
    assert_eq!(
        lift.range_rad,
        Some((-0.2, 0.2)),
        "a slide's range is metres, whatever the angle unit"
    );
    assert_eq!(reach.parent_link, Some(1));
    assert_eq!((wobble.kind, wobble.range_rad), (JointKind::Passive, None));
    assert_eq!(
        (wobble.stiffness_nm_per_rad, wobble.damping_nm_s_per_rad),
        (3.0, 0.4),
        "robot file wins"
    );
    assert_eq!(m.excluded_pairs(), [(0, 2)]);
    assert_eq!(m.world_geoms()[0].shape, Shape::Box { half_size_m: [1.0, 1.0, 0.1] });
    // inertial turned a quarter about z: Ixx and Iyy swap
    let i = m.links()[2].inertia_kgm2;
    near("Ixx", i[0][0], 2.0, 1e-12);
    near("Iyy", i[1][1], 1.0, 1e-12);

    // At zero the carriage is turned a quarter about z: its x axis is the world's y.
    close(at(&m, &[0.0; 4], "tool", [0.0; 3]), [0.0, 0.3, 1.5]);
    // lift 0.1 up; turn a quarter about the anchor 0.1 along the carriage's x, that is about the world point
    // (0, 0.1, 1.6): the carriage's origin goes from 0.1 behind the anchor (-y) to +x, its x axis to -x; the
    // tool reaches 0.05 further.
    let q = [0.1, FRAC_PI_2, 0.05, 0.0];
    close(at(&m, &q, "carriage", [0.0; 3]), [0.1, 0.1, 1.6]);
    close(at(&m, &q, "tool", [0.0; 3]), [0.1 - 0.35, 0.1, 1.6]);
    let k = m.kinematics(&Pose::IDENTITY, &q).unwrap();
    close(k.joints[1].anchor_m, [0.0, 0.1, 1.6]);
    close(k.joints[2].axis, [-1.0, 0.0, 0.0]);
    // centre of mass: stand (0,0,1), carriage (0.1,0.1,1.6), tool (-0.25,0.1,1.6), one kilogram each
    close(m.centre_of_mass_m(&k), [-0.05, 0.2 / 3.0, 1.4]);
}

#[test]
fn euler_sequences_turn_about_moving_or_fixed_axes() {
    let axis = |seq: &str| {
        let m = load(
            &["j"],
            "",
            &format!(
                r#"<mujoco><compiler angle="degree" eulerseq="{seq}"/><worldbody>
                   <body name="a" euler="90 90 0"><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>
                   <joint name="j" range="-1 1"/></body></worldbody>
                   <actuator><motor joint="j"/></actuator></mujoco>"#
            ),
        );
        m.kinematics(&Pose::IDENTITY, &[0.0]).unwrap().joints[0].axis
    };
    // moving: 90° about x, then 90° about the new y (the old z): local z, first at -y, goes to x
    close(axis("xyz"), [1.0, 0.0, 0.0]);
    // fixed: 90° about x takes z to -y; 90° about the world's y leaves it there
    close(axis("XYZ"), [0.0, -1.0, 0.0]);
}

/// A servo says where its encoder is, or has the name of one of the library, or nobody knows.
#[test]
fn where_an_encoder_sits() {
    let mjcf = r#"<mujoco><worldbody><body name="b"><joint name="j" type="hinge" range="-1 1"/>
        <inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/></body></worldbody>
        <actuator><motor joint="j"/></actuator></mujoco>"#;
    let toml = robot_toml(&["j"], "");
    let of = |text: &str| {
        let model = RobotModel::from_bytes("test.robot.toml", text.as_bytes(), mjcf.as_bytes());
        model.map(|m| m.servo(0).encoder)
    };
    let with = |line: &str| {
        toml.replace(
            "gear_backlash_rad = 0.0",
            &format!("gear_backlash_rad = 0.0\nencoder = {line}"),
        )
    };
    assert_eq!(of(&toml).unwrap(), None);
    assert_eq!(of(&with("\"motor\"")).unwrap(), Some(EncoderSide::Motor));
    assert_eq!(of(&with("\"output\"")).unwrap(), Some(EncoderSide::Output));
    assert!(of(&with("\"rotor\"")).is_err());
    let known = toml.replace("default = \"s\"", "default = \"sts3215\"");
    let known = known.replace("preset.s]", "preset.sts3215]");
    assert_eq!(of(&known).unwrap(), Some(EncoderSide::Output));
    let variant = known.replace("[servo]\ndefault = \"sts3215\"", "[servo]\ndefault = \"v\"")
        + "\n[servo.variant.v]\nof = \"sts3215\"\ntau_max_nm = 1.1\n";
    assert_eq!(of(&variant).unwrap(), Some(EncoderSide::Output), "a variant keeps its preset's");
}

#[test]
fn wrong_lengths_are_errors() {
    let m = crate::common::polymander();
    let e = m.kinematics(&Pose::IDENTITY, &[0.0; 3]).unwrap_err();
    assert_eq!(e.to_string(), "joint positions has 3 values where this robot needs 22");
    assert!(m.full_pos_rad(&[0.0; 22]).is_err());
}
