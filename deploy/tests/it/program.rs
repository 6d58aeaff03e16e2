//! The program from outside: a real policy server, a robot on a port, and what is left on the disk.

use std::io::{BufRead, BufReader};
use std::path::Path;
use std::time::Duration;

use crate::common::policies::{policy_file, standing};
use crate::common::{
    Server, end_of, ended, error_lines, outcome, perfect_robot, program, program_on, robot_program,
    start, status_of,
};
use caudata_runlog::{Axis, RunLog, Signal};
use nix::sys::signal::{Signal as Posix, kill};
use nix::unistd::Pid;
use serde_json::Value;

const NOBODY: &str = "127.0.0.1:1";

/// `run` for a short while on `robot`.
fn run(
    server: std::net::SocketAddr,
    state: &Path,
    robot: std::net::SocketAddr,
) -> std::process::Command {
    let mut command = program("run", server, state);
    command.args(["--bus", &format!("sim:{robot}"), "--seconds", "0.5"]);
    command
}

/// The only policy in the state's `blobs`.
fn blob(state: &Path) -> std::path::PathBuf {
    let files = std::fs::read_dir(state.join("blobs")).unwrap();
    let mut policies = files
        .map(|file| file.unwrap().path())
        .filter(|path| path.extension().is_some_and(|e| e == "onnx"));
    let file = policies.next().unwrap();
    assert!(policies.next().is_none());
    file
}

#[test]
fn pulls_runs_and_logs() {
    let folder = tempfile::tempdir().unwrap();
    let server = Server::start(&folder.path().join("server"));
    // It asks for the nominal pose; random weights ask for limits, which ends a trial.
    let still = policy_file(3, |spec, _| spec.layers[0].weight.fill(0.0));
    server.publish(still);
    let (state, log) = (folder.path().join("state"), folder.path().join("log"));

    let (code, pulled, errors) = outcome(program("pull", server.address, &state));
    assert_eq!((code, &pulled["policy"]["version"]), (0, &Value::from(3)), "{errors}");

    let mut command = run(server.address, &state, perfect_robot());
    command.args(["--command", "0.2,0,0", "--terrain", "flat", "--log-dir"]).arg(&log);
    let (code, summary, errors) = outcome(command);
    assert_eq!(code, 0, "{errors}");
    assert_eq!(summary["policy_version"], 3);
    assert_eq!(summary["policy_sha256"], pulled["policy"]["sha256"]);
    assert_eq!(summary["ended"], "time");
    assert_eq!(summary["held_actions"], 0);
    // 25 ticks of standing, 25 of walking, the way back, 25 of standing, at least.
    assert!(summary["ticks"].as_u64().unwrap() >= 75, "{summary}");
    assert!((summary["commanded"]["vx_mps"].as_f64().unwrap() - 0.2).abs() < 1e-6);
    // 4 mm per tick of 20 ms.
    assert!((summary["achieved"]["vx_mps"].as_f64().unwrap() - 0.2).abs() < 1e-3, "{summary}");

    let log = RunLog::read(&log).unwrap();
    assert_eq!(log.meta.terrain, "flat");
    assert!(log.meta.notes.contains(summary["policy_sha256"].as_str().unwrap()));
    let table = &log.table;
    assert_eq!(table.len() as u64, summary["log_rows"].as_u64().unwrap());
    assert_eq!(summary["log_rows"], summary["ticks"]);
    // Servos are where they were sent a tick before.
    let column = |signal: Signal| table.column(&signal).unwrap();
    let (sent, read) =
        (column(Signal::Command("FL_knee".into())), column(Signal::Position("FL_knee".into())));
    assert_eq!(sent[..sent.len() - 1], read[1..]);
    assert!(column(Signal::BasePosition(Axis::X)).iter().all(Option::is_some));
    assert!(column(Signal::Contact("HR".into())).iter().all(|c| *c == Some(1.0)));
    // A log is not overwritten.
    let mut again = run(server.address, &state, perfect_robot());
    again.arg("--log-dir").arg(folder.path().join("log"));
    let (code, _, errors) = outcome(again);
    assert_eq!((code, error_lines(&errors).len()), (73, 1), "{errors}");
    server.stop();
}

