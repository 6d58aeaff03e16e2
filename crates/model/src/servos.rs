//! The servos of a robot: presets of the robot file, variants of them, brushless actuators by their motor and
//! gear, and the library of types that a file may name without describing them (`servos.toml`).

use std::collections::BTreeMap;

use crate::error::ModelError;
use crate::of_joint;
use crate::params::ServoParams;
use crate::robot_file::{Brushless, Checker, RobotFile, Variant};

const LIBRARY: &str = include_str!("servos.toml");

/// Share of the speed without load up to which a brushless actuator has its full torque, unless its table
/// says otherwise: below that the current limits it, above it the voltage does.
const CORNER_SHARE: f64 = 2.0 / 3.0;

impl Brushless {
    /// The same as every other servo. Field-oriented control holds the torque whatever the speed, so nothing
    /// damps beyond the loop's own gain, and it brakes as strongly as it drives.
    fn servo(&self) -> ServoParams {
        let per_current = self.torque_constant_nm_per_a * self.gear_ratio;
        let tau_max_nm = per_current * self.peak_current_a;
        let corner = CORNER_SHARE * self.no_load_speed_radps;
        ServoParams {
            tau_max_nm,
            qd_tau_max_radps: self.corner_speed_radps.unwrap_or(corner),
            qd_max_radps: self.no_load_speed_radps,
            tau_qd_max_nm: 0.0,
            tau_brake_max_nm: tau_max_nm,
            kd_min_nm_s_per_rad: 0.0,
            back_drive_kp_ratio: 1.0,
            friction_loss_nm: self.friction_loss_nm,
            damping_nm_s_per_rad: self.damping_nm_s_per_rad,
            armature_kgm2: self.rotor_inertia_kgm2 * self.gear_ratio * self.gear_ratio,
            reference_supply_v: self.reference_supply_v,
            encoder_counts_per_turn: self.encoder_counts_per_turn,
            velocity_lsb_radps: VELOCITY_STEP_RADPS,
            current_lsb_a: CURRENT_STEP_A,
            torque_per_current_nm_per_a: per_current,
            current_dead_band_a: 0.0,
            gear_backlash_rad: 0.0,
            current_limit_a: self.peak_current_a,
            stribeck_nm: 0.0,
            stribeck_speed_radps: 0.1,
            load_friction_driving: 0.0,
            load_friction_driven: 0.0,
            kd_acts_on_error: self.kd_acts_on_error,
            kd_rate_over_s: self.kd_rate_over_s,
            encoder: self.encoder,
        }
    }
}

/// Steps in which a brushless drive reports: fine enough never to be seen.
const VELOCITY_STEP_RADPS: f64 = 1e-3;
const CURRENT_STEP_A: f64 = 1e-3;

fn library() -> BTreeMap<String, toml::Table> {
    // a test reads it; an unreadable one would be an empty one
    toml::from_str(LIBRARY).unwrap_or_default()
}

/// The servo types of a robot, by name.
pub(crate) type Presets = Vec<(String, ServoParams)>;

/// Every preset of the file in name order, then what it takes from the library; and which of them each
/// actuated joint has.
pub(crate) fn servos(
    c: &Checker<'_>,
    file: &RobotFile,
) -> Result<(Presets, Vec<usize>), ModelError> {
    let mut types = Types::of(c, file)?;
    of_joint::known(c, "servo.joint", file.servo.joint.keys(), file)?;
    let mut of = Vec::new();
    for name in &file.joints.actuated {
        of.push(match of_joint::find(&file.servo.joint, name, file) {
            Some((key, preset)) => types.place(c, &format!("servo.joint.{key}"), preset)?,
            None => types.place(c, "servo.default", &file.servo.default)?,
        });
    }
    Ok((types.presets, of))
}

struct Types {
    presets: Presets,
    library: BTreeMap<String, toml::Table>,
}

