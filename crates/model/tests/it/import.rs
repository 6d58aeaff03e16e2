//! Robots from what other tools write.

use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};

use crate::common::near;
use caudata_model::import::{self, ImportError, ImportOptions, Imported, Weld};
use caudata_model::{BaseKind, Pose, RobotModel, Shape};

/// A file of its own folder.
struct File(PathBuf);

impl File {
    fn new(name: &str, text: &str) -> Self {
        // tests run at once, and some give their files the same name
        static COUNT: AtomicUsize = AtomicUsize::new(0);
        let (process, count) = (std::process::id(), COUNT.fetch_add(1, Ordering::Relaxed));
        let folder = std::env::temp_dir().join(format!("caudata-import-{process}-{count}"));
        std::fs::create_dir_all(&folder).unwrap();
        let path = folder.join(name);
        std::fs::write(&path, text).unwrap();
        Self(path)
    }
}

impl Drop for File {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(self.0.with_file_name(""));
    }
}

pub(crate) fn read(name: &str, text: &str) -> Result<Imported, ImportError> {
    import::import(&File::new(name, text).0, &ImportOptions::default())
}

pub(crate) fn model(made: &Imported) -> RobotModel {
    RobotModel::from_bytes("made", made.robot_toml.as_bytes(), made.mjcf.as_bytes()).unwrap()
}

const LEG: &str = r#"<mujoco model="Hopper 2">
  <compiler angle="radian" meshdir="assets"/>
  <option integrator="implicitfast"><flag eulerdamp="disable"/></option>
  <default>
    <default class="hopper">
      <geom margin="0.001" condim="1"/>
      <joint damping="0.5" armature="0.01"/>
      <position kp="25" kv="2"/>
      <default class="hinge"><joint axis="0 1 0" range="-1 1"/></default>
      <default class="look"><geom type="mesh" contype="0" conaffinity="0"/></default>
    </default>
  </default>
  <asset><mesh name="pretty" file="pretty.obj"/><material name="m" rgba="1 0 0 1"/></asset>
  <worldbody>
    <light pos="0 0 3"/>
    <body name="base" pos="0 0 1" childclass="hopper">
      <freejoint/>
      <geom type="box" size="0.1 0.1 0.1" mass="2"/>
      <geom class="look" mesh="pretty" material="m"/>
      <camera name="eye"/>
      <body name="mount" pos="0 0 -0.1">
        <geom type="sphere" size="0.05" density="1000"/>
        <site name="imu"/>
        <body name="leg" pos="0.01 0 0" euler="0 0 1.5707963267948966">
          <inertial pos="0 0 -0.2" mass="0.5" diaginertia="0.01 0.01 0.001"/>
          <joint name="knee" class="hinge"/>
          <geom name="toe" size="0.02" pos="0 0 -0.4" solimp="0.015 1 0.031" friction="0.7 0.02 0.01"/>
        </body>
      </body>
    </body>
  </worldbody>
  <equality><joint joint1="knee"/></equality>
  <actuator><position name="drive" class="hopper" joint="knee" forcerange="-8 8"/></actuator>
  <keyframe><key name="home" qpos="0 0 1 1 0 0 0 0.25"/></keyframe>
</mujoco>"#;

