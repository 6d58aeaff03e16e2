//! One conformance suite for every engine, and the batch engine beyond it.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::print_stdout)]

mod batch;
mod conformance;
