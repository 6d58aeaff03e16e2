//! Power cuts and failing disks at every step of every change of the store, and what is left then.

use std::collections::BTreeSet;
use std::path::Path;
use std::sync::Arc;

use caudata_durable::OsDisk;
use caudata_policy_server::{Origin, Store, StoreError, StoreLimits};
use caudata_proto::registry::{
    LabelName, Manifest, QuarantineState, RobotReport, RobotState, SetLabel, StreamName, reverting,
};
use caudata_rehearsal::Rehearsal;
use sha2::{Digest, Sha256};

/// Numbers of the system: no space left, input/output error.
const ENOSPC: i32 = 28;
const EIO: i32 = 5;
/// Too many open files.
const EMFILE: i32 = 24;

fn stream() -> StreamName {
    StreamName::new("polymander/flat").unwrap()
}

fn bytes(version: u64) -> Vec<u8> {
    format!("policy {version}").into_bytes()
}

fn manifest(version: u64) -> Manifest {
    let bytes = bytes(version);
    Manifest {
        stream: stream(),
        version,
        sha256: Sha256::digest(&bytes).into(),
        size: bytes.len() as u64,
        created_unix_ms: 5,
        run_id: "run".into(),
        contract_hash: [7; 32],
        robot_name: "polymander".into(),
        robot_hash: [9; 32],
        env_steps: 1,
        training_commit: String::new(),
        config_hash: String::new(),
        evaluation_json: None,
        reverts_to: None,
        signatures: vec![],
    }
}

fn stable(version: u64, expected_generation: u64) -> SetLabel {
    SetLabel {
        stream: stream(),
        label: LabelName::new("stable").unwrap(),
        version,
        expected_generation,
        override_reason: Some("test".into()),
    }
}

fn out(version: u64) -> QuarantineState {
    QuarantineState {
        stream: stream(),
        version,
        reason: "falls".into(),
        by: String::new(),
        generation: 0,
        unix_ms: 0,
    }
}

fn good(version: u64) -> RobotReport {
    RobotReport {
        robot: "robot-1".into(),
        stream: stream(),
        version,
        sha256: manifest(version).sha256,
        state: RobotState::Good,
        reason: String::new(),
        walked_s: 10.0,
        falls: 0,
        attempts: 1,
        unix_ms: 0,
    }
}

/// What shows of a store, without times.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
struct Shown {
    versions: Vec<(u64, Option<u64>)>,
    labels: Vec<(String, u64)>,
    quarantined: Vec<u64>,
    good: usize,
}

fn shown(store: &mut Store) -> Shown {
    let records: Vec<Manifest> = store.records(None).map(|r| r.manifest.clone()).collect();
    for manifest in &records {
        let found = store.read_blob(&manifest.sha256).unwrap();
        assert_eq!(*found, bytes(manifest.reverts_to.unwrap_or(manifest.version)), "whole");
    }
    let labels = store.labels(None).into_iter().map(|s| (s.label.to_string(), s.version));
    let labels = labels.collect();
    let versions: Vec<_> = records.iter().map(|m| (m.version, m.reverts_to)).collect();
    let quarantined = versions.iter().map(|(v, _)| *v);
    let quarantined = quarantined.filter(|v| store.is_quarantined(&stream(), *v)).collect();
    Shown { versions, labels, quarantined, good: store.good_reports(&stream(), 2) }
}

fn open(root: &Path) -> Store {
    Store::open(root, StoreLimits::default()).unwrap()
}

type Change = fn(&mut Store) -> Result<(), StoreError>;

/// Each change that a store can undergo; it begins with version 1 under `stable`, and version 2.
const CHANGES: [(&str, Change); 6] = [
    ("publish", |store| store.publish(manifest(3), &bytes(3)).map(drop)),
    ("label", |store| store.set_label(&Origin::local(), stable(2, 3)).map(drop)),
    ("first label", |store| {
        let mut canary = stable(2, 0);
        canary.label = LabelName::new("canary").unwrap();
        store.set_label(&Origin::local(), canary).map(drop)
    }),
    ("quarantine", |store| store.quarantine(&Origin::local(), out(2)).map(drop)),
    ("report", |store| store.report(&Origin::local(), good(2)).map(drop)),
    ("revert", |store| {
        let manifest = reverting(&manifest(1), 3, 6);
        store.revert(&Origin::local(), manifest, "better").map(drop)
    }),
];

fn begin(root: &Path) -> Store {
    std::fs::create_dir_all(root).unwrap();
    let mut store = open(root);
    store.publish(manifest(1), &bytes(1)).unwrap();
    store.publish(manifest(2), &bytes(2)).unwrap();
    store.set_label(&Origin::local(), stable(1, 0)).unwrap();
    store
}

