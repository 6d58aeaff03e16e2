//! The unmodified program over the real wire protocol: emulated servos and IMU on pseudo-terminals, physics behind them.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod common;

use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;

use caudata_dynamixel::HardwareError;
use caudata_dynamixel::emulator::WireFaults;
use caudata_emulated_robot::{EmulatedRobot, Pace, SUBSTEPS, Terminals, serve};
use caudata_hardware::Wiring;
use caudata_runlog::{RunLog, Signal};
use caudata_sim::{EngineConfig, TerrainConfig};
use common::policies::{ROBOT_FILE, model, standing};
use common::{Server, ended, outcome, program, start};

const WIRING: &str = concat!(
    env!("CARGO_MANIFEST_DIR"),
    "/../robots/polymander.wiring.toml"
);

/// The wiring file with more patience than a robot has, for a machine that is busy with other tests.
fn patient_wiring(folder: &Path) -> String {
    let text = std::fs::read_to_string(WIRING).unwrap();
    let patient = text.replace("read_deadline_ms = 7 ", "read_deadline_ms = 1000 ");
    assert_ne!(text, patient);
    let path = folder.join("patient.wiring.toml");
    std::fs::write(&path, patient).unwrap();
    path.display().to_string()
}

/// An emulated robot in a thread of its own, in step with the goals: a busy machine makes it slow, not wrong.
struct Emulated {
    folder: PathBuf,
    stop: Arc<AtomicBool>,
    heights_m: Arc<Mutex<Vec<f64>>>,
    /// Every change of the torque.
    torque: Arc<Mutex<Vec<bool>>>,
    thread: JoinHandle<()>,
}

impl Emulated {
    /// `change` is made before the robot is served, `at_torque` when its torque has come on.
    fn start(
        folder: &Path,
        change: impl FnOnce(&mut EmulatedRobot),
        alert_after_s: Option<f64>,
    ) -> Self {
        Self::start_at(Pace::Goals, folder, change, alert_after_s)
    }

    fn start_at(
        pace: Pace,
        folder: &Path,
        change: impl FnOnce(&mut EmulatedRobot),
        alert_after_s: Option<f64>,
    ) -> Self {
        let config = EngineConfig {
            substeps: SUBSTEPS,
            ..EngineConfig::default()
        };
        let engine =
            caudata_sim::build(model(), 1, &config, &TerrainConfig::default(), 1, 1).unwrap();
        let wiring = Wiring::read(Path::new(WIRING)).unwrap();
        let mut robot = EmulatedRobot::new(engine, &wiring, 1).unwrap();
        change(&mut robot);
        let mut terminals = Terminals::open(folder).unwrap();
        let stop = Arc::new(AtomicBool::new(false));
        let heights_m = Arc::new(Mutex::new(Vec::new()));
        let torque = Arc::new(Mutex::new(vec![false]));
        let (stopped, heights, edges) = (stop.clone(), heights_m.clone(), torque.clone());
        let change_of_torque = |edges: &Mutex<Vec<bool>>, on: bool| {
            let mut edges = edges.lock().unwrap();
            if edges.last() != Some(&on) {
                edges.push(on);
            }
        };
        let thread = std::thread::spawn(move || {
            if pace == Pace::RealTime {
                let stop = || stopped.load(Ordering::Relaxed);
                let mut event = |on: bool, _: &EmulatedRobot| change_of_torque(&edges, on);
                serve(&mut robot, &mut terminals, pace, &stop, &mut event).unwrap();
                return;
            }
            // Serves in slices, so that a fault can come in between.
            let mut alert_after_s = alert_after_s;
            while !stopped.load(Ordering::Relaxed) {
                let due =
                    |robot: &EmulatedRobot| alert_after_s.is_some_and(|at| robot.time_s() > at);
                if due(&robot) {
                    let overload = HardwareError(HardwareError::OVERLOAD);
                    robot.bus.servos_mut()[9].raise(overload);
                    alert_after_s = None;
                }
                let begun = std::time::Instant::now();
                let slice = || begun.elapsed().as_millis() > 5 || stopped.load(Ordering::Relaxed);
                let mut event = |_: bool, _: &EmulatedRobot| {};
                serve(&mut robot, &mut terminals, Pace::Goals, &slice, &mut event).unwrap();
                heights.lock().unwrap().push(robot.base_pos_m()[2]);
                change_of_torque(&edges, robot.torque_on());
            }
        });
        Self {
            folder: folder.to_owned(),
            stop,
            heights_m,
            torque,
            thread,
        }
    }

