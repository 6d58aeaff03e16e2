//! Worked examples of contracts.

use std::f32::consts::PI;

use super::*;
use crate::TaskConfig;

const ACT_DIM: usize = 16;
const FEET: [&str; 4] = ["FL", "FR", "HL", "HR"];

/// The contract of the default task on a made-up robot.
fn contract() -> PolicyContract {
    let task = TaskConfig::default();
    PolicyContract {
        robot: "newt".to_owned(),
        robot_hash: "ab".repeat(32),
        joint_names: (0..ACT_DIM).map(|i| format!("joint_{i}")).collect(),
        nominal_pos_rad: vec![0.1; ACT_DIM],
        lower_limit_rad: vec![-1.274_090_3; ACT_DIM],
        upper_limit_rad: vec![1.274_090_3; ACT_DIM],
        kp_nm_per_rad: vec![15.0; ACT_DIM],
        kd_nm_s_per_rad: vec![0.15; ACT_DIM],
        control_period_s: task.control_period_s,
        action: task.action,
        observation: ObservationLayout::new(ACT_DIM, &FEET.map(str::to_owned), false),
        imu: Some(ImuContract {
            link: "girdle".to_owned(),
            pos_m: [0.0, 0.0, 0.02],
            quat_wxyz: [1.0, 0.0, 0.0, 0.0],
        }),
        phase: PhaseContract {
            feet: FEET.map(str::to_owned).to_vec(),
            offsets_rad: vec![0.0, PI, PI, 0.0],
            frequency_hz: task.phase.frequency_hz,
            swing_height_m: task.phase.swing_height_m,
            stand_command_norm: task.phase.stand_command_norm,
        },
        command: CommandContract {
            vx_mps: task.command.vx_mps,
            vy_mps: task.command.vy_mps,
            yaw_rate_radps: task.command.yaw_rate_radps,
        },
        afloat_above_m: None,
    }
}

#[test]
fn survives_json_with_the_same_hash() {
    let made = contract();
    made.validate().unwrap();
    for text in [
        serde_json::to_string(&made).unwrap(),
        serde_json::to_string_pretty(&made).unwrap(),
        made.canonical_json(),
    ] {
        let read: PolicyContract = serde_json::from_str(&text).unwrap();
        assert_eq!(read, made);
        assert_eq!(read.hash(), made.hash());
    }
}

#[test]
fn a_value_of_ones_own_may_be_called_phase() {
    let mut own = contract();
    let mut terms = own.observation.terms();
    let phase = terms.iter_mut().find(|term| term.name == "phase").unwrap();
    phase.value = Some("clock");
    let feet = FEET.map(str::to_owned);
    own.observation = ObservationLayout::of(&terms, &own.joint_names, &feet).unwrap();
    own.validate().unwrap();
}

