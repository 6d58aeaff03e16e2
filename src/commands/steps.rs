//! Commands of this program as steps of a longer one: each is printed as one would type it, timed, and may be run again by hand. Training and evaluation of a
//! policy are two of them, which `caudata adapt` and `caudata gap policies` share.
//!
//! A signal to stop is passed on to the step that runs, and no other is begun. Steps are started from the main thread: on Linux the death of the thread that
//! started a child is what the child is told of.

use std::fs::{File, OpenOptions};
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitStatus, Stdio};
use std::time::{Duration, Instant};

use caudata_config::ConfigArgs;
use caudata_evaluation::Suite;
use caudata_telemetry::{ExitCode, Failure, FailureExt, PARENT_PID_VAR, StopFlag};
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use serde_json::Value;

use super::eval::read_policy;
use super::train::children::describe;
use crate::say;

/// How often a step that runs is looked at.
const LOOK_EVERY: Duration = Duration::from_millis(50);

/// This program with `command`, which ends when this process does, however that ends.
pub fn own(command: &str) -> Result<Command, Failure> {
    let mut own = Command::new(std::env::current_exe().or_exit(ExitCode::Internal)?);
    own.arg(command)
        .stdin(Stdio::null())
        .env(PARENT_PID_VAR, std::process::id().to_string())
        // Ctrl-C reaches this process alone, which passes it on: two signals would be "at once".
        .process_group(0);
    Ok(own)
}

/// Commands run one after the other, and how long they took.
pub struct Steps {
    quiet: bool,
    stop: StopFlag,
    after_stop: String,
    seconds: Vec<(String, f64)>,
}

