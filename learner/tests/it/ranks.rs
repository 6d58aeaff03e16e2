//! Several learner ranks, each a process of its own: the bits of one rank, and what happens when one is lost.

use std::io::{BufRead, BufReader};
use std::net::{TcpListener, TcpStream};
use std::path::Path;
use std::process::{Child, Command, Output, Stdio};
use std::time::Duration;

use caudata_telemetry::progress::{Event, Finished};
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;

const PROGRAM: &str = env!("CARGO_BIN_EXE_caudata-learner");

/// Minibatches of 1,536 samples: four shards each, of 384.
const SHARDED: [&str; 4] = [
    "actors.lanes=64",
    "actors.chunk_steps=24",
    "learner.checkpoint_every=1",
    "learner.keep_checkpoints=10000",
];

/// A port that was free just now.
fn free_port() -> u16 {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    listener.local_addr().unwrap().port()
}

/// What all ranks of a run share: configuration and run id.
fn shared(ranks: u32, port: u16, more: &[&str]) -> Vec<String> {
    let robot = concat!(
        env!("CARGO_MANIFEST_DIR"),
        "/../robots/polymander.robot.toml"
    );
    let own = [
        format!("robot=\"{robot}\""),
        format!("cluster.learner_ranks={ranks}"),
        format!("cluster.rank_address=\"127.0.0.1:{port}\""),
    ];
    let mut arguments = ["--preset", "quick", "--run-id", "test"]
        .map(str::to_owned)
        .to_vec();
    let sets = crate::common::tiny::TINY.iter().chain(&SHARDED).chain(more);
    for text in sets.map(|&text| text.to_owned()).chain(own) {
        arguments.extend(["--set".to_owned(), text]);
    }
    arguments
}

fn start_rank(rank: u32, ranks: u32, port: u16, more: &[&str]) -> Child {
    Command::new(PROGRAM)
        .args(shared(ranks, port, more))
        .args(["--rank", &rank.to_string()])
        .stdout(Stdio::null())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap()
}

fn start_root(folder: &Path, ranks: u32, port: u16, iterations: u64, more: &[&str]) -> Child {
    Command::new(PROGRAM)
        .args(shared(ranks, port, more))
        .args(["--inproc", "--run-dir", folder.to_str().unwrap()])
        .args(["--set", &format!("run.iterations={iterations}")])
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap()
}

/// The code that it ended with, and its error line; nothing where it ended well, all that it said where it has none.
fn ended(child: Child) -> (Option<i32>, String) {
    let output: Output = child.wait_with_output().unwrap();
    if output.status.success() {
        return (Some(0), String::new());
    }
    let text = String::from_utf8_lossy(&output.stderr).into_owned();
    let error = text.lines().find(|line| line.starts_with("error: "));
    (output.status.code(), error.unwrap_or(&text).to_owned())
}

fn pid(child: &Child) -> Pid {
    Pid::from_raw(child.id().try_into().unwrap())
}

/// Waits for the end of iteration `until`, then does `what`, and reads on to the learner's last event.
fn after(root: &mut Child, until: u64, what: impl FnOnce()) -> Option<Event> {
    let mut what = Some(what);
    let mut last = None;
    for line in BufReader::new(root.stdout.take().unwrap()).lines() {
        let event: Event = serde_json::from_str(&line.unwrap()).unwrap();
        if matches!(&event, Event::Iteration(done) if done.iteration >= until)
            && let Some(what) = what.take()
        {
            what();
        }
        last = Some(event);
    }
    last
}

/// Trains in `folder` with `ranks` processes; all end with 0.
fn train(folder: &Path, ranks: u32, iterations: u64, more: &[&str]) -> Finished {
    let port = free_port();
    let others: Vec<Child> = (1..ranks)
        .map(|rank| start_rank(rank, ranks, port, more))
        .collect();
    let mut root = start_root(folder, ranks, port, iterations, more);
    let last = after(&mut root, u64::MAX, || {});
    assert_eq!(ended(root).0, Some(0));
    for other in others {
        assert_eq!(ended(other), (Some(0), String::new()));
    }
    let Some(Event::Finished(finished)) = last else {
        panic!("{last:?}")
    };
    *finished
}

