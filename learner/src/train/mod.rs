//! The training run: set up, the loop over iterations, and the end.

mod collect;
mod ending;
mod fleet;
mod metrics;
mod report;
mod resume;
mod retune;
mod run;
mod seen;
mod settings;
mod setup;
mod traces;
mod tuning;
mod versions;

pub use settings::{Resume, TrainSettings};
pub use setup::train;
