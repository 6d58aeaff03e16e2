//! What a power cut, a full card and a torn file leave of a robot's folder.

use caudata_proto::checks::each_left_out;
use caudata_rehearsal::Rehearsal;

use super::*;

fn policy(bytes: &[u8]) -> PolicyRef {
    PolicyRef {
        stream: "s".to_owned(),
        version: 1,
        sha256: Sha256Digest(Sha256::digest(bytes).into()),
        reverts_to: None,
    }
}

#[test]
fn what_was_adopted_is_there_after_a_restart() {
    let folder = tempfile::tempdir().unwrap();
    let one = policy(b"one");
    let mut store = PolicyStore::open(folder.path()).unwrap();
    store.put(&one, b"one").unwrap();
    store.update(|s| s.adopt(one.clone())).unwrap();
    let store = PolicyStore::open(folder.path()).unwrap();
    assert_eq!(store.state().active, Some(one.clone()));
    assert_eq!(*store.get(&one, None).unwrap(), *b"one");
}

#[test]
fn a_truncated_or_missing_file_is_noticed() {
    let folder = tempfile::tempdir().unwrap();
    let one = policy(b"one");
    let store = PolicyStore::open(folder.path()).unwrap();
    let missing = store.get(&one, None).unwrap_err();
    assert!(matches!(missing, DeployError::BlobMissing { .. }), "{missing}");
    store.put(&one, b"one").unwrap();
    let path = blob(folder.path(), one.sha256);
    fs::write(&path, b"on").unwrap();
    let damaged = store.get(&one, None).unwrap_err();
    assert!(matches!(damaged, DeployError::BlobDamaged { .. }), "{damaged}");
    assert!(damaged.to_string().contains(&one.sha256.to_string()));
}

#[test]
fn a_state_that_cannot_be_read_stops_everything() {
    let folder = tempfile::tempdir().unwrap();
    for text in ["", "{", "{\"format\":\"x\"}"] {
        fs::write(folder.path().join("state.json"), text).unwrap();
        let error = PolicyStore::open(folder.path()).unwrap_err();
        assert!(matches!(error, DeployError::StateDamaged { .. }), "{error}");
    }
}

#[test]
fn files_that_no_policy_needs_are_removed() {
    let folder = tempfile::tempdir().unwrap();
    let mut store = PolicyStore::open(folder.path()).unwrap();
    for bytes in [b"one", b"two", b"six"] {
        let policy = policy(bytes);
        store.put(&policy, bytes).unwrap();
        store.update(|s| s.adopt(policy.clone())).unwrap();
        if bytes == b"one" {
            store.update(|s| s.confirm(policy.sha256)).unwrap();
        }
    }
    assert!(store.get(&policy(b"one"), None).is_ok(), "last good");
    assert!(store.get(&policy(b"two"), None).is_err(), "neither active nor good");
    assert!(store.get(&policy(b"six"), None).is_ok(), "active");
}

/// A folder that holds `one` (version 1), adopted, with both copies of the state.
fn adopted() -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    let mut store = PolicyStore::open(folder.path()).unwrap();
    store.put(&policy(b"one"), b"one").unwrap();
    store.update(|s| s.adopt(policy(b"one"))).unwrap();
    folder
}

#[test]
fn fault_15_one_damaged_copy_forgets_nothing() {
    for name in COPIES {
        let whole = fs::read(adopted().path().join(name)).unwrap();
        // Cut anywhere, or any single bit flipped: the other copy speaks, or the damaged one still says the
        // same.
        for at in (0..whole.len()).step_by(7) {
            let mut flipped = whole.clone();
            flipped[at] ^= 0x10;
            for damaged in [&whole[..at], &flipped] {
                let folder = adopted();
                fs::write(folder.path().join(name), damaged).unwrap();
                let store = PolicyStore::open(folder.path()).unwrap();
                assert_eq!(store.state().active, Some(policy(b"one")), "{name} {at}");
                assert_eq!(store.state().seen["s"], 1);
            }
        }
    }
}

#[test]
fn fault_16_both_copies_damaged_is_not_an_empty_state() {
    let folder = adopted();
    for name in COPIES {
        fs::write(folder.path().join(name), b"{").unwrap();
    }
    let error = PolicyStore::open(folder.path()).unwrap_err();
    assert!(matches!(error, DeployError::StateDamaged { .. }), "{error}");
}

