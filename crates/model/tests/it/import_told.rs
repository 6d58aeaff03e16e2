//! What an imported file does not say or hardly means: a pose, feet, names, units.

use std::fmt::Write;

use caudata_model::import::{ImportError, ImportOptions, Imported, import};
use caudata_model::{BaseKind, Pose, RobotModel, Shape};

use crate::import::{model, read};

/// A URDF out of a drawing program: four straight legs of two joints, a ball at the end of each, no pose.
fn quadruped() -> String {
    let inertia = |i: f64| {
        format!("<inertia ixx=\"{i}\" iyy=\"{i}\" izz=\"{i}\" ixy=\"0\" ixz=\"0\" iyz=\"0\"/>")
    };
    let mut out = format!(
        "<robot name=\"Hündchen\"><link name=\"base\"><inertial><mass value=\"0.8\"/>{}</inertial>\
         <collision><geometry><box size=\"0.2 0.1 0.05\"/></geometry></collision></link>\n",
        inertia(1e-3)
    );
    for (leg, x, y) in
        [("fl", 0.1, 0.06), ("fr", 0.1, -0.06), ("rl", -0.1, 0.06), ("rr", -0.1, -0.06)]
    {
        // one knee turns the other way round
        let (axis, low, high) = if leg == "fr" { (-1, -0.2, 2.5) } else { (1, -2.5, 0.2) };
        write!(
            out,
            "<link name=\"{leg}_thigh\"><inertial><mass value=\"0.08\"/>{}</inertial></link>\n\
             <joint name=\"{leg}_hüfte\" type=\"revolute\"><origin xyz=\"{x} {y} 0\"/><parent link=\"base\"/>\
             <child link=\"{leg}_thigh\"/><axis xyz=\"0 1 0\"/><limit lower=\"-1.57\" upper=\"1.57\" effort=\"1.5\" velocity=\"6\"/></joint>\n\
             <link name=\"{leg}_shank\"><inertial><mass value=\"0.04\"/>{}</inertial>\
             <collision><origin xyz=\"0 0 -0.085\"/><geometry><sphere radius=\"0.012\"/></geometry></collision></link>\n\
             <joint name=\"{leg}_knee_of_a_name_that_is_much_too_long_joint\" type=\"revolute\"><origin xyz=\"0 0 -0.08\"/>\
             <parent link=\"{leg}_thigh\"/><child link=\"{leg}_shank\"/><axis xyz=\"0 {axis} 0\"/>\
             <limit lower=\"{low}\" upper=\"{high}\" effort=\"1.5\" velocity=\"6\"/></joint>\n",
            inertia(5e-5),
            inertia(3e-5)
        )
        .unwrap();
    }
    out + "</robot>"
}

pub(crate) fn told(made: &Imported, word: &str) -> bool {
    made.notes.iter().any(|n| n.to_string().contains(word))
}

/// Refusals, each as `LINE MESSAGE`.
pub(crate) fn refused(name: &str, text: &str) -> Vec<String> {
    match read(name, text) {
        Err(ImportError::Refused { refusals: all, .. }) => {
            all.iter().map(|r| format!("{} {}", r.line, r.message)).collect()
        }
        other => panic!("{other:?}"),
    }
}

/// Feet in the nominal pose, seen from the root.
fn feet(m: &RobotModel) -> Vec<[f64; 3]> {
    let q = m.full_pos_rad(m.nominal_pos_rad()).unwrap();
    let places = m.kinematics(&Pose::IDENTITY, &q).unwrap();
    m.feet().iter().map(|f| places.links[f.link].point(f.centre_m)).collect()
}

