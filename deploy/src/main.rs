//! `caudata-robot`: pulls, verifies and runs the policy at 50 Hz.

use std::process::ExitCode;

use caudata_deploy::commands::{Args, dispatch};
use caudata_telemetry::{Process, parse_args};

fn main() -> ExitCode {
    let args: Args = parse_args();
    // Neither loop nor supervisor stands still because a terminal does.
    Process::run_as("caudata-robot", &args.log, true, |process| dispatch(&args, process))
}