#[test]
fn the_newer_copy_wins_where_power_went_between_the_two() {
    let folder = adopted();
    let old = fs::read(folder.path().join(COPIES[1])).unwrap();
    let mut store = PolicyStore::open(folder.path()).unwrap();
    store.update(|s| s.confirm(policy(b"one").sha256)).unwrap();
    fs::write(folder.path().join(COPIES[1]), old).unwrap();
    let store = PolicyStore::open(folder.path()).unwrap();
    assert_eq!(store.state().last_good, Some(policy(b"one")));
}

#[test]
fn fault_16_a_lost_state_takes_nothing_until_a_floor_is_proved() {
    let folder = adopted();
    for name in COPIES {
        fs::write(folder.path().join(name), b"{").unwrap();
    }
    let mut store = PolicyStore::open_torn(folder.path()).unwrap();
    assert!(store.is_torn());
    let error = store.update(|s| s.adopt(policy(b"one"))).unwrap_err();
    assert!(matches!(error, DeployError::StateLost), "{error}");
    // As torn as before, not new.
    assert!(PolicyStore::open(folder.path()).is_err());
    store.recover("s", 9, 2).unwrap();
    let store = PolicyStore::open(folder.path()).unwrap();
    let here = Sha256Digest([7; 32]);
    let older = crate::state::Decision::Older { have: 9 };
    assert_eq!(store.decide(&policy(b"one"), here), older);
    for name in COPIES {
        let aside = folder.path().join(format!("{name}.damaged"));
        assert_eq!(fs::read(aside).unwrap(), b"{", "{name}");
    }
    // Nor do the keys come back that were given up before it was proved.
    let error = check_trust(store.state(), Path::new("t"), 1).unwrap_err();
    assert!(matches!(error, DeployError::OlderTrust { .. }), "{error}");
}

/// A folder whose state is lost: both copies are damaged, or the only one that is there.
fn lost(root: &Path, damaged: &[&str]) {
    drop(walked(root));
    for name in COPIES {
        match damaged.contains(&name) {
            true => fs::write(root.join(name), b"{").unwrap(),
            false => fs::remove_file(root.join(name)).unwrap(),
        }
    }
}

#[test]
fn fault_16_what_was_damaged_later_does_not_replace_what_was_damaged_before() {
    let folder = tempfile::tempdir().unwrap();
    let torn = |text: &str| {
        for name in COPIES {
            fs::write(folder.path().join(name), text).unwrap();
        }
        let mut store = PolicyStore::open_torn(folder.path()).unwrap();
        store.recover("s", 9, 2).unwrap();
    };
    ["{first", "{second", "{second"].into_iter().for_each(torn);
    let kept = |name: &str| fs::read_to_string(folder.path().join(name)).ok();
    assert_eq!(kept("state.json.damaged").as_deref(), Some("{first"));
    assert_eq!(kept("state.json.damaged-2").as_deref(), Some("{second"));
    assert_eq!(kept("state.json.damaged-3"), None, "the same once");
    (0..40).for_each(|n| torn(&format!("{{{n}")));
    let files = fs::read_dir(folder.path()).unwrap().count();
    assert!(files < 40, "{files} files");
    assert_eq!(kept("state.json.damaged").as_deref(), Some("{first"));
}

/// Whether a robot that starts with this folder is still torn; else it goes by the new state. It never takes
/// itself for a new one.
fn torn_or_recovered(folder: &Path) -> bool {
    match PolicyStore::open(folder) {
        Err(DeployError::StateDamaged { .. }) => true,
        Err(error) => panic!("{error}"),
        Ok(store) => {
            assert_eq!(store.state().seen.get("s"), Some(&9));
            assert_eq!(store.state().trust_version, 2);
            false
        }
    }
}

const LOSSES: [&[&str]; 3] = [&COPIES, &[COPIES[0]], &[COPIES[1]]];

