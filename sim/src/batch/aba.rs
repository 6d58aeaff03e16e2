//! The articulated-body algorithm (Featherstone, "Rigid Body Dynamics Algorithms", 2008, chapter 7) about one
//! common point: inwards, then outwards.

use super::frame::Frame;
use super::program::Program;
use super::vec3::{Inertia, V3, add_scaled, dot, zero3};
use crate::simd::Lanes;

/// Torque of a joint, linear in its acceleration: `torque − inertia·q̈`.
#[derive(Debug, Clone, Copy)]
pub(super) struct Load<R> {
    /// N·m.
    pub torque: R,
    /// Rotor inertia and what dampers and springs taken at the step's end add to it, kg·m².
    pub inertia: R,
}

/// What the inward pass leaves for the outward one.
#[derive(Debug, Clone, Copy)]
pub(super) struct Hinge<R> {
    u_ang: V3<R>,
    u_lin: V3<R>,
    /// 1 / (joint's articulated inertia), 1/kg·m².
    inverse: R,
    /// Torque left for acceleration, N·m.
    rest: R,
}

impl<R: Lanes> Hinge<R> {
    pub fn zero() -> Self {
        Self { u_ang: zero3(), u_lin: zero3(), inverse: R::zero(), rest: R::zero() }
    }
}

/// Folds every joint into its parent's articulated inertia.
#[inline(always)]
pub(super) fn inward<R: Lanes>(
    program: &Program<R>,
    frames: &[Frame<R>],
    loads: &[Load<R>],
    inertias: &mut [Inertia<R>],
    hinges: &mut [Hinge<R>],
) {
    for i in (0..program.nodes.len()).rev() {
        let node = &program.nodes[i];
        let frame = &frames[i + 1];
        let load = &loads[i];
        let (before, after) = inertias.split_at_mut(i + 1);
        let own = &after[0];
        let (ang, lin) = (frame.axis_ang, frame.axis_lin);
        let (u_ang, u_lin, d, held);
        if node.slide {
            (u_ang, u_lin) = own.times_linear(lin);
            d = dot(lin, u_lin);
            held = dot(lin, own.f);
        } else {
            (u_ang, u_lin) = own.times(ang, lin);
            d = dot(ang, u_ang) + dot(lin, u_lin);
            held = dot(ang, own.n) + dot(lin, own.f);
        }
        let inverse = R::one() / (d + load.inertia);
        let rest = load.torque - held;
        hinges[i] = Hinge { u_ang, u_lin, inverse, rest };
        if node.parent == 0 && !program.free {
            continue;
        }
        let part = own.reduced(u_ang, u_lin, inverse, rest * inverse);
        let parent = &mut before[node.parent];
        if node.first_for_parent {
            *parent = part;
        } else {
            parent.add(&part);
        }
    }
}

/// Acceleration of the base beyond its bias: solves `inertia · (α, a) = −(n, f)`.
#[inline(always)]
pub(super) fn solve_base<R: Lanes>(i: &Inertia<R>) -> (V3<R>, V3<R>) {
    // L·D·Lᵀ of the symmetric 6 × 6 matrix, linear part first: it is the better conditioned pivot
    let (a, b, c) = (&i.a, &i.b, &i.c);
    let m = [
        [c[0], c[1], c[2], b[0], b[3], b[6]],
        [c[1], c[3], c[4], b[1], b[4], b[7]],
        [c[2], c[4], c[5], b[2], b[5], b[8]],
        [b[0], b[1], b[2], a[0], a[1], a[2]],
        [b[3], b[4], b[5], a[1], a[3], a[4]],
        [b[6], b[7], b[8], a[2], a[4], a[5]],
    ];
    let mut l = m;
    let mut inverse = [R::zero(); 6];
    for j in 0..6 {
        inverse[j] = R::one() / l[j][j];
        for r in j + 1..6 {
            let factor = l[r][j] * inverse[j];
            for k in j + 1..=r {
                l[r][k] -= factor * l[k][j];
            }
        }
        for r in j + 1..6 {
            l[r][j] = l[r][j] * inverse[j];
        }
    }
    let mut y = [-i.f[0], -i.f[1], -i.f[2], -i.n[0], -i.n[1], -i.n[2]];
    for r in 1..6 {
        for k in 0..r {
            y[r] -= l[r][k] * y[k];
        }
    }
    for r in 0..6 {
        y[r] = y[r] * inverse[r];
    }
    for r in (0..5).rev() {
        for k in r + 1..6 {
            y[r] -= l[k][r] * y[k];
        }
    }
    ([y[3], y[4], y[5]], [y[0], y[1], y[2]])
}

/// Joint accelerations `qdd`, and every node's acceleration beyond its bias, from the base's.
#[inline(always)]
pub(super) fn outward<R: Lanes>(
    program: &Program<R>,
    frames: &[Frame<R>],
    hinges: &[Hinge<R>],
    beyond: &mut [(V3<R>, V3<R>)],
    qdd: &mut [R],
) {
    for i in 0..program.nodes.len() {
        let node = &program.nodes[i];
        let frame = &frames[i + 1];
        let h = &hinges[i];
        let (ang, lin) = beyond[node.parent];
        let carried = dot(h.u_ang, ang) + dot(h.u_lin, lin);
        let acceleration = (h.rest - carried) * h.inverse;
        qdd[i] = acceleration;
        beyond[i + 1] = (
            add_scaled(ang, frame.axis_ang, acceleration),
            add_scaled(lin, frame.axis_lin, acceleration),
        );
    }
}
