//! End stops of joints, as soft as the MJCF says.
//!
//! The law is MuJoCo's (see [`Softness`]), so that both speak of the same stop. Beyond the limit by r, moving
//! out at v: `τ = W·(k·r − b·v − a)` with `W = d(r) / ((1 − d(r))·A)`: a spring, a damper and an inertia W,
//! many times the joint's own, that has to be pushed out of the way. It never pulls. MuJoCo takes r and v at
//! the start of a step and the acceleration a over it; here spring and damper are taken in the middle of it,
//! which has the same limit for small steps and is nearer to it at 2 ms.

use caudata_model::{RobotModel, Softness};

use crate::drive::ImplicitTorque;
use crate::mobility::Mobility;
use crate::real::Real;
use crate::{EngineConfig, SimError};

/// MuJoCo's bounds of an impedance: `mjMINIMP`, `mjMAXIMP`.
const IMPEDANCE: (f64, f64) = (1e-4, 0.9999);

/// The law of one constraint for one step size.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Stop {
    /// k / d(r), 1/s².
    pub stiffness_per_s2: f64,
    /// b, 1/s.
    pub damping_per_s: f64,
    /// d at the limit.
    low: f64,
    /// What it grows by.
    span: f64,
    /// 1 / width, 1/rad.
    per_width: f64,
    /// Share of the width below which the first branch holds: `x·(first.0 + first.1·x)`, beyond
    /// `1 − (1 − x)·(second.0 + second.1·(1 − x))`.
    middle: f64,
    first: (f64, f64),
    second: (f64, f64),
    /// 1/A, kg·m².
    inertia_kgm2: f64,
    /// A, 1/(kg·m²).
    mobility: f64,
}

impl Stop {
    /// Stops of all joints, model order.
    ///
    /// # Errors
    /// Where the robot's inertia is singular.
    pub fn all(model: &RobotModel, config: &EngineConfig) -> Result<Vec<Self>, SimError> {
        let mobility = Mobility::of(model, config)?;
        Ok((model.joints().iter().zip(&mobility.joints))
            .map(|(joint, &inverse)| Self::new(&joint.stop, inverse))
            .collect())
    }

    /// `inverse_inertia`: A, 1/(kg·m²); 0 where nothing moves. Time constants of less than two steps are not
    /// lengthened to two as MuJoCo's `refsafe` does: taken in the middle of the step, they need not be, and
    /// play would open farther in larger steps.
    pub fn new(softness: &Softness, inverse_inertia: f64) -> Self {
        let impedance = |d: f64| d.clamp(IMPEDANCE.0, IMPEDANCE.1);
        let [low, high, width, middle, power] = softness.solimp;
        let (low, high, middle) = (impedance(low), impedance(high), impedance(middle));
        let [time, ratio] = softness.solref;
        let (stiffness_per_s2, damping_per_s) = if time > 0.0 {
            ((high * time * ratio).powi(-2), 2.0 / (high * time))
        } else {
            (-time / (high * high), -ratio / high)
        };
        let (first, second) = if power == 1.0 {
            ((1.0, 0.0), (1.0, 0.0))
        } else {
            ((0.0, 1.0 / middle), (0.0, 1.0 / (1.0 - middle)))
        };
        Self {
            stiffness_per_s2,
            damping_per_s,
            low,
            span: high - low,
            per_width: 1.0 / width.max(1e-9),
            middle,
            first,
            second,
            mobility: inverse_inertia,
            inertia_kgm2: if inverse_inertia > 0.0 { 1.0 / inverse_inertia } else { 0.0 },
        }
    }

    /// The same with a time constant of `1/times`.
    pub fn harder(self, times: f64) -> Self {
        Self {
            stiffness_per_s2: self.stiffness_per_s2 * times * times,
            damping_per_s: self.damping_per_s * times,
            ..self
        }
    }

    /// A: inverse of the inertia that the stop reckons with, 1/(kg·m²).
    pub fn mobility(&self) -> f64 {
        self.mobility
    }

    /// Impedance d at `r` beyond the limit.
    #[inline(always)]
    pub fn impedance<R: Real>(&self, r: R) -> R {
        let s = R::splat;
        let x = (r.abs() * s(self.per_width)).min(R::one());
        let rest = R::one() - x;
        let before = x * s(self.first.1).mul_add(x, s(self.first.0));
        let after = R::one() - rest * s(self.second.1).mul_add(rest, s(self.second.0));
        let y = R::select(x.lt(s(self.middle)), before, after);
        y.mul_add(s(self.span), s(self.low))
    }

    /// The torque at `beyond_rad` past a limit (signed: above the upper one is positive), at `qd_radps`. It
    /// pushes only where the joint would accelerate outwards more than the law wants without it:
    /// `free_radps2`, as it was in the last step.
    #[inline(always)]
    pub fn torque<R: Real>(&self, beyond_rad: R, qd_radps: R, free_radps2: R) -> ImplicitTorque<R> {
        let o = R::zero();
        let half = R::splat(0.5);
        let d = self.impedance(beyond_rad);
        let inertia = d / (R::one() - d) * R::splat(self.inertia_kgm2);
        let spring = d * R::splat(self.stiffness_per_s2);
        let damper = R::splat(self.damping_per_s);
        // wanted acceleration; it is pushed towards the range only
        let wanted = -(spring * beyond_rad + damper * qd_radps);
        let out = R::select(o.lt(beyond_rad), R::one(), -R::one());
        let on = ((wanted - free_radps2) * out).lt(o);
        let weight = R::select(on, inertia, o);
        ImplicitTorque {
            now_nm: -(weight * (spring * beyond_rad + half * damper * qd_radps)),
            stiffness_nm_per_rad: half * weight * spring,
            damping_nms_per_rad: half * weight * damper,
            inertia_kgm2: weight,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// MuJoCo's impedance: 0.9 at the limit, halfway between at half the width, 0.95 from the width on; a
    /// parabola in between.
    #[test]
    fn impedance_grows_over_the_width() {
        let stop = Stop::new(&Softness::default(), 1.0);
        for (r, d) in [
            (0.0, 0.9),
            (0.000_25, 0.906_25),
            (0.0005, 0.925),
            (0.000_75, 0.943_75),
            (0.001, 0.95),
            (-0.02, 0.95),
        ] {
            assert!((stop.impedance(r) - d).abs() < 1e-12, "at {r}");
        }
        let straight = Softness { solimp: [0.9, 0.95, 0.001, 0.5, 1.0], ..Softness::default() };
        let d = Stop::new(&straight, 1.0).impedance(0.000_25);
        assert!((d - 0.9125).abs() < 1e-12);
    }

    /// τ = 20 ms, ζ = 1, d_max = 0.95: b = 2/(0.95·0.02), k = d/(0.95·0.02)²; negative numbers are stiffness
    /// and damping themselves.
    #[test]
    fn reference_is_mujocos() {
        let near = |a: f64, b: f64| assert!((a - b).abs() < 1e-9 * b, "{a} and {b}");
        let stop = Stop::new(&Softness::default(), 1.0);
        near(stop.damping_per_s, 2.0 / 0.019);
        near(stop.stiffness_per_s2, 1.0 / (0.019 * 0.019));
        let direct = Softness { solref: [-1000.0, -50.0], ..Softness::default() };
        let stop = Stop::new(&direct, 1.0);
        near(stop.damping_per_s, 50.0 / 0.95);
        near(stop.stiffness_per_s2, 1000.0 / (0.95 * 0.95));
    }
}
