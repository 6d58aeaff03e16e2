//! Robot files: what they say, what is refused, and MuJoCo as referee.

#![allow(clippy::expect_used, clippy::panic, clippy::unwrap_used)]

mod common;
mod general;
mod import;
mod import_feet;
mod import_slips;
mod import_told;
mod mujoco;
mod polymander;
mod shipped;
mod wrong_files;