#[test]
fn a_bad_policy_is_refused_and_the_last_one_keeps_running() {
    let folder = tempfile::tempdir().unwrap();
    let state = folder.path().join("state");
    let server = Server::start(&folder.path().join("server"));
    let robot = perfect_robot();
    let order = policy_file(1, |_, m| m.contract.joint_names.swap(2, 3));
    server.publish_to("order", order);
    let run_on = |stream: &str| {
        let mut command = program_on(stream, "run", server.address, &state);
        command.args(["--bus", &format!("sim:{robot}"), "--seconds", "0.5"]);
        outcome(command)
    };
    // Nothing else to run: 77, one line, recorded.
    let (code, _, errors) = run_on("order");
    assert_eq!(code, 77, "{errors}");
    let reason = "joint 2 is `spine_4` in the policy and `spine_3` here";
    let line = format!("error: policy order version 1 refused: {reason}");
    assert_eq!(error_lines(&errors), [line]);
    assert_eq!(status_of(&state)["quarantined"][0]["reason"], reason);
    // It stays refused.
    let (code, _, errors) = run_on("order");
    assert_eq!(code, 77, "{errors}");
    assert!(errors.contains("refused before: joint 2"), "{errors}");

    server.publish(standing(2));
    let (code, _, errors) = outcome(program("pull", server.address, &state));
    assert_eq!(code, 0, "{errors}");
    let model = policy_file(3, |_, m| m.contract.robot_hash = "0".repeat(64));
    server.publish_to("model", model);
    let (code, summary, errors) = run_on("model");
    assert_eq!((code, &summary["policy_version"]), (0, &Value::from(2)), "{errors}");
    assert!(errors.contains("running what is on disk"), "{errors}");
    assert_eq!(status_of(&state)["active"]["version"], 2);
    let reason = status_of(&state)["quarantined"][1]["reason"].to_string();
    assert!(reason.contains("another robot: it is about robot model 000"), "{reason}");
    server.stop();
}

/// The robot file with one comment more, which makes it another model, in a folder of its own.
fn another_robot_file(folder: &Path) -> std::path::PathBuf {
    let original = Path::new(crate::common::policies::ROBOT_FILE.as_str());
    let mjcf = original.with_file_name("polymander.xml");
    std::fs::copy(mjcf, folder.join("polymander.xml")).unwrap();
    let path = folder.join("other.robot.toml");
    let text = std::fs::read_to_string(original).unwrap();
    std::fs::write(&path, text + "# edited\n").unwrap();
    path
}

#[test]
fn a_wrong_robot_file_does_not_cost_the_right_one_its_policy() {
    let folder = tempfile::tempdir().unwrap();
    let state = folder.path().join("state");
    let server = Server::start(&folder.path().join("server"));
    server.publish(standing(1));
    assert_eq!(outcome(program("pull", server.address, &state)).0, 0);

    let wrong_robot = another_robot_file(folder.path());
    for address in [server.address, NOBODY.parse().unwrap()] {
        let mut wrong = robot_program();
        wrong.args(["run", "--seconds", "0.5", "--stream", crate::common::STREAM]);
        wrong.args(["--bus", &format!("sim:{}", perfect_robot())]);
        wrong.arg("--robot").arg(&wrong_robot);
        wrong.args(["--policy-server", &address.to_string(), "--state"]);
        wrong.arg(&state);
        let (code, _, errors) = outcome(wrong);
        assert!(code == 77 || code == 69, "{code}: {errors}");
        assert!(errors.contains("trained on model"), "{errors}");
    }
    let now = status_of(&state);
    assert_eq!(now["active"]["version"], 1, "{now}");
    let refused = now["quarantined"][0]["robot"].as_str().unwrap();
    assert_eq!(refused.len(), 64, "{now}");

    // The right file again: with the server, and from the disk alone.
    let (code, summary, errors) = outcome(run(server.address, &state, perfect_robot()));
    assert_eq!((code, &summary["policy_version"]), (0, &Value::from(1)), "{errors}");
    let (code, _, errors) = outcome(run(NOBODY.parse().unwrap(), &state, perfect_robot()));
    assert_eq!(code, 0, "{errors}");
    server.stop();
}

