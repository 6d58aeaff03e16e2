//! `caudata-robot limp`: lets all servos go, whatever they do. What a supervisor calls when the loop is gone.

use std::path::PathBuf;

use caudata_dynamixel::xm430;
use caudata_hardware::Wiring;

use crate::DeployError;
use crate::bus::BusError;
use crate::commands::{PortArgs, say};
use crate::hardware::{TORQUE_OFF_TIMES, open_bus};

#[derive(Debug, clap::Args)]
pub struct LimpArgs {
    /// Wiring file
    #[arg(
        long,
        value_name = "FILE.wiring.toml",
        default_value = "robots/polymander.wiring.toml"
    )]
    wiring: PathBuf,
    #[command(flatten)]
    ports: PortArgs,
}

pub fn run(args: &LimpArgs) -> Result<(), DeployError> {
    let mut wiring = Wiring::read(&args.wiring)?;
    if let Some(port) = args.ports.overrides().servo_port {
        wiring.bus.port = port;
    }
    let mut bus = open_bus(&wiring)?;
    // Nobody answers an order to all: it is repeated.
    for _ in 0..TORQUE_OFF_TIMES {
        bus.broadcast(&xm430::TORQUE_ENABLE, 0)
            .map_err(|fault| BusError::Lost {
                reason: fault.to_string(),
            })?;
    }
    say("the torque is off");
    Ok(())
}
