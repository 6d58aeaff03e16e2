//! What loads a joint: servo, spring, damping, friction, end stops. The formulas of [`crate::servo`] and [`crate::joint`] over lanes.

use super::lanes::{JointLane, ServoLane};
use crate::joint::PRESLIDING_RAD;
use crate::simd::Lanes;

/// Speed over which the back-driven gain ratio fades in, rad/s (see [`crate::servo`]).
const BACK_DRIVE_FADE_RADPS: f64 = 0.1;

/// Damping of the friction bristle as a time: it feels where it would be that much later. Without it a joint that should be held rings on its
/// bristle and creeps; with much more, friction acts ahead of time at every reversal.
const BRISTLE_DAMPING_S: f64 = 0.02;

/// Torque of a joint, linear in its acceleration: `torque − inertia·q̈`.
#[derive(Debug, Clone, Copy)]
pub(super) struct Load<R> {
    /// N·m.
    pub torque: R,
    /// Rotor inertia and what dampers and springs taken at the step's end add to it, kg·m².
    pub inertia: R,
    /// The motor's part of `torque`, N·m.
    pub motor: R,
    /// The motor's part of `inertia`, kg·m².
    pub motor_inertia: R,
}

/// The step.
#[derive(Debug, Clone, Copy)]
pub(super) struct Step<R> {
    /// s
    pub dt: R,
    /// s²
    pub dt2: R,
}

/// Springs, stops, friction and rotor.
#[inline(always)]
pub(super) fn passive<R: Lanes>(j: &JointLane<R>, s: Step<R>, q: R, qd: R, bristle: R) -> Load<R> {
    let (o, one) = (R::zero(), R::one());
    let moved = s.dt * qd;
    let ahead = q + moved;
    let mut damping = j.damping;
    let mut stiffness = j.spring;
    let mut torque = j.spring * (j.spring_ref - ahead);
    // end stops
    let outside = q.lt(j.low) | j.high.lt(q);
    let stop = R::select(outside, j.stop, o);
    torque = stop.mul_add(q.clamp(j.low, j.high) - ahead, torque);
    stiffness += stop;
    damping += R::select(outside, j.stop_damping, o);
    // friction: a bristle up to its full deflection, then constant
    let per_rad = R::splat(1.0 / f64::from(PRESLIDING_RAD));
    let soon = R::splat(BRISTLE_DAMPING_S);
    let deflection = (bristle + (s.dt + soon) * qd) * per_rad;
    let sticks = R::select(deflection.abs().le(one), j.friction * per_rad, o);
    torque -= j.friction * deflection.clamp(-one, one);
    torque -= damping * qd;
    Load {
        torque,
        inertia: (stiffness + sticks).mul_add(
            s.dt2,
            (sticks.mul_add(soon, damping)).mul_add(s.dt, j.armature),
        ),
        motor: o,
        motor_inertia: o,
    }
}

/// Adds the servo's torque towards `target`. Its damping is taken at the end of the step unless the envelope holds it.
#[inline(always)]
pub(super) fn add_servo<R: Lanes>(
    load: &mut Load<R>,
    p: &ServoLane<R>,
    s: Step<R>,
    q: R,
    qd: R,
    target: R,
) {
    let (o, one) = (R::zero(), R::one());
    let error = target - q;
    let away = -(qd * error.signum0());
    let share = (away * R::splat(1.0 / BACK_DRIVE_FADE_RADPS)).clamp(o, one);
    let kp = p.kp * (p.back_drive - one).mul_add(share, one);
    let wanted = kp * error - p.kd * qd;
    let over = (qd.abs() - p.flat).max(o);
    let driving = p.slope.mul_add(over, p.tau_max).max(-p.brake);
    let (forward, backward) = (o.lt(qd), qd.lt(o));
    let high = R::select(forward, driving, R::select(backward, p.brake, p.tau_max));
    let low = -R::select(backward, driving, R::select(forward, p.brake, p.tau_max));
    let torque = wanted.max(low).min(high);
    let inside = low.le(wanted) & wanted.le(high);
    load.motor = torque;
    load.motor_inertia = R::select(inside, p.kd * s.dt, o);
    load.torque += torque;
    load.inertia += load.motor_inertia;
}
