//! The steps of a study: each is announced, timed, and not done again where it is complete.
//!
//! A training is a child process. A signal to stop is passed on to it, and no other step is begun. It is
//! started from the main thread: on Linux the death of the thread that started a child is what the child is
//! told of.

use std::fs::OpenOptions;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitStatus, Stdio};
use std::sync::Arc;
use std::time::{Duration, Instant};

use caudata_config::{Config, ConfigArgs};
use caudata_evaluation::{Evaluation, Settings, Suite, SuiteResult};
use caudata_gap::{Progress, Report};
use caudata_telemetry::{ExitCode, Failure, FailureExt, PARENT_PID_VAR, StopFlag};
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use serde_json::Value;

use crate::failures::{refused, stopped};
use crate::{diagnosis, files, flags};

/// How often a step that runs is looked at.
const LOOK_EVERY: Duration = Duration::from_millis(50);

/// What is told of a study as it goes.
#[derive(Clone, Copy, Debug)]
pub enum News<'a> {
    /// A step begins, or is there already.
    Step {
        /// Its name.
        name: &'a str,
        /// What it does.
        what: &'a str,
    },
    /// A diagnosis goes on.
    Diagnosis(&'a Progress),
}

/// Steps done one after the other, and how long they took.
pub struct Steps<'a> {
    program: PathBuf,
    quiet: bool,
    stop: StopFlag,
    after_stop: String,
    seconds: Vec<(String, f64)>,
    tell: Box<dyn FnMut(News<'_>) + 'a>,
}