/// Network, optimiser, normaliser, learning rate and rewards after an iteration, byte for byte.
fn state(folder: &Path, iteration: u64) -> Vec<u8> {
    std::fs::read(folder.join(format!("checkpoints/iter_{iteration:06}/state.safetensors")))
        .unwrap()
}

/// The newest checkpoint's iteration.
fn newest(folder: &Path) -> u64 {
    let name = std::fs::read_to_string(folder.join("checkpoints/latest")).unwrap();
    name.trim().strip_prefix("iter_").unwrap().parse().unwrap()
}

#[test]
fn any_number_of_ranks_ends_in_the_bits_of_one() {
    // Everything that is taken over a whole batch or minibatch is in one of these: the scale of the advantages, the KL divergence that
    // the learning rate follows, the norm of the gradient, which is clipped, and the moments of the observations.
    let variants: [&[&str]; 3] = [
        &["learner.ppo.max_grad_norm=0.1"],
        &[
            "learner.ppo.advantage_scale=\"minibatch\"",
            "learner.threads=2",
        ],
        &["learner.ppo.mirror=true"],
    ];
    for more in variants {
        let dirs: Vec<_> = (0..3).map(|_| tempfile::tempdir().unwrap()).collect();
        let finished: Vec<Finished> = (1..)
            .zip(&dirs)
            .map(|(ranks, dir)| train(dir.path(), ranks, 3, more))
            .collect();
        for (dir, run) in dirs.iter().zip(&finished).skip(1) {
            assert_eq!(state(dir.path(), 3), state(dirs[0].path(), 3), "{more:?}");
            assert_eq!(run.policy_sha256, finished[0].policy_sha256, "{more:?}");
        }
    }
}

#[test]
fn one_shard_and_more_ranks_than_shards() {
    // Minibatches of 48 samples are one shard; two of three ranks have nothing to do.
    let small = ["actors.lanes=2"];
    let dirs = [tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap()];
    train(dirs[0].path(), 1, 2, &small);
    train(dirs[1].path(), 3, 2, &small);
    assert_eq!(state(dirs[0].path(), 2), state(dirs[1].path(), 2));
}

#[test]
fn a_dead_rank_ends_the_run_with_its_own_code_and_nothing_half_done_is_saved() {
    let [lost, whole] = [tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap()];
    let port = free_port();
    let rank = start_rank(1, 2, port, &[]);
    let mut root = start_root(lost.path(), 2, port, 1_000_000, &[]);
    let victim = pid(&rank);
    after(&mut root, 3, || kill(victim, Signal::SIGKILL).unwrap());
    let (code, error) = ended(root);
    assert_eq!(code, Some(85), "{error}");
    assert!(error.contains("rank 1 of the learner"), "{error}");
    assert_eq!(ended(rank).0, None, "it was killed");

    // What was saved is what one process has after so many iterations.
    let saved = newest(lost.path());
    assert!(saved >= 3);
    train(whole.path(), 1, saved + 2, &[]);
    assert_eq!(state(lost.path(), saved), state(whole.path(), saved));

    // It goes on, with another number of ranks, from a checkpoint that was made between two iterations.
    let port = free_port();
    let others = [1, 2].map(|rank| start_rank(rank, 3, port, &[]));
    let root = Command::new(PROGRAM)
        .args(shared(3, port, &[]))
        .args(["--inproc", "--run-dir", lost.path().to_str().unwrap()])
        .args(["--resume-from", "iter_000002"])
        .args(["--set", &format!("run.iterations={}", saved + 2)])
        .stdout(Stdio::null())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    assert_eq!(ended(root).0, Some(0));
    for other in others {
        assert_eq!(ended(other), (Some(0), String::new()));
    }
    let last = saved + 2;
    assert_eq!(state(lost.path(), last), state(whole.path(), last));
}

#[test]
fn a_rank_that_hangs_is_not_waited_for_longer_than_configured() {
    let dir = tempfile::tempdir().unwrap();
    let port = free_port();
    let short = ["cluster.rank_timeout_s=1"];
    let rank = start_rank(1, 2, port, &short);
    let mut root = start_root(dir.path(), 2, port, 1_000_000, &short);
    let victim = pid(&rank);
    after(&mut root, 2, || kill(victim, Signal::SIGSTOP).unwrap());
    let (code, error) = ended(root);
    assert_eq!(code, Some(85), "{error}");
    assert!(error.contains("in time"), "{error}");
    kill(victim, Signal::SIGKILL).unwrap();
    ended(rank);
}

