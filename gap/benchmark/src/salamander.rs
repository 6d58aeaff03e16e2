//! Cases of the salamander. On the ground: play at a girdle, slippery feet, a payload, a slope. In water:
//! drag, added mass, buoyancy and its centre, a current, bobbing that dies faster. Seen by joints alone, with
//! an IMU, or with motion capture.

use std::fs;
use std::path::Path;
use std::sync::Arc;

use caudata_model::RobotModel;
use caudata_runlog::BaseHold;
use caudata_sim::LaneParams;

use crate::case::{Answer, Block};
use crate::file::at;
use crate::generate::GenerateError;
use crate::hides::{lane_of, truth};
use crate::scripts::{swims, walks};
use crate::simulated::{self, Robot};
use crate::truth::free::Channels;

pub use crate::hides::Hides;

/// Name of the rig in answers.
pub const RIG: &str = "polymander";

/// Which robot file the lab has.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LabFile {
    /// Stiff girdles: what a lab's model is before anybody thought of play.
    Stiff,
    /// The one of this repository, which policies are trained in.
    AsShipped,
}

/// A case of the salamander.
#[derive(Clone, Debug)]
pub struct SalamanderPlan {
    /// Folder name.
    pub name: String,
    /// The robot file that goes with the logs; what is hidden is hidden on top of it.
    pub file: LabFile,
    /// On the ground or in water.
    pub place: BaseHold,
    /// What is hidden.
    pub hidden: Hides,
    /// What is recorded.
    pub channels: Channels,
    /// Seed.
    pub seed: u64,
    /// Repeats of each fit trial.
    pub repeats: u64,
}

/// The salamander as the lab's file has it. Text of the robot file and of the MJCF.
///
/// # Errors
/// [`GenerateError::Rig`].
pub fn lab_file(file: LabFile) -> Result<(String, String, Arc<RobotModel>), GenerateError> {
    let nominal = include_str!("../../../robots/polymander.robot.toml");
    let mjcf = include_str!("../../../robots/polymander.xml").to_owned();
    let toml: String = nominal
        .lines()
        .map(|line| {
            if file == LabFile::Stiff && line.starts_with("half_width_rad") {
                "half_width_rad = 0.0"
            } else {
                line
            }
        })
        .map(|line| format!("{line}\n"))
        .collect();
    let model = RobotModel::from_bytes("polymander", toml.as_bytes(), mjcf.as_bytes())
        .map_err(|e| GenerateError::Rig("polymander".to_owned(), e))?;
    Ok((toml, mjcf, Arc::new(model)))
}

/// Text of a robot file whose robot is the true one of `hidden` on top of `file`, to evaluate policies on; it
/// needs the salamander's MJCF beside it.
///
/// # Errors
/// [`GenerateError::Rig`].
pub fn true_salamander(file: LabFile, hidden: Hides) -> Result<String, GenerateError> {
    let (toml, _, model) = lab_file(file)?;
    let mut nominal = std::collections::BTreeMap::new();
    LaneParams::nominal(&model).visit(&model, &mut |path, x| {
        nominal.insert(path.to_owned(), *x);
    });
    let mut changes = String::new();
    lane_of(&model, hidden).visit(&model, &mut |path, x| {
        if nominal.get(path) != Some(x) {
            changes += &format!("{path:?} = {:?}\n", f64::from(*x));
        }
    });
    Ok(format!(
        "{toml}\n[extension]\nbase = \"{}\"\n\n[extension.lane]\n{changes}",
        model.hash_hex()
    ))
}

/// Makes a case under `parent/<name>` and returns its answer, as long as `go_on` says so, which is asked
/// before each run.
pub fn make(
    plan: &SalamanderPlan,
    parent: &Path,
    go_on: &dyn Fn() -> bool,
) -> Result<Answer, GenerateError> {
    let (toml, mjcf, model) = lab_file(plan.file)?;
    let folder = parent.join(&plan.name);
    fs::create_dir_all(&folder).map_err(at(&folder))?;
    for (name, text) in [("polymander.robot.toml", &toml), ("polymander.xml", &mjcf)] {
        let path = folder.join(name);
        fs::write(&path, text).map_err(at(&path))?;
    }
    let lane = lane_of(&model, plan.hidden);
    let robot = Robot { lab: &model, model: &model, lane: &lane, seed: plan.seed, payload: &[] };
    let scripts = match plan.place {
        BaseHold::Water => swims,
        BaseHold::Fixed | BaseHold::Free => walks,
    };
    let (fit, held_out) = (scripts(&model, 1.0), scripts(&model, 1.25));
    let all = fit
        .iter()
        .map(|s| ("fit", s, plan.repeats))
        .chain(held_out.iter().map(|s| ("holdout", s, 2)));
    for (i, (role, script, repeats)) in all.enumerate() {
        for r in 0..repeats {
            if !go_on() {
                return Err(GenerateError::Stopped);
            }
            let index = 10 * i as u64 + r;
            let dir = folder.join(format!("{role}_{}_{}", script.name, r + 1));
            simulated::rows(&robot, &script.rows_rad, script.begins, plan.channels, index, &dir)?;
        }
    }
    Ok(Answer {
        case: plan.name.clone(),
        block: match (plan.hidden, plan.place) {
            (Hides::Nothing, _) => Block::Null,
            (_, BaseHold::Water) => Block::Water,
            (_, BaseHold::Fixed | BaseHold::Free) => Block::Ground,
        },
        rig: RIG.to_owned(),
        seed: plan.seed,
        effects: truth(&model, plan.hidden),
        ..Answer::default()
    })
}
