//! Labels, reports, quarantine, reverts and freshness from the outside.

use std::sync::Arc;
use std::time::{Duration, Instant};

use crate::common::{Server, code, policy, publish, stream};
use caudata_policy_server::{ServeOptions, StoreLimits};
use caudata_proto::registry::{
    LabelName, RobotReport, RobotState, SetLabel, WatchChange, reverting,
};
use caudata_registry_client::{ClientError, RegistryClient};
use caudata_signing::{ReleaseKey, Stale, Trust};
use tonic::Code;

fn label(name: &str) -> LabelName {
    LabelName::new(name).unwrap()
}

fn set(name: &str, version: u64, expected_generation: u64) -> SetLabel {
    SetLabel {
        stream: stream(),
        label: label(name),
        version,
        expected_generation,
        override_reason: None,
    }
}

fn report(robot: &str, version: u64, state: RobotState) -> RobotReport {
    RobotReport {
        robot: robot.into(),
        stream: stream(),
        version,
        sha256: policy(version).sha256(),
        state,
        reason: if state.went_well() { String::new() } else { "fell".into() },
        walked_s: 11.5,
        falls: u32::from(!state.went_well()),
        attempts: 1,
        unix_ms: 0,
    }
}

fn refused<T: std::fmt::Debug>(answer: Result<T, ClientError>) -> Code {
    code(&answer.unwrap_err())
}

#[tokio::test]
async fn faults_7_and_8_labels_move_by_compare_and_set_to_what_may_be_run() {
    let data = tempfile::tempdir().unwrap();
    let mut server = Server::start(data.path(), StoreLimits::default()).await;
    let client = &mut server.client;
    for version in 1..=3 {
        publish(client, &policy(version)).await.unwrap();
    }
    assert_eq!(client.labelled(&stream(), &LabelName::latest()).await.unwrap().version, 3);
    assert_eq!(refused(client.labelled(&stream(), &label("canary")).await), Code::NotFound);

    // Two operators see that there is no canary; both move it. One wins, the other is told.
    let mut other = client.clone();
    let (a, b) =
        tokio::join!(client.set_label(set("canary", 1, 0)), other.set_label(set("canary", 2, 0)));
    let (won, lost) = if a.is_ok() { (a, b) } else { (b, a) };
    let won = won.unwrap();
    assert_eq!(refused(lost), Code::Aborted);
    let leads = client.labelled(&stream(), &label("canary")).await.unwrap();
    assert_eq!(leads.version, won.version, "no update is lost");

    // Unknown, below, quarantined, and `latest`, which moves by itself.
    for wanted in [set("canary", 9, won.generation), set("latest", 1, 0)] {
        assert_eq!(refused(client.set_label(wanted).await), Code::FailedPrecondition);
    }
    let third = client.set_label(set("canary", 3, won.generation)).await.unwrap();
    let down = client.set_label(set("canary", 1, third.generation)).await;
    assert_eq!(refused(down), Code::FailedPrecondition, "robots never go down");
    client.quarantine(&stream(), 3, "falls on gravel").await.unwrap();
    assert_eq!(refused(client.labelled(&stream(), &label("canary")).await), Code::NotFound);
    assert_eq!(client.labelled(&stream(), &LabelName::latest()).await.unwrap().version, 2);
    assert_eq!(client.manifest(&stream(), None).await.unwrap().version, 2);
    let back = client.set_label(set("demo", 3, 0)).await;
    assert_eq!(refused(back), Code::FailedPrecondition, "quarantined");

    // All of it is there after a restart, with who did it.
    server.stop().await;
    let mut server = Server::start(data.path(), StoreLimits::default()).await;
    let overview = server.client.overview(None).await.unwrap();
    let canary = overview.labels.iter().find(|l| l.label == label("canary")).unwrap();
    assert_eq!((canary.version, canary.by.as_str()), (3, "local"));
    assert_eq!(overview.quarantined[0].reason, "falls on gravel");
    let audit = server.client.audit(0, 0).await.unwrap();
    let what: Vec<&str> = audit.iter().rev().map(|e| e.what.as_str()).collect();
    assert_eq!(what, ["publish", "publish", "publish", "label", "label", "quarantine"]);
    assert!(audit.iter().rev().map(|e| e.number).eq(1..=6));
}

