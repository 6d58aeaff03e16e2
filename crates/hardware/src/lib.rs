//! The robot's hardware as both ends see it: how it is wired ([`wiring`]), and its IMU ([`imu`]) behind an
//! I²C bus ([`i2c`]), which may be a Linux one, a serial bridge, or emulated registers ([`emulated`]).
//!
//! The robot program drives it; the emulated robot answers with the same register maps, so that one wiring
//! file serves both.
//!
//! *Invariant:* knows neither a simulator nor a control loop; whatever bytes arrive, nothing here panics or
//! waits without end.

pub mod emulated;
pub mod i2c;
pub mod imu;
mod linux_i2c;
pub mod registers;
pub mod wiring;

pub use i2c::{BridgeI2c, I2c};
pub use imu::{ImuChip, ImuSample};
pub use linux_i2c::LinuxI2c;
pub use wiring::{Axis, JointWiring, Wiring, WiringError};
