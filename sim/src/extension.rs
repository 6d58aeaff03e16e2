//! Every number of a lane's parameters by path, for robot files that a diagnosis extended.
//!
//! `kp_nm_per_rad.FL_hip`, `joints.FL_hip.dead_band_rad`, `link_mass_scale.body_01`,
//! `com_offset_m.body_01.x`, `payload_kg`, ….

use caudata_model::RobotModel;

use crate::params::{backlash_joints, unactuated};
use crate::{HingeEffects, JointEffects, LaneParams, LinkWater, SimError};

const AXES: [&str; 3] = ["x", "y", "z"];

impl LaneParams {
    /// Calls `each` with the path and the value of every number (but the seed of lost frames).
    pub fn visit(&mut self, model: &RobotModel, each: &mut dyn FnMut(&str, &mut f32)) {
        macro_rules! by_path {
            ($($path:literal $value:expr;)+) => { $(each($path, &mut $value);)+ };
        }
        macro_rules! by_name {
            ($($names:ident $field:ident;)+) => {
                $(for (of, x) in $names.iter().zip(&mut self.$field) {
                    each(&format!("{}.{of}", stringify!($field)), x);
                })+
            };
        }
        macro_rules! by_axis {
            ($($field:ident;)+) => {
                $(for (axis, x) in AXES.iter().zip(&mut self.$field) {
                    each(&format!("{}.{axis}", stringify!($field)), x);
                })+
            };
        }
        macro_rules! by_effect {
            ($($kind:ty, $names:ident $field:ident;)+) => {
                $(for (of, one) in $names.iter().zip(&mut self.$field) {
                    for field in <$kind>::FIELDS {
                        let mut x = one.get(field.name).unwrap_or_default();
                        each(&format!("{}.{of}.{}", stringify!($field), field.name), &mut x);
                        one.set(field.name, x);
                    }
                })+
            };
        }
        let feet: Vec<&str> = model.feet().iter().map(|f| f.name.as_str()).collect();
        let links: Vec<&str> = model.links().iter().map(|l| l.name.as_str()).collect();
        let servos = model.actuated_names();
        let passive: Vec<&str> = unactuated(model).map(|j| j.name.as_str()).collect();
        let play: Vec<&str> =
            backlash_joints(model).map(|j| model.joints()[j].name.as_str()).collect();
        by_axis! { gravity_mps2; payload_m; water_current_mps; }
        by_path! {
            "foot_friction" self.foot_friction;
            "body_friction" self.body_friction;
            "payload_kg" self.payload_kg;
            "supply_v" self.supply_v;
            "supply_resistance_ohm" self.supply_resistance_ohm;
            "supply_lag_s" self.supply_lag_s;
            "command_delay_s" self.command_delay_s;
            "command_loss.share" self.command_loss.share;
            "command_loss.burst" self.command_loss.burst;
            "water_level_offset_m" self.water_level_offset_m;
        }
        by_name! {
            feet foot_friction_scale;
            links link_mass_scale;
            links link_inertia_scale;
            servos joint_friction_nm;
            servos joint_armature_kgm2;
            servos joint_damping_nms_per_rad;
            servos kp_nm_per_rad;
            servos kd_nms_per_rad;
            servos torque_scale;
            play backlash_half_width_rad;
        }
        for (link, offset) in links.iter().zip(&mut self.com_offset_m) {
            for (axis, x) in AXES.iter().zip(offset) {
                each(&format!("com_offset_m.{link}.{axis}"), x);
            }
        }
        by_effect! {
            JointEffects, servos joints;
            HingeEffects, passive hinges;
            LinkWater, links water;
        }
    }

    /// Takes over what the robot file's `[extension]` has; paths that do not exist are in
    /// [`check_extension`].
    pub(crate) fn extend(&mut self, model: &RobotModel) {
        let Some(extension) = model.extension() else { return };
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
    let Some(extension) = model.extension() else { return Ok(()) };
    let mut unknown: Vec<&String> = extension.lane.keys().collect();
    let mut params = LaneParams::bare(model);
    params.visit(model, &mut |path, _| unknown.retain(|u| *u != path));
    if let Some(path) = unknown.first() {
        return Err(SimError::Extension { path: (*path).clone() });
    }
    LaneParams::nominal(model).validate(model, 0)
}
