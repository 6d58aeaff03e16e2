//! The experiment battery: commands that bring out what a robot's simulation may get wrong, within what its
//! joints, speeds and motors stand.
//!
//! Each trial says which effects it is made for; [`next`] picks the one that best tells a set of effects
//! apart. Trials of single joints move every chosen joint at once on a stand, turned and paced apart;
//! [`Trial::to_csv`] gives the command file that `caudata sim rollout` and the robot's player read (`t`,
//! `cmd.<joint>`, and `on.<joint>` where a joint is let go).

mod body;
mod legs;
mod limits;
mod recipes;
mod wave;

use caudata_model::RobotModel;
use caudata_runlog::{BaseHold, LogError, Signal, TableWriter};
use serde::Serialize;

pub use limits::{HOLD_SHARE, HOT_SHARE, JointLimits};

use crate::report::NextExperiment;
use body::Body;
use recipes::{Make, Place, RECIPES, Recipe};
use wave::Wave;

/// Rows per second of command files: twice the robot's control rate, so that a step's edge falls where it was
/// meant to.
pub const DEFAULT_RATE_HZ: f64 = 100.0;

/// Why there is no such trial.
#[derive(Debug, thiserror::Error)]
#[expect(missing_docs, reason = "a message says what its fields are")]
pub enum ExciteError {
    /// No such joint.
    #[error("the robot has no actuated joint `{joint}`; it has {known}")]
    Joint { joint: String, known: String },
    /// No such trial, or not for this robot.
    #[error("there is no trial `{trial}` for this robot; there are {known}")]
    Trial { trial: String, known: String },
    /// A rate that makes no sense.
    #[error("a rate of {0} Hz is not between 10 and 1000")]
    Rate(f64),
}

/// One experiment.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Trial {
    /// Name, also of its file.
    pub name: String,
    /// What is done, in a few words.
    pub purpose: String,
    /// How the robot is held.
    pub base: BaseHold,
    /// How often to record it.
    pub repeats: usize,
    /// Joints that move.
    pub joints: Vec<String>,
    /// Effects that it is made to show, best first.
    pub excites: Vec<String>,
    /// s.
    pub duration_s: f64,
    /// Root mean square torque that the motion asks of its hardest joint, as a share of the greatest, with
    /// the base held level.
    pub effort: f64,
    /// Rows per second.
    pub rate_hz: f64,
    /// Names of all joints, policy order. `[A]`
    #[serde(skip)]
    pub columns: Vec<String>,
    /// rad. `[T][A]`
    #[serde(skip)]
    pub commands_rad: Vec<Vec<f64>>,
    /// Whether a joint is powered. `[T][A]`; empty where all always are.
    #[serde(skip)]
    pub on: Vec<Vec<bool>>,
}

impl Trial {
    /// The command file.
    ///
    /// # Errors
    /// [`LogError::Refused`] for joint names that a log cannot have.
    pub fn to_csv(&self) -> Result<Vec<u8>, LogError> {
        let named = |of: fn(String) -> Signal| self.columns.iter().cloned().map(of);
        let mut signals: Vec<Signal> = named(Signal::Command).collect();
        if !self.on.is_empty() {
            signals.extend(named(Signal::Enabled));
        }
        let mut table = TableWriter::new(Vec::new(), &signals, f64::INFINITY)?;
        for (k, row) in self.commands_rad.iter().enumerate() {
            // no finer than a thousandth of an encoder step
            let mut values: Vec<Option<f64>> =
                row.iter().map(|q| Some((q * 1e6).round() / 1e6)).collect();
            if let Some(on) = self.on.get(k) {
                values.extend(on.iter().map(|on| Some(f64::from(u8::from(*on)))));
            }
            let t_s = k as f64 / self.rate_hz;
            table.row((t_s * 1e6).round() / 1e6, &values)?;
        }
        table.finish()
    }
}

