//! Friction of the ground, where Rapier's own is not Coulomb's at that place.
//!
//! *Patches.* Rapier keeps one coefficient per contact manifold: a ball has one contact in it, so its factor
//! is exact; a flat shape that lies across a patch's edge has the factor at the mean of its contact points.
//!
//! *Sliding.* Rapier 0.36.1 solves the two tangents of a multibody's contact each by itself, with its own
//! effective mass (m₁, m₂), and then cuts the impulse to μ·N. What slides at v is so pulled back along (m₁v₁,
//! m₂v₂) in the world's axes, and not along v: the tip of a tail, light sideways and heavy lengthwise, loses
//! up to a quarter of its drag, and how much hangs on the robot's heading (figures:
//! `docs/reference/simulation.md`). So a contact that slides fast enough for an explicit force gets
//! −μ·N·v/|v| from here, and none from Rapier. How fast that is goes with the step: some 0.1 m/s for the
//! Polymander's tail and 0.2 m/s for a foot that carries its share at 1 ms, four times as much at 4 ms. What
//! is slower stays Rapier's, whose direction then is as wrong as ever.

use std::sync::Arc;

use rapier3d::math::{Real, TangentImpulse, Vector};
use rapier3d::pipeline::{ContactModificationContext, PhysicsHooks};
use rapier3d::prelude::*;
use serde::{Deserialize, Serialize};

use super::tags::GROUND_TAG;
use crate::Terrain;

/// A contact is taken over where its speed is beyond so many times what all friction changes of it in one
/// step, and given back below so many times that: a link gives way sideways up to about twice as easily as in
/// the mean over directions. With less between the two, contacts that rock go to and fro.
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
    /// On the robot, world, N.
    pub force_n: Vector,
}

/// A point where a collider of the robot touches, or may touch in a moment.
#[derive(Debug, Clone, Copy)]
struct Touch {
    /// Index of the collider.
    of: usize,
    arm_m: Vector,
    /// Out of the ground or into it.
    normal: Vector,
    /// Friction that the last step's push allows, N·s.
    allowed_ns: Real,
    /// Whether Rapier gave it.
    given: bool,
}

/// Friction that sliding contacts have yet to give.
///
/// A push is answered over a few steps: in a leg that friction presses into the ground an answer to the last
/// step's push alone is a larger push in the next one, and so on until the foot hops.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
pub(super) struct Owed {
    /// Impulse owed to each of the robot's colliders, N·s.
    impulse_ns: Vec<Real>,
}

/// The robot's colliders, and how they give way.
pub(super) struct Skin {
    colliders: Vec<ColliderHandle>,
    /// Acceleration of the collider's link per force on it, mean over directions, 1/kg.
    give_per_kg: Vec<Real>,
    /// Mass of the whole robot, kg.
    mass_kg: Real,
    /// Where it touches the ground, in the order of colliders.
    touches: Vec<Touch>,
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
        let (colliders, give_per_kg) =
            robots.map(|(handle, c)| (handle, c.parent().map_or(0.0, &give_per_kg))).unzip();
        Self { colliders, give_per_kg, mass_kg, touches: Vec::new(), slides: Vec::new() }
    }

    /// What slides.
    pub fn slides(&self) -> &[Slide] {
        &self.slides
    }

    /// Finds what slides as the world now is, and takes what the last step's pushes call for into `owed`.
    /// What has left the ground owes nothing.
    pub fn find_slides(&mut self, world: &PhysicsWorld, grip: &Grip, owed: &mut Owed) {
        self.find_touches(world, grip);
        self.slides.clear();
        owed.impulse_ns.resize(self.colliders.len(), 0.0);
        let all_ns: Real = self.touches.iter().map(|t| t.allowed_ns).sum();
        let all_mps = all_ns / self.mass_kg;
        let mut touches = self.touches.as_slice();
        for (i, owed_ns) in owed.impulse_ns.iter_mut().enumerate() {
            let (own, others) = touches.split_at(touches.partition_point(|t| t.of <= i));
            touches = others;
            let contact = Contact {
                collider: self.colliders[i],
                give_per_kg: self.give_per_kg[i],
                touches: own,
                was_ns: std::mem::take(owed_ns),
            };
            if let Some(rest_ns) = contact.slide(world, all_mps, &mut self.slides) {
                *owed_ns = rest_ns;
            }
        }
    }

    /// Finds where the robot touches the ground, by collider.
    fn find_touches(&mut self, world: &PhysicsWorld, grip: &Grip) {
        self.touches.clear();
        for pair in world.narrow_phase.contact_pairs() {
            let sides = [pair.collider1, pair.collider2];
            let index = |side: usize| self.colliders.iter().position(|c| *c == sides[side]);
            let (side, of) = match (index(0), index(1)) {
                (Some(of), None) => (0, of),
                (None, Some(of)) => (1, of),
                _ => continue,
            };
            let Some(collider) = world.colliders.get(sides[side]) else { continue };
            let centre = (collider.parent())
                .and_then(|body| world.bodies.get(body))
                .map_or(Vector::ZERO, RigidBody::center_of_mass);
            for manifold in pair.solver_manifolds() {
                for point in &manifold.points {
                    let arm_m = match side {
                        0 => point.data.solver_dp1,
                        _ => point.data.solver_dp2,
                    };
                    let friction = collider.friction() * grip.factor(centre + arm_m);
                    self.touches.push(Touch {
                        of,
                        arm_m,
                        normal: manifold.data.normal,
                        allowed_ns: friction * point.data.impulse,
                        given: point.data.tangent_impulse != TangentImpulse::zeros(),
                    });
                }
            }
        }
        // a collider on the edge of two pieces of ground touches both, and is one contact
        self.touches.sort_by_key(|t| t.of);
    }
}

