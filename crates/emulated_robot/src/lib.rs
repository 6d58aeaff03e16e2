//! A simulated robot behind emulated servos and an emulated IMU, on pseudo-terminals: the robot program
//! drives it through the real wire protocol, byte for byte, and cannot tell it from a robot but by its speed.
//!
//! [`robot`] couples the physics with the control tables and the IMU's registers, [`serve`] puts both on
//! pseudo-terminals.
//!
//! *Invariant:* the far end learns nothing that a real servo or IMU would not say.

pub mod robot;
pub mod serve;

pub use robot::{EmulatedRobot, Travel};
pub use serve::{Pace, Terminals, serve};

/// Physics steps per step of the emulated robot: 4 ms at the usual step of 2 ms, so that servos get goals and
/// sensors change in between control ticks.
pub const SUBSTEPS: u32 = 2;

/// Why an emulated robot does not work.
#[derive(Debug, thiserror::Error)]
pub enum EmulationError {
    /// The physics.
    #[error(transparent)]
    Sim(#[from] caudata_sim::SimError),
    /// Pseudo-terminals.
    #[error("pseudo-terminal: {0}")]
    Terminal(#[from] std::io::Error),
    /// The wiring does not fit the robot.
    #[error("wiring: {0}")]
    Wiring(String),
    /// The physics broke down.
    #[error("the simulation diverged")]
    Diverged,
}