/// The record says exactly what happened: its last line is the change, or that it did not happen.
fn record_agrees(root: &Path, happened: bool) -> bool {
    let text = std::fs::read_to_string(root.join("audit.jsonl")).unwrap();
    let lines: Vec<serde_json::Value> =
        text.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    assert_eq!(lines[0]["number"], 1);
    let (announced, taken_back) = lines.iter().skip(3).fold((0, 0), |(a, t), line| {
        if line["what"] == "undone" { (a, t + 1) } else { (a + 1, t) }
    });
    announced - taken_back == i32::from(happened)
}

#[test]
fn fault_1_power_cut_at_any_step_of_any_change_leaves_the_old_or_the_new() {
    let mut states = 0;
    for (name, change) in CHANGES {
        let folder = tempfile::tempdir().unwrap();
        let root = folder.path().join("data");
        let mut before = begin(&root);
        let old = shown(&mut before);
        drop(before);
        let disk = Arc::new(Rehearsal::new(&root).unwrap());
        let mut store = Store::open_on(&root, StoreLimits::default(), disk.clone()).unwrap();
        let first = disk.steps();
        change(&mut store).unwrap();
        let last = disk.steps();
        let new = shown(&mut store);
        drop(store);
        assert_ne!(old, new, "{name}");
        let mut seen = BTreeSet::new();
        for step in first..=last {
            let below = folder.path().join(format!("cuts-{step}"));
            for left in disk.cut(step, &below).unwrap() {
                let mut store = open(&left);
                let found = shown(&mut store);
                assert!(found == old || found == new, "{name} cut after {step}: {found:?}");
                if step == last {
                    assert_eq!(found, new, "{name}: promised");
                }
                // Reports count as no change and are told again: an announcement of one may stand alone.
                if name != "report" {
                    assert!(record_agrees(&left, found == new), "{name} cut after {step}");
                }
                // And it goes on from there.
                store.publish(manifest(9), &bytes(9)).unwrap();
                states += 1;
                seen.insert(found);
            }
            std::fs::remove_dir_all(&below).unwrap();
        }
        assert_eq!(seen.len(), 2, "{name}: both were seen");
    }
    println!("{states} states after power cuts");
    assert!(states > 200, "{states}");
}

#[test]
fn fault_2_a_full_disk_at_any_step_refuses_the_change_and_harms_nothing() {
    for (name, change) in CHANGES {
        for step in 0.. {
            let folder = tempfile::tempdir().unwrap();
            let root = folder.path().join("data");
            let mut store = begin(&root);
            let old = shown(&mut store);
            drop(store);
            let disk = Arc::new(Rehearsal::new(&root).unwrap());
            let mut store = Store::open_on(&root, StoreLimits::default(), disk.clone()).unwrap();
            // A full disk refuses bytes and names, not the wait for what is written already.
            disk.fail_writes_at(disk.steps() + step, ENOSPC);
            let result = change(&mut store);
            disk.heal();
            let Err(error) = result else {
                assert!(step > 3, "{name} has few steps");
                break;
            };
            let full = matches!(&error, StoreError::Durable(e) if e.is_disk_full());
            assert!(full, "{name} at {step}: {error}");
            assert_eq!(shown(&mut store), old, "{name} at {step}");
            assert_eq!(stray_files(&root), 0, "{name} at {step}");
            assert!(store.read_only().is_none());
            assert!(store.trouble().is_some());
            // With space again it works, and a restart finds nothing odd.
            change(&mut store).unwrap();
            let new = shown(&mut store);
            drop(store);
            assert_eq!(shown(&mut open(&root)), new, "{name} at {step}");
            assert_eq!(leftovers(&root), 0, "{name} at {step}");
            assert!(record_agrees(&root, true), "{name} at {step}");
        }
    }
}

