//! Outwards from the base: where every frame is, how it moves, what inertia it carries, what it touches.
//!
//! Positions, velocities and inertias are about one point of the base ([`Program::centre`]) in world axes, so
//! bodies add up without transforms. Bias accelerations (what moves without any joint accelerating: Coriolis
//! and centrifugal) are accumulated here, so that the articulated passes see none.

use super::contact::touch;
use super::contact_law::{ContactLaw, MEMORY, Touch};
use super::frame::Frame;
use super::ground::Ground;
use super::group::{GroupParams, Layout, layout};
use super::place::Part;
use super::program::{Node, Program};
use super::vec3::{
    Inertia, V3, add, add_cross, add_scaled, columns, cross, dot, scale, sub, sym_times, turn,
    turn_sym, zero3,
};
use crate::simd::Lanes;

/// The base's frame. `centre`: the reference point in the base's frame, see [`Program::centre`].
#[inline(always)]
pub(super) fn base_frame<R: Lanes>(program: &Program<R>, x: &[R], half_dt: R) -> Frame<R> {
    let q = Layout::QUAT;
    let mut frame = Frame::zero();
    frame.rot = columns([x[q], x[q + 1], x[q + 2], x[q + 3]]);
    let c = program.centre;
    let to_centre = turn(&frame.rot, [R::uniform(c[0]), R::uniform(c[1]), R::uniform(c[2])]);
    frame.pos = [-to_centre[0], -to_centre[1], -to_centre[2]];
    if program.free {
        let vel = take3(x, Layout::VEL);
        frame.ang = take3(x, Layout::ANG);
        frame.lin = add_cross(vel, frame.ang, to_centre);
        let vel_mid = add_scaled(vel, take3(x, Layout::ACC), half_dt);
        frame.ang_mid = add_scaled(frame.ang, take3(x, Layout::SPIN_ACC), half_dt);
        frame.lin_mid = add_cross(vel_mid, frame.ang_mid, to_centre);
        // spatial: the bias gives the base's origin no acceleration
        frame.bias_lin = cross(vel_mid, frame.ang_mid);
    }
    frame
}

/// World position of the reference point.
#[inline(always)]
pub(super) fn centre<R: Lanes>(x: &[R], base: &Frame<R>) -> V3<R> {
    sub(take3(x, Layout::POS), base.pos)
}

#[inline(always)]
pub(super) fn take3<R: Lanes>(x: &[R], at: usize) -> V3<R> {
    [x[at], x[at + 1], x[at + 2]]
}

/// A node's frame from its parent's.
#[inline(always)]
pub(super) fn next_frame<R: Lanes>(
    node: &Node<R>,
    parent: &Frame<R>,
    q: R,
    qd: R,
    qd_mid: R,
) -> Frame<R> {
    let mut pos = parent.pos;
    for c in 0..3 {
        if node.has_offset[c] {
            pos = add_scaled(pos, parent.rot[c], R::uniform(node.offset[c]));
        }
    }
    let mut rot = parent.rot;
    if let Some(t) = &node.turn {
        for c in 0..3 {
            let v = [R::uniform(t[c][0]), R::uniform(t[c][1]), R::uniform(t[c][2])];
            rot[c] = turn(&parent.rot, v);
        }
    }
    // one copy of the code below per axis, so that columns are known when it is compiled
    match node.axis {
        0 => joint(node, parent, rot, pos, q, qd, qd_mid, 0, 1, 2),
        1 => joint(node, parent, rot, pos, q, qd, qd_mid, 1, 2, 0),
        _ => joint(node, parent, rot, pos, q, qd, qd_mid, 2, 0, 1),
    }
}

#[inline(always)]
fn joint<R: Lanes>(
    node: &Node<R>,
    parent: &Frame<R>,
    mut rot: [V3<R>; 3],
    mut pos: V3<R>,
    q: R,
    qd: R,
    qd_mid: R,
    along: usize,
    first: usize,
    second: usize,
) -> Frame<R> {
    let column = rot[along];
    let axis = if node.negative { [-column[0], -column[1], -column[2]] } else { column };
    let (pa, pl) = (parent.ang_mid, parent.lin_mid);
    if node.slide {
        pos = add_scaled(pos, axis, q);
        let moved = scale(axis, qd_mid);
        return Frame {
            rot,
            pos,
            axis_ang: zero3(),
            axis_lin: axis,
            ang: parent.ang,
            lin: add_scaled(parent.lin, axis, qd),
            ang_mid: pa,
            lin_mid: add(pl, moved),
            bias_ang: parent.bias_ang,
            bias_lin: add_cross(parent.bias_lin, pa, moved),
        };
    }
    let (sin, cos) = q.sin_cos();
    let sin = if node.negative { -sin } else { sin };
    let (a, b) = (rot[first], rot[second]);
    rot[first] = add_scaled(scale(a, cos), b, sin);
    rot[second] = add_scaled(scale(b, cos), a, -sin);
    let moment = cross(pos, axis);
    let (turn_ang, turn_lin) = (scale(axis, qd_mid), scale(moment, qd_mid));
    Frame {
        rot,
        pos,
        axis_ang: axis,
        axis_lin: moment,
        ang: add_scaled(parent.ang, axis, qd),
        lin: add_scaled(parent.lin, moment, qd),
        ang_mid: add(pa, turn_ang),
        lin_mid: add(pl, turn_lin),
        bias_ang: add_cross(parent.bias_ang, pa, turn_ang),
        bias_lin: add_cross(add_cross(parent.bias_lin, pa, turn_lin), pl, turn_ang),
    }
}

/// A push on the torso, world.
#[derive(Debug, Clone, Copy)]
pub(super) struct Push<R> {
    pub force: V3<R>,
    pub torque: V3<R>,
}

