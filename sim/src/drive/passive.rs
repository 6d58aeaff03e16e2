//! Springs, dampers and end stops of a hinge.
//!
//! A stop is a stiff spring and a damper, both only while it is touched (end stops of 1000 N·m/rad bend by a tenth of a degree under a
//! servo's full torque). Implicit, so it cannot gain energy at any step.

use super::{ImplicitTorque, JointPassive};
use crate::real::Real;

/// Joint spring and end stops at position `q_rad`.
#[must_use]
#[inline(always)]
pub fn spring_and_stops<R: Real>(p: &JointPassive<R>, q_rad: R) -> ImplicitTorque<R> {
    let short = (p.low_rad - q_rad).max(R::zero());
    let beyond = (q_rad - p.high_rad).max(R::zero());
    let touched = R::zero().lt(short + beyond);
    ImplicitTorque {
        now_nm: p.stiffness_nm_per_rad * (p.spring_rest_rad - q_rad)
            + p.stop_stiffness_nm_per_rad * (short - beyond),
        stiffness_nm_per_rad: p.stiffness_nm_per_rad
            + R::select(touched, p.stop_stiffness_nm_per_rad, R::zero()),
        damping_nms_per_rad: R::select(touched, p.stop_damping_nms_per_rad, R::zero()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn hinge() -> JointPassive<f64> {
        JointPassive {
            stiffness_nm_per_rad: 2.0,
            spring_rest_rad: 0.1,
            low_rad: -0.5,
            high_rad: 0.5,
            stop_stiffness_nm_per_rad: 200.0,
            stop_damping_nms_per_rad: 1.0,
            ..JointPassive::default()
        }
    }

    #[test]
    fn inside_the_range_only_the_spring() {
        // 2·(0.1 − 0.3) = −0.4
        let t = spring_and_stops(&hinge(), 0.3);
        assert!((t.now_nm + 0.4).abs() < 1e-12);
        assert_eq!((t.stiffness_nm_per_rad, t.damping_nms_per_rad), (2.0, 0.0));
    }

    #[test]
    fn beyond_a_stop_the_springs_add() {
        // 2·(0.1 − 0.6) − 200·0.1 = −21; below: 2·0.8 + 200·0.2 = 41.6
        let t = spring_and_stops(&hinge(), 0.6);
        assert!((t.now_nm + 21.0).abs() < 1e-12);
        assert_eq!(
            (t.stiffness_nm_per_rad, t.damping_nms_per_rad),
            (202.0, 1.0)
        );
        assert!((spring_and_stops(&hinge(), -0.7).now_nm - 41.6).abs() < 1e-12);
        // moved back by 0.05 rad at 0.1 rad/s: −21 + 202·0.05 − 1·(−0.1)
        assert!((t.after(-0.05, -0.1) - (-21.0 + 10.1 + 0.1)).abs() < 1e-12);
    }

    #[test]
    fn no_range_no_stop() {
        let endless = JointPassive {
            low_rad: -1e6,
            high_rad: 1e6,
            ..hinge()
        };
        assert_eq!(spring_and_stops(&endless, 900.0).stiffness_nm_per_rad, 2.0);
    }
}