#[test]
fn fault_16_a_power_cut_while_a_lost_state_is_begun_anew_leaves_no_robot_that_never_had_one() {
    for damaged in LOSSES {
        let folder = tempfile::tempdir().unwrap();
        let root = folder.path().join("state");
        lost(&root, damaged);
        let disk = Arc::new(Rehearsal::new(&root).unwrap());
        let mut store = PolicyStore::open_torn_on(disk.clone(), &root);
        let first = disk.steps();
        store.recover("s", 9, 2).unwrap();
        let last = disk.steps();
        let (mut torn, mut recovered) = (0, 0);
        for step in first..=last {
            let below = folder.path().join(format!("cuts-{step}"));
            for left in disk.cut(step, &below).unwrap() {
                let still = torn_or_recovered(&left);
                assert!(!still || step < last, "promised");
                torn += u32::from(still);
                recovered += u32::from(!still);
                if still {
                    PolicyStore::open_torn(&left).unwrap().recover("s", 9, 2).unwrap();
                    assert!(!torn_or_recovered(&left));
                }
            }
            fs::remove_dir_all(&below).unwrap();
        }
        assert!(torn > 0 && recovered > 0, "both were seen");
    }
}

#[test]
fn fault_16_a_full_disk_while_a_lost_state_is_begun_anew_leaves_no_robot_that_never_had_one() {
    for damaged in LOSSES {
        for step in 0.. {
            let folder = tempfile::tempdir().unwrap();
            lost(folder.path(), damaged);
            let disk = Arc::new(Rehearsal::new(folder.path()).unwrap());
            let mut store = PolicyStore::open_torn_on(disk.clone(), folder.path());
            disk.fail_writes_at(disk.steps() + step, 28);
            let result = store.recover("s", 9, 2);
            disk.heal();
            let Err(error) = result else {
                assert!(step > 5, "it has few steps");
                break;
            };
            assert_eq!(error.exit_code(), caudata_telemetry::ExitCode::IoError);
            assert!(store.is_torn());
            torn_or_recovered(folder.path());
            // The next answer of the server does it, and what was damaged is still there for a person.
            store.recover("s", 9, 2).unwrap();
            assert!(!torn_or_recovered(folder.path()));
            for name in damaged {
                let aside = folder.path().join(format!("{name}.damaged"));
                assert_eq!(fs::read(aside).unwrap(), b"{", "{name}");
            }
        }
    }
}

/// Version 1 ran well, version 2 is active.
fn walked(folder: &Path) -> PolicyStore {
    let mut store = PolicyStore::open(folder).unwrap();
    for (bytes, version) in [(&b"one"[..], 1), (&b"two"[..], 2)] {
        let policy = PolicyRef { version, ..policy(bytes) };
        store.put(&policy, bytes).unwrap();
        store.update(|s| s.adopt(policy.clone())).unwrap();
        if version == 1 {
            store.update(|s| s.confirm(policy.sha256)).unwrap();
        }
    }
    store
}

type Change = fn(&mut PolicyStore) -> Result<(), DeployError>;

/// Each change that a robot's folder undergoes.
const CHANGES: [(&str, Change); 4] = [
    ("a newer one is taken", |store| {
        let six = PolicyRef { version: 3, ..policy(b"six") };
        store.put(&six, b"six")?;
        store.update(|s| s.adopt(six))
    }),
    ("begun", |store| {
        store.update(|s| {
            s.begin(policy(b"two").sha256);
        })
    }),
    ("confirmed", |store| store.update(|s| s.confirm(policy(b"two").sha256))),
    ("quarantined", |store| {
        let two = store.state().active.clone().unwrap();
        store.update(|s| s.quarantine(two, "falls".into(), crate::state::Blame::Policy))
    }),
];

/// What a robot that starts with this folder finds: its state, with every policy that it names there and
/// whole.
fn found(folder: &Path) -> RobotState {
    let store = PolicyStore::open(folder).unwrap();
    let state = store.state().clone();
    assert!(!state.on_disk().is_empty(), "never to nothing");
    for policy in state.on_disk() {
        store.get(&policy, None).unwrap();
    }
    state
}