#[test]
fn canonical_json_is_sorted_compact_and_short() {
    let text = contract().canonical_json();
    assert!(
        text.starts_with(r#"{"action":{"clip":5.0,"filter_alpha":0.5,"scale":0.5},"command":{"vx_mps":[-0.2,0.5],"#),
        "{text}"
    );
    assert!(text.contains(r#""kd_nm_s_per_rad":[0.15,0.15,"#));
    assert!(text.contains(r#""upper_limit_rad":[1.2740903,"#));
    assert!(!text.contains("\": ") && !text.contains("\", "));
}

#[test]
fn the_hash_is_that_of_the_canonical_text() {
    let made = contract();
    let expected: [u8; 32] = Sha256::digest(made.canonical_json().as_bytes()).into();
    assert_eq!(made.hash(), expected);
    assert_eq!(made.hash_hex().len(), 64);
    assert_eq!(&made.hash_hex()[..2], format!("{:02x}", expected[0]));
}

#[test]
fn every_change_is_named_and_changes_the_hash() {
    use ContractDifference as D;
    type Change = fn(&mut PolicyContract);
    let changes: [(D, Change); 15] = [
        (D::Robot, |c| c.robot = "axolotl".to_owned()),
        (D::RobotModel, |c| c.robot_hash = "cd".repeat(32)),
        (D::JointOrder, |c| c.joint_names.swap(0, 1)),
        (D::NominalPose, |c| c.nominal_pos_rad[3] += 1e-6),
        (D::JointLimits, |c| c.lower_limit_rad[3] = -1.0),
        (D::JointLimits, |c| c.upper_limit_rad[3] = 1.0),
        (D::Gains, |c| c.kp_nm_per_rad[0] = 14.0),
        (D::ControlPeriod, |c| c.control_period_s = 0.01),
        (D::Action, |c| c.action.filter_alpha = 0.15),
        (D::Observation, |c| c.observation = c.observation.clone().with_past(&[2, 4]).unwrap()),
        (D::Observation, |c| {
            c.observation = ObservationLayout::new(ACT_DIM, &FEET.map(str::to_owned), true)
        }),
        (D::Imu, |c| c.imu.as_mut().unwrap().link = "head".to_owned()),
        (D::Imu, |c| c.imu.as_mut().unwrap().quat_wxyz = [0.0, 0.0, 0.0, 1.0]),
        (D::Phase, |c| c.phase.swing_height_m = 0.06),
        (D::CommandRange, |c| c.command.vx_mps = [0.0, 0.3]),
    ];
    let base = contract();
    assert_eq!(base.differences(&base), []);
    for (expected, change) in changes {
        let mut changed = base.clone();
        change(&mut changed);
        assert_eq!(base.differences(&changed), [expected]);
        assert_ne!(base.hash(), changed.hash(), "{expected:?}");
        let harmless = matches!(expected, D::RobotModel | D::CommandRange);
        assert_eq!(expected.is_breaking(), !harmless);
        assert!(!expected.name().is_empty());
    }
}

#[test]
fn a_contract_from_before_the_imu_was_stated_runs_on_any() {
    let mut old = contract();
    old.imu = None;
    assert!(!old.canonical_json().contains("imu"));
    assert_eq!(old.differences(&contract()), []);
    assert_eq!(contract().differences(&old), []);
}

#[test]
fn several_differences_are_all_named_most_telling_first() {
    use ContractDifference as D;
    let mut other = contract();
    other.robot_hash = "00".repeat(32);
    other.joint_names.swap(4, 5);
    other.action.scale = 1.0;
    assert_eq!(contract().differences(&other), [D::JointOrder, D::Action, D::RobotModel]);
}

#[test]
fn damaged_contracts_are_refused() {
    type Change = fn(&mut PolicyContract);
    let changes: [(&str, Change); 9] = [
        ("joint_names", |c| c.joint_names.truncate(15)),
        ("nominal_pos_rad", |c| c.nominal_pos_rad.push(0.0)),
        ("kp_nm_per_rad", |c| c.kp_nm_per_rad[2] = f32::NAN),
        ("lower_limit_rad", |c| c.lower_limit_rad[2] = 2.0),
        ("phase.feet", |c| c.phase.feet.clear()),
        ("phase.offsets_rad", |c| c.phase.offsets_rad.clear()),
        ("control_period_s", |c| c.control_period_s = 0.0),
        ("action.scale", |c| c.action.scale = -1.0),
        ("phase.frequency_hz", |c| c.phase.frequency_hz = [2.0, 1.0]),
    ];
    for (field, change) in changes {
        let mut changed = contract();
        change(&mut changed);
        let message = changed.validate().unwrap_err().to_string();
        assert!(message.contains(field), "{message}");
    }
    let unknown = serde_json::to_string(&contract()).unwrap().replacen(
        "\"robot\"",
        "\"colour\":1,\"robot\"",
        1,
    );
    assert!(serde_json::from_str::<PolicyContract>(&unknown).is_err());
}

#[test]
fn the_joint_table_is_the_contracts() {
    let table = contract().joint_table().unwrap();
    assert_eq!(table.nominal_rad, [0.1; ACT_DIM]);
    assert_eq!(table.upper_rad, [1.274_090_3; ACT_DIM]);
    let mut short = contract();
    short.upper_limit_rad.pop();
    assert!(short.joint_table().is_none());
}

proptest::proptest! {
    #[test]
    fn any_numbers_survive_json_with_the_same_hash(
        values in proptest::array::uniform16(proptest::num::f32::NORMAL | proptest::num::f32::ZERO),
        period in 1e-4f64..1.0,
    ) {
        let mut made = contract();
        made.nominal_pos_rad = values.to_vec();
        made.control_period_s = period;
        let read: PolicyContract =
            serde_json::from_str(&serde_json::to_string(&made).unwrap()).unwrap();
        proptest::prop_assert_eq!(&read, &made);
        proptest::prop_assert_eq!(read.hash(), made.hash());
        let again: PolicyContract = serde_json::from_str(&made.canonical_json()).unwrap();
        proptest::prop_assert_eq!(again, made);
    }
}

#[test]
fn the_height_from_which_on_it_swims_is_written_where_it_is_observed() {
    let old = PolicyContract {
        observation: ObservationLayout::new(ACT_DIM, &FEET.map(str::to_owned), true),
        ..contract()
    };
    let at = |height_m| PolicyContract { afloat_above_m: Some(height_m), ..old.clone() };
    old.validate().unwrap();
    at(0.08).validate().unwrap();
    assert!(at(f32::NAN).validate().is_err());
    let on_land = PolicyContract { afloat_above_m: Some(0.08), ..contract() };
    assert!(on_land.validate().unwrap_err().to_string().contains("afloat_above_m"));
    // it runs all the same, and whoever asks is told; an old file does not say
    assert_eq!(at(0.08).differences(&at(0.09)), [ContractDifference::Afloat]);
    assert!(!ContractDifference::Afloat.is_breaking());
    assert!(at(0.08).differences(&old).is_empty());
    assert!(at(0.08).canonical_json().contains(r#""afloat_above_m":0.08"#));
    assert!(!old.canonical_json().contains("afloat"));
}
