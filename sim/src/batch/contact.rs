//! Contact of one ball or rim with the ground, as a force that is linear in the acceleration of the touching point.
//!
//! Normal force: MuJoCo's law with the `solref` and `solimp` of the MJCF, a spring, a damper and an inertia
//! (see [`Stop`]; A is the mean over directions at the link's centre of mass). Like MuJoCo's, its
//! acceleration is that of the coordinates alone, without Coriolis and centrifugal parts. Spring and damper
//! are taken in the middle of the step (θ = ½), so no step is too large for them. It never pulls: it acts
//! where the point would go into the ground faster than the law wants, judged by how it would have
//! accelerated without contact in the last step.
//!
//! Friction: a bristle (Cundall and Strack, "A discrete numerical model for granular assemblies", 1979) that
//! the point drags along once the force exceeds friction × normal force. Regularised friction instead (force
//! ∝ slip speed) creeps under load: an open-loop trot then travels a sixth of what MuJoCo's converged answer
//! is. The limit is friction × the normal force that came out of the *last* step: over a contact, friction
//! then gets exactly its share of the push. Any estimate from the start of this step is too large while a
//! foot lands: that cost the trot 16 % of its way at 2 ms (2 % so), and halving the step only halved it.
//! While sliding, only the direction across the slip is implicit, so that the force along the slip is
//! Coulomb's whatever the acceleration.
//!
//! Here MuJoCo differs, unless [`convex`](super::convex) is chosen: its friction is the convex relaxation of
//! Coulomb's, in which a sliding contact also lifts (the normal force grows with the slip), and sticking
//! takes a time constant. `docs/reference/simulation.md` says how much of a gait's way that is.

use super::contact_law::{ContactLaw, THETA, Touch};
use super::convex;
use super::frame::Frame;
use super::ground::Ground;
use super::program::Point;
use super::vec3::{
    Inertia, V3, add, add_cross, add_scaled, cross, dot, scale, select3, sub, turn, uniform3, zero3,
};
use crate::real::Mask;
use crate::simd::Lanes;

/// Cosine and sine of the angles from straight down, ± 30 and ± 60°, at which a rim may meet a riser or a slope
/// before its centre is above it. Between them it goes in by up to 3 % of its radius, at a wall by 13 %.
const RIM_AHEAD: [[f64; 2]; 4] = [[0.866, 0.5], [0.866, -0.5], [0.5, 0.866], [0.5, -0.866]];

/// A ball or a rim that reaches into the ground.
struct Meeting<R> {
    depth: R,
    normal: V3<R>,
    /// Touching point from the reference point, world, m.
    arm: V3<R>,
    /// Likewise the centre of a rim, which stays above the touching point while the wheel rolls; `None`: of a ball,
    /// which is mostly a foot and hardly rolls, it is the point itself that is accelerated.
    above: Option<V3<R>>,
    /// The ground's factor on friction there.
    grip: R,
}

/// Works out the contact of a ball (`point` in the frame `frame`, from the base at `base`), adds it to the
/// body's inertia and notes it.
#[inline(always)]
pub(super) fn touch<R: Lanes, const FLAT: bool>(
    law: &ContactLaw<R>,
    ground: &Ground<R>,
    base: V3<R>,
    frame: &Frame<R>,
    point: &Point<R>,
    friction: R,
    memory: &mut [R],
    inertia: &mut Inertia<R>,
    note: &mut Touch<R>,
) {
    let Some(meeting) = meet::<R, FLAT>(ground, base, frame, point) else {
        leave(memory, note);
        return;
    };
    let (normal, arm) = (meeting.normal, meeting.arm);
    let friction = friction * meeting.grip;
    let touching = R::zero().lt(meeting.depth);
    let depth = meeting.depth.min(R::uniform(point.deepest));
    let vel = add_cross(frame.lin, frame.ang, arm);
    // classical acceleration with the bias alone, without what turns the touching point of a rim up again
    let carried = match meeting.above {
        Some(at) => add_cross(frame.lin, frame.ang, at),
        None => vel,
    };
    let acc = add_cross(add_cross(frame.bias_lin, frame.bias_ang, arm), frame.ang, carried);
    let (f0, m);
    if law.convex {
        let free = [memory[0], memory[1], memory[2]];
        (f0, m) = convex::force(law, point, touching, depth, normal, vel, acc, friction, free);
        add_general(inertia, arm, &m);
    } else {
        (f0, m) =
            bristle::<R, FLAT>(law, point, touching, depth, normal, vel, acc, friction, memory);
        if FLAT {
            add_flat(inertia, arm, &m);
        } else {
            add_general(inertia, arm, &m);
        }
    }
    inertia.f = sub(inertia.f, f0);
    inertia.n = sub(inertia.n, cross(arm, f0));
    *note = Touch {
        any: true,
        arm,
        normal,
        give: R::uniform(point.mobility),
        touching: R::select(touching, R::one(), R::zero()),
        f0,
        m,
    };
}

