//! Diagnosis: where simulation and measurement part, why, and what it is worth to know.
//!
//! Measured runs and a robot file go in; a [`Report`] comes out: the divergence, named causes with intervals
//! and look-alikes, the gain on runs that were not used for fitting, what could not have been seen, and what
//! to record next.
//!
//! Invariant: no clock, no network; same logs, same seed, same report, whatever the thread count.

pub mod calibration;
pub mod check;
pub mod diagnose;
pub mod effects;
pub mod error;
pub mod excitation;
pub mod excite;
pub mod extension;
pub mod go_on;
pub mod import;
pub mod page;
pub mod place;
pub mod plant;
pub mod plots;
pub mod prospects;
pub mod reading;
pub mod repeats;
pub mod replay;
pub mod report;
pub mod term;
pub mod trial;
mod units;

pub use diagnose::{Diagnosis, Options, Progress, Request, Stage, diagnose};
pub use error::GapError;
pub use extension::{Extension, mjcf_name};
pub use go_on::GoOn;
pub use plots::Plots;
pub use report::Report;
pub use trial::{Role, Run};
