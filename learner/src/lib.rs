//! PPO on libtorch: batches, update, checkpoints, ONNX export.

pub mod adam;
pub mod batch;
pub mod checkpoint;
mod error;
pub mod export;
pub mod network;
pub mod normaliser;
pub mod ppo;
pub mod publish;
pub mod report;
pub mod returns;
mod task;
pub mod teacher;
pub mod train;
pub mod warm_start;

pub use error::LearnerError;
