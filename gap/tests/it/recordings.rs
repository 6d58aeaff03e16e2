//! Recordings of ROS 2 and LeRobot as logs: files of other people's libraries (`fixtures/make.py`), and what a
//! stranger does wrong.

use std::path::{Path, PathBuf};

use caudata_gap::import::map::Map;
use caudata_gap::import::{Format, Imported, draft, open, read};
use caudata_model::RobotModel;
use caudata_runlog::ros::messages::{
    BatteryState, Header, Imu, JointState, JointTrajectory, Odometry, TrajectoryPoint,
};
use caudata_runlog::ros::parse_mcap;
use caudata_runlog::{RunLog, Signal};
use mcap::records::MessageHeader;

fn fixture(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures").join(name)
}

fn robot(name: &str) -> RobotModel {
    let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../robots");
    RobotModel::load(&Path::new(folder).join(format!("{name}.robot.toml"))).unwrap()
}

fn drafted(path: &Path, robot: &RobotModel) -> String {
    let format = Format::guess(path).unwrap();
    draft::map(&open(path, format, None).unwrap(), robot).unwrap().map
}

fn imported(path: &Path, map: &str, robot: &RobotModel) -> Result<Vec<Imported>, String> {
    let map = Map::parse("map.toml", map).map_err(|e| e.to_string())?;
    let format = Format::guess(path).unwrap();
    read(path, format, Some(&map), robot).map_err(|e| e.to_string())
}

fn value(run: &Imported, row: usize, signal: &str) -> f64 {
    let signal: Signal = signal.parse().unwrap();
    let place = run.signals.iter().position(|s| *s == signal).unwrap();
    run.rows[row].1[place].unwrap()
}

fn has(text: &str, all: &[&str]) {
    for said in all {
        assert!(text.contains(said), "`{said}` is not in: {text}");
    }
}

/// Whether the Python that reads Parquet files can; what is left out where it cannot runs with the wheel's tests
/// (`python/tests/test_recordings.py`), which bring one along.
fn has_pyarrow() -> bool {
    let found = python("import pyarrow, numpy", &[]);
    if !found {
        eprintln!("skipped: CAUDATA_PYTHON, or else python3, has no pyarrow");
    }
    found
}

/// Whether a script runs to its end.
fn python(script: &str, arguments: &[&std::ffi::OsStr]) -> bool {
    let python = std::env::var_os("CAUDATA_PYTHON").unwrap_or_else(|| "python3".into());
    let mut command = std::process::Command::new(python);
    let output = command.args(["-c", script]).args(arguments).output();
    output.unwrap().status.success()
}

/// An SQLite bag: joint states with stamps, commands without, a topic that says nothing.
#[test]
fn a_bag_becomes_a_log_by_its_draft() {
    let (path, robot) = (fixture("bag.db3"), robot("xl330_pendulum"));
    let draft = drafted(&path, &robot);
    has(
        &draft,
        &[
            "column = \"stamp\"",
            "/arm/commands has none and counts by receipt, which is 2.0 ms later at the others",
            "signal = \"cmd.swing\"\ncolumn = \"/arm/commands/data[0]\"\nunit = \"rad\"",
            "signal = \"pos.swing\"\ncolumn = \"/joint_states/position/swing\"\nunit = \"rad\"",
            "signal = \"vel.swing\"\ncolumn = \"/joint_states/velocity/swing\"\nunit = \"rad/s\"",
            "# not read: \"/joint_states/position/elbow\", as none of the robot's joints",
            "# not read: /rosout (std_msgs/msg/String, 8 messages)",
        ],
    );
    let runs = imported(&path, &draft, &robot).unwrap();
    let [run] = runs.as_slice() else { panic!("{} runs", runs.len()) };
    // eight states, one in 20 ms, and 2 ms behind each a command
    assert_eq!((run.name.as_str(), run.rows.len()), ("bag", 16));
    assert!((run.meta.rate_hz - 50.0).abs() < 1e-3, "{}", run.meta.rate_hz);
    assert!((run.rows[3].0 - 0.022).abs() < 1e-6);
    assert!((value(run, 2, "pos.swing") - 0.01).abs() < 1e-12);
    assert!((value(run, 3, "cmd.swing") - 0.11).abs() < 1e-12);
    let unused = [
        "/rosout (std_msgs/msg/String, 8 messages)",
        "/joint_states/position/elbow",
        "/joint_states/velocity/elbow",
    ];
    assert_eq!(run.unused, unused);
    let dir = tempfile::tempdir().unwrap();
    let log = RunLog::read(&run.write(dir.path()).unwrap()).unwrap();
    assert_eq!(log.table.len(), 16);
}

