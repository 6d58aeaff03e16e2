//! The supervisor against tiny programs, one per fault.

use std::fs;
use std::path::Path;

use caudata_config::Source;

use super::*;

const SERVER: &str =
    r#"echo '{"listening":"policy_server","address":"127.0.0.1:1"}'; exec sleep 600"#;
const STARTED: &str = r#"echo '{"event":"started","run_id":"r","transport":"{}","metrics":null,"iteration":0,"iterations":9,"resumed_from":null,"device":"cpu"}'"#;

/// A learner's last line.
fn finished(reason: &str) -> String {
    let event =
        Event::Finished(Box::new(Finished { reason: reason.into(), ..Finished::default() }));
    format!("echo '{}'", serde_json::to_string(&event).unwrap())
}

/// Makes `text` a program. A shell writes it: a file that this process writes may still be open in the child
/// of another test that is just being started, and is then too busy to be run.
pub fn write_program(path: &Path, text: &str) {
    let mut shell = Command::new("/bin/sh");
    shell.args(["-c", "printf '#!/bin/sh\\n%s\\n' \"$1\" > \"$0\" && chmod 755 \"$0\""]);
    assert!(shell.arg(path).arg(text).status().unwrap().success());
}

/// A folder with a run and programs that are shell scripts. `$RUN` is the run folder.
struct Stage {
    dir: tempfile::TempDir,
    folder: RunFolder,
    config: Config,
    stop: StopFlag,
    restart_learner: bool,
}

impl Stage {
    fn new(learner: &str, actor: &str) -> Self {
        let dir = tempfile::tempdir().unwrap();
        let folder = RunFolder::create(Some(&dir.path().join("run")), dir.path(), "t").unwrap();
        let scripts = [
            ("caudata-policy-server", SERVER),
            ("caudata-learner", learner),
            ("caudata-actor", actor),
        ];
        for (name, script) in scripts {
            let path = dir.path().join(name);
            let run = folder.root().display();
            write_program(&path, &format!("RUN={run}\n{script}"));
        }
        let source = Source::default()
            .set("transport.kind=zenoh")
            .set("actors.count=1")
            .set("actors.flush_timeout_s=0.1");
        let config = Config::load(&source).unwrap();
        Self { dir, folder, config, stop: StopFlag::new(), restart_learner: false }
    }

    fn run(&self) -> Result<Outcome, Failure> {
        let programs = Programs::inside(self.dir.path());
        let view = View::Plain { last: None };
        Supervisor::start(
            &programs,
            &self.config,
            &self.folder,
            &self.stop,
            view,
            Plan {
                resume: Resume::No,
                actors: self.config.actors.count,
                restart_learner: self.restart_learner,
            },
        )?
        .watch()
    }
}

/// Waits for a file, as a shell script.
fn wait_for(file: &str) -> String {
    format!("while [ ! -e {file} ]; do sleep 0.02; done")
}

#[test]
fn the_learner_s_exit_code_and_error_line_pass_through() {
    let stage = Stage::new("echo 'error: checkpoint 7 is damaged' >&2; exit 78", "exec sleep 600");
    let failure = stage.run().err().unwrap();
    assert_eq!(failure.code(), ExitCode::CheckpointDamaged);
    assert_eq!(failure.to_string(), "the learner: checkpoint 7 is damaged");
    assert!(failure.hint_text().unwrap().contains("learner.log"));
}

#[test]
fn a_killed_learner_is_a_failure_even_after_its_last_word() {
    let stage = Stage::new(&format!("{}; kill -9 $$", finished("completed")), "exec sleep 600");
    // What the learner of an earlier session said is not why this one ended.
    let log = stage.folder.logs().join("learner.log");
    fs::write(log, "error: only 1 chunks came\nhint: old\n").unwrap();
    let failure = stage.run().err().unwrap();
    assert_eq!(failure.to_string(), "the learner was killed by SIGKILL");
    assert!(failure.hint_text().unwrap().contains("train --resume"));
}