#[test]
fn classes_welds_masses_and_a_named_pose_by_hand() {
    let made = read("hopper.xml", LEG).unwrap();
    assert_eq!(made.name, "hopper_2");
    let m = model(&made);
    assert_eq!((m.base(), m.links().len(), m.joints().len()), (BaseKind::Free, 2, 1));
    // the mount is welded: 2 kg of box and 1000·4/3·π·0.05³ = 0.5236 kg of ball, 0.1 m below
    let ball_kg = 1000.0 * 4.0 / 3.0 * std::f64::consts::PI * 0.05f64.powi(3);
    let base = &m.links()[0];
    near("mass", base.mass_kg, 2.5236, 1e-4);
    near("centre", base.com_m[2], -0.1 * ball_kg / (2.0 + ball_kg), 1e-6);
    let leg = &m.links()[1];
    near("leg at", leg.parent_from_link.pos_m[0], 0.01, 1e-15);
    near("leg at", leg.parent_from_link.pos_m[2], -0.1, 1e-15);
    // turned a quarter about z: its y axis points against x
    let y = leg.parent_from_link.rotate([0.0, 1.0, 0.0]);
    near("axis", y[0], -1.0, 1e-12);
    let joint = &m.joints()[0];
    assert_eq!(joint.name, "knee");
    assert_eq!((joint.damping_nm_s_per_rad, joint.armature_kgm2), (0.5, 0.01));
    assert_eq!(m.joint_limits_rad(), [(-1.0, 1.0)]);
    assert_eq!(m.nominal_pos_rad(), [0.25]);
    assert_eq!((m.kp_nm_per_rad(0), m.kd_nm_s_per_rad(0)), (25.0, 2.0));
    assert_eq!(m.servo(0).tau_max_nm, 8.0);
    assert_eq!(m.imu_site().unwrap().link, 0);
    near("imu", m.imu_site().unwrap().link_from_site.pos_m[2], -0.1, 1e-15);
    assert_eq!(m.feet().len(), 1);
    assert_eq!(m.feet()[0].radius_m(), 0.02);
    // a share of 1 is held below 1, as MuJoCo holds it
    let toe = &m.links()[1].geoms[0];
    assert_eq!(toe.soft.solimp[1], 0.9999);
    let said = made.notes.iter().map(ToString::to_string).collect::<Vec<_>>().join("\n");
    for part in ["<asset>", "<equality>", "<option>", "cameras", "`home`"] {
        assert!(said.contains(part), "{part} is not in\n{said}");
    }
}

#[test]
fn a_key_frame_in_other_units_than_the_limits_is_told() {
    let told = |old: &str, new: &str| {
        let made = read("key.xml", &LEG.replace(old, new)).unwrap();
        made.notes.iter().any(|n| n.message.contains("the key frame has knee beyond the limits"))
    };
    assert!(!told("", ""));
    assert!(told("0.25\"", "40\""));
    assert!(told("<compiler angle=\"radian\"", "<compiler"));
}

#[test]
fn without_any_actuator_every_joint_has_a_drive() {
    let start = LEG.find("  <actuator>").unwrap();
    let end = LEG.find("  <keyframe>").unwrap();
    let made = read("bare.xml", &[&LEG[..start], &LEG[end..]].concat()).unwrap();
    assert_eq!(model(&made).actuated().len(), 1);
    let said = |note: &import::Remark| note.message.contains("names no actuators");
    assert!(made.notes.iter().any(said), "{:?}", made.notes);
    // A tendon's drive is not a joint's: no guess.
    let tendon = [&LEG[..start], "<actuator><motor tendon=\"t\"/></actuator>", &LEG[end..]];
    assert!(read("tendon.xml", &tendon.concat()).is_err());
}

#[test]
fn everything_that_is_refused_is_said_at_once_with_its_line() {
    let text = r#"<mujoco>
  <worldbody>
    <body name="a">
      <joint name="one" type="ball"/>
      <geom size="0.1"/>
      <body name="b">
        <joint name="two" axis="0 0 0"/>
        <geom size="0.1" pos="1 2"/>
        <composite type="cable"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor joint="three"/></actuator>
  <something/>
</mujoco>"#;
    let ImportError::Refused { refusals: all, .. } = read("wrong.xml", text).unwrap_err() else {
        panic!("refused as a file");
    };
    let said: Vec<String> = all.iter().map(|r| format!("{} {}", r.line, r.message)).collect();
    for (line, part) in [
        (4, "ball joint"),
        (7, "no direction"),
        (8, "2 numbers where 3"),
        (9, "<composite>"),
        (13, "no joint `three`"),
        (14, "<something>"),
    ] {
        let found = said.iter().any(|s| s.starts_with(&format!("{line} ")) && s.contains(part));
        assert!(found, "line {line}, {part}: {said:#?}");
    }
}

