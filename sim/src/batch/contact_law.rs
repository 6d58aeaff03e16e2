//! What a contact computes with, and what it leaves behind.

use super::vec3::{V3, add_cross, sub, sym_times, zero3};
use crate::EngineConfig;
use crate::real::Real;
use crate::simd::Lanes;

/// Share of a contact spring's motion over the step that its force sees.
pub(super) const THETA: f64 = 0.5;

/// Constants of the contact law for one step size.
#[derive(Debug, Clone, Copy)]
pub(super) struct ContactLaw<R: Lanes> {
    pub dt: R::Elem,
    /// θ·dt, s.
    pub theta_dt: R::Elem,
    /// MuJoCo's friction instead of the bristle.
    pub convex: bool,
}

impl<R: Lanes> ContactLaw<R> {
    pub fn new(config: &EngineConfig) -> Self {
        let dt = config.dt_s;
        Self { dt: R::elem(dt), theta_dt: R::elem(THETA * dt), convex: config.convex_friction }
    }
}

/// A contact of the current step: force on the robot `f0 − m·Δ`, Δ the acceleration of the point beyond its
/// bias.
#[derive(Debug, Clone, Copy)]
pub(super) struct Touch<R> {
    /// Whether any lane touches.
    pub any: bool,
    /// Touching point from the base's origin, world, m.
    pub arm: V3<R>,
    /// Normal of the ground.
    pub normal: V3<R>,
    /// A: acceleration of the point per force, 1/kg.
    pub give: R,
    /// 1 where a lane touches, 0 elsewhere.
    pub touching: R,
    pub f0: V3<R>,
    /// Symmetric.
    pub m: [R; 6],
}

impl<R: Real> Touch<R> {
    pub fn none() -> Self {
        Self {
            any: false,
            arm: zero3(),
            normal: zero3(),
            give: R::zero(),
            touching: R::zero(),
            f0: zero3(),
            m: [R::zero(); 6],
        }
    }

    /// The force with the body's acceleration beyond its bias, N; and that acceleration of the point, m/s².
    #[inline(always)]
    pub fn force(&self, ang: V3<R>, lin: V3<R>) -> (V3<R>, V3<R>) {
        let a = add_cross(lin, ang, self.arm);
        (sub(self.f0, sym_times(&self.m, a)), a)
    }
}

/// Values that a contact point keeps from step to step: deflection of its bristle, world, m; of the last step
/// the normal force, N, and the acceleration along the normal without it, m/s². With convex friction the
/// first three are that acceleration, world, m/s².
pub(super) const MEMORY: usize = 5;
