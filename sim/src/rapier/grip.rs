//! Friction patches of the ground, told to Rapier before it solves contacts.
//!
//! Rapier keeps one coefficient per contact manifold: a ball has one contact in it, so its factor is exact; a flat shape that lies across a
//! patch's edge has the factor at the mean of its contact points.

use std::sync::Arc;

use rapier3d::math::{Real, Vector};
use rapier3d::pipeline::{ContactModificationContext, PhysicsHooks};

use crate::Terrain;

/// Multiplies each contact's friction coefficient by the terrain's factor there.
pub(super) struct Grip {
    terrain: Arc<Terrain>,
    needed: bool,
}

impl Grip {
    pub fn new(terrain: Arc<Terrain>) -> Self {
        Self {
            needed: terrain.has_patches(),
            terrain,
        }
    }

    /// Whether the ground has patches at all: asking Rapier to call back costs time.
    pub fn is_needed(&self) -> bool {
        self.needed
    }
}

impl PhysicsHooks for Grip {
    fn modify_solver_contacts(&self, context: &mut ContactModificationContext<'_>) {
        let Some(contact) = context.rigid_mut() else {
            return;
        };
        let count = contact.solver_contacts.len();
        if count == 0 {
            return;
        }
        let sum = contact
            .solver_contacts
            .iter()
            .fold(Vector::ZERO, |sum, c| sum + c.anchor1);
        let at = sum / count as Real;
        *contact.friction *= self.terrain.friction_factor(at.x, at.y);
    }
}
