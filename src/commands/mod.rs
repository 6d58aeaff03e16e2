//! One module per command.

pub mod bench;
pub mod config;
pub mod eval;
pub mod policy;
pub mod robot_model;
pub mod sim;
pub mod sim_robot;
pub mod sim_rollout;
pub mod train;
