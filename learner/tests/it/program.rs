//! The program as its supervisor sees it: signals, exit codes, one clear line.

use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Child, Command, Output, Stdio};

use caudata_telemetry::progress::Event;
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;

const PROGRAM: &str = env!("CARGO_BIN_EXE_caudata-learner");

fn arguments(folder: &Path, iterations: u64) -> Vec<String> {
    let folder = folder.to_str().unwrap();
    let mut arguments: Vec<String> =
        ["--preset", "quick", "--inproc", "--run-dir", folder, "--run-id", "test"]
            .map(str::to_owned)
            .to_vec();
    let robot = concat!(env!("CARGO_MANIFEST_DIR"), "/../robots/polymander.robot.toml");
    let more = [format!("robot=\"{robot}\""), format!("run.iterations={iterations}")];
    for text in crate::common::tiny::TINY.iter().map(|&text| text.to_owned()).chain(more) {
        arguments.extend(["--set".to_owned(), text]);
    }
    arguments
}

fn learner(arguments: &[String]) -> Output {
    Command::new(PROGRAM).args(arguments).output().unwrap()
}

fn error_line(output: &Output) -> String {
    let text = String::from_utf8_lossy(&output.stderr).into_owned();
    text.lines().find(|line| line.starts_with("error: ")).unwrap_or(&text).to_owned()
}

fn start(arguments: &[String]) -> Child {
    Command::new(PROGRAM)
        .args(arguments)
        .stdout(Stdio::piped())
        .stderr(Stdio::null())
        .spawn()
        .unwrap()
}

fn events(child: &mut Child) -> impl Iterator<Item = Event> {
    let out = BufReader::new(child.stdout.take().unwrap());
    out.lines().map(|line| serde_json::from_str(&line.unwrap()).unwrap())
}

#[test]
fn a_signal_ends_the_run_in_good_order_and_it_can_be_resumed() {
    for signal in [Signal::SIGTERM, Signal::SIGINT] {
        let dir = tempfile::tempdir().unwrap();
        let mut child = start(&arguments(dir.path(), 100_000));
        let pid = Pid::from_raw(child.id() as i32);
        let mut last = None;
        for event in events(&mut child) {
            if matches!(&event, Event::Iteration(done) if done.iteration == 3) {
                kill(pid, signal).unwrap();
            }
            last = Some(event);
        }
        assert_eq!(child.wait().unwrap().code(), Some(0));
        let Some(Event::Finished(finished)) = last else { panic!("{last:?}") };
        assert_eq!(finished.reason, signal.as_str());
        assert!(finished.iteration >= 3);
        assert!(Path::new(&finished.checkpoint_path).join("SHA256SUMS").exists());

        let mut more = arguments(dir.path(), finished.iteration + 2);
        more.push("--resume".into());
        let mut child = start(&more);
        let all: Vec<Event> = events(&mut child).collect();
        assert_eq!(child.wait().unwrap().code(), Some(0));
        let Some(Event::Finished(resumed)) = all.last() else { panic!("{all:?}") };
        assert_eq!(resumed.iteration, finished.iteration + 2);
        assert_eq!(resumed.reason, "completed");
    }
}

/// As after `kill -9` of a supervisor and `--resume` at once: the first learner still saves when the second
/// comes.
#[test]
fn a_second_learner_of_a_folder_waits_for_the_first_and_goes_on_where_that_ended() {
    let dir = tempfile::tempdir().unwrap();
    let mut first = start(&arguments(dir.path(), 100_000));
    let pid = Pid::from_raw(first.id() as i32);
    let mut heard = events(&mut first);
    heard.find(|event| matches!(event, Event::Iteration(done) if done.iteration == 3)).unwrap();
    let mut more = arguments(dir.path(), 1_000_000);
    more.push("--resume".into());
    let mut second = start(&more);
    let stopper = std::thread::spawn(move || {
        std::thread::sleep(std::time::Duration::from_millis(500));
        kill(pid, Signal::SIGTERM).unwrap();
    });
    let Some(Event::Finished(ended)) = heard.last() else { panic!("no last word") };
    stopper.join().unwrap();
    assert_eq!(first.wait().unwrap().code(), Some(0));
    let Some(Event::Started(started)) = events(&mut second).next() else {
        panic!("it did not start")
    };
    assert_eq!(started.iteration, ended.iteration);
    second.kill().unwrap();
    second.wait().unwrap();
}

