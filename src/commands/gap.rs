//! `caudata gap`: measured data to divergence, named cause, extended model, gain.

use caudata_studies::{diagnosis, session};
use caudata_telemetry::{Failure, Process};
use clap::Subcommand;

use super::{
    gap_apply, gap_check, gap_diagnose, gap_effects, gap_excite, gap_import, gap_policies,
    gap_report, gap_session,
};
use crate::say::WithJson;

#[derive(Debug, Subcommand)]
pub enum GapCommand {
    /// Look at logs before any physics: faults, what they excite, what they cannot tell
    Check(gap_check::CheckArgs),
    /// List the effects that a diagnosis can name, or say what tells some of them apart
    Effects(gap_effects::EffectsArgs),
    /// Turn recordings of other projects into log folders
    Import(gap_import::ImportArgs),
    /// Say where simulation and measurement part, why, and what it is worth to know
    Diagnose(WithJson<diagnosis::Plan>),
    /// Record, diagnose, choose what to record next, until the diagnosis is sure or cannot be: by itself on a
    /// simulated robot, trial by trial on a real one
    Session(WithJson<session::Plan>),
    /// Merge what a diagnosis found into a robot file
    Apply(gap_apply::ApplyArgs),
    /// Show a diagnosis again
    Report(gap_report::ReportArgs),
    /// Write the experiment battery as command files for the robot
    Excite(gap_excite::ExciteArgs),
    /// What an extended model is worth to a policy: trains in it, in the model as given, and in that with
    /// wide randomisation, and runs all on the robot
    Policies(gap_policies::PoliciesArgs),
    /// The pipeline of the paper on logs of a simulated robot: play, low-pass and weaker servos are found and
    /// drawn as the paper draws them, and policies trained without and with them are run on that robot
    Paper(gap_policies::PaperArgs),
}

pub fn run(command: &GapCommand, process: &Process) -> Result<(), Failure> {
    match command {
        GapCommand::Check(args) => gap_check::run(args),
        GapCommand::Effects(args) => gap_effects::run(args),
        GapCommand::Import(args) => gap_import::run(args),
        GapCommand::Diagnose(args) => gap_diagnose::run(args, process),
        GapCommand::Session(args) => gap_session::run(args, process),
        GapCommand::Apply(args) => gap_apply::run(args),
        GapCommand::Report(args) => gap_report::run(args),
        GapCommand::Excite(args) => gap_excite::run(args),
        GapCommand::Policies(args) => gap_policies::run(args, process),
        GapCommand::Paper(args) => gap_policies::paper(args, process),
    }
}