/// Inertia and bias force of the links of node `k`, about the reference point.
#[inline(always)]
pub(super) fn body_inertia<R: Lanes>(
    program: &Program<R>,
    params: &GroupParams<R>,
    k: usize,
    frame: &Frame<R>,
    push: &Push<R>,
) -> Inertia<R> {
    let mut sum = Inertia::zero();
    let range = program.links_of[k].clone();
    let first = range.start;
    for i in range {
        let lane = &params.links[i];
        let own = turn_sym(&frame.rot, &lane.inertia);
        let com = add(frame.pos, turn(&frame.rot, lane.com));
        let vel = add_cross(frame.lin_mid, frame.ang_mid, com);
        let bias = add_cross(add_cross(frame.bias_lin, frame.bias_ang, com), frame.ang_mid, vel);
        let mut f = scale(sub(bias, params.gravity), lane.mass);
        let mut n = add_cross(
            sym_times(&own, frame.bias_ang),
            frame.ang_mid,
            sym_times(&own, frame.ang_mid),
        );
        if i == program.torso {
            f = sub(f, push.force);
            n = sub(n, push.torque);
        }
        n = add_cross(n, com, f);
        let one = rigid(lane.mass, com, &own, n, f);
        if i == first {
            sum = one;
        } else {
            sum.add(&one);
        }
    }
    sum
}

#[inline(always)]
fn rigid<R: Lanes>(mass: R, com: V3<R>, own: &[R; 6], n: V3<R>, f: V3<R>) -> Inertia<R> {
    let o = R::zero();
    let m = scale(com, mass);
    let (xx, yy, zz) = (m[0] * com[0], m[1] * com[1], m[2] * com[2]);
    Inertia {
        a: [
            own[0] + (yy + zz),
            own[1] - m[0] * com[1],
            own[2] - m[0] * com[2],
            own[3] + (xx + zz),
            own[4] - m[1] * com[2],
            own[5] + (xx + yy),
        ],
        b: [o, -m[2], m[1], m[2], o, -m[0], -m[1], m[0], o],
        c: [mass, o, o, mass, o, mass],
        n,
        f,
    }
}

/// What the outward pass reads besides the state.
pub(super) struct World<'a, R: Lanes> {
    pub program: &'a Program<R>,
    pub ground: &'a Ground<R>,
    pub law: &'a ContactLaw<R>,
    pub params: &'a GroupParams<R>,
    pub push: Push<R>,
    /// Half a step, s.
    pub half_dt: R::Elem,
}

/// The first frames only, as many as there is room for.
#[inline(always)]
pub(super) fn frames<R: Lanes>(program: &Program<R>, x: &[R], frames: &mut [Frame<R>]) {
    if frames.is_empty() {
        return;
    }
    frames[0] = base_frame(program, x, R::zero());
    let n = program.nodes.len();
    let lay = layout(program);
    let (q, qd) = (&x[lay.q()..lay.q() + n], &x[lay.qd()..lay.qd() + n]);
    let rest = frames.len() - 1;
    for (i, node) in program.nodes[..rest].iter().enumerate() {
        let parent = frames[node.parent];
        frames[i + 1] = next_frame(node, &parent, q[i], qd[i], qd[i]);
    }
}

/// Frames, inertias and contacts. `FLAT`: the ground is the plane z = 0.
#[inline(always)]
pub(super) fn outward<R: Lanes, const FLAT: bool>(
    world: &World<'_, R>,
    x: &mut [R],
    frames: &mut [Frame<R>],
    inertias: &mut [Inertia<R>],
    touches: &mut [Touch<R>],
) {
    let program = world.program;
    let n = program.nodes.len();
    let half_dt = R::uniform(world.half_dt);
    frames[0] = base_frame(program, x, half_dt);
    let base = centre(x, &frames[0]);
    let lay = layout(program);
    let (head, memory) = x.split_at_mut(lay.contacts());
    let (q, qd) = (&head[lay.q()..lay.q() + n], &head[lay.qd()..lay.qd() + n]);
    let qdd = &head[lay.qdd()..lay.qdd() + n];
    if program.free {
        carry::<R, FLAT>(world, 0, &frames[0], base, memory, &mut inertias[0], touches);
    }
    for (i, node) in program.nodes.iter().enumerate() {
        let (before, after) = frames.split_at_mut(i + 1);
        after[0] =
            next_frame(node, &before[node.parent], q[i], qd[i], qdd[i].mul_add(half_dt, qd[i]));
        let inertia = &mut inertias[i + 1];
        carry::<R, FLAT>(world, i + 1, &after[0], base, memory, inertia, touches);
    }
}

/// Inertia and contacts of node `k`.
#[inline(always)]
fn carry<R: Lanes, const FLAT: bool>(
    world: &World<'_, R>,
    k: usize,
    frame: &Frame<R>,
    base: V3<R>,
    memory: &mut [R],
    to: &mut Inertia<R>,
    touches: &mut [Touch<R>],
) {
    let program = world.program;
    if program.links_of[k].is_empty() {
        return; // its only child writes it
    }
    *to = body_inertia(program, world.params, k, frame, &world.push);
    for p in program.points_of[k].clone() {
        let point = &program.points[p];
        let friction = match point.part {
            Part::Foot(f) => world.params.foot_friction[f],
            Part::Trunk | Part::Tail => world.params.body_friction,
        };
        touch::<R, FLAT>(
            world.law,
            world.ground,
            base,
            frame,
            point,
            friction,
            &mut memory[MEMORY * p..MEMORY * (p + 1)],
            to,
            &mut touches[p],
        );
    }
}

/// Length of a vector.
#[inline(always)]
pub(super) fn length<R: Lanes>(v: V3<R>) -> R {
    dot(v, v).sqrt()
}
