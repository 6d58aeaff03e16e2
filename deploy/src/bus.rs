//! What the control loop needs of a robot: a servo bus and an IMU. The simulated robot is one implementation;
//! hardware is another.

use std::time::Duration;

use caudata_dynamixel::{BusFault, LetGo};
use caudata_task::{PerFoot, PerJoint};

/// What the servos report, policy order.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ServoReadings {
    /// When they were read, s since the robot's start; never goes back.
    pub time_s: f64,
    /// Joint positions, rad.
    pub pos_rad: PerJoint,
    /// Joint velocities, rad/s.
    pub vel_radps: PerJoint,
    /// Currents, A.
    pub current_a: PerJoint,
    /// Supply voltage, V.
    pub supply_v: f32,
}

/// What the IMU reports, in its own frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ImuReading {
    /// Angular velocity, rad/s.
    pub gyro_radps: [f32; 3],
    /// Specific force, m/s².
    pub acc_mps2: [f32; 3],
    /// Direction of gravity, unit vector, where the IMU works it out itself.
    pub gravity: Option<[f32; 3]>,
}

/// What only a simulated robot (or motion capture) knows; for logs, never for control.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct GroundTruth {
    /// Position of the base, world, m.
    pub base_pos_m: Option<[f32; 3]>,
    /// Orientation of the base w, x, y, z, world from body.
    pub base_quat_wxyz: Option<[f32; 4]>,
    /// Which feet touch the ground.
    pub foot_contacts: Option<PerFoot<bool>>,
}

/// What the hardware says about itself, beyond its readings. A robot without such reports is in good health.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Health {
    /// Ticks in a row that the worst servo has been silent; its last readings stand in for it.
    pub silent_ticks: u32,
    /// A servo (joint number) and its latched hardware errors (register 70).
    pub alert: Option<(usize, u8)>,
    /// A servo (joint number) whose torque or settings are gone.
    pub restarted: Option<usize>,
    /// A servo (joint number) that stopped because it heard nothing.
    pub watchdog_fired: Option<usize>,
    /// Hottest servo, °C.
    pub hottest_c: u8,
    /// Ticks in a row without a new IMU sample.
    pub imu_stale_ticks: u32,
    /// IMU samples in a row that were the same to the last digit.
    pub imu_same_ticks: u32,
}

/// Why a bus did not do what was asked.
#[derive(Debug, thiserror::Error)]
#[expect(missing_docs, reason = "a message says what its fields are")]
pub enum BusError {
    /// Nothing came within the deadline; the next try may go well.
    #[error("the robot did not answer within {} ms", deadline.as_millis())]
    Timeout { deadline: Duration },
    /// There is no robot at this address.
    #[error("no robot at {address}: {reason}")]
    Connect { address: String, reason: String },
    /// Another program has the port: two that speak on one bus take each other's answers, and one may let go
    /// of what the other moves.
    #[error("another program has {address}: is a `run` or `doctor` on it?")]
    Taken { address: String },
    /// Servos were told to let go, and do not say that they did.
    #[error("{found}: cut the supply, or hold the robot")]
    Holds { found: LetGo },
    /// It is another robot, or speaks otherwise.
    #[error("the robot at {address} is not the one expected: {reason}")]
    Protocol { address: String, reason: String },
    /// The connection broke, or too many answers in a row were missing.
    #[error("lost the robot: {reason}")]
    Lost { reason: String },
}

impl From<BusFault> for BusError {
    fn from(fault: BusFault) -> Self {
        Self::Lost { reason: fault.to_string() }
    }
}

/// Sixteen position servos.
pub trait ServoBus {
    /// Reads all servos, waiting at most `deadline`.
    ///
    /// # Errors
    /// [`BusError::Timeout`] where the next call may go well, else the bus is gone.
    fn read(&mut self, deadline: Duration) -> Result<ServoReadings, BusError>;

    /// Sends position targets, rad, policy order, with the torque on.
    ///
    /// # Errors
    /// [`BusError::Lost`].
    fn write(&mut self, targets_rad: &PerJoint) -> Result<(), BusError>;

    /// Lets all servos go limp, and asks whether they did.
    ///
    /// # Errors
    /// [`BusError::Lost`]; [`BusError::Holds`] where the torque of one is still on.
    fn torque_off(&mut self) -> Result<(), BusError>;
}

/// An inertial measurement unit.
pub trait Imu {
    /// The newest reading.
    ///
    /// # Errors
    /// [`BusError`] where there is none.
    fn reading(&mut self) -> Result<ImuReading, BusError>;
}

/// A whole robot.
pub trait Robot: ServoBus + Imu {
    /// What is known beyond the robot's own sensors.
    fn ground_truth(&self) -> GroundTruth {
        GroundTruth::default()
    }

    /// What the hardware says about itself.
    fn health(&self) -> Health {
        Health::default()
    }

    /// Whether it is in water, for policies that know the difference; `None` where nothing tells.
    fn in_water(&mut self) -> Option<bool> {
        None
    }
}
