//! The service from the outside: a real server on a port of its own, talked to through the client that
//! everybody uses.

use std::sync::Arc;

use crate::common::{Server, code, policy, publish, stream};
use caudata_policy::{PolicyFile, build_onnx};
use caudata_policy_server::{ServeOptions, StoreLimits, listen};
use caudata_proto::registry::WatchChange;
use caudata_registry_client::manifest_of;
use tonic::Code;

/// Limits that keep so many versions.
fn keep(versions_kept: usize) -> StoreLimits {
    StoreLimits { versions_kept, ..StoreLimits::default() }
}

#[tokio::test]
async fn what_is_published_comes_back_byte_for_byte_also_after_a_restart() {
    let data = tempfile::tempdir().unwrap();
    let mut server = Server::start(data.path(), keep(8)).await;
    let file = policy(1);
    assert!(!publish(&mut server.client, &file).await.unwrap());
    assert!(publish(&mut server.client, &file).await.unwrap(), "a repeat is the same version");
    server.stop().await;

    let mut server = Server::start(data.path(), keep(8)).await;
    let manifest = server.client.manifest(&stream(), None).await.unwrap();
    assert_eq!(manifest.sha256, file.sha256());
    assert_eq!(manifest.env_steps, 10);
    assert_eq!(server.client.fetch(&manifest).await.unwrap(), file.bytes().as_ref());
    server.stop().await;
}

/// All files below `folder`, with their sizes.
fn files(folder: &std::path::Path) -> Vec<(std::path::PathBuf, u64)> {
    let mut found = Vec::new();
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        match path.is_dir() {
            true => found.extend(files(&path)),
            false => found.push((path.clone(), std::fs::metadata(&path).unwrap().len())),
        }
    }
    found.sort();
    found
}

#[tokio::test]
async fn fault_13_a_publisher_that_dies_in_the_middle_leaves_nothing() {
    use caudata_proto::wire::registry as wire;
    use caudata_proto::wire::registry::policy_registry_client::PolicyRegistryClient;
    use caudata_proto::wire::registry::publish_request::Part;

    let data = tempfile::tempdir().unwrap();
    let mut server = Server::start(data.path(), keep(8)).await;
    publish(&mut server.client, &policy(1)).await.unwrap();
    let before = files(data.path());
    let file = policy(2);
    let whole = file.bytes().len();
    for got in [0, 1, whole / 2, whole - 1] {
        let address = format!("http://{}", server.address);
        let mut raw = PolicyRegistryClient::connect(address).await.unwrap();
        let (to, messages) = tokio::sync::mpsc::channel(1);
        let publishing = tokio::spawn(async move {
            let messages = tokio_stream::wrappers::ReceiverStream::new(messages);
            raw.publish(messages).await
        });
        let manifest = manifest_of(stream(), &file, 5).unwrap();
        let header = Part::Header(manifest.into());
        let bytes = Part::Data(file.bytes()[..got].to_vec());
        // The last one leaves when there is room for it: the ones before are on their way then.
        for part in [header, bytes, Part::Data(Vec::new())] {
            let part = Some(part);
            let _ = to.send(wire::PublishRequest { part }).await;
        }
        // Not an end in order: the connection goes with it.
        publishing.abort();
        let _ = publishing.await;
        drop(to);
        let page = server.client.list(Some(&stream()), 0, None).await.unwrap();
        let versions: Vec<u64> = page.manifests.iter().map(|m| m.version).collect();
        assert_eq!(versions, [1], "{got} bytes came");
        assert_eq!(files(data.path()), before, "{got} bytes came");
    }
    // Its place is free for one that does not die.
    assert!(!publish(&mut server.client, &file).await.unwrap());
    let manifest = server.client.manifest(&stream(), None).await.unwrap();
    assert_eq!(manifest.version, 2);
    server.stop().await;
}

