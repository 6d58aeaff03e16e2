//! Scores: single cases ([`outcome`]), rates with intervals ([`wilson`]), the table of the protocol
//! ([`summary`]).

pub mod outcome;
pub mod summary;
pub mod wilson;

pub use outcome::{Given, Judged, Outcome, judge};
pub use summary::Summary;
pub use wilson::Rate;
