//! Contact impulses on the robot, read back from Rapier's manifolds.

use rapier3d::geometry::ContactManifold;
use rapier3d::math::Vector;
use rapier3d::prelude::*;

use super::convert;
use super::world::{GROUND_TAG, TAIL_TAG, TRUNK_TAG};

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

    /// Adds what the last step's contacts did.
    pub fn add(&mut self, world: &PhysicsWorld) {
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
    fn add_foot(&mut self, manifold: &ContactManifold, tag: u128, sign: f64) {
        if matches!(tag, GROUND_TAG | TRUNK_TAG | TAIL_TAG) {
            return;
        }
        let foot = 3 * (tag as usize - 1);
        let towards_first = -manifold.data.normal;
        for point in &manifold.points {
            let impulse =
                towards_first * point.data.impulse + friction_impulse(&point.data, towards_first);
            for (sum, part) in self.feet_ns[foot..foot + 3]
                .iter_mut()
                .zip(convert::array(impulse))
            {
                *sum += sign * part;
            }
        }
    }
}

/// Friction impulse on the first body over the whole step, world. Rapier reports it in a tangent basis that it does not
/// keep; the last pass's share is known in both that basis and the world, which gives the basis back.
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
