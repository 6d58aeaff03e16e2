//! The unmodified program over the real wire protocol: emulated servos and IMU on pseudo-terminals, physics behind them.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod common;

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::Duration;

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

/// The same with a watchdog that leaves a busy machine two and a half seconds.
fn calm_wiring(folder: &Path) -> String {
    let wiring = patient_wiring(folder);
    let text = std::fs::read_to_string(&wiring).unwrap();
    let calm = text.replace("watchdog_ms = 100 ", "watchdog_ms = 2500 ");
    assert_ne!(text, calm);
    std::fs::write(&wiring, calm).unwrap();
    wiring
}

/// Something that happens to a robot.
type Change = fn(&mut EmulatedRobot);

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
    /// `change` is made before the robot is served, `later` after so many seconds of its time (only in step with the goals).
    fn start(
        folder: &Path,
        change: impl FnOnce(&mut EmulatedRobot),
        later: Option<(f64, Change)>,
    ) -> Self {
        Self::start_at(Pace::Goals, folder, change, later)
    }

    fn start_at(
        pace: Pace,
        folder: &Path,
        change: impl FnOnce(&mut EmulatedRobot),
        mut later: Option<(f64, Change)>,
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
            while !stopped.load(Ordering::Relaxed) {
                if let Some((_, change)) = later.take_if(|(at, _)| robot.time_s() > *at) {
                    change(&mut robot);
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

    /// Every change of its torque so far, off at first.
    fn torque(&self) -> Vec<bool> {
        self.torque.lock().unwrap().clone()
    }

    /// Waits until its torque has changed like this. Nothing is asserted about time; whoever runs the tests has patience.
    fn torque_comes_to(&self, changes: &[bool]) {
        while self.torque() != changes {
            std::thread::sleep(Duration::from_millis(5));
        }
    }

    /// `run` on this robot, in step with the goals, or by the clock.
    fn run(&self, server: &Server, folder: &Path, wiring: &str, in_step: bool) -> Command {
        let mut command = program("run", server.address, &folder.join("state"));
        command
            .args(["--bus", &format!("wiring:{wiring}")])
            .args(self.ports());
        if in_step {
            command.args(["--in-step", "--hang-ms", "120000"]);
        }
        command
    }

    /// Ends it; the height of its base over time, m.
    fn stop(self) -> Vec<f64> {
        self.stop.store(true, Ordering::Relaxed);
        self.thread.join().unwrap();
        std::mem::take(&mut self.heights_m.lock().unwrap())
    }
}

fn doctor(robot: &Emulated, flags: &[&str]) -> (i32, serde_json::Value, String) {
    let mut command = Command::new(env!("CARGO_BIN_EXE_caudata-robot"));
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
    let wiring = patient_wiring(folder.path());
    let mut command = robot.run(&server, folder.path(), &wiring, true);
    command.args(["--seconds", "3", "--log-dir"]).arg(&log);
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
    let overload = |robot: &mut EmulatedRobot| {
        let error = HardwareError(HardwareError::OVERLOAD);
        robot.bus.servos_mut()[9].raise(error);
    };
    let at = Some((2.0, overload as Change));
    let robot = Emulated::start(&folder.path().join("robot"), |_| {}, at);
    let wiring = patient_wiring(folder.path());
    let mut command = robot.run(&server, folder.path(), &wiring, true);
    command.args(["--seconds", "60"]);
    let (code, summary, errors) = outcome(command);
    robot.stop();
    assert_eq!(
        (code, &summary["ended"]),
        (69, &"servo_alert".into()),
        "{errors}"
    );
    assert!(errors.contains("ServoAlert"), "{errors}");
    // The loop ended by itself, with an error: its supervisor makes sure.
    assert!(errors.contains("the servos were let go"), "{errors}");
    server.stop();
}

#[test]
fn a_log_of_the_flight_recorder_goes_straight_through_check_and_diagnosis() {
    let folder = tempfile::tempdir().unwrap();
    let server = Server::start(&folder.path().join("server"));
    let shipped = concat!(env!("CARGO_MANIFEST_DIR"), "/../policies/flat.onnx");
    server.publish(std::fs::read(shipped).unwrap());
    let robot = Emulated::start(&folder.path().join("robot"), |_| {}, None);
    let log = folder.path().join("log");
    let wiring = patient_wiring(folder.path());
    let mut command = robot.run(&server, folder.path(), &wiring, true);
    command
        .args([
            "--seconds",
            "6",
            "--command",
            "0.3,0,0",
            "--terrain",
            "flat",
            "--log-dir",
        ])
        .arg(&log);
    let (code, summary, errors) = outcome(command);
    robot.stop();
    assert_eq!((code, &summary["ended"]), (0, &"time".into()), "{errors}");
    let caudata = Path::new(env!("CARGO_BIN_EXE_caudata-robot")).with_file_name("caudata");
    let mut check = Command::new(&caudata);
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
    // And through the diagnosis: two effects that it may or may not find, but must be able to look for.
    let mut diagnose = Command::new(&caudata);
    diagnose
        .args(["gap", "diagnose", "--robot", ROBOT_FILE, "--json"])
        .args(["--only", "kp_error", "--only", "coulomb_friction", "--log"])
        .arg(&log)
        .arg("--out")
        .arg(folder.path().join("diagnosis"));
    let (code, found, errors) = outcome(diagnose);
    let verdict = found["verdict"].as_str().unwrap_or_default();
    // What a diagnosis that is complete can come to (docs/exit-codes.md); a data fault or a flag that is wrong is none of them.
    let fits = match verdict {
        "no_gap" | "explained" => code == 0,
        "ambiguous" => code == 80,
        "partly_explained" => code == 81,
        "unexplained" => code == 82,
        "insufficient_data" => code == 83,
        _ => false,
    };
    assert!(fits, "{code} {verdict}: {errors}\n{found}");
    let report = std::fs::read_to_string(folder.path().join("diagnosis/report.json")).unwrap();
    let report: serde_json::Value = serde_json::from_str(&report).unwrap();
    assert_eq!(report["verdict"], found["verdict"]);
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
    let wiring = calm_wiring(folder.path());
    let mut command = robot.run(&server, folder.path(), &wiring, false);
    command.args(["--hang-ms", "120000", "--seconds", "2"]);
    let running = start(command);
    robot.torque_comes_to(&[false, true]);
    let looper = child_of(running.id(), "rt");
    nix::sys::signal::kill(looper, nix::sys::signal::Signal::SIGKILL).unwrap();
    let (code, summary, errors) = ended(running);
    // On, off by the supervisor, on again, off in order.
    let seen = robot.torque();
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

fn signal(pid: u32, signal: nix::sys::signal::Signal) {
    nix::sys::signal::kill(nix::unistd::Pid::from_raw(pid as i32), signal).unwrap();
}

/// A loop that neither lives nor dies, on a robot whose torque is on: `run` by the clock, its loop stopped.
fn hung(robot: &Emulated, mut command: Command) -> std::process::Child {
    command.stdout(Stdio::piped()).stderr(Stdio::piped());
    let running = command.spawn().unwrap();
    robot.torque_comes_to(&[false, true]);
    let looper = child_of(running.id(), "rt");
    nix::sys::signal::kill(looper, nix::sys::signal::Signal::SIGSTOP).unwrap();
    running
}

#[test]
fn fault_38_servos_are_let_go_where_the_loop_hangs_and_it_stands_up_again() {
    let folder = tempfile::tempdir().unwrap();
    let server = Server::start(&folder.path().join("server"));
    server.publish(standing(1));
    let robot = Emulated::start_at(Pace::RealTime, &folder.path().join("robot"), |_| {}, None);
    let wiring = calm_wiring(folder.path());
    let mut command = robot.run(&server, folder.path(), &wiring, false);
    // Patience with a busy machine; a robot has 0.3 s.
    command.args(["--hang-ms", "6000", "--seconds", "2"]);
    let (code, summary, errors) = ended(hung(&robot, command));
    let seen = robot.torque();
    robot.stop();
    assert_eq!(seen, [false, true, false, true, false], "{errors}");
    assert_eq!((code, &summary["ended"]), (0, &"time".into()), "{errors}");
    assert!(errors.contains("the loop hangs: ended"), "{errors}");
    server.stop();
}

#[test]
fn fault_48_the_kill_button_lets_go_of_servos_whose_loop_hangs() {
    let folder = tempfile::tempdir().unwrap();
    let server = Server::start(&folder.path().join("server"));
    server.publish(standing(1));
    let robot = Emulated::start_at(Pace::RealTime, &folder.path().join("robot"), |_| {}, None);
    let wiring = calm_wiring(folder.path());
    let key = folder.path().join("link.key");
    std::fs::write(&key, [7; 32]).unwrap();
    // Free a moment ago; a program that took it meanwhile shows as an error.
    let free = std::net::UdpSocket::bind("127.0.0.1:0").unwrap();
    let address = free.local_addr().unwrap().to_string();
    drop(free);
    let mut command = robot.run(&server, folder.path(), &wiring, false);
    // Silence alone would be noticed after two minutes.
    command
        .args(["--hang-ms", "120000", "--link-addr", &address, "--link-key"])
        .arg(&key);
    let running = hung(&robot, command);
    let mut drive = Command::new(env!("CARGO_BIN_EXE_caudata-robot"))
        .args(["drive", &address, "--link-key"])
        .arg(&key)
        .stdin(Stdio::piped())
        .spawn()
        .unwrap();
    let mut typed = drive.stdin.take().unwrap();
    std::io::Write::write_all(&mut typed, b"k\n").unwrap();
    let (code, _, errors) = ended(running);
    let seen = robot.torque();
    robot.stop();
    drop(typed);
    let _ = drive.kill();
    let _ = drive.wait();
    assert_eq!((code, seen), (69, vec![false, true, false]), "{errors}");
    assert!(
        errors.contains("hung when the kill button was pressed; it was ended; the torque is off"),
        "{errors}"
    );
    server.stop();
}

#[test]
fn a_second_signal_leaves_no_torque_on_a_robot_whose_loop_hangs() {
    use nix::sys::signal::Signal::SIGINT;
    let folder = tempfile::tempdir().unwrap();
    let server = Server::start(&folder.path().join("server"));
    server.publish(standing(1));
    let robot = Emulated::start_at(Pace::RealTime, &folder.path().join("robot"), |_| {}, None);
    let wiring = calm_wiring(folder.path());
    let mut command = robot.run(&server, folder.path(), &wiring, false);
    command.args(["--hang-ms", "120000"]);
    let running = hung(&robot, command);
    let (pid, looper) = (running.id(), child_of(running.id(), "rt"));
    signal(pid, SIGINT);
    // Signals that come together are one; whoever presses twice takes longer.
    std::thread::sleep(Duration::from_millis(500));
    signal(pid, SIGINT);
    let (code, _, errors) = ended(running);
    let seen = robot.torque();
    robot.stop();
    assert_eq!((code, seen), (130, vec![false, true, false]), "{errors}");
    assert!(
        errors.contains("stopped at once by a second signal; the torque is off"),
        "{errors}"
    );
    assert!(!Path::new(&format!("/proc/{looper}/status")).exists());
    server.stop();
}

/// Every servo's torque on, as a loop that died leaves it; servo 5 does not let go.
fn left_standing(robot: &mut EmulatedRobot) {
    for servo in robot.bus.servos_mut() {
        servo.put(&caudata_dynamixel::xm430::TORQUE_ENABLE, 1);
    }
}

fn limp(robot: &Emulated, flags: &[&str]) -> (Option<i32>, String) {
    let mut command = Command::new(env!("CARGO_BIN_EXE_caudata-robot"));
    command
        .args(["limp", "--wiring", &patient_wiring(&robot.folder)])
        .args(robot.ports())
        .args(flags);
    let output = command.output().unwrap();
    let said = [output.stdout, output.stderr].concat();
    (output.status.code(), String::from_utf8(said).unwrap())
}

#[test]
fn limp_asks_whether_the_servos_let_go_and_names_those_that_do_not() {
    let folder = tempfile::tempdir().unwrap();
    let robot = Emulated::start(&folder.path().join("good"), left_standing, None);
    robot.torque_comes_to(&[false, true]);
    let (code, said) = limp(&robot, &[]);
    assert_eq!(code, Some(0), "{said}");
    assert!(
        said.contains("the torque is off: 16 servos say so"),
        "{said}"
    );
    robot.torque_comes_to(&[false, true, false]);
    robot.stop();

    let jammed = |robot: &mut EmulatedRobot| {
        left_standing(robot);
        robot.bus.servos_mut()[4].jam(true);
    };
    let robot = Emulated::start(&folder.path().join("jammed"), jammed, None);
    robot.torque_comes_to(&[false, true]);
    let (code, said) = limp(&robot, &[]);
    assert_eq!(code, Some(69), "{said}");
    assert!(
        said.contains("error: the torque is still on of servos 5: cut the supply"),
        "{said}"
    );
    assert_eq!(robot.torque(), [false, true]);
    robot.stop();
}

#[test]
fn a_run_whose_servo_does_not_let_go_says_so_and_fails() {
    let folder = tempfile::tempdir().unwrap();
    let server = Server::start(&folder.path().join("server"));
    server.publish(standing(1));
    let jam = |robot: &mut EmulatedRobot| robot.bus.servos_mut()[9].jam(true);
    let at = Some((2.0, jam as Change));
    let robot = Emulated::start(&folder.path().join("robot"), |_| {}, at);
    let wiring = patient_wiring(folder.path());
    let mut command = robot.run(&server, folder.path(), &wiring, true);
    command.args(["--seconds", "3"]);
    let (code, _, errors) = outcome(command);
    robot.stop();
    assert_eq!(code, 69, "{errors}");
    assert!(
        errors.contains("the torque is still on of servos 10"),
        "{errors}"
    );
    // Its supervisor tried as well.
    assert!(
        errors.contains("nobody knows whether the servos were let go"),
        "{errors}"
    );
    server.stop();
}

#[test]
fn what_has_the_port_keeps_a_second_run_and_doctor_out_but_not_limp() {
    let folder = tempfile::tempdir().unwrap();
    let server = Server::start(&folder.path().join("server"));
    server.publish(standing(1));
    let robot = Emulated::start(&folder.path().join("robot"), |_| {}, None);
    let wiring = patient_wiring(folder.path());
    let command = robot.run(&server, folder.path(), &wiring, true);
    let running = start(command);
    robot.torque_comes_to(&[false, true]);
    let (code, _, errors) = doctor(&robot, &["--fix"]);
    assert_eq!(code, 73, "{errors}");
    assert!(errors.contains("another program has"), "{errors}");
    // Another state, another run folder, the same robot. What it leaves behind must not let the first one's servos go.
    let other = folder.path().join("other");
    let (code, _, errors) = outcome(robot.run(&server, &other, &wiring, true));
    assert_eq!(code, 73, "{errors}");
    assert!(errors.contains("another program has"), "{errors}");
    let (code, said) = limp(&robot, &["--unless-taken"]);
    assert_eq!(code, Some(73), "{said}");
    assert_eq!(robot.torque(), [false, true], "nobody touched it");
    // A person who types this means it, whoever has the port: the loop finds servos without torque, and ends.
    limp(&robot, &[]);
    let (code, summary, errors) = ended(running);
    assert_eq!(code, 69, "{errors}");
    assert!(
        ["servo_restarted", "servo_silent"]
            .map(Into::into)
            .contains(&summary["ended"]),
        "{summary}"
    );
    assert_eq!(robot.torque().last(), Some(&false));
    robot.stop();
    server.stop();
}
