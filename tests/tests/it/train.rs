//! Training from the outside: real processes, small networks, every transport, stop, resume, kill.

use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};

use caudata_tests::{Finished, command, finish, json_file, train};
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use serde_json::Value;

fn ended_well(finished: &Finished) -> Value {
    assert_eq!(finished.code, Some(0), "{}\n{}", finished.stdout, finished.stderr);
    finished.last_json().unwrap()
}

fn account_holds(report: &Value) {
    let account = &report["accounting"];
    let count = |key: &str| account[key].as_u64().unwrap_or_else(|| panic!("{key} in {account}"));
    assert!(count("sent") > 0, "{account}");
    assert_eq!(
        count("sent"),
        count("accepted") + count("rejected") + count("dropped") + count("lost"),
        "{account}"
    );
    assert_eq!(account["holds"], true, "{account}");
}

/// Trains a few iterations over `transport` and runs the policy on the simulated robot: the whole way, end to
/// end.
fn trains_end_to_end(transport: &str) {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("run");
    let flags = [
        "--transport",
        transport,
        "--iterations",
        "4",
        "--set",
        "learner.publish_every=1",
        "--set",
        "evaluation.robot_run_s=1",
        "--set",
        "evaluation.episodes=1",
    ];
    let report = ended_well(&finish(train(&out, &flags).unwrap()).unwrap());
    account_holds(&report);
    assert_eq!(report["finished"]["iteration"], 4);
    assert_eq!(report["finished"]["reason"], "completed");
    // One file everywhere: learner, run folder, server, robot, and with the actors a version that the server
    // has.
    let policy = &report["policy"];
    assert_eq!(policy["same"], true, "{policy}");
    let actors = &policy["actors"];
    // The last one is not run by them; one that the server has no time for is passed over.
    let version = actors["version"].as_u64().unwrap();
    assert!((1..=3).contains(&version), "{actors}");
    assert!(actors["actors"].is_string() && actors["actors"] == actors["server"], "{actors}");
    assert_eq!(policy["learner"], policy["robot"], "{policy}");
    chosen(&report);
    for name in
        ["config.toml", "git.txt", "policy.onnx", "report.json", "progress.jsonl", "robot/log.csv"]
    {
        assert!(out.join(name).is_file(), "{name} is missing");
    }
    // the learner's, and the evaluation's
    let events = files_like(&out, "events.out.tfevents");
    assert_eq!(events.len(), 2);
    let tells_falls = |file: &&PathBuf| {
        let bytes = std::fs::read(file).unwrap();
        bytes.windows(22).any(|tag| tag == b"Evaluation/fall_share\x15")
    };
    assert_eq!(events.iter().filter(tells_falls).count(), 1);
    assert!(!files_like(&out.join("curves"), ".svg").is_empty());
    samples(&out);
    assert_eq!(json_file(&out.join("report.json")).unwrap()["policy"], *policy);
}

/// The newest of the versions that miss the fewest commands is the policy; nothing walks after four iterations.
fn chosen(report: &Value) {
    let choice = &report["choice"];
    let tried = choice["tried"].as_array().unwrap();
    let missed = |t: &Value| t["missed"].as_array().unwrap().len();
    let fewest = tried.iter().map(missed).min().unwrap();
    let best = tried.iter().find(|t| missed(t) == fewest).unwrap();
    assert!(tried[0]["version"] == 4 && fewest > 0, "{choice}");
    assert_eq!(choice["version"], best["version"], "{choice}");
    assert_eq!(choice["version"], report["policy"]["version"], "{choice}");
}

