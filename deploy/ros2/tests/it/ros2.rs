//! Our messages and logs through a real ROS 2: rclpy over Fast DDS, all on this computer. Skipped, with a
//! message, where `CAUDATA_ROS2_PYTHON` names no Python that has it.

use std::io::{BufRead, BufReader, Write};
use std::path::Path;
use std::process::{Child, Command, Stdio};

use caudata_ros2::wire::{BATTERY_STATE, DIAGNOSTIC_ARRAY, IMU, JOINT_STATE, TWIST};
use caudata_runlog::ros::messages::{
    BatteryState, DiagnosticArray, DiagnosticStatus, Header, Imu, JointState, PoseStamped, Twist,
    TwistStamped,
};
use caudata_runlog::ros::{Compression, parse_mcap, write_mcap};
use caudata_runlog::{RunLog, Table};
use serde_json::{Value, json};

/// `ros2_counterpart.py` at work.
struct Counterpart {
    child: Child,
    said: BufReader<std::process::ChildStdout>,
}

/// A script of this folder in the Python that has ROS 2, where there is one.
pub(crate) fn counterpart(script: &str) -> Option<Command> {
    let Some(python) = std::env::var_os("CAUDATA_ROS2_PYTHON") else {
        // Past what the test harness captures.
        let _ = writeln!(
            std::io::stderr(),
            "skipped: CAUDATA_ROS2_PYTHON names no Python with ROS 2 (`make test-faults` installs one)"
        );
        return None;
    };
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/it");
    let mut command = Command::new(python);
    command.arg(folder.join(script));
    Some(command)
}

impl Counterpart {
    fn start() -> Option<Self> {
        let mut child = counterpart("ros2_counterpart.py")?
            .env("RMW_IMPLEMENTATION", "rmw_fastrtps_cpp")
            .env("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
            .env("ROS_DOMAIN_ID", "77")
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let said = BufReader::new(child.stdout.take().unwrap());
        Some(Self { child, said })
    }

    fn ask(&mut self, question: &Value) -> Value {
        let mut to = self.child.stdin.as_ref().unwrap();
        writeln!(to, "{question}").unwrap();
        let mut line = String::new();
        self.said.read_line(&mut line).unwrap();
        serde_json::from_str(&line).unwrap_or_else(|_| panic!("no answer to {question}: {line:?}"))
    }
}

impl Drop for Counterpart {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|b| format!("{b:02x}")).collect()
}

fn unhex(text: &str) -> Vec<u8> {
    let digits = text.as_bytes().chunks(2);
    let digits = digits.map(|two| std::str::from_utf8(two).unwrap());
    digits.map(|two| u8::from_str_radix(two, 16).unwrap()).collect()
}

fn header() -> Header {
    Header { stamp_ns: 1_500_000_002, frame: "base".to_owned() }
}

/// Whether bytes are a message to us.
type Reads = Box<dyn Fn(&[u8]) -> bool>;

/// A message of ours, what ROS must find in it, and whether bytes that ROS wrote are that message to us.
struct Row {
    name: &'static str,
    hash: Option<&'static str>,
    ours: Vec<u8>,
    fields: Value,
    is_theirs: Reads,
}

macro_rules! row {
    ($kind:ident, $name:expr, $hash:expr, $message:expr, $fields:expr) => {{
        let message: $kind = $message;
        Row {
            name: $name,
            hash: $hash,
            ours: message.encode(),
            fields: $fields,
            is_theirs: Box::new(move |bytes| {
                $kind::decode(bytes).is_ok_and(|theirs| theirs == message)
            }),
        }
    }};
}

fn vector([x, y, z]: [f64; 3]) -> Value {
    json!({ "x": x, "y": y, "z": z })
}

