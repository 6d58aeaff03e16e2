//! A side door to ROS 2: a robot's joint states, IMU and diagnostics for ROS tools, and velocity commands
//! from them, without a ROS install on the robot. It speaks to ROS nodes that run on `rmw_zenoh_cpp`.
//!
//! [`wire`] is what `rmw_zenoh_cpp` puts on zenoh; the messages are those of `caudata_runlog::ros`; [`door`]
//! connects both with the tap of a running robot and with its command link.
//!
//! *Invariant:* it never opens the bus, and its commands count no more than those of `caudata-robot drive`:
//! with the link's key only.

pub mod door;
pub mod wire;
