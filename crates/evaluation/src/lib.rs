//! How well a policy walks.
//!
//! A [`Suite`] is a list of [`Scenario`]s (ground, command, disturbances). [`run_suite`] runs the mean of a policy in each and keeps
//! a [`Trace`] per episode; [`gait`] measures it; [`gates`] says whether that is walking at all, since the rewards of walking can
//! also be had by vibrating.
//!
//! Invariant: the same policy, configuration and seed give the same figures; nothing here looks at a clock.
#![cfg_attr(test, allow(clippy::unwrap_used, clippy::expect_used, clippy::panic))]

mod error;
mod estimate;
pub mod gait;
pub mod gates;
mod result;
mod run;
mod spectrum;
mod suite;
mod trace;

pub use error::EvaluationError;
pub use estimate::Estimate;
pub use gait::Gait;
pub use gates::{Gate, GateReport, Limits};
pub use result::{ScenarioResult, SuiteResult};
pub use run::{Settings, run_scenario, run_suite};
pub use suite::{Corner, Scenario, Suite};
pub use trace::{Frame, Trace};
