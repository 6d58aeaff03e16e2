//! How well a policy walks.
//!
//! A [`Suite`] is a list of [`Scenario`]s (ground, command, disturbances). [`Evaluation`] runs the mean of a
//! policy in each; [`gait`] measures every episode; [`gates`] says whether that is walking at all, since the
//! rewards of walking can also be had by vibrating; [`report`] makes a page of it that people look at.
//!
//! Invariant: the same policy, configuration and seed give the same figures, on any number of threads;
//! nothing here looks at a clock.

mod acceptance;
mod anatomy;
mod animal;
mod block;
mod choice;
mod envelope;
mod error;
mod estimate;
mod evaluate;
pub mod gait;
pub mod gates;
mod overlap;
mod posture;
pub mod report;
mod result;
mod righting;
mod run;
mod scenario;
mod spectrum;
mod stride;
mod suite;
mod summary;
mod trace;
mod transition;
mod wave;

pub use anatomy::Anatomy;
pub use animal::score as animal_score;
pub use choice::Tried;
pub use envelope::Envelope;
pub use error::EvaluationError;
pub use estimate::Estimate;
pub use evaluate::Evaluation;
pub use gait::Gait;
pub use gates::{Gate, GateReport};
pub use overlap::Shapes;
pub use posture::{Posture, PostureResult};
pub use result::{AnimalRow, Referee, Row, ScenarioResult, SuiteResult};
pub use righting::RightingResult;
pub use run::{Outcome, Settings, conditions, run_scenario};
pub use scenario::{Corner, Goal, Leg, Order, Scenario, Start};
pub use stride::Stride;
pub use suite::{Suite, flat_name};
pub use summary::{Summary, SummaryError, summary_path};
pub use trace::{Film, Frame, RobotPose, Trace, Track};
pub use transition::TransitionResult;
pub use wave::WaveResult;
