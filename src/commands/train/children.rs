//! Child processes: started beside this executable, logged to files, stopped with a deadline.

use std::fs::{File, OpenOptions};
use std::io::{BufRead, BufReader, Read, Seek, SeekFrom};
use std::os::unix::process::{CommandExt, ExitStatusExt};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use caudata_telemetry::{ExitCode, Failure, FailureExt, PARENT_PID_VAR};
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;

/// How often a child that shall end is looked at.
const END_LOOK_EVERY: Duration = Duration::from_millis(20);

/// Where the other executables are.
#[derive(Clone, Debug)]
pub struct Programs {
    folder: PathBuf,
}

impl Programs {
    /// Those that were installed beside this one.
    pub fn beside_this_one() -> Result<Self, Failure> {
        let own = std::env::current_exe().or_exit(ExitCode::Internal)?;
        Ok(Self { folder: own.with_file_name("") })
    }

    /// Those in `folder`.
    #[cfg(test)]
    pub fn inside(folder: &Path) -> Self {
        Self { folder: folder.to_owned() }
    }

    /// The executable `name`.
    pub fn find(&self, name: &str) -> Result<PathBuf, Failure> {
        let path = self.folder.join(name);
        if path.is_file() {
            return Ok(path);
        }
        let message = format!("{name} is not in {}", self.folder.display());
        Err(Failure::message(ExitCode::NoInput, message).hint("`make build` makes all executables"))
    }
}

/// A running child. Dropped while it runs, it is killed: no child outlives an error.
#[derive(Debug)]
pub struct Process {
    name: String,
    child: Child,
    log: PathBuf,
    /// Length of the log when this child was started: what stands before is of others.
    log_from: u64,
    reader: Option<JoinHandle<()>>,
    status: Option<ExitStatus>,
}

/// What to do with each line of a child's standard output, on a thread of its own.
pub type LineSink = Box<dyn FnMut(String) + Send>;

impl Process {
    /// Starts `command`; standard error is appended to `log`, lines of standard output go to `lines`, or to
    /// the log too.
    ///
    /// Called from the main thread only: on Linux the parent-death signal follows the starting thread.
    pub fn start(
        name: &str,
        mut command: Command,
        log: &Path,
        lines: Option<LineSink>,
    ) -> Result<Self, Failure> {
        let cannot_log = || format!("cannot write {}", log.display());
        let file = OpenOptions::new()
            .create(true)
            .append(true)
            .open(log)
            .or_exit_with(ExitCode::CannotCreate, cannot_log)?;
        let log_from = file.metadata().map_or(0, |metadata| metadata.len());
        let stdout = match &lines {
            Some(_) => Stdio::piped(),
            None => clone_of(&file, log)?.into(),
        };
        let mut child = command
            .stdin(Stdio::null())
            .stdout(stdout)
            .stderr(file)
            .env(PARENT_PID_VAR, std::process::id().to_string())
            // Ctrl-C reaches the supervisor alone, which then stops the children in order.
            .process_group(0)
            .spawn()
            .or_exit_with(ExitCode::OsResource, || format!("cannot start {name}"))?;
        let reader = match (lines, child.stdout.take()) {
            (Some(sink), Some(stdout)) => Some(read_lines(name, stdout, sink)?),
            _ => None,
        };
        tracing::info!(name, pid = child.id(), "started");
        Ok(Self {
            name: name.to_owned(),
            child,
            log: log.to_owned(),
            log_from,
            reader,
            status: None,
        })
    }

    /// Its name in messages.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Its process id.
    pub fn pid(&self) -> u32 {
        self.child.id()
    }

    /// Its log.
    pub fn log(&self) -> &Path {
        &self.log
    }

    /// What this child itself has said last about why it fails.
    pub fn last_error(&self) -> Option<LastWords> {
        last_error(&self.log, self.log_from)
    }

    /// How it ended, if it has. Everything that it printed has then been read.
    pub fn ended(&mut self) -> Option<ExitStatus> {
        if self.status.is_none() {
            self.status = self.child.try_wait().ok().flatten();
            if self.status.is_some()
                && let Some(reader) = self.reader.take()
            {
                let _ = reader.join();
            }
        }
        self.status
    }

    /// Sends a signal; one to a child that has just ended is lost, which is fine.
    pub fn signal(&self, signal: Signal) {
        let pid = i32::try_from(self.child.id()).unwrap_or_default();
        if self.status.is_none() && pid > 0 {
            let _ = kill(Pid::from_raw(pid), signal);
        }
    }

    /// Waits for its end, at most `patience`; then kills it.
    pub fn finish(&mut self, patience: Duration) -> Option<ExitStatus> {
        let deadline = Instant::now() + patience;
        while self.ended().is_none() {
            if Instant::now() >= deadline {
                tracing::warn!(name = self.name, "did not end in time; killed");
                let _ = self.child.kill();
                let _ = self.child.wait();
            } else {
                std::thread::sleep(END_LOOK_EVERY);
            }
        }
        self.status
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        if self.ended().is_none() {
            let _ = self.child.kill();
            let _ = self.child.wait();
        }
    }
}