/// All that one collider does on the ground.
struct Contact<'a> {
    collider: ColliderHandle,
    give_per_kg: Real,
    touches: &'a [Touch],
    /// Owed from before the last step, N·s.
    was_ns: Real,
}

impl Contact<'_> {
    /// Adds it to `slides` and returns what it still owes after the coming step, N·s; `None` where it may
    /// hold. `all_mps`: what all friction changes of the robot's speed in a step.
    fn slide(&self, world: &PhysicsWorld, all_mps: Real, slides: &mut Vec<Slide>) -> Option<Real> {
        let last_ns: Real = self.touches.iter().map(|t| t.allowed_ns).sum();
        // Taken over from Rapier it begins where it would be after many steps of such a push, so that the
        // force goes on as it was.
        let due_ns = |t: &Touch| {
            if t.given { t.allowed_ns / PAID } else { t.allowed_ns }
        };
        let owed_ns = self.was_ns + self.touches.iter().map(due_ns).sum::<Real>();
        if self.touches.is_empty() || owed_ns <= 0.0 {
            return None; // whatever lands, lands in Rapier's hands
        }
        let share = |t: &Touch| match last_ns > 0.0 {
            true => t.allowed_ns / last_ns,
            false => 1.0 / self.touches.len() as Real,
        };
        let body = world.colliders.get(self.collider)?.parent()?;
        let (linvel, angvel) = velocity(world, body)?;
        let slip = |t: &Touch| {
            let vel = linvel + angvel.cross(t.arm_m);
            vel - t.normal * vel.dot(t.normal)
        };
        let paid_ns = PAID * owed_ns;
        let surely = if self.was_ns > 0.0 { ENDS } else { BEGINS };
        let least_mps = surely * (self.give_per_kg * paid_ns.max(last_ns) + all_mps);
        let bear = || self.touches.iter().filter(|t| share(t) > 0.0);
        // one coefficient for all that a collider touches: all slide, or none
        if bear().any(|t| slip(t).length() <= least_mps) {
            return None;
        }
        let force_n = paid_ns / world.integration_parameters.dt;
        slides.extend(bear().map(|t| Slide {
            collider: self.collider,
            body,
            arm_m: t.arm_m,
            force_n: slip(t).normalize_or_zero() * (-share(t) * force_n),
        }));
        Some(owed_ns - paid_ns)
    }
}

/// Velocity of a link's centre of mass and its angular velocity, world: a link's own fields are those at the
/// start of the last step.
fn velocity(world: &PhysicsWorld, body: RigidBodyHandle) -> Option<(Vector, Vector)> {
    let link = world.multibody_joints.rigid_body_link(body)?;
    let multibody = world.multibody_joints.get_multibody(link.multibody)?;
    let v = multibody.body_jacobian(link.id) * multibody.generalized_velocity();
    Some((Vector::new(v[0], v[1], v[2]), Vector::new(v[3], v[4], v[5])))
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
        let Some(contact) = context.rigid_mut() else { return };
        let count = contact.solver_contacts.len();
        if count == 0 {
            return;
        }
        if slides {
            *contact.friction = 0.0;
            return;
        }
        let sum = contact.solver_contacts.iter().fold(Vector::ZERO, |sum, c| sum + c.anchor1);
        *contact.friction *= self.grip.factor(sum / count as Real);
    }
}