#[test]
fn the_learner_s_hint_passes_through() {
    let stage = Stage::new(
        "echo 'error: damaged' >&2; echo 'hint: resume with --resume-from iter_000004' >&2; exit 78",
        "exec sleep 600",
    );
    let failure = stage.run().err().unwrap();
    let hint = failure.hint_text().unwrap();
    assert_eq!(hint, "resume with --resume-from iter_000004");
}

#[test]
fn an_actor_takes_an_incarnation_that_the_learner_listens_to() {
    // The run was in one process before: no ledgers, but the learner knows four incarnations.
    let started = STARTED.replace("\"cpu\"", "\"cpu\",\"next_incarnations\":[4]");
    let learner = format!("{started}; {}; {}", wait_for("$RUN/four"), finished("completed"));
    let actor = r#"case "$*" in *'--incarnation 4'*) touch $RUN/four;; esac; exec sleep 600"#;
    assert!(Stage::new(&learner, actor).run().is_ok());
}

#[test]
fn a_progress_file_that_cannot_be_written_ends_the_run_in_good_order() {
    let learner =
        format!("trap 'touch $RUN/asked; exit 0' TERM; {STARTED}; while :; do sleep 0.02; done");
    let stage = Stage::new(&learner, "exec sleep 600");
    std::os::unix::fs::symlink("/dev/full", stage.folder.progress()).unwrap();
    let failure = stage.run().err().unwrap();
    assert_eq!(failure.code(), ExitCode::IoError, "{failure}");
    assert!(stage.folder.root().join("asked").exists(), "the learner was asked to stop");
}

#[test]
fn a_killed_actor_is_started_again_as_its_next_incarnation() {
    // The first incarnation sends 5 chunks and is killed, the second sends 6 and stays.
    let actor = r#"
        case "$*" in
            *'--incarnation 0'*) printf '\5\0\0\0\0\0\0\0' > $RUN/ledgers/actor-0-0.ledger; kill -9 $$;;
            *'--incarnation 1'*) printf '\6\0\0\0\0\0\0\0' > $RUN/ledgers/actor-0-1.ledger; exec sleep 600;;
        esac"#;
    let learner = format!(
        "{STARTED}; {}; {}",
        wait_for("$RUN/ledgers/actor-0-1.ledger"),
        finished("completed")
    );
    let stage = Stage::new(&learner, actor);
    let outcome = stage.run().unwrap();
    assert_eq!(outcome.restarts, 1);
    let counts: Vec<_> = outcome.ledgers.iter().map(|l| (l.incarnation, l.sent)).collect();
    assert_eq!(counts, [(0, Some(5)), (1, Some(6))]);
    assert_eq!(outcome.finished.reason, "completed");
}

/// SIGSTOP, a deadlock and a host that swaps look alike: the process is there and says nothing.
#[test]
fn an_actor_that_hangs_is_killed_and_started_again() {
    let actor = r#"
        case "$*" in
            *'--incarnation 0'*) : > $RUN/ledgers/actor-0-0.ledger; echo alive; kill -STOP $$;;
            *'--incarnation 1'*) : > $RUN/ledgers/actor-0-1.ledger; while :; do echo alive; sleep 0.1; done;;
        esac"#;
    let learner = format!(
        "{STARTED}; {}; {}",
        wait_for("$RUN/ledgers/actor-0-1.ledger"),
        finished("completed")
    );
    let mut stage = Stage::new(&learner, actor);
    stage.config.cluster.hang_timeout_s = 1.0;
    let outcome = stage.run().unwrap();
    assert_eq!(outcome.restarts, 1);
    assert_eq!(outcome.finished.reason, "completed");
}

#[test]
fn a_learner_that_stands_still_is_told_of_and_may_go_on() {
    let still = "echo alive; (sleep 2.5; kill -CONT $$) & kill -STOP $$; echo alive; sleep 0.5";
    let learner = format!("{STARTED}; {still}; {}", finished("completed"));
    let mut stage = Stage::new(&learner, "while :; do echo alive; sleep 0.1; done");
    stage.config.cluster.hang_timeout_s = 1.0;
    let outcome = stage.run().unwrap();
    assert_eq!(outcome.learner_silences, 1);
    assert_eq!(outcome.finished.reason, "completed");
}

