//! End to end, faults, and the rules of this repository.

#![allow(clippy::expect_used, clippy::panic, clippy::print_stdout, clippy::unwrap_used)]

mod adapt;
mod chaos;
mod explain;
mod faults_actors;
mod gap_policies;
mod gap_session;
mod live;
mod publish;
mod refusals;
mod siege;
mod tidy;
mod traces;
mod train;