const ARM: &str = r#"<robot name="arm">
  <link name="world"/>
  <joint name="bolt" type="fixed"><parent link="world"/><child link="foot"/><origin xyz="0 0 0.5"/></joint>
  <link name="foot"><inertial><mass value="3"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="turn" type="revolute">
    <parent link="foot"/><child link="upper"/><origin xyz="0 0 0.1" rpy="0.1 0.2 0.3"/>
    <axis xyz="0 0 2"/><limit lower="-1.5" upper="2" effort="7" velocity="3"/><dynamics damping="0.3" friction="0.1"/>
  </joint>
  <link name="upper">
    <inertial><origin xyz="0.1 0 0"/><mass value="1"/><inertia ixx="0.01" iyy="0.02" izz="0.02" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><origin xyz="0.2 0 0"/><geometry><box size="0.4 0.02 0.06"/></geometry></collision>
  </link>
</robot>"#;

#[test]
fn a_urdf_arm_by_hand() {
    let made = read("arm.urdf", ARM).unwrap();
    let m = model(&made);
    assert_eq!((m.base(), m.links().len()), (BaseKind::Fixed, 2));
    // an MJCF has a body of that name already
    assert!(!made.mjcf.contains("name=\"world\""), "{}", made.mjcf);
    assert_eq!(m.joint_limits_rad(), [(-1.5, 2.0)]);
    assert_eq!(m.servo(0).tau_max_nm, 7.0);
    let joint = &m.joints()[0];
    assert_eq!(
        (joint.axis, joint.damping_nm_s_per_rad, joint.friction_loss_nm),
        ([0.0, 0.0, 1.0], 0.3, 0.1)
    );
    assert_eq!(m.links()[1].geoms[0].shape, Shape::Box { half_size_m: [0.2, 0.01, 0.03] });
    // rpy: about fixed x, then y, then z. Of Rz(0.3)·Ry(0.2)·Rx(0.1) the x axis is (cz·cy, sz·cy, −sy)
    let places = m.kinematics(&Pose::IDENTITY, &[0.0]).unwrap();
    let x = places.links[1].rotate([1.0, 0.0, 0.0]);
    near("x", x[0], 0.3f64.cos() * 0.2f64.cos(), 1e-12);
    near("x", x[1], 0.3f64.sin() * 0.2f64.cos(), 1e-12);
    near("x", x[2], -(0.2f64.sin()), 1e-12);
    near("height", places.links[1].pos_m[2], 0.6, 1e-12);
    // the speed is the file's, the rotor a guess that says so
    assert_eq!(m.servo(0).qd_max_radps, 3.0);
    let mut lines = made.robot_toml.lines();
    let rotor = lines.find(|l| l.starts_with("armature_kgm2")).unwrap();
    assert!(rotor.ends_with("# [ours]") && !rotor.contains("= 0.0 "), "{rotor}");
    let rotor = "servo.preset.drive_0.armature_kgm2";
    assert_eq!(m.assumed_of_servo(0, "armature_kgm2"), Some(rotor));
    assert_eq!(m.assumed_of_servo(0, "qd_max_radps"), None);
}

#[test]
fn a_held_robot_is_not_left_stuck_in_the_ground() {
    let raised = |made: &Imported| made.notes.iter().any(|n| n.to_string().contains("raised"));
    assert!(!raised(&read("arm.urdf", ARM).unwrap()));
    // Bolted 0.2 m above the ground, with its joint 0.3 m below that: the box begins below the ground.
    let low = ARM
        .replace("xyz=\"0 0 0.5\"", "xyz=\"0 0 0.2\"")
        .replace("xyz=\"0 0 0.1\"", "xyz=\"0 0 -0.3\"");
    let made = read("low.urdf", &low).unwrap();
    assert!(raised(&made), "{:?}", made.notes);
    let places = model(&made).kinematics(&Pose::IDENTITY, &[0.0]).unwrap();
    // The box's far corner is within 0.2 + |(0.2, 0.01, 0.03)| = 0.403 m of the joint.
    assert!(places.links[1].pos_m[2] > 0.403, "{:?}", places.links[1].pos_m);
}