fn clone_of(file: &File, log: &Path) -> Result<File, Failure> {
    file.try_clone()
        .or_exit_with(ExitCode::OsResource, || format!("cannot share {}", log.display()))
}

fn read_lines(
    name: &str,
    stdout: std::process::ChildStdout,
    mut sink: LineSink,
) -> Result<JoinHandle<()>, Failure> {
    std::thread::Builder::new()
        .name(format!("{name}-stdout"))
        .spawn(move || BufReader::new(stdout).lines().map_while(Result::ok).for_each(&mut sink))
        .or_exit(ExitCode::OsResource)
}

/// How a child ended, as its exit code where it is one of ours.
pub fn exit_code(status: ExitStatus) -> ExitCode {
    status.code().and_then(ExitCode::from_number).unwrap_or(ExitCode::Internal)
}

/// How a child ended, in words.
pub fn describe(status: ExitStatus) -> String {
    match (status.code(), status.signal()) {
        (Some(code), _) => format!("ended with exit code {code}"),
        (None, Some(signal)) => match Signal::try_from(signal) {
            Ok(signal) => format!("was killed by {signal}"),
            Err(_) => format!("was killed by signal {signal}"),
        },
        (None, None) => "ended".into(),
    }
}

/// What a child said before it ended, to pass on to the user.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LastWords {
    /// Its line `error: …`.
    pub error: String,
    /// Its line `hint: …`.
    pub hint: Option<String>,
}

/// The last `error:` line of a log from byte `from` on, and the hint below it.
fn last_error(log: &Path, from: u64) -> Option<LastWords> {
    let mut file = File::open(log).ok()?;
    file.seek(SeekFrom::Start(from)).ok()?;
    let mut bytes = Vec::new();
    file.read_to_end(&mut bytes).ok()?;
    let text = String::from_utf8_lossy(&bytes);
    let mut lines = text.lines().rev();
    let mut hint = None;
    let error = lines.find_map(|line| {
        if let Some(text) = line.strip_prefix("hint: ") {
            hint = Some(text.to_owned());
        }
        line.strip_prefix("error: ")
    })?;
    Some(LastWords { error: error.to_owned(), hint })
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::{Arc, Mutex};

    fn shell(script: &str) -> Command {
        let mut command = Command::new("sh");
        command.args(["-c", script]);
        command
    }

    #[test]
    fn lines_are_read_and_the_exit_code_is_kept() {
        let dir = tempfile::tempdir().unwrap();
        let log = dir.path().join("child.log");
        let lines = Arc::new(Mutex::new(Vec::new()));
        let sink = Arc::clone(&lines);
        let sink: LineSink = Box::new(move |line| sink.lock().unwrap().push(line));
        let script = "echo one; echo two; echo 'error: no luck' >&2; exit 75";
        let mut child = Process::start("child", shell(script), &log, Some(sink)).unwrap();
        let status = child.finish(Duration::from_secs(60)).unwrap();
        assert_eq!(exit_code(status), ExitCode::TempFail);
        assert_eq!(*lines.lock().unwrap(), ["one", "two"]);
        let words = |error: &str, hint: Option<&str>| LastWords {
            error: error.into(),
            hint: hint.map(str::to_owned),
        };
        assert_eq!(child.last_error(), Some(words("no luck", None)));

        // The next one writes to the same log; what the first one said is not its own.
        let mut next =
            Process::start("child", shell("echo hm >&2; kill -9 $$"), &log, None).unwrap();
        next.finish(Duration::from_secs(60)).unwrap();
        assert_eq!(next.last_error(), None);
        let script =
            "echo 'error: a' >&2; echo 'hint: b' >&2; echo 'error: c' >&2; echo 'hint: d' >&2";
        let mut third = Process::start("child", shell(script), &log, None).unwrap();
        third.finish(Duration::from_secs(60)).unwrap();
        assert_eq!(third.last_error(), Some(words("c", Some("d"))));
    }

    #[test]
    fn a_child_that_ignores_sigterm_is_killed() {
        let dir = tempfile::tempdir().unwrap();
        let script = "trap '' TERM; echo ready; while :; do sleep 0.05; done";
        let (ready, is_ready) = std::sync::mpsc::sync_channel(1);
        let sink: LineSink = Box::new(move |_| ready.send(()).unwrap());
        let log = dir.path().join("stubborn.log");
        let mut child = Process::start("stubborn", shell(script), &log, Some(sink)).unwrap();
        is_ready.recv().unwrap();
        child.signal(Signal::SIGTERM);
        let status = child.finish(Duration::from_millis(200)).unwrap();
        assert_eq!(describe(status), "was killed by SIGKILL");
    }
}
