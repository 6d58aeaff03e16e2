//! The battery: what each trial does, and which effects it is made to show.

use super::body::Body;
use super::wave::Wave;

/// How a trial is made.
pub(super) enum Make {
    /// The same for each chosen joint (turned and paced apart).
    Joint(fn(&mut Wave<'_>)),
    /// One motion of the whole robot.
    Body(fn(&mut Body<'_>)),
}

/// How the robot is held.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) enum Place {
    /// Clamped, or hung up by the trunk.
    Stand,
    /// On its feet.
    Ground,
    /// In water.
    Water,
}

/// A row of the battery.
pub(super) struct Recipe {
    pub name: &'static str,
    pub purpose: &'static str,
    pub place: Place,
    pub repeats: usize,
    pub excites: &'static [&'static str],
    pub make: Make,
}

const fn joint(
    name: &'static str,
    purpose: &'static str,
    excites: &'static [&'static str],
    make: fn(&mut Wave<'_>),
) -> Recipe {
    Recipe { name, purpose, place: Place::Stand, repeats: 3, excites, make: Make::Joint(make) }
}

const fn body(
    name: &'static str,
    purpose: &'static str,
    place: Place,
    excites: &'static [&'static str],
    make: fn(&mut Body<'_>),
) -> Recipe {
    Recipe { name, purpose, place, repeats: 3, excites, make: Make::Body(make) }
}

const fn once(mut recipe: Recipe) -> Recipe {
    recipe.repeats = 1;
    recipe
}

fn triangles(w: &mut Wave<'_>, speed_radps: f64, size_rad: f64, cycles: f64) {
    let centre = w.place(0.0);
    w.triangle(centre, size_rad, speed_radps, cycles);
}

fn steps(w: &mut Wave<'_>, centre_rad: f64, size_rad: f64, s: f64) {
    let size = w.reach(centre_rad, size_rad);
    w.go(centre_rad);
    w.hold(0.5);
    for x in [1.0, 0.0, -1.0, 0.0, 1.0, -1.0, 0.0] {
        w.step(centre_rad + w.sign * size * x, s);
    }
}

/// Reversals of so many mrad about a place.
fn micro(w: &mut Wave<'_>, place: f64) {
    let centre = w.place(place);
    w.go(centre);
    for mrad in [1.5, 3.0, 6.0, 12.0] {
        for _ in 0..4 {
            let size = 1e-3 * mrad * w.limits.per_radian;
            w.step(centre + size, 0.15);
            w.step(centre - size, 0.15);
        }
        w.step(centre, 0.2);
    }
}

/// All trials. Effects that a trial is best for come first in its list.
#[rustfmt::skip]
pub(super) const RECIPES: &[Recipe] = &[
    // at rest and in poses: gravity, zeros, droop
    joint("rest", "hold the nominal pose for ten seconds", &["gyro_bias", "imu_tilt", "floor_slope"], |w| w.hold(10.0)),
    joint("holds", "hold nine poses, approached from both sides", &["kp_error", "duty_supply", "encoder_offset", "parallel_spring", "link_mass", "link_com", "point_mass", "payload", "torque_constant", "current_bias", "mocap_frame", "controller_dead_band"], |w| {
        for x in [0.25, 0.5, 0.75, 1.0, 0.5, 0.0, -0.5, -0.75, -1.0, -0.25] { let q = w.place(x); w.go(q); w.hold(1.2); }
    }),
    joint("holds_long", "hold three loaded poses for six seconds each", &["integral_action", "friction_drift", "kp_error"], |w| {
        for x in [0.9, -0.9, 0.5] { let q = w.place(x); w.go(q); w.hold(6.0); }
    }),
    once(joint("hot_hold", "warm the servos for four minutes, then move as in triangle_medium", &["thermal_derating", "friction_drift", "winding_resistance"], |w| {
        let (pose, share) = w.limits.hottest();
        if share > 0.15 { w.go(pose); w.hold(240.0); } else {
            // no gravity on this joint: heat by motion
            let centre = w.place(0.0); let hz = 1.5; let size = w.as_size(w.limits.sine_rad(0.5 * w.limits.per_radian, hz));
            w.sine(centre, size, hz, 240.0);
        }
        triangles(w, 0.5, 0.4, 2.0);
    })),
    joint("staircase", "climb and descend in steps of 40 mrad", &["controller_dead_band", "kp_error", "coulomb_friction", "encoder_gain"], |w| {
        let start = w.place(-0.4); w.go(start);
        let (sign, step) = (w.sign, 0.04 * w.scale * w.limits.per_radian);
        for k in [1.0, -1.0] { for _ in 0..10 { let next = w.now() + sign * k * step; w.step(next, 0.4); } }
    }),
    // frequency
    joint("chirp_small", "50 mrad, 0.5 to 10 Hz: within what the servo follows", &["command_delay", "command_low_pass", "servo_loop_delay", "measurement_delay", "armature", "gear_compliance"], |w| { let c = w.place(0.0); w.chirp(c, 0.05, 0.5, 10.0, 12.0); }),
    joint("chirp_medium", "0.2 rad, 0.2 to 6 Hz", &["velocity_lag", "current_lag", "command_low_pass", "command_delay", "kd_error", "viscous_friction", "link_inertia"], |w| { let c = w.place(0.0); w.chirp(c, 0.2, 0.2, 6.0, 14.0); }),
    joint("chirp_large", "0.6 rad, 0.1 to 3 Hz, up to the speed limit", &["armature", "damping_lag", "link_inertia", "voltage_limit", "viscous_friction", "profile_limit"], |w| { let c = w.place(0.0); w.chirp(c, 0.6, 0.1, 3.0, 16.0); }),
    joint("chirp_raised", "0.15 rad, 0.3 to 5 Hz, about a raised pose", &["load_dependent_friction", "link_com", "gear_backlash", "play_behind_encoder"], |w| { let c = w.place(0.8); w.chirp(c, 0.15, 0.3, 5.0, 10.0); }),
    joint("chirp_lowered", "the same about a lowered pose: the load the other way", &["load_dependent_friction", "link_com", "gear_backlash", "play_behind_encoder"], |w| { let c = w.place(-0.8); w.chirp(c, 0.15, 0.3, 5.0, 10.0); }),
    joint("sines", "three sizes at three frequencies", &["viscous_friction", "linear_drag", "quadratic_drag", "added_mass", "command_low_pass"], |w| {
        let c = w.place(0.0);
        for hz in [0.5, 1.2, 2.8] { for size in [0.08, 0.2, 0.5] { w.sine(c, size, hz, 3.0); } }
    }),
    joint("multisine", "five frequencies at once", &["command_low_pass", "command_delay", "kd_error"], |w| { let c = w.place(0.0); for hz in [0.4, 0.9, 1.9, 3.7, 7.1] { w.sine(c, 0.12, hz, 3.0); } }),
    joint("prbs_slow", "pseudo-random jumps of 0.1 rad every 0.25 s", &["kd_error", "kp_error", "servo_loop_delay"], |w| { let c = w.place(0.0); w.prbs(c, 0.05, 0.25, 48); }),
    joint("prbs", "pseudo-random jumps of 40 mrad every 60 ms", &["dropped_frames", "command_delay", "servo_loop_delay", "armature"], |w| { let c = w.place(0.0); w.prbs(c, 0.02, 0.06, 127); }),
    // friction
    joint("triangle_creep", "0.03 rad/s: stick and slip", &["stribeck_friction", "pre_sliding", "cogging"], |w| triangles(w, 0.03, 0.12, 1.0)),
    joint("triangle_slow", "0.12 rad/s", &["stribeck_friction", "coulomb_friction", "cogging", "direction_asymmetry"], |w| triangles(w, 0.12, 0.35, 1.0)),
    joint("triangle_medium", "0.5 rad/s", &["coulomb_friction", "direction_asymmetry", "viscous_friction"], |w| triangles(w, 0.5, 0.5, 3.0)),
    joint("triangle_fast", "2 rad/s", &["viscous_friction", "voltage_limit", "supply_level"], |w| triangles(w, 2.0, 0.7, 5.0)),
    joint("triangle_raised", "0.3 rad/s about a raised pose", &["load_dependent_friction", "drive_asymmetry", "direction_asymmetry"], |w| { let c = w.place(0.7); w.triangle(c, 0.2, 0.3, 3.0); }),
    joint("triangle_lowered", "0.3 rad/s about a lowered pose", &["load_dependent_friction", "drive_asymmetry", "direction_asymmetry"], |w| { let c = w.place(-0.7); w.triangle(c, 0.2, 0.3, 3.0); }),
    joint("sweep_full", "the whole range and back at 0.4 rad/s", &["hard_stop", "cogging", "encoder_gain", "parallel_spring"], |w| {
        let (top, bottom, speed) = (w.far(1.0), w.far(-1.0), 0.4);
        let (middle, size) = (0.5 * (top + bottom), 0.5 * (top - bottom).abs());
        w.triangle(middle, w.as_size(size), speed, 1.0);
    }),
    // steps
    joint("steps_small", "steps of 30 mrad", &["kp_error", "kd_error", "controller_dead_band", "servo_loop_delay"], |w| { let c = w.place(0.0); steps(w, c, 0.03, 0.6); }),
    joint("steps_medium", "steps of 0.2 rad", &["kd_error", "damping_on_error", "kp_error", "profile_limit", "armature"], |w| { let c = w.place(0.0); steps(w, c, 0.2, 0.8); }),
    joint("steps_large", "steps of 0.8 rad: full torque, full speed", &["torque_limit", "profile_limit", "voltage_limit", "winding_resistance", "supply_level", "braking_asymmetry"], |w| { let c = w.place(0.0); steps(w, c, 0.8, 1.2); }),
    joint("steps_loaded", "steps of 0.2 rad about a raised pose", &["torque_limit", "kp_error", "load_dependent_friction", "drive_asymmetry"], |w| { let c = w.place(0.8); steps(w, c, 0.2, 0.8); }),
    joint("reversals_fast", "full turns of direction at speed", &["braking_asymmetry", "torque_limit", "supply_sag"], |w| { let c = w.place(0.0); for size in [0.2, 0.4, 0.6] { w.triangle(c, size, 3.5, 4.0); } }),
    // load
    joint("lift_lower", "lift and lower at three equal speeds", &["load_dependent_friction", "drive_asymmetry", "viscous_friction", "winding_resistance"], |w| {
        for speed in [0.15, 0.5, 1.2] { let (c, size) = (w.place(0.5), w.as_size((w.place(1.0) - w.place(0.0)).abs() * 0.5)); w.triangle(c, size, speed, 1.0); }
    }),
    joint("lift_lower_other", "the same on the other side", &["load_dependent_friction", "drive_asymmetry", "direction_asymmetry"], |w| {
        for speed in [0.15, 0.5, 1.2] { let (c, size) = (w.place(-0.5), w.as_size((w.place(-1.0) - w.place(0.0)).abs() * 0.5)); w.triangle(c, size, speed, 1.0); }
    }),
    joint("micro", "reversals of 1.5 to 12 mrad, no load", &["pre_sliding", "gear_backlash", "play_behind_encoder", "controller_dead_band"], |w| micro(w, 0.0)),
    joint("micro_loaded", "the same under load, both ways", &["gear_backlash", "play_behind_encoder", "pre_sliding", "gear_compliance"], |w| { micro(w, 0.9); micro(w, -0.9); }),
    joint("backlash_probe", "slow reversals of 30 mrad about no load", &["gear_backlash", "play_behind_encoder", "gear_compliance", "coulomb_friction"], |w| { let c = w.place(0.0); w.triangle(c, 0.015, 0.06, 6.0); w.triangle(c, 0.03, 0.3, 6.0); }),
    joint("drop_high", "let go from a raised pose", &["measurement_delay", "viscous_friction", "voltage_limit", "coulomb_friction", "current_bias"], |w| { for _ in 0..2 { let q = w.place(1.0); w.go(q); w.hold(0.6); w.drop(2.0); } }),
    joint("drop_low", "let go from a half-raised pose on the other side", &["measurement_delay", "coulomb_friction", "stribeck_friction"], |w| { for _ in 0..2 { let q = w.place(-0.5); w.go(q); w.hold(0.6); w.drop(2.0); } }),
    // several joints
    body("all_chirp", "every joint with the same small chirp", Place::Stand, &["bus_skew", "command_delay", "supply_sag"], |b| b.all_chirp()),
    body("all_steps", "every joint jumps at once", Place::Stand, &["supply_sag", "torque_limit"], |b| b.all_steps()),
    body("load_probe", "one joint repeats a step while the others begin to work", Place::Stand, &["supply_sag"], |b| b.load_probe()),
    // trunk, on the ground
    body("rock_x", "rock the trunk about its length, slowly and fast", Place::Ground, &["girdle_play", "imu_delay"], |b| b.rock(true)),
    body("rock_y", "rock the trunk nose up, nose down", Place::Ground, &["girdle_play", "imu_delay"], |b| b.rock(false)),
    body("lift_feet", "lift each foot in turn: each girdle hangs both ways", Place::Ground, &["girdle_play"], |b| b.lift_feet()),
    body("gait", "walk: trot at 1.2 Hz", Place::Ground, &["contact_friction"], |b| b.gait(1.2, 1.0, 0.0, 14.0)),
    body("gait_slow", "walk at 0.7 Hz", Place::Ground, &["contact_friction", "floor_slope"], |b| b.gait(0.7, 1.0, 0.0, 14.0)),
    body("gait_low", "walk with the belly low", Place::Ground, &["belly_friction"], |b| b.gait(1.0, 0.45, 0.0, 14.0)),
    body("gait_turn", "walk in a curve, the trunk bent or strides of one side shorter", Place::Ground, &["gyro_bias"], |b| b.gait(1.2, 1.0, 0.12, 14.0)),
    once(body("gait_long", "walk for two and a half minutes", Place::Ground, &["clock_drift", "friction_drift", "thermal_derating"], |b| b.gait(1.2, 1.0, 0.0, 150.0))),
    // water
    body("float", "float at rest", Place::Water, &["buoyancy", "buoyancy_centre", "water_level"], |b| b.hold(12.0)),
    body("bob", "draw the legs up and let them down at once", Place::Water, &["heave_damping", "buoyancy"], |b| b.bob()),
    body("swim", "swim: a wave along the body at 0.8 Hz", Place::Water, &["quadratic_drag", "added_mass", "linear_drag"], |b| b.swim(0.8, 0.35, 14.0)),
    body("swim_sizes", "three sizes at three frequencies", Place::Water, &["linear_drag", "quadratic_drag", "added_mass"], |b| { for hz in [0.4, 0.8, 1.4] { for size in [0.12, 0.25, 0.45] { b.swim(hz, size, 5.0); } } }),
    body("coast", "swim, then hold still and drift", Place::Water, &["water_current", "quadratic_drag", "linear_drag"], |b| { b.swim(1.0, 0.4, 6.0); b.hold(8.0); }),
];