#[test]
fn a_rank_survives_its_learner_and_joins_the_next_one() {
    let dir = tempfile::tempdir().unwrap();
    let port = free_port();
    let rank = start_rank(1, 2, port, &[]);
    let mut root = start_root(dir.path(), 2, port, 1_000_000, &[]);
    let victim = pid(&root);
    after(&mut root, 2, || kill(victim, Signal::SIGKILL).unwrap());
    assert_eq!(ended(root).0, None, "it was killed");
    let resumed = Command::new(PROGRAM)
        .args(shared(2, port, &[]))
        .args(["--inproc", "--run-dir", dir.path().to_str().unwrap()])
        .arg("--resume")
        .args([
            "--set",
            &format!("run.iterations={}", newest(dir.path()) + 2),
        ])
        .stdout(Stdio::null())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let (code, error) = ended(resumed);
    assert_eq!(code, Some(0), "{error}");
    assert_eq!(ended(rank).0, Some(0));
}

#[test]
fn a_rank_that_is_asked_to_stop_ends_the_run_in_good_order() {
    let dir = tempfile::tempdir().unwrap();
    let port = free_port();
    let rank = start_rank(1, 2, port, &[]);
    let mut root = start_root(dir.path(), 2, port, 1_000_000, &[]);
    let asked = pid(&rank);
    let last = after(&mut root, 2, || kill(asked, Signal::SIGTERM).unwrap());
    assert_eq!(ended(root).0, Some(0));
    assert_eq!(ended(rank).0, Some(0));
    let Some(Event::Finished(finished)) = last else {
        panic!("{last:?}")
    };
    assert_eq!(finished.reason, "rank 1 was asked to stop");
    assert_eq!(newest(dir.path()), finished.iteration);
}

#[test]
fn ranks_that_do_not_fit_are_refused_and_missing_ones_are_named() {
    let dir = tempfile::tempdir().unwrap();
    let port = free_port();
    let patience = "cluster.rank_join_timeout_s=4";
    let root = start_root(dir.path(), 2, port, 3, &[patience]);
    let other = start_rank(1, 2, port, &[patience, "learner.ppo.gamma=0.9"]);
    let (code, error) = ended(other);
    assert_eq!(code, Some(64), "{error}");
    assert!(error.contains("configuration is another"), "{error}");
    let (code, error) = ended(root);
    assert_eq!(code, Some(85), "{error}");
    assert!(
        error.contains("rank 1 of the learner did not join"),
        "{error}"
    );
    assert!(
        !dir.path().join("checkpoints/latest").exists(),
        "nothing was trained"
    );

    // Nobody listens, and numbers that no rank has.
    let alone = start_rank(1, 2, port, &["cluster.rank_join_timeout_s=0.5"]);
    let (code, error) = ended(alone);
    assert_eq!(code, Some(85), "{error}");
    assert!(error.contains("not reached"), "{error}");
    for number in [0, 2] {
        let (code, error) = ended(start_rank(number, 2, port, &[]));
        assert_eq!(code, Some(64), "{error}");
        assert!(error.contains("1 to 1"), "{error}");
    }
}

#[test]
fn who_connects_and_says_nothing_does_not_keep_the_learner_waiting() {
    let dir = tempfile::tempdir().unwrap();
    let port = free_port();
    let mut root = start_root(dir.path(), 2, port, 3, &["cluster.rank_join_timeout_s=1"]);
    // There is always one more that waits to be accepted.
    let mut silent = Vec::new();
    while root.try_wait().unwrap().is_none() {
        silent.extend(TcpStream::connect(("127.0.0.1", port)));
        std::thread::sleep(Duration::from_millis(50));
    }
    let (code, error) = ended(root);
    assert_eq!(code, Some(85), "{error}");
    assert!(error.contains("did not join"), "{error}");
}

#[test]
fn a_rank_that_waits_for_its_welcome_can_be_asked_to_stop() {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let port = listener.local_addr().unwrap().port();
    let rank = start_rank(1, 2, port, &["cluster.rank_join_timeout_s=86400"]);
    let _silent = listener.accept().unwrap();
    kill(pid(&rank), Signal::SIGTERM).unwrap();
    assert_eq!(ended(rank), (Some(0), String::new()));
}