/// Two episodes in degrees beside a gripper in percent, of a robot with more joints.
#[test]
fn a_dataset_becomes_a_log_of_each_episode() {
    if !has_pyarrow() {
        return;
    }
    let (path, robot) = (fixture("lerobot"), robot("xl330_pendulum"));
    let draft = drafted(&path, &robot);
    has(
        &draft,
        &[
            "The largest of its angles is 120.00, taken for degrees",
            "`timestamp` is the frame's number over 50 Hz",
            "signal = \"cmd.swing\"\ncolumn = \"action/swing.pos\"\nunit = \"deg\"",
            "signal = \"pos.swing\"\ncolumn = \"observation.state/swing.pos\"\nunit = \"deg\"",
            "# not read: \"action/gripper.pos\", as none of the robot's joints",
            "# not read: observation.images.front (video)",
        ],
    );
    let runs = imported(&path, &draft, &robot).unwrap();
    let names: Vec<(&str, usize)> = runs.iter().map(|r| (r.name.as_str(), r.rows.len())).collect();
    assert_eq!(names, [("lerobot_episode_000000", 12), ("lerobot_episode_000001", 8)]);
    assert!((value(&runs[1], 7, "pos.swing") - 0.07).abs() < 1e-6);
    assert!((value(&runs[1], 7, "cmd.swing") - 0.17).abs() < 1e-6);
    assert!((runs[1].rows[7].0 - 0.14).abs() < 1e-6);
    has(
        &runs[0].unused.join(" "),
        &["observation.images.front", "next.done", "action/gripper.pos"],
    );
}

/// What a number of a share of a joint's range is nobody knows who does not say where its ends are.
#[test]
fn shares_of_a_range_need_its_ends() {
    if !has_pyarrow() {
        return;
    }
    let (path, robot) = (fixture("lerobot"), robot("xl330_pendulum"));
    let draft = drafted(&path, &robot);
    let share = draft.replace("unit = \"deg\"", "unit = \"-100..100\"");
    let error = imported(&path, &share, &robot).unwrap_err();
    has(&error, &["cmd.swing: unit `-100..100` is a share", "`range = [low, high]`"]);
    let open = draft.replace("unit = \"deg\"", "unit = \"?\"");
    has(&imported(&path, &open, &robot).unwrap_err(), &["its unit is not known"]);
    // -100 is -1 rad and 100 is 3 rad: a share of x is 1 + 0.02 x
    let ends = share.replace("\"-100..100\"", "\"-100..100\"\nrange = [-1.0, 3.0]");
    let runs = imported(&path, &ends, &robot).unwrap();
    let want = 1.0 + 0.02 * 0.07f64.to_degrees();
    assert!((value(&runs[0], 7, "pos.swing") - want).abs() < 1e-6);
    let ends = draft.replace("\"deg\"", "\"deg\"\nrange = [-1.0, 3.0]");
    has(&imported(&path, &ends, &robot).unwrap_err(), &["`range` is for the units"]);
}