#[test]
fn without_a_server_the_disk_is_enough_and_without_both_it_is_69() {
    let folder = tempfile::tempdir().unwrap();
    let state = folder.path().join("state");
    let robot = perfect_robot();
    let nobody = NOBODY.parse().unwrap();
    let (code, _, errors) = outcome(run(nobody, &state, robot));
    assert_eq!((code, error_lines(&errors).len()), (69, 1), "{errors}");

    let server = Server::start(&folder.path().join("server"));
    // A stream without a policy is as good as no server.
    let (code, _, errors) = outcome(run(server.address, &state, robot));
    assert_eq!(code, 69, "{errors}");
    server.publish(standing(4));
    assert_eq!(outcome(program("pull", server.address, &state)).0, 0);

    let (code, summary, errors) = outcome(run(nobody, &state, robot));
    assert_eq!((code, &summary["policy_version"]), (0, &Value::from(4)), "{errors}");
    assert!(errors.contains("does not answer"), "{errors}");

    // A truncated file on the disk is noticed, does not run, and is fetched again where there is a server.
    let file = blob(&state);
    let whole = std::fs::read(&file).unwrap();
    std::fs::write(&file, &whole[..whole.len() - 1]).unwrap();
    let (code, _, errors) = outcome(run(nobody, &state, robot));
    assert_eq!(code, 69, "{errors}");
    assert!(errors.contains("is damaged: its hash differs from its name"), "{errors}");
    let (code, _, errors) = outcome(run(server.address, &state, robot));
    assert_eq!(code, 0, "{errors}");
    assert_eq!(std::fs::read(&file).unwrap(), whole);
    server.stop();
}

#[test]
fn follows_newer_policies_while_it_walks_and_stops_on_a_signal() {
    let folder = tempfile::tempdir().unwrap();
    let state = folder.path().join("state");
    let server = Server::start(&folder.path().join("server"));
    server.publish(standing(1));
    let mut command = program("run", server.address, &state);
    command.args(["--bus", &format!("sim:{}", perfect_robot()), "--follow"]);
    let mut running = start(command);
    let mut said = BufReader::new(running.stderr.take().unwrap()).lines().map_while(Result::ok);
    let active = |version: u64| {
        // Bounded by the patience of whoever runs the tests; nothing is asserted about time.
        while status_of(&state)["active"]["version"] != version {
            std::thread::sleep(Duration::from_millis(50));
        }
    };
    active(1);
    server.publish(policy_file(2, |spec, _| spec.layers[0].weight.fill(3e38)));
    while status_of(&state)["quarantined"].as_array().is_none_or(Vec::is_empty) {
        std::thread::sleep(Duration::from_millis(50));
    }
    server.publish(standing(3));
    active(3);
    // The loop takes it over at a safe moment.
    let mut errors = String::new();
    for line in said.by_ref() {
        errors += &line;
        if line.contains("policy swapped in") {
            break;
        }
    }
    kill(Pid::from_raw(running.id() as i32), Posix::SIGTERM).unwrap();
    let (code, summary, _) = ended(running);
    errors.extend(said);
    assert_eq!((code, &summary["ended"]), (0, &Value::from("signal")), "{errors}");
    assert_eq!(summary["policy_version"], 3, "{errors}");
    assert_eq!(summary["policy_swaps"], 1);
    assert!(errors.contains("beyond ±1000"), "{errors}");
    server.stop();
}

#[test]
fn wrong_input_has_its_own_codes() {
    let folder = tempfile::tempdir().unwrap();
    let state = folder.path().join("state");
    let nobody: std::net::SocketAddr = NOBODY.parse().unwrap();
    let check = |command: std::process::Command, expected: i32| {
        let (code, _, errors) = outcome(command);
        assert_eq!(code, expected, "{errors}");
        assert!(errors.contains("error: "), "{errors}");
    };
    let mut flag = program("run", nobody, &state);
    flag.args(["--bus", "can0"]);
    check(flag, 64);
    let mut command = program("run", nobody, &state);
    command.args(["--bus", "sim:127.0.0.1:1", "--command", "0.2,x,0"]);
    check(command, 64);
    let mut missing = robot_program();
    missing.args(["pull", "--robot", "no/such.robot.toml", "--stream", "s", "--state"]).arg(&state);
    check(missing, 66);
    std::fs::create_dir_all(&state).unwrap();
    for copy in ["state.json", "state.copy.json"] {
        std::fs::write(state.join(copy), "{").unwrap();
    }
    check(program("pull", nobody, &state), 65);
    for copy in ["state.json", "state.copy.json"] {
        std::fs::remove_file(state.join(copy)).unwrap();
    }
    // A policy, but no robot.
    let server = Server::start(&folder.path().join("server"));
    server.publish(standing(1));
    let mut nowhere = program("run", server.address, &state);
    nowhere.args(["--bus", "sim:127.0.0.1:1"]);
    check(nowhere, 69);
    server.stop();
}