/// All trials for `robot`, in the order in which to record them: those that load little first.
///
/// `joint`: move only this one; single-joint trials only.
///
/// # Errors
/// [`ExciteError`] for an unknown joint or a rate that makes no sense.
pub fn battery(
    robot: &RobotModel,
    joint: Option<&str>,
    rate_hz: f64,
) -> Result<Vec<Trial>, ExciteError> {
    let maker = Maker::new(robot, joint, rate_hz)?;
    Ok(RECIPES.iter().filter_map(|r| maker.make(r)).collect())
}

/// The trial called `name`.
///
/// # Errors
/// [`ExciteError`] for an unknown joint, trial or rate.
pub fn trial(
    robot: &RobotModel,
    name: &str,
    joint: Option<&str>,
    rate_hz: f64,
) -> Result<Trial, ExciteError> {
    let maker = Maker::new(robot, joint, rate_hz)?;
    let wanted = RECIPES.iter().find(|r| r.name == name);
    wanted.and_then(|r| maker.make(r)).ok_or_else(|| ExciteError::Trial {
        trial: name.to_owned(),
        known: names(robot, joint).join(", "),
    })
}

/// Names of the trials that `robot` can do.
pub fn names(robot: &RobotModel, joint: Option<&str>) -> Vec<&'static str> {
    RECIPES.iter().filter(|r| fits(r, robot, joint)).map(|r| r.name).collect()
}

/// Whether a trial of the battery moves the joint that it is asked for, and not all that it needs.
pub fn moves_one_joint(trial: &str) -> bool {
    RECIPES.iter().any(|r| r.name == trial && matches!(r.make, Make::Joint(_)))
}

/// The trial of the battery that a run's name or notes name; the longest name where several do.
pub fn names_in(text: &str) -> Option<&'static str> {
    let is_letter = |c: char| c.is_ascii_alphanumeric();
    let whole = |name: &str| {
        text.match_indices(name).any(|(at, _)| {
            let before = text[..at].chars().next_back();
            let after = text[at + name.len()..].chars().next();
            !before.is_some_and(is_letter) && !after.is_some_and(char::is_alphabetic)
        })
    };
    let named = RECIPES.iter().map(|r| r.name).filter(|name| whole(name));
    named.max_by_key(|name| name.len())
}

/// The trial that says most about `separates` (effect ids): made for as many of them as possible, and for
/// each as directly as possible. `joints`: where the effects are suspected; empty: anywhere. `None` where no
/// trial of the battery shows any of them.
pub fn next(robot: &RobotModel, separates: &[&str], joints: &[String]) -> Option<NextExperiment> {
    let one = (joints.len() == 1).then(|| joints[0].as_str());
    // First in a trial's list counts 1, each place after it less; what it also shows of other effects does
    // not count.
    let worth = |r: &Recipe| -> f64 {
        let of = |e: &&str| {
            let place = r.excites.iter().position(|x| x == e);
            place.map_or(0.0, |p| 1.0 / (1.0 + 0.25 * p as f64))
        };
        separates.iter().map(of).sum()
    };
    // of equals the first: it loads the robot least
    let best = RECIPES
        .iter()
        .rev()
        .filter(|r| fits(r, robot, None) && worth(r) > 0.0)
        .max_by(|a, b| worth(a).total_cmp(&worth(b)))?;
    let shown: Vec<String> =
        separates.iter().filter(|e| best.excites.contains(e)).map(|e| (*e).to_owned()).collect();
    let on_one = matches!(best.make, Make::Joint(_)).then_some(one).flatten();
    let place = match best.place {
        Place::Stand => "on a stand",
        Place::Ground => "on the ground",
        Place::Water => "in water",
    };
    Some(NextExperiment {
        trial: best.name.to_owned(),
        joints: on_one.map(|j| vec![j.to_owned()]).unwrap_or_default(),
        reason: format!(
            "{}, {place}, {} times: made to show {}",
            best.purpose,
            best.repeats,
            shown.join(", ")
        ),
        separates: separates.iter().map(|e| (*e).to_owned()).collect(),
        payload: None,
    })
}