impl<'a> Steps<'a> {
    /// None yet. `program` is what `train` is a command of; `quiet`: what it prints is not wanted;
    /// `after_stop` is what can be done after a stop. No step begins once `stop` is raised.
    pub fn new(
        program: PathBuf,
        quiet: bool,
        stop: &StopFlag,
        after_stop: &str,
        tell: impl FnMut(News<'_>) + 'a,
    ) -> Self {
        Self {
            program,
            quiet,
            stop: stop.clone(),
            after_stop: after_stop.to_owned(),
            seconds: Vec::new(),
            tell: Box::new(tell),
        }
    }

    /// What can be done after a stop from here on.
    pub fn after_stop(&mut self, hint: &str) {
        hint.clone_into(&mut self.after_stop);
    }

    /// Wall time of each step so far, s.
    pub fn seconds(&self) -> Vec<(String, f64)> {
        self.seconds.clone()
    }

    /// Nothing, unless somebody asked to stop.
    ///
    /// # Errors
    /// Exit code 75 then.
    pub fn go_on(&self) -> Result<(), Failure> {
        if self.stop.is_set() { Err(self.stopped()) } else { Ok(()) }
    }

    fn stopped(&self) -> Failure {
        stopped(&self.stop).hint(self.after_stop.clone())
    }

    /// Does a step; `what` it does, in words. `work` looks at the flag.
    ///
    /// # Errors
    /// Those of `work`; exit code 75 after a stop.
    pub fn run<T>(
        &mut self,
        name: &str,
        what: &str,
        work: impl FnOnce(&StopFlag, &mut dyn FnMut(News<'_>)) -> Result<T, Failure>,
    ) -> Result<T, Failure> {
        self.go_on()?;
        (self.tell)(News::Step { name, what });
        let began = Instant::now();
        let done = work(&self.stop, &mut self.tell);
        self.seconds.push((name.to_owned(), began.elapsed().as_secs_f64()));
        match done {
            Err(_) if self.stop.is_set() => Err(self.stopped()),
            done => done,
        }
    }

    /// Says that a step need not be done again.
    pub fn is_there(&mut self, name: &str, path: &Path) {
        let what = &format!("{} is there already", path.display());
        (self.tell)(News::Step { name, what });
    }

    /// Diagnoses as `plan` says, whatever the verdict is.
    ///
    /// # Errors
    /// As [`diagnosis::diagnose`].
    pub fn diagnose(&mut self, name: &str, plan: &diagnosis::Plan) -> Result<Report, Failure> {
        let (robot, out) = (plan.robot.display(), plan.out.display());
        let what = format!("{robot} against its logs, into {out}");
        self.run(name, &what, |stop, tell| {
            let tell = &mut |progress: &_| tell(News::Diagnosis(progress));
            let report = diagnosis::diagnose(plan, stop, tell)?;
            if report.unfinished && stop.is_set() {
                // what comes next must not build on half an answer
                let path = plan.out.join(diagnosis::REPORT);
                std::fs::remove_file(&path).or_exit(ExitCode::CannotCreate)?;
                return Err(crate::failures::stopped(stop));
            }
            Ok(report)
        })
    }

    /// Trains a policy as `training` says, to its end, unless that has been done; the policy's file.
    ///
    /// # Errors
    /// The exit code that the training ended with; 75 where it was stopped.
    pub fn train(&mut self, name: &str, training: &Training<'_>) -> Result<PathBuf, Failure> {
        if let Some(policy) = training.finished() {
            self.is_there(name, &policy);
            return Ok(policy);
        }
        let mut command = training.command(&self.program)?;
        if let Some(path) = &training.progress {
            let open = || format!("cannot write {}", path.display());
            let file = OpenOptions::new().create(true).append(true).open(path);
            command.stdout(file.or_exit_with(ExitCode::CannotCreate, open)?);
        } else if self.quiet {
            command.stdout(Stdio::null());
        }
        self.child(name, &mut command)?;
        // A training that was stopped ends well, and leaves a policy too.
        match training.finished() {
            Some(policy) => Ok(policy),
            None if self.stop.is_set() => Err(self.stopped()),
            None => {
                let message = format!("{name} was stopped before its end");
                Err(Failure::message(ExitCode::TempFail, message).hint(self.after_stop.clone()))
            }
        }
    }

    fn child(&mut self, name: &str, command: &mut Command) -> Result<(), Failure> {
        let status = self.run(name, &spelled(command), |stop, _| attended(command, stop))?;
        match status.code().and_then(ExitCode::from_number) {
            _ if status.success() => Ok(()),
            _ if self.stop.is_set() => Err(self.stopped()),
            Some(code) => Err(Failure::said_already(code)),
            None => Err(Failure::message(
                ExitCode::Internal,
                format!("{name} ended with {status}"),
            )
            .hint("what was made so far is in the output folder; the command can be run by hand")),
        }
    }

    /// Evaluates a policy as `test` says; `file` keeps the result, and what it says of this very policy is
    /// not asked again.
    ///
    /// # Errors
    /// As [`refused`].
    pub fn evaluate(
        &mut self,
        name: &str,
        test: &Test<'_>,
        file: &Path,
    ) -> Result<SuiteResult, Failure> {
        let policy = files::policy(test.policy)?;
        let kept = files::read_json::<SuiteResult>(file).ok();
        if let Some(kept) = kept.filter(|kept| kept.policy_sha256 == policy.sha256_hex()) {
            self.is_there(name, file);
            return Ok(kept);
        }
        let (shown, robot) = (test.policy.display(), test.robot.display());
        let (suite, episodes) = (test.suite.name(), test.episodes);
        let what = format!("{shown} on {robot}: suite {suite}, {episodes} episodes");
        self.run(name, &what, |stop, _| {
            let mut config = test.config.clone();
            config.robot = std::path::absolute(test.robot).or_exit(ExitCode::NoInput)?;
            let evaluation = Evaluation {
                model: &Arc::new(files::robot(&config.robot)?),
                config: &config,
                policy: &policy,
                suite: test.suite,
                settings: Settings { episodes: test.episodes, ..Settings::default() },
                referee: None,
            };
            let (result, _) = evaluation
                .run(&|| !stop.is_set(), &mut |_, _| ())
                .map_err(|error| refused(error, stop))?;
            files::write_json(file, &result)?;
            Ok(result)
        })
    }
}

/// Runs a command to its end; a request to stop is passed on to it, and it ends by itself.
fn attended(command: &mut Command, stop: &StopFlag) -> Result<ExitStatus, Failure> {
    let cannot = || "cannot start a step".to_owned();
    let mut child = command.spawn().or_exit_with(ExitCode::OsResource, cannot)?;
    let mut asked = false;
    loop {
        if let Some(status) = child.try_wait().or_exit(ExitCode::Internal)? {
            return Ok(status);
        }
        if asked {
            // How long it may drain is limited by this process's own drain deadline.
            std::thread::sleep(LOOK_EVERY);
        } else if stop.wait(LOOK_EVERY) {
            asked = true;
            // It has not been waited for, so that its number is still its own.
            let pid = i32::try_from(child.id()).or_exit(ExitCode::Internal)?;
            let _ = kill(Pid::from_raw(pid), Signal::SIGTERM);
        }
    }
}

/// A training of a policy in one robot's model.
pub struct Training<'a> {
    /// How; the robot is another.
    pub flags: &'a ConfigArgs,
    /// The robot.
    pub robot: &'a Path,
    /// What it begins with; from nothing without it.
    pub start: Option<&'a Path>,
    /// Iterations.
    pub iterations: u64,
    /// Seed, where it is not the configuration's.
    pub seed: Option<u64>,
    /// More keys, `KEY=VALUE`.
    pub set: &'a [String],
    /// Run folder. A run that is in it goes on.
    pub out: PathBuf,
    /// File for what it says as it goes, behind what is in it; shown without one.
    pub progress: Option<PathBuf>,
}

/// For a policy that walks already: small steps from the first on, a critic that keeps up
/// (docs/reference/learning.md), costs and pushes that count from the start.
const GOES_ON: [&str; 6] = [
    "learner.ppo.learning_rate=5e-5",
    "learner.ppo.value_learning_rate=1e-3",
    "learner.ppo.target_kl=0.005",
    "learner.ppo.target_kl_final=0",
    "task.reward.costs_full_after_env_steps=0",
    "task.push.full_after_env_steps=0",
];
/// The step after this one evaluates.
const NO_EVALUATION: [&str; 2] = ["evaluation.episodes=0", "evaluation.robot_run_s=0"];

impl Training<'_> {
    /// The policy, where the run folder holds a training that has come to its end: one that was stopped has
    /// no report.
    pub fn finished(&self) -> Option<PathBuf> {
        let policy = self.out.join("policy.onnx");
        (policy.is_file() && self.out.join("report.json").is_file()).then_some(policy)
    }

    fn command(&self, program: &Path) -> Result<Command, Failure> {
        let mut command = Command::new(program);
        command
            .arg("train")
            .stdin(Stdio::null())
            .env(PARENT_PID_VAR, std::process::id().to_string())
            // Ctrl-C reaches this process alone, which passes it on: two signals would be "at once".
            .process_group(0);
        command.args(flags::as_words(self.flags));
        command.args(["--iterations", &self.iterations.to_string()]);
        if let Some(seed) = self.seed {
            command.args(["--seed", &seed.to_string()]);
        }
        command.arg("--out").arg(&self.out);
        if self.out.join("config.toml").is_file() {
            command.arg("--resume");
        }
        let mut set = vec![format!("robot={}", quoted(self.robot)?)];
        if let Some(start) = self.start {
            set.push(format!("learner.warm_start.policy={}", quoted(start)?));
            set.extend(GOES_ON.map(str::to_owned));
        }
        set.extend(NO_EVALUATION.map(str::to_owned));
        set.extend_from_slice(self.set);
        for set in set {
            command.args(["--set", &set]);
        }
        Ok(command)
    }
}

/// An evaluation of a policy on one robot.
pub struct Test<'a> {
    /// The task that it was trained for; the robot is another.
    pub config: &'a Config,
    /// The policy.
    pub policy: &'a Path,
    /// The robot.
    pub robot: &'a Path,
    /// Suite.
    pub suite: Suite,
    /// Episodes of each scenario.
    pub episodes: u32,
}

