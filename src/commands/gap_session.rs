//! `caudata gap session`: a diagnosis that asks for its own experiments. The work is in `crates/studies`.

use caudata_runlog::BaseHold;
use caudata_studies::session::{self, Ending, Session};
use caudata_telemetry::{ExitCode, Failure, Process};

use super::gap_diagnose::{self, steps};
use crate::say::{self, WithJson};

pub fn run(args: &WithJson<session::Plan>, process: &Process) -> Result<(), Failure> {
    let WithJson { plan, json } = args;
    let mut steps = steps(*json, process, "the same command goes on from here")?;
    let found = session::session(plan, &mut steps)?;
    drop(steps);
    say::either(*json, &found, |found| {
        say::tables(vec![found.table()]);
        say::line(format!("\n{:?}: {}", found.ending, found.reason));
        if let Some(folder) = &found.diagnosis {
            say::line(format!(
                "report.html, report.json and extended.robot.toml (if there is one) are in {}",
                folder.display()
            ));
        }
    })?;
    outcome(&found)
}

/// 0 where it is sure; else why not.
fn outcome(found: &Session) -> Result<(), Failure> {
    if let Some(next) = &found.next {
        let held = match next.base {
            BaseHold::Fixed => "on a stand",
            BaseHold::Free => "on the ground",
            BaseHold::Water => "in water",
        };
        let (commands, log) = (next.commands.display(), next.log.display());
        let message = format!("record {} {held}: {}", next.trial, next.why);
        let weight = next.payload.as_ref().map_or(String::new(), |weight| {
            format!("hang the weight on, write `{}` into its log.toml, ", session::noted(weight))
        });
        return Err(Failure::outcome(ExitCode::InsufficientData, message).hint(format!(
            "{weight}send the robot {commands}, put the log folder at {log} (or repeats in it), and start the same command again"
        )));
    }
    match (found.ending, found.verdict) {
        (Ending::Sure, _) => Ok(()),
        (_, Some(verdict)) => {
            let code = match gap_diagnose::code(verdict) {
                // what it says is not certain
                ExitCode::Ok => ExitCode::InsufficientData,
                code => code,
            };
            Err(Failure::outcome(code, &found.reason))
        }
        (_, None) => Err(Failure::outcome(ExitCode::InsufficientData, &found.reason)),
    }
}
