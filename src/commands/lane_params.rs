//! `--set lane.KEY=VALUE`: one robot's physical parameters on the command line.
//!
//! `KEY` is a field of `LaneParams`. A number given for a list fills it; `KEY.NAME` is one joint's, link's or foot's value in it. Of the effects of joints, hinges and links
//! `joints.FIELD` is all joints', `joints.NAME.FIELD` one joint's.

use caudata_config::ConfigArgs;
use caudata_model::{JointKind, RobotModel};
use caudata_sim::LaneParams;
use caudata_telemetry::{ExitCode, Failure, FailureExt};
use serde_json::Value;

/// What `--set` keys of this module begin with.
const PREFIX: &str = "lane.";

/// The configuration's own flags, and the changes `KEY=VALUE` to lane parameters, without prefix.
pub fn split(flags: &ConfigArgs) -> (ConfigArgs, Vec<String>) {
    let mut flags = flags.clone();
    let (lane, rest): (Vec<String>, Vec<String>) = std::mem::take(&mut flags.overrides)
        .into_iter()
        .partition(|change| change.trim_start().starts_with(PREFIX));
    flags.overrides = rest;
    let bare = |change: String| change.trim_start()[PREFIX.len()..].to_owned();
    (flags, lane.into_iter().map(bare).collect())
}

/// The model's nominal parameters with `changes` applied.
///
/// # Errors
/// `BadConfig` with the key, where it is unknown or its value does not fit.
pub fn changed(model: &RobotModel, changes: &[String]) -> Result<LaneParams, Failure> {
    let nominal = LaneParams::nominal(model);
    let mut fields = serde_json::to_value(&nominal).or_exit(ExitCode::Internal)?;
    for change in changes {
        apply(&mut fields, model, change).map_err(|reason| {
            let message = format!("--set {PREFIX}{change}: {reason}");
            Failure::message(ExitCode::BadConfig, message)
        })?;
    }
    let params: LaneParams = serde_json::from_value(fields)
        .or_exit_with(ExitCode::BadConfig, || format!("--set {PREFIX}…"))?;
    params.validate(model, 0).or_exit(ExitCode::BadConfig)?;
    Ok(params)
}

fn apply(fields: &mut Value, model: &RobotModel, change: &str) -> Result<(), String> {
    let (key, text) = change.split_once('=').ok_or("must be KEY=VALUE")?;
    let path: Vec<&str> = key.trim().split('.').collect();
    let value: Value =
        serde_json::from_str(text.trim()).map_err(|_| format!("`{text}` is not a value"))?;
    set(fields, model, &path, &value)
}

/// Sets what `path` leads to: fields by name, values of lists by the name of their joint, link or foot. A field of a list's values without such
/// a name is set in all of them.
fn set(slot: &mut Value, model: &RobotModel, path: &[&str], value: &Value) -> Result<(), String> {
    match (slot, path) {
        (Value::Array(list), []) if !value.is_array() => list.fill(value.clone()),
        (slot, []) => *slot = value.clone(),
        (Value::Object(fields), [field, rest @ ..]) => {
            let known = fields.keys().cloned().collect::<Vec<_>>().join(", ");
            let slot = fields
                .get_mut(*field)
                .ok_or_else(|| format!("there is no `{field}`; known: {known}"))?;
            set(slot, model, rest, value).map_err(|reason| {
                match reason.strip_prefix(ONE_VALUE) {
                    Some(_) => format!("`{field}` is {ONE_VALUE}, not a list"),
                    None => reason,
                }
            })?;
        }
        (Value::Array(list), [name, rest @ ..]) => {
            let len = list.len();
            if list.first().is_some_and(|first| first.get(*name).is_some()) {
                for one in list {
                    set(one, model, path, value)?;
                }
            } else {
                set(&mut list[index_of(model, len, name)?], model, rest, value)?;
            }
        }
        _ => return Err(ONE_VALUE.to_owned()),
    }
    Ok(())
}

/// Why a path ends too late.
const ONE_VALUE: &str = "one value";