/// Angles up to 100 may be degrees as well as shares: the draft does not decide, and says what it would take.
#[test]
fn a_draft_does_not_decide_what_the_numbers_leave_open() {
    if !has_pyarrow() {
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    let folder = dir.path().join("set");
    std::fs::create_dir_all(folder.join("meta")).unwrap();
    std::fs::create_dir_all(folder.join("data")).unwrap();
    let info = |feature: &str| {
        format!("{{\"codebase_version\": \"v2.1\", \"fps\": 30, \"features\": {{{feature}}}}}")
    };
    let scalar = |name: &str| {
        format!(
            "\"{name}\": {{\"dtype\": \"float32\", \"shape\": [1], \"names\": [\"swing.pos\"]}}"
        )
    };
    let write = |scale: f64| {
        let features = [scalar("action"), scalar("observation.state")].join(",");
        std::fs::write(folder.join("meta/info.json"), info(&features)).unwrap();
        let columns = "{'action': v, 'observation.state': v, 'episode_index': [3.0] * 5}";
        let script = format!(
            "import sys, pyarrow as pa, pyarrow.parquet as pq; v = [{scale} * k for k in range(5)]; \
             pq.write_table(pa.table({columns}), sys.argv[1])"
        );
        assert!(python(&script, &[folder.join("data/a.parquet").as_os_str()]));
    };
    let robot = robot("xl330_pendulum");
    write(20.0);
    let draft = drafted(&folder, &robot);
    has(&draft, &["unit = \"?\"", "fits degrees as well as shares"]);
    has(&imported(&folder, &draft, &robot).unwrap_err(), &["its unit is not known"]);
    write(0.2);
    let draft = drafted(&folder, &robot);
    has(&draft, &["unit = \"rad\"", "taken for radians"]);
    let runs = imported(&folder, &draft, &robot).unwrap();
    assert_eq!(runs[0].name, "set_episode_000003");
    // without a time, the number over the rate
    assert!((runs[0].rows[4].0 - 4.0 / 30.0).abs() < 1e-12);
}

/// An MCAP of messages: (topic, type, received ns, bytes).
fn bag(dir: &Path, messages: &[(&str, &str, u64, Vec<u8>)]) -> PathBuf {
    let mut w = mcap::Writer::new(std::io::Cursor::new(Vec::new())).unwrap();
    for (topic, kind, log_time, data) in messages {
        let schema = w.add_schema(kind, "ros2msg", b"").unwrap();
        let channel_id = w.add_channel(schema, topic, "cdr", &Default::default()).unwrap();
        let (log_time, publish_time) = (*log_time, *log_time);
        let header = MessageHeader { channel_id, sequence: 0, log_time, publish_time };
        w.write_to_known_channel(&header, data).unwrap();
    }
    w.finish().unwrap();
    let path = dir.join("run.mcap");
    std::fs::write(&path, w.into_inner().into_inner()).unwrap();
    path
}

fn header(stamp_ns: i64) -> Header {
    Header { stamp_ns, frame: String::new() }
}

fn state(stamp_ns: i64, name: &[&str], position: Vec<f64>) -> Vec<u8> {
    let name = name.iter().map(|n| (*n).to_owned()).collect();
    JointState { header: header(stamp_ns), name, position, ..JointState::default() }.encode()
}

const JOINTS: &str = "sensor_msgs/msg/JointState";

/// From 0 to 1 rad in 0.1 s, and after 0.05 s back to 0 in 0.1 s: straight in between, and the second begins where
/// the first was.
#[test]
fn a_trajectory_is_followed_until_the_next() {
    let dir = tempfile::tempdir().unwrap();
    let go = |stamp_ns, to: &[f64]| {
        let point = |(k, x): (usize, &f64)| TrajectoryPoint {
            position: vec![*x],
            after: (0, 100_000_000 * k as u32),
            ..TrajectoryPoint::default()
        };
        let first = 2 - to.len();
        let points = to.iter().enumerate().map(|(k, x)| point((k + first, x))).collect();
        JointTrajectory { header: header(stamp_ns), name: vec!["swing".to_owned()], points }
            .encode()
    };
    let topic = "/arm_controller/joint_trajectory";
    let s = 1_000_000_000;
    let messages = [
        (topic, JointTrajectory::TYPE, 9 * s as u64, go(s, &[0.0, 1.0])),
        (topic, JointTrajectory::TYPE, 9 * s as u64, go(s + 50_000_000, &[0.0])),
        ("/joint_states", JOINTS, 9 * s as u64, state(s, &["swing"], vec![0.2])),
    ];
    let (path, robot) = (bag(dir.path(), &messages), robot("xl330_pendulum"));
    let run = &imported(&path, &drafted(&path, &robot), &robot).unwrap()[0];
    let place = run.signals.iter().position(|x| *x == Signal::Command("swing".to_owned())).unwrap();
    let asked: Vec<(f64, f64)> = run.rows.iter().filter_map(|r| Some((r.0, r.1[place]?))).collect();
    for (t, want) in [(0.0, 0.0), (0.04, 0.4), (0.1, 0.25), (0.15, 0.0)] {
        let got = asked.iter().find(|(at, _)| (at - t).abs() < 1e-6).unwrap().1;
        assert!((got - want).abs() < 0.051, "{t}: {got}, not {want}");
    }
    assert!(asked.iter().all(|(t, _)| *t < 0.1501), "{asked:?}");
}

/// Everything at once, on a robot that walks: an IMU, a battery, odometry.
#[test]
fn a_free_robot_has_its_other_sensors() {
    let dir = tempfile::tempdir().unwrap();
    let imu = Imu {
        header: header(5),
        orientation_wxyz: Some([1.0, 0.0, 0.0, 0.0]),
        gyro_radps: [0.1, 0.2, 0.3],
        acc_mps2: [0.0, 0.0, 9.8],
    };
    let battery = BatteryState { header: header(5), voltage_v: 12.5 };
    let odometry = Odometry {
        header: header(5),
        position_m: [1.0, 2.0, 3.0],
        orientation_xyzw: [0.0, 0.0, 0.0, 1.0],
        ..Odometry::default()
    };
    let messages = [
        ("/imu", Imu::TYPE, 7, imu.encode()),
        ("/battery", BatteryState::TYPE, 7, battery.encode()),
        ("/odom", Odometry::TYPE, 7, odometry.encode()),
        ("/joint_states", JOINTS, 7, state(5, &["FL_hip"], vec![0.1])),
        ("/joint_states", JOINTS, 9, state(8, &["HR_calf"], vec![-1.0])),
    ];
    let (path, robot) = (bag(dir.path(), &messages), robot("quadruped"));
    let draft = drafted(&path, &robot);
    has(&draft, &["base = \"free\"", "Nothing was taken for commands"]);
    let run = &imported(&path, &draft, &robot).unwrap()[0];
    for (signal, want) in [
        ("imu.gyro.y", 0.2),
        ("imu.acc.z", 9.8),
        ("imu.grav.z", -1.0),
        ("volt", 12.5),
        ("base.pos.x", 1.0),
        ("base.quat.w", 1.0),
        ("pos.FL_hip", 0.1),
    ] {
        assert!((value(run, 0, signal) - want).abs() < 1e-6, "{signal}");
    }
}

/// Imported or read as it is: of a doubled stamp one reading is lost, and that is said.
#[test]
fn doubled_stamps_are_counted() {
    let dir = tempfile::tempdir().unwrap();
    let robot = robot("xl330_pendulum");
    let of = |stamps_ms: &[i64]| {
        let states = stamps_ms.iter().map(|ms| {
            let stamp_ns = 1_000_000 * ms;
            ("/joint_states", JOINTS, stamp_ns as u64, state(stamp_ns, &["swing"], vec![0.1]))
        });
        let path = bag(dir.path(), &states.collect::<Vec<_>>());
        let runs = imported(&path, &drafted(&path, &robot), &robot).unwrap();
        let read = parse_mcap("run.mcap", &std::fs::read(&path).unwrap()).unwrap();
        (runs[0].notes.clone(), read.notes().to_vec())
    };
    assert_eq!(of(&[10, 20, 30]), (vec![], vec![]));
    let (notes, read) = of(&[10, 20, 20, 40, 30]);
    has(&notes.join(""), &["2 stamp(s) do not come after the one before, the first 0.010 s after"]);
    assert_eq!(read, ["1 value(s) that another of the same signal and stamp follows"]);
}

#[test]
fn a_stranger_is_told_what_is_wrong() {
    let dir = tempfile::tempdir().unwrap();
    let guess = |path: &Path| Format::guess(path).map_err(|e| e.to_string());
    has(&guess(dir.path()).unwrap_err(), &["is no recording", "meta/info.json"]);
    has(&guess(&dir.path().join("nothing")).unwrap_err(), &["No such file"]);
    std::fs::write(dir.path().join("log.toml"), "").unwrap();
    has(&guess(dir.path()).unwrap_err(), &["is a log folder already"]);
    let opened =
        |path: &Path| open(path, Format::Rosbag, None).map(|_| ()).map_err(|e| e.to_string());
    let path = bag(dir.path(), &[]);
    has(&opened(&path).unwrap_err(), &["run.mcap: has no message"]);
    let path = bag(dir.path(), &[("/image", "sensor_msgs/msg/Image", 1, vec![0])]);
    has(
        &opened(&path).unwrap_err(),
        &["has no topic that is read; it has /image (sensor_msgs/msg/Image, 1 messages)"],
    );
    // names of nobody: not one joint each, so they are not handed out by their place
    let twenty = state(5, &[], vec![0.0; 20]);
    let path = bag(dir.path(), &[("/joint_states", JOINTS, 6, twenty)]);
    let draft = drafted(&path, &robot("quadruped"));
    has(&draft, &["as which joints its 20 numbers are is not said, and the robot has 12"]);
    has(
        &imported(&path, &draft, &robot("quadruped")).unwrap_err(),
        &["says of no column what it is"],
    );
    // stamps of a simulation's clock, and a topic without
    let mut messages =
        vec![("/joint_states", JOINTS, 1_700_000_000_000_000_000, state(5, &["swing"], vec![0.5]))];
    let point = TrajectoryPoint { position: vec![0.1], ..TrajectoryPoint::default() };
    let ask = JointTrajectory {
        name: vec!["swing".to_owned()],
        points: vec![point],
        ..JointTrajectory::default()
    };
    messages.push(("/ask", JointTrajectory::TYPE, 1_700_000_000_000_000_000, ask.encode()));
    let path = bag(dir.path(), &messages);
    let draft = drafted(&path, &robot("xl330_pendulum"));
    has(
        &draft,
        &[
            "column = \"received\"",
            "/ask has no stamps, and those of the others are of another clock",
        ],
    );
    let error = imported(
        &path,
        &draft.replace("/position/swing", "/position/swign"),
        &robot("xl330_pendulum"),
    );
    has(&error.unwrap_err(), &["has no column `/", "swign`; it has stamp, received"]);
}