/// Writes what an environment of the training does as rows, the same again, and none into its folder.
fn samples(run: &Path) {
    let at = |out: &Path| {
        let (run, out) = (run.to_str().unwrap(), out.to_str().unwrap());
        finish(command("caudata", &["log", "sample", run, "--seconds", "1", "--out", out]).unwrap())
    };
    let folder = tempfile::tempdir().unwrap();
    let files = ["one.csv", "two.csv"].map(|name| folder.path().join(name));
    let rows = files.map(|file| {
        let done = at(&file).unwrap();
        assert_eq!(done.code, Some(0), "{}", done.stderr);
        std::fs::read_to_string(file).unwrap()
    });
    assert_eq!(rows[0].lines().count(), 1 + 51); // names, then 1 s at 50 Hz and its end
    assert_eq!(rows[0], rows[1]);
    let refused = at(run).unwrap();
    assert!(refused.code == Some(73) && !run.join("log.csv").exists(), "{}", refused.stderr);
}

fn files_like(folder: &Path, part: &str) -> Vec<PathBuf> {
    let mut found: Vec<PathBuf> = std::fs::read_dir(folder)
        .unwrap()
        .flatten()
        .map(|entry| entry.path())
        .filter(|path| path.file_name().unwrap().to_string_lossy().contains(part))
        .collect();
    found.sort();
    found
}

/// A robot that is over at its first step learns nothing for ever: said once, with where to look.
#[test]
fn episodes_that_end_at_once_are_told_of() {
    let folder = tempfile::tempdir().unwrap();
    let flags = [
        "--iterations",
        "5",
        "--set",
        "task.termination.com_height_m=[0.5, 1.0]",
        "--set",
        "evaluation.robot_run_s=1",
        "--logger",
        "wandb",
    ];
    let mut run = train(&folder.path().join("run"), &flags).unwrap();
    run.env("CAUDATA_PYTHON", "/no/python");
    let done = finish(run).unwrap();
    // That its tracker is not there does not stop it.
    assert!(done.stdout.contains("no tracker: cannot start /no/python"));
    let told = done.stdout.matches("robot check").count();
    assert_eq!(told, 1, "{}", done.stdout);
}

#[test]
fn trains_end_to_end_in_one_process() {
    trains_end_to_end("inproc");
}

#[test]
fn trains_end_to_end_over_shared_memory() {
    trains_end_to_end("iceoryx2");
}

#[test]
fn trains_end_to_end_over_tcp() {
    trains_end_to_end("zenoh");
}

/// The state file of the newest checkpoint; every bit of weights and optimiser is in it.
fn newest_state(out: &Path) -> Vec<u8> {
    let newest = files_like(&out.join("checkpoints"), "iter_").pop().expect("a checkpoint");
    std::fs::read(newest.join("state.safetensors")).unwrap()
}

#[test]
fn a_run_that_was_stopped_and_resumed_has_the_same_weights_bit_for_bit() {
    let folder = tempfile::tempdir().unwrap();
    let (whole, halves) = (folder.path().join("whole"), folder.path().join("halves"));
    ended_well(&finish(train(&whole, &["--iterations", "13"]).unwrap()).unwrap());
    ended_well(&finish(train(&halves, &["--iterations", "3"]).unwrap()).unwrap());
    let half = newest_state(&halves);
    let resume = ["--iterations", "13", "--resume"];
    let report = ended_well(&finish(train(&halves, &resume).unwrap()).unwrap());
    assert_eq!(report["finished"]["iteration"], 13);
    assert!(newest_state(&whole) != half, "ten more iterations change the weights");
    assert!(newest_state(&whole) == newest_state(&halves), "the weights differ");
}

#[test]
fn another_seed_gives_other_weights_and_the_same_seed_the_same() {
    let folder = tempfile::tempdir().unwrap();
    let run = |name: &str, seed: &str| {
        let out = folder.path().join(name);
        ended_well(&finish(train(&out, &["--iterations", "2", "--seed", seed]).unwrap()).unwrap());
        newest_state(&out)
    };
    let first = run("a", "5");
    assert!(first == run("b", "5"));
    assert!(first != run("c", "6"));
}

/// A training run in the background whose events are read as they come.
struct Running {
    child: Child,
    lines: std::io::Lines<BufReader<std::process::ChildStdout>>,
    last: String,
}