#[test]
fn fault_29_a_power_cut_at_any_write_leaves_the_old_or_the_new_state_with_its_policies() {
    let mut states = 0;
    for (name, change) in CHANGES {
        let folder = tempfile::tempdir().unwrap();
        let root = folder.path().join("state");
        drop(walked(&root));
        let old = found(&root);
        let disk = Arc::new(Rehearsal::new(&root).unwrap());
        let mut store = PolicyStore::open_on(disk.clone(), &root).unwrap();
        let first = disk.steps();
        change(&mut store).unwrap();
        let last = disk.steps();
        let new = store.state().clone();
        assert_ne!(old, new, "{name}");
        let (mut olds, mut news) = (0, 0);
        for step in first..=last {
            let below = folder.path().join(format!("cuts-{step}"));
            for left in disk.cut(step, &below).unwrap() {
                let found = found(&left);
                assert!(found == old || found == new, "{name} cut after {step}");
                assert!(step < last || found == new, "{name}: promised");
                olds += u32::from(found == old);
                news += u32::from(found == new);
                // And it goes on from there.
                let mut store = PolicyStore::open(&left).unwrap();
                store.update(|s| s.adopt(policy(b"nix"))).unwrap();
                states += 1;
            }
            fs::remove_dir_all(&below).unwrap();
        }
        assert!(olds > 0 && news > 0, "{name}: both were seen");
    }
    assert!(states > 50, "{states}");
}

#[test]
fn fault_30_a_full_disk_at_any_write_refuses_the_change_and_harms_nothing() {
    for (name, change) in CHANGES {
        for step in 0.. {
            let folder = tempfile::tempdir().unwrap();
            drop(walked(folder.path()));
            let old = found(folder.path());
            let disk = Arc::new(Rehearsal::new(folder.path()).unwrap());
            let mut store = PolicyStore::open_on(disk.clone(), folder.path()).unwrap();
            disk.fail_writes_at(disk.steps() + step, 28);
            let result = change(&mut store);
            disk.heal();
            let Err(error) = result else {
                assert!(step > 3, "{name} has few steps");
                break;
            };
            assert_eq!(error.exit_code(), caudata_telemetry::ExitCode::IoError);
            assert_eq!(*store.state(), old, "{name} at {step}: as it was, here");
            // One copy may be the new one already: then the change counts after a restart, whole.
            found(folder.path());
            change(&mut store).unwrap();
            assert_eq!(found(folder.path()), *store.state());
        }
    }
}

#[test]
fn fault_30_a_disk_that_would_not_take_a_policy_says_so_before_it_is_fetched() {
    let folder = tempfile::tempdir().unwrap();
    drop(walked(folder.path()));
    let disk = Arc::new(Rehearsal::new(folder.path()).unwrap());
    let store = PolicyStore::open_on(disk.clone(), folder.path()).unwrap();
    let before = fs::read_dir(folder.path().join("blobs")).unwrap().count();
    store.reserve(&policy(b"six"), 100_000).unwrap();
    disk.fail_writes_at(disk.steps(), 30);
    let error = store.reserve(&policy(b"six"), 100_000).unwrap_err();
    assert!(matches!(error, DeployError::Durable(_)), "{error}");
    let after = fs::read_dir(folder.path().join("blobs")).unwrap().count();
    assert_eq!(before, after, "nothing is left of it");
}

#[test]
fn what_the_loop_loads_was_signed_as_this_very_policy() {
    let folder = tempfile::tempdir().unwrap();
    let key = caudata_signing::ReleaseKey::from_seed("release", &[7; 32]);
    let trust = Trust::parse(&key.trust_file()).unwrap();
    let store = PolicyStore::open(folder.path()).unwrap();
    let one = policy(b"one");
    store.put(&one, b"one").unwrap();
    let read = || read_policy(folder.path(), &one, Some(&trust));
    // Each error names the file that it is about.
    let named = |wanted: PathBuf| match read() {
        Err(DeployError::BlobMissing { path, .. } | DeployError::NotSigned { path }) => {
            assert_eq!(path, wanted);
        }
        other => panic!("{other:?}"),
    };
    let path = manifest_file(folder.path(), &one);
    assert!(matches!(read(), Err(DeployError::BlobMissing { .. })));
    named(path.clone());
    let mut manifest = announced(&one, &key);
    manifest.signatures.clear();
    store.put_manifest(&manifest).unwrap();
    named(path.clone());
    assert!(matches!(read(), Err(DeployError::NotSigned { .. })));
    key.sign(&mut manifest);
    store.put_manifest(&manifest).unwrap();
    assert_eq!(*read().unwrap(), *b"one");
    // Signed, but announced in another stream: under the name of this policy it does not count.
    manifest.stream = caudata_proto::registry::StreamName::new("other").unwrap();
    key.sign(&mut manifest);
    fs::write(&path, manifest.to_bytes()).unwrap();
    assert!(matches!(read(), Err(DeployError::NotSigned { .. })));
    fs::write(&path, b"no manifest").unwrap();
    assert!(matches!(read(), Err(DeployError::NotSigned { .. })));
}