#[test]
fn the_shipped_robots_come_back_from_their_own_mjcf() {
    for name in ["polymander", "quadruped", "biped", "hexapod", "snake", "xl330_pendulum"] {
        let file = crate::common::robots().join(format!("{name}.xml"));
        let made = import::import(&file, &ImportOptions::default()).unwrap();
        let original = RobotModel::load(&file.with_extension("robot.toml")).unwrap();
        let again = model(&made);
        assert_eq!(again.actuated_names(), original.actuated_names(), "{name}");
        assert_eq!(again.joint_limits_rad(), original.joint_limits_rad(), "{name}");
        for (a, b) in again.links().iter().zip(original.links()) {
            assert_eq!((&a.name, a.mass_kg, a.parent), (&b.name, b.mass_kg, b.parent), "{name}");
            for i in 0..9 {
                near(&a.name, a.inertia_kgm2[i / 3][i % 3], b.inertia_kgm2[i / 3][i % 3], 1e-15);
            }
        }
        // with all joints at zero, only these stand on their feet
        if matches!(name, "quadruped" | "biped") {
            assert_eq!(again.feet().len(), original.feet().len(), "{name}");
        }
    }
}

/// Set `CAUDATA_MODELS` to a folder of MJCF and URDF files of your own to see what becomes of each.
#[test]
fn a_folder_of_models() {
    let Some(folder) = std::env::var_os("CAUDATA_MODELS") else {
        return;
    };
    let mut files = Vec::new();
    find(Path::new(&folder), &mut files);
    files.sort();
    for file in files {
        match import::import(&file, &ImportOptions::default()) {
            Ok(made) => eprintln!("loaded  {} ({} notes)", file.display(), made.notes.len()),
            Err(error) => eprintln!("REFUSED {}\n{error}", file.display()),
        }
    }
}

fn find(folder: &Path, files: &mut Vec<PathBuf>) {
    for entry in std::fs::read_dir(folder).unwrap().flatten() {
        let path = entry.path();
        let kind = path.extension().map(|e| e.to_string_lossy().into_owned());
        if path.is_dir() {
            find(&path, files);
        } else if matches!(kind.as_deref(), Some("xml" | "urdf")) {
            files.push(path);
        }
    }
}

#[test]
fn a_robot_written_as_urdf_is_read_back_the_same() {
    for name in ["polymander", "quadruped", "biped", "hexapod", "snake", "xl330_pendulum"] {
        let robot = crate::common::robots().join(format!("{name}.robot.toml"));
        let original = RobotModel::load(&robot).unwrap();
        let free = original.base() == BaseKind::Free;
        let options = ImportOptions { free_base: Some(free), ..ImportOptions::default() };
        let made =
            import::import(&File::new("robot.urdf", &original.to_urdf()).0, &options).unwrap();
        let again = model(&made);
        near(name, again.total_mass_kg(), original.total_mass_kg(), 1e-4);
        // every joint's axis lies where it lay, at zero and bent
        for q in [0.0, 0.3] {
            let bent =
                |m: &RobotModel| m.kinematics(&Pose::IDENTITY, &vec![q; m.joints().len()]).unwrap();
            let (ours, theirs) = (bent(&original), bent(&again));
            for (j, joint) in original.joints().iter().enumerate() {
                let other = again.joint_index(&joint.name).unwrap();
                for i in 0..3 {
                    let (a, b) = (&ours.joints[j], &theirs.joints[other]);
                    // a base that is read from a URDF stands at the origin, as kinematics puts a free one
                    near(&joint.name, a.anchor_m[i], b.anchor_m[i], 1e-9);
                    near(&joint.name, a.axis[i], b.axis[i], 1e-9);
                }
            }
        }
    }
}

