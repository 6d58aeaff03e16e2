//! Cases of the salamander. On the ground: play at a girdle, slippery feet, a payload, a slope. In water: drag, added mass, buoyancy and its centre, a
//! current, bobbing that dies faster. Seen by joints alone, with an IMU, or with motion capture.

use std::fs;
use std::path::Path;
use std::sync::Arc;

use caudata_model::RobotModel;
use caudata_random::{Key, Purpose, Stream};
use caudata_runlog::{BaseHold, LogMeta, LogWriter, Setting};
use caudata_sim::{LaneParams, LinkWater};

use crate::battery::RATE_HZ;
use crate::case::{Answer, Block, TrueEffect, TrueValue};
use crate::generate::GenerateError;
use crate::truth::free::{self, Beginning, Channels, Session};

/// Name of the rig in answers.
pub const RIG: &str = "polymander";

/// What is hidden. What acts on the ground or in water alone is no effect elsewhere.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Hides {
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
    /// Quadratic drag across all links, and against turning, as a factor.
    Drag(f64),
    /// Linear drag of all links, as a factor.
    LinearDrag(f64),
    /// Added mass and inertia across all links, as a share of the water displaced.
    AddedMass(f64),
    /// Buoyancy of all links, as a factor.
    Buoyancy(f64),
    /// The centre of buoyancy of each link is so many metres higher.
    BuoyancyCentre(f64),
    /// Heave damping of each link, N·s/m more.
    Heave(f64),
    /// The water flows along x, m/s.
    Current(f64),
}

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

/// Joints of the weak leg.
const WEAK_LEG: &str = "FL_";

/// Text of a robot file whose robot is the true one of `hidden` on top of `file`, to evaluate policies on; it needs the salamander's MJCF beside it.
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

/// A run: its name, its commands, and how it begins.
struct Script {
    name: &'static str,
    rows_rad: Vec<Vec<f64>>,
    begins: Beginning,
}

/// How long a run is, s.
const RUN_S: f64 = 6.0;
const TURN: f64 = std::f64::consts::TAU;

/// Full after a second.
fn soft(t: f64) -> f64 {
    t.clamp(0.0, 1.0)
}

/// Adds an angle (rad) to the command of a joint.
type Add<'a> = dyn FnMut(&str, f64) + 'a;