fn rows() -> Vec<Row> {
    let stamp = json!({ "stamp": { "sec": 1, "nanosec": 500_000_002 }, "frame_id": "base" });
    let quarter = std::f64::consts::FRAC_1_SQRT_2;
    let none = [0.0; 9];
    vec![
        row!(
            JointState,
            JointState::TYPE,
            Some(JOINT_STATE.hash),
            JointState {
                header: header(),
                name: vec!["hip".to_owned(), "knee é".to_owned()],
                position: vec![1.0, -0.25],
                velocity: vec![],
                effort: vec![1e-300, 0.5],
            },
            json!({ "header": stamp, "name": ["hip", "knee é"], "position": [1.0, -0.25], "velocity": [],
                "effort": [1e-300, 0.5] })
        ),
        row!(
            Imu,
            Imu::TYPE,
            Some(IMU.hash),
            Imu {
                header: header(),
                orientation_wxyz: Some([quarter, 0.0, 0.0, quarter]),
                gyro_radps: [0.125, 0.25, -0.5],
                acc_mps2: [0.0, -1.0, 9.75],
            },
            json!({ "header": stamp, "orientation": { "x": 0.0, "y": 0.0, "z": quarter, "w": quarter },
                "orientation_covariance": none, "angular_velocity": vector([0.125, 0.25, -0.5]),
                "angular_velocity_covariance": none, "linear_acceleration": vector([0.0, -1.0, 9.75]),
                "linear_acceleration_covariance": none })
        ),
        row!(
            BatteryState,
            BatteryState::TYPE,
            Some(BATTERY_STATE.hash),
            BatteryState { header: header(), voltage_v: 12.5 },
            json!({ "header": stamp, "voltage": 12.5, "temperature": "nan", "current": "nan", "charge": "nan",
                "capacity": "nan", "design_capacity": "nan", "percentage": "nan", "power_supply_status": 0,
                "power_supply_health": 0, "power_supply_technology": 0, "present": true, "cell_voltage": [],
                "cell_temperature": [], "location": "", "serial_number": "" })
        ),
        row!(
            PoseStamped,
            PoseStamped::TYPE,
            None,
            PoseStamped {
                header: header(),
                position_m: [1.0, 2.0, 3.0],
                orientation_wxyz: [0.5, -0.5, 0.5, -0.5],
            },
            json!({ "header": stamp, "pose": { "position": vector([1.0, 2.0, 3.0]),
                "orientation": { "x": -0.5, "y": 0.5, "z": -0.5, "w": 0.5 } } })
        ),
        row!(
            TwistStamped,
            TwistStamped::TYPE,
            None,
            TwistStamped {
                header: header(),
                linear_mps: [0.1, 0.2, 0.3],
                angular_radps: [-1.0, 0.0, 1.0],
            },
            json!({ "header": stamp, "twist": { "linear": vector([0.1, 0.2, 0.3]),
                "angular": vector([-1.0, 0.0, 1.0]) } })
        ),
        row!(
            Twist,
            TWIST.name,
            Some(TWIST.hash),
            Twist { linear_mps: [0.25, 0.0, 0.0], angular_radps: [0.0, 0.0, -0.5] },
            json!({ "linear": vector([0.25, 0.0, 0.0]), "angular": vector([0.0, 0.0, -0.5]) })
        ),
        row!(
            DiagnosticArray,
            DIAGNOSTIC_ARRAY.name,
            Some(DIAGNOSTIC_ARRAY.hash),
            DiagnosticArray {
                header: header(),
                status: vec![DiagnosticStatus {
                    level: DiagnosticStatus::ERROR,
                    name: "hip".to_owned(),
                    message: "hot".to_owned(),
                    hardware_id: String::new(),
                    values: vec![("T".to_owned(), "69".to_owned())],
                }],
            },
            json!({ "header": stamp, "status": [{ "level": 2, "name": "hip", "message": "hot",
                "hardware_id": "", "values": [{ "key": "T", "value": "69" }] }] })
        ),
    ]
}

#[test]
#[ignore = "installs ROS 2: make test-faults"]
fn every_message_goes_through_ros_and_back() {
    let Some(mut ros) = Counterpart::start() else {
        return;
    };
    eprintln!(
        "| message | ours read by ROS | ROS's read by us | hash of the type |\n|---|---|---|---|"
    );
    for row in rows() {
        let answer = ros.ask(&json!({ "type": row.name, "cdr": hex(&row.ours) }));
        assert_eq!(answer["fields"], row.fields, "{}", row.name);
        let theirs = unhex(answer["cdr"].as_str().unwrap());
        assert!((row.is_theirs)(&theirs), "{}: {}", row.name, answer["cdr"]);
        if let Some(hash) = row.hash {
            assert_eq!(answer["hash"], hash, "{}", row.name);
        }
        let hash = row.hash.map_or("not ours to know", |_| "equal");
        eprintln!("| `{}` | equal | equal | {hash} |", row.name);
    }
}

#[test]
#[ignore = "installs ROS 2: make test-faults"]
fn a_log_played_and_recorded_by_ros_is_the_log_that_diagnosis_reads() {
    let Some(mut ros) = Counterpart::start() else {
        return;
    };
    let text = "t,cmd.FL_hip,pos.FL_hip,vel.FL_hip,pos.FR_hip,tau.FR_hip,cur.FL_hip,volt,imu.gyro.x,imu.gyro.y,imu.gyro.z,\
         imu.acc.x,imu.acc.y,imu.acc.z,base.pos.x,base.pos.y,base.pos.z\n\
         0.5,0.1,0.05,1.5,-0.2,0.3,0.25,12.5,0.1,0.2,0.3,0.5,-0.5,9.8,1,2,3\n\
         0.52,0.2,,,,,,,,,,,,,,,\n\
         0.54,,0.06,,,,,12.25,0.1,0.2,0.3,0.5,-0.5,9.8,1,2,3\n";
    let log = Table::parse("log.csv", text.as_bytes()).unwrap();
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    let start_ns = 1_700_000_000_000_000_000;
    let bag = write_mcap(&log, start_ns, Some(Compression::Zstd), None).unwrap();
    let before = parse_mcap("ours.mcap", &bag).unwrap();
    let played = tempfile::tempdir().unwrap();
    let source = played.path().join("ours.mcap");
    std::fs::write(&source, bag).unwrap();
    let answer = ros.ask(&json!({ "play": source, "record": path("recorded.mcap") }));
    assert!(answer["messages"].as_u64().unwrap() > 5, "{answer}");

    // As diagnosis takes it: a folder with a bag and what is known of the robot.
    let known = "robot = \"polymander\"\nbase = \"free\"\nrate_hz = 50\n";
    std::fs::write(path("log.toml"), known).unwrap();
    let after = RunLog::read(folder.path()).unwrap().table;
    assert_eq!(after.signals(), before.signals());
    assert_eq!(after.time_s(), before.time_s());
    for signal in before.signals() {
        assert_eq!(after.column(signal), before.column(signal), "{signal}");
    }
}