#[test]
fn straight_legs_are_bent_and_stand_below_their_hips() {
    let made = read("dog.urdf", &quadruped()).unwrap();
    let m = model(&made);
    assert!(told(&made, "one was worked out"), "{:?}", made.notes);
    let feet = feet(&m);
    assert_eq!(feet.len(), 4);
    for (foot, (x, y)) in feet.iter().zip([(0.1, 0.06), (0.1, -0.06), (-0.1, 0.06), (-0.1, -0.06)])
    {
        // three quarters of 0.165 m, though one knee's axis is turned round
        let off = [foot[0] - x, foot[1] - y, foot[2] + 0.124];
        assert!(off.iter().all(|d| d.abs() < 0.02), "{feet:?}");
    }
    let knees: Vec<f64> = m.nominal_pos_rad().iter().skip(1).step_by(2).map(|q| q.abs()).collect();
    assert!(knees.iter().all(|q| (1.2..1.7).contains(q)), "{knees:?}");
    // what bends already stays as it is
    let bent = quadruped().replace("xyz=\"0 0 -0.085\"", "xyz=\"-0.05 0 -0.06\"");
    let bent = bent.replace("xyz=\"0 0 -0.08\"", "xyz=\"0.05 0 -0.06\"");
    assert!(model(&read("bent.urdf", &bent).unwrap()).nominal_pos_rad().iter().all(|q| *q == 0.0));
}

/// The legs before a waist stand as those behind it, and the waist stays straight.
#[test]
fn a_waist_is_no_joint_of_a_leg() {
    let mut text = quadruped();
    for leg in ["fl", "fr"] {
        let at = text.find(&format!("{leg}_hüfte")).unwrap();
        let parent = at + text[at..].find("link=\"base\"").unwrap();
        text.replace_range(parent..parent + "link=\"base\"".len(), "link=\"front\"");
    }
    let waist = "<link name=\"front\"><inertial><mass value=\"0.3\"/>\
                 <inertia ixx=\"0.001\" iyy=\"0.001\" izz=\"0.001\"/></inertial><joint_properties friction=\"1\"/></link>\
                 <joint name=\"waist\" type=\"revolute\"><parent link=\"base\"/><child link=\"front\"/>\
                 <axis xyz=\"0 0 1\"/><limit lower=\"-0.6\" upper=\"0.6\" effort=\"1.5\" velocity=\"6\"/></joint></robot>";
    let made = read("waist.urdf", &text.replace("</robot>", waist)).unwrap();
    assert!(told(&made, "<joint_properties> in a <link> is not kept"), "{:?}", made.notes);
    let (m, plain) = (model(&made), model(&read("dog.urdf", &quadruped()).unwrap()));
    let place = m.actuated_names().iter().position(|name| *name == "waist").unwrap();
    assert_eq!(m.nominal_pos_rad()[place], 0.0);
    assert_eq!(m.nominal_pos_rad().len(), 9);
    for (a, b) in feet(&m).iter().zip(feet(&plain)) {
        assert!((0..3).all(|i| (a[i] - b[i]).abs() < 0.01), "{a:?} and {b:?}");
    }
}

