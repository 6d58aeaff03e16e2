//! The on-robot client: pulls, verifies and runs the policy at 50 Hz.
//!
//! A policy comes from the policy server ([`keeper`]), passes every check ([`verify`]), is stored ([`store`], [`state`]) and
//! then drives the robot ([`control`]) through [`bus`] traits, which the robot's own servos and IMU ([`hardware`]) and a simulated
//! robot in another process ([`sim_link`]) implement. `docs/robot-client.md` describes the whole from outside.
//!
//! *Invariant:* nothing that was not verified here runs here, and neither libtorch nor a simulator is linked.
#![cfg_attr(test, allow(clippy::unwrap_used, clippy::expect_used, clippy::panic))]

pub mod bus;
pub mod command_link;
pub mod commands;
pub mod control;
mod error;
pub mod flight_log;
pub mod follower;
pub mod gate;
pub mod guard;
pub mod hardware;
pub mod keeper;
pub mod metrics;
pub mod motion;
pub mod orientation;
pub mod pacing;
pub mod probe;
pub mod recorder;
pub mod report;
pub mod reporter;
pub mod runner;
pub mod sim_link;
pub mod state;
pub mod store;
#[cfg(test)]
mod testing;
pub mod updates;
pub mod verify;
pub mod walk_command;

pub use error::{DeployError, failure};
