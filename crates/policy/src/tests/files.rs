//! What is written reads back, and policies that do not fit are told apart.

use caudata_task::{ContractDifference, PolicyContract};

use super::{bytes, contract, file, metadata, network, small};
use crate::{Activation, METADATA_KEY, PolicyError, PolicyFile, build_onnx};

#[test]
fn network_and_metadata_survive_exactly() {
    for activation in Activation::ALL {
        for (hidden, clip) in [(&[8, 5][..], None), (&[3], Some(10.0))] {
            let spec = network(hidden, activation, clip);
            let file = file(&spec);
            assert_eq!(file.spec(), &spec);
            assert_eq!(file.metadata(), &metadata());
            assert_eq!(file.metadata().contract.hash(), contract().hash());
        }
    }
    let linear = network(&[], Activation::Elu, None);
    assert_eq!(file(&linear).spec(), &linear);
}

#[test]
fn equal_policies_are_equal_bytes() {
    let (a, b) = (file(&small()), file(&small()));
    assert_eq!(a.bytes(), b.bytes());
    assert_eq!(a.sha256_hex(), b.sha256_hex());
    let mut other = small();
    other.layers[0].bias[0] += 1e-6;
    assert_ne!(file(&other).sha256(), a.sha256());
}

#[test]
fn the_hash_is_that_of_the_bytes() {
    use sha2::{Digest, Sha256};
    let file = file(&small());
    let expected: [u8; 32] = Sha256::digest(file.bytes()).into();
    assert_eq!(file.sha256(), expected);
    assert!(file.sha256_hex().starts_with(&format!("{:02x}{:02x}", expected[0], expected[1])));
}

#[test]
fn keys_for_other_tools_hold_full_precision() {
    let properties = metadata().properties().unwrap();
    let get = |key| &properties.iter().find(|(k, _)| *k == key).unwrap().1;
    assert_eq!(get("run_path"), "2026-01-01_quick");
    assert!(get("joint_names").starts_with("joint_0,joint_1,"));
    assert!(get("joint_stiffness").starts_with("15,15,"));
    assert!(get("joint_damping").starts_with("0.15,0.15,"));
    // 1/7 and 2/7, the shortest decimals that read back as the same f32.
    assert!(get("default_joint_pos").starts_with("0,0.14285715,0.2857143,"));
    assert!(get("observation_names").starts_with("joint_vel,joint_pos_offset,gyro,gravity,phase"));
    assert_eq!(get("command_names"), "twist");
    assert_eq!(get("action_scale").split(',').count(), 16);
    assert!(get(METADATA_KEY).contains(r#""env_steps":18446744073709551615"#));
}

#[test]
fn networks_and_metadata_that_do_not_fit_are_not_written() {
    let refused = |change: fn(&mut crate::MlpSpec, &mut crate::PolicyMetadata)| {
        let (mut spec, mut meta) = (small(), metadata());
        change(&mut spec, &mut meta);
        build_onnx(&spec, &meta).unwrap_err()
    };
    let nan = refused(|s, _| s.layers[1].bias[3] = f32::INFINITY);
    assert_eq!(nan, PolicyError::NotFinite { name: "layers.1.bias".into(), index: 3 });
    let narrow = refused(|s, _| {
        s.layers[1].out = 15;
        s.layers[1].weight.truncate(30);
        s.layers[1].bias.truncate(15);
    });
    assert!(matches!(narrow, PolicyError::Length { found: 15, expected: 16, .. }), "{narrow}");
    let std = refused(|_, m| m.log_std.truncate(15));
    assert_eq!(std, PolicyError::Length { what: "log_std", found: 15, expected: 16 });
    let wild = refused(|_, m| m.log_std[2] = 6.0);
    assert!(matches!(wild, PolicyError::Range { field: "log_std", .. }), "{wild}");
    for error in [
        refused(|_, m| m.run_id.clear()),
        refused(|_, m| m.training_commit = "two words".into()),
        refused(|_, m| m.evaluation = Some(serde_json::json!([1]))),
        refused(|_, m| m.contract.joint_names[0] = "a,b".into()),
        refused(|_, m| m.contract.control_period_s = f64::NAN),
        refused(|_, m| m.contract.kp_nm_per_rad.truncate(3)),
    ] {
        assert!(matches!(error, PolicyError::Metadata { .. }), "{error}");
    }
}

#[test]
fn a_policy_for_something_else_is_told_apart() {
    let file = file(&small());
    let expecting = |change: fn(&mut PolicyContract)| {
        let mut expected = contract();
        change(&mut expected);
        expected
    };
    file.check_contract(&contract()).unwrap();
    let refused = |change| file.check_contract(&expecting(change)).unwrap_err();
    assert!(matches!(refused(|c| c.robot = "eft".into()), PolicyError::WrongRobot { .. }));
    assert_eq!(
        refused(|c| c.joint_names.swap(4, 5)),
        PolicyError::WrongJointOrder {
            index: 4,
            found: "joint_4".into(),
            expected: "joint_5".into(),
        }
    );
    let part = |part| PolicyError::WrongPart { part };
    assert_eq!(refused(|c| c.action.scale = 1.5), part("action"));
    assert_eq!(refused(|c| c.kd_nm_s_per_rad[3] = 0.2), part("gains"));
    assert_eq!(refused(|c| c.control_period_s = 0.01), part("control period"));
    let medium = caudata_task::ObservationLayout::new(16, &super::FEET.map(str::to_owned), true);
    let mut expected = contract();
    expected.observation = medium;
    assert_eq!(file.check_contract(&expected).unwrap_err(), part("observation layout"));
}

#[test]
fn other_parameters_of_the_same_robot_are_reported_and_run() {
    let file = file(&small());
    let mut expected = contract();
    expected.robot_hash = "cd".repeat(32);
    expected.command.vx_mps[1] = 0.8;
    assert!(matches!(
        file.check_contract(&expected).unwrap_err(),
        PolicyError::WrongRobotModel { .. }
    ));
    assert_eq!(
        file.check_runs_on(&expected).unwrap(),
        [ContractDifference::RobotModel, ContractDifference::CommandRange]
    );
    expected.phase.offsets_rad[1] = 1.0;
    assert!(matches!(
        file.check_runs_on(&expected).unwrap_err(),
        PolicyError::WrongPart { part: "gait phase" }
    ));
}

#[test]
fn a_file_above_the_limit_is_neither_written_nor_read() {
    // 97·1400 + 1400·1400 + 1400·16 weights of 4 bytes: 8.5 MB.
    let large = network(&[1400, 1400], Activation::Relu, None);
    let error = build_onnx(&large, &metadata()).unwrap_err();
    assert!(matches!(error, PolicyError::TooLarge { .. }), "{error}");
    let mut long = bytes(&small()).to_vec();
    long.resize(crate::MAX_FILE_BYTES + 1, 0);
    let error = PolicyFile::parse(long.into()).unwrap_err();
    assert!(matches!(error, PolicyError::TooLarge { .. }), "{error}");
}