#[test]
fn fault_3_after_a_failed_sync_nothing_is_changed_until_the_disk_is_sound_and_then_it_goes_on() {
    for (name, change) in CHANGES {
        let mut failed = 0;
        for step in 0.. {
            let folder = tempfile::tempdir().unwrap();
            let root = folder.path().join("data");
            let mut store = begin(&root);
            let old = shown(&mut store);
            drop(store);
            let disk = Arc::new(Rehearsal::new(&root).unwrap());
            let mut store = Store::open_on(&root, StoreLimits::default(), disk.clone()).unwrap();
            disk.fail_syncs_at(disk.steps() + step, EIO);
            let result = change(&mut store);
            let Err(error) = result else {
                break;
            };
            failed += 1;
            assert!(
                matches!(&error, StoreError::Durable(e) if e.is_sync_failure()),
                "{name} at {step}: {error}"
            );
            assert!(store.recover().is_err(), "not while syncs fail");
            disk.heal();
            assert!(store.read_only().is_some(), "{name} at {step}");
            assert_eq!(shown(&mut store), old, "{name} at {step}: still served");
            // Not even when the disk seems well again: first it is made certain what is on it.
            let again = store.publish(manifest(4), &bytes(4)).unwrap_err();
            assert!(matches!(again, StoreError::ReadOnly { .. }), "{again}");
            let generation = store.generation();
            let late = store.recover().unwrap();
            assert!(store.trouble().is_none(), "{name} at {step}");
            let found = shown(&mut store);
            // What shows now is told to watchers.
            let is_new = found != old && name != "report";
            assert_eq!(usize::from(is_new), late.len(), "{name} at {step}");
            if name != "report" {
                assert!(record_agrees(&root, found != old), "{name} at {step}");
            }
            store.publish(manifest(9), &bytes(9)).unwrap();
            assert!(store.generation() > generation, "{name} at {step}");
            let found = shown(&mut store);
            // All of it is on the disk: a power cut takes nothing.
            let below = folder.path().join("cuts");
            let cuts = disk.cut(disk.steps(), &below).unwrap();
            drop(store);
            for left in &cuts {
                assert_eq!(shown(&mut open(left)), found, "{name} at {step}");
            }
        }
        assert!(failed >= 3, "{name}: {failed} syncs");
    }
}

#[test]
fn a_process_without_file_handles_refuses_the_change_and_stays_writable() {
    for (name, change) in CHANGES {
        for step in 0.. {
            let folder = tempfile::tempdir().unwrap();
            let root = folder.path().join("data");
            let mut store = begin(&root);
            let old = shown(&mut store);
            drop(store);
            let disk = Arc::new(Rehearsal::new(&root).unwrap());
            let mut store = Store::open_on(&root, StoreLimits::default(), disk.clone()).unwrap();
            disk.fail_opens_at(disk.steps() + step, EMFILE);
            let result = change(&mut store);
            if result.is_ok() {
                assert!(step > 2, "{name} opens something");
                break;
            }
            assert!(store.recover().is_err());
            disk.heal();
            assert!(store.read_only().is_none(), "{name} at {step}");
            assert!(store.trouble().is_some(), "{name} at {step}: it says so");
            assert_eq!(shown(&mut store), old, "{name} at {step}");
            assert!(store.recover().unwrap().is_empty());
            assert!(store.trouble().is_none(), "{name} at {step}");
            change(&mut store).unwrap();
            let new = shown(&mut store);
            drop(store);
            assert_eq!(shown(&mut open(&root)), new, "{name} at {step}");
            assert!(record_agrees(&root, true), "{name} at {step}");
        }
    }
}

/// Temporary files anywhere below `folder`.
fn stray_files(folder: &Path) -> usize {
    let entries = std::fs::read_dir(folder).unwrap().map(|e| e.unwrap().path());
    entries
        .map(|path| match path.is_dir() {
            true => stray_files(&path),
            false => usize::from(path.to_string_lossy().ends_with(".partial")),
        })
        .sum()
}

/// Blobs that no version names.
fn leftovers(root: &Path) -> usize {
    let mut store = open(root);
    let named: BTreeSet<String> = shown(&mut store)
        .versions
        .iter()
        .map(|(v, old)| hex(&manifest(old.unwrap_or(*v)).sha256))
        .collect();
    std::fs::read_dir(root.join("blobs"))
        .unwrap()
        .map(|entry| entry.unwrap().file_name().into_string().unwrap())
        .filter(|name| !named.contains(name.trim_end_matches(".onnx")))
        .count()
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|b| format!("{b:02x}")).collect()
}

#[test]
fn a_damaged_quarantine_file_keeps_its_version_out_of_use() {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path().join("data");
    let mut store = begin(&root);
    store.quarantine(&Origin::local(), out(2)).unwrap();
    drop(store);
    let file = root.join("quarantine/polymander@flat/00000000000000000002.json");
    std::fs::write(&file, b"{").unwrap();
    let store = Store::open_on(&root, StoreLimits::default(), Arc::new(OsDisk)).unwrap();
    assert!(store.is_quarantined(&stream(), 2));
    let latest = store.labelled(&stream(), &LabelName::latest()).unwrap();
    assert_eq!(latest.manifest.version, 1);
}
