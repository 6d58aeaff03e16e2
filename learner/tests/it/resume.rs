//! Stopping and going on, with the real simulator in one process.

use std::fs;
use std::path::Path;

use crate::common::{Listener, config, run};
use caudata_actor::ledgers_in;
use caudata_learner::LearnerError;
use caudata_learner::train::Resume;
use caudata_policy::PolicyFile;
use caudata_telemetry::progress::Event;
use serde_json::Value;

/// The network, the optimiser, the normaliser, the learning rate and the rewards so far, byte for byte.
fn state(folder: &Path, iteration: u64) -> Vec<u8> {
    fs::read(folder.join(format!("checkpoints/iter_{iteration:06}/state.safetensors"))).unwrap()
}

fn policy(folder: &Path) -> Vec<u8> {
    fs::read(folder.join("policy.onnx")).unwrap()
}

/// What only the value function sees, and earlier observations, are saved and restored as all else.
const SEES: [&str; 2] =
    ["task.critic.sees=[\"velocity\", \"push\", \"friction\"]", "task.observation.past=[1, 3]"];

#[test]
fn a_stopped_and_resumed_run_ends_in_the_same_bits() {
    let dirs: Vec<_> = (0..3).map(|_| tempfile::tempdir().unwrap()).collect();
    let [through, again, stopped] = [dirs[0].path(), dirs[1].path(), dirs[2].path()];
    let quiet = Listener::default();
    let finished = run(through, config(14, &SEES), Resume::No, &quiet, None).unwrap();
    assert_eq!((finished.reason.as_str(), finished.iteration), ("completed", 14));
    assert_eq!(finished.steps_total, 14 * 2 * 2 * 4);
    assert_eq!((finished.accounting.accepted, finished.accounting.received), (28, 28));

    // The same again: threads took other turns, the bits are the same.
    run(again, config(14, &SEES), Resume::No, &Listener::default(), None).unwrap();
    assert_eq!(state(again, 14), state(through, 14));

    // Asked to stop after iteration 3, which is no multiple of checkpoint_every; k = 3 or 4.
    let listener = Listener { stop_at: Some(3), ..Listener::default() };
    let first = run(stopped, config(14, &SEES), Resume::No, &listener, None).unwrap();
    let k = first.iteration;
    assert!(first.reason == "test" && (3..14).contains(&k), "{first:?}");
    assert_ne!(state(stopped, k), state(through, 14));
    let second = Listener::default();
    let last = run(stopped, config(14, &SEES), Resume::Latest, &second, None).unwrap();
    assert!(last.iteration >= k + 10);
    assert_eq!(state(stopped, 14), state(through, 14));
    assert_eq!(policy(stopped), policy(through));
    assert!(last.first_tenth.is_none(), "fourteen iterations say nothing about tenths");

    // What the two processes counted belongs together.
    let Some(Event::Started(started)) = second.events().into_iter().next() else { panic!() };
    assert_eq!(started.iteration, k);
    let sent: u64 = last.actors.iter().map(|actor| actor.received).sum();
    assert_eq!((sent, last.accounting.accepted, last.actors.len()), (28, 28, 4));
    let report = fs::read_to_string(stopped.join("accounting.json")).unwrap();
    assert!(report.contains("\"holds\": true"), "{report}");
}

#[test]
fn a_run_whose_checkpoints_are_gone_does_not_begin_anew() {
    let dir = tempfile::tempdir().unwrap();
    let folder = dir.path();
    let quiet = Listener::default();
    run(folder, config(4, &[]), Resume::No, &quiet, None).unwrap();
    let before = policy(folder);
    fs::remove_dir_all(folder.join("checkpoints")).unwrap();
    let error = run(folder, config(6, &[]), Resume::Latest, &quiet, None).unwrap_err();
    assert_eq!(error.exit_code().number(), 78, "{error}");
    assert!(error.to_string().contains("holds no checkpoint"), "{error}");
    assert_eq!(policy(folder), before);

    // One that was killed before its first checkpoint begins again.
    let fresh = tempfile::tempdir().unwrap();
    run(fresh.path(), config(2, &[]), Resume::Latest, &quiet, None).unwrap();
}

#[test]
fn a_truncated_checkpoint_is_refused_and_the_good_one_named() {
    let dir = tempfile::tempdir().unwrap();
    let folder = dir.path();
    run(folder, config(4, &[]), Resume::No, &Listener::default(), None).unwrap();
    let path = folder.join("checkpoints/iter_000004/state.safetensors");
    let whole = fs::read(&path).unwrap();
    fs::write(&path, &whole[..whole.len() / 2]).unwrap();

    let quiet = Listener::default();
    let error = run(folder, config(6, &[]), Resume::Latest, &quiet, None).unwrap_err();
    assert_eq!(error.exit_code().number(), 78);
    let failure = error.into_failure();
    assert!(failure.hint_text().unwrap().contains("--resume-from iter_000002"));
    assert!(quiet.events().is_empty(), "nothing was started");

    let mistyped = Resume::Named("iter_000003".into());
    let failure = run(folder, config(6, &[]), mistyped, &quiet, None).unwrap_err().into_failure();
    assert_eq!(
        (failure.code().number(), failure.to_string().as_str()),
        (66, "the run has no checkpoint iter_000003")
    );
    assert_eq!(failure.hint_text(), Some("it has iter_000002, iter_000004"));

    let named = Resume::Named("iter_000002".into());
    let finished = run(folder, config(6, &[]), named, &quiet, None).unwrap();
    assert_eq!(finished.iteration, 6);
    // The damaged one has been written anew on the way.
    assert_eq!(fs::read(&path).unwrap(), whole);
}