#[tokio::test]
async fn fault_13_an_upload_that_goes_silent_is_ended_and_leaves_nothing() {
    use caudata_proto::wire::registry as wire;
    use caudata_proto::wire::registry::policy_registry_client::PolicyRegistryClient;
    use caudata_proto::wire::registry::publish_request::Part;

    // What it is unless told otherwise is what the page says.
    let unless_told = ServeOptions::default().upload_idle;
    assert_eq!(unless_told, std::time::Duration::from_secs(30));
    let data = tempfile::tempdir().unwrap();
    let options =
        ServeOptions { upload_idle: std::time::Duration::from_secs(2), ..ServeOptions::default() };
    let mut server = Server::start_with(data.path(), keep(8), options).await;
    publish(&mut server.client, &policy(1)).await.unwrap();
    let before = files(data.path());
    let file = policy(2);
    // Silent from the beginning, after the header, and in the middle of the file; the connection stays.
    for parts in 0..3 {
        let address = format!("http://{}", server.address);
        let mut raw = PolicyRegistryClient::connect(address).await.unwrap();
        let (to, messages) = tokio::sync::mpsc::channel(4);
        let manifest = manifest_of(stream(), &file, 5).unwrap();
        let all = [
            Part::Header(manifest.into()),
            Part::Data(file.bytes()[..file.bytes().len() / 2].to_vec()),
        ];
        for part in all.into_iter().take(parts) {
            let part = Some(part);
            to.send(wire::PublishRequest { part }).await.unwrap();
        }
        let messages = tokio_stream::wrappers::ReceiverStream::new(messages);
        let answer = raw.publish(messages).await.unwrap_err();
        // The publisher's end is still open here.
        drop(to);
        assert_eq!(answer.code(), Code::DeadlineExceeded, "{parts}: {answer}");
        assert!(answer.message().contains("stalled"), "{answer}");
        assert_eq!(files(data.path()), before, "{parts} parts came");
    }
    // Its number was not taken.
    assert!(!publish(&mut server.client, &file).await.unwrap());
    server.stop().await;
}

#[tokio::test]
async fn refusals_have_their_own_codes() {
    let data = tempfile::tempdir().unwrap();
    let mut server = Server::start(data.path(), keep(8)).await;
    let client = &mut server.client;
    publish(client, &policy(1)).await.unwrap();

    // The same version with other bytes.
    let other = policy(2);
    let mut manifest = manifest_of(stream(), &other, 5).unwrap();
    manifest.version = 1;
    let error = client.publish(manifest, other.bytes()).await.unwrap_err();
    assert_eq!(code(&error), Code::InvalidArgument, "header and file disagree: {error}");

    // Bytes that are no policy at all.
    let mut manifest = manifest_of(stream(), &other, 5).unwrap();
    let garbage = vec![7; other.bytes().len()];
    let error = client.publish(manifest.clone(), &garbage).await.unwrap_err();
    assert_eq!(code(&error), Code::InvalidArgument, "{error}");

    // Fewer and more bytes than announced.
    let short = &other.bytes()[..100];
    let error = client.publish(manifest.clone(), short).await.unwrap_err();
    assert_eq!(code(&error), Code::InvalidArgument, "{error}");
    manifest.size -= 1;
    let error = client.publish(manifest, other.bytes()).await.unwrap_err();
    assert_eq!(code(&error), Code::InvalidArgument, "{error}");

    // Unknown things.
    let error = client.manifest(&stream(), Some(99)).await.unwrap_err();
    assert!(error.is_not_found(), "{error}");
    let mut unknown = manifest_of(stream(), &other, 5).unwrap();
    unknown.sha256 = [1; 32];
    assert!(client.fetch(&unknown).await.unwrap_err().is_not_found());

    // Nothing of all this became visible.
    let page = client.list(None, 0, None).await.unwrap();
    assert_eq!(page.manifests.len(), 1);
    server.stop().await;
}

#[tokio::test]
async fn lists_come_in_pages_newest_first() {
    let data = tempfile::tempdir().unwrap();
    let mut server = Server::start(data.path(), keep(8)).await;
    for version in 1..=5 {
        publish(&mut server.client, &policy(version)).await.unwrap();
    }
    let name = stream();
    let page = server.client.list(Some(&name), 2, None).await.unwrap();
    let versions: Vec<u64> = page.manifests.iter().map(|m| m.version).collect();
    assert_eq!((versions, page.more), (vec![5, 4], true));
    let page = server.client.list(Some(&name), 0, Some(4)).await.unwrap();
    let versions: Vec<u64> = page.manifests.iter().map(|m| m.version).collect();
    assert_eq!((versions, page.more), (vec![3, 2, 1], false));
    server.stop().await;
}