/// Motors that command torque, an IMU whose site is called otherwise, feet without names, no pose.
#[test]
fn what_a_file_does_not_say_is_worked_out_or_told() {
    let text = LEG
        .replace("site name=\"imu\"", "site name=\"mount_point\"")
        .replace("geom name=\"toe\" ", "geom ")
        .replace(
            "<position name=\"drive\" class=\"hopper\" joint=\"knee\" forcerange=\"-8 8\"/>",
            "<motor joint=\"knee\" ctrlrange=\"-7 7\" ctrllimited=\"true\"/>",
        )
        .replace(
            "<keyframe><key name=\"home\" qpos=\"0 0 1 1 0 0 0 0.25\"/></keyframe>",
            "<sensor><gyro site=\"mount_point\"/></sensor>",
        );
    let made = read("unsaid.xml", &text).unwrap();
    let m = model(&made);
    assert_eq!(m.imu_site().unwrap().link, 0);
    assert_eq!(m.feet().len(), 1);
    // 7 N·m at 0.7 rad, and a fortieth of it as damping
    assert_eq!((m.kp_nm_per_rad(0), m.kd_nm_s_per_rad(0)), (10.0, 0.25));
    let told = |word: &str| made.notes.iter().any(|n| n.to_string().contains(word));
    assert!(told("[pose.nominal_rad]"), "{:?}", made.notes);
}

/// A robot of one leg, with what a test adds to its parts.
fn hopper(trunk: &str, joint: &str, leg: &str, end: &str) -> String {
    format!(
        "<mujoco><compiler angle=\"degree\"/><worldbody><body name=\"base\"><freejoint/>{trunk}\
         <geom type=\"box\" size=\"0.1 0.1 0.05\" mass=\"2\"/><body name=\"leg\" pos=\"0 0 -0.1\">\
         <joint name=\"hip\" axis=\"0 1 0\" range=\"-80 80\" {joint}/>{leg}</body></body></worldbody>{end}</mujoco>"
    )
}

const BALL: &str = "<geom size=\"0.03\" pos=\"0 0 -0.2\" mass=\"0.3\"/>";
const DRIVE: &str = "<actuator><position joint=\"hip\" kp=\"9\" forcerange=\"-3 3\"/></actuator>";

#[test]
fn what_an_mjcf_says_of_its_base_goes_before_the_option() {
    let told = |free: bool| {
        let file = File::new("base.xml", &hopper("", "", BALL, DRIVE));
        let options = ImportOptions { free_base: Some(free), ..ImportOptions::default() };
        let made = import::import(&file.0, &options).unwrap();
        assert_eq!(model(&made).base(), BaseKind::Free);
        made.notes.iter().any(|n| n.to_string().contains("`--base` is of a URDF"))
    };
    assert!(told(false) && !told(true));
}

#[test]
fn a_key_counts_from_the_ref_of_its_joint() {
    let key = "<keyframe><key name=\"home\" qpos=\"0 0 0.4 1 0 0 0 0.5\"/></keyframe>";
    let text = hopper("", "ref=\"10\"", BALL, &format!("{DRIVE}{key}"));
    let m = model(&read("ref.xml", &text).unwrap());
    near("hip", m.nominal_pos_rad()[0], 0.5 - 10f64.to_radians(), 1e-9);
    near("range", m.joint_limits_rad()[0].0, -90f64.to_radians(), 1e-9);
}

#[test]
fn an_imu_that_is_mounted_turned_reads_forward_left_and_up() {
    let turned = |imu: &str| {
        let made = read("imu.xml", &hopper(imu, "", BALL, DRIVE)).unwrap();
        let told = made.notes.iter().any(|n| n.to_string().contains("mounted turned"));
        (model(&made).imu_site().unwrap().link_from_site, told)
    };
    let (site, told) = turned("<site name=\"imu\" pos=\"0.01 0 0.02\" euler=\"180 0 0\"/>");
    assert!(told);
    assert_eq!(site.pos_m, [0.01, 0.0, 0.02]);
    near("up", site.rotate([0.0, 0.0, 1.0])[2], 1.0, 1e-12);
    // in a body that is turned itself
    let (site, told) = turned(
        "<body name=\"neck\" euler=\"0 0 90\"><joint name=\"neck\" axis=\"0 0 1\" range=\"-9 9\"/><site name=\"imu\"/>\
         <geom size=\"0.03\"/></body>",
    );
    assert!(told);
    near("forward", site.rotate([1.0, 0.0, 0.0])[1], -1.0, 1e-12);
    // a tilt is one of the mounting
    let (site, told) = turned("<site name=\"imu\" euler=\"0 5 0\"/>");
    assert!(!told);
    near("tilt", site.rotate([1.0, 0.0, 0.0])[2], -(5f64.to_radians().sin()), 1e-12);
}