/// Where the standard output of a step goes.
enum Output<'a> {
    /// Where that of this program goes; nowhere where only one line is wanted.
    Shown,
    /// Into a new file.
    File(&'a Path),
    /// Behind what is in a file.
    Behind(&'a Path),
}

impl Steps {
    /// None yet. `quiet`: only the last line of all is wanted. No step begins once `stop` is raised.
    pub fn new(quiet: bool, stop: &StopFlag) -> Self {
        Self {
            quiet,
            stop: stop.clone(),
            after_stop: "what was made so far is in the output folder".to_owned(),
            seconds: Vec::new(),
        }
    }

    /// What can be done after a stop, in place of "what was made so far is in the output folder".
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
        match self.stop.is_set() {
            true => Err(self.stopped()),
            false => Ok(()),
        }
    }

    fn stopped(&self) -> Failure {
        stopped(&self.stop).hint(self.after_stop.clone())
    }

    /// Runs a step; its exit code, which must be one of `good`.
    pub fn run(&mut self, name: &str, command: &mut Command, good: &[i32]) -> Result<i32, Failure> {
        self.with_output(name, command, good, &Output::Shown)
    }

    /// Does a step in this process; `what` it does, in words. `work` looks at the flag.
    pub fn inside<T>(
        &mut self,
        name: &str,
        what: &str,
        work: impl FnOnce(&StopFlag) -> Result<T, Failure>,
    ) -> Result<T, Failure> {
        self.go_on()?;
        self.announce(name, what);
        let began = Instant::now();
        let done = work(&self.stop);
        self.took(name, began);
        match done {
            Err(_) if self.stop.is_set() => Err(self.stopped()),
            done => done,
        }
    }

    /// Says that a step need not be done again.
    pub fn is_there(&self, name: &str, path: &Path) {
        self.announce(name, &format!("{} is there already", path.display()));
    }

    fn announce(&self, name: &str, what: &str) {
        if !self.quiet {
            say::line(format_args!("── {name}: {what}"));
        }
    }

    fn took(&mut self, name: &str, began: Instant) {
        let took_s = began.elapsed().as_secs_f64();
        self.seconds.push((name.to_owned(), took_s));
    }

    fn with_output(
        &mut self,
        name: &str,
        command: &mut Command,
        good: &[i32],
        output: &Output<'_>,
    ) -> Result<i32, Failure> {
        self.go_on()?;
        match output {
            Output::Shown if self.quiet => {
                command.stdout(Stdio::null());
            }
            Output::Shown => {}
            Output::File(path) => {
                let create = || format!("cannot create {}", path.display());
                let file = File::create(path).or_exit_with(ExitCode::CannotCreate, create)?;
                command.stdout(file);
            }
            Output::Behind(path) => {
                let open = || format!("cannot write {}", path.display());
                let file = OpenOptions::new().create(true).append(true).open(path);
                command.stdout(file.or_exit_with(ExitCode::CannotCreate, open)?);
            }
        }
        self.announce(name, &spelled(command));
        let began = Instant::now();
        let status = attended(command, &self.stop)?;
        self.took(name, began);
        match (status.code(), status.code().and_then(ExitCode::from_number)) {
            (Some(code), _) if good.contains(&code) => Ok(code),
            _ if self.stop.is_set() => Err(self.stopped()),
            (_, Some(code)) => Err(Failure::said_already(code)),
            _ => Err(Failure::message(
                ExitCode::Internal,
                format!("{name} {}", describe(status)),
            )
            .hint("what was made so far is in the output folder; the command that failed can be run by hand")),
        }
    }

    /// Trains a policy as `training` says, to its end, unless that has been done; the policy's file.
    pub fn train(&mut self, name: &str, training: &Training<'_>) -> Result<PathBuf, Failure> {
        if let Some(policy) = training.finished() {
            self.is_there(name, &policy);
            return Ok(policy);
        }
        let mut command = training.command()?;
        let output = match &training.progress {
            Some(path) => Output::Behind(path),
            None => Output::Shown,
        };
        self.with_output(name, &mut command, &[0], &output)?;
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

    /// Evaluates a policy as `test` says; what `caudata eval --json` says, which `file` keeps. The file is there when it is complete, and what it says of this
    /// very policy is not asked again.
    pub fn evaluate(&mut self, name: &str, test: &Test<'_>, file: &Path) -> Result<Value, Failure> {
        if file.is_file() {
            let said: Value = last_json(file)?;
            if said["policy_sha256"] == read_policy(test.policy)?.sha256_hex() {
                self.is_there(name, file);
                return Ok(said);
            }
        }
        let mut command = test.command()?;
        let part = file.with_extension("part");
        let output = Output::File(&part);
        self.with_output(name, &mut command, &[0, 79], &output)?;
        let said = last_json(&part)?;
        let cannot = || format!("cannot write {}", file.display());
        std::fs::rename(&part, file).or_exit_with(ExitCode::CannotCreate, cannot)?;
        Ok(said)
    }
}

/// What a command ends with that was asked to stop.
pub fn stopped(stop: &StopFlag) -> Failure {
    let by = stop.reason().map(|reason| format!(" by {reason}"));
    let message = format!("stopped{}", by.unwrap_or_default());
    Failure::message(ExitCode::TempFail, message)
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

/// For a policy that walks already: small steps from the first on, a critic that keeps up (docs/reference/learning.md), costs and pushes that count from the start.
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
    /// The policy, where the run folder holds a training that has come to its end: one that was stopped has no report.
    pub fn finished(&self) -> Option<PathBuf> {
        let policy = self.out.join("policy.onnx");
        (policy.is_file() && self.out.join("report.json").is_file()).then_some(policy)
    }

    fn command(&self) -> Result<Command, Failure> {
        let mut command = own("train")?;
        command.args(super::bench::as_flags(self.flags));
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
    /// The task that it was trained for.
    pub flags: &'a ConfigArgs,
    /// The policy.
    pub policy: &'a Path,
    /// The robot.
    pub robot: &'a Path,
    /// Suite.
    pub suite: Suite,
    /// Episodes of each scenario.
    pub episodes: u32,
}

impl Test<'_> {
    fn command(&self) -> Result<Command, Failure> {
        let mut command = own("eval")?;
        command.arg("--policy").arg(self.policy);
        command.arg("--robot").arg(self.robot);
        command.args(super::bench::as_flags(self.flags));
        command.args(["--suite", self.suite.name(), "--json", "--episodes"]);
        command.arg(self.episodes.to_string());
        Ok(command)
    }
}

/// A path as a TOML string, absolute: relative paths of a configuration are relative to something else.
fn quoted(path: &Path) -> Result<String, Failure> {
    let path = std::path::absolute(path).or_exit(ExitCode::NoInput)?;
    Ok(Value::from(path.display().to_string()).to_string())
}

/// The command as one would type it.
fn spelled(command: &Command) -> String {
    let words = command.get_args().map(|word| word.to_string_lossy());
    std::iter::once("caudata".into())
        .chain(words)
        .collect::<Vec<_>>()
        .join(" ")
}

/// The last line of a command's output.
///
/// # Errors
/// When the file cannot be read, or its last line is something else.
pub fn last_json<T: serde::de::DeserializeOwned>(path: &Path) -> Result<T, Failure> {
    let text = std::fs::read_to_string(path).or_exit_with(ExitCode::NoInput, || {
        format!("cannot read {}", path.display())
    })?;
    let last = text.lines().last().unwrap_or_default();
    serde_json::from_str(last).or_exit_with(ExitCode::BadInput, || path.display().to_string())
}

/// How far off the command a policy is, and how often it falls, over all scenarios of an evaluation.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Measures {
    /// Share of episodes that end by falling.
    pub falls: f64,
    /// Root mean square over scenarios of the error of strides: forward, sideways (m/s), turning (rad/s).
    pub off: [f64; 3],
}

