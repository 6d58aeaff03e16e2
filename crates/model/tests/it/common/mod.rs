//! Shared by the tests of the model.

#![allow(dead_code)] // not every test file uses all of it

use std::path::{Path, PathBuf};

use caudata_model::RobotModel;

/// The folder of the shipped robots.
pub fn robots() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../robots")
}

/// The shipped Polymander.
pub fn polymander() -> RobotModel {
    RobotModel::load(&robots().join("polymander.robot.toml")).unwrap()
}

/// Fails with a message unless `a` and `b` agree within `tolerance`.
pub fn near(what: &str, a: f64, b: f64, tolerance: f64) {
    assert!((a - b).abs() <= tolerance, "{what}: {a} is not {b} (tolerance {tolerance})");
}
