//! Legs against trunk and other legs: balls against balls, after the outward pass.
//!
//! Which may touch says [`crate::self_contact`]; shapes other than balls meet in [`super::cores`].
//! The force is explicit, equal and opposite on the two bodies: taken implicitly by each body alone it
//! would not be, and the robot would push itself along. So its stiffness is bounded by the lightest link and
//! the step: 5000 N/m on 0.1 kg at 2 ms is ω·dt = 0.45, the limit being 2.

use super::frame::Frame;
use super::group::Group;
use super::place::Part;
use super::program::Program;
use super::vec3::{Inertia, V3, add, cross, dot, scale, select3, sub, zero3};
use crate::real::Mask;
use crate::simd::Lanes;

/// N/m.
const STIFFNESS: f64 = 5000.0;
/// N·s/m, once [`FULL_DEPTH_M`] deep.
const DAMPING: f64 = 15.0;
/// Penetration at which damping is full, m.
const FULL_DEPTH_M: f64 = 5e-4;
/// Friction per slip speed below the limit, N·s/m.
const SLIP_DAMPING: f64 = 15.0;
/// Deepest penetration that pushes, m.
const DEEPEST_M: f64 = 0.01;

/// Adds what touching parts of the robot do to each other; feet report it.
#[inline(always)]
pub(super) fn collide<R: Lanes>(
    program: &Program<R>,
    group: &mut Group<R>,
    frames: &[Frame<R>],
    centres: &mut [V3<R>],
    inertias: &mut [Inertia<R>],
) {
    for (p, point) in program.points.iter().enumerate() {
        centres[p] = frames[point.node].point(point.centre);
    }
    let one = R::one();
    let tiny = R::splat(1e-12);
    for &(a, b) in &program.pairs {
        let (pa, pb) = (&program.points[a], &program.points[b]);
        let reach = R::uniform(pa.radius) + R::uniform(pb.radius);
        let apart = sub(centres[b], centres[a]);
        let square = dot(apart, apart);
        let on = square.lt(reach * reach);
        if !on.any() {
            continue;
        }
        let distance = square.max(tiny).sqrt();
        let normal = scale(apart, one / distance);
        let depth = reach - distance;
        // on the line between the centres, where the balls meet
        let at = add(centres[a], scale(normal, R::uniform(pa.radius) - R::splat(0.5) * depth));
        let meeting =
            Meeting { nodes: [pa.node, pb.node], parts: [pa.part, pb.part], at, normal, depth, on };
        push(program, group, frames, inertias, &meeting);
    }
}

/// Two parts that reach into each other.
pub(super) struct Meeting<R: Lanes> {
    pub nodes: [usize; 2],
    pub parts: [Part; 2],
    /// Where, from the reference point, world, m.
    pub at: V3<R>,
    /// From the first to the second.
    pub normal: V3<R>,
    /// m.
    pub depth: R,
    /// Lanes in which they do.
    pub on: R::Mask,
}

/// Adds the force of a meeting to both.
#[inline(always)]
pub(super) fn push<R: Lanes>(
    program: &Program<R>,
    group: &mut Group<R>,
    frames: &[Frame<R>],
    inertias: &mut [Inertia<R>],
    meeting: &Meeting<R>,
) {
    let (o, one) = (R::zero(), R::one());
    let tiny = R::splat(1e-12);
    let &Meeting { nodes: [a, b], parts, at, normal, depth, on } = meeting;
    let (fa, fb) = (&frames[a], &frames[b]);
    let vel = sub(fb.velocity(at), fa.velocity(at));
    let vn = dot(vel, normal);
    let damping = R::splat(DAMPING) * (depth * R::splat(1.0 / FULL_DEPTH_M)).min(one);
    let push = R::splat(STIFFNESS) * depth.min(R::splat(DEEPEST_M)) - damping * vn;
    let push = push.max(o);
    let slip = sub(vel, scale(normal, vn));
    let speed = dot(slip, slip).max(tiny).sqrt();
    let friction = friction(group, parts[0]).max(friction(group, parts[1]));
    let drag = R::splat(SLIP_DAMPING).min(friction * push / speed);
    // on b; its opposite on a
    let force = sub(scale(normal, push), scale(slip, drag));
    let force = select3(on, force, zero3());
    let moment = cross(at, force);
    let to = &mut inertias[a];
    to.f = add(to.f, force);
    to.n = add(to.n, moment);
    let to = &mut inertias[b];
    to.f = sub(to.f, force);
    to.n = sub(to.n, moment);
    let first = 2 * program.actuated;
    if let Part::Foot(f) = parts[0] {
        for c in 0..3 {
            group.sums[first + 3 * f + c] -= force[c];
        }
    }
    if let Part::Foot(f) = parts[1] {
        for c in 0..3 {
            group.sums[first + 3 * f + c] += force[c];
        }
    }
}

#[inline(always)]
fn friction<R: Lanes>(group: &Group<R>, part: Part) -> R {
    match part {
        Part::Foot(f) => group.params.foot_friction[f],
        Part::Trunk | Part::Tail => group.params.body_friction,
    }
}
