//! What is there: coloured shapes, ground, water.

use std::sync::Arc;

use caudata_model::pose::{norm, sub};
use caudata_model::{Pose, Shape};
use caudata_sim::Terrain;

use crate::ground::Ground;
use crate::solid::{Hit, Ray, Solid};
use crate::vector::Vec3;

/// One coloured shape.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Item {
    /// What it is.
    pub shape: Shape,
    /// Where it is.
    pub world_from_shape: Pose,
    /// Linear RGB, 0 to 1.
    pub colour: [f64; 3],
}

/// Everything that a picture shows.
#[derive(Clone, Debug)]
pub struct Scene {
    pub(crate) solids: Vec<(Solid, Vec3)>,
    /// Centre and radius of a ball around all solids.
    bounds: (Vec3, f64),
    pub(crate) ground: Ground,
    /// Moves the ripples of the water, s.
    pub(crate) time_s: f64,
}

impl Scene {
    /// `items` on `terrain` at `time_s` (which only moves the water's ripples).
    pub fn new(items: &[Item], terrain: Arc<Terrain>, time_s: f64) -> Self {
        let solids: Vec<(Solid, Vec3)> = items
            .iter()
            .filter_map(|i| Some((Solid::new(i.shape, &i.world_from_shape)?, i.colour)))
            .collect();
        Self { bounds: ball_around(&solids), solids, ground: Ground::new(terrain), time_s }
    }

    /// The first solid on a ray, nearer than `far`, and its colour.
    pub(crate) fn meet_solids(&self, ray: &Ray, far: f64) -> Option<(Hit, Vec3)> {
        let mut found = None;
        let mut nearest = far;
        if !self.may_meet(ray) {
            return None;
        }
        for (solid, colour) in &self.solids {
            if let Some(hit) = solid.meet(ray, nearest) {
                nearest = hit.t;
                found = Some((hit, *colour));
            }
        }
        found
    }

    /// Whether any solid stands in a ray's way before `far`.
    pub(crate) fn is_blocked(&self, ray: &Ray, far: f64) -> bool {
        self.may_meet(ray) && self.solids.iter().any(|(s, _)| s.meet(ray, far).is_some())
    }

    /// Distance from the ball around all solids, m; 0 inside.
    pub(crate) fn distance_to_solids(&self, point: Vec3) -> f64 {
        (norm(sub(point, self.bounds.0)) - self.bounds.1).max(0.0)
    }

    /// How far the solids reach from `point`: to the sides, and up or down, m.
    pub fn reach_m(&self, point: Vec3) -> [f64; 2] {
        self.solids.iter().fold([0.0_f64; 2], |[aside_m, up_m], (solid, _)| {
            let (centre, radius_m) = solid.bounds();
            let [x, y, z] = sub(centre, point);
            [aside_m.max(x.hypot(y) + radius_m), up_m.max(z.abs() + radius_m)]
        })
    }

    fn may_meet(&self, ray: &Ray) -> bool {
        let (centre, radius) = self.bounds;
        let to = sub(ray.from, centre);
        let b = caudata_model::pose::dot(to, ray.along);
        let beside = caudata_model::pose::dot(to, to) - b * b;
        beside <= radius * radius && radius - b >= 0.0
    }
}

fn ball_around(solids: &[(Solid, Vec3)]) -> (Vec3, f64) {
    if solids.is_empty() {
        return ([0.0; 3], -1.0); // met by nothing
    }
    let mut centre = [0.0; 3];
    for (solid, _) in solids {
        let (c, _) = solid.bounds();
        centre = [0, 1, 2].map(|i| centre[i] + c[i] / solids.len() as f64);
    }
    let radius = solids
        .iter()
        .map(|(s, _)| norm(sub(s.bounds().0, centre)) + s.bounds().1)
        .fold(0.0, f64::max);
    (centre, radius)
}
