//! What [`State`] reports, worked out in the lanes. [`crate::observe`] is the plain form of the same
//! quantities.

use super::frame::Frame;
use super::group::{Group, Layout, layout};
use super::kinematics::{self, take3};
use super::place::Place;
use super::program::Program;
use super::readout::Readout;
use super::shared::{Scratch, Shared};
use super::vec3::{
    V3, add, add_scaled, cross, scale, sub, sym_times, turn, turn_back, turn_sym, uniform3, zero3,
};
use crate::simd::Lanes;

/// Numbers per lane of what [`Readout::base`] stands for.
const BASE: usize = 3 + 4 + 3 + 3;
/// Numbers per lane of centre of mass, its velocity, angular velocity and heading.
const WHOLE: usize = 3 + 3 + 3 + 1;

/// Writes the fields one after the other.
struct Writer<'a, R> {
    out: &'a mut [R],
    at: usize,
}

impl<R: Lanes> Writer<'_, R> {
    #[inline(always)]
    fn put(&mut self, values: &[R]) {
        let end = self.at + values.len();
        self.out[self.at..end].copy_from_slice(values);
        self.at = end;
    }
}

/// Fills the fields of `scratch.out` that are in `readout` from the group's state and sums, and moves the
/// IMU's velocity on if that is one of them.
#[inline(always)]
pub(super) fn report<R: Lanes>(
    shared: &Shared<R>,
    readout: Readout,
    group: &mut Group<R>,
    scratch: &mut Scratch<R>,
) {
    let program = &shared.program;
    let needed = frames_needed(program, readout);
    kinematics::frames(program, &group.x, &mut scratch.frames[..needed]);
    let frames = &scratch.frames;
    let mut w = Writer { out: &mut scratch.out, at: 0 };
    let base = if needed > 0 { kinematics::centre(&group.x, &frames[0]) } else { zero3() };
    if readout.base {
        put_base(program, group, frames, base, &mut w);
    } else {
        w.at += BASE;
    }
    put_joints(program, group, &mut w);
    let a = program.actuated;
    w.put(&group.sums[..2 * a]);
    if shared.ahead {
        put_ahead(program, group, &mut w);
    }
    w.at += 2 * a;
    if readout.rest {
        put_whole(program, group, frames, base, &mut scratch.coms, &mut w);
        w.put(&[heading(program, frames)]);
    } else {
        w.at += WHOLE;
    }
    put_feet(shared, readout, frames, base, &mut w);
    w.put(&group.sums[2 * a..]);
    if readout.imu {
        put_imu(shared, group, frames, &mut w);
    }
}

/// Number of the frames, from the base on, that what is read out is worked out from.
#[inline(always)]
fn frames_needed<R: Lanes>(program: &Program<R>, readout: Readout) -> usize {
    if readout.rest || readout.feet {
        return program.frames();
    }
    let mut frames = 0;
    if readout.base {
        frames = program.base_place.node + 1;
    }
    if readout.imu {
        frames = frames.max(program.imu.node + 1);
    }
    frames
}

#[inline(always)]
fn put_base<R: Lanes>(
    program: &Program<R>,
    group: &Group<R>,
    frames: &[Frame<R>],
    base: V3<R>,
    w: &mut Writer<'_, R>,
) {
    let place = &program.base_place;
    let frame = &frames[place.node];
    let arm = frame.point(place.at);
    let q = Layout::QUAT;
    if program.base_joint_count == 0 {
        // not by way of the reference point: a held base stands exactly where it was put
        let at = turn(&frame.rot, uniform3(place.at));
        w.put(&add(take3(&group.x, Layout::POS), at));
        // a held base may be placed turned in its node; a free one is its node
        let own = [group.x[q], group.x[q + 1], group.x[q + 2], group.x[q + 3]];
        w.put(&quat_times(own, &program.base_quat));
    } else {
        w.put(&add(base, arm));
        let mut rot = [zero3(); 3];
        for c in 0..3 {
            rot[c] = turn(&frame.rot, uniform3(place.columns[c]));
        }
        w.put(&quat_of(&rot));
    }
    w.put(&frame.velocity(arm));
    w.put(&into_place(place, frame, frame.ang));
}

