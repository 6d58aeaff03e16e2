//! Friction of the ground, where Rapier's own is not Coulomb's at that place.
//!
//! *Patches.* Rapier keeps one coefficient per contact manifold: a ball has one contact in it, so its factor is exact; a flat shape that lies across a
//! patch's edge has the factor at the mean of its contact points.
//!
//! *Sliding.* Rapier 0.36.1 solves the two tangents of a multibody's contact one by one, each with its own effective mass (m₁, m₂), and then cuts the impulse
//! to μ·N. What slides at v is so pulled back along (m₁v₁, m₂v₂) in the world's axes, and not along v: the tip of a tail, light sideways and heavy
//! lengthwise, loses up to a quarter of its drag, and how much hangs on the robot's heading. So a contact that slides faster than an explicit force could turn
//! round within the step gets −μ·N·v/|v| from here, and none from Rapier. Slower ones, and those that hold, stay Rapier's: what is at rest has no
//! direction to get wrong. With it random gaits end 4.2 % and 4.1° from MuJoCo's, without 8.8 % and 8.7° (2 ms, `caudata sim verify`).

use std::sync::Arc;

use rapier3d::math::{Real, TangentImpulse, Vector};
use rapier3d::pipeline::{ContactModificationContext, PhysicsHooks};
use rapier3d::prelude::*;
use serde::{Deserialize, Serialize};

use super::world::GROUND_TAG;
use crate::Terrain;

/// A contact is taken over where its speed is beyond so many times what all friction changes of it in one step, and given back below so many times that: a
/// link gives way sideways up to about twice as easily as in the mean over directions. With less between the two, contacts that rock go to and fro.
const BEGINS: Real = 10.0;
const ENDS: Real = 2.0;
/// Share of what is owed that is given in each step.
const PAID: Real = 0.3;

/// How slippery the ground is, by place.
pub(super) struct Grip {
    terrain: Arc<Terrain>,
}

impl Grip {
    pub fn new(terrain: Arc<Terrain>) -> Self {
        Self { terrain }
    }

    /// Factor on the coefficient at a point, world, m.
    fn factor(&self, at: Vector) -> Real {
        self.terrain.friction_factor(at.x, at.y)
    }
}

/// A contact of the robot with the ground that slides.
#[derive(Debug, Clone, Copy)]
pub(super) struct Slide {
    /// The robot's side.
    pub collider: ColliderHandle,
    pub body: RigidBodyHandle,
    /// From the body's centre of mass to the contact, world, m.
    pub arm_m: Vector,
    /// World, m/s.
    slip_mps: Vector,
    /// On the robot, world, N.
    pub force_n: Vector,
}

/// Friction that sliding contacts have yet to give.
///
/// A push is answered over a few steps: in a leg that friction presses into the ground an answer to the last step's push alone is a larger push in the next
/// one, and so on until the foot hops.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub(super) struct Owed {
    /// Of each of the robot's colliders, N·s.
    impulse_ns: Vec<f32>,
}

/// The robot's colliders, and how they give way.
pub(super) struct Skin {
    colliders: Vec<ColliderHandle>,
    /// Acceleration of the collider's link per force on it, mean over directions, 1/kg.
    give_per_kg: Vec<Real>,
    /// Of the whole robot, kg.
    mass_kg: Real,
    /// What slides in the coming step, or in the one just taken.
    slides: Vec<Slide>,
}

impl Skin {
    /// `give_per_kg` of a body; `mass_kg` of the robot.
    pub fn new(
        world: &PhysicsWorld,
        mass_kg: Real,
        give_per_kg: impl Fn(RigidBodyHandle) -> Real,
    ) -> Self {
        let robots = (world.colliders.iter()).filter(|(_, c)| c.user_data != GROUND_TAG);
        let (colliders, give_per_kg) = robots
            .map(|(handle, c)| (handle, c.parent().map_or(0.0, &give_per_kg)))
            .unzip();
        Self {
            colliders,
            give_per_kg,
            mass_kg,
            slides: Vec::new(),
        }
    }

    /// What slides.
    pub fn slides(&self) -> &[Slide] {
        &self.slides
    }

