//! Worked examples of expressions.

use super::*;

struct State {
    joints: Vec<f32>,
    feet: Vec<f32>,
}

impl Source for State {
    fn values(&self, signal: Signal) -> &[f32] {
        match signal {
            Signal::Velocity => &[0.3, 0.1, 0.0],
            Signal::CommandVx => &[0.5],
            Signal::Torque | Signal::JointVel => &self.joints,
            Signal::FootHeight | Signal::Contact => &self.feet,
            other => panic!("{other:?}"),
        }
    }
}

fn names() -> ([String; 2], [String; 3]) {
    (["hip", "knee"].map(str::to_owned), ["L", "M", "R"].map(str::to_owned))
}

fn value(text: &str) -> Vec<f32> {
    let (joints, feet) = names();
    let names = Names { joints: &joints, feet: &feet };
    let program = compile(text, names).unwrap_or_else(|e| panic!("{text} {e}"));
    let state = State { joints: vec![2.0, -3.0], feet: vec![0.0, 0.02, 0.05] };
    let mut stack = Vec::new();
    let values = program.run(&state, &mut stack).to_vec();
    assert_eq!(values.len(), program.len(), "{text}");
    values
}

#[test]
fn arithmetic_by_hand() {
    for (text, expected) in [
        ("1 + 2 * 3", vec![7.0]),
        ("-2 ^ 2", vec![-4.0]),
        ("(1 - 3) / 4", vec![-0.5]),
        ("2 - -3", vec![5.0]),
        ("8 - 2 - 1", vec![5.0]),
        ("1e1 + .5", vec![10.5]),
        // 0.5 − 0.3 = 0.2
        ("command_vx - velocity.x", vec![0.2]),
        // 2·2 + 3·3
        ("sum(torque ^ 2)", vec![13.0]),
        ("sum(abs(torque * joint_vel))", vec![13.0]),
        ("torque.knee", vec![-3.0]),
        ("2 * torque", vec![4.0, -6.0]),
        ("1 - torque", vec![-1.0, 4.0]),
        ("most(torque) - least(torque)", vec![5.0]),
        ("mean(contact)", vec![0.023_333_333]),
        ("norm(velocity) ^ 2", vec![0.1]),
        ("min(torque, 0)", vec![0.0, -3.0]),
        ("clamp(torque, -1, 1)", vec![1.0, -1.0]),
        ("foot_height > 0.03", vec![0.0, 0.0, 1.0]),
        ("foot_height.M <= 0.02", vec![1.0]),
        // the side that is not taken is 1/0
        ("where(foot_height > 0, 1 / foot_height, -1)", vec![-1.0, 50.0, 20.0]),
        ("exp(-(command_vx - velocity.x)^2 / 0.04)", vec![(-1.0f32).exp()]),
        ("(2 * velocity).y", vec![0.2]),
        ("sqrt(0 - 4)", vec![0.0]),
    ] {
        let found = value(text);
        assert_eq!(found.len(), expected.len(), "{text}");
        for (found, expected) in found.iter().zip(expected) {
            assert!((found - expected).abs() < 1e-5, "{text} is {found}, not {expected}");
        }
    }
}

#[test]
fn what_is_wrong_is_said() {
    for (text, reason) in [
        ("speed", "`speed`, which is no signal"),
        ("cosh(1)", "`cosh`, which is no function"),
        ("min(1)", "with 1 arguments, it takes 2"),
        ("velocity.x + joint_vel.hip", "`+` between m·s^-1 and s^-1"),
        ("height < torque.hip", "`<` between m and N·m"),
        ("exp(sum(power))", "`exp` of a quantity in W"),
        ("action + contact", "per joint and what is per foot"),
        ("velocity.w", ".x, .y and .z"),
        ("height.x", "`height` is one number"),
        ("1 +", "ends where"),
        ("(1", "not closed"),
        ("1 2", "from `2` on"),
        ("2 ^ 0.5", "a power that is not a whole number"),
        ("a $ b", "from `$ b` on"),
        ("1 $ 2", "from `$ 2` on"),
    ] {
        let error = check(text).unwrap_err();
        assert!(error.contains(reason), "{text}: {error}");
    }
    let (joints, feet) = names();
    let names = Names { joints: &joints, feet: &feet };
    let error = compile("torque.elbow", names).unwrap_err();
    assert!(error.contains("no such joint; it has: hip, knee"), "{error}");
    // without a robot nobody knows
    check("torque.elbow").unwrap();
    let deep = format!("{}1{}", "(".repeat(60), ")".repeat(60));
    assert!(check(&deep).unwrap_err().contains("deeper"));
}

#[test]
fn units_follow_and_plain_numbers_take_what_is_needed() {
    for (text, unit) in [
        ("velocity.x ^ 2", "m^2·s^-2"),
        ("sqrt(height)", "m^(1/2)"),
        ("torque * joint_vel", "W"),
        ("sum(torque) / height", "N"),
        ("height + 0.1", "m"),
        ("exp(height / 0.1)", "1"),
        ("height > 0.1", "1"),
    ] {
        let (_, found) = check(text).unwrap();
        assert_eq!(found.unwrap().to_string(), unit, "{text}");
    }
    assert_eq!(check("2 * 3").unwrap(), (Shape::Scalar, None));
}

#[test]
fn what_only_the_simulation_knows_is_noticed() {
    let (joints, feet) = names();
    let names = Names { joints: &joints, feet: &feet };
    let sensed = compile("gyro.x * gravity.y + joint_vel.hip", names);
    // gyro and joint velocities are both 1/s
    assert_eq!(sensed.unwrap().simulated(), None);
    let program = compile("joint_vel * height", names).unwrap();
    assert_eq!(program.simulated(), Some(Signal::Height));
    assert_eq!((program.len(), program.shape()), (2, Shape::Joints));
}

proptest::proptest! {
    #[test]
    fn any_text_is_read_or_refused(text in "[a-z0-9+*/().,<>^_ -]{0,40}") {
        let _ = check(&text);
    }
}
