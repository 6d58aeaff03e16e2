//! What takes hours and is made of steps: a diagnosis into a folder, a policy adapted to a robot, ways to
//! train compared.
//!
//! A study leaves everything in its output folder and goes on there when it was stopped. Diagnosis and
//! evaluation are called; a training is a child process, `caudata train`, since learner and actors are
//! programs of their own. Plans are flags of the command line, results are what `--json` prints. Errors are
//! [`Failure`](caudata_telemetry::Failure)s: a study is what a command does, exit code included.

pub mod adapt;
pub mod diagnosis;
pub mod failures;
pub mod files;
pub mod flags;
mod out_folder;
pub mod paper;
pub mod policies;
pub mod session;
pub mod steps;
mod table;
pub mod training;

pub use out_folder::{Asked, differences};
pub use steps::{News, Steps};
pub use table::Table;