/// A wheel with a square hub on one side, one like a roll on the other; a mass of 1 kg half a metre below a joint of
/// gear 3.
#[test]
fn wheels_are_no_feet_and_a_damping_ratio_becomes_a_gain() {
    let wheel = |name: &str, y: f64, tyre: &str, hub_m: f64| {
        format!(
            "<body name=\"{name}\" pos=\"0 {y} 0\"><joint name=\"{name}\" axis=\"0 1 0\"/>\
             <geom type=\"box\" size=\"{hub_m} 0.03 {hub_m}\"/>\
             <geom type=\"{tyre}\" size=\"0.1 0.02\" euler=\"90 0 0\"/></body>"
        )
    };
    let hub_m = 0.06; // its corners are 0.085 m off the axle
    let position = "<position joint=\"arm\" kp=\"30\" dampratio=\"0.5\" gear=\"3\"/>";
    let velocity = "<velocity joint=\"arm\" kv=\"0.1\" gear=\"3\"/>";
    let text = |first: &str, second: &str| {
        format!(
            "<mujoco><worldbody><body name=\"base\"><freejoint/><geom size=\"0.05\"/>{}{}\
         <body name=\"arm\"><joint name=\"arm\" axis=\"0 1 0\" range=\"-40 40\" armature=\"0.05\"/>\
         <inertial pos=\"0 0 -0.5\" mass=\"1\" diaginertia=\"0.01 0.01 0.01\"/></body></body></worldbody><actuator>\
         {first}{second}<motor joint=\"l\"/><motor joint=\"r\"/></actuator></mujoco>",
            wheel("l", 0.1, "cylinder", hub_m),
            wheel("r", -0.1, "capsule", hub_m)
        )
    };
    let made = read("cart.xml", &text(position, velocity)).unwrap();
    assert!(told(&made, "a wheel and no foot") && told(&made, "dampratio"), "{:?}", made.notes);
    let m = model(&made);
    assert!(m.feet().is_empty() && !m.rolls(0) && m.rolls(1) && m.rolls(2) && m.balances());
    // what the file says of a wheel's friction is the ground's; of the rest it says nothing
    assert_eq!(m.contact().body_friction, 0.5);
    let grips =
        text(position, velocity).replace("size=\"0.1 0.02\"", "size=\"0.1 0.02\" friction=\"0.9\"");
    assert_eq!(model(&read("cart.xml", &grips).unwrap()).contact().body_friction, 0.9);
    // on a castor, or a belly that lies on the ground, it stands
    for (z_m, balances) in [(-0.07, false), (-0.03, true)] {
        let castor = format!("<freejoint/><geom size=\"0.025\" pos=\"-0.2 0 {z_m}\"/>");
        let text = text(position, velocity).replace("<freejoint/>", &castor);
        assert_eq!(model(&read("cart.xml", &text).unwrap()).balances(), balances, "{z_m}");
    }
    let gains = m.gains()[0];
    assert_eq!(model(&read("cart.xml", &text(velocity, position)).unwrap()).gains(), m.gains());
    let by_speed = text(position, velocity)
        .replace("<motor joint=\"l\"/>", "<velocity joint=\"l\" kv=\"0.5\"/>");
    let wheel = model(&read("cart.xml", &by_speed).unwrap()).gains()[1];
    assert_eq!((wheel.kp_nm_per_rad, wheel.kd_nm_s_per_rad), (20.0, 0.5));
    // 0.25 + 0.01 + 0.05 kg·m² at 270 N·m/rad, and 9 × 0.1 N·m·s/rad
    assert!((gains.kp_nm_per_rad - 270.0).abs() < 1e-9);
    assert!((gains.kd_nm_s_per_rad - (270.0_f64 * 0.31).sqrt() - 0.9).abs() < 1e-9, "{gains:?}");
}

/// Soles that nothing touches by their bits, one of them paired with a floor that stands in another file, one with the
/// other sole.
#[test]
fn what_a_pair_lets_touch_the_floor_is_a_foot() {
    let leg = |name: &str, y: f64| {
        format!(
            "<body name=\"{name}\" pos=\"0 {y} 0\"><joint name=\"{name}\" axis=\"0 1 0\" range=\"-60 60\"/>\
             <geom name=\"{name}_sole\" size=\"0.02\" pos=\"0 0 -0.2\" contype=\"0\" conaffinity=\"0\"/></body>"
        )
    };
    let text = format!(
        "<mujoco><worldbody><body name=\"base\"><freejoint/><geom size=\"0.05\"/>{}{}</body></worldbody><contact>\
         <pair geom1=\"floor\" geom2=\"l_sole\" friction=\"0.6 0.6\"/><pair geom1=\"l_sole\" geom2=\"r_sole\"/></contact>\
         <actuator><position joint=\"l\" kp=\"9\"/><position joint=\"r\" kp=\"9\"/></actuator></mujoco>",
        leg("l", 0.1),
        leg("r", -0.1)
    );
    let made = read("pairs.xml", &text).unwrap();
    assert!(told(&made, "two parts of the robot"), "{:?}", made.notes);
    assert!(told(&made, "no geom `floor` in this file; it is taken for the ground"));
    let m = model(&made);
    let names: Vec<&str> = m.feet().iter().map(|foot| foot.name.as_str()).collect();
    assert_eq!(names, ["l"]);
    let foot = &m.feet()[0];
    assert_eq!(m.links()[foot.link].geoms[foot.geoms[0]].friction, 0.6);
}

