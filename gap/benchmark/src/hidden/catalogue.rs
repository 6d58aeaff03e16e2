//! Effects of the catalogue, as physics in the truth.

use caudata_model::RobotModel;

use super::row::{Hidden, Measure, Of, adds, does};
use crate::truth::spec::Spec;

/// Where the first link beyond joint `a` has its centre of mass, as a direction from the joint, link frame.
fn outward(model: &RobotModel, a: usize) -> (usize, [f64; 3]) {
    let link = Spec::link_of(model, a);
    let joint = &model.joints()[model.actuated()[a]];
    let r = caudata_model::pose::sub(model.links()[link].com_m, joint.anchor_m);
    let size = caudata_model::pose::norm(r).max(1e-9);
    (link, r.map(|x| x / size))
}

/// The nominal joint `a`.
fn nominal(model: &RobotModel, a: usize) -> &caudata_model::Joint {
    &model.joints()[model.actuated()[a]]
}

/// Every effect of the catalogue that the truth on a stand can hide.
pub const CATALOGUE: &[Hidden] = &[
    adds("encoder_offset", "sensing", (0.03, 0.15), |w, a| &mut w.joint(a).encoder_offset_rad)
        .signed()
        .sum(&["offset", "bias"], "rad")
        .like(&["floor_slope"], &[]),
    adds("encoder_gain", "sensing", (0.015, 0.05), |w, a| &mut w.joint(a).encoder_gain)
        .signed()
        .sum(&["gain", "scale"], ""),
    adds("velocity_lag", "sensing", (0.005, 0.08), |w, a| &mut w.sensing.servos[a].velocity_lag_s)
        .sum(&["lag", "tau", "time"], "s"),
    adds("current_bias", "sensing", (0.02, 0.1), |w, a| &mut w.sensing.servos[a].current_bias_a)
        .signed()
        .sum(&["bias", "offset"], "A"),
    adds("command_delay", "timing", (0.003, 0.06), |w, _| &mut w.spec.command_delay_s)
        .global()
        .sum(&["delay"], "s")
        .like(&["measurement_delay", "bus_skew"], &["measurement_delay"]),
    adds("measurement_delay", "timing", (0.003, 0.06), |w, _| &mut w.sensing.measurement_delay_s)
        .global()
        .sum(&["delay"], "s")
        .like(&["command_delay", "bus_skew"], &["command_delay"]),
    adds("bus_skew", "timing", (0.002, 0.006), |w, _| &mut w.spec.skew_s)
        .chain()
        .sum(&["skew", "per_joint", "delay"], "s"),
    does("dropped_frames", "timing", (0.05, 0.6), |w, _, _, s| {
        w.spec.command_loss = ((w.spec.command_loss.0 + s).min(0.8), 3.0);
    })
    .global()
    .value(&["share", "prob", "loss"], "", |w, _, _| (w.spec.command_loss.0, 0.0)),
    adds("clock_drift", "timing", (0.0003, 0.004), |w, _| &mut w.sensing.clock_drift)
        .global()
        .sum(&["drift", "rate", "ppm"], ""),
    adds("command_low_pass", "timing", (0.004, 0.12), |w, a| &mut w.joint(a).low_pass_s)
        .sum(&["low_pass", "tau", "time"], "s"),
    // the speed limit is 12·e^(−size) rad/s
    does("profile_limit", "timing", (1.0, 3.5), |w, _, a, s| {
        w.joint(a).profile_speed_radps = 12.0 * (-s).exp();
    })
    .value(&["speed", "velocity"], "rad/s", |w, _, a| (w.spec.joints[a].profile_speed_radps, 0.0)),
    adds("servo_loop_delay", "timing", (0.002, 0.02), |w, a| &mut w.joint(a).loop_delay_s)
        .sum(&["delay", "lag", "time"], "s"),
    // kp·e^size
    does("kp_error", "actuation", (0.1, 0.7), |w, _, a, s| {
        w.joint(a).kp_nm_per_rad *= s.exp();
    })
    .signed()
    .value(&["kp", "scale", "ratio"], "N·m/rad", |w, m, a| {
        (w.spec.joints[a].kp_nm_per_rad, m.kp_nm_per_rad(a))
    })
    .like(&["stale_gains"], &["stale_gains"]),
    adds("kd_error", "actuation", (0.05, 1.0), |w, a| &mut w.joint(a).kd_nms_per_rad).sum_on(
        &["kd", "extra", "scale"],
        "N·m·s/rad",
        |m, a| m.kd_nm_s_per_rad(a),
    ),
    adds("damping_lag", "actuation", (0.002, 0.03), |w, a| &mut w.joint(a).damping_lag_s)
        .sum(&["lag", "delay", "time"], "s"),
    adds("integral_action", "actuation", (3.0, 120.0), |w, a| &mut w.joint(a).ki_nm_per_rad_s)
        .sum(&["ki", "gain"], "N·m/(rad·s)"),
    // a weaker magnet: less torque per ampere and less back-EMF, e^−size
    does("torque_constant", "actuation", (0.1, 0.4), |w, _, a, s| {
        w.joint(a).kt_nm_per_a *= (-s).exp();
        w.joint(a).ke_vs_per_rad *= (-s).exp();
    })
    .signed()
    .value(&["kt", "scale", "ratio", "constant"], "", |w, m, a| {
        (w.spec.joints[a].kt_nm_per_a / m.servo(a).torque_per_current_nm_per_a, 1.0)
    }),
    // R·e^size
    does("winding_resistance", "actuation", (0.1, 0.5), |w, _, a, s| {
        w.joint(a).resistance_ohm *= s.exp();
    })
    .signed()
    .value(&["resistance", "winding", "scale", "ratio"], "", |w, _, a| {
        let p = &w.spec.joints[a];
        (p.resistance_ohm / (p.volt_per_nm * p.kt_nm_per_a), 1.0)
    }),
    // limit·e^−size
    does("torque_limit", "actuation", (0.5, 2.5), |w, _, a, s| {
        w.joint(a).drive_current_a *= (-s).exp();
    })
    .value(&["limit", "scale", "torque"], "N·m", |w, m, a| {
        let limit_nm = w.spec.joints[a].drive_current_a * m.servo(a).torque_per_current_nm_per_a;
        (limit_nm, m.servo(a).tau_max_nm)
    }),
    // duty at most e^−size
    does("voltage_limit", "actuation", (0.3, 2.0), |w, _, a, s| {
        w.joint(a).duty_limit *= (-s).exp();
    })
    .value(&["duty", "scale", "ratio", "limit", "volt"], "", |w, _, a| {
        (w.spec.joints[a].duty_limit, 1.0)
    })
    .like(&["supply_level"], &[]),
    adds("supply_sag", "actuation", (0.3, 1.5), |w, _| &mut w.spec.supply_ohm)
        .global()
        .sum(&["resistance", "ohm"], "Ω"),
    // volts below what the log says; the voltage is not read
    does("supply_level", "actuation", (1.5, 7.0), |w, _, _, s| {
        w.declared_supply_v = Some(w.spec.supply_v);
        w.spec.supply_v = (w.spec.supply_v - s).max(3.0);
        w.sensing.log_voltage = false;
    })
    .global()
    .value(&["supply", "volt", "level", "scale"], "V", |w, _, _| {
        (w.spec.supply_v, w.declared_supply_v.unwrap_or(w.spec.supply_v))
    })
    .like(&["voltage_limit"], &[]),
    adds("controller_dead_band", "actuation", (0.005, 0.05), |w, a| &mut w.joint(a).dead_band_rad)
        .sum(&["dead_band", "width"], "rad"),
    // braking limit·e^−size
    does("braking_asymmetry", "actuation", (1.0, 4.0), |w, _, a, s| {
        w.joint(a).brake_current_a *= (-s).exp();
    })
    .value(&["brake", "scale", "ratio"], "", |w, m, a| {
        let servo = m.servo(a);
        let brake_nm = w.spec.joints[a].brake_current_a * servo.torque_per_current_nm_per_a;
        (brake_nm / servo.tau_brake_max_nm, 1.0)
    }),
    adds("coulomb_friction", "transmission", (0.02, 0.3), |w, a| &mut w.joint(a).coulomb_nm)
        .sum_on(&["coulomb", "friction", "extra"], "N·m", |m, a| nominal(m, a).friction_loss_nm),
    adds("viscous_friction", "transmission", (0.02, 0.5), |w, a| {
        &mut w.joint(a).viscous_nms_per_rad
    })
    .sum_on(&["viscous", "damping", "extra"], "N·m·s/rad", |m, a| {
        nominal(m, a).damping_nm_s_per_rad
    }),
    adds("stribeck_friction", "transmission", (0.02, 0.2), |w, a| &mut w.joint(a).stribeck_nm)
        .sum(&["stribeck", "stiction", "extra"], "N·m"),
    does("load_dependent_friction", "transmission", (0.05, 0.8), |w, _, a, s| {
        w.joint(a).load_driving += s;
        w.joint(a).load_driven += s;
    })
    .value(&["load", "share"], "", |w, _, a| (w.spec.joints[a].load_driving, 0.0)),
    adds("drive_asymmetry", "transmission", (0.05, 0.9), |w, a| &mut w.joint(a).load_driven)
        .sum(&["driven", "difference", "asymmetry"], ""),
    does("direction_asymmetry", "transmission", (0.01, 0.3), |w, _, a, s| {
        let joint = w.joint(a);
        joint.asymmetry_nm += s;
        // friction never drives: the easy way keeps a little
        joint.coulomb_nm = joint.coulomb_nm.max(joint.asymmetry_nm.abs() + 0.005);
    })
    .signed()
    .value(&["asymmetry", "difference"], "N·m", |w, _, a| (w.spec.joints[a].asymmetry_nm, 0.0)),
    adds("pre_sliding", "transmission", (0.01, 0.1), |w, a| &mut w.joint(a).presliding_rad).sum_on(
        &["presliding", "way", "deflection"],
        "rad",
        |_, _| 0.002,
    ),
    adds("gear_backlash", "transmission", (0.004, 0.03), |w, a| &mut w.joint(a).half_gap_rad)
        .sum(&["half"], "rad")
        .or(&["gap", "width"], "rad", |w, _, a| (2.0 * w.spec.joints[a].half_gap_rad, 0.0)),
    // rad per N·m
    does("gear_compliance", "transmission", (0.005, 0.1), |w, _, a, s| {
        w.joint(a).gear_nm_per_rad = 1.0 / s.max(5e-4);
    })
    .value(&["compliance"], "rad/(N·m)", |w, _, a| (1.0 / w.spec.joints[a].gear_nm_per_rad, 0.0))
    .or(&["stiffness"], "N·m/rad", |w, _, a| (w.spec.joints[a].gear_nm_per_rad, 0.0)),
    does("cogging", "transmission", (0.02, 0.2), |w, _, a, s| {
        w.joint(a).ripple_nm += s;
        w.joint(a).ripple_per_turn = 12.0;
        w.joint(a).ripple_phase_rad = 0.7;
    })
    .value(&["ripple", "amplitude"], "N·m", |w, _, a| (w.spec.joints[a].ripple_nm, 0.0)),
    does("friction_drift", "transmission", (0.03, 0.3), |w, _, a, s| w.joint(a).run_in = (s, 4.0)),
    adds("parallel_spring", "structure", (0.05, 3.0), |w, a| &mut w.joint(a).spring_nm_per_rad)
        .sum(&["spring_nm", "stiffness", "spring"], "N·m/rad"),
    // how much earlier the upper stop comes, rad
    does("hard_stop", "structure", (0.3, 1.6), |w, _, a, s| w.joint(a).stops_rad.1 -= s).value(
        &["high", "stop", "limit"],
        "rad",
        |w, m, a| (w.spec.joints[a].stops_rad.1, m.joint_limits_rad()[a].1),
    ),
    // m·e^size
    does("link_mass", "inertia", (0.1, 0.6), |w, m, a, s| {
        w.spec.links[Spec::link_of(m, a)].mass_scale *= s.exp();
    })
    .signed()
    .value(&["mass", "scale", "ratio"], "", |w, m, a| {
        (w.spec.links[Spec::link_of(m, a)].mass_scale, 1.0)
    })
    .like(&["payload"], &[]),
    // metres away from the joint
    does("link_com", "inertia", (0.01, 0.04), |w, m, a, s| {
        let (link, out) = outward(m, a);
        for (x, o) in w.spec.links[link].com_offset_m.iter_mut().zip(out) {
            *x += s * o;
        }
    })
    .signed()
    .reported(Measure {
        names: &["x_m", "y_m", "z_m"],
        unit: "m",
        of: Of::Axis(|w, m, a| {
            let (link, out) = outward(m, a);
            let longest = (0..3).max_by(|&i, &j| out[i].abs().total_cmp(&out[j].abs()));
            let axis = longest.unwrap_or(0);
            (axis, w.spec.links[link].com_offset_m[axis])
        }),
    })
    .like(&["payload"], &[]),
    // I·e^size
    does("link_inertia", "inertia", (1.0, 3.0), |w, m, a, s| {
        w.spec.links[Spec::link_of(m, a)].inertia_scale *= s.exp();
    })
    .value(&["inertia", "scale", "ratio"], "", |w, m, a| {
        (w.spec.links[Spec::link_of(m, a)].inertia_scale, 1.0)
    })
    .like(&["armature"], &["armature"]),
    adds("armature", "inertia", (0.001, 0.012), |w, a| &mut w.joint(a).rotor_kgm2)
        .sum_on(&["armature", "inertia", "extra"], "kg·m²", |m, a| nominal(m, a).armature_kgm2)
        .like(&["link_inertia"], &["link_inertia"]),
    // pitch of what the rig stands on, rad
    does("floor_slope", "inertia", (0.03, 0.3), |w, _, _, s| {
        let g = caudata_model::pose::norm(w.spec.gravity_mps2);
        w.spec.gravity_mps2 = [-g * s.sin(), 0.0, -g * s.cos()];
    })
    .global()
    .signed()
    .value(&["pitch", "slope"], "rad", |w, _, _| {
        let g = w.spec.gravity_mps2;
        ((-g[0]).atan2(-g[2]), 0.0)
    })
    .like(&["encoder_offset"], &[]),
];
