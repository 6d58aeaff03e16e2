//! Per-lane parameters of single joints, hinges and links, each field with its range: what a lane's robot
//! does differently.
//!
//! Every struct also knows its fields by name ([`JointEffects::FIELDS`], [`JointEffects::get`],
//! [`JointEffects::set`]), so that a search over parameters needs no list of its own.

use caudata_model::{EncoderSide, Joint, ServoParams, WaterParams};
use serde::{Deserialize, Serialize};

use crate::drive::command::MAX_COMMAND_DELAY_S;
use crate::drive::friction;
use crate::drive::gear::TOOTH_DAMPING_RATIO;
use crate::drive::loop_delay::MAX_LOOP_DELAY_S;

/// Farthest an end stop can be, rad: stands for none.
pub const ENDLESS_RAD: f32 = 1e6;

/// One number of an effects struct.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct EffectField {
    /// Name, with unit.
    pub name: &'static str,
    /// Smallest value accepted.
    pub low: f32,
    /// Largest value accepted.
    pub high: f32,
}

/// Declares a struct of `f32`, each with `low..=high` and what it is for the robot as the model has it.
macro_rules! effects {
    (
        $(#[$nominal_meta:meta])* ($($from:ident: $kind:ty),+)
        $(#[$meta:meta])* pub struct $name:ident {
            $($(#[$field_meta:meta])* $field:ident: $low:expr, $high:expr => $nominal:expr;)+
        }
    ) => {
        $(#[$meta])*
        #[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
        #[serde(deny_unknown_fields)]
        pub struct $name {
            $($(#[$field_meta])* pub $field: f32,)+
        }

        impl $name {
            $(#[$nominal_meta])*
            pub fn nominal($($from: $kind),+) -> Self {
                Self { $($field: ($nominal) as f32,)+ }
            }

            /// Every field, in order of declaration.
            pub const FIELDS: &[EffectField] = &[
                $(EffectField { name: stringify!($field), low: $low, high: $high },)+
            ];

            /// Value of the field called `name`.
            pub fn get(&self, name: &str) -> Option<f32> {
                match name {
                    $(stringify!($field) => Some(self.$field),)+
                    _ => None,
                }
            }

            /// Sets the field called `name`; whether there is one. (Its range is checked where the lane's
            /// parameters are.)
            pub fn set(&mut self, name: &str, value: f32) -> bool {
                match name {
                    $(stringify!($field) => self.$field = value,)+
                    _ => return false,
                }
                true
            }

            /// The first field outside its range, and its value.
            pub(crate) fn wrong(&self) -> Option<(EffectField, f32)> {
                let values = [$(self.$field),+];
                Self::FIELDS
                    .iter()
                    .zip(values)
                    .find(|(f, v)| !(f.low..=f.high).contains(v))
                    .map(|(f, v)| (*f, v))
            }
        }
    };
}

effects! {
    /// The joint as the model has it.
    (servo: &ServoParams, joint: &Joint)
    /// Drive-line of one actuated joint, beyond what [`LaneParams`](crate::LaneParams) has as arrays.
    /// Formulas: [`crate::drive`].
    pub struct JointEffects {
        /// Delay of this joint's commands on top of the lane's `command_delay_s`, s (sampling skew along the
        /// bus). Together at most [`MAX_COMMAND_DELAY_S`]. Nominal 0.
        command_skew_s: 0.0, MAX_COMMAND_DELAY_S => 0.0;
        /// Time constant of a first-order low-pass on the command, s. Nominal 0: none.
        command_low_pass_s: 0.0, 10.0 => 0.0;
        /// Speed limit of the servo's command profile, rad/s. Nominal 0: none.
        profile_speed_radps: 0.0, 1000.0 => 0.0;
        /// Acceleration limit of the servo's command profile, rad/s². Nominal 0: none.
        profile_acceleration_radps2: 0.0, 1e6 => 0.0;
        /// Share of the command's own speed that Kd does not damp: 1 where it acts on the rate of the error, 0 where
        /// it acts on the joint's speed. Nominal: the servo's.
        kd_on_command: 0.0, 1.0 => f64::from(u8::from(servo.kd_acts_on_error));
        /// Time over which that speed is taken, s. Nominal: the servo's.
        kd_rate_over_s: 1e-4, 0.1 => servo.kd_rate_over_s;
        /// Errors within ± this give no torque, and larger ones that much less, rad. Nominal 0.
        dead_band_rad: 0.0, 1.0 => 0.0;
        /// Share of that by which larger errors are not less: 1 where a controller acts on the whole error as
        /// soon as it is outside. Nominal 0.
        dead_band_jump: 0.0, 1.0 => 0.0;
        /// Integral gain, N·m/(rad·s); stands still while the motor saturates. Nominal 0.
        ki_nm_per_rad_s: 0.0, 1e7 => 0.0;
        /// Delay between what the loop wants and what the motor gives, s (computing time). At most
        /// [`MAX_LOOP_DELAY_S`]. Nominal 0.
        loop_delay_s: 0.0, MAX_LOOP_DELAY_S => 0.0;
        /// Time constant of a first-order low-pass on the speed that Kd damps, s. Nominal 0: none.
        damping_lag_s: 0.0, 1.0 => 0.0;
        /// Factor on the motor's speed without load (a lower back-EMF constant is a faster motor). Nominal 1.
        speed_scale: 0.05, 20.0 => 1.0;
        /// Share of the bus voltage that the motor gets at most. Nominal 1.
        voltage_share: 0.01, 20.0 => 1.0;
        /// Factor on the limit of torque against the motion, on top of `torque_scale`. Nominal 1.
        brake_scale: 0.0, 100.0 => 1.0;
        /// Winding resistance over the nominal one: divides the loop's torque and the sloping part of the
        /// envelope. Nominal 1.
        winding_scale: 0.05, 20.0 => 1.0;
        /// Damping that the motor has beyond the Kd gain (back-EMF), N·m·s/rad. Nominal: the servo's.
        kd_min_nms_per_rad: 0.0, 1e5 => servo.kd_min_nm_s_per_rad;
        /// Factor on Kp while the load drives the joint away from its target. Nominal: the servo's.
        back_drive_kp_ratio: 0.0, 10.0 => servo.back_drive_kp_ratio;
        /// Torque per ampere beyond the dead band, N·m/A. Nominal: the servo's.
        torque_constant_nm_per_a: 0.001, 1000.0 => servo.torque_per_current_nm_per_a;
        /// Current that gives no torque yet, A. Nominal: the servo's.
        current_dead_band_a: 0.0, 100.0 => servo.current_dead_band_a;
        /// Largest motor current, A. 0: none. Nominal: the servo's.
        current_limit_a: 0.0, 1000.0 => servo.current_limit_a;
        /// Largest motor current against the motion where it is another one (a bridge that is limited as it
        /// drives brakes through its diodes), A. Comes with the speed, over 0.1 rad/s. 0: `current_limit_a`.
        /// Nominal 0.
        braking_current_limit_a: 0.0, 1000.0 => 0.0;
        /// Friction at rest beyond Coulomb's, N·m (Stribeck). Nominal: the servo's.
        stribeck_nm: 0.0, 1e4 => servo.stribeck_nm;
        /// Speed at which that has fallen to 1/e, rad/s. Nominal: the servo's.
        stribeck_speed_radps: 1e-3, 100.0 => servo.stribeck_speed_radps;
        /// Friction per load torque while the motor drives the load. Nominal: the servo's.
        load_friction_driving: 0.0, 0.95 => servo.load_friction_driving;
        /// Friction per load torque while the load drives the motor. Nominal: the servo's.
        load_friction_driven: 0.0, 0.95 => servo.load_friction_driven;
        /// Friction per load torque at rest on top of that; falls with speed as Stribeck's does, at the same
        /// speed. Nominal 0.
        load_stribeck: 0.0, 0.95 => 0.0;
        /// How fast torque falls behind the current: a motor that would give τ gives τ/(1 + s·|τ|), 1/(N·m)
        /// (iron that saturates, brushes and bridge that drop more). Nominal 0.
        torque_saturation_per_nm: 0.0, 100.0 => 0.0;
        /// Friction more in the positive and less in the negative direction, N·m. Nominal 0.
        friction_asymmetry_nm: -1e4, 1e4 => 0.0;
        /// Deflection at which friction starts to slide, rad. Nominal 0.002; of a slide, m, 0.0001.
        presliding_rad: 1e-7, 1.0 => friction::presliding_rad(joint);
        /// Amplitude of torque ripple A·sin(n·q + φ), N·m. Nominal 0.
        ripple_nm: 0.0, 1e4 => 0.0;
        /// n: periods of the ripple per turn of the joint. Nominal 1.
        ripple_per_turn: 0.0, 10_000.0 => 1.0;
        /// φ: phase of the ripple, rad. Nominal 0.
        ripple_phase_rad: -10.0, 10.0 => 0.0;
        /// Half of the play between rotor and joint, rad. Nominal 0 (the servo's own figure is
        /// [`gear_backlash_rad`](ServoParams::gear_backlash_rad)/2).
        gear_half_gap_rad: 0.0, 0.5 => 0.0;
        /// Stiffness between rotor and joint, N·m/rad. Nominal 0: rigid (teeth of 1000 where there is play).
        gear_stiffness_nm_per_rad: 0.0, 1e8 => 0.0;
        /// Damping ratio of the rotor on that stiffness. Nominal 0.3.
        gear_damping_ratio: 0.0, 10.0 => TOOTH_DAMPING_RATIO;
        /// 1 where the encoder is on the motor, 0 where it is on the output: the share of what the rotor is
        /// ahead of the joint that loop and log see. Nominal: the servo's.
        motor_encoder: 0.0, 1.0 => f64::from(u8::from(servo.encoder == Some(EncoderSide::Motor)));
        /// Spring at the joint (cable, skin), N·m/rad. Nominal: the model's.
        spring_nm_per_rad: 0.0, 1e6 => joint.stiffness_nm_per_rad;
        /// Where that spring is relaxed, rad. Nominal: the model's.
        spring_rest_rad: -1000.0, 1000.0 => joint.spring_ref_rad;
        /// Lower end stop, rad. Nominal: the model's.
        low_rad: -ENDLESS_RAD, ENDLESS_RAD => range(joint).0;
        /// Upper end stop, rad, not below the lower one. Nominal: the model's.
        high_rad: -ENDLESS_RAD, ENDLESS_RAD => range(joint).1;
        /// Steady rise of the winding's temperature per current squared, K/A². Nominal 0: stays cold.
        thermal_rise_k_per_a2: 0.0, 1000.0 => 0.0;
        /// Time constant of the warming, s. Nominal 100.
        thermal_time_s: 0.1, 1e5 => 100.0;
        /// Growth of the winding's resistance, 1/K. Nominal 0.0039, copper.
        resistance_per_k: 0.0, 0.1 => 0.0039;
    }
}

effects! {
    /// The hinge as the model has it.
    (joint: &Joint)
    /// A hinge without a servo: passive, or play at a connection (whose stops are the lane's
    /// `backlash_half_width_rad`).
    pub struct HingeEffects {
        /// Spring, N·m/rad. Nominal: the model's.
        spring_nm_per_rad: 0.0, 1e6 => joint.stiffness_nm_per_rad;
        /// Where it is relaxed, rad. Nominal: the model's.
        spring_rest_rad: -1000.0, 1000.0 => joint.spring_ref_rad;
        /// Viscous damping, N·m·s/rad. Nominal: the model's.
        damping_nms_per_rad: 0.0, 1e6 => joint.damping_nm_s_per_rad;
        /// Coulomb friction, N·m. Nominal: the model's.
        friction_nm: 0.0, 1e4 => joint.friction_loss_nm;
        /// Lower end stop, rad. Nominal: the model's.
        low_rad: -ENDLESS_RAD, ENDLESS_RAD => range(joint).0;
        /// Upper end stop, rad, not below the lower one. Nominal: the model's.
        high_rad: -ENDLESS_RAD, ENDLESS_RAD => range(joint).1;
    }
}

effects! {
    /// Link `link` as the model has it; without water in the model, neutral.
    (water: Option<&WaterParams>, link: usize)
    /// One link in water. Formulas: [`crate::water`].
    pub struct LinkWater {
        /// Factor on the link's buoyancy. Nominal 1.
        buoyancy_scale: 0.0, 100.0 => 1.0;
        /// Centre of buoyancy, offset from the (nominal) centre of mass along the link's x, m. Nominal 0.
        buoyancy_x_m: -1.0, 1.0 => 0.0;
        /// The same along y.
        buoyancy_y_m: -1.0, 1.0 => 0.0;
        /// The same along z.
        buoyancy_z_m: -1.0, 1.0 => 0.0;
        /// Factor on linear drag, force and torque. Nominal 1.
        linear_drag_scale: 0.0, 100.0 => 1.0;
        /// Factor on quadratic drag along the link's x. Nominal 1.
        quadratic_drag_scale_x: 0.0, 100.0 => 1.0;
        /// The same along y.
        quadratic_drag_scale_y: 0.0, 100.0 => 1.0;
        /// The same along z.
        quadratic_drag_scale_z: 0.0, 100.0 => 1.0;
        /// Factor on the quadratic drag torque. Nominal 1.
        quadratic_torque_scale: 0.0, 100.0 => 1.0;
        /// Damping of the vertical motion of the whole link under water, N·s/m. Nominal: the model's.
        heave_damping_ns_per_m: 0.0, 1000.0 => water.map_or(0.0, |w| w.heave_damping_ns_per_m);
        /// Added mass along the link's x, as a share of the displaced water. Nominal: the model's.
        added_mass_x: 0.0, 20.0 => added(water, link).0[0];
        /// The same along y.
        added_mass_y: 0.0, 20.0 => added(water, link).0[1];
        /// The same along z.
        added_mass_z: 0.0, 20.0 => added(water, link).0[2];
        /// Added inertia about the link's x, as a share of the displaced water's own. Nominal: the model's.
        added_inertia_x: 0.0, 20.0 => added(water, link).1[0];
        /// The same about y.
        added_inertia_y: 0.0, 20.0 => added(water, link).1[1];
        /// The same about z.
        added_inertia_z: 0.0, 20.0 => added(water, link).1[2];
    }
}

/// Added mass and inertia of a link along and about its axes.
fn added(water: Option<&WaterParams>, link: usize) -> ([f64; 3], [f64; 3]) {
    let added = water.and_then(|w| w.added.get(link));
    added.map_or_else(Default::default, |a| (a.mass, a.inertia))
}

fn range(joint: &Joint) -> (f32, f32) {
    joint.range_rad.map_or((-ENDLESS_RAD, ENDLESS_RAD), |(low, high)| (low as f32, high as f32))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fields_are_known_by_name() {
        let mut link = LinkWater::nominal(None, 0);
        assert!(link.set("added_mass_y", 0.7) && !link.set("added_mass_w", 0.7));
        assert_eq!((link.get("added_mass_y"), link.added_mass_y), (Some(0.7), 0.7));
        assert_eq!(link.get("added_mass_w"), None);
        assert_eq!(LinkWater::FIELDS.len(), 16);
        assert_eq!(link.wrong(), None);
        link.buoyancy_scale = f32::NAN;
        assert_eq!(link.wrong().unwrap().0.name, "buoyancy_scale");
    }
}