#[test]
fn legs_that_the_file_stretches_out_stand_spread() {
    let mut text = quadruped();
    for (old, new) in
        [("xyz=\"0 0 -0.085\"", "xyz=\"0.11 0 0\""), ("xyz=\"0 0 -0.08\"", "xyz=\"0.07 0 0\"")]
    {
        text = text.replace(old, new);
    }
    for (y, yaw) in [("0.06", "1.5708"), ("-0.06", "-1.5708")] {
        text = text.replace(
            &format!(" {y} 0\"/><parent"),
            &format!(" {y} 0\" rpy=\"0 0 {yaw}\"/><parent"),
        );
    }
    let text =
        text.replace("\"-2.5\" upper=\"0.2\"", "\"-0.2\" upper=\"2.5\"").replace("0 -1 0", "0 1 0");
    let m = model(&read("spider.urdf", &text).unwrap());
    let feet = feet(&m);
    assert_eq!(feet.len(), 4, "{feet:?}");
    assert!(feet.iter().all(|f| f[2] < -0.1 && f[1].abs() > 0.12), "{feet:?}");
}

/// Four legs around a trunk, two of them in its middle plane; a trunk that is an ellipsoid, thighs without a shape.
#[test]
fn legs_around_a_trunk_are_spread_and_what_has_no_shape_is_drawn() {
    let joint = |name: &str, k: i32, axis: &str, range: &str| {
        format!("<joint name=\"{name}{k}\" axis=\"{axis}\" range=\"{range}\"/>")
    };
    let leg = |k: i32| {
        let (y, x) = f64::from(90 * k).to_radians().sin_cos();
        format!(
            "<body name=\"hip{k}\" pos=\"{} {} 0\" euler=\"0 0 {}\">{}{}\
             <inertial pos=\"0.04 0 0\" mass=\"0.06\" diaginertia=\"1e-5 4e-5 4e-5\"/>\
             <body name=\"shank{k}\" pos=\"0.08 0 0\">{}<geom type=\"capsule\" fromto=\"0 0 0 0.12 0 0\" size=\"0.01\"/></body></body>",
            0.08 * x,
            0.08 * y,
            90 * k,
            joint("yaw", k, "0 0 1", "-45 45"),
            joint("lift", k, "0 -1 0", "-70 70"),
            joint("knee", k, "0 -1 0", "-137 0")
        )
    };
    let text = format!(
        "<mujoco><worldbody><body name=\"trunk\"><freejoint/><geom type=\"ellipsoid\" size=\"0.06 0.09 0.03\"/>{}</body>\
         </worldbody></mujoco>",
        (0..4).map(leg).collect::<String>()
    );
    let made = read("star.xml", &text).unwrap();
    assert!(
        told(&made, "as long and as wide") && told(&made, "the box of its inertia"),
        "{:?}",
        made.notes
    );
    let m = model(&made);
    let trunk = m.links()[0].geoms[0].shape;
    assert_eq!(trunk, Shape::Capsule { radius_m: 0.03, half_length_m: 0.06 });
    let feet = feet(&m);
    assert!(feet.iter().all(|f| f[2] < -0.06 && f[0].hypot(f[1]) > 0.12), "{feet:?}");
    // 0.06 kg, 1e-5 and 4e-5 kg·m²: a rod of 3.2 by 3.2 by 8.4 cm
    let Shape::Box { half_size_m } = m.links()[1].geoms[0].shape else { panic!() };
    assert!((half_size_m.iter().sum::<f64>() - 0.0158 * 2.0 - 0.0418).abs() < 1e-3);
}

