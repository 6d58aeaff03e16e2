//! The robot client at the end of a run: pulls the policy from the server and walks the simulated robot with
//! it.

use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use caudata_config::Config;
use caudata_telemetry::{ExitCode, Failure, FailureExt, StopFlag};
use nix::sys::signal::Signal;
use serde::Serialize;
use serde_json::Value;

use super::children::{self, LineSink, Process, Programs};
use super::folder::RunFolder;
use super::start::{failed_child, start_service};
use crate::say;

/// How long the simulated robot may take to start.
const SIMULATOR_START_MAX: Duration = Duration::from_secs(30);
/// Time for pulling, standing up and lying down, on top of the walk itself.
const AROUND_THE_WALK_MAX: Duration = Duration::from_secs(60);
/// How often the client is looked at.
const CLIENT_LOOK_EVERY: Duration = Duration::from_millis(50);

/// What the robot client reported.
#[derive(Clone, Debug, Serialize)]
pub struct RobotRun {
    /// SHA-256 of the policy that it pulled and ran, hex.
    pub policy_sha256: String,
    /// Folder of its log.
    pub log: PathBuf,
    /// Its own summary.
    pub summary: Value,
}

/// Runs `caudata sim robot` and `caudata-robot` for the configured time, with what `label` of the policy server
/// leads to.
pub fn run_robot(
    config: &Config,
    folder: &RunFolder,
    server: &str,
    label: &str,
    stop: &StopFlag,
) -> Result<RobotRun, Failure> {
    let (mut simulator, addr) = start_simulator(folder)?;
    let log = free_name(&folder.robot_log());
    let summary = run_client(config, folder, [server, label], addr, &log, stop);
    simulator.signal(Signal::SIGTERM);
    simulator.finish(Duration::from_secs(5));
    let summary = summary?;
    let policy_sha256 = summary["policy_sha256"].as_str().unwrap_or_default().to_owned();
    Ok(RobotRun { policy_sha256, log, summary })
}

fn start_simulator(folder: &RunFolder) -> Result<(Process, SocketAddr), Failure> {
    let mut command = Command::new(std::env::current_exe().or_exit(ExitCode::Internal)?);
    command.args(["sim", "robot", "--addr", "127.0.0.1:0", "--log-filter", "info"]);
    command.arg("--config").arg(folder.config());
    let log = folder.logs().join("sim_robot.log");
    start_service("the simulated robot", "robot_link", command, &log, SIMULATOR_START_MAX)
}

fn run_client(
    config: &Config,
    folder: &RunFolder,
    [server, label]: [&str; 2],
    simulator: SocketAddr,
    log: &Path,
    stop: &StopFlag,
) -> Result<Value, Failure> {
    let evaluation = &config.evaluation;
    let mut command = Command::new(Programs::beside_this_one()?.find("caudata-robot")?);
    command.args(["run", "--json", "--policy-server", server, "--label", label]);
    command.args(["--stream", config.policy_server.stream_of(folder.run_id())]);
    command.arg("--robot").arg(&config.robot);
    // a robot of its own: one that walked before would not go down to an older version
    command.arg("--state").arg(free_name(&folder.root().join("robot_state")));
    command.args(["--bus", &format!("sim:{simulator}")]);
    command.args(["--command", &format!("{},0,0", evaluation.robot_command_mps)]);
    command.args(["--seconds", &evaluation.robot_run_s.to_string()]);
    command.args(["--terrain", "flat"]);
    command.arg("--log-dir").arg(log);
    let last = Arc::new(Mutex::new(String::new()));
    let keep = Arc::clone(&last);
    let sink: LineSink =
        Box::new(move |line| *keep.lock().unwrap_or_else(PoisonError::into_inner) = line);
    let log = folder.logs().join("robot.log");
    let mut client = Process::start("the robot client", command, &log, Some(sink))?;
    let limit = Duration::from_secs_f64(evaluation.robot_run_s) + AROUND_THE_WALK_MAX;
    let deadline = Instant::now() + limit;
    while client.ended().is_none() && Instant::now() < deadline && !stop.wait(CLIENT_LOOK_EVERY) {}
    client.signal(Signal::SIGTERM);
    let status = client.finish(Duration::from_secs(10));
    if let Some(status) = status.filter(|status| !status.success()) {
        let (code, how) = (children::exit_code(status), children::describe(status));
        return Err(failed_child(&client, code, &how));
    }
    let line = last.lock().unwrap_or_else(PoisonError::into_inner).clone();
    serde_json::from_str(&line)
        .or_exit_with(ExitCode::Protocol, || "the robot client did not print its summary")
}

/// `path`, or `path-2`, `path-3` … when a resumed run has walked before.
fn free_name(path: &Path) -> PathBuf {
    let numbered = |n: u32| PathBuf::from(format!("{}-{n}", path.display()));
    if !path.exists() {
        return path.to_owned();
    }
    (2..).map(numbered).find(|path| !path.exists()).unwrap_or_else(|| path.to_owned())
}

impl RobotRun {
    /// As lines for a person. No speed is judged; what does not last is a warning.
    pub fn print(&self) {
        let summary = &self.summary;
        let number = |value: &Value| value.as_f64();
        let walked = number(&summary["walked_s"]).unwrap_or(0.0);
        let commanded = number(&summary["commanded"]["vx_mps"]).unwrap_or(0.0);
        let ended = summary["ended"].as_str().unwrap_or("unknown");
        say::line(format!(
            "simulated robot: walked {walked:.1} s, {}, commanded {commanded:.2} m/s forward; ended by: {ended}",
            match (number(&summary["distance_m"]), number(&summary["achieved"]["vx_mps"])) {
                (Some(distance), Some(vx)) => format!("{distance:.2} m, {vx:.3} m/s"),
                _ => "no pose known".into(),
            }
        ));
        if ended != "time" && ended != "signal" {
            say::line(format!(
                "warning: this policy does not last on the simulated robot ({ended} after {walked:.1} s), where gravity is \
                 estimated and commands come late: its log is below"
            ));
        }
        let count = |key: &str| summary[key].as_u64().unwrap_or(0);
        say::line(format!(
            "  {} ticks, {} overruns, {} late readings, tick p50 {:.2} ms p99 {:.2} ms",
            count("ticks"),
            count("overruns"),
            count("late_readings"),
            count("tick_p50_us") as f64 / 1e3,
            count("tick_p99_us") as f64 / 1e3
        ));
    }
}