    /// Finds what slides as the world now is, and takes what the last step's pushes call for into `owed`. What has left the ground owes nothing.
    pub fn find_slides(&mut self, world: &PhysicsWorld, grip: &Grip, owed: &mut Owed) {
        self.slides.clear();
        let count = self.colliders.len();
        let mut was_ns = std::mem::replace(&mut owed.impulse_ns, vec![0.0; count]);
        was_ns.resize(count, 0.0);
        let all_mps = self.friction_ns(world) / self.mass_kg;
        for pair in world.narrow_phase.contact_pairs() {
            let sides = [pair.collider1, pair.collider2];
            let index = |side: usize| self.colliders.iter().position(|c| *c == sides[side]);
            let (side, i) = match (index(0), index(1)) {
                (Some(i), None) => (0, i),
                (None, Some(i)) => (1, i),
                _ => continue,
            };
            let manifolds = pair.solver_manifolds();
            if manifolds.iter().all(|m| m.points.is_empty()) {
                continue;
            }
            let before = self.slides.len();
            let was_ns = std::mem::take(&mut was_ns[i]);
            match self.slide(world, grip, manifolds, (side, i), was_ns, all_mps) {
                Some(rest_ns) => owed.impulse_ns[i] += rest_ns,
                None => self.slides.truncate(before),
            }
        }
    }

    /// The most friction that the last step's pushes allow, all together, N·s.
    fn friction_ns(&self, world: &PhysicsWorld) -> Real {
        let of = |h: ColliderHandle| world.colliders.get(h).map_or(0.0, Collider::friction);
        let pairs = world.narrow_phase.contact_pairs();
        pairs
            .map(|pair| {
                let points = pair.solver_manifolds().iter().flat_map(|m| &m.points);
                let push_ns: Real = points.map(|p| p.data.impulse).sum();
                push_ns * of(pair.collider1).max(of(pair.collider2))
            })
            .sum()
    }

    /// Adds the contacts in `manifolds`, whose side `side` is the robot's collider `i`, and returns what they still owe after the coming step, N·s; `None`
    /// where one of them may not slide. They owed `was_ns`; `all_mps`: what all friction changes of the robot's speed in a step.
    fn slide(
        &mut self,
        world: &PhysicsWorld,
        grip: &Grip,
        manifolds: &[ContactManifold],
        (side, i): (usize, usize),
        was_ns: Real,
        all_mps: Real,
    ) -> Option<Real> {
        let collider = world.colliders.get(self.colliders[i])?;
        let handle = collider.parent()?;
        let body = world.bodies.get(handle)?;
        let first = self.slides.len();
        let (mut owed_ns, mut last_ns) = (was_ns, 0.0);
        for manifold in manifolds {
            let normal = manifold.data.normal;
            for point in &manifold.points {
                let arm_m = match side {
                    0 => point.data.solver_dp1,
                    _ => point.data.solver_dp2,
                };
                let at = body.center_of_mass() + arm_m;
                let friction_ns = collider.friction() * grip.factor(at) * point.data.impulse;
                last_ns += friction_ns;
                // from Rapier's hands the force goes on as it was
                let taken_over = point.data.tangent_impulse != TangentImpulse::zeros();
                owed_ns += if taken_over {
                    friction_ns / PAID
                } else {
                    friction_ns
                };
                let vel = body.linvel() + body.angvel().cross(arm_m);
                self.slides.push(Slide {
                    collider: self.colliders[i],
                    body: handle,
                    arm_m,
                    slip_mps: vel - normal * vel.dot(normal),
                    force_n: Vector::ZERO,
                });
            }
        }
        if owed_ns <= 0.0 {
            return None; // whatever lands, lands in Rapier's hands
        }
        let own = &mut self.slides[first..];
        let count = own.len() as Real;
        let each_ns = PAID * owed_ns / count;
        let most_mps = self.give_per_kg[i] * each_ns.max(last_ns / count) + all_mps;
        let surely = if was_ns > 0.0 { ENDS } else { BEGINS };
        let dt_s = world.integration_parameters.dt;
        // one coefficient for all of a pair's contacts: all slide, or none
        for slide in own {
            let speed = slide.slip_mps.length();
            if speed <= surely * most_mps {
                return None;
            }
            slide.force_n = slide.slip_mps * (-each_ns / (dt_s * speed));
        }
        Some((1.0 - PAID) * owed_ns)
    }
}

/// What Rapier asks before it solves contacts.
pub(super) struct Friction<'a> {
    pub grip: &'a Grip,
    /// Their friction is a load on the robot already.
    pub slides: &'a [Slide],
}

impl PhysicsHooks for Friction<'_> {
    fn modify_solver_contacts(&self, context: &mut ContactModificationContext<'_>) {
        let pair = [context.collider1, context.collider2];
        let slides = self.slides.iter().any(|s| pair.contains(&s.collider));
        let Some(contact) = context.rigid_mut() else {
            return;
        };
        let count = contact.solver_contacts.len();
        if count == 0 {
            return;
        }
        if slides {
            *contact.friction = 0.0;
            return;
        }
        let sum = contact
            .solver_contacts
            .iter()
            .fold(Vector::ZERO, |sum, c| sum + c.anchor1);
        *contact.friction *= self.grip.factor(sum / count as Real);
    }
}
