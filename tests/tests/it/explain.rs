//! `caudata explain` from end to end: a mistake is hidden in a task, the robot is trained, and the mistake is
//! named.

use caudata_tests::{command, finish};

/// Joint accelerations cost too much on the robot that learns fastest: two short trainings explain it.
#[test]
fn a_hidden_mistake_is_named_and_what_to_change() {
    let folder = tempfile::tempdir().unwrap();
    let keep = folder.path().to_str().unwrap();
    let flags = ["--only", "acceleration", "--seeds", "3", "--budget", "600", "--keep", keep];
    let done = finish(
        command("caudata", &[&["bench", "explain", "--json"], &flags[..]].concat()).unwrap(),
    );
    let done = done.unwrap();
    assert_eq!(done.code, Some(0), "{}", done.stderr);
    let found = done.last_json().unwrap();
    let outcome = &found["outcomes"][0];
    assert_eq!(outcome["hidden"], "acceleration costs too much");
    assert_eq!((&found["mistakes"], &found["first"]), (&1.into(), &1.into()), "{found}");
    assert_eq!(outcome["named"][0][0], "task.reward.weights.joint_acceleration");
}

#[test]
fn what_is_no_run_is_refused_in_one_line() {
    let folder = tempfile::tempdir().unwrap();
    let done = finish(command("caudata", &["explain", folder.path().to_str().unwrap()]).unwrap());
    let done = done.unwrap();
    assert_eq!(done.code, Some(66), "{}", done.stderr);
    assert!(done.errors()[0].contains("is no run folder"), "{}", done.stderr);
}
