//! Cases of the salamander on the ground: play at a girdle, slippery feet, a payload, a slope; seen by joints alone, with an IMU, or with motion
//! capture.

use std::fs;
use std::path::Path;
use std::sync::Arc;

use caudata_model::RobotModel;
use caudata_random::{Key, Purpose, Stream};
use caudata_runlog::{BaseHold, LogMeta, LogWriter};
use caudata_sim::LaneParams;

use crate::battery::RATE_HZ;
use crate::case::{Answer, Block, TrueEffect, TrueValue};
use crate::generate::GenerateError;
use crate::truth::free::{self, Channels, Ground};

/// Name of the rig in answers.
pub const RIG: &str = "polymander";

/// What is hidden.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum OnGround {
    /// Nothing.
    Nothing,
    /// Play at one hinge of the girdles (order of the robot file), half width in degrees.
    Play {
        /// Which of the robot file's play hinges.
        hinge: usize,
        /// Degrees, each side.
        half_width_deg: f64,
    },
    /// Sliding friction of the feet, as a factor.
    Friction(f64),
    /// Mass on the trunk, kg.
    Payload(f64),
    /// The floor rises forward by so many degrees.
    Slope(f64),
    /// The joints of the left front leg have so much of their gain.
    WeakLeg(f64),
    /// The paper's robot: play of so many degrees at all girdle hinges, a command low-pass (s) and a weaker envelope (factor).
    Paper {
        /// Degrees, each side.
        half_width_deg: f64,
        /// s.
        low_pass_s: f64,
        /// Factor on torques.
        torque: f64,
    },
}

/// Which robot file the lab has.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LabFile {
    /// Stiff girdles: what a lab's model is before anybody thought of play.
    Stiff,
    /// The one of this repository, which policies are trained in.
    AsShipped,
}

