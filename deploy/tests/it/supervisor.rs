//! The supervisor over children that behave as this file wants: what it does where one dies, hangs or cannot
//! be started.
//!
//! This test program is its own child: `child` plays the agent, the loop and the one that lets go, as the
//! scenario says.

use std::fmt::Debug;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::mpsc::{RecvTimeoutError, sync_channel};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use caudata_deploy::boundary::RunFolder;
use caudata_deploy::notify::{Notifier, Word};
use caudata_deploy::supervisor::{Plan, supervise};
use caudata_telemetry::{ExitCode, Failure, StopFlag};
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use tracing::field::Field;
use tracing::{Event, Metadata, span};

/// How long anything is waited for before the test gives up; nothing is asserted about time.
const PATIENCE: Duration = Duration::from_secs(120);
/// How often a child looks whether it may go on.
const LOOK: Duration = Duration::from_millis(5);

/// How long braking may take where it is timed.
const BRAKE_MAX: Duration = Duration::from_secs(4);

/// What the supervisor says in its log.
#[derive(Clone, Default)]
struct Heard(Arc<Mutex<Vec<String>>>);

impl tracing::Subscriber for Heard {
    fn enabled(&self, _: &Metadata<'_>) -> bool {
        true
    }

    fn new_span(&self, _: &span::Attributes<'_>) -> span::Id {
        span::Id::from_u64(1)
    }

    fn record(&self, _: &span::Id, _: &span::Record<'_>) {}

    fn record_follows_from(&self, _: &span::Id, _: &span::Id) {}

    fn event(&self, event: &Event<'_>) {
        let mut line = String::new();
        event.record(&mut |field: &Field, value: &dyn Debug| {
            if field.name() == "message" {
                line = format!("{value:?}");
            }
        });
        self.0.lock().unwrap().push(line);
    }

    fn enter(&self, _: &span::Id) {}

    fn exit(&self, _: &span::Id) {}
}

/// A scene: the folder in which children leave a line each time they are started, and what they are told.
struct Scene {
    folder: tempfile::TempDir,
    plan: Plan,
    stop: StopFlag,
    insisted: StopFlag,
    heard: Heard,
}

impl Scene {
    /// Children play `scenario`. `hang_after` is beyond any test, so that silence shows only where a test is
    /// about it.
    fn new(scenario: &str) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let program = folder.path().join("program");
        std::os::unix::fs::symlink(std::env::current_exe().unwrap(), &program).unwrap();
        // The names behind `--` are filters to the test harness; `supervisor::child` alone fits.
        let before = ["supervisor::child", "--exact", "--nocapture", "--"].map(Into::into);
        let told = vec![scenario.into(), folder.path().as_os_str().to_owned()];
        let plan = Plan {
            program,
            arguments: [before.to_vec(), told.clone()],
            limp: Some(told),
            hang_after: Duration::from_secs(600),
            folder: RunFolder::open(&folder.path().join("run")).unwrap(),
        };
        Self {
            folder,
            plan,
            stop: StopFlag::new(),
            insisted: StopFlag::new(),
            heard: Heard::default(),
        }
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    /// Starts of `part` so far.
    fn starts(&self, part: &str) -> usize {
        starts(self.folder.path(), part)
    }

    /// Waits until `part` was started `times` times.
    #[track_caller]
    fn comes_to(&self, part: &str, times: usize) {
        let end = Instant::now() + PATIENCE;
        while self.starts(part) < times {
            assert!(Instant::now() < end, "{part}: {}", self.starts(part));
            std::thread::sleep(LOOK);
        }
    }

    /// Waits until the supervisor has said `line`.
    #[track_caller]
    fn hears(&self, line: &str) {
        let end = Instant::now() + PATIENCE;
        let said = || self.heard.0.lock().unwrap().clone();
        while !said().iter().any(|said| said == line) {
            assert!(Instant::now() < end, "{line}: {:?}", said());
            std::thread::sleep(LOOK);
        }
    }

