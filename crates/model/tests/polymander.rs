//! The shipped robot: mass, length, order, signs, clearance, stance.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

use std::path::{Path, PathBuf};

use caudata_model::{JointKind, Kinematics, Pose, RobotModel, pose};

#[test]
fn loads() {
    let m = RobotModel::load(&Path::new(env!("CARGO_MANIFEST_DIR")).join("../../robots/polymander.robot.toml")).unwrap();
    println!("{} {}", m.total_mass_kg(), m.joints().len());
    let _ = (PathBuf::new(), JointKind::Passive, Kinematics::default(), Pose::IDENTITY, pose::norm([0.0;3]));
}