#[test]
fn faults_14_and_22_a_robot_that_trusts_a_key_takes_signed_policies_only() {
    let folder = tempfile::tempdir().unwrap();
    let state = folder.path().join("state");
    let server = Server::start(&folder.path().join("server"));
    let key = caudata_signing::ReleaseKey::from_seed("release", &[7; 32]);
    let other = caudata_signing::ReleaseKey::from_seed("release", &[8; 32]);
    let trust = folder.path().join("trust.toml");
    std::fs::write(&trust, key.trust_file()).unwrap();
    let pull = || {
        let mut command = program("pull", server.address, &state);
        command.arg("--trust").arg(&trust);
        outcome(command)
    };
    server.publish(standing(1));
    let (code, _, errors) = pull();
    assert_eq!(code, 77, "{errors}");
    assert!(errors.contains("0 valid signatures"), "{errors}");
    server.publish_signed(standing(2), &other);
    assert_eq!(pull().0, 77, "another key under the same name");
    server.publish_signed(standing(3), &key);
    let (code, pulled, errors) = pull();
    assert_eq!((code, &pulled["policy"]["version"]), (0, &3.into()), "{errors}");
    // Nothing that was not signed left a trace.
    assert_eq!(status_of(&state)["quarantined"], serde_json::json!([]));
    server.stop();
}

#[test]
fn fault_23_a_robot_whose_trust_file_was_followed_by_another_takes_what_the_new_keys_sign_only() {
    use caudata_signing::{ReleaseKey, add_signature, successor_path};
    let folder = tempfile::tempdir().unwrap();
    let state = folder.path().join("state");
    let server = Server::start(&folder.path().join("server"));
    let key = |name: &str, seed: u8| ReleaseKey::from_seed(name, &[seed; 32]);
    let (old, new) = (key("release-1", 1), key("release-2", 2));
    let (old_root, new_root) = (key("root-1", 3), key("root-2", 4));
    let trust = folder.path().join("trust.toml");
    let first = old.trust_file() + &old_root.trust_lines("root_key");
    std::fs::write(&trust, first).unwrap();
    let pull = || {
        let mut command = program("pull", server.address, &state);
        command.arg("--trust").arg(&trust);
        outcome(command)
    };
    server.publish_signed(standing(1), &old);
    assert_eq!(pull().0, 0);
    let second = new.trust_file().replacen("threshold = 1\n", "threshold = 1\nversion = 2\n", 1)
        + &new_root.trust_lines("root_key");
    let file = successor_path(&trust, 2);
    std::fs::write(&file, &second).unwrap();
    add_signature(&file, &new_root.sign_trust(&second)).unwrap();
    // Signed by its own keys alone: somebody else's. What is not in force is not passed over.
    let (code, _, errors) = pull();
    assert_eq!(code, 65, "{errors}");
    assert!(errors.contains("the old root keys signed it 0 times"), "{errors}");
    add_signature(&file, &old_root.sign_trust(&second)).unwrap();
    server.publish_signed(standing(2), &old);
    let (code, _, errors) = pull();
    assert_eq!(code, 77, "{errors}");
    assert!(errors.contains("0 valid signatures"), "{errors}");
    server.publish_signed(standing(3), &new);
    let (code, pulled, errors) = pull();
    assert_eq!((code, &pulled["policy"]["version"]), (0, &3.into()), "{errors}");
    assert_eq!(status_of(&state)["trust_version"], 2);
    // The newest file is lost, and with it what it gave up: the old key signs again.
    std::fs::remove_file(&file).unwrap();
    server.publish_signed(standing(4), &old);
    let (code, _, errors) = pull();
    assert_eq!(code, 65, "{errors}");
    assert!(errors.contains("version 1 is in force, and on this robot version 2 was"), "{errors}");
    // The loop's process looks for itself, whatever became of the agent.
    let looper = || {
        let mut looper = program("rt", server.address, &state);
        looper.args(["--bus", &format!("sim:{}", perfect_robot())]);
        looper.args(["--seconds", "1"]);
        looper
    };
    let mut trusting = looper();
    trusting.arg("--trust").arg(&trust);
    let (code, _, errors) = outcome(trusting);
    assert_eq!(code, 65, "{errors}");
    assert!(errors.contains("on this robot version 2 was"), "{errors}");
    // Nor may the flag be left out, in either process.
    for command in [program("pull", server.address, &state), looper()] {
        let (code, _, errors) = outcome(command);
        assert_eq!(code, 65, "{errors}");
        assert!(
            errors.contains("trust file version 2 was in force on this robot and none is given"),
            "{errors}"
        );
    }
    server.stop();
}

