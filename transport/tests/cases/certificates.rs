//! Certificates: who gets in over QUIC, and what a role may do there.

use std::path::Path;
use std::time::{Duration, SystemTime};

use caudata_signing::pki::{Authority, Request, Role};
use caudata_transport::{
    Control, LearnerLink, TlsFiles, TransportConfig, ZenohConfig, actor_link, learner_link,
};
use zenoh::Wait;

use crate::support::frames::{Ledger, flush, frame, recv, send, wait_until};
use crate::support::policies::{assert_nothing_more, label, next_policy, policy, read};
use crate::support::rig::limits;

/// How long somebody tries who shall not get in: some heartbeats and attempts to connect.
const TRIES: Duration = Duration::from_secs(2);

fn certificate(authority: &Authority, role: Role, name: &str) -> TlsFiles {
    let request =
        Request { role, name: name.to_owned(), hosts: vec!["localhost".to_owned()], days: 1 };
    let folder = authority.issue(&request, SystemTime::now(), false).unwrap();
    TlsFiles::in_folder(&folder)
}

fn authority(folder: &Path) -> Authority {
    Authority::create(folder, "lab", SystemTime::now()).unwrap()
}

/// A learner on a free port, and how an actor with `files` reaches it.
fn learner(authority: &Authority, run_id: &str) -> Box<dyn LearnerLink> {
    let config = TransportConfig::Zenoh(ZenohConfig {
        limits: limits(),
        listen: vec!["quic/localhost:0".to_owned()],
        connect: Vec::new(),
        tls: Some(certificate(authority, Role::Learner, "learner")),
    });
    learner_link(&config, run_id).unwrap()
}

fn towards(learner: &dyn LearnerLink, files: TlsFiles) -> TransportConfig {
    match learner.actor_config() {
        TransportConfig::Zenoh(config) => {
            TransportConfig::Zenoh(ZenohConfig { tls: Some(files), ..config })
        }
        other => panic!("another transport: {other:?}"),
    }
}

#[test]
fn an_actor_with_a_certificate_works_as_without() {
    let dir = tempfile::tempdir().unwrap();
    let authority = authority(dir.path());
    let mut learner = learner(&authority, "tls");
    let files = certificate(&authority, Role::Actor, "actor");
    let mut actor = actor_link(&towards(&*learner, files), "tls", 0).unwrap();
    let update = policy(1, 60_000, Control::Run);
    learner.publish_policy(update.clone()).unwrap();
    assert_eq!(next_policy(&mut *actor), update);
    let mut ledger = Ledger::default();
    for number in 1..=100 {
        send(&mut *actor, &frame(label(0, number), 60_000));
        ledger.take(&recv(&mut *learner));
    }
    flush(&mut *actor);
    assert_eq!(learner.stats().peers, 1);
}

/// A robot's certificate is genuine and opens the policy server; here it opens nothing. Nor does an actor's
/// of another lab.
#[test]
fn other_roles_and_strangers_get_nothing_in_and_nothing_out() {
    let dir = tempfile::tempdir().unwrap();
    let ours = authority(&dir.path().join("ours"));
    let theirs = authority(&dir.path().join("theirs"));
    let mut learner = learner(&ours, "roles");
    learner.publish_policy(policy(1, 1_000, Control::Run)).unwrap();
    let cases = [
        ("a robot", certificate(&ours, Role::Robot, "robot")),
        ("an operator", certificate(&ours, Role::Operator, "operator")),
        ("a stranger", certificate(&theirs, Role::Actor, "actor")),
    ];
    for (who, files) in cases {
        let mut link = actor_link(&towards(&*learner, files), "roles", 0).unwrap();
        let refused = link.send(&frame(label(0, 1), 1_000), TRIES);
        assert!(refused.is_err(), "{who} sent a rollout");
        let got = link.next_policy(Duration::from_millis(100)).unwrap();
        assert!(got.is_none(), "{who} got a policy");
        assert_nothing_more(&mut *learner);
    }
    assert_eq!(learner.stats().frames, 0);
}

