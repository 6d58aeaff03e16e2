//! Contact as MuJoCo's elliptic cone has it, the other choice beside the bristle of [`super::contact`]
//! (`engine.convex_friction`).
//!
//! MuJoCo's constraint forces minimise a convex function. For one contact with friction μ that means (its
//! documentation, "Computation", "Constraint model"): friction is a damper and an inertia `ratio` times those
//! of the normal (`impratio`), and where that would exceed μ × normal force, normal and friction together
//! become one constraint along `e = n + μ·s`, s against the slip. So a sliding contact also lifts, at μ × its
//! slip, which Coulomb's does not. Along `e` the force is linear in the acceleration and symmetric: it fits
//! the articulated-body pass without any estimate of the normal force. Whether it slides, sticks or does
//! nothing is judged by how the point would have accelerated without contact in the last step.

use super::contact_law::ContactLaw;
use super::program::Point;
use super::vec3::{V3, add_scaled, dot, scale, select3, zero3};
use crate::simd::Lanes;

/// MuJoCo's `impratio` in its converged setting.
const RATIO: f64 = 100.0;
/// Row and column of each entry of a symmetric matrix as it is stored.
const UPPER: [[usize; 2]; 6] = [[0, 0], [0, 1], [0, 2], [1, 1], [1, 2], [2, 2]];
/// Slips below this are none, m/s².
const LEAST_SLIP: f64 = 1e-6;

/// The force `f0 − m·Δ` of a contact `depth` deep, Δ the acceleration of the point beyond its bias; m
/// symmetric.
///
/// `vel`, `acc`: velocity and bias acceleration of the point; `free`: its acceleration beyond the bias in the
/// last step, without contact.
#[inline(always)]
pub(super) fn force<R: Lanes>(
    law: &ContactLaw<R>,
    point: &Point<R>,
    touching: R::Mask,
    depth: R,
    normal: V3<R>,
    vel: V3<R>,
    acc: V3<R>,
    friction: R,
    free: V3<R>,
) -> (V3<R>, [R; 6]) {
    let (o, one) = (R::zero(), R::one());
    let give = R::uniform(point.mobility);
    let d = point.soft.impedance(depth);
    let weight = d / ((one - d) * give);
    let spring = d * R::splat(point.soft.stiffness_per_s2);
    let damper = R::splat(point.soft.damping_per_s);
    let half = R::uniform(law.theta_dt);
    let mid = add_scaled(vel, acc, half);
    let mid_n = dot(mid, normal);
    let mid_t = add_scaled(mid, normal, -mid_n);

    // accelerations that the contact would have to give to get what it wants
    let wish = [
        damper.mul_add(-vel[0], -free[0]),
        damper.mul_add(-vel[1], -free[1]),
        damper.mul_add(-vel[2], -free[2]),
    ];
    let along_n = dot(wish, normal);
    let wish_t = add_scaled(wish, normal, -along_n);
    let wish_n = spring.mul_add(depth, along_n);
    let length = dot(wish_t, wish_t).sqrt().max(R::splat(LEAST_SLIP));
    let lifted = friction.mul_add(length, wish_n);
    let on = touching & o.lt(lifted);
    let weight_t = weight * R::splat(RATIO);
    let sticks = (length / (give + one / weight_t)).le(friction * (wish_n * d / give));

    // sliding: one constraint along e; across the slip the force turns with it
    let s = scale(wish_t, one / length);
    let e = add_scaled(normal, s, friction);
    let square = friction * friction;
    let softer = square.mul_add(R::splat(1.0 / RATIO), one);
    let normal_nm = lifted / (give * (one + square) + softer / weight);
    let limit = friction * normal_nm.max(o);
    let across = (limit / (length - limit * give).max(R::splat(LEAST_SLIP))).min(weight_t);
    let weight_e = weight / softer;
    let push = spring * (depth - half * mid_n);
    let damped = damper.mul_add(half, one);
    let stiffened = (spring * half).mul_add(half, damped);

    let w = R::select(sticks, weight_t, across);
    let pull = scale(mid_t, -(w * damper));
    let stuck = add_scaled(pull, normal, weight * (push - damper * mid_n));
    let slid =
        add_scaled(add_scaled(pull, s, -dot(pull, s)), e, weight_e * (push - damper * dot(mid, e)));
    let f0 = select3(on, select3(sticks, stuck, slid), zero3());
    // m = a·1 + p·nᵀ + q·sᵀ, symmetric as a whole
    let a = w * damped;
    let m_e = weight_e * stiffened;
    let p = select3(
        sticks,
        scale(normal, weight * stiffened - a),
        add_scaled(scale(normal, -a), e, m_e),
    );
    let q = select3(sticks, zero3(), add_scaled(scale(s, -a), e, m_e * friction));
    let mut m = [a, o, o, a, o, a];
    for k in 0..6 {
        let [r, c] = UPPER[k];
        let value = q[r].mul_add(s[c], p[r].mul_add(normal[c], m[k]));
        m[k] = R::select(on, value, o);
    }
    (f0, m)
}