#[test]
fn names_are_those_that_policies_and_logs_can_carry() {
    let made = read("dog.urdf", &quadruped()).unwrap();
    assert_eq!(made.name, "huendchen");
    let m = model(&made);
    let names = m.actuated_names();
    assert_eq!(names[0], "fl_huefte");
    assert!(names[1].len() <= 32 && names[1].starts_with("fl_knee_of_a_nam"), "{names:?}");
    assert!(told(&made, "is called `fl_huefte` here"));
}

#[test]
fn a_sole_is_all_its_balls_and_its_toes_need_no_drive() {
    let leg = |name: &str, y: f64| {
        let corner =
            |x: f64, y: f64| format!("<geom size=\"0.01\" pos=\"{x} {y} -0.02\" mass=\"0.01\"/>");
        let balls =
            [corner(0.04, 0.02), corner(0.04, -0.02), corner(-0.04, 0.02), corner(-0.04, -0.02)]
                .concat();
        format!(
            "<body name=\"{name}_shin\" pos=\"0 {y} -0.2\"><joint name=\"{name}_knee\" axis=\"0 1 0\" range=\"-1 1\"/>\
             <geom size=\"0.02\" mass=\"0.2\"/><body name=\"{name}_foot\" pos=\"0 0 -0.2\">\
             <joint name=\"{name}_ankle\" axis=\"0 1 0\" range=\"-1 1\"/>{balls}\
             <body name=\"{name}_toe\" pos=\"0.05 0 -0.02\"><joint name=\"{name}_toe\" axis=\"0 1 0\" range=\"-1 1\" stiffness=\"1\"/>\
             <geom type=\"box\" size=\"0.02 0.02 0.01\" pos=\"0.02 0 0\" mass=\"0.02\"/></body></body></body>"
        )
    };
    let motors: String = ["l_knee", "l_ankle", "r_knee", "r_ankle"]
        .map(|j| format!("<motor joint=\"{j}\"/>"))
        .concat();
    let text = format!(
        "<mujoco><compiler angle=\"radian\"/><worldbody><body name=\"hips\"><freejoint/><geom size=\"0.05\" mass=\"1\"/>{}{}\
         </body></worldbody><actuator>{motors}</actuator></mujoco>",
        leg("l", 0.06),
        leg("r", -0.06)
    );
    let m = model(&read("toes.xml", &text).unwrap());
    let names: Vec<(&str, usize)> =
        m.feet().iter().map(|f| (f.name.as_str(), f.geoms.len())).collect();
    assert_eq!(names, [("l_foot", 4), ("r_foot", 4)]);
    // the toes hang as the file has them
    assert!(m.joints().len() == 6 && feet(&m)[0][2] < -0.3);
    // no drive says its torque: 1.52 kg that reach 0.46 m
    let torque_nm = m.servo(0).tau_max_nm;
    assert!((4.0..9.0).contains(&torque_nm), "{torque_nm}");
}

/// Moments of some links of [`quadruped`].
const BALL: &str = "ixx=\"0.00003\" iyy=\"0.00003\" izz=\"0.00003\"";

