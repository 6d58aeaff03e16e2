//! Pictures of robots, terrain and water, so that a person can check a model, a scene or a log by eye.
//!
//! A small ray caster: every shape of the model is met exactly, with a sun, its shadows, a sky and ambient occlusion. Pure functions: the
//! same scene gives the same bytes, for any number of threads. [`Scene`] says what is there, [`Camera`] from where, [`render`] makes an
//! [`Image`], which [`encode`] turns into PNG, and a row of them into an animated GIF.
#![cfg_attr(test, allow(clippy::unwrap_used, clippy::expect_used, clippy::panic))]

mod camera;
pub mod encode;
mod font;
mod ground;
mod image;
mod light;
mod robot;
mod scene;
mod solid;
mod trace;

pub use camera::{Camera, View};
pub use encode::{gif, png};
pub use image::Image;
pub use robot::robot_items;
pub use scene::{Item, Scene};
pub use trace::{Quality, render};

/// Why a picture could not be made.
#[derive(Debug, thiserror::Error)]
pub enum RenderError {
    /// A size or setting is out of range.
    #[error("{what} is {value}: {reason}")]
    Setting {
        /// Which one.
        what: &'static str,
        /// As given.
        value: String,
        /// What would be accepted.
        reason: &'static str,
    },
    /// The pose does not fit the robot.
    #[error(transparent)]
    Model(#[from] caudata_model::ModelError),
    /// The encoder refused.
    #[error("cannot encode the picture: {0}")]
    Encode(String),
}

type Vec3 = [f64; 3];

fn scale(v: Vec3, s: f64) -> Vec3 {
    v.map(|x| x * s)
}

fn unit(v: Vec3) -> Vec3 {
    let length = caudata_model::pose::norm(v).max(1e-300);
    v.map(|x| x / length)
}

/// `a` at 0, `b` at 1.
fn mix(a: Vec3, b: Vec3, t: f64) -> Vec3 {
    [0, 1, 2].map(|i| a[i] + (b[i] - a[i]) * t)
}