/// Whoever has an actor's certificate cannot speak for the learner: neither answers nor a policy of its own
/// reach other actors.
#[test]
fn an_actor_cannot_pose_as_the_learner() {
    let dir = tempfile::tempdir().unwrap();
    let authority = authority(dir.path());
    let mut learner = learner(&authority, "pose");
    let files = certificate(&authority, Role::Actor, "actor");
    let TransportConfig::Zenoh(config) = towards(&*learner, files.clone()) else {
        panic!("another transport");
    };
    let mut settings = zenoh::Config::default();
    let path = |path: &Path| format!("{:?}", path.display().to_string());
    for (key, value) in [
        ("mode", "\"client\"".to_owned()),
        ("connect/endpoints", format!("{:?}", config.connect)),
        ("scouting/multicast/enabled", "false".to_owned()),
        ("transport/link/tls/root_ca_certificate", path(&files.ca)),
        ("transport/link/tls/connect_certificate", path(&files.certificate)),
        ("transport/link/tls/connect_private_key", path(&files.key)),
        ("transport/link/tls/enable_mtls", "true".to_owned()),
    ] {
        settings.insert_json5(key, &value).unwrap();
    }
    let impostor = zenoh::open(settings).wait().unwrap();
    let asked = std::sync::Arc::new(std::sync::atomic::AtomicU64::new(0));
    let counter = std::sync::Arc::clone(&asked);
    let posing = impostor
        .declare_queryable("caudata/pose/policy")
        .complete(true)
        .callback(move |_| {
            counter.fetch_add(1, std::sync::atomic::Ordering::Relaxed);
        })
        .wait()
        .unwrap();
    let overheard = std::sync::Arc::new(std::sync::atomic::AtomicU64::new(0));
    let counter = std::sync::Arc::clone(&overheard);
    let listening = impostor
        .declare_subscriber("caudata/pose/up/*")
        .callback(move |_| {
            counter.fetch_add(1, std::sync::atomic::Ordering::Relaxed);
        })
        .wait()
        .unwrap();

    let honest = certificate(&authority, Role::Actor, "honest");
    let mut actor = actor_link(&towards(&*learner, honest), "pose", 0).unwrap();
    let update = policy(1, 60_000, Control::Run);
    learner.publish_policy(update.clone()).unwrap();
    assert_eq!(next_policy(&mut *actor), update);
    let mut ledger = Ledger::default();
    for number in 1..=20 {
        send(&mut *actor, &frame(label(0, number), 10_000));
        read(&mut *learner, &mut ledger, number);
    }
    // Said on behalf of the learner: the actor would stop.
    impostor.put("caudata/pose/down/1", vec![0u8; 64]).wait().unwrap();
    wait_until("everything is acknowledged", || actor.stats().depth == 0);
    assert!(!actor.stop_requested());
    let count =
        |counter: &std::sync::atomic::AtomicU64| counter.load(std::sync::atomic::Ordering::Relaxed);
    assert_eq!((count(&asked), count(&overheard)), (0, 0));
    drop((posing, listening));
    // While the learner is there: a QUIC connection whose other end is gone is closed by its time-out only.
    impostor.close().wait().unwrap();
    drop((actor, learner));
}

/// What the TLS link of zenoh 1.10 did not survive (eclipse-zenoh/zenoh#2557): both directions busy at once,
/// for long. Every frame carries a checksum over all its bytes, every policy is compared whole.
#[test]
fn both_directions_at_once_for_long() {
    both_directions(2_000);
}

/// The same for minutes: some ten gigabytes.
#[test]
#[ignore = "long: minutes"]
fn both_directions_at_once_for_minutes() {
    both_directions(200_000);
}

fn both_directions(frames: u64) {
    let dir = tempfile::tempdir().unwrap();
    let authority = authority(dir.path());
    let mut learner = learner(&authority, "long");
    let files = certificate(&authority, Role::Actor, "actor");
    let config = towards(&*learner, files);
    std::thread::scope(|scope| {
        for sender in 0..2 {
            let mut actor = actor_link(&config, "long", sender).unwrap();
            scope.spawn(move || {
                let mut newest = 0;
                for number in 1..=frames {
                    send(&mut *actor, &frame(label(u64::from(sender), number), 60_000));
                    while let Some(update) = actor.next_policy(Duration::ZERO).unwrap() {
                        assert_eq!(update, policy(update.version, 60_000, Control::Run));
                        assert!(update.version > newest);
                        newest = update.version;
                    }
                }
                flush(&mut *actor);
                assert!(newest > 1, "policies came all the while");
            });
        }
        let mut ledger = Ledger::default();
        let mut version = 0;
        while ledger.total() < 2 * frames {
            if ledger.total() >= 20 * version {
                version += 1;
                learner.publish_policy(policy(version, 60_000, Control::Run)).unwrap();
            }
            ledger.take(&recv(&mut *learner));
        }
    });
}
