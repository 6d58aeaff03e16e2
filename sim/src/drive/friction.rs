//! Dry friction of a joint: Coulomb, Stribeck, load-dependent and direction-dependent, on a bristle.
//!
//! The bound is `f = f_c + (f_s + k_s·|τ_load|)·exp(−(q̇/v_s)²) + k(P)·|τ_load| ± a`: Coulomb, the extra grip
//! at rest (Stribeck, in the form of Armstrong-Hélouvry, Dupont, Canudas de Wit, Automatica 30, 1994; part of
//! it may grow with the load), a share of the torque that the gear passes on (different when it drives the
//! load and when the load drives it: a gear's two efficiencies), and a part that changes sign with the
//! direction.
//!
//! Below the bound the joint hangs on a bristle (Dahl, "A solid friction model", 1968, with Coulomb's bound):
//! a spring of stiffness `f / presliding` that is dragged along once the bound is reached. It holds a load
//! without creep, never gives more than its bound while sliding, and dissipates. Smoothed: a reversal takes
//! two presliding ways instead of none.

use caudata_model::{Joint, JointMotion};

use super::{ImplicitTorque, ServoDrive};
use crate::real::Real;

/// Nominal deflection at which friction of a hinge starts to slide, rad (0.11°; a gear train's presliding is of
/// this size).
const PRESLIDING_RAD: f64 = 0.002;

/// The same of a slide, m: a ball guide is a linear spring below 0.1 µm and rolls as ever from 100 µm on (Futami,
/// Furutani, J. Japan Soc. Precision Engineering 57, 1991, 1808).
const PRESLIDING_M: f64 = 100e-6;

/// Nominal deflection at which friction of `joint` starts to slide, rad or m.
pub fn presliding_rad(joint: &Joint) -> f64 {
    match joint.motion {
        JointMotion::Hinge => PRESLIDING_RAD,
        JointMotion::Slide => PRESLIDING_M,
    }
}

/// The shortest way over which friction of bound `bound_nm` can spring in steps of `dt_s`, on a joint that
/// accelerates by `per_inertia` per torque, rad or m. Over a shorter one the joint would not stick after a step
/// that turned it round, and friction would push it.
pub fn least_presliding_rad(bound_nm: f64, per_inertia: f64, dt_s: f64) -> f64 {
    (dt_s + BRISTLE_DAMPING_S) * dt_s * bound_nm * per_inertia
}

/// Damping of the bristle as a time: it feels where it would be that much later. Without it a joint that
/// friction should hold rings on its bristle, the more the smaller the step, and creeps; with much more,
/// friction acts ahead of time at every reversal.
const BRISTLE_DAMPING_S: f64 = 0.02;

/// Speed over which the load share fades from one direction of power to the other, rad/s: a loaded joint at
/// rest has the mean of both.
const POWER_FADE_RADPS: f64 = 0.02;

/// Beyond e^−40 the Stribeck part is nothing; larger arguments only underflow.
const MAX_EXPONENT: f64 = 40.0;

/// Stribeck's extra friction at speed `qd_radps`, N·m.
#[inline(always)]
pub fn stribeck_nm<R: Real>(p: &ServoDrive<R>, qd_radps: R) -> R {
    p.stribeck_nm * at_rest_share(p, qd_radps)
}

/// What is left of the grip at rest at speed `qd_radps`: 1 at rest.
#[inline(always)]
fn at_rest_share<R: Real>(p: &ServoDrive<R>, qd_radps: R) -> R {
    let x = qd_radps * p.per_stribeck_speed_s_per_rad;
    let exponent = (x * x).min(R::splat(MAX_EXPONENT));
    (-exponent).exp()
}

/// Extra friction at rest from the torque that passes through the joint to its load, N·m.
#[inline(always)]
pub fn load_stribeck_nm<R: Real>(p: &ServoDrive<R>, load_nm: R, qd_radps: R) -> R {
    load_nm.abs() * p.load_stribeck * at_rest_share(p, qd_radps)
}

/// Friction from the torque that passes through the joint to its load, N·m.
#[inline(always)]
pub fn load_friction_nm<R: Real>(p: &ServoDrive<R>, load_nm: R, qd_radps: R) -> R {
    let power = qd_radps * load_nm.signum0() * R::splat(1.0 / POWER_FADE_RADPS);
    let driving = power.clamp(-R::one(), R::one());
    load_nm.abs() * (p.load_friction_mean + p.load_friction_half_difference * driving)
}

/// The part of the bound that depends on the direction, N·m: `asymmetry` towards positive, its opposite
/// towards negative, in between in proportion to the bristle.
#[inline(always)]
pub fn asymmetry_nm<R: Real>(p: &ServoDrive<R>, bristle_rad: R, presliding_rad: R) -> R {
    let direction = (bristle_rad / presliding_rad).clamp(-R::one(), R::one());
    p.friction_asymmetry_nm * direction
}