impl Types {
    fn of(c: &Checker<'_>, file: &RobotFile) -> Result<Self, ModelError> {
        let library = library();
        let mut described: BTreeMap<String, ServoParams> = file.servo.preset.clone();
        for (name, servo) in &mut described {
            // a type of the library with figures of its own is built as the library's is
            let known = || library.get(name)?.get("encoder")?.clone().try_into().ok();
            servo.encoder = servo.encoder.or_else(known);
        }
        let presets = described.clone();
        let mut once = |at: &str, name: &str, servo: ServoParams| {
            c.servo(&format!("{at}.{name}"), &servo)?;
            match described.insert(name.to_owned(), servo) {
                None => Ok(()),
                Some(_) => c.refuse(format!("{at}.{name}"), "is described twice"),
            }
        };
        for (name, motor) in &file.servo.brushless {
            c.brushless(&format!("servo.brushless.{name}"), motor)?;
            once("servo.brushless", name, motor.servo())?;
        }
        for (name, variant) in &file.servo.variant {
            let servo = varied(c, name, variant, presets.get(&variant.of), &library)?;
            once("servo.variant", name, servo)?;
        }
        Ok(Self { presets: described.into_iter().collect(), library })
    }

    /// Place of the type called `name` among the presets; one of the library is added to them.
    fn place(&mut self, c: &Checker<'_>, at: &str, name: &str) -> Result<usize, ModelError> {
        if let Some(place) = self.presets.iter().position(|p| p.0 == name) {
            return Ok(place);
        }
        let Some(table) = self.library.get(name) else {
            let own = self.presets.iter().map(|p| p.0.as_str());
            let all: Vec<&str> = own.chain(self.library.keys().map(String::as_str)).collect();
            let known = all.join(", ");
            return c.refuse(at, format!("there is no servo preset `{name}` (known: {known})"));
        };
        let servo = read(c, at, table.clone())?;
        self.presets.push((name.to_owned(), servo));
        Ok(self.presets.len() - 1)
    }
}

fn varied(
    c: &Checker<'_>,
    name: &str,
    variant: &Variant,
    preset: Option<&ServoParams>,
    library: &BTreeMap<String, toml::Table>,
) -> Result<ServoParams, ModelError> {
    let at = format!("servo.variant.{name}");
    let base = preset.and_then(|p| toml::Table::try_from(p).ok());
    let Some(mut table) = base.or_else(|| library.get(&variant.of).cloned()) else {
        let of = &variant.of;
        return c.refuse(at, format!("there is neither a preset nor a known type `{of}`"));
    };
    table.extend(variant.changes.clone());
    read(c, &at, table)
}

fn read(c: &Checker<'_>, at: &str, table: toml::Table) -> Result<ServoParams, ModelError> {
    let servo = table.try_into::<ServoParams>();
    servo.map_err(|e| c.error(at, e.message().replace('\n', " ")))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_type_of_the_library_is_a_servo() {
        let c = Checker { file: "servos.toml" };
        let types = library();
        assert!(types.len() >= 6, "{:?}", types.keys());
        for (name, table) in types {
            let servo = read(&c, &name, table).unwrap();
            c.servo(&name, &servo).unwrap();
            assert!(servo.encoder.is_some(), "{name}");
            // what holds still at the speed without load has no torque left, or little
            assert!(servo.tau_qd_max_nm <= 0.25 * servo.tau_max_nm, "{name}");
        }
    }

    #[test]
    fn a_brushless_actuator_by_hand() {
        // 0.1 N·m/A behind 6:1 with 30 A: 18 N·m; a rotor of 1e-4 kg·m² is 36e-4 at the joint
        let motor = Brushless {
            torque_constant_nm_per_a: 0.1,
            gear_ratio: 6.0,
            rotor_inertia_kgm2: 1e-4,
            peak_current_a: 30.0,
            no_load_speed_radps: 30.0,
            corner_speed_radps: None,
            reference_supply_v: 24.0,
            friction_loss_nm: 0.2,
            damping_nm_s_per_rad: 0.0,
            encoder_counts_per_turn: 32768,
            kd_acts_on_error: false,
            kd_rate_over_s: 0.001,
            encoder: None,
        };
        let servo = motor.servo();
        assert!((servo.tau_max_nm - 18.0).abs() < 1e-12);
        assert!((servo.armature_kgm2 - 36e-4).abs() < 1e-15);
        assert!((servo.qd_tau_max_radps - 20.0).abs() < 1e-12);
        assert!((servo.torque_per_current_nm_per_a - 0.6).abs() < 1e-12);
    }
}
