//! The robot as the MuJoCo script wants it: its MJCF, unchanged, and what the robot file decides.

use std::path::Path;

use caudata_model::RobotModel;
use serde_json::{Map, Value, json};

use super::error::{VerifyError, read};

/// A robot for MuJoCo.
#[derive(Clone, Debug)]
pub struct RobotRequest {
    mjcf: String,
}

impl RobotRequest {
    /// Reads the MJCF that a robot file names.
    ///
    /// # Errors
    /// [`VerifyError::Read`].
    pub fn read(robot: &Path) -> Result<Self, VerifyError> {
        let wrong =
            |reason: &str| VerifyError::Read { path: robot.to_owned(), reason: reason.to_owned() };
        let file: toml::Table = read(robot)?.parse().map_err(|_| wrong("it is not valid TOML"))?;
        let mjcf = file.get("mjcf").and_then(toml::Value::as_str);
        let name = mjcf.ok_or_else(|| wrong("it names no MJCF"))?;
        Ok(Self { mjcf: read(&robot.with_file_name(name))? })
    }

    /// A request for `task`: `options` are MuJoCo's, `more` the task's own keys.
    pub fn task(&self, task: &str, model: &RobotModel, options: Value, more: Value) -> Value {
        let joints: Map<String, Value> = model
            .joints()
            .iter()
            .map(|j| {
                let p = json!({
                    "damping": j.damping_nm_s_per_rad, "armature": j.armature_kgm2, "friction": j.friction_loss_nm,
                    "stiffness": j.stiffness_nm_per_rad, "spring_ref": j.spring_ref_rad,
                });
                (j.name.clone(), p)
            })
            .collect();
        let names: Vec<&str> = model.joints().iter().map(|j| j.name.as_str()).collect();
        let mut request = json!({
            "task": task, "mjcf": self.mjcf, "joints": joints, "joint_names": names,
            "actuated": model.actuated_names(), "servos": servos(model), "options": options,
            "heading_sites": model.heading_sites().map(|(h, f)| [h.name.clone(), f.name.clone()]),
        });
        if let (Some(to), Value::Object(from)) = (request.as_object_mut(), more) {
            to.extend(from);
        }
        request
    }
}

/// Each servo's gains and envelope at the robot's supply voltage.
fn servos(model: &RobotModel) -> Vec<Value> {
    (0..model.actuated().len())
        .map(|a| {
            let s = model.servo(a);
            let supply = model.supply_v() / s.reference_supply_v;
            let span = s.qd_max_radps - s.qd_tau_max_radps;
            let taper = ((s.tau_max_nm - s.tau_qd_max_nm) / span).max(0.0);
            json!({
                "kp": model.kp_nm_per_rad(a),
                "kd": model.kd_nm_s_per_rad(a) + s.kd_min_nm_s_per_rad,
                "tau_max": s.tau_max_nm,
                "stall": supply * (s.tau_max_nm + taper * s.qd_tau_max_radps),
                "taper": taper,
                "tau_brake_max": s.tau_brake_max_nm,
            })
        })
        .collect()
}

/// MuJoCo's converged setting, which the travel and standing rows are held against. Stops and contacts are as
/// soft as the MJCF has them.
pub(crate) fn converged() -> Value {
    json!({ "dt_s": 0.0005, "cone": "elliptic", "impratio": 100.0 })
}