/// A case on the ground.
#[derive(Clone, Debug)]
pub struct GroundPlan {
    /// Folder name.
    pub name: String,
    /// The robot file that goes with the logs; what is hidden is hidden on top of it.
    pub file: LabFile,
    /// What is hidden.
    pub hidden: OnGround,
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
pub fn salamander(file: LabFile) -> Result<(String, String, Arc<RobotModel>), GenerateError> {
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

/// Joints of the weak leg.
const WEAK_LEG: &str = "FL_";

/// Text of a robot file whose robot is the true one of `hidden` on top of `file`, to evaluate policies on; it needs the salamander's MJCF beside it.
///
/// # Errors
/// [`GenerateError::Rig`].
pub fn true_salamander(file: LabFile, hidden: OnGround) -> Result<String, GenerateError> {
    let (toml, _, model) = salamander(file)?;
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

/// Commands: name and rows.
type Script = (&'static str, Vec<Vec<f64>>);

/// Walking, rocking on four feet, lifting one foot after the other.
fn scripts(model: &RobotModel, seconds: f64, tempo: f64) -> Vec<Script> {
    let names = model.actuated_names();
    let index = |name: &str| names.iter().position(|n| *n == name);
    let nominal = model.nominal_pos_rad().to_vec();
    let rows = |at: &dyn Fn(f64, &mut Vec<f64>)| -> Vec<Vec<f64>> {
        (0..=(seconds * RATE_HZ) as usize)
            .map(|k| {
                let t = k as f64 / RATE_HZ;
                let mut row = nominal.clone();
                at(t, &mut row);
                row
            })
            .collect()
    };
    let add = |row: &mut Vec<f64>, name: &str, x: f64| {
        if let Some(i) = index(name) {
            row[i] += x;
        }
    };
    let soft = |t: f64| t.min(1.0);
    let turn = std::f64::consts::TAU;
    let walk = rows(&|t, row| {
        let phase = turn * tempo * t;
        for (leg, shift) in [("FL", 0.0), ("HR", 0.0), ("FR", 0.5), ("HL", 0.5)] {
            let p = phase + turn * shift;
            add(row, &format!("{leg}_hip"), 0.35 * soft(t) * p.sin());
            add(
                row,
                &format!("{leg}_knee"),
                -0.45 * soft(t) * p.cos().max(0.0),
            );
        }
        for i in 1..=4 {
            add(
                row,
                &format!("spine_{i}"),
                0.12 * soft(t) * (phase + 0.6 * f64::from(i)).sin(),
            );
        }
    });
    let rock = rows(&|t, row| {
        let (roll, pitch) = (
            0.22 * soft(t) * (turn * 0.5 * tempo * t).sin(),
            0.18 * soft(t) * (turn * 0.31 * tempo * t).sin(),
        );
        for leg in ["FL", "FR", "HL", "HR"] {
            let side = if leg.ends_with('L') { 1.0 } else { -1.0 };
            let end = if leg.starts_with('F') { 1.0 } else { -1.0 };
            add(row, &format!("{leg}_knee"), side * roll + end * pitch);
        }
    });
    let lift = rows(&|t, row| {
        let leg = ["FL", "HR", "FR", "HL"][(t / (1.5 / tempo)) as usize % 4];
        let x = (t / (1.5 / tempo)).fract();
        add(
            row,
            &format!("{leg}_knee"),
            -0.7 * (std::f64::consts::PI * x).sin().powi(2),
        );
    });
    vec![("walk", walk), ("rock", rock), ("lift", lift)]
}

/// The robot with what is hidden.
pub(crate) fn lane_of(model: &RobotModel, hidden: OnGround) -> LaneParams {
    let mut lane = LaneParams::nominal(model);
    let rad = |deg: f64| deg.to_radians() as f32;
    match hidden {
        OnGround::Nothing => {}
        OnGround::Play {
            hinge,
            half_width_deg,
        } => lane.backlash_half_width_rad[hinge] = rad(half_width_deg),
        OnGround::Friction(factor) => lane.foot_friction *= factor as f32,
        OnGround::Payload(kg) => {
            lane.payload_kg = kg as f32;
            lane.payload_m = model.links()[model.torso_link()].com_m.map(|x| x as f32);
        }
        OnGround::Slope(deg) => lane.tilt_floor(0.0, rad(deg)),
        OnGround::WeakLeg(share) => {
            for (kp, name) in lane.kp_nm_per_rad.iter_mut().zip(model.actuated_names()) {
                if name.starts_with(WEAK_LEG) {
                    *kp *= share as f32;
                }
            }
        }
        OnGround::Paper {
            half_width_deg,
            low_pass_s,
            torque,
        } => {
            lane.backlash_half_width_rad.fill(rad(half_width_deg));
            lane.torque_scale.fill(torque as f32);
            for j in &mut lane.joints {
                j.command_low_pass_s = low_pass_s as f32;
            }
        }
    }
    lane
}

fn truth(model: &RobotModel, hidden: OnGround) -> Vec<TrueEffect> {
    let hinges: Vec<String> = model
        .backlash()
        .joints
        .iter()
        .map(|&j| model.joints()[j].name.clone())
        .collect();
    let one = |effect: &str,
               layer: &str,
               joint: &str,
               names: &[&str],
               unit: &str,
               value: f64,
               nominal: f64| TrueEffect {
        effect: effect.to_owned(),
        layer: layer.to_owned(),
        joint: joint.to_owned(),
        size: value,
        d: 0.0,
        equivalent: Vec::new(),
        parameters: vec![TrueValue {
            names: names.iter().map(|n| (*n).to_owned()).collect(),
            unit: unit.to_owned(),
            value,
            nominal,
        }],
    };
    let play = |joint: &str, deg: f64| {
        one(
            "girdle_play",
            "structure",
            joint,
            &["half"],
            "rad",
            deg.to_radians(),
            0.0,
        )
    };
    match hidden {
        OnGround::Nothing => Vec::new(),
        OnGround::Play {
            hinge,
            half_width_deg,
        } => vec![play(&hinges[hinge], half_width_deg)],
        OnGround::Friction(f) => {
            let nominal = model.contact().foot_friction;
            vec![one(
                "contact_friction",
                "contact",
                "",
                &["scale", "friction"],
                "",
                f * nominal,
                nominal,
            )]
        }
        OnGround::Payload(kg) => vec![one("payload", "inertia", "", &["mass"], "kg", kg, 0.0)],
        OnGround::Slope(deg) => vec![one(
            "floor_slope",
            "inertia",
            "",
            &["pitch"],
            "rad",
            deg.to_radians(),
            0.0,
        )],
        OnGround::WeakLeg(share) => model
            .actuated_names()
            .into_iter()
            .filter(|name| name.starts_with(WEAK_LEG))
            .map(|name| one("kp_error", "actuation", name, &["scale"], "", share, 1.0))
            .collect(),
        OnGround::Paper {
            half_width_deg,
            low_pass_s,
            torque,
        } => vec![
            play("", half_width_deg),
            one(
                "command_low_pass",
                "timing",
                "",
                &["time"],
                "s",
                low_pass_s,
                0.0,
            ),
            one(
                "torque_limit",
                "actuation",
                "",
                &["limit", "scale"],
                "N·m",
                torque * model.servo(0).tau_max_nm,
                model.servo(0).tau_max_nm,
            ),
        ],
    }
}

/// Makes a case under `parent/<name>` and returns its answer, as long as `go_on` says so, which is asked before each run.
///
/// # Errors
/// [`GenerateError`].
pub fn make(
    plan: &GroundPlan,
    parent: &Path,
    go_on: &dyn Fn() -> bool,
) -> Result<Answer, GenerateError> {
    let (toml, mjcf, model) = salamander(plan.file)?;
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
    let fit = scripts(&model, 6.0, 1.0);
    let held_out = scripts(&model, 6.0, 1.25);
    let all = fit
        .iter()
        .map(|s| ("fit", s, plan.repeats))
        .chain(held_out.iter().map(|s| ("holdout", s, 2)));
    for (i, (role, (name, rows), repeats)) in all.enumerate() {
        for r in 0..repeats {
            if !go_on() {
                return Err(GenerateError::Stopped);
            }
            let index = 10 * i as u64 + r;
            let ground = Ground::of_the_day(&model, &lane, plan.seed, index);
            let key = Key {
                seed: plan.seed,
                actor: 13,
                env: index,
                episode: 0,
            };
            let mut stream = Stream::new(key, Purpose::Sensor);
            let log = free::run(&model, &ground, rows, plan.channels, false, &mut stream)?;
            let mut meta = LogMeta::new("polymander", BaseHold::Free, RATE_HZ);
            meta.terrain = "flat".to_owned();
            meta.kp = Some(model.kp_nm_per_rad());
            meta.kd = Some(model.kd_nm_s_per_rad());
            meta.supply_v = Some((f64::from(ground.lane.supply_v) * 10.0).round() / 10.0);
            let dir = folder.join(format!("{role}_{name}_{}", r + 1));
            let mut writer = LogWriter::create(&dir, &free::signals(&model, plan.channels), &meta)?;
            for (t, row) in &log {
                writer.row(*t, row)?;
            }
            writer.finish()?;
        }
    }
    Ok(Answer {
        case: plan.name.clone(),
        block: if plan.hidden == OnGround::Nothing {
            Block::Null
        } else {
            Block::Ground
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
