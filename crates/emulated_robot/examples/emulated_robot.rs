//! An emulated robot on pseudo-terminals without the rest of the command line, for measuring:
//! ROBOT.robot.toml WIRING.toml FOLDER [in-step]. The same as `caudata sim robot --bus pty`.
#![allow(clippy::print_stdout)]

use std::error::Error;
use std::path::Path;
use std::sync::Arc;

use caudata_emulated_robot::{EmulatedRobot, Pace, SUBSTEPS, Terminals, serve};
use caudata_hardware::Wiring;
use caudata_model::RobotModel;
use caudata_sim::{EngineConfig, TerrainConfig};

fn main() -> Result<(), Box<dyn Error>> {
    let args: Vec<String> = std::env::args().collect();
    let [_, robot, wiring, folder, rest @ ..] = args.as_slice() else {
        return Err("usage: emulated_robot ROBOT.robot.toml WIRING.toml FOLDER [in-step]".into());
    };
    let model = Arc::new(RobotModel::load(Path::new(robot))?);
    let wiring = Wiring::read(Path::new(wiring))?;
    let config = EngineConfig {
        substeps: SUBSTEPS,
        ..EngineConfig::default()
    };
    let engine = caudata_sim::build(model, 1, &config, &TerrainConfig::default(), 1, 1)?;
    let mut robot = EmulatedRobot::new(engine, &wiring, 1)?;
    let mut terminals = Terminals::open(Path::new(folder))?;
    let pace = match rest {
        [] => Pace::RealTime,
        _ => Pace::Goals,
    };
    println!("ready");
    let mut event = |on: bool, robot: &EmulatedRobot| {
        println!(
            "torque {on} at {:.2} s, {:?}",
            robot.time_s(),
            robot.travel()
        );
    };
    serve(&mut robot, &mut terminals, pace, &|| false, &mut event)?;
    Ok(())
}
