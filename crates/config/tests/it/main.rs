//! Configuration: what wrong files are told, and the reference page.

#![allow(clippy::expect_used, clippy::panic, clippy::unwrap_used)]

mod derived;
mod errors;
mod reference;
