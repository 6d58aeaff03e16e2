//! A policy server in this process, a robot made of perfect servos on a TCP port, and the program under test.
// Each test file uses a part of it.
#![allow(dead_code)]

#[path = "../../../src/testing.rs"]
pub mod policies;
pub mod watchdog;

use std::io::Read;
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::path::Path;
use std::process::{Child, Command, ExitStatus, Output, Stdio};
use std::sync::Arc;

use caudata_policy::PolicyFile;
use caudata_policy_server::{
    ServeOptions, ServerMetrics, SharedStore, Store, StoreLimits, listen, serve_with,
};
use caudata_proto::framing::{FrameReader, write_frame};
use caudata_proto::registry::StreamName;
use caudata_proto::robot_link::{
    BasePose, Hello, MAX_MESSAGE_BYTES, RobotMessage, Sensors, decode, encode,
};
use caudata_registry_client::{RegistryClient, manifest_of};
use caudata_telemetry::Metrics;
use serde_json::Value;
use tokio::runtime::Runtime;
use tokio::sync::watch;
use tokio::task::JoinHandle;
use watchdog::{PATIENCE, Watchdog, output_within};

/// Stream that tests use where it does not matter.
pub const STREAM: &str = "test";

/// A policy server; dropped or stopped, it is gone and its port closed.
pub struct Server {
    pub address: SocketAddr,
    runtime: Runtime,
    stop: watch::Sender<bool>,
    ended: JoinHandle<()>,
}

impl Server {
    pub fn start(data: &Path) -> Self {
        Self::start_with(data, ServeOptions::default())
    }

    /// One that proves where labels lead.
    pub fn proving(data: &Path, key: caudata_signing::ReleaseKey) -> Self {
        let options = ServeOptions { fresh_key: Some(Arc::new(key)), ..ServeOptions::default() };
        Self::start_with(data, options)
    }

    fn start_with(data: &Path, options: ServeOptions) -> Self {
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .worker_threads(1)
            .enable_all()
            .build()
            .unwrap();
        let store = Store::open(data, StoreLimits::default()).unwrap();
        let (stop, stopped) = watch::channel(false);
        let (address, ended) = runtime.block_on(async {
            let listener = listen("127.0.0.1:0".parse().unwrap()).await.unwrap();
            let address = listener.local_addr().unwrap();
            let metrics = ServerMetrics::register(&Metrics::new());
            let store = SharedStore::new(store);
            let serving = async move {
                serve_with(listener, store, metrics, stopped, options).await.unwrap();
            };
            (address, tokio::spawn(serving))
        });
        Self { address, runtime, stop, ended }
    }

    pub fn publish(&self, bytes: Vec<u8>) {
        self.publish_to(STREAM, bytes);
    }

    /// Publishes with a signature.
    pub fn publish_signed(&self, bytes: Vec<u8>, key: &caudata_signing::ReleaseKey) {
        let file = PolicyFile::parse(Arc::from(bytes)).unwrap();
        let mut manifest = manifest_of(StreamName::new(STREAM).unwrap(), &file, 5).unwrap();
        key.sign(&mut manifest);
        let address = self.address.to_string();
        self.runtime.block_on(async move {
            let mut client = RegistryClient::new(&address).unwrap();
            client.publish(manifest, file.bytes()).await.unwrap();
        });
    }

    /// A stream takes policies of one contract only.
    pub fn publish_to(&self, stream: &str, bytes: Vec<u8>) {
        let file = PolicyFile::parse(Arc::from(bytes)).unwrap();
        let manifest = manifest_of(StreamName::new(stream).unwrap(), &file, 5).unwrap();
        let address = self.address.to_string();
        self.runtime.block_on(async move {
            let mut client = RegistryClient::new(&address).unwrap();
            client.publish(manifest, file.bytes()).await.unwrap();
        });
    }

    pub fn stop(self) {
        self.stop.send(true).unwrap();
        self.runtime.block_on(self.ended).unwrap();
    }
}

/// Serves one client after the other with servos that are at once where they are sent, walking 4 mm per tick.
pub fn perfect_robot() -> SocketAddr {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = listener.local_addr().unwrap();
    std::thread::spawn(move || {
        for stream in listener.incoming() {
            serve_robot(stream.unwrap());
        }
    });
    address
}