impl Running {
    fn start(mut command: Command) -> Self {
        let mut child = command.stdout(Stdio::piped()).stderr(Stdio::null()).spawn().unwrap();
        let lines = BufReader::new(child.stdout.take().unwrap()).lines();
        Self { child, lines, last: String::new() }
    }

    fn next_event(&mut self) -> Option<Value> {
        self.last = self.lines.next()?.ok()?;
        Some(serde_json::from_str(&self.last).unwrap_or(Value::Null))
    }

    fn wait_for_iteration(&mut self, iteration: u64) {
        while let Some(event) = self.next_event() {
            if event["event"] == "iteration" && event["iteration"].as_u64() >= Some(iteration) {
                return;
            }
        }
        panic!("the run ended before iteration {iteration}");
    }

    fn signal(&self, signal: Signal) {
        kill(Pid::from_raw(self.child.id().cast_signed()), signal).unwrap();
    }

    /// Reads to the end; the last line and the exit code.
    fn end(mut self) -> (Value, Option<i32>) {
        while self.next_event().is_some() {}
        let code = self.child.wait().unwrap().code();
        (serde_json::from_str(&self.last).unwrap(), code)
    }
}

#[test]
fn sigterm_leaves_a_run_that_resumes() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("run");
    let mut running = Running::start(train(&out, &["--iterations", "100000"]).unwrap());
    running.wait_for_iteration(3);
    running.signal(Signal::SIGTERM);
    let (last, code) = running.end();
    assert_eq!(code, Some(0), "{last}");
    let stopped = last["iteration"].as_u64().unwrap();
    assert!(stopped >= 3, "{last}");
    account_holds(&last);

    let until = (stopped + 2).to_string();
    let resumed = finish(train(&out, &["--iterations", &until, "--resume"]).unwrap()).unwrap();
    let report = ended_well(&resumed);
    assert_eq!(report["finished"]["iteration"], stopped + 2);
}

/// `report.json` and `accounting.json` tell the same of the whole run.
fn accounts_agree(out: &Path, report: &Value) {
    let stored = json_file(&out.join("accounting.json")).unwrap();
    let account = &report["accounting"];
    let count = |of: &Value, key: &str| of[key].as_u64().unwrap();
    for key in ["sent", "accepted", "rejected"] {
        assert_eq!(count(account, key), count(&stored, key), "{key}: {account}");
    }
    assert_eq!(
        count(account, "dropped") + count(account, "lost"),
        count(&stored, "dropped"),
        "{account}"
    );
}

/// A run goes on over another transport, with actors that the learner has not heard of.
fn goes_on_over(first: &str, then: &str) {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("run");
    let run = |flags: &[&str]| ended_well(&finish(train(&out, flags).unwrap()).unwrap());
    run(&["--transport", first, "--iterations", "3"]);
    let report = run(&["--transport", then, "--iterations", "5", "--resume"]);
    assert_eq!(report["finished"]["iteration"], 5);
    assert_eq!(report["first_iteration"], 3);
    assert_eq!(report["policy"]["same"], true, "{}", report["policy"]);
    account_holds(&report);
    accounts_agree(&out, &report);
    // Two actors, a chunk each per iteration; nothing came twice.
    assert_eq!(report["accounting"]["accepted"], 10, "{report}");
    let stored = json_file(&out.join("accounting.json")).unwrap();
    assert_eq!(stored["duplicates"], 0, "{stored}");
}

#[test]
fn a_run_in_one_process_goes_on_over_shared_memory() {
    goes_on_over("inproc", "iceoryx2");
}

#[test]
fn a_run_in_one_process_goes_on_over_tcp() {
    goes_on_over("inproc", "zenoh");
}

#[test]
fn a_run_over_tcp_goes_on_in_one_process() {
    goes_on_over("zenoh", "inproc");
}

/// The process id of the learner of the run at `out`.
fn learner_process(out: &Path) -> i32 {
    let found = processes("caudata-learner", &out.display().to_string());
    assert_eq!(found.len(), 1, "one learner runs");
    found[0]
}

