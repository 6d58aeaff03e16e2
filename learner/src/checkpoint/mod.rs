//! Checkpoints: everything that a run needs to go on as if it had not stopped.

mod state;
mod store;

pub use state::{CheckpointState, EpisodeWindow, Saved};
pub use store::{CheckpointStore, FORMAT};