fn fits(recipe: &Recipe, robot: &RobotModel, joint: Option<&str>) -> bool {
    match (&recipe.make, recipe.place) {
        (Make::Joint(_), _) => true,
        (Make::Body(_), _) if joint.is_some() => false,
        (Make::Body(_), Place::Stand) => robot.actuated().len() > 1,
        (Make::Body(_), Place::Ground) => robot.feet().len() >= 2,
        (Make::Body(_), Place::Water) => robot.water().is_some(),
    }
}

/// Motions take at most this share of the greatest torque (root mean square); poses have their own,
/// [`HOLD_SHARE`].
const MOTION_SHARE: f64 = 0.2;
/// How often a motion is halved to get there.
const MOST_HALVINGS: i32 = 5;

struct Maker<'a> {
    robot: &'a RobotModel,
    joint: Option<&'a str>,
    rate_hz: f64,
    limits: Vec<JointLimits>,
}

impl<'a> Maker<'a> {
    fn new(
        robot: &'a RobotModel,
        joint: Option<&'a str>,
        rate_hz: f64,
    ) -> Result<Self, ExciteError> {
        let known = robot.actuated_names();
        if let Some(joint) = joint.filter(|j| !known.contains(j)) {
            return Err(ExciteError::Joint { joint: joint.to_owned(), known: known.join(", ") });
        }
        if !(10.0..=1000.0).contains(&rate_hz) {
            return Err(ExciteError::Rate(rate_hz));
        }
        Ok(Self { robot, joint, rate_hz, limits: JointLimits::all(robot) })
    }

    fn make(&self, recipe: &Recipe) -> Option<Trial> {
        if !fits(recipe, self.robot, self.joint) {
            return None;
        }
        let (commands_rad, on) = match recipe.make {
            Make::Joint(write) => self.joints(write),
            Make::Body(write) => {
                let mut body = Body::new(self.robot, &self.limits, self.rate_hz);
                if recipe.place == Place::Ground && !body.has_legs() {
                    return None;
                }
                body.hold(0.5);
                write(&mut body);
                body.hold(0.5);
                (self.lightened(body.rows), Vec::new())
            }
        };
        let moves = |a: usize| {
            let column = || commands_rad.iter().map(|row| row[a]);
            let still = column().all(|q| (q - commands_rad[0][a]).abs() < 1e-9);
            !still || on.iter().any(|row| !row[a])
        };
        let columns: Vec<String> = self.limits.iter().map(|l| l.name.clone()).collect();
        Some(Trial {
            name: recipe.name.to_owned(),
            purpose: recipe.purpose.to_owned(),
            base: match recipe.place {
                Place::Stand => BaseHold::Fixed,
                Place::Ground => BaseHold::Free,
                Place::Water => BaseHold::Water,
            },
            repeats: recipe.repeats,
            joints: (0..columns.len()).filter(|&a| moves(a)).map(|a| columns[a].clone()).collect(),
            excites: recipe.excites.iter().map(|e| (*e).to_owned()).collect(),
            duration_s: (commands_rad.len() - 1) as f64 / self.rate_hz,
            effort: self.effort(&commands_rad),
            rate_hz: self.rate_hz,
            columns,
            commands_rad,
            on,
        })
    }