/// The actor waits meanwhile: it is the same process before and after.
#[test]
fn a_killed_learner_of_a_cluster_goes_on_from_its_checkpoint() {
    let learner = format!(
        "{STARTED}; {}; case \"$*\" in *--resume*) {};; *) kill -9 $$;; esac",
        wait_for("$RUN/actor-pid"),
        finished("completed")
    );
    let actor = "echo $$ >> $RUN/actor-pid; while :; do echo alive; sleep 0.1; done";
    let mut stage = Stage::new(&learner, actor);
    stage.restart_learner = true;
    let outcome = stage.run().unwrap();
    assert_eq!(outcome.finished.reason, "completed");
    let starts = fs::read_to_string(stage.folder.root().join("actor-pid")).unwrap();
    assert_eq!((outcome.restarts, starts.lines().count()), (0, 1));
}

#[test]
fn an_actor_that_cannot_work_ends_the_run_with_its_exit_code() {
    let learner = format!(
        "trap '{}; exit 0' TERM; {STARTED}; {}",
        finished("SIGTERM").replace('\'', "'\\''"),
        "while :; do sleep 0.02; done"
    );
    let actor = "echo 'error: policy version 0 is refused: wrong joint order' >&2; exit 77";
    let stage = Stage::new(&learner, actor);
    let failure = stage.run().err().unwrap();
    assert_eq!(failure.code(), ExitCode::PolicyRefused);
    assert!(failure.to_string().contains("wrong joint order"), "{failure}");
}

#[test]
fn an_actor_that_keeps_dying_is_given_up() {
    let learner = format!("trap 'exit 0' TERM; {STARTED}; while :; do sleep 0.02; done");
    let mut stage = Stage::new(&learner, "exit 70");
    stage.config.actors.restarts_per_minute = 1;
    let failure = stage.run().err().unwrap();
    assert_eq!(failure.code(), ExitCode::TempFail);
    assert!(failure.to_string().contains("no actor is left"), "{failure}");
    assert_eq!(stage.folder.next_incarnation(0), 0, "the script makes no ledger");
}

#[test]
fn a_stop_reaches_the_learner_which_saves_and_says_so() {
    let learner = format!(
        "trap '{}; exit 0' TERM; touch $RUN/ready; while :; do sleep 0.02; done",
        finished("SIGTERM").replace('\'', "'\\''")
    );
    let stage = Stage::new(&learner, "exec sleep 600");
    let (stop, ready) = (stage.stop.clone(), stage.folder.root().join("ready"));
    let stopper = std::thread::spawn(move || {
        while !ready.exists() {
            std::thread::sleep(Duration::from_millis(5));
        }
        stop.request("SIGINT");
    });
    let outcome = stage.run().unwrap();
    stopper.join().unwrap();
    // as it was asked, not as it was passed on
    assert_eq!(outcome.finished.reason, "SIGINT");
}

#[test]
fn a_stop_before_the_learner_listens_is_no_fault() {
    let stage = Stage::new("touch $RUN/ready; exec sleep 600", "exec sleep 600");
    let (stop, ready) = (stage.stop.clone(), stage.folder.root().join("ready"));
    let stopper = std::thread::spawn(move || {
        while !ready.exists() {
            std::thread::sleep(Duration::from_millis(5));
        }
        stop.request("test");
    });
    let failure = stage.run().err().unwrap();
    stopper.join().unwrap();
    assert_eq!(failure.code(), ExitCode::Interrupted);
}

#[test]
fn a_server_that_cannot_start_passes_its_exit_code_on() {
    let stage = Stage::new("exit 0", "exit 0");
    let server = stage.dir.path().join("caudata-policy-server");
    write_program(&server, "echo 'error: 127.0.0.1:1 is in use' >&2; exit 71");
    let failure = stage.run().err().unwrap();
    assert_eq!(failure.code(), ExitCode::OsResource);
    assert_eq!(failure.to_string(), "the policy server: 127.0.0.1:1 is in use");
}