    /// To its end, which must come.
    #[track_caller]
    fn run(&self) -> Result<(), Failure> {
        let (plan, heard) = (self.plan.clone(), self.heard.clone());
        let (stop, insisted) = (self.stop.clone(), self.insisted.clone());
        let (tell, told) = sync_channel(1);
        // A supervisor that does not end must not keep its test from failing.
        let running = std::thread::spawn(move || {
            let _listening = tracing::subscriber::set_default(heard);
            tell.send(supervise(&plan, &stop, &insisted)).unwrap();
        });
        match told.recv_timeout(PATIENCE) {
            Ok(result) => result,
            Err(RecvTimeoutError::Timeout) => panic!("it does not end: {:?}", self.heard.0),
            Err(RecvTimeoutError::Disconnected) => {
                std::panic::resume_unwind(running.join().unwrap_err())
            }
        }
    }
}

#[track_caller]
fn failed(result: Result<(), Failure>) -> (ExitCode, String) {
    let failure = result.unwrap_err();
    (failure.code(), failure.to_string())
}

fn starts(folder: &Path, part: &str) -> usize {
    let text = std::fs::read_to_string(folder.join(part)).unwrap_or_default();
    text.lines().count()
}

/// Not a test: what a child of a scene does. Run as one it has nothing to do.
#[test]
fn child() {
    let words: Vec<String> = std::env::args().skip_while(|word| word != "--").collect();
    let Some(part) = words.get(1) else {
        return;
    };
    // `--unless-taken` stands before what the scene says.
    let told: Vec<&String> = words[2..].iter().filter(|w| !w.starts_with('-')).collect();
    let (scenario, folder) = (told[0].as_str(), Path::new(told[1]));
    let start = starts(folder, part) + 1;
    let mut log =
        std::fs::OpenOptions::new().append(true).create(true).open(folder.join(part)).unwrap();
    writeln!(log, "{}", words[2..].join(" ")).unwrap();
    let says = Notifier::from_environment().unwrap();
    let code = match part.as_str() {
        "agent" => agent(scenario, folder, start, &says),
        "rt" => looper(scenario, folder, start, &says),
        "limp" => limp(scenario, start),
        other => panic!("{other}"),
    };
    std::process::exit(code);
}

/// Waits until `done` says so, or until nobody is above it any more.
fn waits(done: impl Fn() -> bool) {
    let parent = nix::unistd::getppid();
    while !done() && nix::unistd::getppid() == parent {
        std::thread::sleep(LOOK);
    }
}

/// Lives until it is told to end, or until `done` says so.
fn lives(says: &Notifier, done: impl Fn() -> bool) {
    waits(|| {
        says.say(Word::Alive);
        done()
    });
}

fn dies() -> i32 {
    kill(Pid::this(), Signal::SIGKILL).unwrap();
    unreachable!()
}

fn agent(scenario: &str, folder: &Path, start: usize, says: &Notifier) -> i32 {
    says.say(Word::Ready);
    if scenario == "pressed_early" {
        // There is a loop, but no tick yet.
        lives(says, || starts(folder, "rt") == 1);
        says.say(Word::Kill);
        std::fs::write(folder.join("pressed"), "").unwrap();
    }
    // SIGTERM ends it as it ends any program that does nothing about it.
    lives(says, || scenario == "no_program" && start == 1 && folder.join("agent-ends").exists());
    0
}

fn looper(scenario: &str, folder: &Path, start: usize, says: &Notifier) -> i32 {
    match (scenario, start) {
        ("dies_after_its_end", _) => {
            says.say(Word::Ready);
            assert!(says.say_last(Word::Stopping));
            dies()
        }
        ("full_disk_after_its_end", _) => {
            says.say(Word::Ready);
            assert!(says.say_last(Word::Stopping));
            i32::from(ExitCode::IoError.number())
        }
        ("pressed_early", _) => {
            waits(|| folder.join("pressed").exists());
            // Longer than braking may take. Then its first tick, and a few ticks later it brakes.
            std::thread::sleep(BRAKE_MAX + Duration::from_secs(1));
            says.say(Word::Ready);
            std::thread::sleep(Duration::from_millis(100));
            says.say(Word::Brakes);
            assert!(says.say_last(Word::Stopping));
            0
        }
        ("crash_then_order", 2) => {
            says.say(Word::Ready);
            assert!(says.say_last(Word::Stopping));
            0
        }
        ("no_program", _) => {
            says.say(Word::Ready);
            lives(says, || starts(folder, "agent") == 2);
            assert!(says.say_last(Word::Stopping));
            0
        }
        _ => {
            says.say(Word::Ready);
            dies()
        }
    }
}

fn limp(scenario: &str, start: usize) -> i32 {
    match (scenario, start) {
        ("unanswered", _) | ("crash_then_order", 1) => i32::from(ExitCode::TorqueOn.number()),
        ("let_go_hangs", _) => {
            waits(|| false);
            0
        }
        _ => 0,
    }
}

#[test]
fn a_loop_that_dies_after_its_end_does_not_rise_again() {
    let scene = Scene::new("dies_after_its_end");
    let (code, line) = failed(scene.run());
    assert_eq!(line, "the loop was ended by signal: 9 (SIGKILL); the torque is off");
    assert_eq!(code, ExitCode::Internal);
    assert_eq!((scene.starts("rt"), scene.starts("limp")), (1, 1));
    // One that could not finish its log has a code by which it would be tried again, had it not come to its
    // end.
    let scene = Scene::new("full_disk_after_its_end");
    assert_eq!(failed(scene.run()).0, ExitCode::IoError);
    assert_eq!((scene.starts("rt"), scene.starts("limp")), (1, 1));
}

#[test]
fn the_time_to_brake_counts_from_the_first_tick_on() {
    let mut scene = Scene::new("pressed_early");
    // A fifth of it is for braking.
    scene.plan.hang_after = 5 * BRAKE_MAX;
    scene.run().unwrap();
    // It was not taken for one that hangs.
    assert_eq!((scene.starts("rt"), scene.starts("limp")), (1, 0));
}

#[test]
fn letting_go_that_is_not_answered_is_a_failure_whatever_else_happens() {
    for scenario in ["unanswered", "let_go_hangs"] {
        let scene = Scene::new(scenario);
        // Asked to stop between two starts: in itself a run that ended as it should.
        let result = std::thread::scope(|scope| {
            let running = scope.spawn(|| scene.run());
            scene.comes_to("limp", 1);
            scene.stop.request("test");
            running.join().unwrap()
        });
        let (code, line) = failed(result);
        assert_eq!(code, ExitCode::TorqueOn, "{line}");
        assert!(line.contains("THE TORQUE MAY STILL BE ON"), "{line}");
    }
    // Where a later loop ended in order, it has asked the servos itself.
    let scene = Scene::new("crash_then_order");
    scene.run().unwrap();
    assert_eq!((scene.starts("rt"), scene.starts("limp")), (2, 1));
    // Where another program has the port by then, the robot is its.
    let said = std::fs::read_to_string(scene.path("limp")).unwrap();
    assert!(said.starts_with("--unless-taken "), "{said}");
}

#[test]
fn an_agent_that_cannot_be_started_again_does_not_end_the_walk() {
    let scene = Scene::new("no_program");
    let program = scene.plan.program.clone();
    let away = scene.path("away");
    std::thread::scope(|scope| {
        let running = scope.spawn(|| scene.run());
        scene.comes_to("rt", 1);
        std::fs::rename(&program, &away).unwrap();
        std::fs::write(scene.path("agent-ends"), "").unwrap();
        scene.hears("the agent cannot be started; the loop goes on");
        assert!(!running.is_finished(), "the walk goes on");
        std::fs::rename(&away, &program).unwrap();
        scene.comes_to("agent", 2);
        running.join().unwrap().unwrap();
    });
    assert_eq!((scene.starts("rt"), scene.starts("limp")), (1, 0));
    // One that cannot be started at all ends the run.
    std::fs::remove_file(&program).unwrap();
    let (code, line) = failed(scene.run());
    assert_eq!(code, ExitCode::OsResource, "{line}");
    assert!(line.contains("a child process"), "{line}");
}
