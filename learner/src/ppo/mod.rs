//! Proximal policy optimisation: from a [`Batch`](crate::batch::Batch) to changed weights.

mod loss;
mod pool;
mod shards;
mod targets;
mod update;

pub use loss::{
    LossSettings, OutputGradient, Outputs, Samples, entropy, log_prob, loss_and_gradient, sums,
};
pub use pool::{Pool, SHARD_ROWS, Worker};
pub use update::{Ppo, PpoSettings, UpdateStats};
