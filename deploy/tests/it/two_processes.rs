//! Faults 38, 48 and 49: the agent, the loop or their supervisor is killed or hangs while the robot walks.

use std::io::{BufRead, BufReader, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, Command, Stdio};
use std::time::{Duration, Instant};

use crate::common::policies::{policy_file, standing, stepping};
use crate::common::watchdog::output_within;
use crate::common::{Server, end_of, output_of, perfect_robot, program, robot_program, status_of};
use caudata_chaos_proxy::Wire;
use caudata_deploy::command_link::LinkKey;
use crossbeam_channel::{Receiver, RecvTimeoutError, bounded};
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use serde_json::Value;

/// How long anything is waited for before the test gives up; nothing is asserted about time.
const PATIENCE: Duration = Duration::from_secs(120);

/// The program with its two children, and what all of them write.
struct Robot {
    supervisor: Child,
    lines: Receiver<Value>,
    /// Everything so far.
    said: Vec<Value>,
    /// What nobody has looked for yet: three processes write, and what one says first may come second.
    waiting: Vec<Value>,
}

impl Robot {
    fn start(mut command: Command) -> Self {
        let mut supervisor = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
        let (sender, lines) = bounded(100_000);
        let outputs: [Box<dyn std::io::Read + Send>; 2] = [
            Box::new(supervisor.stdout.take().unwrap()),
            Box::new(supervisor.stderr.take().unwrap()),
        ];
        for output in outputs {
            let sender = sender.clone();
            std::thread::spawn(move || {
                for line in BufReader::new(output).lines().map_while(Result::ok) {
                    let value = serde_json::from_str(&line).unwrap_or(Value::String(line));
                    let _ = sender.send(value);
                }
            });
        }
        Self { supervisor, lines, said: Vec::new(), waiting: Vec::new() }
    }

    /// Waits until somebody says what `wanted` looks for, if nobody has yet; each line is heard once.
    #[track_caller]
    fn hears(&mut self, wanted: impl Fn(&Value) -> bool) -> Value {
        if let Some(at) = self.waiting.iter().position(&wanted) {
            return self.waiting.remove(at);
        }
        let end = Instant::now() + PATIENCE;
        while let Ok(line) = self.lines.recv_timeout(end.saturating_duration_since(Instant::now()))
        {
            self.said.push(line.clone());
            if wanted(&line) {
                return line;
            }
            self.waiting.push(line);
        }
        panic!("not said in time; said was {:#?}", self.said);
    }

    #[track_caller]
    fn hears_message(&mut self, text: &str) -> Value {
        self.hears(|line| line["message"].as_str().is_some_and(|m| m.contains(text)))
    }

    /// Process id of the child `part` that was started last.
    #[track_caller]
    fn started(&mut self, part: &str) -> Pid {
        let line = self.hears(|line| line["message"] == "started" && line["part"] == part);
        Pid::from_raw(line["pid"].as_i64().unwrap() as i32)
    }

    fn stop(&self) {
        kill(Pid::from_raw(self.supervisor.id() as i32), Signal::SIGTERM).unwrap();
    }

    /// Exit code and summary (null without one).
    fn ended(mut self) -> (Option<i32>, Value, Vec<Value>) {
        let code = end_of(&mut self.supervisor).code();
        let end = Instant::now() + PATIENCE;
        loop {
            match self.lines.recv_timeout(end.saturating_duration_since(Instant::now())) {
                Ok(line) => self.said.push(line),
                Err(RecvTimeoutError::Disconnected) => break,
                Err(RecvTimeoutError::Timeout) => panic!(
                    "it ended, and something that it left holds its output open; said was {:#?}",
                    self.said
                ),
            }
        }
        let summary = self.said.iter().find(|line| !line["ended"].is_null());
        let summary = summary.cloned().unwrap_or_default();
        (code, summary, std::mem::take(&mut self.said))
    }
}

impl Drop for Robot {
    fn drop(&mut self) {
        let _ = self.supervisor.kill();
        let _ = self.supervisor.wait();
    }
}

