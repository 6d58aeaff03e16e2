//! Springs, dampers and end stops of a hinge.

use super::{ImplicitTorque, JointPassive};
use crate::real::{Mask, Real};
use crate::stop::Stop;

/// A joint's stop, and what tells whether it pushes.
#[derive(Debug, Clone, Copy)]
pub struct StopAt<'a, R> {
    /// Its law.
    pub law: &'a Stop,
    /// How the joint would have accelerated in the last step without its stops, rad/s²: [`free_radps2`].
    pub free_radps2: R,
}

/// Joint spring and end stops at position `q_rad`, velocity `qd_radps`.
#[inline(always)]
pub fn spring_and_stops<R: Real>(
    p: &JointPassive<R>,
    stop: StopAt<'_, R>,
    q_rad: R,
    qd_radps: R,
) -> ImplicitTorque<R> {
    let spring = ImplicitTorque {
        now_nm: p.stiffness_nm_per_rad * (p.spring_rest_rad - q_rad),
        stiffness_nm_per_rad: p.stiffness_nm_per_rad,
        ..ImplicitTorque::none()
    };
    match stops(p, stop, q_rad, qd_radps) {
        Some(push) => spring.plus(push),
        None => spring,
    }
}

/// End stops alone; `None` where no lane is at one, which is most of the time.
#[inline(always)]
fn stops<R: Real>(
    p: &JointPassive<R>,
    stop: StopAt<'_, R>,
    q_rad: R,
    qd_radps: R,
) -> Option<ImplicitTorque<R>> {
    let short = (p.low_rad - q_rad).max(R::zero());
    let beyond = (q_rad - p.high_rad).max(R::zero());
    let touched = R::zero().lt(short + beyond);
    if !touched.any() {
        return None;
    }
    let push = stop.law.torque(beyond - short, qd_radps, stop.free_radps2);
    Some(ImplicitTorque::select(touched, push, ImplicitTorque::none()))
}

/// How the joint would have accelerated without its stops in a step that began at `q_rad`, `qd_radps` and
/// went with `qdd_radps2` to `qd_after_radps`, rad/s²: the stop's torque is taken off, over the inertia that
/// its law reckons with.
#[inline(always)]
pub fn free_radps2<R: Real>(
    p: &JointPassive<R>,
    stop: StopAt<'_, R>,
    q_rad: R,
    qd_radps: R,
    moved_rad: R,
    qd_after_radps: R,
    qdd_radps2: R,
) -> R {
    match stops(p, stop, q_rad, qd_radps) {
        Some(push) => {
            let torque = push.after(moved_rad, qd_after_radps) - push.inertia_kgm2 * qdd_radps2;
            qdd_radps2 - torque * R::splat(stop.law.mobility())
        }
        None => qdd_radps2,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use caudata_model::Softness;

    /// On 0.05 kg·m²: 1/A.
    fn law() -> Stop {
        Stop::new(&Softness::default(), 20.0)
    }

    fn hinge() -> JointPassive<f64> {
        JointPassive {
            stiffness_nm_per_rad: 2.0,
            spring_rest_rad: 0.1,
            low_rad: -0.5,
            high_rad: 0.5,
            ..JointPassive::default()
        }
    }

    fn at(law: &Stop, free_radps2: f64) -> StopAt<'_, f64> {
        StopAt { law, free_radps2 }
    }

    #[test]
    fn inside_the_range_only_the_spring() {
        // 2·(0.1 − 0.3) = −0.4
        let t = spring_and_stops(&hinge(), at(&law(), 0.0), 0.3, 5.0);
        assert!((t.now_nm + 0.4).abs() < 1e-12);
        assert_eq!((t.stiffness_nm_per_rad, t.damping_nms_per_rad), (2.0, 0.0));
    }

    #[test]
    fn beyond_a_stop_it_is_added() {
        // 0.1 rad beyond, at rest: d = 0.95, 19·0.05 kg·m² and 0.95/(0.95·0.02)² = 2631.6 1/s²: −0.95·263.16
        // = −250 N·m; spring 2·(0.1 − 0.6) = −1
        let t = spring_and_stops(&hinge(), at(&law(), 0.0), 0.6, 0.0);
        assert!((t.now_nm + 251.0).abs() < 1e-9, "{t:?}");
        assert!((t.inertia_kgm2 - 0.95).abs() < 1e-12);
        // as far below: the other way
        let t = spring_and_stops(&hinge(), at(&law(), 0.0), -0.6, 0.0);
        assert!((t.now_nm - (250.0 + 1.4)).abs() < 1e-9, "{t:?}");
    }

    /// 1 mrad beyond the law wants −2.632 rad/s² at rest. Pulled back harder than that it does not act: it
    /// never pulls.
    #[test]
    fn it_never_pulls() {
        let t = spring_and_stops(&hinge(), at(&law(), -2.7), 0.501, 0.0);
        assert_eq!(t.inertia_kgm2, 0.0);
        let t = spring_and_stops(&hinge(), at(&law(), -2.6), 0.501, 0.0);
        assert!(t.inertia_kgm2 > 0.9);
    }

    #[test]
    fn what_it_would_have_done_without() {
        // 0.1 rad beyond, at rest before and after, at −10 rad/s²
        let free = free_radps2(&hinge(), at(&law(), 0.0), 0.6, 0.0, 0.0, 0.0, -10.0);
        // torque −250 + 0.95·10 = −240.5; −10 + 240.5·20
        assert!((free - (-10.0 + 4810.0)).abs() < 1e-6, "{free}");
        assert_eq!(free_radps2(&hinge(), at(&law(), 0.0), 0.3, 0.0, 0.0, 0.0, -10.0), -10.0);
    }

    #[test]
    fn no_range_no_stop() {
        let endless = JointPassive { low_rad: -1e6, high_rad: 1e6, ..hinge() };
        let t = spring_and_stops(&endless, at(&law(), 0.0), 900.0, 0.0);
        assert_eq!(t.stiffness_nm_per_rad, 2.0);
    }
}