#[inline(always)]
fn quat_times<R: Lanes>(a: [R; 4], b: &[R::Elem; 4]) -> [R; 4] {
    let b = [R::uniform(b[0]), R::uniform(b[1]), R::uniform(b[2]), R::uniform(b[3])];
    [
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    ]
}

/// Unit quaternion of a rotation matrix, lane by lane (only for robots whose root link hangs on joints).
fn quat_of<R: Lanes>(columns: &[V3<R>; 3]) -> [R; 4] {
    let mut out = [R::zero(); 4];
    for lane in 0..R::LANES {
        let m = |r: usize, c: usize| columns[c][r].lane(lane);
        let matrix = nalgebra::Matrix3::from_fn(m);
        let q = nalgebra::UnitQuaternion::from_rotation_matrix(
            &nalgebra::Rotation3::from_matrix_unchecked(matrix),
        );
        for (slot, value) in out.iter_mut().zip([q.w, q.i, q.j, q.k]) {
            *slot = slot.with_lane(lane, value);
        }
    }
    out
}

/// A world vector in the place's own axes.
#[inline(always)]
fn into_place<R: Lanes>(place: &Place<R>, frame: &Frame<R>, v: V3<R>) -> V3<R> {
    let node = turn_back(&frame.rot, v);
    turn_back(
        &[uniform3(place.columns[0]), uniform3(place.columns[1]), uniform3(place.columns[2])],
        node,
    )
}

#[inline(always)]
fn put_joints<R: Lanes>(program: &Program<R>, group: &Group<R>, w: &mut Writer<'_, R>) {
    let lay = layout(program);
    let (pos, vel) = (w.at, w.at + program.joints);
    // locked joints stay at the zero that nothing ever overwrites
    for (i, node) in program.nodes.iter().enumerate() {
        w.out[pos + node.joint] = group.x[lay.q() + i];
        w.out[vel + node.joint] = group.x[lay.qd() + i];
    }
    w.at += 2 * program.joints;
}

/// How far encoders are ahead of their joints. Those of locked joints are not.
#[inline(always)]
fn put_ahead<R: Lanes>(program: &Program<R>, group: &Group<R>, w: &mut Writer<'_, R>) {
    let qd = layout(program).qd();
    for (i, node) in program.nodes.iter().enumerate() {
        let Some(a) = node.servo else { continue };
        let (rad, radps) = group.drives[a].encoder_ahead(&group.params.servos[a], group.x[qd + i]);
        w.out[w.at + a] = rad;
        w.out[w.at + program.actuated + a] = radps;
    }
}

/// Centre of mass, its velocity and the equivalent angular velocity I⁻¹·L about it.
#[inline(always)]
fn put_whole<R: Lanes>(
    program: &Program<R>,
    group: &Group<R>,
    frames: &[Frame<R>],
    base: V3<R>,
    coms: &mut [(V3<R>, V3<R>)],
    w: &mut Writer<'_, R>,
) {
    let (mut total, mut com, mut vel) = (R::zero(), zero3(), zero3());
    for (i, place) in program.links.iter().enumerate() {
        let (frame, lane) = (&frames[place.node], &group.params.links[i]);
        let at = add(frame.pos, turn(&frame.rot, lane.com));
        let moving = frame.velocity(at);
        coms[i] = (at, moving);
        total += lane.mass;
        com = add_scaled(com, at, lane.mass);
        vel = add_scaled(vel, moving, lane.mass);
    }
    let inverse = R::one() / total;
    let (com, vel) = (scale(com, inverse), scale(vel, inverse));
    let (mut inertia, mut momentum) = ([R::zero(); 6], zero3());
    for (i, place) in program.links.iter().enumerate() {
        let (frame, lane) = (&frames[place.node], &group.params.links[i]);
        let own = turn_sym(&frame.rot, &lane.inertia);
        let (d, u) = (sub(coms[i].0, com), sub(coms[i].1, vel));
        let m = scale(d, lane.mass);
        momentum = add(momentum, add(sym_times(&own, frame.ang), cross(m, u)));
        let (xx, yy, zz) = (m[0] * d[0], m[1] * d[1], m[2] * d[2]);
        inertia[0] += own[0] + (yy + zz);
        inertia[1] += own[1] - m[0] * d[1];
        inertia[2] += own[2] - m[0] * d[2];
        inertia[3] += own[3] + (xx + zz);
        inertia[4] += own[4] - m[1] * d[2];
        inertia[5] += own[5] + (xx + yy);
    }
    w.put(&add(base, com));
    w.put(&vel);
    w.put(&solve_sym(&inertia, momentum));
}

