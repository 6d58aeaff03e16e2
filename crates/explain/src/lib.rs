//! Why does it not walk? From a run folder to the most likely mistake in its task or robot, what to change, and
//! the evidence that it helps.
//!
//! The policy is rolled out ([`behaviour`]): what does it do instead of walking? Everything in the
//! configuration that differs from what is known to train such a robot, and every sign of a mistake in the
//! task's own terms, its observation and the robot file, is a [`Suspect`]; the table in [`table`] says how
//! suspect. The suspects are put right, one at a time and together, each in a short training
//! ([`trial`]), and compared with the same training as the run is ([`search`]). Only what makes it walk is
//! named.

pub mod behaviour;
mod observation;
mod report;
mod robot;
mod run;
mod search;
mod stance;
mod suspect;
mod table;
mod terms;
mod trial;

pub use behaviour::{Behaviour, Sign};
pub use report::{Cause, Report, Trial, Verdict};
pub use run::Run;
pub use search::{Plan, explain, suspects};
pub use suspect::Suspect;
pub use trial::{Trainer, turned};