    /// A single-joint motion for each chosen joint; the others stay nominal.
    fn joints(&self, write: fn(&mut Wave<'_>)) -> (Vec<Vec<f64>>, Vec<Vec<bool>>) {
        let columns: Vec<(Vec<f64>, Vec<bool>)> = self
            .limits
            .iter()
            .enumerate()
            .map(|(a, limits)| {
                let alone = self.joint.is_some();
                let sign = if a % 2 == 0 || alone { 1.0 } else { -1.0 };
                let pace = if alone { 1.0 } else { 1.0 + 0.02 * a as f64 };
                let written = |scale: f64| {
                    let mut wave = Wave::new(limits, self.rate_hz, sign, pace);
                    wave.scale = scale;
                    wave.hold(0.5 + if alone { 0.0 } else { 0.2 * (a % 4) as f64 });
                    if self.joint.is_none_or(|j| j == limits.name) {
                        write(&mut wave);
                        wave.go(limits.nominal_rad);
                        wave.hold(0.5);
                    }
                    wave.finish()
                };
                // a joint that carries half the robot does less of it
                let mut best = written(1.0);
                for k in 1..=MOST_HALVINGS {
                    if self.joint_effort(limits, &best.0) <= MOTION_SHARE {
                        break;
                    }
                    best = written(0.5f64.powi(k));
                }
                best
            })
            .collect();
        let n = columns.iter().map(|c| c.0.len()).max().unwrap_or(0);
        let row = |k: usize| {
            columns.iter().map(|c| c.0.get(k).or(c.0.last()).copied().unwrap_or(0.0)).collect()
        };
        let powered =
            |k: usize| columns.iter().map(|c| c.1.get(k).copied().unwrap_or(true)).collect();
        let commands = (0..n).map(row).collect();
        let dropped = columns.iter().any(|c| c.1.contains(&false));
        let on = if dropped { (0..n).map(powered).collect() } else { Vec::new() };
        (commands, on)
    }

    /// Root mean square torque of the hardest joint, as a share of its greatest: each joint alone follows its
    /// command through its position loop, with its inertia in the nominal pose and gravity.
    fn effort(&self, rows: &[Vec<f64>]) -> f64 {
        let of = |(a, l): (usize, &JointLimits)| {
            let column: Vec<f64> = rows.iter().map(|row| row[a]).collect();
            self.joint_effort(l, &column)
        };
        self.limits.iter().enumerate().map(of).fold(0.0, f64::max)
    }

    /// A motion of the whole robot, in which joints that it asks too much of go half as far, and half again.
    fn lightened(&self, mut rows: Vec<Vec<f64>>) -> Vec<Vec<f64>> {
        for (a, l) in self.limits.iter().enumerate() {
            for _ in 0..MOST_HALVINGS {
                let column: Vec<f64> = rows.iter().map(|row| row[a]).collect();
                if self.joint_effort(l, &column) <= MOTION_SHARE {
                    break;
                }
                for row in &mut rows {
                    row[a] = l.nominal_rad + 0.5 * (row[a] - l.nominal_rad);
                }
            }
        }
        rows
    }

    /// The same of one joint.
    fn joint_effort(&self, l: &JointLimits, command_rad: &[f64]) -> f64 {
        /// Longest step, s: rotor inertia and gain swing at 10 to 20 Hz.
        const STEP_S: f64 = 1e-3;
        let substeps = (1.0 / (self.rate_hz * STEP_S)).ceil().max(1.0);
        let dt = 1.0 / (self.rate_hz * substeps);
        let (kp, kd) = (l.kp_nm_per_rad, l.kd_nm_s_per_rad);
        let (mut q, mut v, mut sum) = (command_rad[0], 0.0, 0.0);
        for u in command_rad {
            for _ in 0..substeps as usize {
                // the damper is taken at the end of the step, so that no gain makes it unstable
                let push = (kp * (u - q)).clamp(-l.tau_max_nm, l.tau_max_nm);
                v = (v + dt * (push - l.gravity_nm(q)) / l.inertia_kgm2)
                    / (1.0 + dt * kd / l.inertia_kgm2);
                q += dt * v;
                sum += ((push - kd * v) / l.tau_max_nm).clamp(-1.0, 1.0).powi(2);
            }
        }
        (sum / (command_rad.len() as f64 * substeps)).sqrt()
    }
}