#[test]
fn a_mesh_is_scaled_by_its_class_and_lies_where_its_reference_says() {
    let corners = "v -10 -20 -60\nv 10 -20 -60\nv 10 20 -60\nv -10 20 -60\nv -10 -20 60\nv 10 -20 60\nv 10 20 60\nv -10 20 60\n";
    let faces = "f 1 4 3 2\nf 5 6 7 8\nf 1 2 6 5\nf 2 3 7 6\nf 3 4 8 7\nf 4 1 5 8\n";
    let end = format!(
        "<default><default class=\"mm\"><mesh scale=\"0.001 0.001 0.001\"/></default></default>\
         <asset><mesh name=\"shank\" class=\"mm\" file=\"shank.obj\" refpos=\"0 0 100\" refquat=\"1 1 0 0\"/></asset>{DRIVE}"
    );
    let leg = "<geom type=\"mesh\" mesh=\"shank\" mass=\"0.2\"/>";
    let file = File::new("mesh.xml", &hopper("", "", leg, &end));
    std::fs::write(file.0.with_file_name("shank.obj"), format!("{corners}{faces}")).unwrap();
    let made = import::import(&file.0, &ImportOptions::default()).unwrap();
    let link = model(&made).links()[1].clone();
    // what was 100 mm below the reference is behind it once turned: z of the file is y
    for (axis, m) in [0.0, -0.1, 0.0].into_iter().enumerate() {
        near("centre", link.com_m[axis], m, 1e-9);
        near("box", link.geoms[0].link_from_geom.pos_m[axis], m, 1e-9);
    }
    assert!(
        matches!(link.geoms[0].shape, Shape::Box { half_size_m: [_, y, _] } if (y - 0.06).abs() < 1e-9)
    );
}

#[test]
fn gains_of_a_position_actuator_may_stand_in_a_class_of_general_ones_and_the_other_way_round() {
    for (class, drive) in [
        ("<general gainprm=\"50\" biasprm=\"0 -50 -2\" biastype=\"affine\"/>", "position"),
        ("<position kp=\"50\" kv=\"2\"/>", "general"),
    ] {
        let end = format!(
            "<default>{class}</default><actuator><{drive} joint=\"hip\" forcerange=\"-3 3\"/></actuator>"
        );
        let m = model(&read("class.xml", &hopper("", "", BALL, &end)).unwrap());
        assert_eq!(
            (m.gains()[0].kp_nm_per_rad, m.gains()[0].kd_nm_s_per_rad),
            (50.0, 2.0),
            "{class}"
        );
    }
}

#[test]
fn a_torque_ends_at_what_can_be_asked_for_or_at_the_range_of_forces() {
    for (drive, most_nm) in [
        ("motor ctrlrange=\"-1 1\" forcerange=\"-12 12\" gear=\"6\"", 6.0),
        ("motor ctrlrange=\"-9 9\" forcerange=\"-2 2\" gear=\"6\"", 12.0),
        ("general ctrlrange=\"-1 1\" gainprm=\"7\"", 7.0),
        ("general ctrlrange=\"-1 1\" dyntype=\"integrator\" forcerange=\"-4 4\"", 4.0),
        ("motor ctrllimited=\"false\" ctrlrange=\"-1 1\" forcerange=\"-5 5\"", 5.0),
        ("position kp=\"50\" ctrlrange=\"-1 1\" forcerange=\"-3 3\"", 3.0),
    ] {
        let end = format!("<actuator><{drive} joint=\"hip\"/></actuator>");
        let m = model(&read("torque.xml", &hopper("", "", BALL, &end)).unwrap());
        assert_eq!(m.servo(0).tau_max_nm, most_nm, "{drive}");
    }
}