#[test]
fn a_test_that_waits_for_output_does_not_wait_for_what_a_program_left_behind() {
    let left = "sleep 1000 & kill -STOP $!; echo $!";
    let child = Command::new("sh").args(["-c", left]).stdout(Stdio::piped()).spawn().unwrap();
    let output = output_within(child, Duration::from_secs(2));
    let pid = String::from_utf8(output.stdout).unwrap();
    let pid = Pid::from_raw(pid.trim().parse().expect("the shell got that far"));
    let end = Instant::now() + PATIENCE;
    while !gone(pid) {
        assert!(Instant::now() < end, "it is still there");
        std::thread::sleep(Duration::from_millis(20));
    }
}

/// Number of control ticks so far, of the loop's page of metrics.
fn ticks(state: &Path) -> u64 {
    let page = std::fs::read_to_string(state.join("run/loop.prom")).unwrap_or_default();
    let line = page.lines().find_map(|l| l.strip_prefix("caudata_robot_ticks_total "));
    line.map_or(0, |number| number.trim().parse().unwrap())
}

/// Waits until the loop has ticked `more` times from now on.
#[track_caller]
fn walks_on(state: &Path, more: u64) {
    let (end, from) = (Instant::now() + PATIENCE, ticks(state));
    // A loop that was started again counts from 0.
    while ticks(state) < from + more {
        assert!(Instant::now() < end, "stuck at {} ticks", ticks(state));
        std::thread::sleep(Duration::from_millis(50));
    }
}

/// How often a loop was started.
fn loops(said: &[Value]) -> usize {
    let starts = said.iter();
    starts.filter(|line| line["message"] == "started" && line["part"] == "rt").count()
}

/// How many lines that are not of the log hold `text`.
fn told(said: &[Value], text: &str) -> usize {
    let lines = said.iter().filter_map(Value::as_str);
    lines.filter(|line| line.contains(text)).count()
}

fn gone(pid: Pid) -> bool {
    let status = std::fs::read_to_string(format!("/proc/{pid}/status")).unwrap_or_default();
    status.is_empty() || status.contains("State:\tZ")
}

/// A policy server with what was published, and the folder that holds everything.
struct Lab {
    folder: tempfile::TempDir,
    server: Server,
}

impl Lab {
    fn with(policies: impl IntoIterator<Item = Vec<u8>>) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let server = Server::start(&folder.path().join("server"));
        policies.into_iter().for_each(|bytes| server.publish(bytes));
        Self { folder, server }
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    fn state(&self) -> PathBuf {
        self.path("state")
    }

    /// A file with the key of a command link.
    fn link_key(&self) -> PathBuf {
        let key = self.path("link.key");
        std::fs::write(&key, [7; 32]).unwrap();
        let private = std::os::unix::fs::PermissionsExt::from_mode(0o600);
        std::fs::set_permissions(&key, private).unwrap();
        LinkKey::read(&key).unwrap();
        key
    }

    /// `run` on a perfect robot, with `flags`, until stopped. Silence of its loop for `hang_ms` is a hang;
    /// where that is not what a test is about, a minute: machines that run tests are busy.
    fn command(&self, hang_ms: &str, flags: &[&str]) -> Command {
        let mut command = program("run", self.server.address, &self.state());
        command
            .args(["--bus", &format!("sim:{}", perfect_robot())])
            .args(["--metrics-addr", "127.0.0.1:0", "--hang-ms", hang_ms])
            .args(flags);
        command
    }

    /// It runs, and follows.
    fn walking(&self) -> Robot {
        Robot::start(self.command("60000", &["--follow"]))
    }

    fn stop(self) {
        self.server.stop();
    }
}

/// Velocities for the robot at `address`, line by line.
struct Driver {
    child: Child,
    lines: Option<ChildStdin>,
}

impl Driver {
    fn of(address: &Value, key: &Path) -> Self {
        let mut child = robot_program()
            .args(["drive", address.as_str().unwrap(), "--link-key"])
            .arg(key)
            .stdin(Stdio::piped())
            .spawn()
            .unwrap();
        let lines = child.stdin.take();
        Self { child, lines }
    }

    fn says(&mut self, line: &str) {
        let lines = self.lines.as_mut().unwrap();
        writeln!(lines, "{line}").unwrap();
    }
}

