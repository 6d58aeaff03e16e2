//! From frames to batches: what is accepted, in which order, and what became of everything else.

mod account;
mod accounting;
mod collector;
mod rows;
mod side_by_side;

pub use account::{Arrival, DropReason, IncarnationAccount};
pub use accounting::{Accounting, ActorKey, Report, ReportRow};
pub use collector::{Collector, CollectorSettings, Outcome, STRIKES_MAX};
pub use rows::{Batch, Segment};
pub use side_by_side::side_by_side;
