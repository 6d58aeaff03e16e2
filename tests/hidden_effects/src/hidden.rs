//! What can be hidden: effects of the catalogue, as physics in the truth, and laws that the catalogue does not have.
//!
//! `size` grows with the effect and is 0 where there is none; what it means is in each row.

use caudata_model::RobotModel;

use crate::truth::sensors::Sensing;
use crate::truth::spec::Spec;

/// A robot, its sensors, and what its log says about it.
#[derive(Clone, Debug)]
pub struct World {
    /// The robot.
    pub spec: Spec,
    /// What is read of it.
    pub sensing: Sensing,
    /// Supply that `log.toml` gives; `None`: the true one.
    pub declared_supply_v: Option<f64>,
    /// What the battery loses from the first run to the held-out ones, V.
    pub drained_v: f64,
}

/// How an effect is placed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Scope {
    /// At one joint.
    Joint,
    /// At the robot as a whole.
    Global,
    /// At the robot as a whole, and only with several joints.
    Chain,
}

/// Where a true parameter ends up.
#[derive(Clone, Copy, Debug)]
pub struct TrueParameter {
    /// Words of which a reported parameter's name must have one (they name the quantity, not a spelling).
    pub names: &'static [&'static str],
    /// Unit.
    pub unit: &'static str,
    /// True value.
    pub value: f64,
    /// Value without the effect: errors are shares of the distance from it.
    pub nominal: f64,
}

/// One effect that can be hidden.
pub struct Hidden {
    /// Id of the catalogue; laws outside it have a name that is in no catalogue.
    pub id: &'static str,
    /// Layer of the catalogue; of a law outside it, the layer where it acts.
    pub layer: &'static str,
    /// Where.
    pub scope: Scope,
    /// First guess and largest plausible size.
    pub sizes: (f64, f64),
    /// Whether the sign may be turned round.
    pub signed: bool,
    /// Puts it into the world.
    pub apply: fn(&mut World, &RobotModel, usize, f64),
    /// What a perfect diagnosis would report.
    pub truth: fn(&World, &RobotModel, usize) -> Vec<TrueParameter>,
    /// Ids that the same data fit exactly as well (on a rig with one joint, on one with several).
    pub equivalent: (&'static [&'static str], &'static [&'static str]),
}

/// On a rig with one joint (effect, what fits exactly as well, beside what): of a hanging link two numbers show, its moment of gravity and its inertia about the
/// hinge, and where an inertia is free only the first tells a mass from its centre.
const EQUIVALENT_BESIDE: &[(&str, &str, &[&str])] = &[
    ("link_mass", "link_com", &["link_inertia", "armature"]),
    ("link_com", "link_mass", &["link_inertia", "armature"]),
];

impl Hidden {
    /// Ids that the same data fit exactly as well where one of those is named too that they come with, on a rig with `joints` joints where the effects `hidden` are
    /// hidden: (id, named too).
    #[must_use]
    pub fn same_beside(&self, joints: usize, hidden: &[&str]) -> Vec<(&'static str, &'static str)> {
        let rows = EQUIVALENT_BESIDE.iter();
        let here = |(id, _, beside): &&(&str, &str, &[&str])| {
            joints == 1 && *id == self.id && beside.iter().any(|b| hidden.contains(b))
        };
        rows.filter(here)
            .flat_map(|(_, same, beside)| beside.iter().map(|b| (*same, *b)))
            .collect()
    }
}

const NONE: (&[&str], &[&str]) = (&[], &[]);

fn one(
    names: &'static [&'static str],
    unit: &'static str,
    value: f64,
    nominal: f64,
) -> Vec<TrueParameter> {
    vec![TrueParameter {
        names,
        unit,
        value,
        nominal,
    }]
}

/// Where the first link beyond joint `a` has its centre of mass, as a direction from the joint, link frame.
fn outward(model: &RobotModel, a: usize) -> (usize, [f64; 3]) {
    let link = Spec::link_of(model, a);
    let joint = &model.joints()[model.actuated()[a]];
    let r = caudata_model::pose::sub(model.links()[link].com_m, joint.anchor_m);
    let size = caudata_model::pose::norm(r).max(1e-9);
    (link, r.map(|x| x / size))
}