/// Where a ball or a rim reaches into the ground; `None` where no lane's does.
#[inline(always)]
fn meet<R: Lanes, const FLAT: bool>(
    ground: &Ground<R>,
    base: V3<R>,
    frame: &Frame<R>,
    point: &Point<R>,
) -> Option<Meeting<R>> {
    let (o, one) = (R::zero(), R::one());
    let c = uniform3(point.centre);
    let radius = R::uniform(point.radius);
    if let Some(axle) = point.axle {
        return meet_rim::<R, FLAT>(ground, base, frame, point, uniform3(axle));
    }
    let z = coordinate(frame, c, 2);
    if FLAT {
        let depth = radius - (z + base[2]);
        if !o.lt(depth).any() {
            return None;
        }
        let arm = [coordinate(frame, c, 0), coordinate(frame, c, 1), z - radius];
        return Some(Meeting { depth, normal: [o, o, one], arm, above: None, grip: one });
    }
    let (x, y) = (coordinate(frame, c, 0), coordinate(frame, c, 1));
    let (clearance, normal, grip) = ground.clearance(x + base[0], y + base[1], z + base[2]);
    let depth = radius - clearance;
    if !o.lt(depth).any() {
        return None;
    }
    let arm = add_scaled([x, y, z], normal, -radius);
    Some(Meeting { depth, normal, arm, above: None, grip })
}

/// The same of a rim about `axle` (node's frame): what touches is its point that is farthest down the normal of
/// the ground below its centre, or, where it is deeper, a point of the rim ahead or behind.
#[inline(always)]
fn meet_rim<R: Lanes, const FLAT: bool>(
    ground: &Ground<R>,
    base: V3<R>,
    frame: &Frame<R>,
    point: &Point<R>,
    axle: V3<R>,
) -> Option<Meeting<R>> {
    let (o, one) = (R::zero(), R::one());
    let above = frame.point(point.centre);
    let [x, y, z] = add(above, base);
    let (clearance, mut normal, mut grip) =
        if FLAT { (z, [o, o, one], one) } else { ground.clearance(x, y, z) };
    let axle = turn(&frame.rot, axle);
    let radius = R::uniform(point.radius);
    let (steep, down) = down_the_rim(axle, normal);
    let mut depth = radius * steep - clearance;
    let mut to_rim = scale(down, radius);
    if !FLAT {
        let (_, down) = down_the_rim(axle, [o, o, one]);
        let ahead = cross(axle, down);
        for [along, across] in RIM_AHEAD {
            let at =
                scale(add_scaled(scale(down, R::splat(along)), ahead, R::splat(across)), radius);
            let (clear, upright, grips) = ground.clearance(x + at[0], y + at[1], z + at[2]);
            let deeper = depth.lt(-clear);
            depth = depth.max(-clear);
            to_rim = select3(deeper, at, to_rim);
            normal = select3(deeper, upright, normal);
            grip = R::select(deeper, grips, grip);
        }
    }
    if !o.lt(depth).any() {
        return None;
    }
    Some(Meeting { depth, normal, arm: add(above, to_rim), above: Some(above), grip })
}

