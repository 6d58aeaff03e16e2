//! The unmodified program over the real wire protocol: emulated servos and IMU on pseudo-terminals, physics
//! behind them.

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use crate::common::policies::{ROBOT_FILE, model, standing};
use crate::common::{Server, end_of, ended, outcome, output_of, program, robot_program, start};
use caudata_deploy::boundary::RunFolder;
use caudata_deploy::odometry::DeadReckoning;
use caudata_deploy::tap::Tap;
use caudata_dynamixel::HardwareError;
use caudata_dynamixel::emulator::WireFaults;
use caudata_emulated_robot::{EmulatedRobot, Pace, SUBSTEPS, Terminals, serve};
use caudata_hardware::Wiring;
use caudata_policy::PolicyFile;
use caudata_runlog::{RunLog, Signal};
use caudata_sim::{EngineConfig, InitialState, TerrainConfig};

const WIRING: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../robots/polymander.wiring.toml");

/// How long anything is waited for before the test gives up.
const PATIENCE: Duration = Duration::from_secs(120);

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
    pace: Pace,
    stop: Arc<AtomicBool>,
    places_m: Arc<Mutex<Vec<[f64; 3]>>>,
    /// Every change of the torque.
    torque: Arc<Mutex<Vec<bool>>>,
    thread: JoinHandle<()>,
}

impl Emulated {
    /// `change` is made before the robot is served, `later` after so many seconds of its time (only in step
    /// with the goals).
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
        let config = EngineConfig { substeps: SUBSTEPS, ..EngineConfig::default() };
        let engine =
            caudata_sim::build(model(), 1, &config, &TerrainConfig::default(), 1, 1).unwrap();
        let wiring = Wiring::read(Path::new(WIRING)).unwrap();
        let mut robot = EmulatedRobot::new(engine, &wiring, 1).unwrap();
        change(&mut robot);
        let mut terminals = Terminals::open(folder).unwrap();
        let stop = Arc::new(AtomicBool::new(false));
        let places_m = Arc::new(Mutex::new(Vec::new()));
        let torque = Arc::new(Mutex::new(vec![false]));
        let (stopped, places, edges) = (stop.clone(), places_m.clone(), torque.clone());
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
                places.lock().unwrap().push(robot.base_pos_m());
                change_of_torque(&edges, robot.torque_on());
            }
        });
        Self { folder: folder.to_owned(), pace, stop, places_m, torque, thread }
    }

    fn ports(&self) -> [String; 4] {
        let at = |name: &str| self.folder.join(name).display().to_string();
        let imu = format!("bridge:{}", at("imu"));
        ["--servo-port".to_owned(), at("servos"), "--imu-bus".to_owned(), imu]
    }

    /// Every change of its torque so far, off at first.
    fn torque(&self) -> Vec<bool> {
        self.torque.lock().unwrap().clone()
    }

    /// Waits until its torque has changed like this. Nothing is asserted about time: the limit is for what
    /// never comes.
    #[track_caller]
    fn torque_comes_to(&self, changes: &[bool]) {
        let end = Instant::now() + PATIENCE;
        while self.torque() != changes {
            let seen = self.torque();
            let may_come = changes.starts_with(&seen) && Instant::now() < end;
            assert!(may_come, "the torque went {seen:?}, never {changes:?}");
            std::thread::sleep(Duration::from_millis(5));
        }
    }

    /// Ends it; the height of its base over time, m.
    fn stop(self) -> Vec<f64> {
        self.stop.store(true, Ordering::Relaxed);
        self.thread.join().unwrap();
        let places = self.places_m.lock().unwrap();
        places.iter().map(|place| place[2]).collect()
    }
}

/// A robot, a server with one policy, which makes it stand, and the folder of everything.
struct Bench {
    folder: tempfile::TempDir,
    server: Server,
    robot: Emulated,
    wiring: String,
}

impl Bench {
    /// In step with the goals; `change` and `later` as of [`Emulated::start`].
    fn in_step(change: impl FnOnce(&mut EmulatedRobot), later: Option<(f64, Change)>) -> Self {
        Self::in_step_under(standing(1), change, later)
    }