macro_rules! joint {
    ($w:ident, $a:ident) => {
        $w.spec.joints[$a]
    };
}

/// Every effect of the catalogue that the truth on a stand can hide.
pub const CATALOGUE: &[Hidden] = &[
    Hidden {
        id: "encoder_offset",
        layer: "sensing",
        scope: Scope::Joint,
        sizes: (0.03, 0.15),
        signed: true,
        apply: |w, _, a, s| joint!(w, a).encoder_offset_rad += s,
        truth: |w, _, a| {
            one(
                &["offset", "bias"],
                "rad",
                joint!(w, a).encoder_offset_rad,
                0.0,
            )
        },
        equivalent: (&["floor_slope"], &[]),
    },
    Hidden {
        id: "encoder_gain",
        layer: "sensing",
        scope: Scope::Joint,
        sizes: (0.015, 0.05),
        signed: true,
        apply: |w, _, a, s| joint!(w, a).encoder_gain += s,
        truth: |w, _, a| one(&["gain", "scale"], "", joint!(w, a).encoder_gain, 0.0),
        equivalent: NONE,
    },
    Hidden {
        id: "velocity_lag",
        layer: "sensing",
        scope: Scope::Joint,
        sizes: (0.005, 0.08),
        signed: false,
        apply: |w, _, a, s| w.sensing.servos[a].velocity_lag_s += s,
        truth: |w, _, a| {
            one(
                &["lag", "tau", "time"],
                "s",
                w.sensing.servos[a].velocity_lag_s,
                0.0,
            )
        },
        equivalent: NONE,
    },
    Hidden {
        id: "current_bias",
        layer: "sensing",
        scope: Scope::Joint,
        sizes: (0.02, 0.1),
        signed: true,
        apply: |w, _, a, s| w.sensing.servos[a].current_bias_a += s,
        truth: |w, _, a| {
            one(
                &["bias", "offset"],
                "A",
                w.sensing.servos[a].current_bias_a,
                0.0,
            )
        },
        equivalent: NONE,
    },
    Hidden {
        id: "command_delay",
        layer: "timing",
        scope: Scope::Global,
        sizes: (0.003, 0.06),
        signed: false,
        apply: |w, _, _, s| w.spec.command_delay_s += s,
        truth: |w, _, _| one(&["delay"], "s", w.spec.command_delay_s, 0.0),
        equivalent: (&["measurement_delay", "bus_skew"], &["measurement_delay"]),
    },
    Hidden {
        id: "measurement_delay",
        layer: "timing",
        scope: Scope::Global,
        sizes: (0.003, 0.06),
        signed: false,
        apply: |w, _, _, s| w.sensing.measurement_delay_s += s,
        truth: |w, _, _| one(&["delay"], "s", w.sensing.measurement_delay_s, 0.0),
        equivalent: (&["command_delay", "bus_skew"], &["command_delay"]),
    },
    Hidden {
        id: "bus_skew",
        layer: "timing",
        scope: Scope::Chain,
        sizes: (0.002, 0.006),
        signed: false,
        apply: |w, _, _, s| w.spec.skew_s += s,
        truth: |w, _, _| one(&["skew", "per_joint", "delay"], "s", w.spec.skew_s, 0.0),
        equivalent: NONE,
    },
    Hidden {
        id: "dropped_frames",
        layer: "timing",
        scope: Scope::Global,
        sizes: (0.05, 0.6),
        signed: false,
        apply: |w, _, _, s| w.spec.command_loss = ((w.spec.command_loss.0 + s).min(0.8), 3.0),
        truth: |w, _, _| one(&["share", "prob", "loss"], "", w.spec.command_loss.0, 0.0),
        equivalent: NONE,
    },
    Hidden {
        id: "clock_drift",
        layer: "timing",
        scope: Scope::Global,
        sizes: (0.0003, 0.004),
        signed: false,
        apply: |w, _, _, s| w.sensing.clock_drift += s,
        truth: |w, _, _| one(&["drift", "rate", "ppm"], "", w.sensing.clock_drift, 0.0),
        equivalent: NONE,
    },
    Hidden {
        id: "command_low_pass",
        layer: "timing",
        scope: Scope::Joint,
        sizes: (0.004, 0.12),
        signed: false,
        apply: |w, _, a, s| joint!(w, a).low_pass_s += s,
        truth: |w, _, a| {
            one(
                &["low_pass", "tau", "time"],
                "s",
                joint!(w, a).low_pass_s,
                0.0,
            )
        },
        equivalent: NONE,
    },
    Hidden {
        id: "profile_limit",
        layer: "timing",
        scope: Scope::Joint,
        // the speed limit is 12·e^(−size) rad/s
        sizes: (1.0, 3.5),
        signed: false,
        apply: |w, _, a, s| joint!(w, a).profile_speed_radps = 12.0 * (-s).exp(),
        truth: |w, _, a| {
            one(
                &["speed", "velocity"],
                "rad/s",
                joint!(w, a).profile_speed_radps,
                0.0,
            )
        },
        equivalent: NONE,
    },
    Hidden {
        id: "servo_loop_delay",
        layer: "timing",
        scope: Scope::Joint,
        sizes: (0.002, 0.02),
        signed: false,
        apply: |w, _, a, s| joint!(w, a).loop_delay_s += s,
        truth: |w, _, a| {
            one(
                &["delay", "lag", "time"],
                "s",
                joint!(w, a).loop_delay_s,
                0.0,
            )
        },
        equivalent: NONE,
    },
    Hidden {
        id: "kp_error",
        layer: "actuation",
        scope: Scope::Joint,
        // kp·e^size
        sizes: (0.1, 0.7),
        signed: true,
        apply: |w, _, a, s| joint!(w, a).kp_nm_per_rad *= s.exp(),
        truth: |w, m, a| {
            one(
                &["kp", "scale", "ratio"],
                "N·m/rad",
                joint!(w, a).kp_nm_per_rad,
                m.kp_nm_per_rad(),
            )
        },
        equivalent: (&["stale_gains"], &["stale_gains"]),
    },
    Hidden {
        id: "kd_error",
        layer: "actuation",
        scope: Scope::Joint,
        sizes: (0.05, 1.0),
        signed: false,
        apply: |w, _, a, s| joint!(w, a).kd_nms_per_rad += s,
        truth: |w, m, a| {
            one(
                &["kd", "extra", "scale"],
                "N·m·s/rad",
                joint!(w, a).kd_nms_per_rad,
                m.kd_nm_s_per_rad(),
            )
        },
        equivalent: NONE,
    },
    Hidden {
        id: "integral_action",
        layer: "actuation",
        scope: Scope::Joint,
        sizes: (3.0, 120.0),
        signed: false,
        apply: |w, _, a, s| joint!(w, a).ki_nm_per_rad_s += s,
        truth: |w, _, a| {
            one(
                &["ki", "gain"],
                "N·m/(rad·s)",
                joint!(w, a).ki_nm_per_rad_s,
                0.0,
            )
        },
        equivalent: NONE,
    },
    Hidden {
        id: "torque_constant",
        layer: "actuation",
        scope: Scope::Joint,
        // a weaker magnet: less torque per ampere and less back-EMF, e^−size
        sizes: (0.1, 0.4),
        signed: true,
        apply: |w, _, a, s| {
            joint!(w, a).kt_nm_per_a *= (-s).exp();
            joint!(w, a).ke_vs_per_rad *= (-s).exp();
        },
        truth: |w, m, a| {
            let ratio = joint!(w, a).kt_nm_per_a / m.servo(a).torque_per_current_nm_per_a;
            one(&["kt", "scale", "ratio", "constant"], "", ratio, 1.0)
        },
        equivalent: NONE,
    },
    Hidden {
        id: "winding_resistance",
        layer: "actuation",
        scope: Scope::Joint,
        // R·e^size
        sizes: (0.1, 0.5),
        signed: true,
        apply: |w, _, a, s| joint!(w, a).resistance_ohm *= s.exp(),
        truth: |w, _, a| {
            let p = &joint!(w, a);
            let nominal_ohm = p.volt_per_nm * p.kt_nm_per_a;
            one(
                &["resistance", "winding", "scale", "ratio"],
                "",
                p.resistance_ohm / nominal_ohm,
                1.0,
            )
        },
        equivalent: NONE,
    },
    Hidden {
        id: "torque_limit",
        layer: "actuation",
        scope: Scope::Joint,
        // limit·e^−size
        sizes: (0.5, 2.5),
        signed: false,
        apply: |w, _, a, s| joint!(w, a).drive_current_a *= (-s).exp(),
        truth: |w, m, a| {
            let p = &joint!(w, a);
            let limit_nm = p.drive_current_a * m.servo(a).torque_per_current_nm_per_a;
            one(
                &["limit", "scale", "torque"],
                "N·m",
                limit_nm,
                m.servo(a).tau_max_nm,
            )
        },
        equivalent: NONE,
    },
    Hidden {
        id: "voltage_limit",
        layer: "actuation",
        scope: Scope::Joint,
        // duty at most e^−size
        sizes: (0.3, 2.0),
        signed: false,
        apply: |w, _, a, s| joint!(w, a).duty_limit *= (-s).exp(),
        truth: |w, _, a| {
            one(
                &["duty", "scale", "ratio", "limit", "volt"],
                "",
                joint!(w, a).duty_limit,
                1.0,
            )
        },
        equivalent: (&["supply_level"], &[]),
    },
    Hidden {
        id: "supply_sag",
        layer: "actuation",
        scope: Scope::Global,
        sizes: (0.3, 1.5),
        signed: false,
        apply: |w, _, _, s| w.spec.supply_ohm += s,
        truth: |w, _, _| one(&["resistance", "ohm"], "Ω", w.spec.supply_ohm, 0.0),
        equivalent: NONE,
    },
    Hidden {
        id: "supply_level",
        layer: "actuation",
        scope: Scope::Global,
        // volts below what the log says; the voltage is not read
        sizes: (1.5, 7.0),
        signed: false,
        apply: |w, _, _, s| {
            w.declared_supply_v = Some(w.spec.supply_v);
            w.spec.supply_v = (w.spec.supply_v - s).max(3.0);
            w.sensing.log_voltage = false;
        },
        truth: |w, _, _| {
            let nominal = w.declared_supply_v.unwrap_or(w.spec.supply_v);
            one(
                &["supply", "volt", "level", "scale"],
                "V",
                w.spec.supply_v,
                nominal,
            )
        },
        equivalent: (&["voltage_limit"], &[]),
    },
    Hidden {
        id: "controller_dead_band",
        layer: "actuation",
        scope: Scope::Joint,
        sizes: (0.005, 0.05),
        signed: false,
        apply: |w, _, a, s| joint!(w, a).dead_band_rad += s,
        truth: |w, _, a| {
            one(
                &["dead_band", "width"],
                "rad",
                joint!(w, a).dead_band_rad,
                0.0,
            )
        },
        equivalent: NONE,
    },
    Hidden {
        id: "braking_asymmetry",
        layer: "actuation",
        scope: Scope::Joint,
        // braking limit·e^−size
        sizes: (1.0, 4.0),
        signed: false,
        apply: |w, _, a, s| joint!(w, a).brake_current_a *= (-s).exp(),
        truth: |w, m, a| {
            let p = &joint!(w, a);
            let ratio = p.brake_current_a * m.servo(a).torque_per_current_nm_per_a
                / m.servo(a).tau_brake_max_nm;
            one(&["brake", "scale", "ratio"], "", ratio, 1.0)
        },
        equivalent: NONE,
    },
    Hidden {
        id: "coulomb_friction",
        layer: "transmission",
        scope: Scope::Joint,
        sizes: (0.02, 0.3),
        signed: false,
        apply: |w, _, a, s| joint!(w, a).coulomb_nm += s,
        truth: |w, m, a| {
            let nominal = m.joints()[m.actuated()[a]].friction_loss_nm;
            one(
                &["coulomb", "friction", "extra"],
                "N·m",
                joint!(w, a).coulomb_nm,
                nominal,
            )
        },
        equivalent: NONE,
    },
    Hidden {
        id: "viscous_friction",
        layer: "transmission",
        scope: Scope::Joint,
        sizes: (0.02, 0.5),
        signed: false,
        apply: |w, _, a, s| joint!(w, a).viscous_nms_per_rad += s,
        truth: |w, m, a| {
            let nominal = m.joints()[m.actuated()[a]].damping_nm_s_per_rad;
            one(
                &["viscous", "damping", "extra"],
                "N·m·s/rad",
                joint!(w, a).viscous_nms_per_rad,
                nominal,
            )
        },
        equivalent: NONE,
    },
    Hidden {
        id: "stribeck_friction",
        layer: "transmission",
        scope: Scope::Joint,
        sizes: (0.02, 0.2),
        signed: false,
        apply: |w, _, a, s| joint!(w, a).stribeck_nm += s,
        truth: |w, _, a| {
            one(
                &["stribeck", "stiction", "extra"],
                "N·m",
                joint!(w, a).stribeck_nm,
                0.0,
            )
        },
        equivalent: NONE,
    },
    Hidden {
        id: "load_dependent_friction",
        layer: "transmission",
        scope: Scope::Joint,
        sizes: (0.05, 0.8),
        signed: false,
        apply: |w, _, a, s| {
            joint!(w, a).load_driving += s;
            joint!(w, a).load_driven += s;
        },
        truth: |w, _, a| one(&["load", "share"], "", joint!(w, a).load_driving, 0.0),
        equivalent: NONE,
    },
    Hidden {
        id: "drive_asymmetry",
        layer: "transmission",
        scope: Scope::Joint,
        sizes: (0.05, 0.9),
        signed: false,
        apply: |w, _, a, s| joint!(w, a).load_driven += s,
        truth: |w, _, a| {
            one(
                &["driven", "difference", "asymmetry"],
                "",
                joint!(w, a).load_driven,
                0.0,
            )
        },
        equivalent: NONE,
    },
    Hidden {
        id: "direction_asymmetry",
        layer: "transmission",
        scope: Scope::Joint,
        sizes: (0.01, 0.3),
        signed: true,
        apply: |w, _, a, s| {
            joint!(w, a).asymmetry_nm += s;
            // friction never drives: the easy way keeps a little
            let least = joint!(w, a).asymmetry_nm.abs() + 0.005;
            joint!(w, a).coulomb_nm = joint!(w, a).coulomb_nm.max(least);
        },
        truth: |w, _, a| {
            one(
                &["asymmetry", "difference"],
                "N·m",
                joint!(w, a).asymmetry_nm,
                0.0,
            )
        },
        equivalent: NONE,
    },
    Hidden {
        id: "pre_sliding",
        layer: "transmission",
        scope: Scope::Joint,
        sizes: (0.01, 0.1),
        signed: false,
        apply: |w, _, a, s| joint!(w, a).presliding_rad += s,
        truth: |w, _, a| {
            one(
                &["presliding", "way", "deflection"],
                "rad",
                joint!(w, a).presliding_rad,
                0.002,
            )
        },
        equivalent: NONE,
    },
    Hidden {
        id: "gear_backlash",
        layer: "transmission",
        scope: Scope::Joint,
        sizes: (0.004, 0.03),
        signed: false,
        apply: |w, _, a, s| joint!(w, a).half_gap_rad += s,
        truth: |w, _, a| {
            let half = joint!(w, a).half_gap_rad;
            let mut both = one(&["half"], "rad", half, 0.0);
            both.extend(one(&["gap", "width"], "rad", 2.0 * half, 0.0));
            both
        },
        equivalent: NONE,
    },
    Hidden {
        id: "gear_compliance",
        layer: "transmission",
        scope: Scope::Joint,
        // rad per N·m
        sizes: (0.005, 0.1),
        signed: false,
        apply: |w, _, a, s| joint!(w, a).gear_nm_per_rad = 1.0 / s.max(5e-4),
        truth: |w, _, a| {
            let mut both = one(
                &["compliance"],
                "rad/(N·m)",
                1.0 / joint!(w, a).gear_nm_per_rad,
                0.0,
            );
            both.extend(one(
                &["stiffness"],
                "N·m/rad",
                joint!(w, a).gear_nm_per_rad,
                0.0,
            ));
            both
        },
        equivalent: NONE,
    },
    Hidden {
        id: "cogging",
        layer: "transmission",
        scope: Scope::Joint,
        sizes: (0.02, 0.2),
        signed: false,
        apply: |w, _, a, s| {
            joint!(w, a).ripple_nm += s;
            joint!(w, a).ripple_per_turn = 12.0;
            joint!(w, a).ripple_phase_rad = 0.7;
        },
        truth: |w, _, a| one(&["ripple", "amplitude"], "N·m", joint!(w, a).ripple_nm, 0.0),
        equivalent: NONE,
    },
    Hidden {
        id: "friction_drift",
        layer: "transmission",
        scope: Scope::Joint,
        sizes: (0.03, 0.3),
        signed: false,
        apply: |w, _, a, s| joint!(w, a).run_in = (s, 4.0),
        truth: |_, _, _| Vec::new(),
        equivalent: NONE,
    },
    Hidden {
        id: "parallel_spring",
        layer: "structure",
        scope: Scope::Joint,
        sizes: (0.05, 3.0),
        signed: false,
        apply: |w, _, a, s| joint!(w, a).spring_nm_per_rad += s,
        truth: |w, _, a| {
            one(
                &["spring_nm", "stiffness", "spring"],
                "N·m/rad",
                joint!(w, a).spring_nm_per_rad,
                0.0,
            )
        },
        equivalent: NONE,
    },
    Hidden {
        id: "hard_stop",
        layer: "structure",
        scope: Scope::Joint,
        // how much earlier the upper stop comes, rad
        sizes: (0.3, 1.6),
        signed: false,
        apply: |w, _, a, s| joint!(w, a).stops_rad.1 -= s,
        truth: |w, m, a| {
            let nominal = m.joint_limits_rad()[a].1;
            one(
                &["high", "stop", "limit"],
                "rad",
                joint!(w, a).stops_rad.1,
                nominal,
            )
        },
        equivalent: NONE,
    },
    Hidden {
        id: "link_mass",
        layer: "inertia",
        scope: Scope::Joint,
        // m·e^size
        sizes: (0.1, 0.6),
        signed: true,
        apply: |w, m, a, s| w.spec.links[Spec::link_of(m, a)].mass_scale *= s.exp(),
        truth: |w, m, a| {
            one(
                &["mass", "scale", "ratio"],
                "",
                w.spec.links[Spec::link_of(m, a)].mass_scale,
                1.0,
            )
        },
        equivalent: (&["payload"], &[]),
    },
    Hidden {
        id: "link_com",
        layer: "inertia",
        scope: Scope::Joint,
        // metres away from the joint
        sizes: (0.01, 0.04),
        signed: true,
        apply: |w, m, a, s| {
            let (link, out) = outward(m, a);
            for (x, o) in w.spec.links[link].com_offset_m.iter_mut().zip(out) {
                *x += s * o;
            }
        },
        truth: |w, m, a| {
            let (link, out) = outward(m, a);
            let axis = (0..3)
                .max_by(|&i, &j| out[i].abs().total_cmp(&out[j].abs()))
                .unwrap_or(0);
            const NAMES: [&[&str]; 3] = [&["x_m"], &["y_m"], &["z_m"]];
            one(NAMES[axis], "m", w.spec.links[link].com_offset_m[axis], 0.0)
        },
        equivalent: (&["payload"], &[]),
    },
    Hidden {
        id: "link_inertia",
        layer: "inertia",
        scope: Scope::Joint,
        // I·e^size
        sizes: (1.0, 3.0),
        signed: false,
        apply: |w, m, a, s| w.spec.links[Spec::link_of(m, a)].inertia_scale *= s.exp(),
        truth: |w, m, a| {
            one(
                &["inertia", "scale", "ratio"],
                "",
                w.spec.links[Spec::link_of(m, a)].inertia_scale,
                1.0,
            )
        },
        equivalent: (&["armature"], &["armature"]),
    },
    Hidden {
        id: "armature",
        layer: "inertia",
        scope: Scope::Joint,
        sizes: (0.001, 0.012),
        signed: false,
        apply: |w, _, a, s| joint!(w, a).rotor_kgm2 += s,
        truth: |w, m, a| {
            let nominal = m.joints()[m.actuated()[a]].armature_kgm2;
            one(
                &["armature", "inertia", "extra"],
                "kg·m²",
                joint!(w, a).rotor_kgm2,
                nominal,
            )
        },
        equivalent: (&["link_inertia"], &["link_inertia"]),
    },
    Hidden {
        id: "floor_slope",
        layer: "inertia",
        scope: Scope::Global,
        // pitch of what the rig stands on, rad
        sizes: (0.03, 0.3),
        signed: true,
        apply: |w, _, _, s| {
            let g = caudata_model::pose::norm(w.spec.gravity_mps2);
            w.spec.gravity_mps2 = [-g * s.sin(), 0.0, -g * s.cos()];
        },
        truth: |w, _, _| {
            let g = w.spec.gravity_mps2;
            one(&["pitch", "slope"], "rad", (-g[0]).atan2(-g[2]), 0.0)
        },
        equivalent: (&["encoder_offset"], &[]),
    },
];

