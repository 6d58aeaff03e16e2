//! FAULTS.md section 4, "Rollouts and actors", against the real programs. The faults of a single crate have
//! their tests there (docs/reference/faults-actors.md has the table); here is what needs several processes.

use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::mpsc::{Receiver, sync_channel};
use std::time::{Duration, Instant};

use caudata_tests::{json_file, train};
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use serde_json::Value;

/// Longest wait for anything. Only a hang reaches it.
const PATIENCE: Duration = Duration::from_secs(300);

/// A `caudata train --json` over zenoh whose events can be waited for.
struct Run {
    child: Child,
    lines: Receiver<String>,
}

impl Run {
    fn start(out: &Path, extra: &[&str]) -> Self {
        let mut flags = vec!["--transport", "zenoh", "--set", "learner.checkpoint_every=2"];
        flags.extend(extra);
        let mut child = train(out, &flags)
            .unwrap()
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        let stdout = BufReader::new(child.stdout.take().unwrap());
        let (sender, lines) = sync_channel(4096);
        std::thread::spawn(move || {
            for line in stdout.lines().map_while(Result::ok) {
                if sender.send(line).is_err() {
                    return;
                }
            }
        });
        Self { child, lines }
    }

    /// The next event of this kind.
    fn wait_for(&self, kind: &str) -> Value {
        let deadline = Instant::now() + PATIENCE;
        loop {
            let left = deadline.saturating_duration_since(Instant::now());
            let line = self.lines.recv_timeout(left).expect(kind);
            let event: Value = serde_json::from_str(&line).unwrap();
            if event["event"] == kind {
                return event;
            }
        }
    }

    /// Waits until `count` more iterations are done.
    fn iterations(&self, count: usize) -> u64 {
        let last = (0..count).map(|_| self.wait_for("iteration")).next_back().unwrap();
        last["iteration"].as_u64().unwrap()
    }

    /// The process of a child whose command line has all these words.
    fn process(&self, words: &[&str]) -> Pid {
        let deadline = Instant::now() + PATIENCE;
        loop {
            if let Some(pid) = child_of(self.child.id(), words) {
                return pid;
            }
            assert!(Instant::now() < deadline, "no process {words:?}");
            std::thread::sleep(Duration::from_millis(50));
        }
    }

    /// As Ctrl-C.
    fn stop(&self) {
        let own = Pid::from_raw(self.child.id().try_into().unwrap());
        kill(own, Signal::SIGTERM).unwrap();
    }

    /// Waits for the end; the exit code and the last line.
    fn end(mut self) -> (Option<i32>, Value) {
        let mut last = Value::Null;
        while let Ok(line) = self.lines.recv_timeout(PATIENCE) {
            last = serde_json::from_str(&line).unwrap();
        }
        (self.child.wait().unwrap().code(), last)
    }
}

impl Drop for Run {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn child_of(parent: u32, words: &[&str]) -> Option<Pid> {
    let output =
        Command::new("ps").args(["-o", "pid=,args=", "--ppid", &parent.to_string()]).output();
    let text = String::from_utf8_lossy(&output.ok()?.stdout).into_owned();
    text.lines().find_map(|line| {
        let (pid, arguments) = line.trim().split_once(' ')?;
        if !words.iter().all(|word| arguments.contains(word)) {
            return None;
        }
        Some(Pid::from_raw(pid.parse().ok()?))
    })
}

fn books(out: &Path) -> Value {
    let books = json_file(&out.join("accounting.json")).unwrap();
    assert_eq!(books["holds"], true, "{books}");
    let number = |key: &str| books[key].as_u64().unwrap();
    let fates = ["accepted", "rejected", "dropped", "waiting"].map(number);
    assert_eq!(number("sent"), fates.iter().sum::<u64>(), "{books}");
    assert_eq!(number("duplicates"), 0, "{books}");
    books
}

/// 59, at the level of a run: killed in the middle of its work, an actor is replaced by its next incarnation,
/// and what it had sent is accounted for.
#[test]
fn fault_59_a_killed_actor_is_replaced_and_its_chunks_are_accounted_for() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("run");
    let run = Run::start(&out, &["--iterations", "100000", "--set", "learner.batch_timeout_s=2"]);
    run.iterations(3);
    kill(run.process(&["caudata-actor", "--actor-id 1 "]), Signal::SIGKILL).unwrap();
    run.process(&["caudata-actor", "--actor-id 1 ", "--incarnation 1 "]);
    run.iterations(10);
    run.stop();
    let (code, _) = run.end();
    assert_eq!(code, Some(0));
    let books = books(&out);
    let of_actor: Vec<&Value> =
        books["actors"].as_array().unwrap().iter().filter(|a| a["actor_id"] == 1).collect();
    assert_eq!(of_actor.len(), 2, "{books}");
}

/// SIGSTOP on an actor: the process is there, and does nothing. It gets killed and replaced.
#[test]
fn fault_60_a_hung_actor_is_noticed_and_replaced() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("run");
    let run = Run::start(
        &out,
        &[
            "--iterations",
            "100000",
            "--set",
            "learner.batch_timeout_s=2",
            "--set",
            "cluster.hang_timeout_s=10",
        ],
    );
    run.iterations(3);
    kill(run.process(&["caudata-actor", "--actor-id 0 "]), Signal::SIGSTOP).unwrap();
    run.process(&["caudata-actor", "--actor-id 0 ", "--incarnation 1 "]);
    run.iterations(3);
    run.stop();
    let (code, last) = run.end();
    assert_eq!((code, last["stopped"].as_str()), (Some(0), Some("SIGTERM")));
    books(&out);
}

/// 60: the learner stands still for ten seconds, longer than the peer time-out; the actors wait, and no chunk
/// counts twice.
#[test]
fn fault_60_a_learner_that_stands_still_for_ten_seconds_loses_nothing() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("run");
    let run = Run::start(&out, &["--iterations", "100000"]);
    run.iterations(3);
    let learner = run.process(&["caudata-learner"]);
    kill(learner, Signal::SIGSTOP).unwrap();
    std::thread::sleep(Duration::from_secs(10));
    kill(learner, Signal::SIGCONT).unwrap();
    run.iterations(20);
    run.stop();
    let (code, _) = run.end();
    assert_eq!(code, Some(0));
    let books = books(&out);
    assert_eq!(books["rejected"], 0, "{books}");
    assert_eq!(books["actors"].as_array().unwrap().len(), 2, "nobody was replaced: {books}");
}

/// 60: the learner is killed; the run goes on from its checkpoint, and what was sent after it is accounted
/// for as rolled back.
#[test]
fn fault_60_a_killed_learner_goes_on_from_its_checkpoint() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("run");
    let run = Run::start(&out, &["--iterations", "100000"]);
    run.wait_for("checkpoint");
    let reached = run.iterations(5);
    kill(run.process(&["caudata-learner"]), Signal::SIGKILL).unwrap();
    let (code, last) = run.end();
    assert_ne!(code, Some(0));
    // It went on until the signal arrived, and may have saved one iteration more than it told of.
    let told = last["iteration"].as_u64().unwrap_or(reached).max(reached);
    let goal = (reached + 20).to_string();
    let again = Run::start(&out, &["--resume", "--iterations", &goal]);
    let started = again.wait_for("started");
    let from = started["iteration"].as_u64().unwrap();
    assert!((2..=told + 1).contains(&from), "told of {told}: {started}");
    let (code, _) = again.end();
    assert_eq!(code, Some(0));
    books(&out);
}
