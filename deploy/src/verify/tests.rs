//! Bad policies, each refused by name.

use caudata_policy::{Dense, PolicyMetadata};
use caudata_proto::checks::each_left_out;
use caudata_proto::registry::StreamName;
use caudata_proto::registry::question::{ANSWERS, Compare};

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
    let mut action = [0.0; 16];
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

/// The same file in other bytes: a field of protobuf that comes twice counts by its last value. `ir_version`
/// (field 1) once more at the end, with the value that it has.
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
    let here = model();
    let signed = |manifest: &Manifest| {
        let announcement = Announcement { manifest, trust: Some(&trust), model: &here };
        announcement.check(ANNOUNCEMENT)
    };
    assert!(signed(&manifest).is_ok());
    manifest.sha256 = Sha256::digest(&other).into();
    let refusal = signed(&manifest).unwrap_err();
    assert!(matches!(refusal, Refusal::Untrusted(_)), "{refusal}");
    // As large as it is, too.
    manifest.sha256 = file.sha256();
    assert!(signed(&manifest).is_ok());
    manifest.size = other.len() as u64;
    assert!(signed(&manifest).is_err());
}

/// A network of two layers in which sums of millions cancel: what is left depends on how each product is
/// rounded, so that two correct evaluations differ.
fn rounding_matters() -> Vec<u8> {
    policy_file(1, |spec, _| {
        let (input, out) = (spec.layers[0].input, spec.layers[0].out);
        let hidden = 128;
        let sign = |i: usize| if i.is_multiple_of(2) { 1.0 } else { -1.0 };
        let first = Dense {
            out: hidden,
            input,
            weight: (0..hidden * input).map(|i| (i as f32 * 0.7).sin()).collect(),
            bias: vec![1.0e6; hidden],
        };
        let second = Dense {
            out,
            input: hidden,
            weight: (0..out * hidden)
                .map(|i| sign(i) * (0.7 + 1e-3 * (i / hidden) as f32))
                .collect(),
            bias: vec![0.0; out],
        };
        spec.layers = vec![first, second];
    })
}

#[test]
fn each_step_and_no_other_keeps_its_bad_policy_out() {
    let overflows = || {
        policy_file(1, |spec, _| {
            spec.layers[0].weight.fill(3e38);
        })
    };
    let swapped = || policy_file(1, |_, m| m.contract.joint_names.swap(2, 3));
    let table = each_left_out(CANDIDATE, |name, checks| {
        let good = policy_file(1, |_, _| {});
        let (bytes, policy) = match name {
            "hash" => (good, reference(1, b"other bytes")),
            "version" => (good.clone(), reference(2, &good)),
            "contract" => (swapped(), reference(1, &swapped())),
            "actions in range" => (overflows(), reference(1, &overflows())),
            _ => (rounding_matters(), reference(1, &rounding_matters())),
        };
        verify_by(checks, bytes.into(), &policy, &model())
            .map(drop)
            .map_err(|error| error.to_string())
    });
    // Seen with --nocapture: `make mutants`.
    eprintln!("{}", table.unwrap_or_else(|wrong| panic!("\n{wrong}")));
}

/// Announcements that a key of the robot really signed; it asked for version 3500 of `release/flat`, and its
/// own robot.
#[test]
fn each_step_and_no_other_keeps_its_bad_announcement_out() {
    let key = caudata_signing::ReleaseKey::from_seed("release", &[7; 32]);
    let trust = Trust::parse(&key.trust_file()).unwrap();
    let here = model();
    let [asked_stream, other_stream] =
        ["release/flat", "experimental/rough"].map(|name| StreamName::new(name).unwrap());
    let file =
        PolicyFile::parse(policy_file(3500, |spec, _| spec.layers[0].weight.fill(0.0)).into());
    let file = file.unwrap();
    let announced = |change: &dyn Fn(&mut Manifest)| {
        let stream = asked_stream.clone();
        let mut manifest = caudata_registry_client::manifest_of(stream, &file, 5).unwrap();
        change(&mut manifest);
        key.sign(&mut manifest);
        manifest
    };
    let asked = Facts {
        version: Some(3500),
        sha256: Some(&file.sha256()),
        ..Facts::of_stream(&asked_stream)
    };
    // What a robot asks for by name, then what every announcement must be: as [`crate::keeper::Keeper`] does
    // it.
    let taken = |answers: &[Check<Compare>], checks: &[_], manifest: &Manifest| {
        let said = Facts::from(manifest);
        let answers = answers.iter().try_for_each(|fact| (fact.refuse)(&asked, &said));
        let announcement = Announcement { manifest, trust: Some(&trust), model: &here };
        let taken = answers.map_err(|other| other.to_string());
        taken.and_then(|()| announcement.check(checks).map_err(|refusal| refusal.to_string()))
    };
    let questions: Vec<_> = ANSWERS
        .iter()
        .filter(|fact| ["stream", "version", "bytes"].contains(&fact.name))
        .copied()
        .collect();
    let answers = each_left_out(&questions, |name, facts| {
        let manifest = announced(&|m| match name {
            "stream" => m.stream = other_stream.clone(),
            "version" => m.version = 3510,
            _ => m.sha256 = [1; 32],
        });
        taken(facts, ANNOUNCEMENT, &manifest)
    });
    let announcements = each_left_out(ANNOUNCEMENT, |name, checks| {
        let manifest = match name {
            "signature" => {
                let mut manifest = announced(&|_| {});
                manifest.size += 1;
                manifest
            }
            "robot" => announced(&|m| m.robot_name = "newt".to_owned()),
            _ => announced(&|m| m.robot_hash = [0; 32]),
        };
        taken(ANSWERS, checks, &manifest)
    });
    // Seen with --nocapture: `make mutants`.
    for table in [answers, announcements] {
        eprintln!("{}", table.unwrap_or_else(|wrong| panic!("\n{wrong}")));
    }
}

#[test]
fn weights_of_1e30_do_not_pass_the_probe() {
    let bytes = policy_file(1, |spec, _| spec.layers[0].weight.fill(1e30));
    let policy = reference(1, &bytes);
    let line = refusal(bytes, &policy).to_string();
    assert!(line.contains("beyond ±1000"), "{line}");
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
            assert!(!looks || allowed.contains(&name), "{} looks at the date", path.display());
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
    assert_eq!(line, "joint 2 is `spine_4` in the policy and `spine_3` here");
    let line = refused(|m| m.contract.robot_hash = "0".repeat(64));
    assert!(line.starts_with("policy was trained on model 000"), "{line}");
    let line = refused(|m| m.contract.robot = "newt".to_owned());
    assert!(line.contains("`newt`") && line.contains("`polymander`"), "{line}");
    let line = refused(|m| m.contract.control_period_s = 0.01);
    assert_eq!(line, "the policy differs from what is expected here in its control period");
    let line = refused(|m| m.contract.nominal_pos_rad[9] += 0.1);
    assert_eq!(line, "the policy differs from what is expected here in its nominal pose");
    let line = refused(|m| m.contract.kp_nm_per_rad[0] = 20.0);
    assert_eq!(line, "the policy differs from what is expected here in its gains");
}

#[test]
fn a_policy_that_knows_land_from_water_passes_with_its_own_layout_only() {
    let task = TaskConfig { observe_medium: true, ..TaskConfig::default() };
    let bytes = policy_file(1, |spec, metadata| {
        metadata.contract = PolicyContract::new(&model(), &task).unwrap();
        spec.obs_mean.push(0.0);
        spec.obs_std.push(1.0);
        spec.layers[0].input = 98;
        spec.layers[0].weight.resize(98 * 16, 0.0);
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
