//! Files with slips in them, and what is said of them.

use caudata_model::import::ImportError;

use crate::common::near;
use crate::import::{model, read};
use crate::import_told::{refused, told};

/// A trunk on two legs with soles that nothing touches but by what `contact` says.
fn paired(contact: &str) -> String {
    let leg = |name: &str, y: f64| {
        format!(
            "<body name=\"{name}\" pos=\"0 {y} 0\"><joint name=\"{name}\" axis=\"0 1 0\" range=\"-60 60\"/>\
             <geom name=\"{name}_sole\" size=\"0.02\" pos=\"0 0 -0.2\" contype=\"0\" conaffinity=\"0\"/></body>"
        )
    };
    format!(
        "<mujoco><default><pair friction=\"0.4 0.4\" solref=\"0.05 1\"/></default><worldbody>\
         <geom name=\"floor\" type=\"plane\" size=\"0 0 1\"/><body name=\"base\"><freejoint/>\
         <geom name=\"trunk\" size=\"0.05\"/><geom name=\"shell\" size=\"0.05\" contype=\"2\"/>\
         <geom name=\"shin\" size=\"0.05\" contype=\"4\" conaffinity=\"0\"/>{}{}</body>\
         <body name=\"yard\"><geom name=\"slab\" size=\"1\"/></body></worldbody>\n\
         <contact>{contact}</contact>\
         <actuator><position joint=\"l\" kp=\"9\"/><position joint=\"r\" kp=\"9\"/></actuator></mujoco>",
        leg("l", 0.1),
        leg("r", -0.1)
    )
}

#[test]
fn a_pair_is_kept_with_what_its_class_says() {
    let made = read(
        "pairs.xml",
        &paired(
            "<pair geom1=\"floor\" geom2=\"l_sole\"/>\
             <pair geom1=\"trunk\" geom2=\"floor\" friction=\"0.7\" solimp=\"0.8 0.9 0.01\" condim=\"6\" gap=\"0.1\"/>\
             <pair geom1=\"slab\" geom2=\"shin\"/><exclude body1=\"base\" body2=\"lft\"/>",
        ),
    )
    .unwrap();
    assert!(told(&made, "<pair>: not kept: condim, gap"), "{:?}", made.notes);
    assert!(told(&made, "there is no body `lft` in the robot"), "{:?}", made.notes);
    let m = model(&made);
    let geoms: Vec<_> = m.links().iter().flat_map(|link| &link.geoms).collect();
    let geom = |name: &str| *geoms.iter().find(|g| g.name.as_deref() == Some(name)).unwrap();
    let (sole, trunk, floor) = (geom("l_sole"), geom("trunk"), &m.world_geoms()[0]);
    assert_eq!((sole.friction, sole.soft.solref), (0.4, [0.05, 1.0]));
    assert_eq!(trunk.soft.solimp[..3], [0.8, 0.9, 0.01]);
    assert!(made.mjcf.contains("name=\"trunk\" type=\"sphere\" size=\"0.05\" friction=\"0.7\""));
    // the ground touches it, and neither trunk nor shell, of bits 1 and 2
    assert!(floor.collides_with(sole) && !geom("r_sole").collides());
    assert!(!sole.collides_with(trunk) && !sole.collides_with(geom("shell")));
    // bits of its own stay, and what stands still on the ground is the ground
    assert!(floor.collides_with(geom("shin")) && geom("shin").contype == 4);
    assert!(!geom("shin").collides_with(trunk));
}

#[test]
fn a_shape_of_a_pair_that_is_misspelt_is_refused() {
    let said = refused("pairs.xml", &paired("<pair geom1=\"floor\" geom2=\"r_sol\"/>"));
    assert_eq!(
        said,
        ["2 <pair>: attribute `geom2`: there is no geom `r_sol`; did you mean `r_sole`?"]
    );
}

