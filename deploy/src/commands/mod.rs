//! The commands of `caudata-robot`.

mod agent;
mod control_loop;
mod doctor;
mod drive;
mod limp;
mod probe;
mod pull;
mod run;
mod say;
mod source;
mod status;

use caudata_telemetry::{Failure, LogArgs, Process};
use clap::{Parser, Subcommand};

use crate::failure;

pub use run::{BusAddress, RunArgs};

/// Pulls, verifies and runs a policy on the robot.
#[derive(Debug, Parser)]
#[command(name = "caudata-robot", version, max_term_width = 100, after_help = EXIT_CODES)]
pub struct Args {
    #[command(subcommand)]
    command: Command,
    /// Logging.
    #[command(flatten)]
    pub log: LogArgs,
}

const EXIT_CODES: &str = "\
Exit codes: 0 done · 64 flag · 65 bad input file or state · 66 input missing · 69 server or robot gone, nothing to run
  70 internal · 71 system resource · 73 output cannot be made · 74 disk full or I/O · 76 another protocol or robot
  77 policy refused, nothing else to run · 79 the robot is not fit for torque · 130 interrupted twice";

#[derive(Debug, Subcommand)]
enum Command {
    /// Pull the newest policy and run it at 50 Hz: starts `agent` and `rt`, watches both, and lets the robot
    /// go where one hangs
    Run(Box<RunArgs>),
    /// One half of `run`: fetch, verify, try and stage policies, take commands; never opens the bus. Flags as
    /// of `run`
    Agent(Box<RunArgs>),
    /// The other half: the control loop on what is staged; no network. Flags as of `run`
    Rt(Box<RunArgs>),
    /// Let all servos go limp, whatever they do
    Limp(limp::LimpArgs),
    /// Pull, verify and store the newest policy; run nothing
    Pull(pull::PullArgs),
    #[command(hide = true)]
    Probe(probe::ProbeArgs),
    /// Check servos, supply, pose and IMU before any torque
    Doctor(doctor::DoctorArgs),
    /// Send velocity commands to a robot that runs with --link-addr: w s a d q e, space stops, k kills
    Drive(drive::DriveArgs),
    /// Show which policies this robot holds and trusts
    Status(status::StatusArgs),
}

/// Runs the command.
///
/// # Errors
/// The failure that ends the process.
pub fn dispatch(args: &Args, process: &Process) -> Result<(), Failure> {
    match &args.command {
        Command::Run(args) => return run::run(args, process),
        Command::Agent(args) => agent::run(args, process),
        Command::Rt(args) => control_loop::run(args, process),
        Command::Limp(args) => limp::run(args),
        Command::Pull(args) => pull::run(args),
        Command::Status(args) => status::run(args),
        Command::Probe(args) => probe::run(args),
        Command::Drive(args) => drive::run(args, process),
        Command::Doctor(args) => doctor::run(args),
    }
    .map_err(failure)
}
