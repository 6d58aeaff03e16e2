//! Where the robot is told to go: one command for the whole run, or a table of them over time.

use std::path::Path;
use std::str::FromStr;

use caudata_task::COMMAND_DIM;

use crate::DeployError;

/// Most rows of a command file.
pub const TABLE_ROWS_MAX: usize = 100_000;
/// Largest command file that is read.
const FILE_BYTES_MAX: u64 = 16 << 20;
/// Header of a command file.
pub const HEADER: &str = "t,vx,vy,yaw_rate";
/// Largest command in either direction, m/s and rad/s.
const COMMAND_MAX: f32 = 20.0;

/// Forward and sideways velocity (m/s) and yaw rate (rad/s).
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct WalkCommand(pub [f32; COMMAND_DIM]);

impl FromStr for WalkCommand {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let numbers: Result<Vec<f32>, _> = text.split(',').map(|p| p.trim().parse()).collect();
        let numbers = numbers.map_err(|_| format!("`{text}` is not vx,vy,yaw_rate"))?;
        let values: [f32; COMMAND_DIM] = numbers
            .try_into()
            .map_err(|_| format!("`{text}` must be three numbers: vx,vy,yaw_rate"))?;
        if values.iter().all(|v| v.abs() <= COMMAND_MAX) {
            return Ok(Self(values));
        }
        Err(format!("`{text}` must be within ±{COMMAND_MAX} m/s and rad/s"))
    }
}

/// Commands over time: each holds until the next one.
#[derive(Clone, Debug, PartialEq)]
pub struct CommandTable {
    /// Start (s since walking began) and command, in order; never empty.
    rows: Vec<(f64, WalkCommand)>,
}

impl CommandTable {
    /// One command for good.
    pub fn constant(command: WalkCommand) -> Self {
        Self { rows: vec![(0.0, command)] }
    }

    /// Reads a CSV file with the header `t,vx,vy,yaw_rate` (s, m/s, m/s, rad/s), `t` increasing.
    ///
    /// # Errors
    /// [`DeployError::Commands`] with the line, [`DeployError::Folder`] where it cannot be read.
    pub fn read(path: &Path) -> Result<Self, DeployError> {
        let text = caudata_durable::read_text_at_most(path, FILE_BYTES_MAX)
            .map_err(|e| DeployError::Commands { path: path.to_owned(), reason: e.to_string() })?;
        Self::parse(&text).map_err(|reason| DeployError::Commands { path: path.to_owned(), reason })
    }

    fn parse(text: &str) -> Result<Self, String> {
        let mut lines = text.lines();
        if lines.next().map(str::trim) != Some(HEADER) {
            return Err(format!("the first line must be `{HEADER}`"));
        }
        let mut rows: Vec<(f64, WalkCommand)> = Vec::new();
        for (index, line) in lines.enumerate() {
            let at = |problem: String| format!("line {}: {problem}", index + 2);
            let (time, command) =
                line.split_once(',').ok_or_else(|| at("four numbers are due".to_owned()))?;
            let time: f64 =
                time.trim().parse().map_err(|_| at(format!("`{time}` is not a time")))?;
            let after_last = rows.last().is_none_or(|(last, _)| time > *last);
            if !(time.is_finite() && time >= 0.0 && after_last) {
                return Err(at("t must be at least 0 and increase".to_owned()));
            }
            if rows.len() == TABLE_ROWS_MAX {
                return Err(at(format!("more than {TABLE_ROWS_MAX} rows")));
            }
            rows.push((time, command.parse().map_err(at)?));
        }
        if rows.is_empty() {
            return Err("there are no rows".to_owned());
        }
        Ok(Self { rows })
    }

    /// The command `time_s` after walking began; zero before the first row.
    pub fn at(&self, time_s: f64) -> [f32; COMMAND_DIM] {
        let later = self.rows.partition_point(|(start, _)| *start <= time_s);
        later.checked_sub(1).map_or([0.0; COMMAND_DIM], |i| self.rows[i].1.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_row_holds_until_the_next() {
        let table =
            CommandTable::parse("t,vx,vy,yaw_rate\n1,0.2,0,0\n2.5, 0.1, -0.05, 0.4\n").unwrap();
        assert_eq!(table.at(0.99), [0.0; 3]);
        assert_eq!(table.at(1.0), [0.2, 0.0, 0.0]);
        assert_eq!(table.at(2.49), [0.2, 0.0, 0.0]);
        assert_eq!(table.at(1e6), [0.1, -0.05, 0.4]);
        let constant = CommandTable::constant("0.3,0,-0.1".parse().unwrap());
        assert_eq!(constant.at(0.0), [0.3, 0.0, -0.1]);
    }

    #[test]
    fn wrong_files_say_the_line() {
        for (text, expected) in [
            ("", "first line"),
            ("t,vx\n", "first line"),
            ("t,vx,vy,yaw_rate\n", "no rows"),
            ("t,vx,vy,yaw_rate\n0,0.1,0,0\n0,0.1,0,0\n", "line 3: t must"),
            ("t,vx,vy,yaw_rate\n0,0.1,0\n", "line 2: `0.1,0` must be three"),
            ("t,vx,vy,yaw_rate\n0,nan,0,0\n", "line 2: `nan,0,0` must be within"),
            ("t,vx,vy,yaw_rate\nx,0,0,0\n", "line 2: `x` is not a time"),
        ] {
            let error = CommandTable::parse(text).unwrap_err();
            assert!(error.contains(expected), "{error}");
        }
    }
}