fn serve_robot(mut stream: TcpStream) {
    let model = policies::model();
    let names = model.actuated_names();
    let hello = Hello {
        robot_name: model.name().to_owned(),
        robot_hash: model.hash(),
        joint_names: names.into_iter().map(str::to_owned).collect(),
        control_period_s: 0.02,
    };
    let mut sensors = Sensors {
        tick: 0,
        time_s: 0.0,
        joint_pos_rad: model.nominal_pos_rad().iter().map(|&q| q as f32).collect(),
        joint_vel_radps: vec![0.0; 16],
        current_a: vec![0.0; 16],
        supply_v: 12.0,
        gyro_radps: [0.0; 3],
        acc_mps2: [0.0, 0.0, 9.81],
        imu_gravity: None,
        base_pose: Some(BasePose { pos_m: [0.0, 0.0, 0.1], quat_wxyz: [1.0, 0.0, 0.0, 0.0] }),
        foot_contacts: Some(0b1111),
        in_water: None,
    };
    let send = |stream: &mut TcpStream, message| {
        let _ = write_frame(stream, &encode(&message), MAX_MESSAGE_BYTES);
    };
    let mut reader = FrameReader::new(MAX_MESSAGE_BYTES);
    while let Ok(Some(payload)) = reader.read(&mut stream) {
        match decode(payload).unwrap() {
            RobotMessage::Hello(_) => {
                send(&mut stream, RobotMessage::Hello(Box::new(hello.clone())));
            }
            RobotMessage::Command(command) => {
                sensors.tick = command.tick;
                sensors.time_s = 0.02 * command.tick as f64;
                if command.torque_enabled {
                    let moved = command.targets_rad.iter().zip(&sensors.joint_pos_rad);
                    sensors.joint_vel_radps = moved.map(|(to, from)| (to - from) / 0.02).collect();
                    sensors.joint_pos_rad = command.targets_rad;
                }
                let x_m = 0.004 * command.tick as f32;
                sensors.base_pose.as_mut().unwrap().pos_m[0] = x_m;
            }
            RobotMessage::Sensors(_) => panic!("robots send readings, programs do not"),
        }
        send(&mut stream, RobotMessage::Sensors(Box::new(sensors.clone())));
    }
}

/// The program under test: this build's, or the one that `CAUDATA_ROBOT_PROGRAM` names, such as that of another
/// processor (`make test-arm`).
pub fn robot_program() -> Command {
    let named = std::env::var_os("CAUDATA_ROBOT_PROGRAM");
    Command::new(named.unwrap_or_else(|| env!("CARGO_BIN_EXE_caudata-robot").into()))
}

/// The program with `command` and what every call needs.
pub fn program(command: &str, server: SocketAddr, state: &Path) -> Command {
    program_on(STREAM, command, server, state)
}

/// The same on another stream.
pub fn program_on(stream: &str, command: &str, server: SocketAddr, state: &Path) -> Command {
    let mut program = robot_program();
    program
        .args([command, "--robot", policies::ROBOT_FILE.as_str(), "--stream", stream])
        .args(["--policy-server", &server.to_string()])
        .arg("--state")
        .arg(state)
        .arg("--json")
        .args(["--log-format", "json"]);
    program
}

/// Exit code, last line of standard output as JSON (null without one), and standard error.
pub fn outcome(mut command: Command) -> (i32, Value, String) {
    command.stdin(Stdio::null());
    ended(start(command))
}

/// Starts the program and leaves it running.
pub fn start(mut command: Command) -> Child {
    command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap()
}

/// As [`outcome`], of a program that is running.
pub fn ended(child: Child) -> (i32, Value, String) {
    let output = output_of(child);
    let text = String::from_utf8(output.stdout).unwrap();
    let errors = String::from_utf8(output.stderr).unwrap();
    let Some(code) = output.status.code() else {
        panic!("ended by {}: {errors}", output.status);
    };
    let json = text.lines().last().map_or(Value::Null, |line| serde_json::from_str(line).unwrap());
    (code, json, errors)
}

/// What a program says until it ends, which it must.
pub fn output_of(child: Child) -> Output {
    output_within(child, PATIENCE)
}

/// How a program ends, which it must.
pub fn end_of(child: &mut Child) -> ExitStatus {
    let _dog = Watchdog::over(child);
    child.wait().unwrap()
}

/// The `error: …` lines of a program.
pub fn error_lines(stderr: &str) -> Vec<&str> {
    stderr.lines().filter(|line| line.starts_with("error: ")).collect()
}

/// What a file holds.
pub fn text_of(path: &Path) -> String {
    let mut text = String::new();
    let mut file = std::fs::File::open(path).unwrap();
    file.read_to_string(&mut text).unwrap();
    text
}

/// What the robot's folder says.
pub fn status_of(state: &Path) -> Value {
    let mut command = robot_program();
    command.args(["status", "--json", "--state"]).arg(state);
    outcome(command).1
}