#[tokio::test]
async fn fault_10_a_watcher_that_stops_reading_is_told_that_it_lags_and_others_miss_nothing() {
    /// Far more than wait for one watcher: two megabytes that its connection takes unread, eight in its
    /// queue, 64 changes behind that.
    const VERSIONS: u64 = 240;
    let data = tempfile::tempdir().unwrap();
    let mut server = Server::start(data.path(), keep(VERSIONS as usize)).await;
    let client = |address: std::net::SocketAddr| {
        caudata_registry_client::RegistryClient::new(&address.to_string()).unwrap()
    };
    // Connections of their own, as robots have.
    let (mut one, mut other) = (client(server.address), client(server.address));
    let mut silent = one.watch(Some(&stream()), 0).await.unwrap();
    let mut reads = other.watch(Some(&stream()), 0).await.unwrap();
    for version in 1..=VERSIONS {
        let file = policy(version);
        let mut manifest = manifest_of(stream(), &file, 5).unwrap();
        // Large announcements: a connection takes few of them unread.
        manifest.evaluation_json = Some(format!("{{\"note\":\"{}\"}}", "x".repeat(60_000)));
        server.client.publish(manifest, file.bytes()).await.unwrap();
        // Who reads hears of each version as it comes.
        let heard = loop {
            let event = reads.next().await.unwrap().unwrap();
            match event.change {
                WatchChange::Published(manifest) => break manifest.version,
                _ => continue,
            }
        };
        assert_eq!(heard, version);
    }
    // The other one wakes up: what waited for it, without a gap, and then that it missed the rest.
    let mut last = 0;
    let error = loop {
        match silent.next().await {
            Ok(Some(event)) => match event.change {
                WatchChange::Published(manifest) => {
                    assert_eq!(manifest.version, last + 1);
                    last = manifest.version;
                }
                WatchChange::Snapshot(_) | WatchChange::Progress => {}
                other => panic!("after version {last}: {other:?}"),
            },
            Ok(None) => panic!("it is not told why, after version {last}"),
            Err(error) => break error,
        }
    };
    assert_eq!(code(&error), Code::ResourceExhausted, "{error}");
    assert!(last < VERSIONS - 64, "{last} versions waited for it");
    // It watches again, and is where the others are.
    let mut again = one.watch(Some(&stream()), 0).await.unwrap();
    let event = again.next().await.unwrap().unwrap();
    assert!(
        matches!(&event.change, WatchChange::Snapshot(all) if all[0].version == VERSIONS),
        "{event:?}"
    );
    drop((silent, reads, again));
    server.stop().await;
}

#[tokio::test]
async fn fault_10_a_watcher_that_never_reads_loses_its_place_and_what_waits_for_it() {
    /// More than its connection takes unread and its queue holds, and fewer than it may lag behind that.
    const VERSIONS: u64 = 80;
    let unless_told = ServeOptions::default().reply_idle;
    assert_eq!(unless_told, std::time::Duration::from_secs(60));
    let data = tempfile::tempdir().unwrap();
    let options = ServeOptions {
        reply_idle: std::time::Duration::from_millis(300),
        ..ServeOptions::default()
    };
    let mut server = Server::start_with(data.path(), keep(VERSIONS as usize), options).await;
    let mut one =
        caudata_registry_client::RegistryClient::new(&server.address.to_string()).unwrap();
    let mut silent = one.watch(Some(&stream()), 0).await.unwrap();
    let watchers = server.metrics.watchers.clone();
    assert_eq!(watchers.get(), 1);
    for version in 1..=VERSIONS {
        let file = policy(version);
        let mut manifest = manifest_of(stream(), &file, 5).unwrap();
        manifest.evaluation_json = Some(format!("{{\"note\":\"{}\"}}", "x".repeat(60_000)));
        server.client.publish(manifest, file.bytes()).await.unwrap();
    }
    let end = std::time::Instant::now() + std::time::Duration::from_secs(120);
    while watchers.get() > 0 {
        assert!(std::time::Instant::now() < end, "it keeps its place");
        tokio::time::sleep(std::time::Duration::from_millis(10)).await;
    }
    // It wakes up after all: what its connection had taken, without a gap, and then what became of it.
    let mut last = 0;
    let error = loop {
        match silent.next().await {
            Ok(Some(event)) => {
                if let WatchChange::Published(manifest) = event.change {
                    assert_eq!(manifest.version, last + 1);
                    last = manifest.version;
                }
            }
            Ok(None) => panic!("it is not told why, after version {last}"),
            Err(error) => break error,
        }
    };
    assert_eq!(code(&error), Code::ResourceExhausted, "{error}");
    assert!(error.to_string().contains("nothing of the answer was read"), "{error}");
    assert!(last < VERSIONS - 8, "{last} versions waited for it");
    // It is welcome again.
    let mut again = one.watch(Some(&stream()), 0).await.unwrap();
    let event = again.next().await.unwrap().unwrap();
    assert!(
        matches!(&event.change, WatchChange::Snapshot(all) if all[0].version == VERSIONS),
        "{event:?}"
    );
    drop((silent, again));
    server.stop().await;
}

