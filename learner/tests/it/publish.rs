//! Publishing to a real policy server that is not always there.

use std::net::SocketAddr;
use std::path::Path;
use std::time::{Duration, Instant};

use caudata_chaos_proxy::own_address;
use caudata_config::NetworkConfig;
use caudata_learner::export::{PolicyIdentity, export};
use caudata_learner::network::{ActorCritic, NetworkSpec};
use caudata_learner::normaliser::Scaling;
use caudata_learner::publish::{Notice, Publisher};
use caudata_model::RobotModel;
use caudata_policy::PolicyFile;
use caudata_policy_server::{
    Keepalive, ServeOptions, ServerMetrics, SharedStore, Store, StoreLimits, listen, serve_with,
};
use caudata_proto::registry::StreamName;
use caudata_registry_client::RegistryClient;
use caudata_task::{PolicyContract, TaskConfig};
use caudata_telemetry::Metrics;
use tokio::runtime::Runtime;
use tokio::sync::watch;

const PATIENCE: Duration = Duration::from_secs(60);

fn policy(version: u64) -> PolicyFile {
    policy_of(version, version)
}

/// A policy whose weights depend on `seed`.
fn policy_of(version: u64, seed: u64) -> PolicyFile {
    let robot = Path::new(env!("CARGO_MANIFEST_DIR")).join("../robots/polymander.robot.toml");
    let model = RobotModel::load(&robot).unwrap();
    let contract = PolicyContract::new(&model, &TaskConfig::default()).unwrap();
    let (obs_dim, act_dim) = (contract.obs_dim(), contract.act_dim());
    let spec = NetworkSpec::new(&NetworkConfig::default(), obs_dim, act_dim).unwrap();
    let net = ActorCritic::new(spec, seed, tch::Device::Cpu);
    let identity = PolicyIdentity {
        contract,
        run_id: "test".into(),
        training_commit: String::new(),
        config_hash: String::new(),
        seed: 1,
    };
    export(&net, &Scaling::identity(obs_dim, 10.0), &identity, version, 0).unwrap()
}

/// Serves at `addr` until the sender says stop.
fn server(runtime: &Runtime, addr: SocketAddr, data: &Path) -> watch::Sender<bool> {
    server_with(runtime, addr, data, Keepalive::default())
}

fn server_with(
    runtime: &Runtime,
    addr: SocketAddr,
    data: &Path,
    keepalive: Keepalive,
) -> watch::Sender<bool> {
    let store = Store::open(data, StoreLimits::default()).unwrap();
    let listener = runtime.block_on(listen(addr)).unwrap();
    let (stop, stopped) = watch::channel(false);
    let metrics = ServerMetrics::register(&Metrics::new());
    runtime.spawn(async move {
        let options = ServeOptions { keepalive, ..ServeOptions::default() };
        serve_with(listener, SharedStore::new(store), metrics, stopped, options).await.unwrap();
    });
    stop
}

/// Notices until `enough` of them have come.
fn wait_for(publisher: &Publisher, enough: impl Fn(&[Notice]) -> bool) -> Vec<Notice> {
    let deadline = Instant::now() + PATIENCE;
    let mut heard = Vec::new();
    while !enough(&heard) {
        assert!(Instant::now() < deadline, "{heard:?}");
        heard.extend(publisher.notices());
        std::thread::sleep(Duration::from_millis(10));
    }
    heard
}

fn versions(runtime: &Runtime, addr: SocketAddr) -> Vec<(u64, [u8; 32])> {
    runtime.block_on(async {
        let mut client = RegistryClient::new(&addr.to_string()).unwrap();
        let stream = StreamName::new("test").unwrap();
        let page = client.list(Some(&stream), 0, None).await.unwrap();
        page.manifests.iter().map(|m| (m.version, m.sha256)).collect()
    })
}

#[test]
fn the_latest_policy_arrives_once_the_server_is_there() {
    let runtime = Runtime::new().unwrap();
    let data = tempfile::tempdir().unwrap();
    let addr = own_address();
    let publisher = Publisher::start(&addr.to_string(), "test", None).unwrap();
    publisher.publish(policy(1));
    let failed = |heard: &[Notice]| !heard.is_empty();
    let heard = wait_for(&publisher, failed);
    assert!(matches!(heard[0], Notice::Failed { version: 1, again: true, .. }), "{heard:?}");
    // Two more while nobody listens: only the last of them matters.
    publisher.publish(policy(2));
    publisher.publish(policy(3));
    let _stop = server(&runtime, addr, data.path());
    assert!(publisher.finish(PATIENCE));
    let stored = versions(&runtime, addr);
    assert_eq!(stored.first(), Some(&(3, policy(3).sha256())));
    assert!(!stored.iter().any(|(version, _)| *version == 1), "given up for newer ones");
    let published = |heard: &[Notice]| {
        heard.iter().any(|n| matches!(n, Notice::Published(done) if done.version == 3))
    };
    wait_for(&publisher, published);
}

#[test]
fn a_long_pause_between_two_policies_costs_nothing() {
    let runtime = Runtime::new().unwrap();
    let data = tempfile::tempdir().unwrap();
    let addr = own_address();
    // A server that is soon tired of silent connections.
    let keepalive =
        Keepalive { interval: Duration::from_millis(100), timeout: Duration::from_secs(1) };
    let _stop = server_with(&runtime, addr, data.path(), keepalive);
    let publisher = Publisher::start(&addr.to_string(), "test", None).unwrap();
    publisher.publish(policy(1));
    assert!(publisher.finish(PATIENCE));
    std::thread::sleep(Duration::from_millis(2500));
    publisher.publish(policy(2));
    assert!(publisher.finish(PATIENCE));
    let failed = |notice: &Notice| matches!(notice, Notice::Failed { .. });
    let heard = publisher.notices();
    assert!(!heard.iter().any(failed), "{heard:?}");
    assert_eq!(versions(&runtime, addr).len(), 2);
}

#[test]
fn a_refusal_is_not_tried_again_and_nothing_waits_for_ever() {
    let runtime = Runtime::new().unwrap();
    let data = tempfile::tempdir().unwrap();
    let addr = own_address();
    let _stop = server(&runtime, addr, data.path());
    let publisher = Publisher::start(&addr.to_string(), "test", None).unwrap();
    publisher.publish(policy(5));
    assert!(publisher.finish(PATIENCE));
    // The same version with other bytes: another learner was there first.
    publisher.publish(policy_of(5, 99));
    let refused = |heard: &[Notice]| heard.iter().any(|n| matches!(n, Notice::Failed { .. }));
    let heard = wait_for(&publisher, refused);
    assert!(heard.iter().any(|n| matches!(n, Notice::Failed { version: 5, again: false, .. })));
    assert!(publisher.finish(PATIENCE));
    assert_eq!(versions(&runtime, addr), [(5, policy(5).sha256())]);

    let nobody = Publisher::start(&own_address().to_string(), "test", None).unwrap();
    nobody.publish(policy(1));
    assert!(!nobody.finish(Duration::from_millis(300)));
    // Dropping it gives up what could not be delivered.
    drop(nobody);
    assert!(Publisher::start("nowhere", "test", None).is_err());
    assert!(Publisher::start("127.0.0.1:1", "Not A Stream", None).is_err());
}
