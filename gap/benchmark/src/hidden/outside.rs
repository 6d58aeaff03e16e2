//! Laws that no catalogue entry has.

use super::row::{Hidden, adds, does};

/// Laws that no catalogue entry has.
pub const OUTSIDE: &[Hidden] = &[
    does("position_dependent_rub", "transmission", (0.05, 0.6), |w, _, a, s| {
        w.joint(a).rub = (s, 0.25, 0.75);
    }),
    adds("air_drag_of_a_sail", "structure", (0.01, 0.5), |w, a| &mut w.joint(a).air_nms2_per_rad2),
    does("shaker", "structure", (0.05, 1.0), |w, _, a, s| w.joint(a).shaker = (s, 3.3)),
    does("dwell_friction", "transmission", (0.05, 0.8), |w, _, a, s| w.joint(a).dwell = (s, 1.0)),
    does("swinging_appendage", "structure", (0.001, 0.03), |w, _, a, s| {
        w.joint(a).appendage = (s, 3.0, 0.08);
    }),
    does("hysteretic_cable", "structure", (0.05, 0.8), |w, _, a, s| w.joint(a).cable = (s, 0.25)),
    does("stutter", "transmission", (0.1, 1.5), |w, _, a, s| w.joint(a).stutter = (s, 1.37)),
    adds("gain_grows_with_error", "actuation", (0.5, 8.0), |w, a| {
        &mut w.joint(a).kp_growth_per_rad
    }),
    adds("hardening_spring", "structure", (0.05, 2.0), |w, a| {
        &mut w.joint(a).spring_cubic_nm_per_rad3
    }),
    adds("encoder_interpolation", "sensing", (0.005, 0.06), |w, a| {
        &mut w.joint(a).encoder_wave_rad
    }),
    adds("bridge_dead_time", "actuation", (0.2, 4.0), |w, a| &mut w.joint(a).bridge_drop_v),
    does("gain_follows_supply", "actuation", (1.0, 6.0), |w, _, _, s| {
        // a firmware that does not compensate, on a battery that runs down; the log tells the voltage.
        // (At one voltage it would be what the catalogue calls stale gains.)
        w.spec.gain_follows_supply = true;
        w.drained_v += s;
    }),
];