#[test]
fn each_step_and_no_other_keeps_out_what_lies_in_the_folder() {
    let key = caudata_signing::ReleaseKey::from_seed("release", &[7; 32]);
    let trust = Trust::parse(&key.trust_file()).unwrap();
    let table = each_left_out(STORED, |name, checks| {
        let folder = tempfile::tempdir().unwrap();
        let store = PolicyStore::open(folder.path()).unwrap();
        let one = policy(b"one");
        store.put(&one, b"one").unwrap();
        let mut manifest = announced(&one, &key);
        store.put_manifest(&manifest).unwrap();
        match name {
            "stored hash" => fs::write(blob(folder.path(), one.sha256), b"other").unwrap(),
            _ => {
                manifest.signatures.clear();
                store.put_manifest(&manifest).unwrap();
            }
        }
        read_policy_by(checks, folder.path(), &one, Some(&trust)).map(drop)
    });
    // Seen with --nocapture: `make mutants`.
    eprintln!("{}", table.unwrap_or_else(|wrong| panic!("\n{wrong}")));
}

#[test]
fn announcements_that_no_policy_needs_are_removed_although_its_bytes_are() {
    let folder = tempfile::tempdir().unwrap();
    let key = caudata_signing::ReleaseKey::from_seed("release", &[7; 32]);
    let mut store = PolicyStore::open(folder.path()).unwrap();
    store.put(&policy(b"one"), b"one").unwrap();
    let announcements = || -> Vec<PathBuf> {
        let entries = fs::read_dir(folder.path().join("blobs")).unwrap();
        let paths = entries.map(|entry| entry.unwrap().path());
        let mut paths: Vec<_> = paths.filter(|p| p.extension().unwrap() != "onnx").collect();
        paths.sort();
        paths
    };
    // The same bytes under one number after the other, as a robot gets them whose operators go back again and
    // again.
    for version in 1..10 {
        let of = |version| PolicyRef { version, ..policy(b"one") };
        store.put_manifest(&announced(&of(version), &key)).unwrap();
        store.update(|s| s.adopt(of(version))).unwrap();
        if version == 1 {
            store.update(|s| s.confirm(of(1).sha256)).unwrap();
        }
        let mut needed: Vec<PathBuf> =
            [1, version].into_iter().map(|v| manifest_file(folder.path(), &of(v))).collect();
        needed.sort();
        needed.dedup();
        assert_eq!(announcements(), needed, "{version}");
    }
}

/// The announcement of `policy`, signed by `key`.
fn announced(policy: &PolicyRef, key: &caudata_signing::ReleaseKey) -> Manifest {
    let mut manifest = Manifest {
        stream: caudata_proto::registry::StreamName::new(&policy.stream).unwrap(),
        version: policy.version,
        sha256: policy.sha256.0,
        size: 3,
        created_unix_ms: 5,
        run_id: "r".into(),
        contract_hash: [2; 32],
        robot_name: "polymander".into(),
        robot_hash: [3; 32],
        env_steps: 9,
        training_commit: String::new(),
        config_hash: String::new(),
        evaluation_json: None,
        reverts_to: None,
        signatures: Vec::new(),
    };
    key.sign(&mut manifest);
    manifest
}

#[test]
fn fault_29_a_power_cut_at_any_write_leaves_every_policy_with_its_own_signature() {
    let key = caudata_signing::ReleaseKey::from_seed("release", &[7; 32]);
    let trust = Trust::parse(&key.trust_file()).unwrap();
    let take = |store: &mut PolicyStore, policy: &PolicyRef| {
        store.put(policy, b"one").unwrap();
        store.put_manifest(&announced(policy, &key)).unwrap();
        store.update(|s| s.adopt(policy.clone())).unwrap();
    };
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path().join("state");
    let one = policy(b"one");
    let mut store = PolicyStore::open(&root).unwrap();
    take(&mut store, &one);
    store.update(|s| s.confirm(one.sha256)).unwrap();
    drop(store);
    // The same bytes under the same number, released into another stream.
    let same = PolicyRef { stream: "release/s".to_owned(), ..one.clone() };
    let disk = Arc::new(Rehearsal::new(&root).unwrap());
    let mut store = PolicyStore::open_on(disk.clone(), &root).unwrap();
    let first = disk.steps();
    take(&mut store, &same);
    let mut found = Vec::new();
    for step in first..=disk.steps() {
        let below = folder.path().join(format!("cuts-{step}"));
        for left in disk.cut(step, &below).unwrap() {
            let state = PolicyStore::open(&left).unwrap().state().clone();
            for policy in state.on_disk() {
                let read = read_policy(&left, &policy, Some(&trust));
                assert_eq!(*read.unwrap(), *b"one", "{policy} cut after {step}");
            }
            found.push(state.active);
        }
        fs::remove_dir_all(&below).unwrap();
    }
    assert!(found.contains(&Some(one)) && found.contains(&Some(same)));
}

