//! Every number of a lane's parameters by path, for robot files that a diagnosis extended.
//!
//! `kp_nm_per_rad.FL_hip`, `joints.FL_hip.dead_band_rad`, `link_mass_scale.body_01`, `com_offset_m.body_01.x`, `payload_kg`, ….

use caudata_model::{JointKind, RobotModel};

use crate::params::unactuated;
use crate::{HingeEffects, JointEffects, LaneParams, LinkWater, SimError};

const AXES: [&str; 3] = ["x", "y", "z"];

impl LaneParams {
    /// Calls `each` with the path and the value of every number (but the seed of lost frames).
    pub fn visit(&mut self, model: &RobotModel, each: &mut dyn FnMut(&str, &mut f32)) {
        for (axis, x) in AXES.iter().zip(&mut self.gravity_mps2) {
            each(&format!("gravity_mps2.{axis}"), x);
        }
        for (axis, x) in AXES.iter().zip(&mut self.payload_m) {
            each(&format!("payload_m.{axis}"), x);
        }
        for (axis, x) in AXES.iter().zip(&mut self.water_current_mps) {
            each(&format!("water_current_mps.{axis}"), x);
        }
        for (name, x) in [
            ("foot_friction", &mut self.foot_friction),
            ("body_friction", &mut self.body_friction),
            ("payload_kg", &mut self.payload_kg),
            ("supply_v", &mut self.supply_v),
            ("supply_resistance_ohm", &mut self.supply_resistance_ohm),
            ("supply_lag_s", &mut self.supply_lag_s),
            ("command_delay_s", &mut self.command_delay_s),
            ("command_loss.share", &mut self.command_loss.share),
            ("command_loss.burst", &mut self.command_loss.burst),
            ("water_level_offset_m", &mut self.water_level_offset_m),
        ] {
            each(name, x);
        }
        let feet: Vec<&str> = model.feet().iter().map(|f| f.name.as_str()).collect();
        let links: Vec<&str> = model.links().iter().map(|l| l.name.as_str()).collect();
        let joints = model.actuated_names();
        let hinges: Vec<&str> = unactuated(model).map(|j| j.name.as_str()).collect();
        let play: Vec<&str> = model
            .joints()
            .iter()
            .filter(|j| j.kind == JointKind::Backlash)
            .map(|j| j.name.as_str())
            .collect();
        for (name, names, values) in [
            ("foot_friction_scale", &feet, &mut self.foot_friction_scale),
            ("link_mass_scale", &links, &mut self.link_mass_scale),
            ("link_inertia_scale", &links, &mut self.link_inertia_scale),
            ("joint_friction_nm", &joints, &mut self.joint_friction_nm),
            (
                "joint_armature_kgm2",
                &joints,
                &mut self.joint_armature_kgm2,
            ),
            (
                "joint_damping_nms_per_rad",
                &joints,
                &mut self.joint_damping_nms_per_rad,
            ),
            ("kp_nm_per_rad", &joints, &mut self.kp_nm_per_rad),
            ("kd_nms_per_rad", &joints, &mut self.kd_nms_per_rad),
            ("torque_scale", &joints, &mut self.torque_scale),
            (
                "backlash_half_width_rad",
                &play,
                &mut self.backlash_half_width_rad,
            ),
        ] {
            for (of, x) in names.iter().zip(values) {
                each(&format!("{name}.{of}"), x);
            }
        }
        for (link, offset) in links.iter().zip(&mut self.com_offset_m) {
            for (axis, x) in AXES.iter().zip(offset) {
                each(&format!("com_offset_m.{link}.{axis}"), x);
            }
        }
        macro_rules! fields {
            ($kind:ty, $name:literal, $names:expr, $all:expr) => {
                for (of, one) in $names.iter().zip($all) {
                    for field in <$kind>::FIELDS {
                        let mut x = one.get(field.name).unwrap_or_default();
                        each(&format!("{}.{of}.{}", $name, field.name), &mut x);
                        one.set(field.name, x);
                    }
                }
            };
        }
        fields!(JointEffects, "joints", joints, &mut self.joints);
        fields!(HingeEffects, "hinges", hinges, &mut self.hinges);
        fields!(LinkWater, "water", links, &mut self.water);
    }

    /// Takes over what the robot file's `[extension]` has; paths that do not exist are in [`check_extension`].
    pub(crate) fn extend(&mut self, model: &RobotModel) {
        let Some(extension) = model.extension() else {
            return;
        };
        if extension.lane.is_empty() {
            return;
        }
        self.visit(model, &mut |path, x| {
            if let Some(value) = extension.lane.get(path) {
                *x = *value as f32;
            }
        });
    }
}

/// Refuses a robot file whose `[extension.lane]` names what is not there, or gives what is not physical.
///
/// # Errors
/// [`SimError::Extension`] with the path; as [`LaneParams::validate`].
pub fn check_extension(model: &RobotModel) -> Result<(), SimError> {
    let Some(extension) = model.extension() else {
        return Ok(());
    };
    let mut unknown: Vec<&String> = extension.lane.keys().collect();
    let mut params = LaneParams::bare(model);
    params.visit(model, &mut |path, _| unknown.retain(|u| *u != path));
    if let Some(path) = unknown.first() {
        return Err(SimError::Extension {
            path: (*path).clone(),
        });
    }
    LaneParams::nominal(model).validate(model, 0)
}
