//! Connections that say nothing, fetches that nobody reads, a process with few file handles, and a disk that
//! fails for a while.

use std::io::{BufRead, BufReader};
use std::net::TcpStream;
use std::process::{Command, Stdio};
use std::sync::Arc;
use std::time::Duration;

use caudata_policy_server::{ServeOptions, Store, StoreLimits};
use caudata_proto::wire::registry::FetchRequest;
use caudata_proto::wire::registry::policy_registry_client::PolicyRegistryClient;
use caudata_registry_client::RegistryClient;
use caudata_rehearsal::Rehearsal;
use caudata_telemetry::ConnectionLimits;
use tonic::Code;

use crate::common::{Server, code, policy, policy_of, publish, stream};

#[tokio::test]
async fn silent_connections_keep_nobody_out() {
    let data = tempfile::tempdir().unwrap();
    let connections = ConnectionLimits { total: 8, per_peer: 8 };
    let options = ServeOptions { connections, ..ServeOptions::default() };
    let mut server = Server::start_with(data.path(), StoreLimits::default(), options).await;
    publish(&mut server.client, &policy(1)).await.unwrap();
    let mut watch = server.client.watch(Some(&stream()), 0).await.unwrap();
    watch.next().await.unwrap();
    let silent: Vec<_> = (0..40).map(|_| TcpStream::connect(server.address).unwrap()).collect();
    for version in 2..4 {
        let mut another = RegistryClient::new(&server.address.to_string()).unwrap();
        publish(&mut another, &policy(version)).await.unwrap();
        // Who made calls kept its place.
        watch.next().await.unwrap().unwrap();
    }
    drop((silent, watch));
    server.stop().await;
}

/// The program itself, where neither it nor its parent may have more than so many files.
#[test]
fn a_process_with_few_file_handles_serves_on_beside_idle_connections() {
    let data = tempfile::tempdir().unwrap();
    let program = env!("CARGO_BIN_EXE_caudata-policy-server");
    let line = format!(
        "ulimit -n 128; exec {program} --data {} --addr 127.0.0.1:0",
        data.path().display()
    );
    let mut server = Command::new("sh")
        .args(["-c", &line])
        .stdout(Stdio::piped())
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    let mut out = BufReader::new(server.stdout.take().unwrap());
    let address = caudata_telemetry::read_announcement("policy_server", &mut out).unwrap();
    let runtime = tokio::runtime::Runtime::new().unwrap();
    let worked = runtime.block_on(async {
        let mut client = RegistryClient::new(&address.to_string()).unwrap();
        publish(&mut client, &policy(1)).await.unwrap();
        let idle: Vec<_> = (0..300).map(|_| TcpStream::connect(address).unwrap()).collect();
        for version in 2..5 {
            let mut client = RegistryClient::new(&address.to_string()).unwrap();
            let manifest = client.manifest(&stream(), Some(1)).await.unwrap();
            let fetched = client.fetch(&manifest).await.unwrap();
            assert_eq!(fetched, policy(1).bytes().as_ref());
            publish(&mut client, &policy(version)).await.unwrap();
        }
        idle.len()
    });
    server.kill().unwrap();
    server.wait().unwrap();
    let mut rest = String::new();
    while out.read_line(&mut rest).unwrap() > 0 {}
    assert_eq!(worked, 300);
}

#[tokio::test]
async fn fetches_that_nobody_reads_are_bounded() {
    let data = tempfile::tempdir().unwrap();
    let mut server = Server::start(data.path(), StoreLimits::default()).await;
    // Far more than one piece.
    let file = policy_of(1, Some(512));
    publish(&mut server.client, &file).await.unwrap();
    let request =
        FetchRequest { sha256: file.sha256().to_vec(), offset: 0, if_none_match: Vec::new() };
    let (mut held, mut refused) = (Vec::new(), 0);
    let address = format!("http://{}", server.address);
    for _ in 0..10 {
        let channel = tonic::transport::Endpoint::new(address.clone())
            .unwrap()
            // The client takes next to nothing by itself.
            .initial_stream_window_size(1)
            .connect()
            .await
            .unwrap();
        let mut client = PolicyRegistryClient::new(channel);
        for _ in 0..30 {
            match client.fetch(request.clone()).await {
                Ok(answer) => held.push(answer.into_inner()),
                Err(status) => {
                    assert_eq!(status.code(), Code::Unavailable, "{status}");
                    refused += 1;
                }
            }
        }
    }
    assert_eq!((held.len(), refused), (256, 44));
    drop(held);
    // Their places are free again.
    let manifest = server.client.manifest(&stream(), None).await.unwrap();
    server.client.fetch(&manifest).await.unwrap();
    server.stop().await;
}

#[tokio::test]
async fn a_store_that_cannot_write_says_so_and_comes_back_by_itself() {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path().join("data");
    std::fs::create_dir(&root).unwrap();
    let disk = Arc::new(Rehearsal::new(&root).unwrap());
    let store = Store::open_on(&root, StoreLimits::default(), disk.clone()).unwrap();
    let options =
        ServeOptions { probe_pause: Duration::from_millis(20), ..ServeOptions::default() };
    let mut server = Server::over("127.0.0.1:0".parse().unwrap(), store, options).await;
    publish(&mut server.client, &policy(1)).await.unwrap();
    for (version, fail) in [
        (2, Rehearsal::fail_syncs_at as fn(&Rehearsal, usize, i32)),
        (3, Rehearsal::fail_writes_at),
        (4, Rehearsal::fail_opens_at),
    ] {
        fail(&disk, 0, 5);
        let error = publish(&mut server.client, &policy(version)).await;
        assert_eq!(code(&error.unwrap_err()), Code::Unavailable);
        assert!(server.trouble.borrow().is_some());
        assert_eq!(server.metrics.read_only.get(), 1);
        // What there is is served meanwhile.
        let manifest = server.client.manifest(&stream(), Some(1)).await.unwrap();
        server.client.fetch(&manifest).await.unwrap();
        disk.heal();
        server.trouble.wait_for(Option::is_none).await.unwrap();
        publish(&mut server.client, &policy(version)).await.unwrap();
        assert_eq!(server.metrics.read_only.get(), 0);
    }
    server.stop().await;
}
