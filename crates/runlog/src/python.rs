//! Recordings that Python's own libraries read: `sqlite3` of its standard library, and `pyarrow`.

use std::ffi::OsStr;
use std::io::{self, BufReader, Read, Write};
use std::path::Path;
use std::process::{Child, ChildStdout, Command, Stdio};

use crate::LogError;

/// Names the Python; otherwise it is the `python3` of the path.
const PYTHON: &str = "CAUDATA_PYTHON";

/// With this a script ends that lacks a library (EX_UNAVAILABLE of sysexits.h).
const LACKS_LIBRARY: i32 = 69;

/// Why a script gave no more, in words.
#[derive(Debug)]
pub(crate) enum ScriptError {
    /// There is no such Python, or it lacks a library.
    Missing(String),
    /// What it read is wrong.
    Wrong(String),
}

impl ScriptError {
    /// As an error of the file that the script was to read or write.
    pub fn of(self, path: &Path) -> LogError {
        let file = path.display().to_string();
        match self {
            Self::Missing(message) => LogError::Python { file, message },
            Self::Wrong(message) => LogError::Recording { file, message },
        }
    }
}

/// A script that runs. What it prints is read from it; it ends with this value.
pub(crate) struct Script {
    child: Child,
    output: BufReader<ChildStdout>,
}

impl Script {
    /// Starts a script with its arguments, and gives it its input.
    ///
    /// # Errors
    /// There is no such Python, or it took no input.
    pub fn start(script: &str, arguments: &[&OsStr], input: &[u8]) -> Result<Self, ScriptError> {
        let python = std::env::var_os(PYTHON).unwrap_or_else(|| "python3".into());
        let failed = |e: io::Error| {
            let python = python.display();
            let why = format!("needs a Python, and `{python}` does not start ({e})");
            ScriptError::Missing(format!("{why}; {PYTHON} may name another"))
        };
        let mut child = Command::new(&python)
            .arg("-c")
            .arg(script)
            .args(arguments)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .map_err(failed)?;
        let (stdin, stdout) = (child.stdin.take(), child.stdout.take());
        let no_pipe = || ScriptError::Missing("has no pipe to Python".to_owned());
        let output = BufReader::new(stdout.ok_or_else(no_pipe)?);
        // One that has ended already says why in `finish`.
        let _ = stdin.ok_or_else(no_pipe)?.write_all(input);
        Ok(Self { child, output })
    }

    /// The next bytes, or `None` where it prints no more.
    pub fn take<const N: usize>(&mut self) -> Option<[u8; N]> {
        let mut bytes = [0; N];
        self.output.read_exact(&mut bytes).ok().map(|()| bytes)
    }

    /// The next `n` bytes, or `None` where there are not as many. No more room is made than there are bytes.
    pub fn bytes(&mut self, n: usize) -> Option<Vec<u8>> {
        let mut bytes = Vec::new();
        let read = self.output.by_ref().take(n as u64).read_to_end(&mut bytes);
        (read.ok()? == n).then_some(bytes)
    }

    /// Waits for its end.
    ///
    /// # Errors
    /// The last line that it said, if it failed.
    pub fn finish(mut self) -> Result<(), ScriptError> {
        let mut said = String::new();
        // It does not end before what it prints is read.
        let _ = io::copy(&mut self.output, &mut io::sink());
        if let Some(mut stderr) = self.child.stderr.take() {
            let _ = stderr.read_to_string(&mut said);
        }
        match self.child.wait() {
            Ok(status) if status.success() => Ok(()),
            Ok(status) => {
                let last = said.lines().last();
                let message = last.map_or(status.to_string(), str::to_owned);
                Err(match status.code() {
                    Some(LACKS_LIBRARY) => ScriptError::Missing(message),
                    _ => ScriptError::Wrong(message),
                })
            }
            Err(error) => Err(ScriptError::Wrong(error.to_string())),
        }
    }
}

impl Drop for Script {
    fn drop(&mut self) {
        // Both fail where it has ended.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
