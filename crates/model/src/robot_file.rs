//! The robot file (`*.robot.toml`) as written, and the checks on its single values.

use std::collections::BTreeMap;

use serde::Deserialize;

use crate::error::ModelError;
use crate::extension::Extension;
use crate::params::{
    AddedShare, ContactParams, DragScale, EncoderSide, ImuParams, Measured, ServoParams,
    SupplyParams, default_kd_rate_over_s,
};

/// Value of `format` that this version reads.
pub(crate) const FORMAT: &str = "caudata.robot.v1";

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct RobotFile {
    pub format: String,
    pub name: String,
    pub mjcf: String,
    pub base: BaseWord,
    /// Figures of this file that nobody looked up, by their paths (`servo.preset.NAME.qd_max_radps`).
    #[serde(default)]
    pub assumed: Vec<String>,
    /// How well masses and centres of links were measured, by link.
    #[serde(default)]
    pub measured: BTreeMap<String, Measured>,
    pub joints: JointsTable,
    pub pose: PoseTable,
    pub control: ControlTable,
    pub servo: ServoTable,
    pub supply: SupplyParams,
    pub contact: ContactParams,
    #[serde(default)]
    pub feet: Vec<FootEntry>,
    pub frames: Option<FramesTable>,
    pub imu: Option<ImuParams>,
    pub passive: Option<PassiveTable>,
    pub backlash: Option<BacklashTable>,
    pub water: Option<WaterTable>,
    pub extension: Option<Extension>,
}