/// The direction within a wheel's plane that points farthest down a normal, and the cosine between the two. A
/// wheel that lies on its side has no such direction.
#[inline(always)]
fn down_the_rim<R: Lanes>(axle: V3<R>, normal: V3<R>) -> (R, V3<R>) {
    let along = dot(axle, normal);
    let steep = (R::one() - along * along).max(R::splat(1e-6)).sqrt();
    (steep, scale(add_scaled(scale(axle, along), normal, -R::one()), R::one() / steep))
}

/// One world coordinate of a place in a frame, from the reference point, m.
#[inline(always)]
fn coordinate<R: Lanes>(frame: &Frame<R>, at: V3<R>, axis: usize) -> R {
    let rot = &frame.rot;
    rot[2][axis]
        .mul_add(at[2], rot[1][axis].mul_add(at[1], rot[0][axis].mul_add(at[0], frame.pos[axis])))
}

/// The force `f0 − m·Δ` of a contact `depth` deep with Coulomb's friction on a bristle, Δ the acceleration of
/// the point beyond its bias; m symmetric. `vel`, `acc`: velocity and bias acceleration of the point.
#[inline(always)]
fn bristle<R: Lanes, const FLAT: bool>(
    law: &ContactLaw<R>,
    point: &Point<R>,
    touching: R::Mask,
    depth: R,
    normal: V3<R>,
    vel: V3<R>,
    acc: V3<R>,
    friction: R,
    memory: &mut [R],
) -> (V3<R>, [R; 6]) {
    let k = R::uniform;
    let (o, one) = (R::zero(), R::one());
    let dt = k(law.dt);
    let ahead = add_scaled(vel, acc, dt);
    let (vn, ahead_n) =
        if FLAT { (vel[2], ahead[2]) } else { (dot(vel, normal), dot(ahead, normal)) };
    // normal: spring, damper and inertia
    let d = point.soft.impedance(depth);
    let weight = d / ((one - d) * k(point.mobility));
    let spring = d * R::splat(point.soft.stiffness_per_s2);
    let damper = R::splat(point.soft.damping_per_s);
    let on = touching & memory[4].lt(spring * depth - damper * vn);
    let half = k(law.theta_dt);
    let resists = spring.mul_add(half, damper);
    let mid_n = (ahead_n - vn).mul_add(R::splat(THETA), vn);
    let up = R::select(on, weight * (spring * depth - resists * mid_n), o);
    let mn = R::select(on, weight * resists.mul_add(half, one), o);
    // the normal force that came out of the last step: no estimate of this one's is free of bias (see above)
    let limit = friction * memory[3];

    // friction: deflection, tangential part, held within the limit
    let (slip, slip_ahead) = if FLAT {
        ([vel[0], vel[1], o], [ahead[0], ahead[1], o])
    } else {
        (add_scaled(vel, normal, -vn), add_scaled(ahead, normal, -ahead_n))
    };
    let mut s = add_scaled([memory[0], memory[1], memory[2]], slip, dt);
    if !FLAT {
        s = add_scaled(s, normal, -dot(s, normal));
    }
    let spring = scale(s, k(point.kt));
    let (limit2, spring2) = (limit * limit, flat_dot::<R, FLAT>(spring, spring));
    let tiny = R::splat(1e-20);
    let held = R::select(limit2.lt(spring2), limit / spring2.max(tiny).sqrt(), one);
    let (s, spring) = (scale(s, held), scale(spring, held));
    let trial = add_scaled(spring, slip_ahead, k(point.dt_full));
    let trial2 = flat_dot::<R, FLAT>(trial, trial);
    let slides = limit2.lt(trial2);
    let inverse = one / trial2.max(tiny).sqrt();
    let share = R::select(slides, limit * inverse, one);
    let along = select3(slides, scale(trial, inverse), zero3());
    let mt = R::select(on, share * k(point.dt_full) * dt, o);
    let back = R::select(on, -share, o);
    memory[..3].copy_from_slice(&select3(on, s, zero3()));
    resist::<R, FLAT>(scale(trial, back), normal, along, up, mn, mt)
}

