//! Pictures of robots, terrain and water, so that a person can check a model, a scene or a log by eye.
//!
//! A small ray caster: every shape of the model is met exactly, with a sun, its shadows, a sky and ambient
//! occlusion. Pure functions: the same scene gives the same bytes, for any number of threads. [`Scene`] says
//! what is there, [`Camera`] from where, [`render`] makes an [`Image`], which [`encode`] turns into PNG, and
//! a row of them into an animated GIF.

mod camera;
pub mod encode;
mod error;
mod font;
mod ground;
mod image;
mod light;
mod portrait;
mod robot;
mod scene;
mod solid;
mod trace;
mod vector;

pub use camera::{Camera, View};
pub use encode::{gif, png};
pub use error::RenderError;
pub use image::Image;
pub use portrait::{Moment, portrait};
pub use robot::robot_items;
pub use scene::{Item, Scene};
pub use trace::{Quality, render};