/// One row per period, each the nominal pose to which `at` adds what moves at a time (s).
fn rows(model: &RobotModel, at: &dyn Fn(f64, &mut Add<'_>)) -> Vec<Vec<f64>> {
    let names = model.actuated_names();
    let nominal = model.nominal_pos_rad().to_vec();
    (0..=(RUN_S * RATE_HZ) as usize)
        .map(|k| {
            let mut row = nominal.clone();
            at(k as f64 / RATE_HZ, &mut |name, x| {
                if let Some(i) = names.iter().position(|n| *n == name) {
                    row[i] += x;
                }
            });
            row
        })
        .collect()
}

/// Walking, rocking on four feet, lifting one foot after the other.
fn walks(model: &RobotModel, tempo: f64) -> Vec<Script> {
    let walk = rows(model, &|t, add| {
        let phase = TURN * tempo * t;
        for (leg, shift) in [("FL", 0.0), ("HR", 0.0), ("FR", 0.5), ("HL", 0.5)] {
            let p = phase + TURN * shift;
            add(&format!("{leg}_hip"), 0.35 * soft(t) * p.sin());
            add(&format!("{leg}_knee"), -0.45 * soft(t) * p.cos().max(0.0));
        }
        for i in 1..=4 {
            let bend = 0.12 * soft(t) * (phase + 0.6 * f64::from(i)).sin();
            add(&format!("spine_{i}"), bend);
        }
    });
    let rock = rows(model, &|t, add| {
        let (roll, pitch) = (
            0.22 * soft(t) * (TURN * 0.5 * tempo * t).sin(),
            0.18 * soft(t) * (TURN * 0.31 * tempo * t).sin(),
        );
        for leg in ["FL", "FR", "HL", "HR"] {
            let side = if leg.ends_with('L') { 1.0 } else { -1.0 };
            let end = if leg.starts_with('F') { 1.0 } else { -1.0 };
            add(&format!("{leg}_knee"), side * roll + end * pitch);
        }
    });
    let lift = rows(model, &|t, add| {
        let leg = ["FL", "HR", "FR", "HL"][(t / (1.5 / tempo)) as usize % 4];
        let x = (t / (1.5 / tempo)).fract();
        let up = -0.7 * (std::f64::consts::PI * x).sin().powi(2);
        add(&format!("{leg}_knee"), up);
    });
    let from_rest = |(name, rows_rad)| Script {
        name,
        rows_rad,
        begins: BaseHold::Free.into(),
    };
    [("walk", walk), ("rock", rock), ("lift", lift)]
        .map(from_rest)
        .into()
}

/// A hand that presses the trunk under water and rolls it: N, N·m.
const PRESS_N: f32 = 6.0;
const ROLL_NM: f32 = 0.03;

/// Swimming waves of three sizes at three tempos, a turn, swimming and coasting, and bobbing after a hand lets go.
fn swims(model: &RobotModel, tempo: f64) -> Vec<Script> {
    let names = model.actuated_names();
    let spine: Vec<&str> = (names.iter().copied())
        .filter(|n| n.starts_with("spine") || n.starts_with("tail"))
        .collect();
    // one wave on the body, larger towards the tail, on top of a bend; legs folded back
    let wave = |add: &mut Add<'_>, phase: f64, size: f64, bend: f64, legs: f64| {
        for (i, name) in spine.iter().enumerate() {
            let x = i as f64 / spine.len() as f64;
            let along = (phase - TURN * x).sin();
            add(name, size * (0.4 + 0.6 * x) * along + bend);
        }
        for leg in ["FL", "FR", "HL", "HR"] {
            add(&format!("{leg}_hip"), -0.6 * legs);
        }
    };
    let sizes = rows(model, &|t, add| {
        let part = ((t / 2.0) as usize).min(2);
        let within = t - 2.0 * part as f64;
        let (hz, size) = [(0.5, 0.4), (0.9, 0.28), (1.4, 0.15)][part];
        let fade = soft(2.0 * within) * soft(2.0 * (2.0 - within));
        wave(add, TURN * hz * tempo * t, fade * size, 0.0, soft(t));
    });
    let turn = rows(model, &|t, add| {
        let phase = TURN * 0.7 * tempo * t;
        wave(add, phase, 0.3 * soft(t), 0.12 * soft(t), soft(t));
    });
    let coast = rows(model, &|t, add| {
        let size = 0.35 * soft(t) * soft(2.0 * (3.0 - t));
        wave(add, TURN * tempo * t, size, 0.0, soft(t));
    });
    // with legs a little elsewhere, so that no run takes another one's hand for its own repeat
    let still = rows(model, &|_, add| {
        for leg in ["FL", "FR", "HL", "HR"] {
            add(&format!("{leg}_hip"), 0.3 * (1.0 - tempo));
        }
    });
    let pressed = tempo as f32;
    let at_rest = Beginning::from(BaseHold::Water);
    let pressed = Beginning {
        hand: [0.0, 0.0, -PRESS_N * pressed, ROLL_NM * pressed, 0.0, 0.0],
        ..at_rest
    };
    [
        ("sizes", sizes, at_rest),
        ("turn", turn, at_rest),
        ("coast", coast, at_rest),
        ("float", still, pressed),
    ]
    .map(|(name, rows_rad, begins)| Script {
        name,
        rows_rad,
        begins,
    })
    .into()
}

/// Does the same to each link in water.
fn links(lane: &mut LaneParams, change: impl Fn(&mut LinkWater)) {
    lane.water.iter_mut().for_each(change);
}

