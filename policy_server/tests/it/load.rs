//! Many watchers: how long until the last one hears of a version, what each costs, what slow ones do to the
//! others, and how they come back after the server died.

use std::io::BufReader;
use std::net::SocketAddr;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering::SeqCst};
use std::time::{Duration, Instant};

use crate::common::{policy, publish, stream};
use caudata_policy_server::ServeOptions;
use caudata_proto::registry::WatchChange;
use caudata_registry_client::{RegistryClient, jittered};
use caudata_telemetry::read_announcement;
use tokio::sync::mpsc;

/// Kills the server when dropped.
struct Server {
    child: Child,
    address: SocketAddr,
}

impl Server {
    fn start(data: &Path, address: &str) -> Self {
        let mut child = Command::new(env!("CARGO_BIN_EXE_caudata-policy-server"))
            .arg("--data")
            .arg(data)
            .args(["--addr", address])
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn()
            .unwrap();
        let mut out = BufReader::new(child.stdout.take().unwrap());
        let address = read_announcement("policy_server", &mut out).expect("it listens");
        Self { child, address }
    }

    /// Memory in use, bytes.
    fn resident(&self) -> u64 {
        let status = std::fs::read_to_string(format!("/proc/{}/status", self.child.id())).unwrap();
        let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:")).unwrap();
        1024 * line.trim().trim_end_matches(" kB").parse::<u64>().unwrap()
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Watches for good, coming back as robots do; tells each version that it hears of, and when.
async fn watcher(address: SocketAddr, heard: mpsc::Sender<(u64, Instant)>, open: Arc<AtomicU64>) {
    let mut client = RegistryClient::new(&address.to_string()).unwrap();
    let mut pause = Duration::from_millis(500);
    loop {
        if let Ok(mut watch) = client.watch(Some(&stream()), 0).await {
            let mut counted = false;
            while let Ok(Some(event)) = watch.next().await {
                pause = Duration::from_millis(500);
                let newest = match event.change {
                    WatchChange::Snapshot(all) => all.first().map(|m| m.version),
                    WatchChange::Published(manifest) => Some(manifest.version),
                    _ => None,
                };
                if !counted {
                    open.fetch_add(1, SeqCst);
                    counted = true;
                }
                if let Some(version) = newest
                    && heard.send((version, Instant::now())).await.is_err()
                {
                    return;
                }
            }
            if counted {
                open.fetch_sub(1, SeqCst);
            }
        }
        tokio::time::sleep(jittered(pause)).await;
        pause = (pause * 2).min(Duration::from_secs(30));
    }
}

/// Waits until all `n` have heard of `version`; how long after `from` that was for each, sorted.
async fn all_heard(
    heard: &mut mpsc::Receiver<(u64, Instant)>,
    n: usize,
    version: u64,
    from: Instant,
) -> Vec<Duration> {
    let mut took = Vec::with_capacity(n);
    while took.len() < n {
        let (found, at) = heard.recv().await.unwrap();
        if found == version {
            took.push(at.saturating_duration_since(from));
        }
    }
    took.sort();
    took
}

fn quantile(mut values: Vec<Duration>, q: f64) -> Duration {
    values.sort();
    values[((values.len() - 1) as f64 * q).round() as usize]
}

async fn load(n: usize, rounds: u64) {
    let folder = tempfile::tempdir().unwrap();
    let server = Server::start(folder.path(), "127.0.0.1:0");
    let address = server.address;
    let mut client = RegistryClient::new(&address.to_string()).unwrap();
    publish(&mut client, &policy(1)).await.unwrap();
    let alone = server.resident();
    let (heard_by, mut heard) = mpsc::channel(4 * n);
    let open = Arc::new(AtomicU64::new(0));
    for _ in 0..n {
        tokio::spawn(watcher(address, heard_by.clone(), open.clone()));
    }
    all_heard(&mut heard, n, 1, Instant::now()).await;
    let each = server.resident().saturating_sub(alone) / n as u64;

    let mut version = 1;
    let mut lasts = Vec::new();
    let mut all = Vec::new();
    let round =
        async |version: &mut u64, heard: &mut mpsc::Receiver<_>, client: &mut RegistryClient| {
            *version += 1;
            let file = policy(*version);
            let begun = Instant::now();
            publish(client, &file).await.unwrap();
            all_heard(heard, n, *version, begun).await
        };
    for _ in 0..rounds {
        let took = round(&mut version, &mut heard, &mut client).await;
        lasts.push(*took.last().unwrap());
        all.extend(took);
    }
    let (p50, p99, last) = (quantile(all.clone(), 0.5), quantile(all, 0.99), quantile(lasts, 0.99));
    println!(
        "{n} watchers, {each} bytes each; publish to delivery p50 {p50:?}, p99 {p99:?}, to the last one p99 {last:?}"
    );

    // A tenth as many watchers that never read.
    let mut sleepers = Vec::new();
    for _ in 0..n / 10 {
        let mut sleeper = RegistryClient::new(&address.to_string()).unwrap();
        let watch = sleeper.watch(None, 0).await.unwrap();
        sleepers.push((sleeper, watch));
    }
    let before = server.resident();
    let mut slowed = Vec::new();
    for _ in 0..rounds {
        slowed.extend(round(&mut version, &mut heard, &mut client).await);
    }
    let slowed = quantile(slowed, 0.99);
    let grown = server.resident().saturating_sub(before);
    println!("with {} that never read: p99 {slowed:?}, memory + {grown} bytes", n / 10);
    // Half of what it takes the server to give up on who never reads: nobody waited for that.
    assert!(
        slowed < ServeOptions::default().reply_idle / 2,
        "{slowed:?} against {p99:?}: slow readers hold the others up"
    );
    drop(sleepers);

    // The server dies and comes back: all find it again, and the true newest version.
    drop(server);
    let _server = Server::start(folder.path(), &address.to_string());
    let begun = Instant::now();
    while heard.try_recv().is_ok() {}
    let took = all_heard(&mut heard, n, version, begun).await;
    println!("after a restart all {n} were back after {:?}", took.last().unwrap());
    assert!(each < 200 << 10, "{each} bytes per watcher");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn faults_10_and_11_a_hundred_watchers_hear_of_versions_and_come_back() {
    load(100, 5).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "a thousand connections: make test-faults"]
async fn faults_10_and_11_a_thousand_watchers_hear_of_versions_and_come_back() {
    load(1000, 20).await;
}