#[test]
fn units_that_are_hardly_meant_are_told() {
    let plain = quadruped();
    let quiet = read("dog.urdf", &plain).unwrap();
    assert!(!told(&quiet, "degrees") && !told(&quiet, "unit"), "{:?}", quiet.notes);
    for (old, new, word) in [
        ("lower=\"-1.57\" upper=\"1.57\"", "lower=\"-90\" upper=\"90\"", "are they degrees?"),
        ("mass value=\"0.", "mass value=\"80", "mass in grams"),
        (BALL, "ixx=\"0.03\" iyy=\"0.03\" izz=\"0.03\"", "in another unit (g, g·mm²)"),
    ] {
        assert!(plain.contains(old), "{old}");
        let made = read("units.urdf", &plain.replace(old, new)).unwrap();
        assert!(told(&made, word), "{word}: {:?}", made.notes);
    }
    // a file in radians that does not say so; a URDF always has radians
    let arm = |compiler: &str, range: &str| {
        format!(
            "<mujoco>{compiler}<worldbody><body name=\"arm\"><joint name=\"turn\" range=\"{range}\"/>\
             <geom size=\"0.05\" mass=\"1\"/></body></worldbody><actuator><motor joint=\"turn\"/></actuator></mujoco>"
        )
    };
    for (compiler, range, asked) in [
        ("", "-1.57 1.57", true),
        ("", "-90 90", false),
        ("<compiler angle=\"radian\"/>", "-0.05 0.05", false),
    ] {
        let made = read("arm.xml", &arm(compiler, range)).unwrap();
        assert_eq!(told(&made, "radians that count as degrees"), asked, "{:?}", made.notes);
    }
    // no body of this size has either
    for moments in ["ixx=\"30000\" iyy=\"30000\" izz=\"30000\"", "ixx=\"3\" iyy=\"3\" izz=\"7000\""]
    {
        let said = refused("units.urdf", &plain.replace(BALL, moments));
        assert!(said.iter().all(|s| s.contains("in another unit (g, g·mm²)")), "{said:?}");
    }
    // no body has this; the line is that of the link in the file
    let wrong = plain.replacen("ixx=\"0.001\"", "ixx=\"0.01\"", 1);
    let said = refused("wrong.urdf", &wrong);
    assert!(
        said.len() == 1
            && said[0].starts_with("1 <link name=\"base\">")
            && said[0].contains("triangle"),
        "{said:?}"
    );
}

#[test]
fn what_floats_on_an_empty_world_is_a_free_base() {
    let floating = |world: &str| {
        let text = format!(
            "<robot name=\"hop\">{world}<joint name=\"f\" type=\"floating\"><parent link=\"world\"/><child link=\"b\"/></joint>\
             <link name=\"b\"><inertial><mass value=\"2\"/><inertia ixx=\"0.01\" iyy=\"0.01\" izz=\"0.01\"/></inertial></link>\
             <link name=\"l\"><inertial><mass value=\"1\"/><inertia ixx=\"0.01\" iyy=\"0.01\" izz=\"0.01\"/></inertial></link>\
             <joint name=\"k\" type=\"revolute\"><parent link=\"b\"/><child link=\"l\"/><axis xyz=\"0 1 0\"/>\
             <limit lower=\"-1\" upper=\"1\" effort=\"3\" velocity=\"5\"/></joint></robot>"
        );
        read("hop.urdf", &text)
    };
    let made = floating("<link name=\"world\"/>").unwrap();
    assert_eq!((model(&made).base(), model(&made).links().len()), (BaseKind::Free, 2));
    // a world that weighs something is a body of the robot
    assert!(floating("<link name=\"world\"><inertial/></link>").is_err());
}

#[test]
fn every_fault_of_a_urdf_is_said_at_once() {
    let said = refused(
        "faults.urdf",
        r#"<robot name="faults">
  <link name="base"/>
  <link name="a"><inertial><mass value="abc"/></inertial></link>
  <joint name="j" type="revolute"><parent link="base"/><child link="b"/><axis xyz="0 0 0"/></joint>
  <joint name="k" type="floating"><parent link="bsae"/><child link="a"/></joint>
  <joint name="k" type="planar"><parent link="a"/><child link="a"/></joint>
</robot>"#,
    );
    for (line, part) in [
        (3, "`abc` is not a usable number"),
        (4, "there is no link `b`"),
        (4, "no direction"),
        (5, "there is no link `bsae`"),
        (5, "floating joint"),
        (6, "hangs on another joint already"),
        (6, "another of this name"),
        (6, "a planar joint"),
    ] {
        let found = said.iter().any(|s| s.starts_with(&format!("{line} ")) && s.contains(part));
        assert!(found, "line {line}, {part}: {said:#?}");
    }
}