impl Drop for Driver {
    fn drop(&mut self) {
        self.lines = None;
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

#[test]
fn fault_49_an_agent_that_is_killed_comes_back_and_the_robot_never_stops() {
    let lab = Lab::with([standing(1)]);
    let state = lab.state();
    let mut robot = lab.walking();
    let agent = robot.started("agent");
    robot.started("rt");
    walks_on(&state, 50);
    for version in 2..4 {
        let agent = match version {
            2 => agent,
            _ => robot.started("agent"),
        };
        if version == 3 {
            // The one before took the newer policy over; now it is the next one's turn.
            robot.hears(|line| line["message"] == "policy swapped in" && line["version"] == 2);
        }
        kill(agent, Signal::SIGKILL).unwrap();
        robot.hears_message("the agent ended; the loop goes on");
        walks_on(&state, 50);
        lab.server.publish(standing(version));
    }
    robot.hears(|line| line["message"] == "policy swapped in" && line["version"] == 3);
    robot.stop();
    let (code, summary, said) = robot.ended();
    assert_eq!((code, &summary["ended"]), (Some(0), &"signal".into()), "{said:#?}");
    assert_eq!((&summary["policy_swaps"], &summary["policy_version"]), (&2.into(), &3.into()));
    assert_eq!(loops(&said), 1, "one loop from the beginning to the end");
    // What the loop said while nobody listened was heard.
    assert_eq!(status_of(&state)["active"]["version"], 3);
    assert_eq!(std::fs::read_dir(state.join("told")).unwrap().count(), 0);
    lab.stop();
}

#[test]
fn fault_49_a_loop_that_is_killed_is_started_again_and_its_third_death_in_a_trial_is_the_policys() {
    // Version 1 is good; version 2 takes the loop down with it.
    let lab = Lab::with([stepping(1)]);
    let state = lab.state();
    let first = lab.command("60000", &["--seconds", "12", "--command", "0.3,0,0"]);
    let (code, _, errors) = crate::common::outcome(first);
    assert_eq!(code, 0, "{errors}");
    assert_eq!(status_of(&state)["last_good"]["version"], 1);
    lab.server.publish(standing(2));
    let mut robot = lab.walking();
    for _ in 0..3 {
        let looper = robot.started("rt");
        robot.hears_message("rising");
        kill(looper, Signal::SIGKILL).unwrap();
        robot.hears_message("the control loop died");
    }
    // The fourth start gets the last good one, within the number of starts that there are.
    robot.started("rt");
    let line = robot.hears_message("rising");
    assert_eq!(line["version"], 1, "{line}");
    robot.stop();
    let (code, summary, said) = robot.ended();
    assert_eq!((code, &summary["policy_version"]), (Some(0), &1.into()), "{said:#?}");
    let status = status_of(&state);
    assert_eq!(status["quarantined"][0]["policy"]["version"], 2, "{status}");
    lab.stop();
}

#[test]
fn fault_49_a_loop_that_keeps_dying_is_given_up() {
    let lab = Lab::with([standing(1)]);
    let mut robot = lab.walking();
    for death in 1..=4 {
        let looper = robot.started("rt");
        if death < 4 {
            robot.hears_message("rising");
            kill(looper, Signal::SIGKILL).unwrap();
            robot.hears_message("the control loop died");
        } else {
            kill(looper, Signal::SIGKILL).unwrap();
        }
    }
    let (code, _, said) = robot.ended();
    assert_eq!(code, Some(70), "{said:#?}");
    assert_eq!(told(&said, "died 4 times in a row"), 1, "{said:#?}");
    lab.stop();
}

#[test]
fn fault_38_a_loop_that_hangs_is_ended_and_started_again() {
    let lab = Lab::with([standing(1)]);
    let mut robot = Robot::start(lab.command("3000", &[]));
    let looper = robot.started("rt");
    robot.hears_message("rising");
    // Neither dead nor alive: what a policy that never comes back, or a port that never returns, looks like
    // from outside.
    kill(looper, Signal::SIGSTOP).unwrap();
    robot.hears_message("the loop hangs: ended");
    robot.started("rt");
    robot.hears_message("rising");
    assert!(gone(looper));
    robot.stop();
    let (code, summary, said) = robot.ended();
    assert_eq!((code, &summary["ended"]), (Some(0), &"signal".into()), "{said:#?}");
    lab.stop();
}

#[test]
fn fault_48_the_kill_button_works_with_the_loop_alive_and_with_the_loop_hung() {
    for hung in [false, true] {
        let lab = Lab::with([policy_file(1, |_, _| {})]);
        let key = lab.link_key();
        let link = ["--link-addr", "127.0.0.1:0", "--link-key", key.to_str().unwrap()];
        // Silence alone is noticed after this; braking after a kill is owed within a fifth of it.
        let mut robot = Robot::start(lab.command("30000", &link));
        let address = robot.hears_message("listening for commands")["address"].clone();
        let looper = robot.started("rt");
        robot.hears_message("rising");
        let mut driver = Driver::of(&address, &key);
        if hung {
            kill(looper, Signal::SIGSTOP).unwrap();
        }
        driver.says("k");
        if hung {
            let line = robot.hears_message("the loop hangs: ended");
            assert_eq!(line["deaf"], true, "{line}");
        }
        let (code, summary, said) = robot.ended();
        match hung {
            true => assert_eq!(code, Some(69), "{said:#?}"),
            false => {
                assert_eq!((code, &summary["ended"]), (Some(0), &"killed".into()), "{said:#?}")
            }
        }
        assert!(loops(&said) <= 1, "nothing starts again after a kill");
        drop(driver);
        lab.stop();
    }
}

#[test]
fn fault_48_the_kill_button_pressed_while_the_loop_is_down_keeps_it_down() {
    let lab = Lab::with([standing(1)]);
    let key = lab.link_key();
    let mut command = lab.command("60000", &["--link-addr", "127.0.0.1:0", "--link-key"]);
    command.arg(&key);
    let mut robot = Robot::start(command);
    let address = robot.hears_message("listening for commands")["address"].clone();
    let mut driver = Driver::of(&address, &key);
    driver.says("0,0,0");
    // After the third death in a row it is down for four seconds.
    for _ in 0..3 {
        let looper = robot.started("rt");
        kill(looper, Signal::SIGKILL).unwrap();
        robot.hears_message("the control loop died");
    }
    driver.says("k");
    let (code, _, said) = robot.ended();
    assert_eq!(code, Some(69), "{said:#?}");
    let line = "pressed while the loop was down";
    assert_eq!(told(&said, line), 1, "{said:#?}");
    assert_eq!(loops(&said), 3, "{said:#?}");
    lab.stop();
}

#[test]
fn a_terminal_that_closes_stands_the_robot_down() {
    let status = std::fs::read_to_string("/proc/self/status").unwrap();
    let ignored = status.lines().find_map(|line| line.strip_prefix("SigIgn:")).unwrap();
    if u64::from_str_radix(ignored.trim(), 16).unwrap() & 1 == 1 {
        eprintln!(
            "skipped: this process was started with SIGHUP ignored (nohup), and so is the robot's"
        );
        return;
    }
    let lab = Lab::with([standing(1)]);
    let mut robot = lab.walking();
    robot.hears_message("rising");
    kill(Pid::from_raw(robot.supervisor.id() as i32), Signal::SIGHUP).unwrap();
    let (code, summary, said) = robot.ended();
    assert_eq!((code, &summary["ended"]), (Some(0), &"signal".into()), "{said:#?}");
    lab.stop();
}

#[test]
fn fault_49_where_the_supervisor_is_killed_the_loop_stands_down_and_nothing_is_left() {
    let lab = Lab::with([standing(1)]);
    let mut robot = lab.walking();
    let (agent, looper) = (robot.started("agent"), robot.started("rt"));
    robot.hears_message("rising");
    robot.supervisor.kill().unwrap();
    // In order: its summary says that a signal ended it, after standing.
    let summary = robot.hears(|line| !line["ended"].is_null());
    assert_eq!(summary["ended"], "signal");
    let end = Instant::now() + PATIENCE;
    while !(gone(agent) && gone(looper)) {
        assert!(Instant::now() < end, "children are left");
        std::thread::sleep(Duration::from_millis(20));
    }
    lab.stop();
}

#[test]
fn a_second_program_on_the_same_folder_is_kept_out() {
    let lab = Lab::with([standing(1)]);
    let state = lab.state();
    let mut robot = lab.walking();
    robot.hears_message("rising");
    let mut second = program("agent", lab.server.address, &state);
    second.args(["--bus", "sim:127.0.0.1:1"]);
    let (code, _, errors) = crate::common::outcome(second);
    assert_eq!(code, 73, "{errors}");
    assert!(errors.contains("another process of this robot is running"), "{errors}");
    // Another run folder makes it no other robot: two agents would write over each other's state.
    for command in ["agent", "pull"] {
        let mut other = program(command, lab.server.address, &state);
        if command == "agent" {
            other.args(["--bus", "sim:127.0.0.1:1", "--run-dir"]);
            other.arg(lab.path("other"));
        }
        let (code, _, errors) = crate::common::outcome(other);
        assert_eq!(code, 73, "{command}: {errors}");
        assert!(errors.contains("another process of this robot is running"), "{errors}");
    }
    robot.stop();
    assert_eq!(robot.ended().0, Some(0));
    lab.stop();
}

#[test]
fn fault_16_a_robot_without_state_or_with_a_lost_one_runs_the_factory_policy() {
    let folder = tempfile::tempdir().unwrap();
    let (state, factory) = (folder.path().join("state"), folder.path().join("factory.onnx"));
    std::fs::write(&factory, standing(77)).unwrap();
    let nobody = "127.0.0.1:1".parse().unwrap();
    let run = |server, factory: Option<&Path>| {
        let mut command = program("run", server, &state);
        command.args(["--bus", &format!("sim:{}", perfect_robot()), "--seconds", "0.5"]);
        if let Some(factory) = factory {
            command.arg("--factory").arg(factory);
        }
        crate::common::outcome(command)
    };
    // Empty, and no server: nothing without a factory policy, it with one.
    assert_eq!(run(nobody, None).0, 69);
    let (code, summary, errors) = run(nobody, Some(&factory));
    assert_eq!((code, &summary["policy_stream"]), (0, &"(factory)".into()), "{errors}");
    assert_eq!(summary["policy_version"], 77);
    // With a server the server's newest runs; the factory policy left no trace.
    let server = Server::start(&folder.path().join("server"));
    server.publish(standing(3));
    let (code, summary, errors) = run(server.address, Some(&factory));
    assert_eq!((code, &summary["policy_version"]), (0, &3.into()), "{errors}");
    // Both copies of the state lost: nothing that a server says counts without proof, the factory policy
    // runs.
    for copy in ["state.json", "state.copy.json"] {
        std::fs::write(state.join(copy), "{").unwrap();
    }
    let (code, summary, errors) = run(server.address, Some(&factory));
    assert_eq!((code, &summary["policy_stream"]), (0, &"(factory)".into()), "{errors}");
    assert_eq!(run(server.address, None).0, 65);
    // A factory file that is not for this robot is said so before it is needed.
    let wrong = policy_file(1, |_, m| m.contract.robot = "newt".to_owned());
    std::fs::write(&factory, wrong).unwrap();
    let (code, _, errors) = run(server.address, Some(&factory));
    assert_eq!(code, 77, "{errors}");
    server.stop();
}

/// A pipe that is full to the brim, and nobody at its other end.
fn full_pipe() -> (std::io::PipeReader, std::io::PipeWriter) {
    let (reader, mut writer) = std::io::pipe().unwrap();
    let room = nix::fcntl::fcntl(&writer, nix::fcntl::FcntlArg::F_GETPIPE_SZ).unwrap();
    writer.write_all(&vec![b' '; room as usize]).unwrap();
    (reader, writer)
}

#[test]
fn a_log_that_nobody_reads_holds_neither_loop_nor_supervisor() {
    let lab = Lab::with([standing(1)]);
    let (reader, writer) = full_pipe();
    let mut command = lab.command("60000", &["--seconds", "1"]);
    command.stdout(Stdio::piped()).stderr(writer);
    let running = command.spawn().unwrap();
    // The first line of the log would be the end of it.
    let output = output_of(running);
    let said = String::from_utf8(output.stdout).unwrap();
    let summary: Value = serde_json::from_str(said.lines().last().unwrap()).unwrap();
    assert_eq!((output.status.code(), &summary["ended"]), (Some(0), &"time".into()), "{summary}");
    drop((command, reader));
    lab.stop();
}

#[test]
fn a_reader_of_the_summary_that_sleeps_holds_up_no_end() {
    let lab = Lab::with([standing(1)]);
    let (reader, writer) = full_pipe();
    let mut command = lab.command("60000", &["--seconds", "1"]);
    command.stdout(writer).stderr(Stdio::piped());
    let output = output_of(command.spawn().unwrap());
    let said = String::from_utf8(output.stderr).unwrap();
    // In order, with what it came to said where it can be, and not because somebody lost patience.
    assert_eq!(output.status.code(), Some(0), "{said}");
    assert!(said.contains("nobody reads standard output"), "{said}");
    assert!(!said.contains("the loop hangs: ended"), "{said}");
    drop((command, reader));
    lab.stop();
}

#[test]
fn a_loop_for_which_there_is_nothing_to_run_is_told_so_once() {
    let lab = Lab::with([]);
    let factory = lab.path("factory.onnx");
    std::fs::write(&factory, standing(77)).unwrap();
    let flags = ["--factory", factory.to_str().unwrap()];
    let mut robot = Robot::start(lab.command("60000", &flags));
    let looper = robot.started("rt");
    robot.hears_message("rising");
    // The only policy is spoilt while the robot runs, and the loop dies.
    let newt = policy_file(77, |_, m| m.contract.robot = "newt".to_owned());
    std::fs::write(&factory, newt).unwrap();
    kill(looper, Signal::SIGKILL).unwrap();
    robot.hears_message("the control loop died");
    let (code, _, said) = robot.ended();
    // Neither waited for, nor tried again and again.
    assert_eq!(code, Some(77), "{said:#?}");
    assert_eq!(loops(&said), 2, "the first, and one after its death: {said:#?}");
    let line = "error: no policy may run";
    assert_eq!(told(&said, line), 1, "{said:#?}");
    lab.stop();
}

#[test]
fn a_server_whose_versions_do_not_fit_this_robot_is_told_of_once() {
    let order = |version| policy_file(version, |_, m| m.contract.joint_names.swap(2, 3));
    let lab = Lab::with([order(1)]);
    let factory = lab.path("factory.onnx");
    std::fs::write(&factory, standing(77)).unwrap();
    let flags = ["--follow", "--factory", factory.to_str().unwrap()];
    let mut robot = Robot::start(lab.command("60000", &flags));
    robot.hears_message("rising");
    let refused = || {
        let status = status_of(&lab.state());
        status["quarantined"].as_array().map_or(0, Vec::len)
    };
    let end = Instant::now() + PATIENCE;
    for version in 2..=4 {
        lab.server.publish(order(version));
        while refused() < version as usize {
            assert!(Instant::now() < end, "version {version} was never looked at");
            std::thread::sleep(Duration::from_millis(50));
        }
    }
    robot.stop();
    let (code, summary, said) = robot.ended();
    // The robot walked on with what it had.
    assert_eq!((code, &summary["policy_stream"]), (Some(0), &"(factory)".into()), "{said:#?}");
    let text = "the newest version may not run on this robot";
    let told = |l: &&Value| l["message"].as_str().is_some_and(|m| m.contains(text));
    let lines: Vec<_> = said.iter().filter(told).collect();
    assert_eq!(lines.len(), 1, "{lines:#?}");
    let reason = lines[0]["reason"].as_str().unwrap();
    assert_eq!(reason, "joint 2 is `spine_4` in the policy and `spine_3` here");
    lab.stop();
}

#[test]
fn fault_28_over_a_network_of_two_seconds_that_breaks_newer_policies_arrive_and_the_robot_walks_on()
{
    let lab = Lab::with([standing(1)]);
    let wire = Wire::to(lab.server.address);
    // There and back.
    wire.set_delay_ms(1000);
    let mut command = program("run", wire.address, &lab.state());
    command.args(["--bus", &format!("sim:{}", perfect_robot()), "--follow"]).args([
        "--metrics-addr",
        "127.0.0.1:0",
        "--hang-ms",
        "60000",
    ]);
    let mut robot = Robot::start(command);
    robot.hears_message("rising");
    for version in 2..=4 {
        lab.server.publish(standing(version));
        // In the middle of finding out, or of fetching.
        walks_on(&lab.state(), 40 * version);
        if version < 4 {
            wire.cut();
            walks_on(&lab.state(), 25);
            wire.mend();
        }
        robot.hears(|line| line["message"] == "policy swapped in" && line["version"] == version);
    }
    robot.stop();
    let (code, summary, said) = robot.ended();
    assert_eq!((code, &summary["ended"]), (Some(0), &"signal".into()), "{said:#?}");
    // The loop's process knows nothing of all this, and was never started again.
    assert_eq!(
        (&summary["policy_version"], &summary["held_actions"]),
        (&4.into(), &0.into()),
        "{summary}"
    );
    assert_eq!(loops(&said), 1);
    lab.stop();
}

#[test]
fn fault_47_without_the_dead_mans_button_a_robot_that_asks_for_it_stands() {
    for (line, moves) in [("0.2,0,0", false), ("0.2,0,0,0", false), ("0.2,0,0,1", true)] {
        let lab = Lab::with([policy_file(1, |_, _| {})]);
        let key = lab.link_key();
        let link = ["--dead-man", "--link-addr", "127.0.0.1:0", "--link-key"];
        let mut command = lab.command("60000", &link);
        command.arg(&key);
        let mut robot = Robot::start(command);
        let address = robot.hears_message("listening for commands")["address"].clone();
        let mut driver = Driver::of(&address, &key);
        driver.says(line);
        robot.hears_message("rising");
        walks_on(&lab.state(), 250);
        robot.stop();
        let (code, summary, said) = robot.ended();
        drop(driver);
        assert_eq!(code, Some(0), "{said:#?}");
        let commanded = summary["commanded"]["vx_mps"].as_f64().unwrap();
        assert_eq!(commanded > 0.0, moves, "{line}: {summary}");
        lab.stop();
    }
}

#[test]
fn fault_30_a_state_folder_that_takes_no_word_of_the_loop_does_not_stop_the_robot() {
    let lab = Lab::with([standing(1)]);
    // A file where the loop's words should go.
    std::fs::create_dir_all(lab.state()).unwrap();
    std::fs::write(lab.state().join("told"), "").unwrap();
    let run_dir = lab.path("run");
    let flags = ["--seconds", "0.5", "--run-dir", run_dir.to_str().unwrap()];
    let (code, summary, errors) = crate::common::outcome(lab.command("60000", &flags));
    assert_eq!((code, &summary["ended"]), (0, &"time".into()), "{errors}");
    assert!(errors.contains("the state's disk takes nothing"), "{errors}");
    lab.stop();
}

#[test]
fn a_run_folder_that_others_may_use_is_refused() {
    use std::os::unix::fs::PermissionsExt;
    let lab = Lab::with([standing(1)]);
    let open = lab.path("open");
    std::fs::create_dir(&open).unwrap();
    std::fs::set_permissions(&open, std::fs::Permissions::from_mode(0o755)).unwrap();
    let flags = ["--run-dir", open.to_str().unwrap()];
    let (code, _, errors) = crate::common::outcome(lab.command("60000", &flags));
    assert_eq!(code, 73, "{errors}");
    assert!(errors.contains("may be used by others (mode 755"), "{errors}");
    // Its own is nobody else's.
    let flags = ["--seconds", "0.5"];
    assert_eq!(crate::common::outcome(lab.command("60000", &flags)).0, 0);
    let mode = std::fs::metadata(lab.state().join("run")).unwrap().permissions().mode();
    assert_eq!(mode & 0o777, 0o700);
    lab.stop();
}
