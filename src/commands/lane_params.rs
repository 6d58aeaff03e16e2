//! `--set lane.KEY=VALUE`: one robot's physical parameters on the command line.
//!
//! `KEY` is a field of `LaneParams`. A number given for a list fills it; `KEY.NAME` is one joint's, link's or foot's value in it. In lists of tables,
//! `KEY.FIELD` is that field of all, `KEY.NAME.FIELD` of one.

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
    let value =
        serde_json::from_str(text.trim()).map_err(|_| format!("`{text}` is not a value"))?;
    let path: Vec<&str> = key.trim().split('.').collect();
    put(fields, model, &path, &value)
}

/// Puts `value` at `path` below `slot`.
fn put(slot: &mut Value, model: &RobotModel, path: &[&str], value: &Value) -> Result<(), String> {
    let Some((name, rest)) = path.split_first() else {
        match slot {
            Value::Array(list) if !value.is_array() => list.fill(value.clone()),
            slot => *slot = value.clone(),
        }
        return Ok(());
    };
    match slot {
        Value::Object(fields) => {
            let known: Vec<String> = fields.keys().cloned().collect();
            let field = fields
                .get_mut(*name)
                .ok_or_else(|| format!("there is no `{name}`; known: {}", known.join(", ")))?;
            put(field, model, rest, value)
        }
        Value::Array(list) => match index_of(model, list.len(), name) {
            Ok(at) => put(&mut list[at], model, rest, value),
            // no element's name: a field that all of them have
            Err(_) if list.iter().all(Value::is_object) => list
                .iter_mut()
                .try_for_each(|each| put(each, model, path, value)),
            Err(reason) => Err(reason),
        },
        _ => Err(format!("there is nothing called `{name}` in one value")),
    }
}

/// Where `name` is in a list of `len` values: of actuated joints, links, backlash hinges or feet, whichever has that many.
fn index_of(model: &RobotModel, len: usize, name: &str) -> Result<usize, String> {
    let joints = model.joints().iter();
    let backlash = joints
        .filter(|j| j.kind == JointKind::Backlash)
        .map(|j| j.name.as_str());
    let lists: [(&str, Vec<&str>); 4] = [
        ("actuated joint", model.actuated_names()),
        (
            "link",
            model.links().iter().map(|l| l.name.as_str()).collect(),
        ),
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
        let all = with("joints.dead_band_rad=0.01").unwrap().joints;
        assert!(all.iter().all(|j| j.dead_band_rad == 0.01));
        let one = with("joints.FL_hip.dead_band_rad=0.01").unwrap().joints;
        assert_eq!((one[7].dead_band_rad, one[8].dead_band_rad), (0.0, 0.01));
    }

    #[test]
    fn what_does_not_fit_is_named() {
        for (change, reason) in [
            ("grip=1", "no `grip`"),
            ("foot_friction", "KEY=VALUE"),
            ("foot_friction=high", "not a value"),
            ("foot_friction=-1", "foot_friction"),
            ("foot_friction.FL=1", "one value"),
            ("joints.FL_hip.wobble=1", "no `wobble`"),
            ("kp_nm_per_rad.wing=1", "no actuated joint `wing`"),
            ("kp_nm_per_rad=[1,2]", "kp_nm_per_rad"),
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