/// As MuJoCo finds them.
#[test]
fn a_file_that_an_included_one_includes_lies_beside_it_or_the_outermost() {
    let dir = tempfile::tempdir().unwrap();
    let write = |name: &str, text: &str| std::fs::write(dir.path().join(name), text).unwrap();
    std::fs::create_dir(dir.path().join("sub")).unwrap();
    write("main.xml", "<mujoco><worldbody><include file=\"sub/a.xml\"/></worldbody></mujoco>");
    let body =
        "<body name=\"a\"><joint name=\"j\" range=\"-9 9\"/><include file=\"b.xml\"/></body>";
    write("sub/a.xml", &format!("<mujocoinclude>{body}</mujocoinclude>"));
    for place in ["b.xml", "sub/b.xml"] {
        write(place, "<mujocoinclude><geom size=\"0.1\"/></mujocoinclude>");
        import(&dir.path().join("main.xml"), &ImportOptions::default()).unwrap();
        std::fs::remove_file(dir.path().join(place)).unwrap();
    }
}

#[test]
fn a_xacro_says_what_to_do_with_it() {
    for text in [
        "<robot xmlns:xacro=\"http://www.ros.org/wiki/xacro\" name=\"x\">\n<xacro:include filename=\"leg.xacro\"/></robot>",
        "<robot xmlns:xacro=\"http://playerstage.sourceforge.net/gazebo/xmlschema\" name=\"x\">\n<xacro:include filename=\"a\"/></robot>",
        "<robot name=\"x\">\n<link name=\"base\"><inertial><mass value=\"${m}\"/></inertial></link></robot>",
    ] {
        let said = refused("x.urdf.xacro", text);
        assert!(
            said.len() == 1 && said[0].starts_with("2 ") && said[0].contains("x.urdf.xacro > "),
            "{said:?}"
        );
    }
}

#[test]
fn a_negative_mass_is_called_so() {
    let wrong = quadruped().replacen("mass value=\"0.", "mass value=\"-0.", 1);
    let said = refused("wrong.urdf", &wrong);
    assert!(
        said.len() == 1
            && said[0].contains("<mass>: attribute `value`: is -0.")
            && said[0].contains("above zero"),
        "{said:?}"
    );
}

#[test]
fn slips_in_an_mjcf_are_refused_once_each_where_they_stand() {
    let text = r#"<mujoco>
  <default><joint damping="soft" armatur="0.01"/></default>
  <worldbody><body name="base">
    <freejoint/>
    <geom type="box" size="0.1 0.05 0.02" mass="-1"/>
    <body name="left"><joint name="l" axis="0 1 0" frictionlos="0.1"/><geom size="0.02" densty="5"/></body>
    <body name="right"><joint name="r" axs="0 1 0"/><geom size="0.02" density="-3"/></body>
  </body></worldbody>
</mujoco>"#;
    let said = refused("slips.xml", text).join("\n");
    for wanted in [
        "2 <joint>: attribute `armatur`: is not known; did you mean `armature`?",
        "2 <joint> of a default: attribute `damping`: `soft` is not a usable number",
        "5 <geom>: attribute `mass`: is -1; it must not be negative",
        "6 <joint name=\"l\">: attribute `frictionlos`: is not known; did you mean `frictionloss`?",
        "6 <geom>: attribute `densty`: is not known; did you mean `density`?",
        "7 <joint name=\"r\">: attribute `axs`: is not known; did you mean `axis`?",
        "7 <geom>: attribute `density`: is -3; it must not be negative",
    ] {
        assert_eq!(said.matches(wanted).count(), 1, "{wanted} in\n{said}");
    }
}

