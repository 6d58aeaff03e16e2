//! Legs that the nominal pose stretches out: at the end of their reach they push and step badly.

use std::path::Path;

use caudata_model::import::{ImportOptions, import};
use caudata_model::{Pose, RobotModel};
use caudata_studies::files;
use toml::{Table, Value};

use crate::run::Run;
use crate::suspect::{Edit, Suspect};

/// How much farther a foot is below its hip than in a pose with bent knees, from which on its leg is stretched:
/// bent it reaches down by three quarters of what it can, here by 96 %, its knee bent by less than 30°.
const STRETCHED: f64 = 0.96 / 0.75;
/// Joints nearer than this to the pose with bent knees stay as they are, rad.
const NEAR_RAD: f64 = 0.02;

/// The suspect, where the legs of the run's robot are stretched out and a pose with bent knees can be worked out.
pub fn suspect(run: &Run) -> Option<Suspect> {
    let path = run.config.robot_path();
    let text = String::from_utf8(files::read(&path).ok()?).ok()?;
    let file: Table = text.parse().ok()?;
    let mjcf = file.get("mjcf").and_then(Value::as_str)?;
    of(&run.model, &path.with_file_name(mjcf))
}

fn of(model: &RobotModel, mjcf: &Path) -> Option<Suspect> {
    let bent = import(mjcf, &ImportOptions::default()).ok()?;
    let bent =
        RobotModel::from_bytes("bent", bent.robot_toml.as_bytes(), bent.mjcf.as_bytes()).ok()?;
    let below = |robot: &RobotModel| {
        let pos = robot.full_pos_rad(robot.nominal_pos_rad()).ok()?;
        let places = robot.kinematics(&Pose::IDENTITY, &pos).ok()?;
        let leg = |foot: usize| {
            let end = &robot.feet()[foot];
            let up = |&link: &usize| robot.links()[link].parent;
            let leg = std::iter::successors(Some(end.link), up)
                .take_while(|&link| robot.leg_of(link) == Some(foot));
            let hip_m = places.links[leg.last()?].pos_m[2];
            Some(hip_m - places.links[end.link].point(end.centre_m)[2])
        };
        (0..robot.feet().len()).map(leg).collect::<Option<Vec<f64>>>()
    };
    let (now, then) = (below(model)?, below(&bent)?);
    let stretched = now.len() == then.len()
        && now.iter().zip(&then).all(|(a, b)| *b > 0.0 && *a > STRETCHED * b);
    if now.is_empty() || !stretched {
        return None;
    }
    let names = model.actuated_names();
    let (from, to) = (model.nominal_pos_rad(), bent.nominal_pos_rad());
    let turned = (0..names.len()).filter_map(|joint| {
        let other = bent.actuated_names().iter().position(|name| *name == names[joint])?;
        ((from[joint] - to[other]).abs() > NEAR_RAD).then(|| (names[joint].to_owned(), to[other]))
    });
    let turned: Vec<(String, f64)> = turned.collect();
    Some(Suspect {
        id: "legs_straight",
        keys: turned.iter().map(|(joint, _)| format!("robot.{joint}")).collect(),
        says: "the legs are stretched out in the nominal pose, at the end of their reach"
            .to_owned(),
        edit: Edit::All(
            turned.into_iter().map(|(joint, rad)| Edit::Nominal { joint, rad }).collect(),
        ),
        suspicion: 2.5,
    })
}

#[cfg(test)]
mod tests {
    use std::path::PathBuf;

    use super::*;

    fn robots() -> PathBuf {
        Path::new(env!("CARGO_MANIFEST_DIR")).join("../../robots")
    }

    /// A shipped robot, its nominal pose changed by a function of the joint's name.
    fn robot(name: &str, pose: impl Fn(&str, f64) -> f64) -> RobotModel {
        let read =
            |end: &str| std::fs::read_to_string(robots().join(format!("{name}.{end}"))).unwrap();
        let mut file: Table = read("robot.toml").parse().unwrap();
        let nominal = file["pose"]["nominal_rad"].as_table_mut().unwrap();
        for (joint, rad) in nominal.iter_mut() {
            *rad = Value::Float(pose(joint, rad.as_float().unwrap()));
        }
        let mjcf = read("xml");
        RobotModel::from_bytes(name, file.to_string().as_bytes(), mjcf.as_bytes()).unwrap()
    }

    #[test]
    fn a_quadruped_on_straight_legs_is_suspect_and_no_shipped_robot_is() {
        for name in ["polymander", "quadruped", "biped", "hexapod", "snake"] {
            let mjcf = robots().join(format!("{name}.xml"));
            assert_eq!(of(&robot(name, |_, rad| rad), &mjcf), None, "{name}");
        }
        let straight = |joint: &str, rad: f64| match () {
            () if joint.ends_with("_thigh") => 0.4,
            () if joint.ends_with("_calf") => -0.9,
            () => rad,
        };
        let mjcf = robots().join("quadruped.xml");
        let found = of(&robot("quadruped", straight), &mjcf).unwrap();
        assert!(found.keys.contains(&"robot.FL_calf".to_owned()), "{:?}", found.keys);
        let Edit::All(edits) = &found.edit else { panic!("{:?}", found.edit) };
        let knee = edits.iter().find_map(|edit| match edit {
            Edit::Nominal { joint, rad } if joint == "FL_calf" => Some(*rad),
            _ => None,
        });
        assert!(knee.unwrap() < -1.0, "{knee:?}");
    }
}