    /// The same with another policy.
    fn in_step_under(
        policy: Vec<u8>,
        change: impl FnOnce(&mut EmulatedRobot),
        later: Option<(f64, Change)>,
    ) -> Self {
        let (folder, server) = Self::place(policy);
        let robot = Emulated::start(&folder.path().join("robot"), change, later);
        let wiring = patient_wiring(folder.path());
        Self { folder, server, robot, wiring }
    }

    /// By the clock: a robot that is let go comes to rest although nobody sends goals. Its servos' own
    /// watchdogs, which would hold it, leave a busy machine two and a half seconds.
    fn by_the_clock() -> Self {
        let (folder, server) = Self::place(standing(1));
        let robot = Emulated::start_at(Pace::RealTime, &folder.path().join("robot"), |_| {}, None);
        let wiring = calm_wiring(folder.path());
        Self { folder, server, robot, wiring }
    }

    fn place(policy: Vec<u8>) -> (tempfile::TempDir, Server) {
        let folder = tempfile::tempdir().unwrap();
        let server = Server::start(&folder.path().join("server"));
        server.publish(policy);
        (folder, server)
    }

    /// `run` on the robot, at its pace, with `flags`.
    fn run(&self, flags: &[&str]) -> Command {
        self.run_in(self.folder.path(), flags)
    }

    /// The same with another state folder.
    fn run_in(&self, folder: &Path, flags: &[&str]) -> Command {
        let mut command = program("run", self.server.address, &folder.join("state"));
        command.args(["--bus", &format!("wiring:{}", self.wiring)]).args(self.robot.ports());
        if self.robot.pace == Pace::Goals {
            command.args(["--in-step", "--hang-ms", "120000"]);
        }
        command.args(flags);
        command
    }

    /// Ends robot and server; every change of the torque, and the height of the base over time, m.
    fn end(self) -> (Vec<bool>, Vec<f64>) {
        let torque = self.robot.torque();
        let heights_m = self.robot.stop();
        self.server.stop();
        (torque, heights_m)
    }
}