#[tokio::test]
async fn fault_8_stable_needs_robots_or_a_reason_that_is_written_down() {
    let data = tempfile::tempdir().unwrap();
    let limits = StoreLimits { stable_needs: 2, ..StoreLimits::default() };
    let mut server = Server::start(data.path(), limits).await;
    let client = &mut server.client;
    for version in 1..=2 {
        publish(client, &policy(version)).await.unwrap();
    }
    let unproved = client.set_label(set("stable", 1, 0)).await;
    assert_eq!(refused(unproved), Code::FailedPrecondition);
    client.report(report("robot-1", 1, RobotState::Good)).await.unwrap();
    // The same robot twice is one robot, and one that is only trying does not count.
    client.report(report("robot-1", 1, RobotState::Good)).await.unwrap();
    client.report(report("robot-2", 1, RobotState::Trial)).await.unwrap();
    assert_eq!(refused(client.set_label(set("stable", 1, 0)).await), Code::FailedPrecondition);
    client.report(report("robot-2", 1, RobotState::Good)).await.unwrap();
    let proved = client.set_label(set("stable", 1, 0)).await.unwrap();
    // A robot that fell later takes its word back.
    client.report(report("robot-2", 2, RobotState::Failed)).await.unwrap();
    let mut wanted = set("stable", 2, proved.generation);
    wanted.override_reason = Some("demonstration at ten".into());
    client.set_label(wanted).await.unwrap();
    let audit = client.audit(1, 0).await.unwrap();
    assert!(audit[0].detail.contains("overridden: demonstration at ten"), "{audit:?}");
    // Reports about what is not here, and good news as bad ones.
    let mut foreign = report("robot-1", 1, RobotState::Good);
    foreign.sha256 = [1; 32];
    assert_eq!(refused(client.report(foreign).await), Code::NotFound);
    let overview = client.overview(Some(&stream())).await.unwrap();
    assert_eq!(overview.reports.len(), 3);
    server.stop().await;
    let mut server = Server::start(data.path(), limits).await;
    let again = server.client.overview(Some(&stream())).await.unwrap();
    assert_eq!(again.reports, overview.reports);
}

#[tokio::test]
async fn going_back_is_a_new_and_higher_version_with_the_old_bytes() {
    let data = tempfile::tempdir().unwrap();
    let mut server = Server::start(data.path(), StoreLimits::default()).await;
    let client = &mut server.client;
    for version in 1..=3 {
        publish(client, &policy(version)).await.unwrap();
    }
    let old = client.manifest(&stream(), Some(1)).await.unwrap();
    let low = client.revert(reverting(&old, 3, 5), "better").await;
    assert_eq!(refused(low), Code::AlreadyExists);
    let back = client.revert(reverting(&old, 4, 5), "better").await.unwrap();
    assert_eq!((back.manifest.reverts_to, back.manifest.sha256), (Some(1), old.sha256));
    assert_eq!(client.fetch(&back.manifest).await.unwrap(), policy(1).bytes().as_ref());
    assert_eq!(client.labelled(&stream(), &LabelName::latest()).await.unwrap().version, 4);
    // The same again is the same; back to the way back leads to the file's own number.
    assert!(client.revert(reverting(&old, 4, 5), "better").await.unwrap().already_present);
    let further = client.revert(reverting(&back.manifest, 5, 6), "again").await.unwrap();
    assert_eq!(further.manifest.reverts_to, Some(1));
    // Quarantined bytes do not come back under another number.
    client.quarantine(&stream(), 2, "falls").await.unwrap();
    let bad = client.manifest(&stream(), Some(2)).await.unwrap();
    let refused_again = client.revert(reverting(&bad, 6, 7), "no").await;
    assert_eq!(refused(refused_again), Code::FailedPrecondition);
    // Another announcement than the old one's.
    let mut foreign = reverting(&old, 6, 7);
    foreign.contract_hash = [1; 32];
    assert_eq!(refused(client.revert(foreign, "no").await), Code::FailedPrecondition);
}

