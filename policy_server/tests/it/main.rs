//! The policy server from outside.

#![allow(clippy::expect_used, clippy::panic, clippy::print_stdout, clippy::unwrap_used)]

mod access;
mod common;
mod connections;
mod crash;
mod labels;
mod load;
mod registry;