#[test]
fn fault_23_a_trust_file_that_is_older_than_one_of_before_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let path = Path::new("trust.toml");
    let mut store = PolicyStore::open(folder.path()).unwrap();
    store.trust(path, 1).unwrap();
    store.trust(path, 3).unwrap();
    store.trust(path, 3).unwrap();
    // Also after a restart, whichever copy of the state survives.
    for name in COPIES {
        let other = tempfile::tempdir().unwrap();
        fs::copy(folder.path().join(name), other.path().join(name)).unwrap();
        let mut store = PolicyStore::open(other.path()).unwrap();
        let error = store.trust(path, 2).unwrap_err();
        assert_eq!(
            error.to_string(),
            "trust file trust.toml: version 2 is in force, and on this robot version 3 was: put the newer files back"
        );
        assert_eq!(error.exit_code(), caudata_telemetry::ExitCode::BadInput);
        store.trust(path, 4).unwrap();
    }
}

#[test]
fn fault_30_a_disk_that_takes_nothing_does_not_keep_a_robot_from_its_trust_file() {
    let folder = tempfile::tempdir().unwrap();
    drop(walked(folder.path()));
    let disk = Arc::new(Rehearsal::new(folder.path()).unwrap());
    let mut store = PolicyStore::open_on(disk.clone(), folder.path()).unwrap();
    disk.fail_writes_at(disk.steps(), 28);
    store.trust(Path::new("t"), 2).unwrap();
    assert_eq!(store.state().trust_version, 0, "it is not promised");
    disk.heal();
    store.trust(Path::new("t"), 2).unwrap();
    assert_eq!(found(folder.path()).trust_version, 2);
}

#[test]
fn fault_30_a_trust_version_that_could_not_be_written_comes_with_the_next_change() {
    for step in 0.. {
        let folder = tempfile::tempdir().unwrap();
        drop(walked(folder.path()));
        let disk = Arc::new(Rehearsal::new(folder.path()).unwrap());
        let mut store = PolicyStore::open_on(disk.clone(), folder.path()).unwrap();
        disk.fail_writes_at(disk.steps() + step, 28);
        store.trust(Path::new("t"), 2).unwrap();
        disk.heal();
        if store.state().trust_version == 2 {
            assert!(step > 3, "it has few steps");
            break;
        }
        store.update(|s| s.confirm(policy(b"two").sha256)).unwrap();
        // In each copy: also where the first one had it and the second one had not.
        for name in COPIES {
            let state = read_copy(&folder.path().join(name)).unwrap().unwrap();
            assert_eq!(state.trust_version, 2, "{name} at {step}");
        }
    }
}

#[test]
fn fault_23_the_first_trust_file_is_not_written_down_and_a_later_one_cannot_be_left_out() {
    let folder = tempfile::tempdir().unwrap();
    let mut store = walked(folder.path());
    store.trust(Path::new("t"), 1).unwrap();
    store.update(|s| s.confirm(policy(b"two").sha256)).unwrap();
    let text = fs::read_to_string(folder.path().join(COPIES[0])).unwrap();
    assert!(!text.contains("trust_version"), "the program before reads it: {text}");
    check_without_trust(store.state(), folder.path()).unwrap();
    store.trust(Path::new("t"), 2).unwrap();
    let error = check_without_trust(&found(folder.path()), Path::new("state")).unwrap_err();
    assert_eq!(
        error.to_string(),
        "robot state state: trust file version 2 was in force on this robot and none is given: give it with --trust"
    );
    assert_eq!(error.exit_code(), caudata_telemetry::ExitCode::BadInput);
}
