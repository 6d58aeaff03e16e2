//! The protocol, the bus and its emulation.

#![allow(clippy::expect_used, clippy::panic, clippy::unwrap_used)]

mod any_bytes;
mod golden;
mod pseudo_terminal;
mod transactions;