/// Friction torque of bound `bound_nm` (≥ 0) at velocity `qd_radps` and bristle deflection `bristle_rad`, for
/// a step of `dt_s`.
#[inline(always)]
pub fn bristle_torque<R: Real>(
    bound_nm: R,
    presliding_rad: R,
    qd_radps: R,
    bristle_rad: R,
    dt_s: R,
) -> ImplicitTorque<R> {
    let soon_s = R::splat(BRISTLE_DAMPING_S);
    let ahead = bristle_rad + (dt_s + soon_s) * qd_radps;
    let sticks = ahead.abs().le(presliding_rad);
    let stiffness = R::select(sticks, bound_nm / presliding_rad, R::zero());
    ImplicitTorque {
        now_nm: R::select(sticks, -(stiffness * bristle_rad), -(bound_nm * ahead.signum0())),
        stiffness_nm_per_rad: stiffness,
        damping_nms_per_rad: stiffness * soon_s,
        inertia_kgm2: R::zero(),
    }
}

/// Bristle deflection after the joint moved by `moved_rad`, rad.
#[inline(always)]
pub fn drag_bristle<R: Real>(bristle_rad: R, moved_rad: R, presliding_rad: R) -> R {
    (bristle_rad + moved_rad).clamp(-presliding_rad, presliding_rad)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn near(got: f64, want: f64) {
        assert!((got - want).abs() < 1e-9, "got {got}, want {want}");
    }

    #[test]
    fn sticks_then_slides_at_its_bound() {
        // sticking: 0.04/0.002 = 20 N·m/rad, half deflected: −0.02 N·m
        let t = bristle_torque(0.04, 0.002, 0.0, 0.001, 0.004);
        near(t.stiffness_nm_per_rad, 20.0);
        near(t.now_nm, -0.02);
        // at 1 rad/s the bristle is at its end within the step: constant, against the motion
        let t = bristle_torque(0.04, 0.002, 1.0, 0.001, 0.004);
        assert_eq!((t.stiffness_nm_per_rad, t.now_nm), (0.0, -0.04));
        near(drag_bristle(0.001, 0.004, 0.002), 0.002);
        near(drag_bristle(0.002, -0.001, 0.002), 0.001);
        // no friction, no torque
        let t = bristle_torque(0.0, 0.002, 1.0, 0.001, 0.004);
        assert_eq!((t.stiffness_nm_per_rad, t.now_nm.abs()), (0.0, 0.0));
    }

    #[test]
    fn stribeck_falls_with_speed() {
        let p = ServoDrive {
            stribeck_nm: 0.05,
            per_stribeck_speed_s_per_rad: 1.0 / 0.1,
            ..ServoDrive::default()
        };
        near(stribeck_nm(&p, 0.0), 0.05);
        // exp(−1) at the Stribeck speed, either way round
        near(stribeck_nm(&p, 0.1), 0.05 * 0.367_879_441_171);
        near(stribeck_nm(&p, -0.1), stribeck_nm(&p, 0.1));
        assert!(stribeck_nm(&p, 50.0) < 1e-12);
        // a fifth of 0.5 N·m at rest, either way; 1/e of it at the Stribeck speed
        let p = ServoDrive { load_stribeck: 0.2, ..p };
        near(load_stribeck_nm(&p, -0.5, 0.0), 0.1);
        near(load_stribeck_nm(&p, 0.5, 0.1), 0.1 * 0.367_879_441_171);
    }

    #[test]
    fn load_share_differs_by_the_direction_of_power() {
        // 10 % when driving, 30 % when driven: mean 0.2, half the difference −0.1
        let p = ServoDrive {
            load_friction_mean: 0.2,
            load_friction_half_difference: -0.1,
            ..ServoDrive::default()
        };
        near(load_friction_nm(&p, 1.5, 1.0), 0.15);
        near(load_friction_nm(&p, 1.5, -1.0), 0.45);
        near(load_friction_nm(&p, -1.5, -1.0), 0.15);
        near(load_friction_nm(&p, 1.5, 0.0), 0.3);
        // a quarter of the fade towards driving: 0.2 − 0.025
        near(load_friction_nm(&p, 1.0, 0.005), 0.175);
    }

    #[test]
    fn one_way_is_heavier() {
        let p = ServoDrive { friction_asymmetry_nm: 0.01, ..ServoDrive::default() };
        near(asymmetry_nm(&p, 0.002, 0.002), 0.01);
        near(asymmetry_nm(&p, -0.005, 0.002), -0.01);
        near(asymmetry_nm(&p, 0.001, 0.002), 0.005);
    }
}
