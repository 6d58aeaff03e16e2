//! The side door to ROS 2, from outside.

#![allow(clippy::expect_used, clippy::panic, clippy::unwrap_used)]

mod door;
mod rmw_zenoh;
mod ros2;
