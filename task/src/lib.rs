//! The task as a Markov decision process: what the policy sees, what its actions mean, what is rewarded,
//! how episodes start, are disturbed and end.
//!
//! Everything is a pure function of values (random draws come from a [`caudata_random::Stream`] handed in),
//! for one environment at a time; `caudata-env` runs many of them on a physics engine, and the robot's
//! runtime uses the same observation, phase clock and action filter.
//!
//! Frames: *body* is the IMU's frame on the base link (x forward, y left, z up); *heading* is the world frame
//! turned about z into the line from the hind to the front girdle. SI units and radians. Joint arrays are in
//! policy order, feet in the order of the robot file, from front to hind and left before right. Nothing here
//! knows how many there are.
//!
//! *Invariant:* nothing here knows an engine, a network, a clock or a file.

pub mod action;
pub mod command;
mod config;
pub mod contract;
pub mod critic;
mod error;
pub mod expression;
mod joints;
pub mod layout;
pub mod mirror;
pub mod noise;
pub mod observation;
pub mod past;
pub mod phase;
pub mod push;
pub mod randomise;
pub mod reset;
pub mod reward;
pub mod row;
pub mod termination;

pub use config::TaskConfig;
pub use contract::{CommandContract, ContractDifference, PolicyContract, check_joint_names};
pub use critic::Critic;
pub use error::TaskError;
pub use joints::{BodyPlan, JointTable};
pub use layout::ObservationLayout;
pub use mirror::Mirror;
pub use row::{PerFoot, PerJoint};

/// How many past actions the policy sees.
pub const ACTION_HISTORY: usize = 3;
/// Command: forward and sideways velocity (m/s), yaw rate (rad/s).
pub const COMMAND_DIM: usize = 3;