    fn ports(&self) -> [String; 4] {
        let at = |name: &str| self.folder.join(name).display().to_string();
        let imu = format!("bridge:{}", at("imu"));
        [
            "--servo-port".to_owned(),
            at("servos"),
            "--imu-bus".to_owned(),
            imu,
        ]
    }

    /// Ends it; the height of its base over time, m.
    fn stop(self) -> Vec<f64> {
        self.stop.store(true, Ordering::Relaxed);
        self.thread.join().unwrap();
        std::mem::take(&mut self.heights_m.lock().unwrap())
    }
}

fn doctor(robot: &Emulated, flags: &[&str]) -> (i32, serde_json::Value, String) {
    let mut command = std::process::Command::new(env!("CARGO_BIN_EXE_caudata-robot"));
    command
        .args([
            "doctor",
            "--json",
            "--robot",
            ROBOT_FILE,
            "--wiring",
            &patient_wiring(&robot.folder),
        ])
        .args(robot.ports())
        .args(flags);
    outcome(command)
}

#[test]
fn doctor_finds_factory_settings_sets_them_right_and_then_is_content() {
    let folder = tempfile::tempdir().unwrap();
    let robot = Emulated::start(folder.path(), |_| {}, None);
    let (code, seen, errors) = doctor(&robot, &[]);
    assert_eq!((code, &seen["fit"]), (79, &false.into()), "{errors}");
    assert!(errors.contains("Return Delay Time"), "{errors}");
    let (_, fixed, errors) = doctor(&robot, &["--fix", "--nominal"]);
    let checks = fixed["checks"].as_array().unwrap();
    let of = |what: &str| checks.iter().filter(|c| c["what"] == what).count();
    assert_eq!(
        (of("Return Delay Time"), of("model"), of("zero offset")),
        (16, 16, 16),
        "{errors}"
    );
    let wrong: Vec<_> = checks.iter().filter(|c| c["mark"] == "wrong").collect();
    // The round trip depends on how busy this machine is; everything else does not.
    assert!(wrong.iter().all(|c| c["what"] == "round trip"), "{wrong:?}");
    robot.stop();
}

#[test]
fn the_program_stands_up_over_the_wire_and_lets_go() {
    let folder = tempfile::tempdir().unwrap();
    let server = Server::start(&folder.path().join("server"));
    server.publish(standing(1));
    // The wire is not perfect: one answer in 200 is damaged, another has noise before it.
    let faults = WireFaults {
        flipped_bit: 0.005,
        noise: 0.005,
        ..WireFaults::default()
    };
    let robot = Emulated::start(&folder.path().join("robot"), |r| r.set_faults(faults), None);
    let log = folder.path().join("log");
    let mut command = program("run", server.address, &folder.path().join("state"));
    command
        .args([
            "--bus",
            &format!("wiring:{}", patient_wiring(folder.path())),
            "--in-step",
            "--hang-ms",
            "120000",
            "--seconds",
            "3",
            "--log-dir",
        ])
        .arg(&log)
        .args(robot.ports());
    let (code, summary, errors) = outcome(command);
    let heights = robot.stop();
    assert_eq!((code, &summary["ended"]), (0, &"time".into()), "{errors}");
    // 36° fore knees and 54° hind knees hold the head at about 6 cm; limp it lies at 3 cm.
    let highest = heights.iter().copied().fold(0.0, f64::max);
    assert!(highest > 0.05, "{highest}");
    let log = RunLog::read(&log).unwrap();
    let read = |signal: Signal| log.table.column(&signal).unwrap().to_vec();
    let knee = read(Signal::Position("HL_knee".into()));
    let volts = read(Signal::Voltage);
    assert!((knee.last().unwrap().unwrap() - 54_f64.to_radians()).abs() < 0.1);
    assert!(volts.last().unwrap().unwrap() > 10.0);
    server.stop();
}

#[test]
fn fault_41_an_overload_stands_the_robot_down_with_its_name() {
    let folder = tempfile::tempdir().unwrap();
    let server = Server::start(&folder.path().join("server"));
    server.publish(standing(1));
    let robot = Emulated::start(&folder.path().join("robot"), |_| {}, Some(2.0));
    let mut command = program("run", server.address, &folder.path().join("state"));
    command
        .args([
            "--bus",
            &format!("wiring:{}", patient_wiring(folder.path())),
            "--in-step",
            "--hang-ms",
            "120000",
            "--seconds",
            "60",
        ])
        .args(robot.ports());
    let (code, summary, errors) = outcome(command);
    robot.stop();
    assert_eq!(
        (code, &summary["ended"]),
        (69, &"servo_alert".into()),
        "{errors}"
    );
    assert!(errors.contains("ServoAlert"), "{errors}");
    server.stop();
}