/// A library that, preloaded, gives a program a wrong wall clock. The C compiler is the one that this
/// repository needs anyway.
fn moved_clock(folder: &Path) -> std::path::PathBuf {
    let library = folder.join("moved_clock.so");
    let compiler = std::env::var("CXX").unwrap_or_else(|_| "c++".to_owned());
    let source = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/moved_clock.c");
    let compiled = std::process::Command::new(compiler)
        .args(["-x", "c", "-shared", "-fPIC", "-o"])
        .arg(&library)
        .args([source, "-ldl"])
        .status();
    assert!(compiled.unwrap().success());
    library
}

#[test]
fn fault_18_in_1970_in_2100_and_a_day_back_the_same_is_taken_and_the_same_refused() {
    use caudata_signing::ReleaseKey;
    let folder = tempfile::tempdir().unwrap();
    let library = moved_clock(folder.path());
    let now = i64::try_from(std::time::UNIX_EPOCH.elapsed().unwrap().as_secs()).unwrap();
    let (release, fresh) =
        (ReleaseKey::from_seed("release", &[7; 32]), ReleaseKey::from_seed("server", &[9; 32]));
    let trust = folder.path().join("trust.toml");
    std::fs::write(&trust, release.trust_file() + &fresh.trust_lines("fresh_key")).unwrap();
    let servers = ["old", "new"].map(|name| {
        let key = ReleaseKey::from_seed("server", &[9; 32]);
        Server::proving(&folder.path().join(name), key)
    });
    servers[0].publish_signed(standing(1), &release);
    servers[1].publish_signed(standing(2), &release);
    // By how much, when it is put back by a day, and how its log is dated then.
    let clocks = [
        (0, 0, ""),
        (1_000_000 - now, 0, "1970-01-1"),
        (4_102_444_800 - now, 0, "2100-01-01"),
        (86_400 - now, 1, "1970-01-01"),
    ];
    for (number, (off, step, dated)) in clocks.into_iter().enumerate() {
        let state = folder.path().join(format!("state-{number}"));
        let under = |command: &str, server: &Server| {
            let mut command = program(command, server.address, &state);
            command
                .arg("--trust")
                .arg(&trust)
                .env("LD_PRELOAD", &library)
                .env("CAUDATA_TEST_CLOCK", off.to_string())
                .env("CAUDATA_TEST_CLOCK_STEP", step.to_string());
            command
        };
        let (code, pulled, errors) = outcome(under("pull", &servers[1]));
        assert_eq!((code, &pulled["policy"]["version"]), (0, &2.into()), "{dated}: {errors}");
        // It walks as long as it was asked to, whatever the date does meanwhile.
        let mut run = under("run", &servers[1]);
        run.args(["--bus", &format!("sim:{}", perfect_robot())]).args([
            "--hang-ms",
            "60000",
            "--follow",
            "--seconds",
            "3",
        ]);
        let (code, summary, errors) = outcome(run);
        assert_eq!((code, &summary["ended"]), (0, &"time".into()), "{errors}");
        assert!((summary["walked_s"].as_f64().unwrap() - 3.0).abs() < 0.1);
        let dates = format!("\"timestamp\":\"{dated}");
        assert!(errors.contains(&dates), "{dated}: {errors}");
        // Older, proved and signed: refused, and for that.
        let (code, _, errors) = outcome(under("pull", &servers[0]));
        assert_eq!(code, 77, "{dated}: {errors}");
        assert!(errors.contains("offers an older version"), "{errors}");
        assert_eq!(status_of(&state)["active"]["version"], 2);
    }
    servers.into_iter().for_each(Server::stop);
}

