//! Parts of the robot against each other with their shapes, which [`super::rounded`] describes.

use super::frame::Frame;
use super::group::Group;
use super::pairs::{self, Meeting};
use super::program::Program;
use super::rounded::{Box3, Core, nearest};
use super::vec3::{Inertia, V3, add_scaled, dot, scale, select3, sub, turn, uniform3};
use crate::real::Mask;
use crate::simd::Lanes;

/// Cores nearer than this overlap: the line between their centres is the direction then, m.
const TOUCHING_M: f64 = 1e-5;

/// Adds what cores that meet do to each other.
#[inline(always)]
pub(super) fn collide<R: Lanes>(
    program: &Program<R>,
    group: &mut Group<R>,
    frames: &[Frame<R>],
    inertias: &mut [Inertia<R>],
) {
    let tiny = R::splat(1e-12);
    for &(a, b) in &program.core_pairs {
        let (ca, cb) = (&program.cores[a], &program.cores[b]);
        let (fa, fb) = (&frames[ca.node], &frames[cb.node]);
        let (from, to) = (fa.point(ca.centre), fb.point(cb.centre));
        let between = sub(to, from);
        let bound = R::uniform(ca.bound) + R::uniform(cb.bound);
        if !dot(between, between).lt(bound * bound).any() {
            continue;
        }
        let (near, far) = nearest(&world(ca, fa, from), &world(cb, fb, to));
        let apart = sub(far, near);
        let reach = R::uniform(ca.radius) + R::uniform(cb.radius);
        let square = dot(apart, apart);
        let on = square.lt(reach * reach);
        if !on.any() {
            continue;
        }
        let distance = square.max(tiny).sqrt();
        let overlap = distance.lt(R::splat(TOUCHING_M));
        let along = scale(apart, R::one() / distance);
        let centres = scale(between, R::one() / dot(between, between).max(tiny).sqrt());
        let normal = select3(overlap, centres, along);
        let depth = reach - distance;
        let middle = R::uniform(ca.radius) - R::splat(0.5) * depth;
        let meeting = Meeting {
            nodes: [ca.node, cb.node],
            parts: [ca.part, cb.part],
            at: add_scaled(near, normal, middle),
            normal,
            depth,
            on,
        };
        pairs::push(program, group, frames, inertias, &meeting);
    }
}

#[inline(always)]
fn world<R: Lanes>(core: &Core<R>, frame: &Frame<R>, centre: V3<R>) -> Box3<R> {
    let columns = [
        turn(&frame.rot, uniform3(core.columns[0])),
        turn(&frame.rot, uniform3(core.columns[1])),
        turn(&frame.rot, uniform3(core.columns[2])),
    ];
    (centre, columns, uniform3(core.half))
}