#[test]
fn attributes_of_two_letters_are_read_as_strictly_and_unknown_ones_are_told() {
    let text = |more: &str| {
        format!(
            "<mujoco><worldbody><body name=\"base\"><freejoint/><geom size=\"0.05\" material=\"m\"/>\n\
             <body name=\"a\"><joint name=\"a\" axis=\"0 1 0\" range=\"-9 9\"/><geom size=\"0.05\"/></body></body></worldbody>\n\
             <actuator><position joint=\"a\" {more}/></actuator></mujoco>"
        )
    };
    let said = refused("slip.xml", &text("kpp=\"9\""));
    assert_eq!(said, ["3 <position>: attribute `kpp`: is not known; did you mean `kp`?"]);
    let made = read("slip.xml", &text("kp=\"9\" kd=\"1\" delay=\"0.1\"")).unwrap();
    assert!(told(&made, "<position>: attribute `delay` is not read"), "{:?}", made.notes);
    assert!(told(&made, "<position>: attribute `kd` is not read"), "{:?}", made.notes);
    assert!(!told(&made, "material"), "{:?}", made.notes);
}

#[test]
fn faults_of_xml_are_told_at_their_line() {
    for (text, line, word) in [
        ("<mujoco>\n<worldbody>\n<body>\n</worldbody>\n</mujoco>\n", 4, "expected 'body' tag"),
        ("<mujoco>\n<worldbody>\n</worldbody>\n\n", 3, "never closed"),
        ("<mujoco>\n<worldbody>\n<body name=\"a\"\n", 3, "unexpected end"),
        ("<!-- a -->\n<!DOCTYPE a>\n<mujoco/>", 2, "take it out"),
    ] {
        let Err(ImportError::File(error)) = read("cut.xml", text) else { panic!("{text}") };
        let error = error.to_string();
        assert!(error.contains(&format!("cut.xml:{line}: ")) && error.contains(word), "{error}");
    }
}

#[test]
fn a_second_thing_of_a_name_is_told_where_it_stands() {
    let leg = |joint: &str| {
        format!(
            "<body name=\"leg\"><joint name=\"{joint}\" axis=\"0 1 0\" range=\"-9 9\"/><geom size=\"0.05\"/></body>\n"
        )
    };
    let text = format!(
        "<mujoco><worldbody><body name=\"base\"><freejoint/><geom size=\"0.05\"/>\n{}{}</body></worldbody></mujoco>",
        leg("a"),
        leg("b")
    );
    assert_eq!(refused("two.xml", &text), ["3 <body name=\"leg\">: there is another of this name"]);
}

/// A link with `moments` (ixx, iyy, izz) on a held base.
fn weighed(moments: &str) -> String {
    format!(
        "<robot name=\"arm\"><link name=\"base\"/>\n\
         <link name=\"upper\"><inertial><origin xyz=\"0 0 0.1\" rpy=\"0.3 0 0\"/><mass value=\"1\"/>\
         <inertia {moments}/></inertial></link>\n\
         <joint name=\"turn\" type=\"revolute\"><parent link=\"base\"/><child link=\"upper\"/><axis xyz=\"0 1 0\"/>\
         <limit lower=\"0\" upper=\"2\" effort=\"7\" velocity=\"3\"/></joint></robot>"
    )
}

/// 0.001 + 0.002 < 0.004 kg·m²: the second moments are 0.0025, 0.0015 and −0.0005, and without the last one the
/// moments 0.0015, 0.0025 and 0.004.
#[test]
fn an_inertia_that_no_body_has_is_told_with_the_nearest() {
    let wrong = weighed("ixx=\"0.001\" iyy=\"0.002\" izz=\"0.004\" ixy=\"0\" ixz=\"0\" iyz=\"0\"");
    let said = refused("arm.urdf", &wrong);
    assert!(said.len() == 1 && said[0].starts_with("2 <link name=\"upper\">: no body"), "{said:?}");
    let (_, near_to) = said[0].split_once("the nearest that one has is ").unwrap();
    assert!(near_to.starts_with("ixx=\"1.5") && near_to.contains("izz=\"4.0"), "{near_to}");
    let m = model(&read("arm.urdf", &weighed(near_to)).unwrap());
    let trace: f64 = (0..3).map(|i| m.links()[0].inertia_kgm2[i][i]).sum();
    near("trace", trace, 0.0015 + 0.0025 + 0.004, 1e-7);
}

