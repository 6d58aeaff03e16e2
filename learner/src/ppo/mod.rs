//! Proximal policy optimisation: from a [`Batch`](crate::batch::Batch) to changed weights.

mod gradient;
mod host;
mod loss;
mod minibatch;
mod networks;
mod pool;
mod targets;
mod torch;
mod update;

pub use update::{Ppo, PpoSettings, UpdateStats};