#[tokio::test]
async fn a_watch_begins_with_a_snapshot_and_resumes_without_gaps() {
    let data = tempfile::tempdir().unwrap();
    let mut server = Server::start(data.path(), keep(2)).await;
    let name = stream();
    publish(&mut server.client, &policy(1)).await.unwrap();

    let mut watch = server.client.watch(Some(&name), 0).await.unwrap();
    let first = watch.next().await.unwrap().unwrap();
    assert!(
        matches!(&first.change, WatchChange::Snapshot(all) if all.len() == 1 && all[0].version == 1)
    );
    publish(&mut server.client, &policy(2)).await.unwrap();
    let second = watch.next().await.unwrap().unwrap();
    assert!(matches!(&second.change, WatchChange::Published(m) if m.version == 2));
    drop(watch);

    // From generation 1 on nothing is missing; the server still knows version 2.
    let mut watch = server.client.watch(Some(&name), first.generation).await.unwrap();
    let event = watch.next().await.unwrap().unwrap();
    assert!(matches!(&event.change, WatchChange::Published(m) if m.version == 2));
    drop(watch);

    // Two more publications retire version 2 (two are kept): generation 1 is forgotten.
    for version in [3, 4] {
        publish(&mut server.client, &policy(version)).await.unwrap();
    }
    let error = server.client.watch(Some(&name), first.generation).await.unwrap_err();
    assert_eq!(code(&error), Code::OutOfRange, "{error}");
    server.stop().await;
}

#[tokio::test]
async fn health_and_reflection_answer() {
    let data = tempfile::tempdir().unwrap();
    let server = Server::start(data.path(), keep(2)).await;
    let address = format!("http://{}", server.client.address());
    let channel =
        tonic::transport::Endpoint::from_shared(address).unwrap().connect().await.unwrap();
    let mut health = tonic_health::pb::health_client::HealthClient::new(channel.clone());
    let request = tonic_health::pb::HealthCheckRequest {
        service: "caudata.registry.v1.PolicyRegistry".into(),
    };
    let status = health.check(request).await.unwrap().into_inner().status;
    assert_eq!(status, i32::from(tonic_health::pb::health_check_response::ServingStatus::Serving));

    use tonic_reflection::pb::v1 as reflection;
    let mut client = reflection::server_reflection_client::ServerReflectionClient::new(channel);
    let request = reflection::ServerReflectionRequest {
        host: String::new(),
        message_request: Some(reflection::server_reflection_request::MessageRequest::ListServices(
            String::new(),
        )),
    };
    let mut answers =
        client.server_reflection_info(tokio_stream::iter([request])).await.unwrap().into_inner();
    let answer = answers.message().await.unwrap().unwrap();
    let text = format!("{answer:?}");
    assert!(text.contains("caudata.registry.v1.PolicyRegistry"), "{text}");
    drop(answers);
    drop(client);
    server.stop().await;
}

#[tokio::test]
async fn a_stopping_server_ends_its_watches_and_a_taken_port_is_named() {
    let data = tempfile::tempdir().unwrap();
    let mut server = Server::start(data.path(), keep(2)).await;
    let address = server.client.address().to_owned();
    let taken = listen(address.parse().unwrap()).await.unwrap_err();
    assert!(taken.to_string().contains(&address), "{taken}");

    let mut watch = server.client.watch(None, 0).await.unwrap();
    watch.next().await.unwrap().unwrap();
    server.stop.send(true).unwrap();
    let error = watch.next().await.unwrap_err();
    assert!(error.is_transient(), "{error}");
    drop(watch);
    drop(server.client);
    server.ended.await.unwrap();
}

#[tokio::test]
async fn many_publishers_of_one_version_agree_on_one_winner() {
    let data = tempfile::tempdir().unwrap();
    let server = Server::start(data.path(), keep(8)).await;
    // Same version, different bytes: env_steps differs, so the files do.
    let tasks: Vec<_> = (0..8u64)
        .map(|variant| {
            let mut client = server.client.clone();
            tokio::spawn(async move {
                let file = policy(1);
                let spec = file.spec().clone();
                let mut metadata = file.metadata().clone();
                metadata.env_steps = variant;
                let bytes = build_onnx(&spec, &metadata).unwrap();
                let file = PolicyFile::parse(Arc::from(bytes)).unwrap();
                publish(&mut client, &file).await
            })
        })
        .collect();
    let mut won = 0;
    for task in tasks {
        match task.await.unwrap() {
            Ok(already_present) => {
                assert!(!already_present);
                won += 1;
            }
            Err(error) => assert_eq!(code(&error), Code::AlreadyExists, "{error}"),
        }
    }
    assert_eq!(won, 1);
    server.stop().await;
}