/// Above the trunk stand two links that are nothing but places, one of them on the ground.
#[test]
fn a_place_above_the_trunk_is_not_the_trunk() {
    let link = |name: &str| {
        format!(
            "<link name=\"{name}\"><inertial><mass value=\"1\"/><inertia ixx=\"0.01\" iyy=\"0.01\" izz=\"0.01\"/>\
             </inertial><collision><geometry><sphere radius=\"0.05\"/></geometry></collision></link>"
        )
    };
    let leg = |name: &str, y: f64| {
        format!(
            "{}<joint name=\"{name}\" type=\"revolute\"><origin xyz=\"0 {y} 0\"/><parent link=\"base_link\"/>\
             <child link=\"{name}\"/><axis xyz=\"0 1 0\"/><limit lower=\"0\" upper=\"2\" effort=\"7\" velocity=\"3\"/></joint>",
            link(name)
        )
    };
    let text = format!(
        "<robot name=\"cart\"><link name=\"place\"/><joint name=\"on\" type=\"fixed\"><parent link=\"place\"/>\
         <child link=\"base_footprint\"/></joint><link name=\"base_footprint\"/>{}<joint name=\"up\" type=\"fixed\">\
         <origin xyz=\"0 0 0.3\"/><parent link=\"base_footprint\"/><child link=\"base_link\"/></joint>{}{}</robot>",
        link("base_link"),
        leg("l", 0.2),
        leg("r", -0.2)
    );
    let m = model(&read("cart.urdf", &text).unwrap());
    assert_eq!(m.links()[0].name, "base_link");
    assert_eq!(m.links()[0].com_m, [0.0; 3]);
    // 8 % of the range of 0 to 2 rad
    assert_eq!(m.nominal_pos_rad(), [0.16, 0.16]);
}

/// A lift of 60 N and a hinge of 9 N·m beside a gripper and a second hinge of which nothing is said: forces are not
/// made of torques. The whole force is reached at 0.7 of what counts as a radian on a slide, 0.1 m: 60/0.07 = 857.
#[test]
fn a_slide_is_as_strong_as_slides() {
    let part = |name: &str, kind: &str| {
        format!(
            "<body name=\"{name}\"><joint name=\"{name}\" type=\"{kind}\" axis=\"0 1 0\"/><geom size=\"0.05\"/></body>"
        )
    };
    let text = format!(
        "<mujoco><worldbody><body name=\"base\"><freejoint/><geom size=\"0.05\"/>{}{}{}{}</body></worldbody><actuator>\
         <motor joint=\"lift\" forcerange=\"-60 60\"/><motor joint=\"grip\"/><motor joint=\"turn\" forcerange=\"-9 9\"/>\
         <motor joint=\"bend\"/></actuator></mujoco>",
        part("lift", "slide"),
        part("grip", "slide"),
        part("turn", "hinge"),
        part("bend", "hinge")
    );
    let made = read("lift.xml", &text).unwrap();
    assert!(told(&made, "no greatest force of grip: 60 N written"), "{:?}", made.notes);
    assert!(told(&made, "no greatest torque of bend: 9 N·m written"), "{:?}", made.notes);
    let m = model(&made);
    assert_eq!((m.servo(1).tau_max_nm, m.kp_nm_per_rad(1)), (60.0, 860.0));
    assert_eq!((m.servo(3).tau_max_nm, m.kp_nm_per_rad(3)), (9.0, 13.0));
    assert_eq!((m.servo(1).qd_max_radps, m.servo(3).qd_max_radps), (3.0, 30.0));
}
