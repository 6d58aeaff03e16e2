//! Play and compliance between motor and joint: the rotor is a body of its own.
//!
//! The rotor (the joint's armature, seen at the joint) hangs on the joint by a gear with a gap of ± h and
//! teeth of stiffness k and damping d: inside the gap nothing is passed on, beyond it
//! `τ = k·(x ∓ h) + d·(ω − q̇)` with x = θ − q. Friction and viscous damping sit on the rotor's side, where
//! most of a gear train is: within the gap the output moves freely, and the width of the free travel does not
//! depend on load. Where the encoder sits on the output (as in the XM430), the position loop sees q, and play
//! makes it hunt; where it sits on the motor, loop and log see θ and ω, and the joint follows unseen.
//! Back-EMF and envelope see ω. h = 0 leaves a compliant gear.
//!
//! Teeth are stiff and the rotor is light (1000 N·m/rad on 0.0022 kg·m²: 674 rad/s), so rotor and teeth are
//! taken implicitly together: backward Euler of the rotor gives ω⁺ = a₀ + a₁·q̇⁺, which turns the gear's
//! torque into a constant and a damper on the joint. With infinitely stiff teeth that damper is J/dt: the
//! rotor's inertia as if it were bolted to the joint. Stable at any step.

use super::{ImplicitTorque, ServoDrive};
use crate::real::Real;

/// Stiffness of gear teeth where a gap is asked for and no stiffness, N·m/rad: 1 N·m bends them by 1 mrad, a
/// quarter of the servo's play.
pub const TOOTH_STIFFNESS_NM_PER_RAD: f64 = 1000.0;

/// Nominal damping ratio of rotor on teeth: metal gears ring for one or two periods.
pub const TOOTH_DAMPING_RATIO: f64 = 0.3;

/// What the gear does in one step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GearStep<R> {
    /// Torque on the joint.
    pub torque: ImplicitTorque<R>,
    /// a₀: rotor speed at the end of the step with the joint at rest, rad/s.
    pub speed_radps: R,
    /// a₁: rotor speed per joint speed.
    pub speed_per_speed: R,
}

impl<R: Real> GearStep<R> {
    /// Rotor speed at the end of the step, rad/s.
    #[inline(always)]
    pub fn rotor_radps(&self, qd_radps: R) -> R {
        self.speed_radps + self.speed_per_speed * qd_radps
    }
}