/// Version and bytes of the policy in the run folder.
fn version(folder: &Path) -> u64 {
    let file = PolicyFile::parse(policy(folder).into()).unwrap();
    file.metadata().version
}

#[test]
fn going_back_rolls_back_the_account_and_leaves_published_versions_alone() {
    let dir = tempfile::tempdir().unwrap();
    let folder = dir.path();
    let quiet = Listener::default();
    run(folder, config(4, &[]), Resume::No, &quiet, None).unwrap();
    assert_eq!(version(folder), 4);
    let weights = state(folder, 4);

    // As if the learner had been killed after iteration 4 and had not saved since iteration 2.
    let named = || Resume::Named("iter_000002".into());
    let listener = Listener::default();
    let finished = run(folder, config(4, &[]), named(), &listener, None).unwrap();
    assert_eq!(state(folder, 4), weights, "the same weights");
    assert_eq!((version(folder), finished.policy_version), (7, 7));
    let warned =
        |event: &Event| matches!(event, Event::Warning(w) if w.message.contains("with version 5"));
    assert!(listener.events().iter().any(warned));

    // Two actors, each: 2 accepted and 2 rolled back; 2 more by the next incarnation.
    let report: Value =
        serde_json::from_slice(&fs::read(folder.join("accounting.json")).unwrap()).unwrap();
    let count = |key: &str| report[key].as_u64().unwrap();
    assert_eq!((count("sent"), count("accepted"), count("dropped")), (12, 8, 4));
    assert_eq!(report["actors"][0]["dropped"]["rolled_back"], 2);
    let sent: u64 = ledgers_in(&folder.join("ledgers")).iter().filter_map(|l| l.sent).sum();
    assert_eq!(sent, 12, "the actors' own count");
    let received: u64 = finished.actors.iter().map(|actor| actor.received).sum();
    assert_eq!(received, 12, "what the supervisor is told");

    // Going on from there without going back keeps the numbers.
    let finished = run(folder, config(5, &[]), Resume::Latest, &Listener::default(), None).unwrap();
    assert_eq!((finished.iteration, finished.policy_version), (5, 8));
}

#[test]
fn a_policy_says_the_commit_of_the_runs_beginning() {
    let dir = tempfile::tempdir().unwrap();
    let folder = dir.path();
    let commit = |folder: &Path| {
        let file = PolicyFile::parse(policy(folder).into()).unwrap();
        file.metadata().training_commit.clone()
    };
    let quiet = Listener::default();
    run(folder, config(2, &[]), Resume::No, &quiet, None).unwrap();
    let before = policy(folder);
    // Nothing is left to learn: the same policy is exported again, to the same bytes.
    let finished = run(folder, config(2, &[]), Resume::Latest, &quiet, None).unwrap();
    assert_eq!((policy(folder), finished.policy_version), (before, 2));

    // Begun when something else was checked out.
    let checkpoint = folder.join("checkpoints/iter_000002");
    let meta = fs::read_to_string(checkpoint.join("meta.json")).unwrap();
    let now = format!("\"training_commit\": \"{}\"", commit(folder));
    assert!(meta.contains(&now), "{meta}");
    let then = "\"training_commit\": \"abc\"";
    fs::write(checkpoint.join("meta.json"), meta.replace(&now, then)).unwrap();
    let sums = "sha256sum *.* > SHA256SUMS";
    let summed =
        std::process::Command::new("sh").args(["-c", sums]).current_dir(&checkpoint).status();
    assert!(summed.unwrap().success());
    run(folder, config(3, &[]), Resume::Latest, &quiet, None).unwrap();
    assert_eq!(commit(folder), "abc");
}

#[test]
fn another_configuration_or_task_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    let folder = dir.path();
    run(folder, config(2, &[]), Resume::No, &Listener::default(), None).unwrap();
    let quiet = Listener::default();
    let other = config(4, &["learner.ppo.gamma=0.9"]);
    let error = run(folder, other, Resume::Latest, &quiet, None).unwrap_err();
    assert!(matches!(error, LearnerError::CheckpointConfig { .. }), "{error}");
    assert_eq!(error.exit_code().number(), 64);
    let other = config(4, &["task.action.scale=0.9"]);
    let error = run(folder, other, Resume::Latest, &quiet, None).unwrap_err();
    assert!(matches!(error, LearnerError::CheckpointContract { .. }), "{error}");
    assert_eq!(error.exit_code().number(), 77);
}

#[test]
fn a_policy_server_that_is_gone_holds_nothing_up() {
    let dir = tempfile::tempdir().unwrap();
    let listener = Listener::default();
    let config = config(3, &["learner.publish_every=1"]);
    // Port 1 is closed on any machine that runs tests.
    let finished = run(dir.path(), config, Resume::No, &listener, Some("127.0.0.1:1")).unwrap();
    assert_eq!(finished.iteration, 3);
    let warned = listener.events().into_iter().any(|event| match event {
        Event::Warning(warning) => warning.message.contains("is not published"),
        _ => false,
    });
    assert!(warned);
}
