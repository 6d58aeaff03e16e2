//! Bad policies, each refused by name.

use caudata_policy::PolicyMetadata;

use super::*;
use crate::testing::{model, policy_file};

fn reference(version: u64, bytes: &[u8]) -> PolicyRef {
    PolicyRef {
        stream: "s".to_owned(),
        version,
        sha256: Sha256Digest(Sha256::digest(bytes).into()),
        reverts_to: None,
    }
}

#[track_caller]
fn refusal(bytes: Vec<u8>, policy: &PolicyRef) -> Refusal {
    match verify(bytes.into(), policy, &model()) {
        Err(VerifyError::Refused(refusal)) => refusal,
        Err(error) => panic!("not a refusal: {error}"),
        Ok(_) => panic!("accepted"),
    }
}

/// The refusal of a whole file whose metadata was changed.
#[track_caller]
fn refused(change: impl FnOnce(&mut PolicyMetadata)) -> String {
    let bytes = policy_file(1, |_, metadata| change(metadata));
    let policy = reference(1, &bytes);
    refusal(bytes, &policy).to_string()
}

#[test]
fn a_good_policy_is_accepted_with_its_own_stride_and_action_scale() {
    let bytes = policy_file(7, |_, metadata| {
        metadata.contract.action.scale = 1.0;
        metadata.contract.action.filter_alpha = 0.15;
        metadata.contract.phase.swing_height_m = 0.07;
        metadata.contract.command.vx_mps = [0.0, 0.3];
    });
    let policy = reference(7, &bytes);
    let mut verified = verify(bytes.into(), &policy, &model()).unwrap();
    let mut action = [0.0; ACT_DIM];
    verified.inference.run(&[1.0; 97], 1, &mut action).unwrap();
    // 97 · 0.07 + 0.1
    assert!((action[5] - 6.89).abs() < 1e-4, "{action:?}");
}

const HERE: Sha256Digest = Sha256Digest([7; 32]);

#[test]
fn what_depends_on_the_robot_file_is_not_the_policys_fault() {
    for change in [
        (|m| m.contract.joint_names.swap(2, 3)) as fn(&mut PolicyMetadata),
        |m| m.contract.robot_hash = "0".repeat(64),
        |m| m.contract.kp_nm_per_rad[0] *= 2.0,
    ] {
        let bytes = policy_file(1, |_, m| change(m));
        let policy = reference(1, &bytes);
        assert_eq!(refusal(bytes, &policy).blame(HERE), Blame::Robot(HERE));
    }
}

#[test]
fn bytes_with_another_hash_are_refused_but_may_come_again() {
    let bytes = policy_file(1, |_, _| {});
    let other = reference(1, b"other");
    let refusal = refusal(bytes, &other);
    assert!(matches!(refusal, Refusal::WrongHash { .. }), "{refusal}");
    assert_eq!(refusal.blame(HERE), Blame::Transfer);
}

/// The same file in other bytes: a field of protobuf that comes twice counts by its last value. `ir_version` (field 1) once more at the
/// end, with the value that it has.
fn same_meaning(bytes: &[u8]) -> Vec<u8> {
    assert_eq!(bytes[0], 0x08, "ir_version comes first");
    assert!(bytes[1] < 0x80, "in one byte");
    [bytes, &bytes[..2]].concat()
}

#[test]
fn fault_24_the_same_meaning_in_other_bytes_was_not_signed() {
    let bytes = policy_file(1, |_, _| {});
    let other = same_meaning(&bytes);
    // To ONNX Runtime it is the very same policy; the strict reader does not take it, whoever signed it.
    let read = |bytes: &[u8]| PolicyFile::parse(bytes.into());
    let error = read(&other).unwrap_err().to_string();
    assert!(error.contains("ir_version"), "{error}");
    // Under the signed announcement its bytes are others.
    let policy = reference(1, &bytes);
    let refusal = refusal(other.clone(), &policy);
    assert!(matches!(refusal, Refusal::WrongHash { .. }), "{refusal}");
    // Announced as what it is, nobody signed it: the signature is over the hash.
    let key = caudata_signing::ReleaseKey::from_seed("release", &[7; 32]);
    let trust = Trust::parse(&key.trust_file()).unwrap();
    let stream = caudata_proto::registry::StreamName::new("s").unwrap();
    let file = read(&bytes).unwrap();
    let mut manifest = caudata_registry_client::manifest_of(stream, &file, 5).unwrap();
    key.sign(&mut manifest);
    assert!(check_signatures(&manifest, Some(&trust)).is_ok());
    manifest.sha256 = Sha256::digest(&other).into();
    let refusal = check_signatures(&manifest, Some(&trust)).unwrap_err();
    assert!(matches!(refusal, Refusal::Untrusted(_)), "{refusal}");
    // As large as it is, too.
    manifest.sha256 = file.sha256();
    assert!(check_signatures(&manifest, Some(&trust)).is_ok());
    manifest.size = other.len() as u64;
    assert!(check_signatures(&manifest, Some(&trust)).is_err());
}