/// One step of rotor and teeth. `lead_rad`: rotor ahead of the joint (x = θ − q); `rotor_radps`, `qd_radps`:
/// their speeds; `motor_nm`: motor torque; `drag`: friction and damping on the rotor.
#[inline(always)]
pub fn step<R: Real>(
    p: &ServoDrive<R>,
    lead_rad: R,
    rotor_radps: R,
    qd_radps: R,
    motor_nm: R,
    drag: &ImplicitTorque<R>,
    dt_s: R,
) -> GearStep<R> {
    let inertia = p.rotor_kgm2;
    let momentum = inertia * rotor_radps + dt_s * (motor_nm + drag.now_nm);
    let held = inertia + dt_s * (dt_s * drag.stiffness_nm_per_rad + drag.damping_nms_per_rad);
    // Teeth touch where they will be at the end of the step if they do not.
    let ahead = lead_rad + dt_s * (momentum / held - qd_radps);
    let touch = p.gear_half_gap_rad.lt(ahead.abs());
    let bent = lead_rad - p.gear_half_gap_rad * ahead.signum0();
    let spring = R::select(touch, p.gear_stiffness_nm_per_rad * bent, R::zero());
    let coupling = R::select(
        touch,
        dt_s * p.gear_stiffness_nm_per_rad + p.gear_damping_nms_per_rad,
        R::zero(),
    );
    let per_all = R::one() / (held + dt_s * coupling);
    let speed = (momentum - dt_s * spring) * per_all;
    let share = dt_s * coupling * per_all;
    GearStep {
        torque: ImplicitTorque {
            now_nm: spring + coupling * speed,
            stiffness_nm_per_rad: R::zero(),
            damping_nms_per_rad: coupling * (R::one() - share),
            inertia_kgm2: R::zero(),
        },
        speed_radps: speed,
        speed_per_speed: share,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const DT: f64 = 0.002;

    fn geared(half_gap: f64, stiffness: f64) -> ServoDrive<f64> {
        ServoDrive {
            rotor_kgm2: 0.0022,
            gear_half_gap_rad: half_gap,
            gear_stiffness_nm_per_rad: stiffness,
            gear_damping_nms_per_rad: 2.0 * 0.3 * (stiffness * 0.0022).sqrt(),
            ..ServoDrive::default()
        }
    }

    /// Rotor and a joint of inertia `inertia` under their torques for `steps`, from (θ, ω, q, q̇) = `at`.
    fn run(
        p: &ServoDrive<f64>,
        inertia: f64,
        motor: impl Fn(usize) -> f64,
        load: f64,
        mut at: [f64; 4],
        steps: usize,
        mut each: impl FnMut([f64; 4]),
    ) -> [f64; 4] {
        for k in 0..steps {
            let [theta, w, q, qd] = at;
            let g = step(p, theta - q, w, qd, motor(k), &ImplicitTorque::none(), DT);
            let qd = (inertia * qd + DT * (load + g.torque.now_nm))
                / (inertia + DT * g.torque.damping_nms_per_rad);
            let w = g.rotor_radps(qd);
            at = [theta + DT * w, w, q + DT * qd, qd];
            each(at);
        }
        at
    }

    #[test]
    fn in_the_gap_nothing_is_passed_on() {
        let g = step(&geared(0.01, 1000.0), 0.002, 0.0, 0.0, 0.0, &ImplicitTorque::none(), DT);
        assert_eq!(g.torque, ImplicitTorque::none());
        assert_eq!((g.speed_radps, g.speed_per_speed), (0.0, 0.0));
    }

    #[test]
    fn infinitely_stiff_teeth_add_the_rotors_inertia() {
        // J/dt = 1.1 N·m·s/rad, and the rotor goes with the joint
        let g = step(&geared(0.0, 1e9), 1e-9, 0.0, 0.0, 0.0, &ImplicitTorque::none(), DT);
        assert!((g.torque.damping_nms_per_rad - 1.1).abs() < 1e-5);
        assert!((g.speed_per_speed - 1.0).abs() < 1e-5);
    }

    #[test]
    fn free_travel_is_the_gap_whatever_the_load() {
        // a load presses the joint against one flank, then the other; the rotor is held by friction far
        // beyond the loads
        for load in [0.02, 0.2] {
            let p = ServoDrive { rotor_kgm2: 1e3, ..geared(0.01, 1000.0) };
            let one = run(&p, 0.01, |_| 0.0, load, [0.0; 4], 2000, |_| ());
            let other = run(&p, 0.01, |_| 0.0, -load, one, 4000, |_| ());
            // 2h and the teeth's bend on each side
            let want = 0.02 + 2.0 * load / 1000.0;
            assert!(((one[2] - other[2]) - want).abs() < 2e-5, "{load}: {}", one[2] - other[2]);
        }
    }

    #[test]
    fn a_motor_pushes_rotor_and_load_as_one() {
        // 0.1 N·m on 0.0022 + 0.0078 kg·m²: 10 rad/s² once the gap of 0.005 rad is closed
        let end = run(&geared(0.005, 1000.0), 0.0078, |_| 0.1, 0.0, [0.0; 4], 500, |_| ());
        assert!((end[3] - 10.0).abs() < 0.05, "{}", end[3]); // after 1 s
        // behind by the gap and the bend 0.1·0.0078/0.01/1000
        assert!((end[0] - end[2] - 0.005_078).abs() < 1e-5);
    }

    #[test]
    fn compliance_bends_in_proportion_and_rings_at_its_frequency() {
        // rotor held (very heavy), joint 0.01 kg·m² on 100 N·m/rad without damping: 100 rad/s, period 62.8 ms
        let p = ServoDrive {
            rotor_kgm2: 1e4,
            gear_half_gap_rad: 0.0,
            gear_stiffness_nm_per_rad: 100.0,
            gear_damping_nms_per_rad: 0.0,
            ..ServoDrive::default()
        };
        let mut signs = Vec::new();
        run(
            &p,
            0.01,
            |_| 0.0,
            0.0,
            [0.0, 0.0, 0.01, 0.0],
            100,
            |at| {
                signs.push(at[2] > 0.0);
            },
        );
        let crossings: Vec<usize> =
            (1..signs.len()).filter(|&k| signs[k] != signs[k - 1]).collect();
        // implicit Euler damps it; the first half periods still show the frequency
        let half = (crossings[1] - crossings[0]) as f64 * DT;
        assert!((half - 0.0314).abs() < 0.0021, "half period {half}");
    }

    #[test]
    fn an_impact_on_the_teeth_gains_no_energy() {
        let p = geared(0.01, 1000.0);
        let mut most = 0.0_f64;
        let energy = |at: [f64; 4]| 0.5 * 0.0022 * at[1] * at[1] + 0.5 * 0.005 * at[3] * at[3];
        let start = [0.0, 3.0, 0.0, -1.0];
        let end = run(&p, 0.005, |_| 0.0, 0.0, start, 2000, |at| most = most.max(energy(at)));
        assert!(most <= energy(start) * (1.0 + 1e-9), "{most}");
        // they end up together: (0.0022·3 − 0.005)/0.0072 = 0.2222 rad/s, on average
        let common = (0.0022 * end[1] + 0.005 * end[3]) / 0.0072;
        assert!((common - 0.222_222).abs() < 1e-6, "momentum is kept: {common}");
    }
}