/// The measures of what `caudata eval --json` said; `None` where they are not all there.
pub fn measures(evaluation: &Value) -> Option<Measures> {
    let scenarios = evaluation["scenarios"].as_array()?;
    let mean = |value: &dyn Fn(&Value) -> Option<f64>| {
        let values = scenarios.iter().map(value).collect::<Option<Vec<_>>>()?;
        Some(values.iter().sum::<f64>() / values.len().max(1) as f64)
    };
    let off = |axis: usize| {
        let square = mean(&|s| Some(s["rmse_of_strides"][axis].as_f64()?.powi(2)))?;
        Some(square.sqrt())
    };
    Some(Measures {
        falls: mean(&|s| s["fall_share"]["mean"].as_f64())?,
        off: [off(0)?, off(1)?, off(2)?],
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn words(training: &Training<'_>) -> Vec<String> {
        let command = training.command().unwrap();
        let words = command.get_args();
        words.map(|w| w.to_string_lossy().into_owned()).collect()
    }

    #[test]
    fn a_training_begins_with_a_policy_or_with_nothing() {
        let flags = ConfigArgs {
            preset: Some("flat".into()),
            config: None,
            overrides: vec!["actors.lanes=3".into()],
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
        for word in [
            "--seed",
            "2",
            "actors.lanes=3",
            "robot=\"/a b/r.robot.toml\"",
        ] {
            assert!(has(&bare, word), "{word}: {bare:?}");
        }
        // What is set last counts: this training's own keys stand behind the flags'.
        assert_eq!(
            bare[bare.len() - 1],
            "task.randomisation.kp_scale=[0.5,1.3]"
        );
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

    fn shell(script: &str) -> Command {
        let mut command = Command::new("sh");
        command.args(["-c", script]);
        command
    }

    #[test]
    fn the_exit_code_of_a_step_is_passed_on() {
        let mut steps = Steps::new(true, &StopFlag::new());
        let mut code = |script: &str| {
            let ended = steps.run("step", &mut shell(script), &[0, 80]);
            ended.map_err(|failure| failure.code())
        };
        assert_eq!(code("exit 80"), Ok(80));
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
        let mut steps = Steps::new(true, &stop);
        let began = first.clone();
        let other = std::thread::spawn(move || {
            while !began.exists() {
                std::thread::sleep(Duration::from_millis(5));
            }
            stop.request("test");
        });
        let mut long = shell(&format!("touch '{}'; exec sleep 100000", first.display()));
        let ended = steps.run("long", &mut long, &[0]);
        assert_eq!(ended.unwrap_err().code(), ExitCode::TempFail);
        other.join().unwrap();
        let mut next = shell(&format!("touch '{}'", second.display()));
        let ended = steps.run("next", &mut next, &[0]);
        assert_eq!(ended.unwrap_err().code(), ExitCode::TempFail);
        assert!(steps.inside("inside", "nothing", |_| Ok(())).is_err());
        assert!(!second.exists());
    }

    #[test]
    fn what_is_finished_is_not_done_again() {
        let folder = tempfile::tempdir().unwrap();
        // Nothing is begun any more: what comes out was there.
        let stop = StopFlag::new();
        stop.request("test");
        let mut steps = Steps::new(true, &stop);
        let nothing = Path::new("/no/such/file");
        let policy = Path::new(env!("CARGO_MANIFEST_DIR")).join("policies/flat.onnx");
        let test = Test {
            flags: &ConfigArgs::default(),
            policy: &policy,
            robot: nothing,
            suite: Suite::Flat,
            episodes: 1,
        };
        let file = folder.path().join("evaluation.json");
        let said = |sha256: &str| serde_json::json!({ "policy_sha256": sha256 });
        let own = said(&read_policy(&policy).unwrap().sha256_hex());
        std::fs::write(&file, format!("{own}\n")).unwrap();
        assert_eq!(steps.evaluate("evaluate", &test, &file).unwrap(), own);
        // of another policy, it would be made again
        std::fs::write(&file, format!("{}\n", said("0"))).unwrap();
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
        let mut steps = Steps::new(true, &StopFlag::new());
        let output = Output::Behind(&log);
        let mut echo = shell("echo after");
        steps.with_output("echo", &mut echo, &[0], &output).unwrap();
        assert_eq!(std::fs::read_to_string(&log).unwrap(), "before\nafter\n");
    }

    #[test]
    fn errors_of_scenarios_are_added_as_squares() {
        let scenario = |falls: f64, off: f64| serde_json::json!({ "fall_share": { "mean": falls }, "rmse_of_strides": [off, 0.01, 0.0] });
        let both = serde_json::json!({ "scenarios": [scenario(0.0, 0.03), scenario(0.5, 0.04)] });
        let got = measures(&both).unwrap();
        // √((0.0009 + 0.0016)/2) = 0.0353553
        assert!((got.off[0] - 0.035_355_3).abs() < 1e-6 && (got.off[1] - 0.01).abs() < 1e-12);
        assert_eq!(got.falls, 0.25);
        assert_eq!(
            measures(&serde_json::json!({ "scenarios": [{ "rmse_of_strides": [0.0, 0.0] }] })),
            None
        );
    }
}
