//! A Python with MuJoCo in a process beside: pipes in and out.

use std::io::{BufReader, Read, Write};
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};

use crate::SimError;

/// Names the Python that has MuJoCo.
const PYTHON: &str = "CAUDATA_MUJOCO_PYTHON";

/// Longest text that is read from the process, bytes.
const MAX_TEXT: u32 = 1 << 16;

/// A running script; it ends with this value.
pub struct Python {
    child: Child,
    input: Option<ChildStdin>,
    /// Its standard output.
    pub output: BufReader<ChildStdout>,
}

impl Python {
    /// Starts `script` in the Python that `CAUDATA_MUJOCO_PYTHON` names.
    ///
    /// # Errors
    /// Why there is none.
    pub fn start(script: &str) -> Result<Self, String> {
        let python = std::env::var_os(PYTHON).ok_or_else(|| {
            format!("{PYTHON} is not set; it names a Python that has the mujoco package")
        })?;
        let mut child = Command::new(python)
            .args(["-c", script])
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .map_err(|error| format!("{PYTHON}: {error}"))?;
        match (child.stdin.take(), child.stdout.take()) {
            (Some(input), Some(output)) => {
                Ok(Self { child, input: Some(input), output: BufReader::new(output) })
            }
            _ => Err("no pipe to MuJoCo".to_owned()),
        }
    }

    /// Writes to its standard input.
    ///
    /// # Errors
    /// Where it has ended.
    pub fn write(&mut self, bytes: &[u8]) -> std::io::Result<()> {
        let ended = || std::io::Error::other("the process has ended");
        let input = self.input.as_mut().ok_or_else(ended)?;
        input.write_all(bytes)?;
        input.flush()
    }
}

/// MuJoCo's version.
///
/// # Errors
/// Why there is none.
pub fn version() -> Result<String, String> {
    let mut python = Python::start("import mujoco; print(mujoco.__version__)")?;
    let mut found = String::new();
    let read = python.output.read_to_string(&mut found);
    match found.trim() {
        version if read.is_ok() && !version.is_empty() => Ok(version.to_owned()),
        _ => Err(format!("{PYTHON} has no working mujoco package")),
    }
}

impl Drop for Python {
    fn drop(&mut self) {
        drop(self.input.take()); // its loop ends with its input
        let _ = self.child.wait();
    }
}

/// A request that is being written: a letter, then numbers, little-endian.
pub(super) struct Request(Vec<u8>);

impl Request {
    pub fn new(letter: u8) -> Self {
        Self(vec![letter])
    }

    pub fn u32(&mut self, value: usize) {
        self.0.extend((value as u32).to_le_bytes());
    }

    pub fn text(&mut self, text: &str) {
        self.u32(text.len());
        self.bytes(text.as_bytes());
    }

    pub fn bytes(&mut self, bytes: &[u8]) {
        self.0.extend_from_slice(bytes);
    }

    pub fn numbers(&mut self, values: &[f64]) {
        self.0.extend(values.iter().flat_map(|v| v.to_le_bytes()));
    }
}

/// The engine's script, running.
pub(super) struct Process(Python);

impl Process {
    /// Starts it; `opening` says how many lanes there are and what the ground is.
    pub fn start(opening: &Request) -> Result<Self, SimError> {
        const SCRIPT: &str = include_str!("../../mujoco/engine.py");
        let mut python = Python::start(SCRIPT).map_err(SimError::Mujoco)?;
        python.write(&opening.0[1..]).map_err(gone)?;
        Ok(Self(python))
    }

    /// One request, and whether it could be done; [`Self::read_numbers`] then takes what comes back.
    pub fn ask(&mut self, request: &Request) -> Result<(), SimError> {
        self.0.write(&request.0).map_err(gone)?;
        let mut letter = [0];
        self.read(&mut letter)?;
        if letter == *b"K" {
            return Ok(());
        }
        let mut length = [0; 4];
        self.read(&mut length)?;
        let length = u32::from_le_bytes(length).min(MAX_TEXT);
        let mut text = vec![0; length as usize];
        self.read(&mut text)?;
        Err(SimError::Mujoco(String::from_utf8_lossy(&text).into_owned()))
    }

    /// Fills `answer` with what comes next.
    pub fn read_numbers(&mut self, answer: &mut [f64]) -> Result<(), SimError> {
        let mut bytes = [0; 8];
        for value in answer {
            self.read(&mut bytes)?;
            *value = f64::from_le_bytes(bytes);
        }
        Ok(())
    }

    fn read(&mut self, bytes: &mut [u8]) -> Result<(), SimError> {
        self.0.output.read_exact(bytes).map_err(gone)
    }
}

fn gone(error: std::io::Error) -> SimError {
    SimError::Mujoco(format!(
        "its process ended ({error}); {PYTHON} has to name a Python with the mujoco package"
    ))
}