/// A command whose files, each, may hold `kib` KiB, as on a disk that is nearly full: writing on is refused
/// with an error.
fn on_a_small_disk(command: &std::process::Command, kib: u32) -> std::process::Command {
    let mut small = std::process::Command::new("sh");
    // POSIX counts in halves of a KiB. The signal that comes with the error is for programs that do not look
    // at errors.
    let blocks = 2 * kib;
    small
        .arg("-c")
        .arg(format!("trap '' XFSZ; ulimit -f {blocks}; exec \"$0\" \"$@\""))
        .arg(command.get_program())
        .args(command.get_args());
    small
}

#[test]
fn fault_54_a_full_disk_for_the_log_does_not_touch_the_walk() {
    let folder = tempfile::tempdir().unwrap();
    let (state, log) = (folder.path().join("state"), folder.path().join("log"));
    let server = Server::start(&folder.path().join("server"));
    server.publish(standing(1));
    let with_log = |seconds: &str| {
        let mut command = program("run", server.address, &state);
        command
            .args(["--bus", &format!("sim:{}", perfect_robot())])
            .args(["--seconds", seconds, "--log-dir"])
            .arg(&log);
        command
    };
    // A row is some hundreds of bytes: of five seconds' rows most do not fit.
    let (code, summary, errors) = outcome(on_a_small_disk(&with_log("5"), 64));
    // It walked as long as it was asked to, once, and the summary says so before the error.
    assert_eq!((code, &summary["ended"]), (74, &"time".into()), "{errors}");
    assert!((summary["walked_s"].as_f64().unwrap() - 5.0).abs() < 0.1);
    assert_eq!(summary["held_actions"], 0);
    assert_eq!(error_lines(&errors).len(), 1, "{errors}");
    assert!(error_lines(&errors)[0].contains("flight log"), "{errors}");
    assert!(!folder.path().join("log-2").exists(), "one walk");
    server.stop();
}

#[test]
fn fault_31_the_child_that_tries_a_candidate_is_held_in_memory_and_time() {
    let bytes = standing(1);
    let sha256 = caudata_policy::PolicyFile::parse(bytes.as_slice().into()).unwrap().sha256_hex();
    let mut child = robot_program()
        .args(["probe", "--robot", crate::common::policies::ROBOT_FILE.as_str()])
        .args(["--stream", "s", "--version-number", "1", "--file-version", "1"])
        .args(["--sha256", &sha256])
        .stdin(std::process::Stdio::piped())
        .spawn()
        .unwrap();
    // It limits itself before it looks at the first byte, and that one has not come yet.
    let limits = format!("/proc/{}/limits", child.id());
    let limit = |name: &str| {
        let text = std::fs::read_to_string(&limits).unwrap();
        let line = text.lines().find_map(|line| line.strip_prefix(name));
        let words: Vec<String> = line.unwrap().split_whitespace().map(String::from).collect();
        [words[0].clone(), words[1].clone()]
    };
    let end = std::time::Instant::now() + Duration::from_secs(120);
    let mut comes_to = |name: &str, wanted: [&str; 2]| {
        while limit(name) != wanted {
            let alive = child.try_wait().unwrap().is_none();
            let may_come = alive && std::time::Instant::now() < end;
            assert!(may_come, "{name}: it does not limit itself");
            std::thread::sleep(Duration::from_millis(5));
        }
    };
    comes_to("Max cpu time", ["10", "10"]);
    let gib_2 = (2_u64 << 30).to_string();
    assert_eq!(limit("Max address space"), [gib_2.clone(), gib_2]);
    comes_to("Max core file size", ["0", "0"]);
    // Within them a good candidate passes.
    let mut input = child.stdin.take().unwrap();
    std::io::Write::write_all(&mut input, &bytes).unwrap();
    drop(input);
    assert!(end_of(&mut child).success());
}
