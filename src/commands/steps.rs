//! Commands of this program as steps of a longer one: each is printed as one would type it, timed, and may be run again by hand. Training and evaluation of a
//! policy are two of them, which `caudata adapt` and `caudata gap policies` share.

use std::fs::File;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::Instant;

use caudata_config::ConfigArgs;
use caudata_telemetry::{ExitCode, Failure, FailureExt};
use serde_json::Value;

use crate::say;

/// This program with `command`.
pub fn own(command: &str) -> Result<Command, Failure> {
    let mut own = Command::new(std::env::current_exe().or_exit(ExitCode::Internal)?);
    own.arg(command);
    Ok(own)
}

/// Commands run one after the other, and how long they took.
pub struct Steps {
    quiet: bool,
    seconds: Vec<(String, f64)>,
}

/// Where the standard output of a step goes.
enum Output<'a> {
    /// Where that of this program goes; nowhere where only one line is wanted.
    Shown,
    /// Into a file.
    File(&'a Path),
}

impl Steps {
    /// None yet. `quiet`: only the last line of all is wanted.
    pub fn new(quiet: bool) -> Self {
        Self {
            quiet,
            seconds: Vec::new(),
        }
    }

    /// Wall time of each step so far, s.
    pub fn seconds(self) -> Vec<(String, f64)> {
        self.seconds
    }

    /// Runs a step; its exit code, which must be one of `good`.
    pub fn run(&mut self, name: &str, command: &mut Command, good: &[i32]) -> Result<i32, Failure> {
        self.with_output(name, command, good, &Output::Shown)
    }

    fn with_output(
        &mut self,
        name: &str,
        command: &mut Command,
        good: &[i32],
        output: &Output<'_>,
    ) -> Result<i32, Failure> {
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
        }
        if !self.quiet {
            say::line(format_args!("── {name}: {}", spelled(command)));
        }
        let began = Instant::now();
        let status = command.status().or_exit(ExitCode::OsResource)?;
        let took_s = began.elapsed().as_secs_f64();
        self.seconds.push((name.to_owned(), took_s));
        match status.code() {
            Some(code) if good.contains(&code) => Ok(code),
            _ => Err(Failure::message(
                ExitCode::Internal,
                format!("{name} ended with {status}; its message is above"),
            )
            .hint("what was made so far is in the output folder; the command that failed can be run by hand")),
        }
    }

    /// Trains a policy as `training` says; the policy's file.
    pub fn train(&mut self, name: &str, training: &Training<'_>) -> Result<PathBuf, Failure> {
        let mut command = training.command()?;
        let output = match &training.progress {
            Some(path) => Output::File(path),
            None => Output::Shown,
        };
        self.with_output(name, &mut command, &[0], &output)?;
        Ok(training.out.join("policy.onnx"))
    }

    /// Evaluates a policy as `test` says; what `caudata eval --json` says, which `file` keeps.
    pub fn evaluate(&mut self, name: &str, test: &Test<'_>, file: &Path) -> Result<Value, Failure> {
        let mut command = test.command()?;
        self.with_output(name, &mut command, &[0, 79], &Output::File(file))?;
        last_json(file)
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
    pub set: &'a [&'a str],
    /// Run folder.
    pub out: PathBuf,
    /// File for what it says as it goes; shown without one.
    pub progress: Option<PathBuf>,
}

/// For a policy that walks already: small steps from the first on, a critic that keeps up (docs/learning.md), costs and pushes that count from the start.
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
    fn command(&self) -> Result<Command, Failure> {
        let mut command = own("train")?;
        command.args(super::bench::as_flags(self.flags));
        command.args(["--iterations", &self.iterations.to_string()]);
        if let Some(seed) = self.seed {
            command.args(["--seed", &seed.to_string()]);
        }
        command.arg("--out").arg(&self.out);
        let mut set = vec![format!("robot={}", quoted(self.robot)?)];
        if let Some(start) = self.start {
            set.push(format!("learner.warm_start.policy={}", quoted(start)?));
            set.extend(GOES_ON.map(str::to_owned));
        }
        set.extend(NO_EVALUATION.map(str::to_owned));
        set.extend(self.set.iter().map(|s| (*s).to_owned()));
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
    pub suite: &'a str,
    /// Episodes of each scenario.
    pub episodes: u32,
}

impl Test<'_> {
    fn command(&self) -> Result<Command, Failure> {
        let mut command = own("eval")?;
        command.arg("--policy").arg(self.policy);
        command.arg("--robot").arg(self.robot);
        command.args(super::bench::as_flags(self.flags));
        command.args(["--suite", self.suite, "--json", "--episodes"]);
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
fn last_json(path: &Path) -> Result<Value, Failure> {
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
            set: &["task.randomisation.kp_scale=[0.5,1.3]"],
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
