//! Settings that change while a run goes on, with the real simulator in one process.

use std::fs;
use std::path::Path;

use crate::common::{Listener, config, run};
use caudata_config::{CHANGES, Changes, Config, ask, asked};
use caudata_learner::train::Resume;
use caudata_telemetry::progress::Event;

const ITERATIONS: u64 = 12;

/// Episodes are short, so that new ones begin, with other robots, commands and rewards.
fn short(more: &[&str]) -> Config {
    let short = ["task.episode_steps=10", "task.command.resample_s=[0.1, 0.2]"];
    config(ITERATIONS, &[&short[..], more].concat())
}

fn state(folder: &Path) -> Vec<u8> {
    let name = format!("checkpoints/iter_{ITERATIONS:06}/state.safetensors");
    fs::read(folder.join(name)).unwrap()
}

/// Trains anew with these changes in the record.
fn with_record(config: Config, record: &str) -> (tempfile::TempDir, Listener) {
    let dir = tempfile::tempdir().unwrap();
    fs::write(dir.path().join(CHANGES), record).unwrap();
    let listener = Listener::default();
    run(dir.path(), config, Resume::No, &listener, None).unwrap();
    (dir, listener)
}

fn record(iteration: u64, set: &[&str]) -> String {
    format!("[[change]]\niteration = {iteration}\nset = {set:?}\n")
}

const ALL: [&str; 4] = [
    "task.reward.weights.power=-0.5",
    "task.command.vx_mps=[0.1, 0.2]",
    "task.randomisation.kp_scale=[0.5, 0.6]",
    "learner.ppo.learning_rate=0.0002",
];

#[test]
fn a_change_on_the_way_is_recorded_and_repeats_bit_for_bit() {
    for more in [&[][..], &["actors.max_lead=1", "actors.lockstep=true"][..]] {
        // Asked for before the start, it is made before the first policy, after no iteration.
        let dir = tempfile::tempdir().unwrap();
        let set = ALL.map(str::to_owned);
        ask(dir.path(), &set).unwrap();
        let quiet = Listener::default();
        run(dir.path(), short(more), Resume::No, &quiet, None).unwrap();
        assert!(asked(dir.path()).is_empty(), "it is taken");
        let made = Changes::of_run(dir.path(), &short(more)).unwrap();
        assert_eq!((made.change[0].iteration, &made.change[0].set[..]), (0, &set[..]));

        let text = fs::read_to_string(dir.path().join(CHANGES)).unwrap();
        let (again, listener) = with_record(short(more), &text);
        assert_eq!(state(again.path()), state(dir.path()));
        let told = |event: &Event| matches!(event, Event::Changed(c) if c.iteration == 0);
        assert!(listener.events().iter().any(told));

        let (without, _) = with_record(short(more), "");
        assert_ne!(state(without.path()), state(dir.path()));
    }
}

#[test]
fn each_kind_of_change_matters_and_comes_at_its_iteration() {
    let (none, _) = with_record(short(&[]), "");
    let mut seen = vec![state(none.path())];
    for set in ALL {
        let (dir, _) = with_record(short(&[]), &record(5, &[set]));
        let found = state(dir.path());
        assert!(!seen.contains(&found), "{set} changes nothing");
        seen.push(found);
        let until = |folder: &Path| {
            fs::read(folder.join("checkpoints/iter_000004/state.safetensors")).unwrap()
        };
        assert_eq!(until(dir.path()), until(none.path()), "{set} comes too early");
    }
}

#[test]
fn a_run_resumed_across_a_change_ends_in_the_same_bits() {
    let (through, _) = with_record(short(&[]), &record(6, &ALL));
    // Before the change, at it, and after it.
    for at in [4, 6, 8] {
        let dir = tempfile::tempdir().unwrap();
        let folder = dir.path();
        fs::write(folder.join(CHANGES), record(6, &ALL)).unwrap();
        let quiet = Listener::default();
        run(folder, short(&[]), Resume::No, &quiet, None).unwrap();
        fs::remove_dir_all(folder.join(format!("checkpoints/iter_{ITERATIONS:06}"))).unwrap();
        let named = Resume::Named(format!("iter_{at:06}"));
        run(folder, short(&[]), named, &quiet, None).unwrap();
        assert_eq!(state(folder), state(through.path()), "from iteration {at}");
    }
}

#[test]
fn what_cannot_be_is_refused_and_training_goes_on() {
    let dir = tempfile::tempdir().unwrap();
    for set in ["actors.lanes=3", "task.reward.weights.power=1", "nonsense"] {
        ask(dir.path(), &[set.to_owned()]).unwrap();
    }
    let listener = Listener::default();
    run(dir.path(), short(&[]), Resume::No, &listener, None).unwrap();
    let refused = |event: &Event| matches!(event, Event::Warning(w) if w.message.contains("a change is refused"));
    let events = listener.events();
    assert_eq!(events.iter().filter(|event| refused(event)).count(), 3);
    assert!(!dir.path().join(CHANGES).exists());
    let (without, _) = with_record(short(&[]), "");
    assert_eq!(state(dir.path()), state(without.path()));
}