/// `m⁻¹ · v` by cofactors, `m` scaled to about 1 first.
#[inline(always)]
fn solve_sym<R: Lanes>(m: &[R; 6], v: V3<R>) -> V3<R> {
    let s = R::one() / (m[0] + m[3] + m[5]);
    let [a, b, c, d, e, f] = [m[0] * s, m[1] * s, m[2] * s, m[3] * s, m[4] * s, m[5] * s];
    let co =
        [d * f - e * e, c * e - b * f, b * e - c * d, a * f - c * c, b * c - a * e, a * d - b * b];
    let det = a * co[0] + b * co[1] + c * co[2];
    scale(sym_times(&co, v), s / det)
}

/// Yaw of the girdle line, or of the base's x axis.
#[inline(always)]
fn heading<R: Lanes>(program: &Program<R>, frames: &[Frame<R>]) -> R {
    let line = match &program.heading {
        Some((hind, front)) => {
            sub(frames[front.node].point(front.at), frames[hind.node].point(hind.at))
        }
        None => {
            let place = &program.base_place;
            turn(&frames[place.node].rot, uniform3(place.columns[0]))
        }
    };
    let mut yaw = R::zero();
    for lane in 0..R::LANES {
        yaw = yaw.with_lane(lane, line[1].lane(lane).atan2(line[0].lane(lane)));
    }
    yaw
}

#[inline(always)]
fn put_feet<R: Lanes>(
    shared: &Shared<R>,
    readout: Readout,
    frames: &[Frame<R>],
    base: V3<R>,
    w: &mut Writer<'_, R>,
) {
    let program = &shared.program;
    let feet = program.feet.len();
    let (pos, vel, height) = (w.at, w.at + 3 * feet, w.at + 6 * feet);
    w.at += 7 * feet;
    if !readout.feet && !readout.rest {
        return;
    }
    for (f, foot) in program.feet.iter().enumerate() {
        let frame = &frames[foot.node];
        let arm = frame.point(foot.at);
        let at = add(base, arm);
        w.out[pos + 3 * f..pos + 3 * f + 3].copy_from_slice(&at);
        if !readout.rest {
            continue;
        }
        let moving = frame.velocity(arm);
        w.out[vel + 3 * f..vel + 3 * f + 3].copy_from_slice(&moving);
        let mut gap = lowest(&program.foot_balls[f], frame, base[2]);
        if !shared.ground.is_flat() {
            gap -= shared.ground.sample(at[0], at[1]).height;
        }
        w.out[height + f] = gap;
    }
}

/// Height of the lowest point of a foot's balls, m.
#[inline(always)]
fn lowest<R: Lanes>(balls: &[([R::Elem; 3], R::Elem)], frame: &Frame<R>, base: R) -> R {
    // No closures: they would not be compiled for the lanes' instructions.
    let mut lowest = None;
    for &(at, radius) in balls {
        let z = base + frame.point(at)[2] - R::uniform(radius);
        lowest = Some(match lowest {
            Some(so_far) => R::min(so_far, z),
            None => z,
        });
    }
    match lowest {
        Some(z) => z,
        None => base,
    }
}

#[inline(always)]
fn put_imu<R: Lanes>(
    shared: &Shared<R>,
    group: &mut Group<R>,
    frames: &[Frame<R>],
    w: &mut Writer<'_, R>,
) {
    let place = &shared.program.imu;
    let frame = &frames[place.node];
    let vel = frame.velocity(frame.point(place.at));
    let last = take3(&group.x, Layout::IMU);
    let rate = R::splat(1.0 / shared.period_s());
    let acceleration = scale(sub(vel, last), rate);
    let force = sub(acceleration, group.params.gravity);
    w.put(&into_place(place, frame, frame.ang));
    w.put(&into_place(place, frame, force));
    w.put(&into_place(place, frame, group.params.down));
    group.x[Layout::IMU..Layout::IMU + 3].copy_from_slice(&vel);
}
