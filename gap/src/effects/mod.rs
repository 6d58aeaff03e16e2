//! The catalogue: every physical effect that diagnosis can name, as a small plug-in.
//!
//! An [`Effect`] is a record: parameters with units, bounds and the smallest change that matters, sizes to
//! try, where it can act, a hook that edits a [`Plant`] (physics, sensors, clocks), look-alikes, and what
//! must have been excited to see it. To add one: write its record in a file of its own or of its family, and
//! add a row to [`ALL`].

mod contact;
mod effect;
mod fed;
mod friction;
mod gear;
mod imu;
mod inertia;
mod sensing;
mod servo;
mod structure;
mod supply;
mod timing;
mod water;

pub use crate::place::{Domain, Place};
pub use effect::{Effect, Layer, ParameterSpec, Reference};
pub use structure::{HARD_STOP, PASSED_STOP};
pub use timing::DROPPED_FRAMES;

/// The catalogue.
pub static ALL: &[&Effect] = &[
    &sensing::ENCODER_OFFSET,
    &sensing::ENCODER_GAIN,
    &sensing::VELOCITY_LAG,
    &sensing::CURRENT_BIAS,
    &sensing::CURRENT_LAG,
    &imu::IMU_TILT,
    &imu::GYRO_BIAS,
    &imu::IMU_DELAY,
    &imu::MOCAP_FRAME,
    &timing::COMMAND_DELAY,
    &timing::MEASUREMENT_DELAY,
    &timing::BUS_SKEW,
    &timing::DROPPED_FRAMES,
    &timing::CLOCK_DRIFT,
    &timing::COMMAND_LOW_PASS,
    &timing::PROFILE_LIMIT,
    &timing::SERVO_LOOP_DELAY,
    &servo::KP_ERROR,
    &servo::KD_ERROR,
    &servo::DAMPING_ON_ERROR,
    &servo::DAMPING_LAG,
    &fed::FED_TORQUE,
    &fed::FED_SPEED,
    &fed::OUTER_FORCE,
    &servo::INTEGRAL_ACTION,
    &servo::TORQUE_CONSTANT,
    &servo::WINDING_RESISTANCE,
    &servo::TORQUE_LIMIT,
    &servo::MOTOR_TORQUE,
    &servo::TORQUE_SATURATION,
    &servo::VOLTAGE_LIMIT,
    &servo::CONTROLLER_DEAD_BAND,
    &servo::BRAKING_ASYMMETRY,
    &servo::STALE_GAINS,
    &supply::SUPPLY_SAG,
    &supply::SUPPLY_LEVEL,
    &supply::DUTY_SUPPLY,
    &supply::THERMAL_DERATING,
    &friction::COULOMB_FRICTION,
    &friction::VISCOUS_FRICTION,
    &friction::STRIBECK_FRICTION,
    &friction::LOAD_DEPENDENT_FRICTION,
    &friction::LOAD_STICTION,
    &friction::DRIVE_ASYMMETRY,
    &friction::DIRECTION_ASYMMETRY,
    &friction::PRE_SLIDING,
    &friction::FRICTION_DRIFT,
    &gear::GEAR_BACKLASH,
    &gear::PLAY_BEHIND_ENCODER,
    &gear::GEAR_COMPLIANCE,
    &gear::COGGING,
    &structure::GIRDLE_PLAY,
    &structure::PARALLEL_SPRING,
    &structure::HARD_STOP,
    &structure::PASSED_STOP,
    &inertia::LINK_MASS,
    &inertia::LINK_COM,
    &inertia::POINT_MASS,
    &inertia::LINK_INERTIA,
    &inertia::ARMATURE,
    &inertia::PAYLOAD,
    &inertia::FLOOR_SLOPE,
    &contact::CONTACT_FRICTION,
    &contact::BELLY_FRICTION,
    &water::LINEAR_DRAG,
    &water::QUADRATIC_DRAG,
    &water::ADDED_MASS,
    &water::BUOYANCY,
    &water::BUOYANCY_CENTRE,
    &water::HEAVE_DAMPING,
    &water::WATER_CURRENT,
    &water::WATER_LEVEL,
];

/// The effect with this id.
pub fn find(id: &str) -> Option<&'static Effect> {
    ALL.iter().copied().find(|e| e.id == id)
}

/// Which effects somebody who wrote `asked` may have meant: those that have a word of it, else all.
pub fn meant(asked: &str) -> String {
    let asked = asked.to_lowercase();
    let words: Vec<&str> = asked.split(|c: char| !c.is_ascii_alphanumeric()).collect();
    let has = |id: &str| {
        words.iter().any(|w| w.len() > 2 && id.contains(w) || id.split('_').any(|part| part == *w))
    };
    let near: Vec<&str> = ALL.iter().map(|e| e.id).filter(|id| has(id)).collect();
    match near.is_empty() {
        true => format!("there are {}", ALL.iter().map(|e| e.id).collect::<Vec<_>>().join(", ")),
        false => format!("did you mean {}? `caudata gap effects` lists all", near.join(" or ")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn who_misses_an_effect_by_a_word_is_told_which_have_it() {
        assert!(meant("backlash").starts_with("did you mean gear_backlash?"));
        assert!(meant("kd").starts_with("did you mean kd_error?"));
        // of nothing known all are listed
        assert!(meant("gremlins").starts_with("there are encoder_offset, "));
    }
}