/// Laws that no catalogue entry has.
pub const OUTSIDE: &[Hidden] = &[
    outside(
        "position_dependent_rub",
        "transmission",
        (0.05, 0.6),
        |w, _, a, s| joint!(w, a).rub = (s, 0.25, 0.75),
    ),
    outside(
        "air_drag_of_a_sail",
        "structure",
        (0.01, 0.5),
        |w, _, a, s| joint!(w, a).air_nms2_per_rad2 += s,
    ),
    outside("shaker", "structure", (0.05, 1.0), |w, _, a, s| {
        joint!(w, a).shaker = (s, 3.3)
    }),
    outside(
        "dwell_friction",
        "transmission",
        (0.05, 0.8),
        |w, _, a, s| joint!(w, a).dwell = (s, 1.0),
    ),
    outside(
        "swinging_appendage",
        "structure",
        (0.001, 0.03),
        |w, _, a, s| joint!(w, a).appendage = (s, 3.0, 0.08),
    ),
    outside(
        "hysteretic_cable",
        "structure",
        (0.05, 0.8),
        |w, _, a, s| joint!(w, a).cable = (s, 0.25),
    ),
    outside("stutter", "transmission", (0.1, 1.5), |w, _, a, s| {
        joint!(w, a).stutter = (s, 1.37)
    }),
    outside(
        "gain_grows_with_error",
        "actuation",
        (0.5, 8.0),
        |w, _, a, s| joint!(w, a).kp_growth_per_rad += s,
    ),
    outside(
        "hardening_spring",
        "structure",
        (0.05, 2.0),
        |w, _, a, s| joint!(w, a).spring_cubic_nm_per_rad3 += s,
    ),
    outside(
        "encoder_interpolation",
        "sensing",
        (0.005, 0.06),
        |w, _, a, s| joint!(w, a).encoder_wave_rad += s,
    ),
    outside("bridge_dead_time", "actuation", (0.2, 4.0), |w, _, a, s| {
        joint!(w, a).bridge_drop_v += s
    }),
    outside(
        "gain_follows_supply",
        "actuation",
        (1.0, 6.0),
        |w, _, _, s| {
            // a firmware that does not compensate, on a battery that runs down; the log tells the voltage. (At one voltage it would be what the catalogue calls
            // stale gains.)
            w.spec.gain_follows_supply = true;
            w.drained_v += s;
        },
    ),
];

const fn outside(
    id: &'static str,
    layer: &'static str,
    sizes: (f64, f64),
    apply: fn(&mut World, &RobotModel, usize, f64),
) -> Hidden {
    Hidden {
        id,
        layer,
        scope: Scope::Joint,
        sizes,
        signed: false,
        apply,
        truth: |_, _, _| Vec::new(),
        equivalent: NONE,
    }
}

/// The row of an id, in the catalogue or outside it.
#[must_use]
pub fn find(id: &str) -> Option<&'static Hidden> {
    CATALOGUE.iter().chain(OUTSIDE).find(|h| h.id == id)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeSet;

    #[test]
    fn ids_are_unique_and_sizes_in_order() {
        let ids: BTreeSet<&str> = CATALOGUE.iter().chain(OUTSIDE).map(|h| h.id).collect();
        assert_eq!(ids.len(), CATALOGUE.len() + OUTSIDE.len());
        assert!(OUTSIDE.len() >= 8);
        for h in CATALOGUE.iter().chain(OUTSIDE) {
            assert!(0.0 < h.sizes.0 && h.sizes.0 < h.sizes.1, "{}", h.id);
        }
    }
}
