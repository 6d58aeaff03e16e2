//! The benchmark of diagnosis.

#![allow(clippy::expect_used, clippy::panic, clippy::unwrap_used)]

mod bench;
mod stand;
mod truth;
mod verdicts;
mod water;
