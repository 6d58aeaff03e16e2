//! What the end-to-end tests share: the built binaries, small training runs, and a look into run folders.
//!
//! The binaries are those of this build, beside the test executable (`make test` builds them first).

use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output};

use anyhow::{Context, Result, ensure};
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use serde_json::Value;

/// The repository.
#[must_use]
pub fn repository_root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap_or(Path::new(".")).to_path_buf()
}

/// One of the project's binaries.
///
/// # Errors
/// When it has not been built.
pub fn binary(name: &str) -> Result<PathBuf> {
    // .../target/release/deps/<test> → .../target/release/<name>
    let test = std::env::current_exe()?;
    let folder =
        test.parent().and_then(Path::parent).context("the test lies in target/<profile>/deps")?;
    let path = folder.join(name);
    ensure!(
        path.is_file(),
        "{} is not built: run `make test`, or `cargo build --release --workspace` first",
        path.display()
    );
    Ok(path)
}

/// A command on one of the binaries, run from the repository, with plain logs.
///
/// # Errors
/// When it has not been built.
pub fn command(name: &str, args: &[&str]) -> Result<Command> {
    let mut command = Command::new(binary(name)?);
    command.args(args).current_dir(repository_root());
    Ok(command)
}

/// Flags for `caudata train` that make a run of seconds: a small network, no long evaluation.
pub const TINY: &[&str] = &[
    "--preset",
    "quick",
    "--actors",
    "2",
    "--set",
    "learner.network.policy_hidden=[16]",
    "--set",
    "learner.network.value_hidden=[16]",
    "--set",
    "evaluation.episodes=0",
    "--set",
    "evaluation.robot_run_s=0",
    "--json",
];

/// Flags of whatever trains, for iterations of milliseconds: few samples each. The network is as it is
/// elsewhere, since a training may begin with a policy that is there.
pub const FEW_SAMPLES: [&str; 8] = [
    "--set",
    "actors.lanes=3",
    "--set",
    "actors.chunk_steps=8",
    "--set",
    "learner.ppo.minibatches=2",
    "--set",
    "telemetry.metrics=false",
];

/// `caudata train` with [`TINY`] and [`FEW_SAMPLES`], `extra` flags, into `out`.
///
/// # Errors
/// When the binary is not built.
pub fn train(out: &Path, extra: &[&str]) -> Result<Command> {
    let mut command = command("caudata", &["train"])?;
    command.args(TINY).args(FEW_SAMPLES);
    command.arg("--out").arg(out).args(extra);
    Ok(command)
}

/// Runs to the end; standard output and error come back as text for messages.
///
/// # Errors
/// When it cannot be started.
pub fn finish(mut command: Command) -> Result<Finished> {
    let output: Output = command.output().context("cannot start")?;
    Ok(Finished {
        code: output.status.code(),
        stdout: String::from_utf8_lossy(&output.stdout).into_owned(),
        stderr: String::from_utf8_lossy(&output.stderr).into_owned(),
    })
}

/// How a command ended.
#[derive(Debug)]
pub struct Finished {
    /// Exit code; `None` when a signal ended it.
    pub code: Option<i32>,
    /// Everything on standard output.
    pub stdout: String,
    /// Everything on standard error.
    pub stderr: String,
}

impl Finished {
    /// The lines `error: …` of standard error.
    #[must_use]
    pub fn errors(&self) -> Vec<&str> {
        self.stderr.lines().filter(|line| line.starts_with("error: ")).collect()
    }

    /// The JSON object on the last line of standard output.
    ///
    /// # Errors
    /// When there is none.
    pub fn last_json(&self) -> Result<Value> {
        let line = self.stdout.lines().last().context("nothing on standard output")?;
        serde_json::from_str(line).with_context(|| format!("not JSON: {line}"))
    }
}

/// Says on standard error, past what the test harness captures, that a test did not run, and why.
pub fn skipped(why: &str) {
    use std::io::Write;
    let test = std::thread::current();
    let name = test.name().unwrap_or("a test");
    // Nobody can be told if even this fails.
    let _ = writeln!(std::io::stderr(), "skipped: {name}: {why}");
}

/// Sends a signal to a process that this one started and has not waited for.
///
/// # Errors
/// When the system refuses.
pub fn signal(child: &Child, signal: Signal) -> Result<()> {
    // Not waited for: its number is still its own.
    let pid = i32::try_from(child.id())?;
    Ok(kill(Pid::from_raw(pid), signal)?)
}

/// Processes whose command line names `path`.
///
/// # Errors
/// When the system does not list its processes.
pub fn at_work(path: &Path) -> Result<Vec<i32>> {
    let processes = std::fs::read_dir("/proc")?.filter_map(Result::ok);
    let pids = processes.filter_map(|p| p.file_name().to_str()?.parse::<i32>().ok());
    let path = path.display().to_string();
    let names = |pid: &i32| {
        let line = std::fs::read(format!("/proc/{pid}/cmdline")).unwrap_or_default();
        String::from_utf8_lossy(&line).contains(&path)
    };
    Ok(pids.filter(names).collect())
}

/// A JSON file.
///
/// # Errors
/// When it is absent or not JSON.
pub fn json_file(path: &Path) -> Result<Value> {
    let text = std::fs::read_to_string(path).with_context(|| path.display().to_string())?;
    Ok(serde_json::from_str(&text)?)
}