/// A path as a TOML string, absolute: relative paths of a configuration are relative to something else.
fn quoted(path: &Path) -> Result<String, Failure> {
    let path = std::path::absolute(path).or_exit(ExitCode::NoInput)?;
    Ok(Value::from(path.display().to_string()).to_string())
}

/// The command as one would type it.
fn spelled(command: &Command) -> String {
    let words = command.get_args().map(|word| word.to_string_lossy());
    std::iter::once("caudata".into()).chain(words).collect::<Vec<_>>().join(" ")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn words(training: &Training<'_>) -> Vec<String> {
        let command = training.command(Path::new("caudata")).unwrap();
        let words = command.get_args();
        words.map(|w| w.to_string_lossy().into_owned()).collect()
    }

    #[test]
    fn a_training_begins_with_a_policy_or_with_nothing() {
        let flags = ConfigArgs {
            preset: Some("flat".into()),
            overrides: vec!["actors.lanes=3".into()],
            ..ConfigArgs::default()
        };
        let mut training = Training {
            flags: &flags,
            robot: Path::new("/a b/r.robot.toml"),
            start: None,
            iterations: 7,
            seed: Some(2),
            set: &["task.randomisation.kp_scale=[0.5,1.3]".to_owned()],
            out: "/out".into(),
            progress: None,
        };
        let bare = words(&training);
        let has = |all: &[String], word: &str| all.iter().any(|w| w == word);
        for word in ["--seed", "2", "actors.lanes=3", "robot=\"/a b/r.robot.toml\""] {
            assert!(has(&bare, word), "{word}: {bare:?}");
        }
        // What is set last counts: this training's own keys stand behind the flags'.
        assert_eq!(bare[bare.len() - 1], "task.randomisation.kp_scale=[0.5,1.3]");
        assert!(!bare.iter().any(|w| w.starts_with("learner.")), "{bare:?}");
        training.start = Some(Path::new("/p.onnx"));
        let warm = words(&training);
        assert!(has(&warm, "learner.warm_start.policy=\"/p.onnx\""));
        assert!(has(&warm, GOES_ON[0]), "{warm:?}");
    }

    #[test]
    fn a_run_that_is_there_goes_on_and_is_finished_with_its_report() {
        let folder = tempfile::tempdir().unwrap();
        let training = Training {
            flags: &ConfigArgs::default(),
            robot: Path::new("/r.robot.toml"),
            start: None,
            iterations: 1,
            seed: None,
            set: &[],
            out: folder.path().to_owned(),
            progress: None,
        };
        let resumes = || words(&training).iter().any(|word| word == "--resume");
        let make = |name: &str| std::fs::write(folder.path().join(name), "").unwrap();
        assert!(!resumes());
        make("config.toml");
        make("policy.onnx");
        assert!(resumes());
        assert_eq!(training.finished(), None);
        make("report.json");
        assert_eq!(training.finished(), Some(folder.path().join("policy.onnx")));
    }

    fn steps(stop: &StopFlag) -> Steps<'static> {
        Steps::new("false".into(), true, stop, "go on", |_| ())
    }

    fn shell(script: &str) -> Command {
        let mut command = Command::new("sh");
        command.args(["-c", script]);
        command
    }

    #[test]
    fn the_exit_code_of_a_step_is_passed_on() {
        let mut steps = steps(&StopFlag::new());
        let mut code = |script: &str| {
            let ended = steps.child("step", &mut shell(script));
            ended.map_err(|failure| failure.code())
        };
        assert_eq!(code("exit 0"), Ok(()));
        assert_eq!(code("exit 64"), Err(ExitCode::BadConfig));
        assert_eq!(code("exit 73"), Err(ExitCode::CannotCreate));
        // None of ours
        assert_eq!(code("exit 3"), Err(ExitCode::Internal));
        assert_eq!(code("kill -9 $$"), Err(ExitCode::Internal));
        assert_eq!(steps.seconds().len(), 5);
    }

    #[test]
    fn a_stop_ends_the_step_that_runs_and_keeps_the_next_from_beginning() {
        let folder = tempfile::tempdir().unwrap();
        let (first, second) = (folder.path().join("first"), folder.path().join("second"));
        let stop = StopFlag::new();
        let mut steps = steps(&stop);
        let began = first.clone();
        let other = std::thread::spawn(move || {
            while !began.exists() {
                std::thread::sleep(Duration::from_millis(5));
            }
            stop.request("test");
        });
        let mut long = shell(&format!("touch '{}'; exec sleep 100000", first.display()));
        let ended = steps.child("long", &mut long);
        assert_eq!(ended.unwrap_err().code(), ExitCode::TempFail);
        other.join().unwrap();
        let mut next = shell(&format!("touch '{}'", second.display()));
        let ended = steps.child("next", &mut next);
        assert_eq!(ended.unwrap_err().code(), ExitCode::TempFail);
        assert!(steps.run("inside", "nothing", |_, _| Ok(())).is_err());
        assert!(!second.exists());
    }

    #[test]
    fn what_is_finished_is_not_done_again() {
        let folder = tempfile::tempdir().unwrap();
        // Nothing is begun any more: what comes out was there.
        let stop = StopFlag::new();
        stop.request("test");
        let mut steps = steps(&stop);
        let nothing = Path::new("/no/such/file");
        let root = Path::new(env!("CARGO_MANIFEST_DIR"));
        let policy = root.join("../../policies/flat.onnx");
        let test = Test {
            config: &ConfigArgs::default().load().unwrap(),
            policy: &policy,
            robot: nothing,
            suite: Suite::Flat,
            episodes: 1,
        };
        let file = folder.path().join("evaluation.json");
        let said = |policy_sha256: String| SuiteResult {
            suite: Suite::Flat,
            engine: "batch".into(),
            policy_version: 7,
            policy_sha256,
            scenarios: vec![crate::policies::tests::scenario(0.25, [0.02, 0.03, 0.1])],
            referee: None,
            acceptance: Vec::new(),
            animal: Vec::new(),
        };
        let own = said(files::policy(&policy).unwrap().sha256_hex());
        files::write_json(&file, &own).unwrap();
        assert_eq!(steps.evaluate("evaluate", &test, &file).unwrap(), own);
        // of another policy, it would be made again
        files::write_json(&file, &said("0".into())).unwrap();
        let again = steps.evaluate("evaluate", &test, &file).unwrap_err();
        assert_eq!(again.code(), ExitCode::TempFail);
        for name in ["config.toml", "policy.onnx", "report.json"] {
            std::fs::write(folder.path().join(name), "").unwrap();
        }
        let training = Training {
            flags: &ConfigArgs::default(),
            robot: nothing,
            start: None,
            iterations: 1,
            seed: None,
            set: &[],
            out: folder.path().to_owned(),
            progress: None,
        };
        let policy = folder.path().join("policy.onnx");
        assert_eq!(steps.train("train", &training).unwrap(), policy);
        assert!(steps.seconds().is_empty());
    }

    #[test]
    fn an_existing_log_is_written_behind() {
        let folder = tempfile::tempdir().unwrap();
        let log = folder.path().join("log");
        std::fs::write(&log, "before\n").unwrap();
        let mut steps = Steps::new("echo".into(), true, &StopFlag::new(), "go on", |_| ());
        let training = Training {
            flags: &ConfigArgs::default(),
            robot: Path::new("/r.robot.toml"),
            start: None,
            iterations: 7,
            seed: None,
            set: &[],
            out: folder.path().join("run"),
            progress: Some(log.clone()),
        };
        // `echo` says what it was asked, and trains nothing.
        let ended = steps.train("train", &training).unwrap_err();
        assert_eq!(ended.code(), ExitCode::TempFail);
        let said = std::fs::read_to_string(&log).unwrap();
        assert!(said.starts_with("before\ntrain --iterations 7"), "{said}");
    }
}