#[test]
fn fault_18_nothing_that_decides_looks_at_the_date() {
    // The only place that may: where a sender of commands begins to count.
    let allowed = ["command_link.rs"];
    let root = std::path::Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/src"));
    let mut folders = vec![root.to_owned()];
    let mut looked = 0;
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                folders.push(path);
                continue;
            }
            let name = path.file_name().unwrap().to_str().unwrap();
            let text = std::fs::read_to_string(&path).unwrap();
            // Split, so that this file does not find itself.
            let clocks = [concat!("System", "Time"), concat!("UNIX_", "EPOCH")];
            let looks = clocks.iter().any(|clock| text.contains(clock));
            assert!(
                !looks || allowed.contains(&name),
                "{} looks at the date",
                path.display()
            );
            looked += 1;
        }
    }
    assert!(looked > 30, "{looked}");
}

#[test]
fn a_truncated_file_is_refused() {
    let mut bytes = policy_file(1, |_, _| {});
    bytes.truncate(bytes.len() / 2);
    // Even where the announcement is of the truncated bytes.
    let policy = reference(1, &bytes);
    let refusal = refusal(bytes, &policy);
    assert!(matches!(refusal, Refusal::Policy(_)), "{refusal}");
    assert_eq!(refusal.blame(HERE), Blame::Policy);
}

#[test]
fn weights_that_are_not_numbers_are_refused() {
    let mark = 0.123_456_f32.to_le_bytes();
    let mut bytes = policy_file(1, |spec, _| spec.layers[0].weight[40] = 0.123_456);
    let at = bytes.windows(4).position(|w| w == mark).unwrap();
    bytes[at..at + 4].copy_from_slice(&f32::NAN.to_le_bytes());
    let policy = reference(1, &bytes);
    let line = refusal(bytes, &policy).to_string();
    assert!(line.contains("NaN") && line.contains("index 40"), "{line}");
}

#[test]
fn weights_whose_products_overflow_are_found_by_the_probe() {
    let bytes = policy_file(1, |spec, _| spec.layers[0].weight.fill(3e38));
    let policy = reference(1, &bytes);
    let refusal = refusal(bytes, &policy);
    assert!(matches!(refusal, Refusal::Probe { .. }), "{refusal}");
}

#[test]
fn a_policy_for_something_else_is_refused_in_one_clear_line() {
    let line = refused(|m| m.contract.joint_names.swap(2, 3));
    assert_eq!(
        line,
        "joint 2 is `spine_4` in the policy and `spine_3` here"
    );
    let line = refused(|m| m.contract.robot_hash = "0".repeat(64));
    assert!(
        line.starts_with("policy was trained on model 000"),
        "{line}"
    );
    let line = refused(|m| m.contract.robot = "newt".to_owned());
    assert!(
        line.contains("`newt`") && line.contains("`polymander`"),
        "{line}"
    );
    let line = refused(|m| m.contract.control_period_s = 0.01);
    assert_eq!(
        line,
        "the policy differs from what is expected here in its control period"
    );
    let line = refused(|m| m.contract.nominal_pos_rad[9] += 0.1);
    assert_eq!(
        line,
        "the policy differs from what is expected here in its nominal pose"
    );
    let line = refused(|m| m.contract.kp_nm_per_rad[0] = 20.0);
    assert_eq!(
        line,
        "the policy differs from what is expected here in its gains"
    );
    let line = refused(|m| m.contract.phase.offsets_rad = vec![0.0; 4]);
    assert_eq!(
        line,
        "the policy differs from what is expected here in its gait phase"
    );
}

#[test]
fn a_policy_that_knows_land_from_water_passes_with_its_own_layout_only() {
    let task = TaskConfig {
        observe_medium: true,
        ..TaskConfig::default()
    };
    let bytes = policy_file(1, |spec, metadata| {
        metadata.contract = PolicyContract::new(&model(), &task).unwrap();
        spec.obs_mean.push(0.0);
        spec.obs_std.push(1.0);
        spec.layers[0].input = 98;
        spec.layers[0].weight.resize(98 * ACT_DIM, 0.0);
    });
    let policy = reference(1, &bytes);
    let passed = verify(bytes.into(), &policy, &model()).unwrap();
    assert_eq!(passed.file.metadata().contract.obs_dim(), 98);
}

#[test]
fn another_version_than_announced_is_refused() {
    let bytes = policy_file(4, |_, _| {});
    let policy = reference(5, &bytes);
    let line = refusal(bytes, &policy).to_string();
    assert_eq!(line, "the file says version 4, announced was 5");
}
