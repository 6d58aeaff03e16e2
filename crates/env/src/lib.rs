//! Vectorised environments: the task run on a physics engine, many lanes at a time.
//!
//! [`VecEnv`] takes actions and gives observations and rewards for all lanes; a lane whose episode ends
//! starts the next one in the same step, and its last observation is handed out beside the first of the new
//! episode.
//!
//! Random numbers come from streams keyed by (seed, actor, lane, episode), so that an episode is the same
//! whatever happened in other lanes or episodes, and on any number of threads.
//!
//! *Invariant:* one control step allocates nothing once the buffers have grown to size; no result depends on
//! a clock, a thread count or the order of a hash map.

mod checks;
mod error;
mod lane;
mod measure;
mod observe;
mod output;
mod physics;
mod snapshot;
mod start;
mod steer;
mod vec_env;

pub use error::EnvError;
pub use measure::{Truth, WaterSensor};
pub use output::{EpisodeStats, StepOutput};
pub use start::StartShift;
pub use vec_env::VecEnv;