/// Where `name` is in a list of `len` values: of actuated joints, links, hinges without a servo, backlash hinges or feet, whichever has that many.
fn index_of(model: &RobotModel, len: usize, name: &str) -> Result<usize, String> {
    let joints = model.joints().iter();
    let backlash = joints
        .filter(|j| j.kind == JointKind::Backlash)
        .map(|j| j.name.as_str());
    let hinges = (model.joints().iter())
        .filter(|j| !matches!(j.kind, JointKind::Actuated { .. }))
        .map(|j| j.name.as_str());
    let lists: [(&str, Vec<&str>); 5] = [
        ("actuated joint", model.actuated_names()),
        (
            "link",
            model.links().iter().map(|l| l.name.as_str()).collect(),
        ),
        ("hinge", hinges.collect()),
        ("backlash hinge", backlash.collect()),
        (
            "foot",
            model.feet().iter().map(|f| f.name.as_str()).collect(),
        ),
    ];
    let mut fitting = lists
        .iter()
        .filter(|(_, names)| names.len() == len)
        .peekable();
    let what = fitting.peek().map_or("value", |(what, _)| *what);
    fitting
        .find_map(|(_, names)| names.iter().position(|n| *n == name))
        .ok_or_else(|| format!("there is no {what} `{name}`"))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn model() -> RobotModel {
        let path =
            std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("robots/polymander.robot.toml");
        RobotModel::load(&path).unwrap()
    }

    fn with(change: &str) -> Result<LaneParams, String> {
        changed(&model(), &[change.to_owned()]).map_err(|e| e.to_string())
    }

    #[test]
    fn numbers_lists_and_single_joints() {
        assert_eq!(with("foot_friction=0.5").unwrap().foot_friction, 0.5);
        assert_eq!(
            with("kp_nm_per_rad = 12").unwrap().kp_nm_per_rad,
            [12.0; 16]
        );
        let one = with("kp_nm_per_rad.FL_hip=9").unwrap().kp_nm_per_rad;
        // policy order: eight spine and tail joints, then FL_hip
        assert_eq!((one[7], one[8], one[9]), (15.0, 9.0, 15.0));
        let mass = with("link_mass_scale.body_01=1.5").unwrap();
        assert_eq!(mass.link_mass_scale.iter().sum::<f32>(), 19.5);
    }

    #[test]
    fn effects_of_all_joints_or_of_one() {
        let all = with("joints.dead_band_rad=0.02").unwrap();
        assert!(all.joints.iter().all(|j| j.dead_band_rad == 0.02));
        let one = with("joints.FL_hip.gear_half_gap_rad=0.002")
            .unwrap()
            .joints;
        assert_eq!(
            (one[7].gear_half_gap_rad, one[8].gear_half_gap_rad),
            (0.0, 0.002)
        );
        let water = with("water.body_00.buoyancy_scale=0.5").unwrap().water;
        assert_eq!(
            (water[0].buoyancy_scale, water[1].buoyancy_scale),
            (0.5, 1.0)
        );
        assert_eq!(
            with("command_loss.share=0.1").unwrap().command_loss.share,
            0.1
        );
        let tail = with("hinges.joint_body_09_passive.spring_nm_per_rad=2")
            .unwrap()
            .hinges;
        assert_eq!(
            tail.iter().filter(|h| h.spring_nm_per_rad == 2.0).count(),
            1
        );
    }

    #[test]
    fn what_does_not_fit_is_named() {
        for (change, reason) in [
            ("grip=1", "no `grip`"),
            ("foot_friction", "KEY=VALUE"),
            ("foot_friction=high", "not a value"),
            ("foot_friction=-1", "foot_friction"),
            ("foot_friction.FL=1", "one value"),
            ("kp_nm_per_rad.wing=1", "no actuated joint `wing`"),
            ("kp_nm_per_rad=[1,2]", "kp_nm_per_rad"),
            ("joints.FL_hip.slack=1", "no `slack`"),
            ("joints.wing.dead_band_rad=1", "no actuated joint `wing`"),
            ("joints.FL_hip.dead_band_rad=-1", "dead_band_rad"),
        ] {
            let message = with(change).unwrap_err();
            assert!(message.contains(reason), "{change}: {message}");
        }
    }

    #[test]
    fn other_keys_stay_with_the_configuration() {
        let flags = ConfigArgs {
            overrides: vec!["engine.dt_s=0.002".into(), "lane.supply_v=11".into()],
            ..ConfigArgs::default()
        };
        let (rest, lane) = split(&flags);
        assert_eq!(
            (rest.overrides, lane),
            (
                vec!["engine.dt_s=0.002".to_owned()],
                vec!["supply_v=11".to_owned()]
            )
        );
    }
}
