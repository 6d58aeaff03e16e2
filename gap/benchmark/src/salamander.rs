//! Cases of the salamander. On the ground: play at a girdle, slippery feet, a payload, a slope. In water:
//! drag, added mass, buoyancy and its centre, a current, bobbing that dies faster. Seen by joints alone, with
//! an IMU, or with motion capture.

use std::fs;
use std::path::Path;
use std::sync::Arc;

use caudata_model::RobotModel;
use caudata_random::{Key, Purpose, Stream};
use caudata_runlog::{BaseHold, LogMeta, LogWriter, Setting};
use caudata_sim::LaneParams;

use crate::battery::RATE_HZ;
use crate::case::{Answer, Block};
use crate::generate::GenerateError;
use crate::hides::{lane_of, truth};
use crate::scripts::{Script, swims, walks};
use crate::truth::free::{self, Channels, Session};

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
///
/// # Errors
/// [`GenerateError`].
pub fn make(
    plan: &SalamanderPlan,
    parent: &Path,
    go_on: &dyn Fn() -> bool,
) -> Result<Answer, GenerateError> {
    let (toml, mjcf, model) = lab_file(plan.file)?;
    let folder = parent.join(&plan.name);
    let io = |path: &Path| {
        let path = path.to_owned();
        move |source| GenerateError::Io { path, source }
    };
    fs::create_dir_all(&folder).map_err(io(&folder))?;
    for (name, text) in [("polymander.robot.toml", &toml), ("polymander.xml", &mjcf)] {
        let path = folder.join(name);
        fs::write(&path, text).map_err(io(&path))?;
    }
    let lane = lane_of(&model, plan.hidden);
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
            record(plan, &model, &lane, script, index, &dir)?;
        }
    }
    Ok(Answer {
        together_d: 0.0,
        case: plan.name.clone(),
        block: match (plan.hidden, plan.place) {
            (Hides::Nothing, _) => Block::Null,
            (_, BaseHold::Water) => Block::Water,
            (_, BaseHold::Fixed | BaseHold::Free) => Block::Ground,
        },
        rig: RIG.to_owned(),
        seed: plan.seed,
        target_d: 0.0,
        effects: truth(&model, plan.hidden),
        without: Vec::new(),
        decoy: String::new(),
        fault: false,
        fault_kinds: Vec::new(),
    })
}

/// Records one run into `dir`.
fn record(
    plan: &SalamanderPlan,
    model: &Arc<RobotModel>,
    lane: &LaneParams,
    script: &Script,
    index: u64,
    dir: &Path,
) -> Result<(), GenerateError> {
    let session = Session::of_the_day(model, lane, plan.place, plan.seed, index);
    let key = Key {
        seed: plan.seed,
        actor: 13,
        env: index,
        episode: 0,
    };
    let mut stream = Stream::new(key, Purpose::Sensor);
    let rows = &script.rows_rad;
    let log = free::run(
        model,
        &session,
        rows,
        plan.channels,
        script.begins,
        &mut stream,
    )?;
    let mut meta = LogMeta::new("polymander", plan.place, RATE_HZ);
    meta.terrain = match plan.place {
        BaseHold::Water => "deep_water",
        BaseHold::Fixed | BaseHold::Free => "flat",
    }
    .to_owned();
    if plan.place == BaseHold::Water {
        let level = Setting::Number(free::WATER_LEVEL_M);
        meta.settings.insert("water_level_m".to_owned(), level);
    }
    meta.kp = model.common_gains().map(|g| g.kp_nm_per_rad);
    meta.kd = model.common_gains().map(|g| g.kd_nm_s_per_rad);
    meta.supply_v = Some((f64::from(session.lane.supply_v) * 10.0).round() / 10.0);
    let mut writer = LogWriter::create(dir, &free::signals(model, plan.channels), &meta)?;
    for (t, row) in &log {
        writer.row(*t, row)?;
    }
    Ok(writer.finish()?)
}
