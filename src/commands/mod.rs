//! One module per command.

pub mod bench;
mod bench_learner;
mod bench_sim;
mod bench_skill;
pub mod config;
pub mod eval;
pub mod gap;
mod gap_check;
mod gap_excite;
mod gap_import;
pub mod ground;
pub mod lane_params;
pub mod policy;
pub mod policy_sign;
pub mod robot_model;
pub mod sim;
pub mod sim_robot;
pub mod sim_robot_pty;
pub mod sim_rollout;
pub mod sim_show;
pub mod sim_verify;
pub mod train;
