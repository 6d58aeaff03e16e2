//! Contact impulses on the robot, read back from Rapier's manifolds.

use rapier3d::geometry::ContactManifold;
use rapier3d::math::Vector;
use rapier3d::prelude::*;

use super::convert;
use super::friction::Slide;
use super::tags::{GROUND_TAG, TAIL_TAG, TRUNK_TAG, foot_of};
use crate::State;

/// Sums of contact impulses, N·s.
#[derive(Debug, Default)]
pub(super) struct ContactImpulses {
    /// On each foot, world. `[F, 3]`
    pub feet_ns: Vec<f64>,
    /// Normal impulses on the other geoms of links that carry feet, summed without direction.
    pub trunk_ns: f64,
    /// Normal impulses on links that carry no feet, summed without direction.
    pub tail_ns: f64,
}

impl ContactImpulses {
    pub fn clear(&mut self, feet: usize) {
        self.feet_ns.clear();
        self.feet_ns.resize(3 * feet, 0.0);
        self.trunk_ns = 0.0;
        self.tail_ns = 0.0;
    }

    /// Adds what the last step's contacts did, of which `slides` had their friction as loads.
    pub fn add(&mut self, world: &PhysicsWorld, slides: &[Slide]) {
        for pair in world.narrow_phase.contact_pairs() {
            let tag =
                |h: ColliderHandle| world.colliders.get(h).map_or(GROUND_TAG, |c| c.user_data);
            let (tag1, tag2) = (tag(pair.collider1), tag(pair.collider2));
            // Impulses are those on the first body; the second one gets the opposite.
            for manifold in pair.solver_manifolds() {
                if tag1 == GROUND_TAG || tag2 == GROUND_TAG {
                    self.add_ground(manifold, tag1);
                    self.add_ground(manifold, tag2);
                }
                self.add_foot(manifold, tag1, 1.0);
                self.add_foot(manifold, tag2, -1.0);
            }
        }
        let dt_s = world.integration_parameters.dt;
        for slide in slides {
            let tag = world.colliders.get(slide.collider).map(|c| c.user_data);
            if let Some(foot) = tag.and_then(foot_of) {
                self.push_foot(foot, slide.force_n * dt_s);
            }
        }
    }

    /// Writes the means over a period.
    pub fn write(&self, out: &mut State, period_s: f64) {
        let mean = |sum: f64| (sum / period_s) as f32;
        for (slot, &sum) in out.foot_force_n.iter_mut().zip(&self.feet_ns) {
            *slot = mean(sum);
        }
        out.trunk_force_n[0] = mean(self.trunk_ns);
        out.tail_force_n[0] = mean(self.tail_ns);
    }

    fn push_foot(&mut self, foot: usize, impulse_ns: Vector) {
        let sums = &mut self.feet_ns[3 * foot..3 * foot + 3];
        for (sum, part) in sums.iter_mut().zip(convert::array(impulse_ns)) {
            *sum += part;
        }
    }

    /// What the ground does to the parts that are no feet.
    fn add_ground(&mut self, manifold: &ContactManifold, tag: u128) {
        let sum = match tag {
            TRUNK_TAG => &mut self.trunk_ns,
            TAIL_TAG => &mut self.tail_ns,
            _ => return,
        };
        for point in &manifold.points {
            *sum += f64::from(point.data.impulse);
        }
    }

    /// What a contact does to a foot, if it is one.
    fn add_foot(&mut self, manifold: &ContactManifold, tag: u128, sign: f32) {
        let Some(foot) = foot_of(tag) else { return };
        let towards_first = -manifold.data.normal;
        for point in &manifold.points {
            let impulse =
                towards_first * point.data.impulse + friction_impulse(&point.data, towards_first);
            self.push_foot(foot, impulse * sign);
        }
    }
}

/// Friction impulse on the first body over the whole step, world. Rapier reports it in a tangent basis that
/// it does not keep; the last pass's share is known in both that basis and the world, which gives the basis
/// back.
fn friction_impulse(data: &ContactData, dir1: Vector) -> Vector {
    let (world, local) = (data.warmstart_tangent_world, data.warmstart_tangent_impulse);
    let squared = local.x * local.x + local.y * local.y;
    if squared <= 0.0 {
        return Vector::ZERO;
    }
    let tangent1 = (world * local.x - dir1.cross(world) * local.y) / squared;
    let tangent2 = dir1.cross(tangent1);
    tangent1 * data.tangent_impulse.x + tangent2 * data.tangent_impulse.y
}
