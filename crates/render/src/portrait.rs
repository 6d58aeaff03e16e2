//! A robot in the middle of its picture.

use std::sync::Arc;

use caudata_model::{Pose, RobotModel};
use caudata_sim::Terrain;

use crate::camera::{Camera, View};
use crate::error::RenderError;
use crate::image::Image;
use crate::robot::robot_items;
use crate::scene::Scene;
use crate::trace::{Quality, render};

/// One moment of a robot.
#[derive(Clone, Debug, PartialEq)]
pub struct Moment {
    /// Time, s.
    pub time_s: f64,
    /// `world_from_base`.
    pub base: Pose,
    /// `[J]`, model order.
    pub joint_pos_rad: Vec<f64>,
    /// Which feet stand on something; empty: not known.
    pub contacts: Vec<bool>,
}

/// The robot with its centre of mass in the middle. `distance_m` is made so that the whole robot is in the picture
/// where it is not given, and stays so for the pictures that follow.
///
/// # Errors
/// [`RenderError`] for a setting out of range, or another number of joints.
pub fn portrait(
    model: &RobotModel,
    moment: &Moment,
    terrain: &Arc<Terrain>,
    (view, heading_rad): (View, f64),
    distance_m: &mut Option<f64>,
    quality: &Quality,
) -> Result<Image, RenderError> {
    let places = model.kinematics(&moment.base, &moment.joint_pos_rad)?;
    let com_m = model.centre_of_mass_m(&places);
    let items = robot_items(model, &moment.base, &moment.joint_pos_rad, &moment.contacts)?;
    let scene = Scene::new(&items, Arc::clone(terrain), moment.time_s);
    let aspect = f64::from(quality.width) / f64::from(quality.height);
    let fits = || Camera::far_enough_m(view, scene.reach_m(com_m), aspect);
    let far_m = *distance_m.get_or_insert_with(fits);
    render(&scene, &Camera::of_view(view, com_m, heading_rad, far_m)?, quality)
}
