//! The learner from outside.

#![allow(clippy::expect_used, clippy::panic, clippy::print_stdout, clippy::unwrap_used)]

mod common;
mod faults;
mod learning;
mod lockstep;
mod program;
mod publish;
mod resume;
mod slow_actor;
mod symmetry;
mod tuning;
