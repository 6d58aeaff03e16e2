//! The training run: set up, the loop over iterations, and the end.

mod collect;
mod fleet;
mod metrics;
mod report;
mod resume;
mod run;
mod seen;
mod setup;
mod traces;
mod versions;

pub use resume::Resume;
pub use setup::{TrainSettings, train, train_as_rank};