#[test]
fn the_rotor_of_a_slide_is_a_mass() {
    let slide = |effort: &str| {
        let text = ARM.replace("\"revolute\"", "\"prismatic\"").replace("effort=\"7\"", effort);
        model(&read("slide.urdf", &text).unwrap()).joints()[0].armature_kgm2
    };
    // no more than the 1 kg that it moves
    near("rotor", slide("effort=\"500\""), 1.0, 1e-9);
    // over 0.1 m: ten times that of a hinge of as many N·m
    near("rotor", slide("effort=\"20\""), 0.17, 1e-9);
}

/// A dog's arm of two joints: at 0.5 rad and as drawn its bodies are one with the trunk, and the hand is where it was.
#[test]
fn what_is_welded_stays_where_it_is() {
    let text = r#"<mujoco model="dog"><compiler angle="radian"/><worldbody><body name="trunk" pos="0 0 0.3"><freejoint/>
      <geom type="box" size="0.2 0.1 0.05" mass="5"/>
      <body name="arm" pos="0.1 0 0.1">
        <joint name="z1/sway" axis="0 0 1" pos="0 0.02 0" range="-1 1" ref="0.2"/><joint name="lift" axis="0 1 0" pos="0.01 0 0" range="-1 1"/>
        <geom type="capsule" fromto="0 0 0 0.2 0 0" size="0.02" mass="0.4"/>
        <body name="hand" pos="0.2 0 0"><joint name="grip" type="slide" axis="1 0 0" range="0 0.03"/>
          <geom type="sphere" size="0.02" mass="0.1"/></body>
      </body>
      <body name="leg" pos="0 0 -0.05"><joint name="hip" axis="0 1 0" range="-1 1"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.2" size="0.02" mass="0.3"/></body>
      </body></worldbody></mujoco>"#;
    let weld = |joint: &str, at| Weld { joint: joint.to_owned(), at };
    let made = |weld: Vec<Weld>| {
        import::import(
            &File::new("dog.xml", text).0,
            &ImportOptions { weld, ..ImportOptions::default() },
        )
    };
    let plain = made(Vec::new()).unwrap();
    let told = |made: &Imported, what: &str| made.notes.iter().any(|n| n.message.contains(what));
    assert!(told(&plain, "--weld z1_sway lift grip"), "{:?}", plain.notes);
    let [swayed, welded] = [
        vec![weld("lift", Some(0.5))],
        vec![weld("lift", Some(0.5)), weld("z1/sway", Some(0.3)), weld("grip", Some(0.01))],
    ]
    .map(|welds| made(welds).unwrap());
    assert!(!told(&welded, "--weld"), "{:?}", welded.notes);
    assert_eq!(model(&welded).actuated_names(), ["hip"]);
    // the centre of mass of all is where the joints' own angles put it, also with the first of two left in; 0.3 of a
    // joint that is drawn at 0.2 are 0.1 from there, which is where the robot file counts from
    let com = |made: &Imported, angles: &[(&str, f64)]| {
        let robot = model(made);
        let pos: Vec<f64> = (robot.actuated_names().iter())
            .map(|name| angles.iter().find(|a| a.0 == *name).map_or(0.0, |a| a.1))
            .collect();
        let places = robot.kinematics(&Pose::IDENTITY, &robot.full_pos_rad(&pos).unwrap()).unwrap();
        robot.centre_of_mass_m(&places)
    };
    let want = com(&plain, &[("z1_sway", 0.1), ("lift", 0.5), ("grip", 0.01)]);
    let got = com(&welded, &[]);
    (0..3).for_each(|k| near("centre of mass", got[k], want[k], 1e-9));
    let want = com(&plain, &[("z1_sway", 0.4), ("lift", 0.5)]);
    let got = com(&swayed, &[("z1_sway", 0.4)]);
    (0..3).for_each(|k| near("centre of mass", got[k], want[k], 1e-9));
    let none = made(vec![weld("tail", None)]).unwrap_err().to_string();
    assert!(
        none.contains("has no joint `tail` to weld; it has z1/sway, lift, grip, hip"),
        "{none}"
    );
    let degrees = made(vec![weld("z1_sway", Some(90.0))]).unwrap_err().to_string();
    assert!(degrees.contains("outside of its range (-1 to 1)"), "{degrees}");
}
