//! A publisher that never pauses, a robot that follows `latest`, a server that is killed and a network that
//! is cut, at random.

use std::collections::BTreeMap;
use std::io::BufReader;
use std::net::SocketAddr;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use crate::common::policies::standing;
use crate::common::watchdog::{PATIENCE, output_within};
use crate::common::{STREAM, perfect_robot, program_on, start, status_of};
use caudata_chaos_proxy::{Dice, Wire};
use caudata_policy::PolicyFile;
use caudata_proto::registry::StreamName;
use caudata_registry_client::{RegistryClient, manifest_of};
use caudata_telemetry::read_announcement;
use serde_json::Value;

/// A process that does not outlive the test, however that ends.
struct Killed(Child);

impl Killed {
    /// SIGKILL, now.
    fn kill(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

impl Drop for Killed {
    fn drop(&mut self) {
        self.kill();
    }
}

/// The server as a process of its own, on one port for good.
fn server(data: &Path, address: Option<SocketAddr>) -> (Killed, SocketAddr) {
    let program =
        Path::new(env!("CARGO_BIN_EXE_caudata-robot")).with_file_name("caudata-policy-server");
    let address = address.unwrap_or_else(|| "127.0.0.1:0".parse().unwrap());
    let mut child = Command::new(program)
        .arg("--data")
        .arg(data)
        // three versions a second: what a robot has said of one must still be there when it has been cut off
        // for a while
        .args(["--addr", &address.to_string(), "--keep", "64"])
        .stdout(Stdio::piped())
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    let mut out = BufReader::new(child.stdout.take().unwrap());
    let bound = read_announcement("policy_server", &mut out).expect("it listens");
    (Killed(child), bound)
}

/// Publishes version after version, each until it is taken; what was published, by version.
fn publish_for(end: Instant, address: SocketAddr, published: &Mutex<BTreeMap<u64, String>>) {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    runtime.block_on(async {
        let mut client = RegistryClient::new(&address.to_string()).unwrap();
        let mut version = 1;
        while Instant::now() < end {
            let file = PolicyFile::parse(Arc::from(standing(version))).unwrap();
            let manifest = manifest_of(StreamName::new(STREAM).unwrap(), &file, 5).unwrap();
            // Before it is taken: a lost answer must not make it look unpublished.
            published.lock().unwrap().insert(version, file.sha256_hex());
            while let Err(error) = client.publish(manifest.clone(), file.bytes()).await {
                assert!(error.is_transient(), "{error}");
                assert!(Instant::now() < end + Duration::from_secs(30), "{error}");
                tokio::time::sleep(Duration::from_millis(100)).await;
            }
            version += 1;
            tokio::time::sleep(Duration::from_millis(300)).await;
        }
    });
}

fn soak(seconds: u64) {
    let folder = tempfile::tempdir().unwrap();
    let (data, state) = (folder.path().join("server"), folder.path().join("state"));
    let (mut child, address) = server(&data, None);
    let wire = Wire::to(address);
    let published = Mutex::new(BTreeMap::new());
    // Two seconds of walking, a second and a half of standing, and so on; every second time it walks for longer
    // than a policy may wait, since the server may be dead when it does.
    let mut table = String::from("t,vx,vy,yaw_rate\n");
    let mut t = 0.0;
    while t < seconds as f64 + 10.0 {
        let walk = if table.lines().count() % 4 == 3 { 7.0 } else { 2.0 };
        table += &format!("{t},0.2,0,0\n{},0,0,0\n", t + walk);
        t += walk + 1.5;
    }
    let commands = folder.path().join("commands.csv");
    std::fs::write(&commands, table).unwrap();
    let end = Instant::now() + Duration::from_secs(seconds);
    let (kills, cuts, output) = std::thread::scope(|scope| {
        scope.spawn(|| publish_for(end, address, &published));
        while published.lock().unwrap().len() < 2 {
            std::thread::sleep(Duration::from_millis(50));
        }
        let mut robot = program_on(STREAM, "run", wire.address, &state);
        robot
            .args(["--follow", "--bus", &format!("sim:{}", perfect_robot())])
            .args([
                "--seconds",
                &seconds.to_string(),
                "--swap-wait",
                "4",
                "--hang-ms",
                "60000",
                "--name",
                "soak-robot",
            ])
            .arg("--commands")
            .arg(&commands);
        robot.stdin(Stdio::null());
        // It walks for so long, and then has as long as any other.
        let patience = Duration::from_secs(seconds) + PATIENCE;
        let robot = scope.spawn(move || output_within(start(robot), patience));
        let (mut dice, mut kills, mut cuts) = (Dice::new(20_261_121), 0, 0);
        while Instant::now() < end && !robot.is_finished() {
            std::thread::sleep(Duration::from_millis(1500 + dice.below(3000)));
            if dice.below(2) == 0 {
                child.kill();
                std::thread::sleep(Duration::from_millis(dice.below(1500)));
                child = server(&data, Some(address)).0;
                kills += 1;
            } else {
                wire.cut();
                std::thread::sleep(Duration::from_millis(dice.below(2000)));
                wire.mend();
                cuts += 1;
            }
        }
        (kills, cuts, robot.join().unwrap())
    });
    let errors = String::from_utf8(output.stderr).unwrap();
    assert!(output.status.success(), "{errors}");
    let summary: Value =
        serde_json::from_str(String::from_utf8(output.stdout).unwrap().lines().last().unwrap())
            .unwrap();
    assert_eq!(summary["ended"], "time", "{summary}");

    let published = published.into_inner().unwrap();
    let lines = errors.lines().filter_map(|line| serde_json::from_str::<Value>(line).ok());
    let mut last = 0;
    let mut swaps = 0;
    for line in lines {
        let fields = &line;
        if fields["message"] != "policy swapped in" {
            continue;
        }
        let version = fields["version"].as_u64().unwrap();
        // Never older, never half: these bytes were published under this number.
        assert!(version > last, "{version} after {last}");
        assert_eq!(fields["sha256"], published[&version].as_str(), "{line}");
        let stage = fields["stage"].as_str().unwrap();
        let standing = fields["commanded"] == "[0.0, 0.0, 0.0]";
        let safe = matches!(stage, "Rise" | "Settle" | "Stand") || (stage == "Walk" && standing);
        assert!(safe, "{line}");
        last = version;
        swaps += 1;
    }
    assert_eq!(summary["policy_swaps"].as_u64().unwrap(), swaps, "every swap was looked at");
    assert!(swaps >= seconds / 12, "{swaps} swaps in {seconds} s");
    assert_eq!(
        summary["policy_version"].as_u64().unwrap(),
        last.max(summary["policy_version"].as_u64().unwrap())
    );
    assert!(kills > 0 && cuts > 0);
    assert!(
        summary["held_actions"] == 0 && summary["stands_for_swap"].as_u64().unwrap() > 0,
        "{summary}"
    );

    // The server's store is whole after all of it, and knows what the robot said.
    child.kill();
    let (mut child, _) = server(&data, Some(address));
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    runtime.block_on(async {
        let mut client = RegistryClient::new(&address.to_string()).unwrap();
        let stream = StreamName::new(STREAM).unwrap();
        for manifest in client.list(Some(&stream), 0, None).await.unwrap().manifests {
            client.fetch(&manifest).await.unwrap();
        }
        let overview = client.overview(Some(&stream)).await.unwrap();
        assert!(overview.reports.iter().any(|r| r.robot == "soak-robot"), "{overview:?}");
    });
    child.kill();
    let state = status_of(&state);
    assert_eq!(state["quarantined"].as_array().unwrap().len(), 0, "{state}");
    println!(
        "{} versions published, {swaps} swapped in ({} after the robot was made to stand), {kills} kills, {cuts} cuts in {seconds} s",
        published.len(),
        summary["stands_for_swap"]
    );
}

/// `make test` has three quarters of a minute for it, `make soak` ten minutes or as long as it is told.
#[test]
fn a_robot_follows_latest_while_the_server_dies_and_the_network_breaks() {
    let seconds = std::env::var("CAUDATA_SOAK_S").ok();
    soak(seconds.map_or(45, |text| text.parse().expect("CAUDATA_SOAK_S: whole seconds")));
}
