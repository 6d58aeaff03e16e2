//! The robot model: MJCF subset plus robot file, checked and hashed.
//!
//! A robot is two files side by side: the MJCF (bodies, joints, shapes; plain MuJoCo loads it) and the
//! `*.robot.toml` that names it (servos, sensors, play, contact, water, poses). [`RobotModel::load`] reads
//! both, refuses what is wrong with file and line, and gives one checked value.
//!
//! Where both files carry a number (friction, springs, servo friction, gains) the robot file wins: it is the
//! one that diagnosis extends.
//!
//! Frames: world x forward, y left, z up. SI units and radians. Quaternions w, x, y, z.

mod assemble;
mod error;
mod extension;
mod geometry;
pub mod import;
mod kinematics;
mod load;
mod mesh;
mod mjcf;
mod model;
mod of_joint;
mod params;
mod parts;
pub mod pose;
mod robot_file;
mod servos;
mod tree;
mod types;
mod urdf_export;
mod xml_text;

pub use error::ModelError;
pub use extension::{Extension, ExtensionEffect, ExtensionParameter};
pub use geometry::has_shell;
pub use kinematics::{JointFrame, Kinematics};
pub use model::{IMU_TILT_MAX_RAD, RobotModel};
pub use params::{
    AddedShare, BacklashParams, ContactParams, DragScale, EncoderSide, Gains, ImuParams, Measured,
    SensorParams, ServoParams, SupplyParams, WaterParams,
};
pub use pose::Pose;
pub use types::{
    Ball, BaseKind, Foot, Geom, Joint, JointKind, JointMotion, Link, ROLLS_FROM_RAD, Shape, Site,
    Softness,
};