/// Puts the parts together: `f0` along the ground and `up`; `mn` along the normal, `mt` across it but not
/// `along` the slip.
#[inline(always)]
fn resist<R: Lanes, const FLAT: bool>(
    mut f0: V3<R>,
    normal: V3<R>,
    along: V3<R>,
    up: R,
    mn: R,
    mt: R,
) -> (V3<R>, [R; 6]) {
    if FLAT {
        let o = R::zero();
        f0[2] = up;
        let (tx, ty) = (along[0] * mt, along[1] * mt);
        let m = [mt - tx * along[0], -(tx * along[1]), o, mt - ty * along[1], o, mn];
        return (f0, m);
    }
    let w = scale(along, -mt);
    let v = scale(normal, mn - mt);
    let m = [
        v[0].mul_add(normal[0], w[0].mul_add(along[0], mt)),
        v[0].mul_add(normal[1], w[0] * along[1]),
        v[0].mul_add(normal[2], w[0] * along[2]),
        v[1].mul_add(normal[1], w[1].mul_add(along[1], mt)),
        v[1].mul_add(normal[2], w[1] * along[2]),
        v[2].mul_add(normal[2], w[2].mul_add(along[2], mt)),
    ];
    (add_scaled(f0, normal, up), m)
}

#[inline(always)]
fn leave<R: Lanes>(memory: &mut [R], note: &mut Touch<R>) {
    memory.fill(R::zero());
    note.any = false;
}

#[inline(always)]
fn flat_dot<R: Lanes, const FLAT: bool>(a: V3<R>, b: V3<R>) -> R {
    if FLAT { a[0].mul_add(b[0], a[1] * b[1]) } else { dot(a, b) }
}

/// Adds `m` at `arm`, with `m` = (xx, xy, 0, yy, 0, zz).
#[inline(always)]
fn add_flat<R: Lanes>(i: &mut Inertia<R>, arm: V3<R>, m: &[R; 6]) {
    let [x, y, z] = arm;
    let [a, b, _, d, _, e] = *m;
    // [arm]× · m
    let (p00, p01, p02) = (-(z * b), -(z * d), y * e);
    let (p10, p11, p12) = (z * a, z * b, -(x * e));
    let (p20, p21) = (x * b - y * a, x * d - y * b);
    i.c[0] += a;
    i.c[1] += b;
    i.c[3] += d;
    i.c[5] += e;
    let b_ = &mut i.b;
    b_[0] += p00;
    b_[1] += p01;
    b_[2] += p02;
    b_[3] += p10;
    b_[4] += p11;
    b_[5] += p12;
    b_[6] += p20;
    b_[7] += p21;
    i.a[0] += p02 * y - p01 * z;
    i.a[1] += p00 * z - p02 * x;
    i.a[2] += p01 * x - p00 * y;
    i.a[3] += p10 * z - p12 * x;
    i.a[4] += p11 * x - p10 * y;
    i.a[5] += p21 * x - p20 * y;
}

/// Adds a full symmetric `m` at `arm`.
#[inline(always)]
pub(super) fn add_general<R: Lanes>(i: &mut Inertia<R>, arm: V3<R>, m: &[R; 6]) {
    let [x, y, z] = arm;
    let rows = [[m[0], m[1], m[2]], [m[1], m[3], m[4]], [m[2], m[4], m[5]]];
    for c in 0..6 {
        i.c[c] += m[c];
    }
    // p = [arm]× · m, row by row
    let p0 = add_scaled(scale(rows[2], y), rows[1], -z);
    let p1 = add_scaled(scale(rows[0], z), rows[2], -x);
    let p2 = add_scaled(scale(rows[1], x), rows[0], -y);
    for c in 0..3 {
        i.b[c] += p0[c];
        i.b[3 + c] += p1[c];
        i.b[6 + c] += p2[c];
    }
    // p · [arm]×ᵀ
    i.a[0] += p0[2] * y - p0[1] * z;
    i.a[1] += p0[0] * z - p0[2] * x;
    i.a[2] += p0[1] * x - p0[0] * y;
    i.a[3] += p1[0] * z - p1[2] * x;
    i.a[4] += p1[1] * x - p1[0] * y;
    i.a[5] += p2[1] * x - p2[0] * y;
}
