//! Passive torques of a hinge: spring, damper, Coulomb friction, end stops. Pure; one form for every engine.
//!
//! Everything here is handed to the engine as one linear spring and damper to be taken *implicitly* (backward Euler),
//! plus a constant torque. Implicit because a stop of 200 N·m/rad on a light link is far beyond what an explicit step
//! of 4 ms can follow; the implicit form cannot gain energy at any step.
//!
//! Coulomb friction is a bristle (Dahl, "A solid friction model", 1968, with Coulomb's bound): the joint hangs on a
//! spring of stiffness `friction / PRESLIDING_RAD` that is dragged along once the bound is reached. It holds a load without creep,
//! never gives more than its bound while sliding, and dissipates. What is smoothed: direction reversals take
//! 2 × [`PRESLIDING_RAD`] instead of none.

/// Deflection at which Coulomb friction starts to slide, rad (0.11°; a gear train's presliding is of this size).
pub const PRESLIDING_RAD: f32 = 0.002;

/// Stiffness and damping of end stops.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StopParams {
    /// N·m/rad.
    pub stiffness_nm_per_rad: f32,
    /// N·m·s/rad, only while the stop is touched.
    pub damping_nms_per_rad: f32,
}

impl StopParams {
    /// Stiffness and damping times `factor`.
    #[must_use]
    pub fn times(self, factor: f32) -> Self {
        Self {
            stiffness_nm_per_rad: self.stiffness_nm_per_rad * factor,
            damping_nms_per_rad: self.damping_nms_per_rad * factor,
        }
    }
}

/// Passive properties of one hinge.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PassiveParams {
    /// Spring, N·m/rad.
    pub stiffness_nm_per_rad: f32,
    /// Where the spring is relaxed, rad.
    pub spring_ref_rad: f32,
    /// Viscous damping, N·m·s/rad.
    pub damping_nms_per_rad: f32,
    /// Coulomb friction, N·m.
    pub friction_nm: f32,
    /// End stops, rad; infinite where there are none.
    pub range_rad: (f32, f32),
}

/// A spring `−k·(q − rest)`, a damper `−d·q̇` (both to be taken at the end of the step) and a constant torque.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct ImplicitTorque {
    /// k, N·m/rad.
    pub stiffness_nm_per_rad: f32,
    /// Where the spring is relaxed, rad.
    pub rest_rad: f32,
    /// d, N·m·s/rad.
    pub damping_nms_per_rad: f32,
    /// Constant over the step, N·m.
    pub constant_nm: f32,
}

/// The passive torque of a hinge at position `q_rad`, velocity `qd_radps` and bristle deflection `bristle_rad`, for a step of `dt_s`.
#[must_use]
pub fn passive_torque(
    p: &PassiveParams,
    stop: StopParams,
    q_rad: f32,
    qd_radps: f32,
    bristle_rad: f32,
    dt_s: f32,
) -> ImplicitTorque {
    let mut sum = SpringSum::default();
    sum.add(p.stiffness_nm_per_rad, p.spring_ref_rad);
    let mut damping = p.damping_nms_per_rad;
    let mut constant = 0.0;
    let (low, high) = p.range_rad;
    if q_rad < low || q_rad > high {
        sum.add(stop.stiffness_nm_per_rad, q_rad.clamp(low, high));
        damping += stop.damping_nms_per_rad;
    }
    if p.friction_nm > 0.0 {
        let ahead = bristle_rad + dt_s * qd_radps;
        if ahead.abs() <= PRESLIDING_RAD {
            sum.add(p.friction_nm / PRESLIDING_RAD, q_rad - bristle_rad);
        } else {
            constant = -p.friction_nm * ahead.signum();
        }
    }
    ImplicitTorque {
        stiffness_nm_per_rad: sum.stiffness,
        rest_rad: sum.rest(),
        damping_nms_per_rad: damping,
        constant_nm: constant,
    }
}

/// Bristle deflection after the joint moved by `moved_rad`, rad.
#[must_use]
pub fn drag_bristle(bristle_rad: f32, moved_rad: f32) -> f32 {
    (bristle_rad + moved_rad).clamp(-PRESLIDING_RAD, PRESLIDING_RAD)
}

/// Parallel springs as one.
#[derive(Default)]
struct SpringSum {
    stiffness: f32,
    moment: f32,
}

impl SpringSum {
    fn add(&mut self, stiffness: f32, rest: f32) {
        self.stiffness += stiffness;
        self.moment += stiffness * rest;
    }

    fn rest(&self) -> f32 {
        if self.stiffness > 0.0 {
            self.moment / self.stiffness
        } else {
            0.0
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const STOP: StopParams = StopParams {
        stiffness_nm_per_rad: 200.0,
        damping_nms_per_rad: 1.0,
    };

    fn hinge() -> PassiveParams {
        PassiveParams {
            stiffness_nm_per_rad: 2.0,
            spring_ref_rad: 0.1,
            damping_nms_per_rad: 0.01,
            friction_nm: 0.0,
            range_rad: (-0.5, 0.5),
        }
    }

    #[test]
    fn inside_the_range_spring_and_damper() {
        let t = passive_torque(&hinge(), STOP, 0.3, 1.0, 0.0, 0.004);
        assert_eq!((t.stiffness_nm_per_rad, t.rest_rad), (2.0, 0.1));
        assert_eq!((t.damping_nms_per_rad, t.constant_nm), (0.01, 0.0));
    }

    #[test]
    fn beyond_a_stop_the_springs_add() {
        // k = 2 + 200; rest = (2·0.1 + 200·0.5)/202 = 100.2/202
        let t = passive_torque(&hinge(), STOP, 0.6, 0.0, 0.0, 0.004);
        assert_eq!(t.stiffness_nm_per_rad, 202.0);
        assert!((t.rest_rad - 100.2 / 202.0).abs() < 1e-6);
        assert_eq!(t.damping_nms_per_rad, 1.01);
    }

    #[test]
    fn friction_sticks_then_slides_at_its_bound() {
        let p = PassiveParams {
            stiffness_nm_per_rad: 0.0,
            friction_nm: 0.04,
            ..hinge()
        };
        // sticking: 0.04/0.002 = 20 N·m/rad about q − bristle
        let t = passive_torque(&p, STOP, 0.2, 0.0, 0.001, 0.004);
        assert!((t.stiffness_nm_per_rad - 20.0).abs() < 1e-5);
        assert!((t.rest_rad - 0.199).abs() < 1e-6);
        // at 1 rad/s the bristle is at its end within the step: constant, against the motion
        let t = passive_torque(&p, STOP, 0.2, 1.0, 0.001, 0.004);
        assert_eq!((t.stiffness_nm_per_rad, t.constant_nm), (0.0, -0.04));
        assert_eq!(drag_bristle(0.001, 0.004), PRESLIDING_RAD);
        assert!((drag_bristle(0.002, -0.001) - 0.001).abs() < 1e-9);
    }
}