#[test]
fn slips_in_a_urdf_are_refused_where_they_stand() {
    let right = quadruped();
    assert!(read("right.urdf", &right).is_ok());
    // ways to write no limit
    for (from, to) in [
        ("lower=\"-1.57\" upper=\"1.57\"", "lower=\"0\" upper=\"-1\""),
        ("effort=\"1.5\" velocity=\"6\"", "effort=\"-1\" velocity=\"-1.0\""),
        ("lower=\"-1.57\" upper=\"1.57\"", "lower=\"0.5\""),
    ] {
        assert!(right.contains(from), "{right}");
        assert!(read("unlimited.urdf", &right.replacen(from, to, 1)).is_ok(), "{to}");
    }
    for (from, to, wanted) in [
        (
            "radius=",
            "radus=",
            "4 <sphere>: attribute `radus`: is not known; did you mean `radius`?",
        ),
        (
            "radius=\"",
            "radius=\"-",
            "4 <sphere>: attribute `radius`: is -0.012; it must not be negative",
        ),
        ("lower=", "lowr=", "3 <limit>: attribute `lowr`: is not known; did you mean `lower`?"),
        (
            "upper=\"",
            "upper=\"-2",
            "3 <limit>: attribute `lower`: is -1.57, above `upper`, -21.57;",
        ),
        (
            "effort=\"",
            "effort=\"-",
            "3 <limit>: attribute `effort`: is -1.5; it must not be negative",
        ),
        (
            "velocity=\"",
            "velocity=\"-",
            "3 <limit>: attribute `velocity`: is -6; it must not be negative",
        ),
        ("limit ", "limits ", "3 <limits>: is not known; did you mean <limit>?"),
    ] {
        let said = refused("wrong.urdf", &right.replacen(from, to, 1));
        assert!(said.iter().any(|s| s.starts_with(wanted)), "{wanted} in {said:?}");
    }
}

#[test]
fn what_is_negative_in_an_mjcf_is_refused_where_it_stands() {
    let text = r#"<mujoco><worldbody><body name="base">
    <freejoint/><geom type="box" size="0.1 0.05 0.02"/>
    <body><joint name="l" axis="0 1 0" damping="-0.1"/><geom size="-0.02" contype="0" conaffinity="0"/></body>
    <body><joint name="r" axis="0 1 0" frictionloss="-0.1" armature="-1"/><geom size="0.02" friction="-1"/></body>
  </body></worldbody><actuator>
    <position joint="l" kp="-3"/>
    <position joint="r" kv="-1"/>
  </actuator></mujoco>"#;
    let said = refused("negative.xml", text);
    for (line, key) in [
        (3, "damping"),
        (3, "size"),
        (4, "frictionloss"),
        (4, "armature"),
        (4, "friction"),
        (6, "kp"),
        (7, "kv"),
    ] {
        let found = said.iter().filter(|s| s.starts_with(&format!("{line} ")));
        let count = found.filter(|s| s.contains(&format!("attribute `{key}`"))).count();
        assert_eq!(count, 1, "{key} in {said:#?}");
    }
}

#[test]
fn what_is_expanded_is_not_written_onto_itself_and_other_namespaces_are_no_xacro() {
    let text =
        "<robot xmlns:xacro=\"http://www.ros.org/wiki/xacro\" name=\"x\"><xacro:leg/></robot>";
    let said = refused("x.urdf", text);
    assert!(said[0].contains("x.urdf > ") && said[0].contains("x.plain.urdf`"), "{said:?}");
    let own = quadruped().replace("<robot ", "<robot xmlns:drake=\"http://drake.mit.edu\" ");
    let own = own.replace("</robot>", "<drake:diagonal/></robot>");
    assert!(read("own.urdf", &own).is_ok());
}

#[test]
fn links_that_carry_each_other_are_refused() {
    let hinge = |name: &str, parent: &str, child: &str| {
        format!(
            "<joint name=\"{name}\" type=\"fixed\"><parent link=\"{parent}\"/><child link=\"{child}\"/></joint>"
        )
    };
    let ring = [hinge("there", "a", "b"), hinge("back", "b", "a")].concat();
    let text = quadruped()
        .replace("</robot>", &format!("<link name=\"a\"/><link name=\"b\"/>{ring}</robot>"));
    let said = refused("ring.urdf", &text);
    assert!(said.iter().any(|s| s.contains("a, b carry each other")), "{said:?}");
}