fn doctor(robot: &Emulated, flags: &[&str]) -> (i32, serde_json::Value, String) {
    let mut command = robot_program();
    command
        .args([
            "doctor",
            "--json",
            "--robot",
            ROBOT_FILE.as_str(),
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
    assert_eq!((of("Return Delay Time"), of("model"), of("zero offset")), (16, 16, 16), "{errors}");
    let wrong: Vec<_> = checks.iter().filter(|c| c["mark"] == "wrong").collect();
    // The round trip depends on how busy this machine is; everything else does not.
    assert!(wrong.iter().all(|c| c["what"] == "round trip"), "{wrong:?}");
    robot.stop();
}

#[test]
fn the_program_stands_up_over_the_wire_and_lets_go() {
    // The wire is not perfect: one answer in 200 is damaged, another has noise before it.
    let faults = WireFaults { flipped_bit: 0.005, noise: 0.005, ..WireFaults::default() };
    let bench = Bench::in_step(|r| r.bus.faults = faults, None);
    let log = bench.folder.path().join("log");
    let mut command = bench.run(&["--seconds", "3", "--log-dir"]);
    command.arg(&log);
    let (code, summary, errors) = outcome(command);
    let read_log = RunLog::read(&log);
    let (_, heights) = bench.end();
    assert_eq!((code, &summary["ended"]), (0, &"time".into()), "{errors}");
    // 36° fore knees and 54° hind knees hold the head at about 6 cm; limp it lies at 3 cm.
    let highest = heights.iter().copied().fold(0.0, f64::max);
    assert!(highest > 0.05, "{highest}");
    let log = read_log.unwrap();
    let read = |signal: Signal| log.table.column(&signal).unwrap().to_vec();
    let knee = read(Signal::Position("HL_knee".into()));
    let volts = read(Signal::Voltage);
    assert!((knee.last().unwrap().unwrap() - 54_f64.to_radians()).abs() < 0.1);
    assert!(volts.last().unwrap().unwrap() > 10.0);
}

/// `flat.onnx` while it is upright, `righting.onnx` from 73° on.
fn gets_up() -> Vec<u8> {
    let [flat, righting] = ["flat", "righting"].map(|name| {
        let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../policies");
        let bytes = std::fs::read(format!("{folder}/{name}.onnx")).unwrap();
        PolicyFile::parse(bytes.into()).unwrap()
    });
    let observation = &flat.metadata().contract.observation;
    let gravity_z = observation.slice("gravity").unwrap().start + 2;
    let both = caudata_policy::join(&flat, &righting, gravity_z, -0.3).unwrap();
    both.bytes().to_vec()
}

/// What the legs say of a walk, beside where the robot went: with the error that is claimed, and far from it where it
/// is only a guess.
#[test]
fn the_legs_say_where_the_robot_is() {
    let flat = concat!(env!("CARGO_MANIFEST_DIR"), "/../policies/flat.onnx");
    let bench = Bench::in_step_under(std::fs::read(flat).unwrap(), |_| {}, None);
    let run_dir = bench.folder.path().join("run");
    let tap = Tap::open(&RunFolder::open(&run_dir).unwrap()).unwrap();
    let over = Arc::new(AtomicBool::new(false));
    let is_over = over.clone();
    let reckons = std::thread::spawn(move || {
        let (mut legs, mut way) = (DeadReckoning::new(model()), Vec::new());
        while !is_over.load(Ordering::Relaxed) {
            let tick = tap.next(Duration::from_millis(50)).unwrap();
            way.extend(tick.and_then(|tick| legs.add(&tick)));
        }
        way
    });
    let mut command =
        bench.run(&["--seconds", "12", "--command", "0.3,0,0.1", "--tap", "--run-dir"]);
    command.arg(&run_dir);
    let (code, summary, errors) = outcome(command);
    over.store(true, Ordering::Relaxed);
    let way = reckons.join().unwrap();
    let places = bench.robot.places_m.lock().unwrap().clone();
    bench.end();
    assert_eq!(code, 0, "{errors}");
    assert!(way.len() > 400, "{} ticks: {summary}", way.len());
    let (here, [x, y, z]) = (way[way.len() - 1], places[places.len() - 1]);
    // it begins with its root link at 0, looking along x
    let went = [x - places[0][0], y - places[0][1]];
    let off_m = (here.pose.pos_m[0] - went[0]).hypot(here.pose.pos_m[1] - went[1]);
    // along the arc, by chords of a second
    let seconds: Vec<_> = places.iter().step_by(50).collect();
    let chord_m = |ends: &[&[f64; 3]]| (ends[1][0] - ends[0][0]).hypot(ends[1][1] - ends[0][1]);
    let way_m: f64 = seconds.windows(2).map(chord_m).sum();
    let sd_m = here.pose_variance[0].sqrt();
    println!(
        "{off_m:.3} m off after {way_m:.2} m, claimed {sd_m:.3} m; {:.3} m high, {z:.3}",
        here.pose.pos_m[2]
    );
    assert!(way_m > 2.5, "{way_m}");
    assert!(off_m < 2.0 * sd_m && sd_m < 0.2 * way_m, "{off_m} m off, {sd_m} m claimed, {way_m} m");
    assert!((here.pose.pos_m[2] - z).abs() < 0.02, "{} m high, {z}", here.pose.pos_m[2]);
}

/// On its back where it first stood.
fn turned_over(robot: &mut EmulatedRobot) {
    let mut start = InitialState::nominal(&model());
    start.base_rpy_rad[0] = std::f32::consts::PI;
    robot.place(&start).unwrap();
}

#[test]
fn a_robot_on_its_back_gets_up_where_its_policy_can_and_it_may() {
    // Turned over in the middle of its walk: rising and settling end after 2 s at most, walking 10 s later.
    let bench = Bench::in_step_under(gets_up(), |_| {}, Some((7.0, turned_over)));
    let walk = ["--seconds", "10", "--command", "0.3,0,0", "--get-up", "5"];
    let (code, summary, errors) = outcome(bench.run(&walk));
    let (_, heights_m) = bench.end();
    assert_eq!((code, &summary["ended"]), (0, &"time".into()), "{errors}");
    let highest_m = heights_m.iter().copied().fold(0.0, f64::max);
    assert!(highest_m > 0.05, "{highest_m}");
}

#[test]
fn fault_41_an_overload_stands_the_robot_down_with_its_name() {
    let overload = |robot: &mut EmulatedRobot| {
        let error = HardwareError(HardwareError::OVERLOAD);
        robot.bus.servos[9].raise(error);
    };
    let bench = Bench::in_step(|_| {}, Some((2.0, overload as Change)));
    let (code, summary, errors) = outcome(bench.run(&["--seconds", "60"]));
    bench.end();
    assert_eq!((code, &summary["ended"]), (69, &"servo_alert".into()), "{errors}");
    assert!(errors.contains("ServoAlert"), "{errors}");
    // The loop ended by itself, with an error: its supervisor makes sure.
    assert!(errors.contains("the servos were let go"), "{errors}");
}

#[test]
fn a_log_of_the_flight_recorder_goes_straight_through_check_and_diagnosis() {
    let shipped = concat!(env!("CARGO_MANIFEST_DIR"), "/../policies/flat.onnx");
    let bench = Bench::in_step_under(std::fs::read(shipped).unwrap(), |_| {}, None);
    let log = bench.folder.path().join("log");
    let mut command = bench.run(&["--seconds", "6", "--command", "0.3,0,0"]);
    command.args(["--terrain", "flat", "--log-dir"]).arg(&log);
    let (code, summary, errors) = outcome(command);
    assert_eq!((code, &summary["ended"]), (0, &"time".into()), "{errors}");
    let caudata = Path::new(env!("CARGO_BIN_EXE_caudata-robot")).with_file_name("caudata");
    let mut check = Command::new(&caudata);
    check.args(["gap", "check", "--robot", ROBOT_FILE.as_str(), "--json", "--log"]).arg(&log);
    let (code, checked, errors) = outcome(check);
    assert_eq!((code, &checked["verdict"]), (0, &"ok".into()), "{errors}\n{checked}");
    // It was read as what it is: 50 Hz, all joints, in motion.
    let run = &checked["runs"][0];
    assert!((run["rate_hz"].as_f64().unwrap() - 50.0).abs() < 1.0, "{run}");
    let joints = run["excites"]["joints"].as_array().unwrap();
    assert_eq!(joints.len(), 16);
    let moved = |j: &&serde_json::Value| j["speed_max_radps"].as_f64().unwrap() > 0.3;
    assert!(joints.iter().filter(moved).count() >= 8, "{run}");
    // And through the diagnosis: two effects that it may or may not find, but must be able to look for.
    let mut diagnose = Command::new(&caudata);
    diagnose
        .args(["gap", "diagnose", "--robot", ROBOT_FILE.as_str(), "--json"])
        .args(["--only", "kp_error", "--only", "coulomb_friction", "--log"])
        .arg(&log)
        .arg("--out")
        .arg(bench.folder.path().join("diagnosis"));
    let (code, found, errors) = outcome(diagnose);
    let verdict = found["verdict"].as_str().unwrap_or_default();
    // What a diagnosis that is complete can come to (docs/reference/exit-codes.md); a data fault or a flag
    // that is wrong is none of them.
    let fits = match verdict {
        "no_gap" | "explained" => code == 0,
        "ambiguous" => code == 80,
        "partly_explained" => code == 81,
        "unexplained" => code == 82,
        "insufficient_data" => code == 83,
        _ => false,
    };
    assert!(fits, "{code} {verdict}: {errors}\n{found}");
    let report = bench.folder.path().join("diagnosis/report.json");
    let report = std::fs::read_to_string(report).unwrap();
    let report: serde_json::Value = serde_json::from_str(&report).unwrap();
    assert_eq!(report["verdict"], found["verdict"]);
    bench.end();
}

#[test]
fn fault_49_servos_are_let_go_where_the_loop_is_killed_and_it_stands_up_again() {
    let bench = Bench::by_the_clock();
    let running = start(bench.run(&["--hang-ms", "120000", "--seconds", "2"]));
    bench.robot.torque_comes_to(&[false, true]);
    let looper = child_of(running.id(), "rt");
    nix::sys::signal::kill(looper, nix::sys::signal::Signal::SIGKILL).unwrap();
    let (code, summary, errors) = ended(running);
    // On, off by the supervisor, on again, off in order.
    let (seen, _) = bench.end();
    assert_eq!(seen, [false, true, false, true, false], "{errors}");
    assert_eq!((code, &summary["ended"]), (0, &"time".into()), "{errors}");
    assert!(errors.contains("the servos were let go"), "{errors}");
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
fn hung(robot: &Emulated, command: Command) -> std::process::Child {
    let running = start(command);
    robot.torque_comes_to(&[false, true]);
    let looper = child_of(running.id(), "rt");
    nix::sys::signal::kill(looper, nix::sys::signal::Signal::SIGSTOP).unwrap();
    running
}

#[test]
fn fault_38_servos_are_let_go_where_the_loop_hangs_and_it_stands_up_again() {
    let bench = Bench::by_the_clock();
    // Patience with a busy machine; a robot has 0.3 s.
    let command = bench.run(&["--hang-ms", "6000", "--seconds", "2"]);
    let (code, summary, errors) = ended(hung(&bench.robot, command));
    let (seen, _) = bench.end();
    assert_eq!(seen, [false, true, false, true, false], "{errors}");
    assert_eq!((code, &summary["ended"]), (0, &"time".into()), "{errors}");
    assert!(errors.contains("the loop hangs: ended"), "{errors}");
}

#[test]
fn fault_48_the_kill_button_lets_go_of_servos_whose_loop_hangs() {
    let bench = Bench::by_the_clock();
    let key = bench.folder.path().join("link.key");
    std::fs::write(&key, [7; 32]).unwrap();
    let private = std::os::unix::fs::PermissionsExt::from_mode(0o600);
    std::fs::set_permissions(&key, private).unwrap();
    let address = caudata_chaos_proxy::own_address().to_string();
    // Silence alone would be noticed after two minutes.
    let mut command = bench.run(&["--hang-ms", "120000", "--link-addr", &address, "--link-key"]);
    command.arg(&key);
    let running = hung(&bench.robot, command);
    let mut drive = robot_program()
        .args(["drive", &address, "--link-key"])
        .arg(&key)
        .stdin(Stdio::piped())
        .spawn()
        .unwrap();
    let mut typed = drive.stdin.take().unwrap();
    std::io::Write::write_all(&mut typed, b"k\n").unwrap();
    let (code, _, errors) = ended(running);
    let (seen, _) = bench.end();
    drop(typed);
    let _ = drive.kill();
    let _ = drive.wait();
    assert_eq!((code, seen), (69, vec![false, true, false]), "{errors}");
    assert!(
        errors.contains("hung when the kill button was pressed; it was ended; the torque is off"),
        "{errors}"
    );
}

/// Two signals to the process `pid`, as of a person without patience.
fn insists(pid: u32) {
    use nix::sys::signal::Signal::SIGINT;
    signal(pid, SIGINT);
    // Signals that come together are one; whoever presses twice takes longer.
    std::thread::sleep(Duration::from_millis(500));
    signal(pid, SIGINT);
}

#[test]
fn a_second_signal_leaves_no_torque_on_a_robot_whose_loop_hangs() {
    let bench = Bench::by_the_clock();
    let running = hung(&bench.robot, bench.run(&["--hang-ms", "120000"]));
    let looper = child_of(running.id(), "rt");
    insists(running.id());
    let (code, _, errors) = ended(running);
    let (seen, _) = bench.end();
    assert_eq!((code, seen), (130, vec![false, true, false]), "{errors}");
    assert!(errors.contains("stopped at once by a second signal; the torque is off"), "{errors}");
    assert!(!Path::new(&format!("/proc/{looper}/status")).exists());
}

/// Holds `pid` where it cannot be ended: stopped on its way out, its files open, as by a driver that does not
/// come back. Until this thread lets it go, or ends. False where this machine does not allow that.
fn held_at_its_end(pid: nix::unistd::Pid) -> bool {
    use nix::sys::ptrace::{Options, seize};
    match seize(pid, Options::PTRACE_O_TRACEEXIT) {
        Ok(()) => true,
        Err(error) => {
            eprintln!("skipped: this machine lets nobody trace a process ({error})");
            false
        }
    }
}

#[test]
fn a_loop_that_does_not_end_even_by_force_has_its_servos_let_go_and_is_left() {
    let bench = Bench::by_the_clock();
    let mut running = hung(&bench.robot, bench.run(&["--hang-ms", "120000"]));
    let looper = child_of(running.id(), "rt");
    if !held_at_its_end(looper) {
        let _ = running.kill();
        let _ = running.wait();
        bench.end();
        return;
    }
    // It is ended by force, as far as that goes.
    insists(running.id());
    end_of(&mut running);
    let state = std::fs::read_to_string(format!("/proc/{looper}/status")).unwrap();
    // What it holds open would keep its last words from ending.
    let _ = nix::sys::ptrace::detach(looper, nix::sys::signal::Signal::SIGKILL);
    let (code, _, errors) = ended(running);
    let (seen, _) = bench.end();
    assert!(state.contains("(tracing stop)"), "it is there: {state}");
    // It had the port to the last, and its servos let go all the same.
    assert_eq!((code, seen), (71, vec![false, true, false]), "{errors}");
    let line = "does not end, not even by force: a driver holds it; the torque is off";
    assert!(errors.contains(line), "{errors}");
}

/// Every servo's torque on, as a loop that died leaves it; servo 5 does not let go.
fn left_standing(robot: &mut EmulatedRobot) {
    for servo in &mut robot.bus.servos {
        servo.put(&caudata_dynamixel::xm430::TORQUE_ENABLE, 1);
    }
}

fn limp(robot: &Emulated, flags: &[&str]) -> (Option<i32>, String) {
    let mut command = robot_program();
    command
        .args(["limp", "--wiring", &patient_wiring(&robot.folder)])
        .args(robot.ports())
        .args(flags);
    let output = output_of(start(command));
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
    assert!(said.contains("the torque is off: 16 servos say so"), "{said}");
    robot.torque_comes_to(&[false, true, false]);
    robot.stop();

    let jammed = |robot: &mut EmulatedRobot| {
        left_standing(robot);
        robot.bus.servos[4].jammed = true;
    };
    let robot = Emulated::start(&folder.path().join("jammed"), jammed, None);
    robot.torque_comes_to(&[false, true]);
    let (code, said) = limp(&robot, &[]);
    assert_eq!(code, Some(86), "{said}");
    assert!(said.contains("error: the torque is still on of servos 5: cut the supply"), "{said}");
    assert_eq!(robot.torque(), [false, true]);
    robot.stop();
}

#[test]
fn a_run_whose_servo_does_not_let_go_says_so_and_fails() {
    let jam = |robot: &mut EmulatedRobot| robot.bus.servos[9].jammed = true;
    let bench = Bench::in_step(|_| {}, Some((2.0, jam as Change)));
    let (code, _, errors) = outcome(bench.run(&["--seconds", "3"]));
    bench.end();
    assert_eq!(code, 86, "{errors}");
    // Its supervisor tried as well.
    for line in [
        "the torque is still on of servos 10",
        "nobody knows whether the servos were let go",
        "error: THE TORQUE MAY STILL BE ON",
    ] {
        assert!(errors.contains(line), "{errors}");
    }
}

#[test]
fn what_has_the_port_keeps_a_second_run_and_doctor_out_but_not_limp() {
    let bench = Bench::in_step(|_| {}, None);
    let robot = &bench.robot;
    let running = start(bench.run(&[]));
    robot.torque_comes_to(&[false, true]);
    let (code, _, errors) = doctor(robot, &["--fix"]);
    assert_eq!(code, 73, "{errors}");
    assert!(errors.contains("another program has"), "{errors}");
    // Another state, another run folder, the same robot. What it leaves behind must not let the first one's
    // servos go.
    let other = bench.folder.path().join("other");
    let (code, _, errors) = outcome(bench.run_in(&other, &[]));
    assert_eq!(code, 73, "{errors}");
    assert!(errors.contains("another program has"), "{errors}");
    let (code, said) = limp(robot, &["--unless-taken"]);
    assert_eq!(code, Some(73), "{said}");
    assert_eq!(robot.torque(), [false, true], "nobody touched it");
    // A person who types this means it, whoever has the port: the loop finds servos without torque, and ends.
    limp(robot, &[]);
    let (code, summary, errors) = ended(running);
    assert_eq!(code, 69, "{errors}");
    assert!(
        ["servo_restarted", "servo_silent"].map(Into::into).contains(&summary["ended"]),
        "{summary}"
    );
    assert_eq!(bench.end().0.last(), Some(&false));
}