#[derive(Clone, Copy, Deserialize, PartialEq)]
#[serde(rename_all = "lowercase")]
pub(crate) enum BaseWord {
    Free,
    Fixed,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct JointsTable {
    pub actuated: Vec<String>,
    /// Joints by the name of a group, which other tables may use instead of theirs.
    #[serde(default)]
    pub groups: BTreeMap<String, Vec<String>>,
    /// Limits of a joint or a group, within those of the MJCF.
    #[serde(default)]
    pub limits_rad: BTreeMap<String, [f64; 2]>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct PoseTable {
    pub nominal_rad: BTreeMap<String, f64>,
    pub swimming_rad: Option<BTreeMap<String, f64>>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct ControlTable {
    pub kp_nm_per_rad: f64,
    pub kd_nm_s_per_rad: f64,
    /// Gains of a joint or a group that has others.
    #[serde(default)]
    pub joint: BTreeMap<String, GainsEntry>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct GainsEntry {
    pub kp_nm_per_rad: Option<f64>,
    pub kd_nm_s_per_rad: Option<f64>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct ServoTable {
    pub default: String,
    #[serde(default)]
    pub joint: BTreeMap<String, String>,
    #[serde(default)]
    pub preset: BTreeMap<String, ServoParams>,
    #[serde(default)]
    pub variant: BTreeMap<String, Variant>,
    #[serde(default)]
    pub brushless: BTreeMap<String, Brushless>,
}

/// Table `[servo.brushless.NAME]`: an actuator under torque control, from motor, gear and current.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Brushless {
    /// Torque per current at the rotor, N·m/A.
    pub torque_constant_nm_per_a: f64,
    /// Turns of the rotor per turn of the joint.
    pub gear_ratio: f64,
    /// Inertia of the rotor about its own axis, kg·m².
    pub rotor_inertia_kgm2: f64,
    /// Largest current, A.
    pub peak_current_a: f64,
    /// Speed of the joint without load at `reference_supply_v`, rad/s.
    pub no_load_speed_radps: f64,
    /// Speed of the joint up to which the peak current can be had, rad/s; default two thirds of the above.
    pub corner_speed_radps: Option<f64>,
    /// V.
    pub reference_supply_v: f64,
    /// Coulomb friction of the gear at the joint, N·m.
    pub friction_loss_nm: f64,
    /// Viscous friction at the joint, N·m·s/rad; default 0.
    #[serde(default)]
    pub damping_nm_s_per_rad: f64,
    /// At the joint.
    pub encoder_counts_per_turn: u32,
    /// As in a preset.
    #[serde(default)]
    pub kd_acts_on_error: bool,
    /// As in a preset.
    #[serde(default = "default_kd_rate_over_s")]
    pub kd_rate_over_s: f64,
    /// Where it sits, as in a preset.
    pub encoder: Option<EncoderSide>,
}

/// Table `[servo.variant.NAME]`: another type with some of its values changed.
#[derive(Clone, Debug, Deserialize)]
pub(crate) struct Variant {
    /// A preset of the file or a type of the library.
    pub of: String,
    /// Keys of a preset.
    #[serde(flatten)]
    pub changes: toml::Table,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct FootEntry {
    pub name: String,
    pub geom: Option<String>,
    /// Instead of `geom`: several shapes of one link.
    pub geoms: Option<Vec<String>>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct FramesTable {
    pub torso: String,
    /// Site whose x axis is the heading; instead of a line between two sites.
    pub heading: Option<String>,
    pub heading_hind: Option<String>,
    pub heading_front: Option<String>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct PassiveTable {
    #[serde(default)]
    pub locked: bool,
    pub joint: BTreeMap<String, PassiveJoint>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct PassiveJoint {
    pub stiffness_nm_per_rad: f64,
    pub damping_nm_s_per_rad: f64,
    pub friction_loss_nm: f64,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct BacklashTable {
    pub enabled: bool,
    pub joints: Vec<String>,
    pub half_width_rad: f64,
    pub stiffness_nm_per_rad: f64,
    pub damping_nm_s_per_rad: f64,
    pub friction_loss_nm: f64,
}

impl BacklashTable {
    fn spring(&self) -> PassiveJoint {
        PassiveJoint {
            stiffness_nm_per_rad: self.stiffness_nm_per_rad,
            damping_nm_s_per_rad: self.damping_nm_s_per_rad,
            friction_loss_nm: self.friction_loss_nm,
        }
    }
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct WaterTable {
    pub density_kg_per_m3: f64,
    pub viscosity_pa_s: f64,
    pub buoyancy_ratio: f64,
    pub heave_damping_ns_per_m: f64,
    /// By group; without any, every link has the drag of its box.
    #[serde(default)]
    pub drag: BTreeMap<String, DragGroup>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct DragGroup {
    pub links: Vec<String>,
    pub scale: DragScale,
    #[serde(default)]
    pub added: AddedShare,
}

/// Parses the robot file and checks every value that needs no other file.
pub(crate) fn parse(label: &str, text: &str) -> Result<RobotFile, ModelError> {
    let file: RobotFile = toml::from_str(text).map_err(|e| ModelError::RobotFile {
        file: label.to_owned(),
        line: e.span().map_or(1, |s| 1 + text[..s.start.min(text.len())].matches('\n').count()),
        message: e.message().replace('\n', " "),
    })?;
    let checker = Checker { file: label };
    checker.run(&file)?;
    checker.assumed(&file.assumed, text)?;
    Ok(file)
}

/// The stiffest position gain or spring: an axis on a ball screw in N/m, which is far more than a hinge has.
const STIFFEST: f64 = 1e6;
/// The same of damping, N·s/m.
const MOST_DAMPED: f64 = 1e5;
/// The same of a rotor's inertia: behind a screw of 5 mm a turn that of 1e-4 kg·m² is 160 kg.
const MOST_INERT: f64 = 1e4;

/// Makes errors about the robot file.
pub(crate) struct Checker<'a> {
    pub file: &'a str,
}

impl Checker<'_> {
    pub fn error(&self, at: impl Into<String>, message: impl Into<String>) -> ModelError {
        ModelError::Invalid { file: self.file.to_owned(), at: at.into(), message: message.into() }
    }

    pub fn refuse<T>(
        &self,
        at: impl Into<String>,
        message: impl Into<String>,
    ) -> Result<T, ModelError> {
        Err(self.error(at, message))
    }

    /// Each of `paths` leads to a figure of the file, `text`.
    fn assumed(&self, paths: &[String], text: &str) -> Result<(), ModelError> {
        // it was read before
        let file: toml::Value = toml::from_str(text).unwrap_or_else(|_| toml::Table::new().into());
        for path in paths {
            let figure = (path.split('.')).try_fold(&file, |table, key| table.get(key));
            if !figure.is_some_and(|f| f.is_float() || f.is_integer()) {
                let message = format!("`{path}` is no figure of this file");
                return self.refuse("assumed", message);
            }
        }
        Ok(())
    }

    fn above(&self, at: &str, x: f64) -> Result<(), ModelError> {
        if x.is_finite() && x > 0.0 {
            return Ok(());
        }
        Err(self.error(at, format!("is {x}; it must be above zero")))
    }

    pub fn within(&self, at: &str, x: f64, lo: f64, hi: f64) -> Result<(), ModelError> {
        if x.is_finite() && (lo..=hi).contains(&x) {
            return Ok(());
        }
        Err(self.error(at, format!("is {x}; it must be between {lo} and {hi}")))
    }

    fn run(&self, f: &RobotFile) -> Result<(), ModelError> {
        if f.format != FORMAT {
            return self
                .refuse("format", format!("is `{}`; this version reads `{FORMAT}`", f.format));
        }
        if f.name.is_empty()
            || !f.name.chars().all(|c| c.is_ascii_alphanumeric() || "_-".contains(c))
        {
            return self.refuse("name", "needs letters, digits, _ and - only");
        }
        if f.mjcf.is_empty() || f.mjcf.contains(['/', '\\']) || f.mjcf == ".." {
            return self.refuse("mjcf", "names a file in the same folder, without a path");
        }
        for (name, preset) in &f.servo.preset {
            self.servo(&format!("servo.preset.{name}"), preset)?;
        }
        for (name, gains) in &f.control.joint {
            for (key, gain, hi) in [
                ("kp_nm_per_rad", gains.kp_nm_per_rad, STIFFEST),
                ("kd_nm_s_per_rad", gains.kd_nm_s_per_rad, MOST_DAMPED),
            ] {
                let at = format!("control.joint.{name}.{key}");
                gain.map_or(Ok(()), |gain| self.within(&at, gain, 0.0, hi))?;
            }
        }
        // Ranges: wide enough for any robot of this kind, narrow enough to catch a wrong unit.
        #[rustfmt::skip]
        self.all_within(&[
            ("control.kp_nm_per_rad", f.control.kp_nm_per_rad, 0.0, STIFFEST),
            ("control.kd_nm_s_per_rad", f.control.kd_nm_s_per_rad, 0.0, MOST_DAMPED),
            ("supply.default_v", f.supply.default_v, 1.0, 100.0),
            ("supply.bench_v", f.supply.bench_v, 1.0, 100.0),
            ("supply.battery_full_v", f.supply.battery_full_v, 1.0, 100.0),
            ("supply.battery_nominal_v", f.supply.battery_nominal_v, 1.0, 100.0),
            ("supply.resistance_ohm", f.supply.resistance_ohm, 0.0, 10.0),
            ("supply.lag_s", f.supply.lag_s, 0.0, 1.0),
            ("contact.foot_friction", f.contact.foot_friction, 0.0, 4.0),
            ("contact.body_friction", f.contact.body_friction, 0.0, 4.0),
        ])?;
        if let Some(imu) = &f.imu {
            #[rustfmt::skip]
            self.all_within(&[
                ("imu.gyro_noise_radps_per_sqrt_hz", imu.gyro_noise_radps_per_sqrt_hz, 0.0, 1.0),
                ("imu.acc_noise_mps2_per_sqrt_hz", imu.acc_noise_mps2_per_sqrt_hz, 0.0, 1.0),
                ("imu.gyro_bias_std_radps", imu.gyro_bias_std_radps, 0.0, 1.0),
                ("imu.acc_bias_std_mps2", imu.acc_bias_std_mps2, 0.0, 10.0),
            ])?;
        }
        for (name, j) in f.passive.iter().flat_map(|p| &p.joint) {
            self.spring(&format!("passive.joint.{name}"), j)?;
        }
        if let Some(b) = &f.backlash {
            self.within("backlash.half_width_rad", b.half_width_rad, 0.0, 0.5)?;
            self.spring("backlash", &b.spring())?;
        }
        match &f.water {
            Some(w) => self.water(w),
            None => Ok(()),
        }
    }

    fn all_within(&self, ranges: &[(&str, f64, f64, f64)]) -> Result<(), ModelError> {
        let mut ranges = ranges.iter();
        ranges.try_for_each(|&(at, x, lo, hi)| self.within(at, x, lo, hi))
    }

    fn spring(&self, at: &str, j: &PassiveJoint) -> Result<(), ModelError> {
        for (name, v, most) in [
            ("stiffness_nm_per_rad", j.stiffness_nm_per_rad, STIFFEST),
            ("damping_nm_s_per_rad", j.damping_nm_s_per_rad, MOST_DAMPED),
            ("friction_loss_nm", j.friction_loss_nm, 1e4),
        ] {
            self.within(&format!("{at}.{name}"), v, 0.0, most)?;
        }
        Ok(())
    }

    pub(crate) fn brushless(&self, table: &str, b: &Brushless) -> Result<(), ModelError> {
        for (key, v) in [
            ("torque_constant_nm_per_a", b.torque_constant_nm_per_a),
            ("gear_ratio", b.gear_ratio),
            ("peak_current_a", b.peak_current_a),
        ] {
            self.above(&format!("{table}.{key}"), v)?;
        }
        Ok(())
    }

    /// Checks a servo; `table` is where it stands.
    pub(crate) fn servo(&self, table: &str, s: &ServoParams) -> Result<(), ModelError> {
        let at = |key: &str| format!("{table}.{key}");
        for (key, v) in [
            ("tau_max_nm", s.tau_max_nm),
            ("qd_max_radps", s.qd_max_radps),
            ("tau_brake_max_nm", s.tau_brake_max_nm),
            ("reference_supply_v", s.reference_supply_v),
            ("torque_per_current_nm_per_a", s.torque_per_current_nm_per_a),
            ("velocity_lsb_radps", s.velocity_lsb_radps),
            ("current_lsb_a", s.current_lsb_a),
            ("encoder_counts_per_turn", f64::from(s.encoder_counts_per_turn)),
        ] {
            self.above(&at(key), v)?;
        }
        for (key, v, hi) in [
            ("kd_min_nm_s_per_rad", s.kd_min_nm_s_per_rad, 1e3),
            ("back_drive_kp_ratio", s.back_drive_kp_ratio, 10.0),
            ("friction_loss_nm", s.friction_loss_nm, 1e4),
            ("damping_nm_s_per_rad", s.damping_nm_s_per_rad, MOST_DAMPED),
            ("armature_kgm2", s.armature_kgm2, MOST_INERT),
            ("current_dead_band_a", s.current_dead_band_a, 1e2),
            ("gear_backlash_rad", s.gear_backlash_rad, 0.5),
            ("current_limit_a", s.current_limit_a, 1e2),
            ("stribeck_nm", s.stribeck_nm, 1e4),
            ("load_friction_driving", s.load_friction_driving, 0.95),
            ("load_friction_driven", s.load_friction_driven, 0.95),
        ] {
            self.within(&at(key), v, 0.0, hi)?;
        }
        self.within(&at("kd_rate_over_s"), s.kd_rate_over_s, 1e-4, 0.1)?;
        let key = "stribeck_speed_radps";
        self.within(&at(key), s.stribeck_speed_radps, 1e-3, 1e2)?;
        if !(0.0 <= s.qd_tau_max_radps && s.qd_tau_max_radps < s.qd_max_radps) {
            return self.refuse(at("qd_tau_max_radps"), "must be ≥ 0 and below qd_max_radps");
        }
        if !(0.0 <= s.tau_qd_max_nm && s.tau_qd_max_nm <= s.tau_max_nm) {
            return self.refuse(at("tau_qd_max_nm"), "must be ≥ 0 and at most tau_max_nm");
        }
        Ok(())
    }

    fn water(&self, w: &WaterTable) -> Result<(), ModelError> {
        #[rustfmt::skip]
        self.all_within(&[
            ("water.density_kg_per_m3", w.density_kg_per_m3, 1.0, 2e4),
            ("water.viscosity_pa_s", w.viscosity_pa_s, 0.0, 10.0),
            ("water.buoyancy_ratio", w.buoyancy_ratio, 0.0, 20.0),
            ("water.heave_damping_ns_per_m", w.heave_damping_ns_per_m, 0.0, 1e3),
        ])?;
        for (name, group) in &w.drag {
            let s = &group.scale;
            for (key, v) in [
                ("linear_force", s.linear_force),
                ("quadratic_force", s.quadratic_force),
                ("linear_torque", s.linear_torque),
                ("quadratic_torque", s.quadratic_torque),
            ] {
                for x in v {
                    self.within(&format!("water.drag.{name}.scale.{key}"), x, 0.0, 1e4)?;
                }
            }
            for (key, v) in [("mass", group.added.mass), ("inertia", group.added.inertia)] {
                for x in v {
                    self.within(&format!("water.drag.{name}.added.{key}"), x, 0.0, 20.0)?;
                }
            }
        }
        Ok(())
    }
}
