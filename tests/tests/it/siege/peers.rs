//! Peers that say nothing, too little, or too much.

use std::io::{Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::time::Duration;

use anyhow::{Context, Result, ensure};
use caudata_chaos_proxy::own_address;
use caudata_proto::wire::registry as wire;
use caudata_proto::wire::registry::policy_registry_client::PolicyRegistryClient;
use caudata_tests::{command, finish};

use super::lab::{Lab, RELEASED, Running, ended_with, listening, shell, started};

/// No honest caller waits longer for an answer than a busy machine needs.
const ANSWER_MAX: Duration = Duration::from_secs(60);

fn hold(address: SocketAddr, count: usize) -> Vec<TcpStream> {
    // One that is refused at once is not held, and no worse for that.
    (0..count).filter_map(|_| TcpStream::connect_timeout(&address, ANSWER_MAX).ok()).collect()
}

/// The status line and body of a page.
fn get(address: SocketAddr, path: &str) -> Result<String> {
    let mut stream = TcpStream::connect_timeout(&address, ANSWER_MAX)?;
    stream.set_read_timeout(Some(ANSWER_MAX))?;
    write!(stream, "GET {path} HTTP/1.1\r\nHost: x\r\nConnection: close\r\n\r\n")?;
    let mut answer = String::new();
    stream.read_to_string(&mut answer).context(path.to_owned())?;
    Ok(answer)
}

struct Doors {
    server: Running,
    metrics: SocketAddr,
    page: SocketAddr,
}

fn doors(lab: &Lab) -> Result<Doors> {
    let (metrics, page) = (own_address(), own_address());
    let (m, p) = (metrics.to_string(), page.to_string());
    let server = lab.serve(&lab.data()?, &["--metrics-addr", &m, "--page-addr", &p])?;
    Ok(Doors { server, metrics, page })
}

fn answers(lab: &Lab, doors: &Doors) -> Result<()> {
    let health = get(doors.metrics, "/healthz")?;
    ensure!(health.starts_with("HTTP/1.1 200"), "{health}");
    ensure!(get(doors.metrics, "/metrics")?.contains("caudata_"));
    ensure!(get(doors.page, "/")?.contains(RELEASED));
    let state = lab.fresh()?.join("state");
    ended_with(&[0], &finish(lab.pull(doors.server.address, &state)?)?)
}

/// Every listener of a policy server, and that of a simulated robot.
pub fn silent(lab: &Lab, times: usize) -> Result<String> {
    let doors = doors(lab)?;
    let robot = started("caudata", "robot_link", &["sim", "robot", "--addr", "127.0.0.1:0"])?;
    let each = 60 * times;
    let held = [doors.server.address, doors.metrics, doors.page].map(|door| hold(door, each));
    answers(lab, &doors)?;
    // It takes one client at a time: beyond the kernel's queue of 128 it is the attacker who waits.
    let queued = each.min(100);
    drop(hold(robot.address, queued));
    let run = ["--bus".to_owned(), format!("sim:{}", robot.address)];
    let (server, state) = (doors.server.address.to_string(), lab.fresh()?.join("state"));
    let mut walk = command("caudata-robot", &["run", "--robot", super::lab::ROBOT])?;
    walk.args(run).args(["--policy-server", &server, "--stream", RELEASED]);
    walk.args(["--seconds", "0.2", "--hang-ms", "60000", "--state"]).arg(state);
    ended_with(&[0], &finish(walk)?)?;
    let held: usize = held.iter().map(Vec::len).sum();
    Ok(format!("{held} held on three doors, {queued} came and went at the robot; all answered"))
}

/// Headers of which a byte comes now and then.
pub fn dripping(lab: &Lab, times: usize) -> Result<String> {
    let doors = doors(lab)?;
    let mut slow: Vec<TcpStream> = [doors.metrics, doors.page, doors.server.address]
        .into_iter()
        .flat_map(|door| hold(door, 40))
        .collect();
    for byte in b"GET /healthz HT".iter().cycle().take(15 * times) {
        slow.retain_mut(|stream| stream.write_all(&[*byte]).is_ok());
        answers(lab, &doors)?;
    }
    Ok("all answered between the drops".to_owned())
}

/// The server where neither it nor its parent may have more than 128 files.
pub fn few_files(lab: &Lab, times: usize) -> Result<String> {
    let (data, metrics) = (lab.data()?, own_address());
    let (folder, m) = (data.display().to_string(), metrics.to_string());
    let key = lab.text("fresh.key");
    let args = ["--data", &folder, "--addr", "127.0.0.1:0", "--metrics-addr", &m];
    let fresh = ["--fresh-key", &key, "--fresh-key-id", "fresh-1"];
    let args = [&args[..], &fresh].concat();
    let limited = shell("ulimit -n 128", "caudata-policy-server", &args)?;
    let server = listening(limited, "policy_server")?;
    for number in 0..times {
        let idle = hold(server.address, 300);
        let state = lab.fresh()?.join("state");
        ended_with(&[0], &finish(lab.pull(server.address, &state)?)?)?;
        lab.release(&server, "1", &format!("release/few-{number}"))?;
        drop(idle);
    }
    let health = get(metrics, "/healthz")?;
    ensure!(health.starts_with("HTTP/1.1 200"), "{health}");
    Ok("fetched and published beside 300 idle connections; healthy".to_owned())
}

/// Reports without a pause.
pub fn chatty_robot(lab: &Lab, times: usize) -> Result<String> {
    let data = lab.data()?;
    let server = lab.serve(&data, &[])?;
    let before = std::fs::metadata(data.join("audit.jsonl"))?.len();
    let address = format!("http://{}", server.address);
    let count = 100 * times;
    let taken: usize = tokio::runtime::Runtime::new()?.block_on(async {
        let mut client = PolicyRegistryClient::connect(address).await?;
        let asked = wire::GetManifestRequest {
            stream: RELEASED.to_owned(),
            version: Some(1),
            ..wire::GetManifestRequest::default()
        };
        let answer = client.get_manifest(asked).await?.into_inner();
        let manifest = answer.manifest.context("a manifest")?;
        let mut taken = 0;
        for number in 0..count {
            let report = wire::RobotReport {
                robot: "chatty".to_owned(),
                stream: RELEASED.to_owned(),
                version: 1,
                sha256: manifest.sha256.clone(),
                state: wire::robot_report::State::Trial.into(),
                attempts: 1 + number as u32,
                ..wire::RobotReport::default()
            };
            match client.ack(report).await {
                Ok(_) => taken += 1,
                Err(status) => {
                    ensure!(
                        status.code() == tonic::Code::ResourceExhausted,
                        "refused otherwise: {status}"
                    );
                }
            }
        }
        Ok::<usize, anyhow::Error>(taken)
    })?;
    let grown = std::fs::metadata(data.join("audit.jsonl"))?.len() - before;
    ensure!(taken < count, "all {count} reports were taken");
    ensure!(grown < 100_000, "the record grew by {grown} bytes");
    Ok(format!("{taken} of {count} reports taken, the record grew by {grown} bytes"))
}
