//! The MuJoCo process: `sim/mujoco/compare.py`, one JSON line in, one out.

use std::io::BufRead;

use caudata_sim::mujoco::Python;
use serde_json::Value;

use super::error::VerifyError;

/// The script travels inside the program.
const SCRIPT: &str = include_str!("../../../../sim/mujoco/compare.py");

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
    python: Python,
    /// Its version.
    pub version: String,
}

impl Mujoco {
    /// Starts the Python that `CAUDATA_MUJOCO_PYTHON` names.
    pub fn start() -> Presence {
        let started = caudata_sim::mujoco::version()
            .and_then(|version| Python::start(SCRIPT).map(|python| Self { python, version }));
        match started {
            Ok(mujoco) => Presence::Here(Box::new(mujoco)),
            Err(why) => Presence::Absent(why),
        }
    }

    /// One request, one answer.
    ///
    /// # Errors
    /// [`VerifyError::Mujoco`] where the process is gone or says no.
    pub fn ask(&mut self, request: &Value) -> Result<Value, VerifyError> {
        let failed = |reason: String| VerifyError::Mujoco(reason);
        self.python.write(format!("{request}\n").as_bytes()).map_err(|e| failed(e.to_string()))?;
        let mut line = String::new();
        self.python.output.read_line(&mut line).map_err(|e| failed(e.to_string()))?;
        let mut answer: Value = serde_json::from_str(&line)
            .map_err(|_| failed(format!("it answered `{}`", line.trim())))?;
        match answer.get_mut("ok") {
            Some(value) => Ok(value.take()),
            None => Err(failed(answer["error"].as_str().unwrap_or("no answer").to_owned())),
        }
    }
}
