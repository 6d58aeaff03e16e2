//! The task on an engine: episodes, determinism, mirror images, physics.

#![allow(clippy::expect_used, clippy::panic, clippy::unwrap_used)]

mod determinism;
mod episodes;
mod mirror;
mod physics;
mod rapier;
mod robots;
mod support;
