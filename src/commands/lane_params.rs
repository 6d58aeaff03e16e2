//! `--set lane.KEY=VALUE`: one robot's physical parameters on the command line.
//!
//! `KEY` is a path of `LaneParams`, as in the `[extension.lane]` of a robot file:
//! `joints.FL_hip.dead_band_rad`. Names in its middle or at its end may be left out, and stand for all:
//! `kp_nm_per_rad`, `joints.dead_band_rad`. `VALUE` is a number, or a list of as many as there are.

use std::collections::BTreeSet;

use caudata_config::ConfigArgs;
use caudata_model::RobotModel;
use caudata_sim::LaneParams;
use caudata_telemetry::{ExitCode, Failure, FailureExt};

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
    let mut params = LaneParams::nominal(model);
    for change in changes {
        apply(&mut params, model, change).map_err(|reason| {
            let message = format!("--set {PREFIX}{change}: {reason}");
            Failure::message(ExitCode::BadConfig, message)
        })?;
    }
    params.validate(model, 0).or_exit(ExitCode::BadConfig)?;
    Ok(params)
}

fn apply(params: &mut LaneParams, model: &RobotModel, change: &str) -> Result<(), String> {
    let (key, text) = change.split_once('=').ok_or("must be KEY=VALUE")?;
    let (key, text) = (key.trim(), text.trim());
    let not_a_value = |_| format!("`{text}` is not a value");
    let values: Vec<f32> = match text.starts_with('[') {
        true => serde_json::from_str(text).map_err(not_a_value)?,
        false => vec![serde_json::from_str(text).map_err(not_a_value)?],
    };
    let (mut meant, mut known, mut inside) = (0, Vec::new(), Vec::new());
    params.visit(model, &mut |path, x| {
        if leads_to(key, path) {
            *x = *values.get(meant).or(values.first()).unwrap_or(x);
            meant += 1;
        }
        let head = path.split('.').next().unwrap_or_default();
        if known.last().is_none_or(|last| last != head) {
            known.push(head.to_owned());
        }
        if path.contains('.') && key.split('.').next() == Some(head) {
            inside.push(path.to_owned());
        }
    });
    match meant {
        0 => Err(format!("there is no `{key}`; {}", instead(key, &known, &inside))),
        _ if values.len() == 1 || values.len() == meant => Ok(()),
        _ => Err(format!("`{key}` is {meant} values, not {}", values.len())),
    }
}

/// What there is: first names, or where the first was right what `key` may look like.
fn instead(key: &str, first: &[String], inside: &[String]) -> String {
    let Some(example) = inside.first() else { return format!("known: {}", first.join(", ")) };
    let parts: Vec<Vec<&str>> = inside.iter().map(|path| path.split('.').collect()).collect();
    // the place of the first name that is at no path's
    let wrong = (1..parts[0].len())
        .find(|&at| {
            key.split('.').nth(at).is_none_or(|name| parts.iter().all(|p| p.get(at) != Some(&name)))
        })
        .unwrap_or(parts[0].len() - 1);
    let there: BTreeSet<&str> = parts.iter().filter_map(|p| p.get(wrong).copied()).collect();
    let there: Vec<&str> = there.into_iter().collect();
    format!("write it as `{example}`; name {} is one of: {}", wrong + 1, there.join(", "))
}

/// Whether `path` is `key` with names put in.
fn leads_to(key: &str, path: &str) -> bool {
    let mut path = path.split('.');
    key.split('.').enumerate().all(|(at, name)| match at {
        0 => path.next() == Some(name),
        _ => path.any(|part| part == name),
    })
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
        assert_eq!(with("kp_nm_per_rad = 12").unwrap().kp_nm_per_rad, [12.0; 16]);
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
        let one = with("joints.FL_hip.gear_half_gap_rad=0.002").unwrap().joints;
        assert_eq!((one[7].gear_half_gap_rad, one[8].gear_half_gap_rad), (0.0, 0.002));
        let water = with("water.body_00.buoyancy_scale=0.5").unwrap().water;
        assert_eq!((water[0].buoyancy_scale, water[1].buoyancy_scale), (0.5, 1.0));
        assert_eq!(with("command_loss.share=0.1").unwrap().command_loss.share, 0.1);
        let tail = with("hinges.joint_body_09_passive.spring_nm_per_rad=2").unwrap().hinges;
        assert_eq!(tail.iter().filter(|h| h.spring_nm_per_rad == 2.0).count(), 1);
    }

    #[test]
    fn what_does_not_fit_is_named() {
        for (change, reason) in [
            ("grip=1", "no `grip`"),
            ("foot_friction", "KEY=VALUE"),
            ("foot_friction=high", "not a value"),
            ("foot_friction=-1", "foot_friction"),
            ("foot_friction.FL=1", "no `foot_friction.FL`"),
            ("kp_nm_per_rad.wing=1", "no `kp_nm_per_rad.wing`"),
            ("kp_nm_per_rad=[1,2]", "is 16 values, not 2"),
            ("joints.FL_hip.slack=1", "no `joints.FL_hip.slack`"),
            ("joints.ki_nm_per_rad_s.FL_hip=1", "write it as `joints."),
            ("joints.ki_nm_per_rad_s.FL_hip=1", "; name 2 is one of: FL_hip, "),
            ("joints.FL_hip.slack=1", "; name 3 is one of: back_drive_kp_ratio, "),
            ("kp_nm_per_rad.wing=1", "; name 2 is one of: FL_hip"),
            ("joints.wing.dead_band_rad=1", "no `joints.wing.dead_band_rad`"),
            ("joints.FL_hip.dead_band_rad=-1", "dead_band_rad"),
        ] {
            let message = with(change).unwrap_err();
            assert!(message.contains(reason), "{change}: {message}");
        }
    }

    #[test]
    fn a_list_gives_each_its_own() {
        let moon = with("gravity_mps2=[0, 0.5, -1.62]").unwrap();
        assert_eq!(moon.gravity_mps2, [0.0, 0.5, -1.62]);
        let down = with("com_offset_m.z=-0.01").unwrap().com_offset_m;
        assert!(down.iter().all(|offset| *offset == [0.0, 0.0, -0.01]));
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
            (vec!["engine.dt_s=0.002".to_owned()], vec!["supply_v=11".to_owned()])
        );
    }
}