#[tokio::test]
async fn a_watch_tells_of_labels_and_quarantine_and_resumes_over_them() {
    let data = tempfile::tempdir().unwrap();
    let mut server = Server::start(data.path(), StoreLimits::default()).await;
    let client = &mut server.client;
    publish(client, &policy(1)).await.unwrap();
    let mut watch = client.watch(Some(&stream()), 0).await.unwrap();
    let first = watch.next().await.unwrap().unwrap();
    client.set_label(set("canary", 1, 0)).await.unwrap();
    let moved = watch.next().await.unwrap().unwrap();
    assert!(matches!(&moved.change, WatchChange::LabelMoved(l) if l.label == label("canary")));
    client.quarantine(&stream(), 1, "falls").await.unwrap();
    let gone = watch.next().await.unwrap().unwrap();
    assert!(matches!(&gone.change, WatchChange::Quarantined(q) if q.version == 1));
    assert_eq!([first.generation, moved.generation, gone.generation], [1, 2, 3]);
    let mut resumed = client.watch(None, 1).await.unwrap();
    for expected in [2, 3] {
        assert_eq!(resumed.next().await.unwrap().unwrap().generation, expected);
    }
    // A label that moved twice shows once: whoever missed that asks from the beginning.
    publish(client, &policy(2)).await.unwrap();
    publish(client, &policy(3)).await.unwrap();
    let at = client.set_label(set("demo", 2, 0)).await.unwrap();
    client.set_label(set("demo", 3, at.generation)).await.unwrap();
    let missed = client.watch(None, 3).await;
    assert_eq!(refused(missed.map(drop)), Code::OutOfRange);
}

#[tokio::test]
async fn fault_17_the_server_proves_freshness_to_a_nonce() {
    let data = tempfile::tempdir().unwrap();
    let key = Arc::new(ReleaseKey::from_seed("server-1", &[3; 32]));
    let release = ReleaseKey::from_seed("release", &[4; 32]);
    let trust =
        Trust::parse(&format!("{}\n{}", release.trust_file(), key.trust_lines("fresh_key")))
            .unwrap();
    let options = ServeOptions { fresh_key: Some(key), ..ServeOptions::default() };
    let mut server = Server::start_with(data.path(), StoreLimits::default(), options).await;
    let client = &mut server.client;
    publish(client, &policy(1)).await.unwrap();
    let latest = LabelName::latest();
    let yesterday = client.freshness([1; 32], &stream(), &latest).await.unwrap();
    assert_eq!(trust.check_fresh(&yesterday, &[1; 32], &stream(), &latest), Ok(()));
    publish(client, &policy(2)).await.unwrap();
    assert!(
        matches!(
            trust.check_fresh(&yesterday, &[2; 32], &stream(), &latest),
            Err(Stale::OtherQuestion(_))
        ),
        "replayed"
    );
    let today = client.freshness([2; 32], &stream(), &latest).await.unwrap();
    assert_eq!(trust.check_fresh(&today, &[2; 32], &stream(), &latest), Ok(()));
    assert_eq!((yesterday.said.version, today.said.version), (1, 2));
    server.stop().await;
    // A server without a key says that it cannot.
    let mut server = Server::start(data.path(), StoreLimits::default()).await;
    let none = server.client.freshness([2; 32], &stream(), &latest).await;
    assert_eq!(refused(none), Code::Unimplemented);
}

#[tokio::test]
async fn fault_12_fetches_end_whole_or_go_on_elsewhere_when_the_server_stops() {
    let data = tempfile::tempdir().unwrap();
    let port = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let mut server = Server::on(&port, data.path()).await;
    publish(&mut server.client, &policy(1)).await.unwrap();
    let manifest = server.client.manifest(&stream(), None).await.unwrap();
    let address = server.address;
    let fetches: Vec<_> = (0..50)
        .map(|_| {
            let manifest = manifest.clone();
            tokio::spawn(async move {
                let mut client = RegistryClient::new(&address.to_string()).unwrap();
                client.fetch(&manifest).await
            })
        })
        .collect();
    tokio::time::sleep(Duration::from_millis(5)).await;
    let begun = Instant::now();
    server.stop().await;
    assert!(begun.elapsed() < Duration::from_secs(11), "{:?}", begun.elapsed());
    // The same port again: who was cut off goes on there.
    let _again = Server::on(&port, data.path()).await;
    for fetch in fetches {
        match fetch.await.unwrap() {
            Ok(bytes) => assert_eq!(bytes, policy(1).bytes().as_ref()),
            Err(error) => assert!(error.is_transient(), "{error}"),
        }
    }
}