/// The robot with what is hidden.
pub(crate) fn lane_of(model: &RobotModel, hidden: Hides) -> LaneParams {
    let mut lane = LaneParams::nominal(model);
    let rad = |deg: f64| deg.to_radians() as f32;
    match hidden {
        Hides::Nothing => {}
        Hides::Play {
            hinge,
            half_width_deg,
        } => lane.backlash_half_width_rad[hinge] = rad(half_width_deg),
        Hides::Friction(factor) => lane.foot_friction *= factor as f32,
        Hides::Payload(kg) => {
            lane.payload_kg = kg as f32;
            lane.payload_m = model.links()[model.torso_link()].com_m.map(|x| x as f32);
        }
        Hides::Slope(deg) => lane.tilt_floor(0.0, rad(deg)),
        Hides::WeakLeg(share) => {
            for (kp, name) in lane.kp_nm_per_rad.iter_mut().zip(model.actuated_names()) {
                if name.starts_with(WEAK_LEG) {
                    *kp *= share as f32;
                }
            }
        }
        Hides::Paper {
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
        Hides::Current(mps) => lane.water_current_mps[0] += mps as f32,
        Hides::Drag(f) => links(&mut lane, |link| {
            link.quadratic_drag_scale_y *= f as f32;
            link.quadratic_drag_scale_z *= f as f32;
            link.quadratic_torque_scale *= f as f32;
        }),
        Hides::LinearDrag(f) => links(&mut lane, |link| link.linear_drag_scale *= f as f32),
        Hides::AddedMass(share) => links(&mut lane, |link| {
            link.added_mass_y += share as f32;
            link.added_mass_z += share as f32;
            link.added_inertia_y += share as f32;
            link.added_inertia_z += share as f32;
        }),
        Hides::Buoyancy(f) => links(&mut lane, |link| link.buoyancy_scale *= f as f32),
        Hides::BuoyancyCentre(up_m) => links(&mut lane, |link| link.buoyancy_z_m += up_m as f32),
        Hides::Heave(more) => links(&mut lane, |link| link.heave_damping_ns_per_m += more as f32),
    }
    lane
}

fn truth(model: &RobotModel, hidden: Hides) -> Vec<TrueEffect> {
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
        equivalent_beside: Vec::new(),
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
    let water = |effect: &str, name: &str, unit: &str, value: f64, nominal: f64| {
        one(effect, "water", "", &[name], unit, value, nominal)
    };
    match hidden {
        Hides::Nothing => Vec::new(),
        Hides::Play {
            hinge,
            half_width_deg,
        } => vec![play(&hinges[hinge], half_width_deg)],
        Hides::Friction(f) => {
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
        Hides::Payload(kg) => vec![one("payload", "inertia", "", &["mass"], "kg", kg, 0.0)],
        Hides::Slope(deg) => vec![one(
            "floor_slope",
            "inertia",
            "",
            &["pitch"],
            "rad",
            deg.to_radians(),
            0.0,
        )],
        Hides::WeakLeg(share) => model
            .actuated_names()
            .into_iter()
            .filter(|name| name.starts_with(WEAK_LEG))
            .map(|name| one("kp_error", "actuation", name, &["scale"], "", share, 1.0))
            .collect(),
        Hides::Paper {
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
        Hides::Drag(f) => vec![water("quadratic_drag", "across", "", f, 1.0)],
        Hides::LinearDrag(f) => vec![water("linear_drag", "scale", "", f, 1.0)],
        Hides::AddedMass(share) => vec![water("added_mass", "across", "", share, 0.0)],
        Hides::Buoyancy(f) => vec![water("buoyancy", "scale", "", f, 1.0)],
        Hides::BuoyancyCentre(m) => vec![water("buoyancy_centre", "z_m", "m", m, 0.0)],
        Hides::Heave(more) => vec![water("heave_damping", "extra", "N·s/m", more, 0.0)],
        Hides::Current(mps) => vec![water("water_current", "x_mps", "m/s", mps, 0.0)],
    }
}

/// Makes a case under `parent/<name>` and returns its answer, as long as `go_on` says so, which is asked before each run.
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
        let Script {
            name,
            rows_rad,
            begins,
        } = script;
        for r in 0..repeats {
            if !go_on() {
                return Err(GenerateError::Stopped);
            }
            let index = 10 * i as u64 + r;
            let session = Session::of_the_day(&model, &lane, plan.place, plan.seed, index);
            let key = Key {
                seed: plan.seed,
                actor: 13,
                env: index,
                episode: 0,
            };
            let mut stream = Stream::new(key, Purpose::Sensor);
            let log = free::run(
                &model,
                &session,
                rows_rad,
                plan.channels,
                *begins,
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
            meta.kp = Some(model.kp_nm_per_rad());
            meta.kd = Some(model.kd_nm_s_per_rad());
            meta.supply_v = Some((f64::from(session.lane.supply_v) * 10.0).round() / 10.0);
            let dir = folder.join(format!("{role}_{name}_{}", r + 1));
            let mut writer = LogWriter::create(&dir, &free::signals(&model, plan.channels), &meta)?;
            for (t, row) in &log {
                writer.row(*t, row)?;
            }
            writer.finish()?;
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