#[test]
fn a_learner_that_is_watched_says_between_its_events_that_it_is_alive() {
    let dir = tempfile::tempdir().unwrap();
    let mut watched = arguments(dir.path(), 100_000);
    watched.push("--heartbeat".into());
    let mut child = start(&watched);
    let out = BufReader::new(child.stdout.take().unwrap());
    let (mut alive, mut iterations) = (0, 0);
    for line in out.lines().map(Result::unwrap) {
        match line.as_str() {
            caudata_actor::ALIVE => alive += 1,
            line => {
                let event: Event = serde_json::from_str(line).unwrap();
                iterations += u32::from(matches!(event, Event::Iteration(_)));
            }
        }
        if alive >= 2 && iterations >= 2 {
            break;
        }
    }
    child.kill().unwrap();
    child.wait().unwrap();
}

#[test]
fn each_kind_of_bad_input_has_its_line_and_code() {
    let dir = tempfile::tempdir().unwrap();
    let with = |more: &[&str]| {
        let mut arguments = arguments(dir.path(), 2);
        arguments.extend(more.iter().map(|&text| text.to_owned()));
        learner(&arguments)
    };
    let unknown = with(&["--set", "learner.ppo.gama=0.9"]);
    assert_eq!(unknown.status.code(), Some(64));
    assert!(error_line(&unknown).contains("gamma"), "{}", error_line(&unknown));
    assert_eq!(with(&["--no-such-flag"]).status.code(), Some(64));

    let robot = dir.path().join("wrong.robot.toml");
    std::fs::write(&robot, "name = 3").unwrap();
    let wrong_robot = with(&["--set", &format!("robot=\"{}\"", robot.display())]);
    assert_eq!(wrong_robot.status.code(), Some(65), "{}", error_line(&wrong_robot));
    assert!(error_line(&wrong_robot).contains("wrong.robot.toml"));

    let taken = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let addr = taken.local_addr().unwrap().to_string();
    let port = with(&["--metrics-addr", &addr]);
    assert_eq!(port.status.code(), Some(71));
    assert!(error_line(&port).contains(&addr), "{}", error_line(&port));
    assert!(!dir.path().join("checkpoints").exists(), "nothing was trained");
}

#[test]
fn a_damaged_checkpoint_and_a_full_disk_lose_nothing() {
    let dir = tempfile::tempdir().unwrap();
    assert!(learner(&arguments(dir.path(), 2)).status.success());
    let good = dir.path().join("checkpoints/iter_000002/state.safetensors");
    let before = std::fs::read(&good).unwrap();

    // Files may not grow beyond 8 KiB: what a full disk does, without filling one.
    let mut more = arguments(dir.path(), 8);
    more.push("--resume".into());
    let script = "trap '' XFSZ; ulimit -f 8; exec \"$0\" \"$@\"";
    let full = Command::new("bash").args(["-c", script, PROGRAM]).args(&more).output().unwrap();
    assert_eq!(full.status.code(), Some(74), "{}", error_line(&full));
    assert!(error_line(&full).contains("disk full"), "{}", error_line(&full));
    assert_eq!(std::fs::read(&good).unwrap(), before);
    let resumed = learner(&more);
    assert!(resumed.status.success(), "{}", error_line(&resumed));

    let latest = dir.path().join("checkpoints/iter_000008/meta.json");
    let text = std::fs::read_to_string(&latest).unwrap();
    std::fs::write(&latest, text.replace("\"iteration\": 8", "\"iteration\": 9")).unwrap();
    let tampered = learner(&more);
    assert_eq!(tampered.status.code(), Some(78));
    assert!(error_line(&tampered).contains("iter_000008"), "{}", error_line(&tampered));
    let hint = String::from_utf8_lossy(&tampered.stderr).into_owned();
    assert!(hint.contains("hint: iter_000006 is whole"), "{hint}");
}
