//! The MuJoCo process: `sim/mujoco/compare.py`, one JSON line in, one out.

use std::io::{BufRead, BufReader, Write};
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};

use serde_json::Value;

use super::error::VerifyError;

/// The script travels inside the program.
const SCRIPT: &str = include_str!("../../../../sim/mujoco/compare.py");

/// Names the Python that has MuJoCo.
const PYTHON: &str = "CAUDATA_MUJOCO_PYTHON";

/// Whether there is a MuJoCo to compare with.
pub enum Presence {
    /// Running.
    Here(Box<Mujoco>),
    /// Why not.
    Absent(String),
}

impl Presence {
    /// The process, or why there is none.
    ///
    /// # Errors
    /// The reason, for a row that is skipped.
    pub fn get(&mut self) -> Result<&mut Mujoco, &str> {
        match self {
            Self::Here(mujoco) => Ok(mujoco),
            Self::Absent(why) => Err(why),
        }
    }
}

/// A running MuJoCo process; it ends with this value.
pub struct Mujoco {
    child: Child,
    input: Option<ChildStdin>,
    output: BufReader<ChildStdout>,
    /// Its version.
    pub version: String,
}

impl Mujoco {
    /// Starts the Python that `CAUDATA_MUJOCO_PYTHON` names.
    #[must_use]
    pub fn start() -> Presence {
        let Some(python) = std::env::var_os(PYTHON) else {
            return Presence::Absent(format!("{PYTHON} is not set"));
        };
        let started = Command::new(python)
            .args(["-c", SCRIPT])
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn();
        let mut child = match started {
            Ok(child) => child,
            Err(error) => return Presence::Absent(format!("{PYTHON}: {error}")),
        };
        let (Some(input), Some(output)) = (child.stdin.take(), child.stdout.take()) else {
            return Presence::Absent("no pipe to MuJoCo".to_owned());
        };
        let mut mujoco = Self {
            child,
            input: Some(input),
            output: BufReader::new(output),
            version: String::new(),
        };
        match mujoco.ask(&serde_json::json!({ "task": "version" })) {
            Ok(Value::String(version)) => {
                mujoco.version = version;
                Presence::Here(Box::new(mujoco))
            }
            Ok(_) => Presence::Absent("it did not give its version".to_owned()),
            Err(_) => Presence::Absent(format!("{PYTHON} has no working mujoco package")),
        }
    }

    /// One request, one answer.
    ///
    /// # Errors
    /// [`VerifyError::Mujoco`] where the process is gone or says no.
    pub fn ask(&mut self, request: &Value) -> Result<Value, VerifyError> {
        let failed = |reason: String| VerifyError::Mujoco(reason);
        let input = self
            .input
            .as_mut()
            .ok_or_else(|| failed("the process has ended".to_owned()))?;
        writeln!(input, "{request}")
            .and_then(|()| input.flush())
            .map_err(|e| failed(e.to_string()))?;
        let mut line = String::new();
        self.output
            .read_line(&mut line)
            .map_err(|e| failed(e.to_string()))?;
        let mut answer: Value = serde_json::from_str(&line)
            .map_err(|_| failed(format!("it answered `{}`", line.trim())))?;
        match answer.get_mut("ok") {
            Some(value) => Ok(value.take()),
            None => Err(failed(
                answer["error"].as_str().unwrap_or("no answer").to_owned(),
            )),
        }
    }
}

impl Drop for Mujoco {
    fn drop(&mut self) {
        drop(self.input.take()); // its loop ends with its input
        let _ = self.child.wait();
    }
}