#[test]
fn a_log_of_the_flight_recorder_goes_straight_through_the_check() {
    let folder = tempfile::tempdir().unwrap();
    let server = Server::start(&folder.path().join("server"));
    let shipped = concat!(env!("CARGO_MANIFEST_DIR"), "/../policies/flat.onnx");
    server.publish(std::fs::read(shipped).unwrap());
    let robot = Emulated::start(&folder.path().join("robot"), |_| {}, None);
    let log = folder.path().join("log");
    let mut command = program("run", server.address, &folder.path().join("state"));
    command
        .args([
            "--bus",
            &format!("wiring:{}", patient_wiring(folder.path())),
            "--in-step",
            "--hang-ms",
            "120000",
            "--seconds",
            "6",
            "--command",
            "0.3,0,0",
            "--terrain",
            "flat",
            "--log-dir",
        ])
        .arg(&log)
        .args(robot.ports());
    let (code, summary, errors) = outcome(command);
    robot.stop();
    assert_eq!((code, &summary["ended"]), (0, &"time".into()), "{errors}");
    let caudata = Path::new(env!("CARGO_BIN_EXE_caudata-robot")).with_file_name("caudata");
    let mut check = std::process::Command::new(caudata);
    check
        .args(["gap", "check", "--robot", ROBOT_FILE, "--json", "--log"])
        .arg(&log);
    let (code, checked, errors) = outcome(check);
    assert_eq!(
        (code, &checked["verdict"]),
        (0, &"ok".into()),
        "{errors}\n{checked}"
    );
    // It was read as what it is: 50 Hz, all joints, in motion.
    let run = &checked["runs"][0];
    assert!(
        (run["rate_hz"].as_f64().unwrap() - 50.0).abs() < 1.0,
        "{run}"
    );
    let joints = run["excites"]["joints"].as_array().unwrap();
    assert_eq!(joints.len(), 16);
    let moved = |j: &&serde_json::Value| j["speed_max_radps"].as_f64().unwrap() > 0.3;
    assert!(joints.iter().filter(moved).count() >= 8, "{run}");
    server.stop();
}

#[test]
fn fault_49_servos_are_let_go_where_the_loop_is_killed_and_it_stands_up_again() {
    let folder = tempfile::tempdir().unwrap();
    let server = Server::start(&folder.path().join("server"));
    server.publish(standing(1));
    // By the clock: a robot that is let go comes to rest although nobody sends goals. Its servos' own watchdogs, which would hold
    // it, leave a busy machine two and a half seconds.
    let robot = Emulated::start_at(Pace::RealTime, &folder.path().join("robot"), |_| {}, None);
    let wiring = patient_wiring(folder.path());
    let text = std::fs::read_to_string(&wiring).unwrap();
    let calm = text.replace("watchdog_ms = 100 ", "watchdog_ms = 2500 ");
    assert_ne!(text, calm);
    std::fs::write(&wiring, calm).unwrap();
    let mut command = program("run", server.address, &folder.path().join("state"));
    command
        .args([
            "--bus",
            &format!("wiring:{wiring}"),
            "--hang-ms",
            "120000",
            "--seconds",
            "2",
        ])
        .args(robot.ports());
    let running = start(command);
    let changes = || robot.torque.lock().unwrap().clone();
    // Nothing is asserted about time; whoever runs the tests has patience.
    while changes() != [false, true] {
        std::thread::sleep(std::time::Duration::from_millis(5));
    }
    let looper = child_of(running.id(), "rt");
    nix::sys::signal::kill(looper, nix::sys::signal::Signal::SIGKILL).unwrap();
    let (code, summary, errors) = ended(running);
    // On, off by the supervisor, on again, off in order.
    let seen = changes();
    robot.stop();
    assert_eq!(seen, [false, true, false, true, false], "{errors}");
    assert_eq!((code, &summary["ended"]), (0, &"time".into()), "{errors}");
    assert!(errors.contains("the servos were let go"), "{errors}");
    server.stop();
}

/// The child of `parent` that runs `command`.
fn child_of(parent: u32, command: &str) -> nix::unistd::Pid {
    let processes = std::fs::read_dir("/proc").unwrap().flatten();
    let numbers = processes.filter_map(|p| p.file_name().to_str()?.parse::<i32>().ok());
    let is_it = |pid: &i32| {
        let read = |name: &str| std::fs::read_to_string(format!("/proc/{pid}/{name}")).ok();
        let ours = read("status").is_some_and(|s| s.contains(&format!("PPid:\t{parent}\n")));
        ours && read("cmdline").is_some_and(|c| c.split('\0').nth(1) == Some(command))
    };
    nix::unistd::Pid::from_raw(numbers.into_iter().find(is_it).unwrap())
}
