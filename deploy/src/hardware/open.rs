//! Opening what a wiring file names: the servo bus and the IMU.

use std::path::{Path, PathBuf};
use std::time::Duration;

use caudata_dynamixel::setup::TRIES;
use caudata_dynamixel::{Bus, SerialPort};
use caudata_hardware::i2c::BRIDGE_BAUD;
use caudata_hardware::{BridgeI2c, I2c, ImuChip, JointWiring, LinuxI2c, Wiring};
use caudata_model::RobotModel;

use crate::DeployError;
use crate::bus::BusError;

/// Ports instead of those of the wiring file, as on an emulated robot.
#[derive(Clone, Debug, Default, clap::Args)]
pub struct PortOverrides {
    /// Serial port of the servos instead of the wiring file's
    #[arg(long, value_name = "PATH")]
    pub servo_port: Option<PathBuf>,
    /// IMU bus instead of the wiring file's: a Linux I²C bus, or `bridge:` and the serial port of a bridge
    #[arg(long, value_name = "BUS")]
    pub imu_bus: Option<String>,
    /// The emulated robot runs in step with the goals (`caudata sim robot --bus pty --in-step`): time is
    /// counted in goals too, so that a busy computer makes the robot slow, not wrong. Never with a real robot
    #[arg(long)]
    pub in_step: bool,
}

impl PortOverrides {
    /// Takes the place of `wiring`'s ports.
    pub fn put_into(&self, wiring: &mut Wiring) {
        if let Some(port) = &self.servo_port {
            wiring.bus.port.clone_from(port);
        }
        if let Some(bus) = &self.imu_bus {
            wiring.imu.bus.clone_from(bus);
        }
    }
}

/// Reads a wiring file and puts `overrides` in.
///
/// # Errors
/// [`DeployError::Wiring`], also where its joints are not the model's.
pub fn read_wiring(
    path: &Path,
    model: &RobotModel,
    overrides: &PortOverrides,
) -> Result<(Wiring, Vec<JointWiring>), DeployError> {
    let mut wiring = Wiring::read(path)?;
    let wrong =
        |reason: String| caudata_hardware::WiringError::Wrong { path: path.to_owned(), reason };
    if wiring.robot != model.name() {
        let reason = format!("it is for robot `{}`, this is `{}`", wiring.robot, model.name());
        return Err(wrong(reason).into());
    }
    let names = model.actuated_names();
    if let Some(wheel) = (0..names.len()).find(|&a| model.rolls(a)) {
        let name = names[wheel];
        let reason =
            format!("joint.{name}: it is a wheel, and servos on this bus turn once at most");
        return Err(wrong(reason).into());
    }
    let joints = wiring.joints(&names).map_err(wrong)?;
    overrides.put_into(&mut wiring);
    Ok((wiring, joints))
}

/// Opens the serial port of the servos for this program alone.
///
/// # Errors
/// [`BusError::Connect`], [`BusError::Taken`].
pub fn open_bus(wiring: &Wiring) -> Result<Bus<SerialPort>, BusError> {
    let (path, baud) = (&wiring.bus.port, wiring.bus.baud);
    let port = SerialPort::open(path, baud).map_err(|e| refused(&path.display(), &e))?;
    Ok(patient(wiring, port))
}

/// Opens it also where another program has it, for whoever must be obeyed; with `true` where this one has it
/// alone.
///
/// # Errors
/// [`BusError::Connect`].
pub fn open_bus_anyway(wiring: &Wiring) -> Result<(Bus<SerialPort>, bool), BusError> {
    let (path, baud) = (&wiring.bus.port, wiring.bus.baud);
    let opened = SerialPort::open_anyway(path, baud);
    let (port, alone) = opened.map_err(|e| refused(&path.display(), &e))?;
    Ok((patient(wiring, port), alone))
}

fn patient(wiring: &Wiring, port: SerialPort) -> Bus<SerialPort> {
    let mut bus = Bus::new(port, wiring.bus.baud);
    bus.be_patient(Duration::from_millis(wiring.bus.read_deadline_ms));
    bus
}

fn refused(address: &dyn std::fmt::Display, error: &std::io::Error) -> BusError {
    let address = address.to_string();
    match error.kind() {
        std::io::ErrorKind::ResourceBusy => BusError::Taken { address },
        _ => BusError::Connect { address, reason: error.to_string() },
    }
}

/// Finds and sets up the IMU.
///
/// # Errors
/// [`BusError::Connect`], [`BusError::Taken`].
pub fn open_imu(wiring: &Wiring) -> Result<ImuChip<Box<dyn I2c + Send>>, BusError> {
    let mut tries = 1;
    loop {
        match open_imu_once(wiring) {
            Err(error) if tries < TRIES && !matches!(error, BusError::Taken { .. }) => tries += 1,
            other => return other,
        }
    }
}

fn open_imu_once(wiring: &Wiring) -> Result<ImuChip<Box<dyn I2c + Send>>, BusError> {
    let address = &wiring.imu.bus;
    let connect = |e: std::io::Error| refused(address, &e);
    let bus: Box<dyn I2c + Send> = match address.strip_prefix("bridge:") {
        Some(port) => {
            let port = SerialPort::open(Path::new(port), BRIDGE_BAUD).map_err(connect)?;
            let deadline = Duration::from_millis(wiring.bus.read_deadline_ms);
            Box::new(BridgeI2c::new(port, deadline))
        }
        None => Box::new(LinuxI2c::open(Path::new(address)).map_err(connect)?),
    };
    ImuChip::start(bus, &wiring.imu).map_err(connect)
}
