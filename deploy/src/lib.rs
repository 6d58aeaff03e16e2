//! The on-robot client: pulls, verifies and runs the policy at 50 Hz.
//!
//! Two processes and one that watches them ([`supervisor`]). The agent gets policies from the policy server
//! ([`keeper`]), checks them ([`verify`]), stores them ([`store`], [`state`]) and stages them ([`stage`]); it
//! never opens the bus. The loop loads what is staged ([`courier`]) and drives the robot ([`control`])
//! through [`bus`] traits, which the robot's own servos and IMU ([`hardware`]) and a simulated robot in
//! another process ([`sim_link`]) implement; it knows no network. [`boundary`] is all that passes between the
//! two. `docs/reference/robot-client.md` describes the whole from outside.
//!
//! *Invariant:* nothing that was not verified here runs here, and neither libtorch nor a simulator is linked.

pub mod boundary;
pub mod bus;
pub mod command_link;
pub mod commands;
pub mod control;
pub mod courier;
mod error;
pub mod flight_log;
pub mod follower;
pub mod gamepad;
pub mod gate;
pub mod guard;
pub mod hardware;
pub mod keeper;
pub mod last_moments;
pub mod metrics;
pub mod motion;
pub mod notify;
pub mod odometry;
pub mod orientation;
pub mod pacing;
pub mod probe;
pub mod reporter;
pub mod runner;
mod server;
pub mod sim_link;
pub mod stage;
pub mod state;
pub mod store;
pub mod summary;
pub mod supervisor;
pub mod tap;
#[cfg(test)]
mod testing;
pub mod updates;
pub mod verify;
pub mod walk_command;

pub use error::{DeployError, failure};
