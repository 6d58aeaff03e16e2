//! `caudata sim`: simulate without training.

use caudata_telemetry::{Failure, Process};
use clap::Subcommand;

use super::{sim_robot, sim_rollout, sim_show, sim_verify};

#[derive(Debug, Subcommand)]
pub enum SimCommand {
    /// Open loop: joint commands in, simulated signals out
    Rollout(sim_rollout::RolloutArgs),
    /// A picture or a short animation of a model, a scene or a log
    Show(sim_show::ShowArgs),
    /// The engines against MuJoCo, closed forms, conservation laws and each other, as one table
    Verify(sim_verify::VerifyArgs),
    /// A simulated robot as a process of its own, for caudata-robot
    Robot(sim_robot::SimRobotArgs),
}

pub fn run(command: &SimCommand, process: &Process) -> Result<(), Failure> {
    match command {
        SimCommand::Rollout(args) => sim_rollout::run(args, &process.stop),
        SimCommand::Show(args) => sim_show::run(args, &process.stop),
        SimCommand::Verify(args) => sim_verify::run(args),
        SimCommand::Robot(args) => sim_robot::run(args, &process.stop),
    }
}
