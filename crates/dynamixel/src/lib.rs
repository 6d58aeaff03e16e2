//! Dynamixel protocol 2.0 for the robot's servos: packets, the XM430 control table, a bus with a deadline per
//! transaction, and an emulated bus that answers byte for byte as servos do.
//!
//! Facts (packet layout, CRC, byte stuffing, register addresses, units) are those of the ROBOTIS e-manual,
//! "DYNAMIXEL Protocol 2.0" and "XM430-W210 / XM430-W350"; the packets of its examples are the golden tests.
//!
//! *Invariant:* whatever bytes arrive, nothing here panics, allocates without bound or waits beyond its
//! deadline, and the error byte of a status packet reaches the caller.

pub mod bus;
pub mod crc;
pub mod emulator;
pub mod frame;
pub mod group;
pub mod let_go;
pub mod port;
pub mod setup;
pub mod status;
pub mod units;
pub mod xm430;

pub use bus::{Bus, BusCounts, BusFault};
pub use group::{Answer, GroupRead, GroupWrite};
pub use let_go::{LetGo, let_go};
pub use port::{Port, SerialPort};
pub use status::{ErrorNumber, HardwareError, StatusError};