/// The learner is killed between two checkpoints; the run goes on from the last one, and the policies that
/// were published since stay what they are.
fn goes_on_after_a_killed_learner(transport: &str) {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("run");
    let flags = ["--transport", transport, "--set", "learner.publish_every=1"];
    let flags = [&flags[..], &["--set", "learner.checkpoint_every=4"]].concat();
    let long = [&flags[..], &["--iterations", "100000"]].concat();
    let mut running = Running::start(train(&out, &long).unwrap());
    running.wait_for_iteration(7);
    kill(Pid::from_raw(learner_process(&out)), Signal::SIGKILL).unwrap();
    let (_, code) = running.end();
    assert_eq!(code, Some(70));
    let newest = files_like(&out.join("checkpoints"), "iter_").pop().unwrap();
    let newest: u64 = newest.to_string_lossy().rsplit_once('_').unwrap().1.parse().unwrap();

    let until = (newest + 2).to_string();
    let resume = [&flags[..], &["--iterations", &until, "--resume"]].concat();
    let report = ended_well(&finish(train(&out, &resume).unwrap()).unwrap());
    assert_eq!(report["finished"]["iteration"], newest + 2);
    let policy = &report["policy"];
    assert_eq!(policy["same"], true, "{policy}");
    assert!(policy["version"].as_u64() > Some(newest + 2), "numbers go on: {policy}");
    assert_eq!(policy["actors"]["server"], policy["actors"]["actors"], "{policy}");
    account_holds(&report);
    accounts_agree(&out, &report);
    let stored = std::fs::read_to_string(out.join("accounting.json")).unwrap();
    assert!(stored.contains("rolled_back"), "{stored}");
}

#[test]
fn a_run_goes_on_after_its_learner_was_killed() {
    goes_on_after_a_killed_learner("zenoh");
}

#[test]
fn a_run_in_one_process_goes_on_after_its_learner_was_killed() {
    goes_on_after_a_killed_learner("inproc");
}

/// Process ids of the actors of the run at `out`.
fn actor_processes(out: &Path) -> Vec<i32> {
    processes("caudata-actor", &out.join("ledgers").display().to_string())
}

/// Process ids of the processes called `name` with `mark` in an argument.
fn processes(name: &str, mark: &str) -> Vec<i32> {
    let mut found = Vec::new();
    for entry in std::fs::read_dir("/proc").unwrap().flatten() {
        let Ok(pid) = entry.file_name().to_string_lossy().parse::<i32>() else {
            continue;
        };
        let arguments = std::fs::read(entry.path().join("cmdline")).unwrap_or_default();
        let arguments = String::from_utf8_lossy(&arguments).replace('\0', " ");
        let program = arguments.split(' ').next().unwrap_or_default();
        if program.ends_with(name) && arguments.contains(mark) {
            found.push(pid);
        }
    }
    found
}

fn survives_a_killed_actor(transport: &str) {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("run");
    let flags = ["--transport", transport, "--iterations", "40"];
    let mut running = Running::start(train(&out, &flags).unwrap());
    running.wait_for_iteration(3);
    let actors = actor_processes(&out);
    assert_eq!(actors.len(), 2, "two actors run");
    kill(Pid::from_raw(actors[0]), Signal::SIGKILL).unwrap();
    let (report, code) = running.end();
    assert_eq!(code, Some(0), "{report}");
    assert_eq!(report["finished"]["iteration"], 40);
    assert!(report["actor_restarts"].as_u64() >= Some(1), "{report}");
    account_holds(&report);
}

#[test]
fn a_killed_actor_is_started_again_and_every_chunk_accounted_for_over_shared_memory() {
    survives_a_killed_actor("iceoryx2");
}

#[test]
fn a_killed_actor_is_started_again_and_every_chunk_accounted_for_over_tcp() {
    survives_a_killed_actor("zenoh");
}
