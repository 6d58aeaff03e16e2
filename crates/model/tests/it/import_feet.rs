//! Feet of several shapes, and what stands on them.

use caudata_model::RobotModel;

use crate::import::{model, read};

#[test]
fn boxes_of_one_sole_are_one_foot_and_a_shin_is_none() {
    let text = "<mujoco><worldbody><body name=\"base\"><freejoint/><geom size=\"0.05\" mass=\"1\"/>\
         <body name=\"shank\" pos=\"0 0 -0.1\"><joint name=\"knee\" axis=\"0 1 0\" range=\"-40 40\"/>\
         <geom name=\"shin\" type=\"capsule\" fromto=\"0 0 0 0 0 -0.1\" size=\"0.005\"/>\
         <geom name=\"long\" type=\"box\" size=\"0.06 0.028 0.004\" pos=\"0 0 -0.105\"/>\
         <geom name=\"wide\" type=\"box\" size=\"0.05 0.039 0.004\" pos=\"0 0 -0.105\"/>\
         </body></body></worldbody><actuator><motor joint=\"knee\" ctrlrange=\"-3 3\"/></actuator></mujoco>";
    let m = model(&read("sole.xml", text).unwrap());
    // the shin ends 4 mm above the sole, and its middle is 5.5 cm higher
    let names = |g: &usize| m.links()[1].geoms[*g].name.clone().unwrap_or_default();
    let sole: Vec<String> = m.feet()[0].geoms.iter().map(names).collect();
    assert_eq!(sole, ["long", "wide"]);
}

/// Two legs of six joints that end in `sole`: thighs and shanks of 0.3 m, ankles 5 cm above the ground.
fn two_legs(sole: &str) -> RobotModel {
    let joint = |name: &str, axis: &str, side: &str| {
        format!("<joint name=\"{name}_{side}\" axis=\"{axis}\" range=\"-150 150\"/>")
    };
    let inertia = "<inertial pos=\"0 0 0\" mass=\"1\" diaginertia=\"0.01 0.01 0.01\"/>";
    let leg = |side: &str, y: f64| {
        let [yaw, roll, hip] =
            [("yaw", "0 0 1"), ("roll", "1 0 0"), ("hip", "0 1 0")].map(|(n, a)| joint(n, a, side));
        let [knee, pitch, tilt] = [("knee", "0 1 0"), ("pitch", "0 1 0"), ("tilt", "1 0 0")]
            .map(|(n, a)| joint(n, a, side));
        format!(
            "<body pos=\"0 {y} 0\">{inertia}{yaw}<body pos=\"0 {} 0\">{inertia}{roll}<body>{inertia}{hip}\
             <body pos=\"0 0 -0.3\">{inertia}{knee}<body pos=\"0 0 -0.3\">{inertia}{pitch}<body>{inertia}{tilt}{sole}\
             </body></body></body></body></body></body>",
            y / 2.0
        )
    };
    let names = ["yaw", "roll", "hip", "knee", "pitch", "tilt"];
    let motors: String = ["l", "r"]
        .iter()
        .flat_map(|s| names.map(|n| format!("<motor joint=\"{n}_{s}\" ctrlrange=\"-60 60\"/>")))
        .collect();
    let text = format!(
        "<mujoco><worldbody><body><freejoint/><geom type=\"box\" size=\"0.1 0.1 0.2\" pos=\"0 0 0.2\" mass=\"12\"/>\
         {}{}</body></worldbody><actuator>{motors}</actuator></mujoco>",
        leg("l", 0.1),
        leg("r", -0.1)
    );
    model(&read("two.xml", &text).unwrap())
}

/// A ball at each corner; a thick heel and a thin forefoot; a heel and a ball of the toes: 35 mm ahead of the ankle
/// in the middle.
#[test]
fn two_legs_stand_on_the_middle_of_their_soles_knees_ahead() {
    let ball = |x: f64, y: f64| format!("<geom size=\"0.005\" pos=\"{x} {y} -0.05\"/>");
    let corners = [ball(-0.05, 0.03), ball(-0.05, -0.03), ball(0.12, 0.03), ball(0.12, -0.03)];
    let heel = "<geom type=\"box\" size=\"0.03 0.03 0.02\" pos=\"-0.025 0 -0.035\"/>";
    let fore = "<geom type=\"box\" size=\"0.06 0.03 0.005\" pos=\"0.065 0 -0.05\"/>";
    for (sole, shapes) in [
        (corners.concat(), 4),
        (format!("{heel}{fore}"), 2),
        (format!("{heel}{}", ball(0.12, 0.0)), 2),
    ] {
        let m = two_legs(&sole);
        assert!(m.feet().iter().all(|f| f.geoms.len() == shapes), "{sole}");
        let q = |name: &str| m.nominal_pos_rad()[m.joint_index(name).unwrap()];
        for side in ["l", "r"] {
            for still in ["yaw", "roll", "tilt"] {
                assert!(q(&format!("{still}_{side}")).abs() < 0.05, "{:?}", m.nominal_pos_rad());
            }
            // a leg that reaches 0.9 of its length: 2 acos(0.9) = 52°
            let knee = q(&format!("knee_{side}"));
            assert!((0.75..1.05).contains(&knee), "{sole}: {knee}");
            let level = q(&format!("hip_{side}")) + knee + q(&format!("pitch_{side}"));
            assert!(level.abs() < 0.05, "{sole}: {level}");
        }
    }
}
