//! The end of a physics step: velocities and positions move on; lanes that broke down get their state back.

use super::group::{Group, Layout, layout};
use super::kinematics;
use super::shared::{Scratch, Shared};
use super::vec3::{V3, add_cross, add_scaled, dot, scale};
use crate::drive::passive::{self, StopAt};
use crate::drive::{JointMemory, friction, step};
use crate::simd::Lanes;

/// Moves on by one step: velocities first, then positions with the new velocities.
#[inline(always)]
pub(super) fn integrate<R: Lanes>(
    shared: &Shared<R>,
    group: &mut Group<R>,
    scratch: &Scratch<R>,
) -> R::Mask {
    let program = &shared.program;
    let lay = layout(program);
    let n = program.nodes.len();
    let dt = R::splat(shared.dt_s);
    let fastest = R::splat(shared.max_joint_speed);
    let mut sound = R::zero().le(R::zero());
    let (head, rest) = group.x.split_at_mut(lay.q());
    let (q, rest) = rest.split_at_mut(n);
    let (qd, rest) = rest.split_at_mut(n);
    let (bristle, rest) = rest.split_at_mut(n);
    let (qdd, rest) = rest.split_at_mut(n);
    let free = &mut rest[..n];
    let half = R::splat(0.5);
    for i in 0..n {
        let (before, acceleration) = (qd[i], scratch.qdd[i]);
        let now = acceleration.mul_add(dt, before);
        let moved = now * dt;
        let hinge = &group.params.hinges[i];
        let stop = StopAt { law: &program.nodes[i].stop, free_radps2: free[i] };
        free[i] = passive::free_radps2(hinge, stop, q[i], before, moved, now, acceleration);
        qd[i] = now;
        qdd[i] = acceleration;
        q[i] += moved;
        sound = sound & now.abs().le(fastest);
        let Some(a) = program.nodes[i].servo else {
            bristle[i] = friction::drag_bristle(bristle[i], moved, hinge.presliding_rad);
            continue;
        };
        if let Some(driven) = &scratch.driven[a] {
            let motor_radps = step::finish(
                group.params.features,
                &group.params.servos[a],
                hinge,
                &mut group.drives[a],
                &shared.step,
                driven,
                moved,
                before,
                now,
            );
            group.sums[a] += driven.motor_nm;
            group.sums[program.actuated + a] +=
                driven.motor_nm * (half * (driven.motor_radps + motor_radps));
        }
    }
    if program.free {
        let (ang, lin) = scratch.beyond[0];
        let lin = add_cross(lin, ang, scratch.frames[0].pos);
        let vel = add_scaled(kinematics::take3(head, Layout::VEL), lin, dt);
        let spin = add_scaled(kinematics::take3(head, Layout::ANG), ang, dt);
        let pos = add_scaled(kinematics::take3(head, Layout::POS), vel, dt);
        let quat = turned(head, scale(spin, half * dt));
        put(head, Layout::VEL, &vel);
        put(head, Layout::ANG, &spin);
        put(head, Layout::POS, &pos);
        put(head, Layout::ACC, &lin);
        put(head, Layout::SPIN_ACC, &ang);
        put(head, Layout::QUAT, &quat);
        let base = R::splat(shared.max_base_speed);
        sound = sound & kinematics::length(vel).le(base) & kinematics::length(spin).le(fastest);
    }
    sound
}

#[inline(always)]
fn put<R: Lanes>(x: &mut [R], at: usize, values: &[R]) {
    x[at..at + values.len()].copy_from_slice(values);
}

/// The base's orientation after a turn by twice `half` (world, rad).
#[inline(always)]
fn turned<R: Lanes>(head: &[R], half: V3<R>) -> [R; 4] {
    let q = Layout::QUAT;
    let [w, x, y, z] = [head[q], head[q + 1], head[q + 2], head[q + 3]];
    // half a turn within a step is small: sin h / h and cos h by their series
    let h2 = dot(half, half);
    let s = h2.mul_add(h2.mul_add(R::splat(1.0 / 120.0), R::splat(-1.0 / 6.0)), R::one());
    let c = h2.mul_add(h2.mul_add(R::splat(1.0 / 24.0), R::splat(-0.5)), R::one());
    let [a, b, d] = scale(half, s);
    let new = [
        c * w - a * x - b * y - d * z,
        c * x + a * w + b * z - d * y,
        c * y - a * z + b * w + d * x,
        c * z + a * y - b * x + d * w,
    ];
    let norm2 = new[0] * new[0] + new[1] * new[1] + new[2] * new[2] + new[3] * new[3];
    let inverse = R::one() / norm2.sqrt();
    [new[0] * inverse, new[1] * inverse, new[2] * inverse, new[3] * inverse]
}

/// Gives lanes that broke down the state that they had before this period.
#[inline(always)]
pub(super) fn freeze<R: Lanes>(group: &mut Group<R>, scratch: &Scratch<R>) {
    let mut mark = [0.0_f32; 16];
    let mut any = false;
    for lane in 0..R::LANES {
        if group.diverged[lane] {
            mark[lane] = 1.0;
            any = true;
        }
    }
    if !any {
        return;
    }
    let frozen = R::zero().lt(R::read(&mark));
    for (now, saved) in group.x.iter_mut().zip(&scratch.saved) {
        *now = R::select(frozen, *saved, *now);
    }
    for (now, saved) in group.drives.iter_mut().zip(&scratch.saved_drives) {
        *now = select_memory(frozen, saved, now);
    }
    for (now, saved) in group.sums.iter_mut().zip(&scratch.saved_sums) {
        *now = R::select(frozen, *saved, *now);
    }
    for lane in 0..R::LANES {
        if group.diverged[lane] {
            group.wanted.forget(lane);
        }
    }
}

#[inline(always)]
fn select_memory<R: Lanes>(
    mask: R::Mask,
    yes: &JointMemory<R>,
    no: &JointMemory<R>,
) -> JointMemory<R> {
    JointMemory {
        bristle_rad: R::select(mask, yes.bristle_rad, no.bristle_rad),
        filtered_rad: R::select(mask, yes.filtered_rad, no.filtered_rad),
        profile_rad: R::select(mask, yes.profile_rad, no.profile_rad),
        profile_radps: R::select(mask, yes.profile_radps, no.profile_radps),
        target_rad: R::select(mask, yes.target_rad, no.target_rad),
        target_moved_rad: R::select(mask, yes.target_moved_rad, no.target_moved_rad),
        loop_radps: R::select(mask, yes.loop_radps, no.loop_radps),
        integral_nm: R::select(mask, yes.integral_nm, no.integral_nm),
        load_nm: R::select(mask, yes.load_nm, no.load_nm),
        lead_rad: R::select(mask, yes.lead_rad, no.lead_rad),
        rotor_radps: R::select(mask, yes.rotor_radps, no.rotor_radps),
        rise_k: R::select(mask, yes.rise_k, no.rise_k),
    }
}
