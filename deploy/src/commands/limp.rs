//! `caudata-robot limp`: lets all servos go, whatever they do, and asks whether they did. What a supervisor
//! calls when the loop is gone.

use std::path::PathBuf;

use caudata_dynamixel::let_go;
use caudata_hardware::Wiring;

use crate::DeployError;
use crate::bus::BusError;
use crate::commands::say::say;
use crate::hardware::{PortOverrides, open_bus_anyway};
use caudata_durable::shipped_flag;

#[derive(Debug, clap::Args)]
pub struct LimpArgs {
    /// Wiring file
    #[arg(
        long,
        value_name = "FILE.wiring.toml",
        default_value = "robots/polymander.wiring.toml",
        value_parser = shipped_flag
    )]
    wiring: PathBuf,
    #[command(flatten)]
    ports: PortOverrides,
    /// Do nothing where another program has the servo port (exit code 73): for supervisors, whose own loop is
    /// gone by then. Without it the servos of a robot that walks are let go too
    #[arg(long)]
    unless_taken: bool,
}

pub fn run(args: &LimpArgs) -> Result<(), DeployError> {
    // Not checked against a robot file: what lets go shall not fail for what it does not need.
    let mut wiring = Wiring::read(&args.wiring)?;
    args.ports.put_into(&mut wiring);
    let (mut bus, alone) = open_bus_anyway(&wiring)?;
    if !alone {
        let address = wiring.bus.port.display().to_string();
        if args.unless_taken {
            return Err(BusError::Taken { address }.into());
        }
        tracing::warn!(
            port = address,
            "another program has the port: it may take the servos' answers"
        );
    }
    let mut ids: Vec<u8> = wiring.joint.values().map(|joint| joint.id).collect();
    ids.sort_unstable();
    let patience = bus.setup_deadline;
    let found = let_go(&mut bus, &ids, patience).map_err(BusError::from)?;
    if !found.is_proved() {
        return Err(BusError::Holds { found }.into());
    }
    say(&format!("the torque is off: {} servos say so", ids.len()));
    Ok(())
}
