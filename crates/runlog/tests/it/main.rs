//! Logs written and read again.

#![allow(clippy::expect_used, clippy::panic, clippy::unwrap_used)]

mod mcap;
mod round_trip;
