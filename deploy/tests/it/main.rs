//! The robot client from outside.

#![allow(clippy::expect_used, clippy::panic, clippy::print_stdout, clippy::unwrap_used)]

mod common;
mod link_weather;
mod parity;
mod program;
mod soak;
mod supervisor;
mod two_processes;
mod wire;
