//! Bench robots in a careful lab: what no lab can help, and what changes from run to run.

use std::sync::Arc;

use caudata_model::RobotModel;
use caudata_random::{Key, Purpose, Stream};
use caudata_runlog::LogError;

use crate::battery::{RATE_HZ, Trial};
use crate::file::FileError;
use crate::hidden::World;
use crate::truth::sensors::{self, Row, Sensing};
use crate::truth::{Commands, Sim, Spec, Touch};

/// Why a case could not be made.
#[derive(Debug, thiserror::Error)]
pub enum GenerateError {
    /// The rig does not load.
    #[error("rig {0}: {1}")]
    Rig(String, caudata_model::ModelError),
    /// The diagnosing engine refused the nominal robot.
    #[error("nominal robot: {0}")]
    Engine(#[from] caudata_sim::SimError),
    /// The diagnosing simulator refused a run.
    #[error("{0}")]
    Gap(#[from] caudata_gap::GapError),
    /// The battery has no such trial.
    #[error("{0}")]
    Trial(#[from] caudata_gap::excite::ExciteError),
    /// The log could not be written.
    #[error("{0}")]
    Log(#[from] LogError),
    /// A file could not be written.
    #[error(transparent)]
    File(#[from] FileError),
    /// The truth broke down.
    #[error("the truth simulator broke down on {0}; this size is too large for its step")]
    Diverged(String),
    /// Whoever started it asked it to end.
    #[error("stopped")]
    Stopped,
    /// The effect cannot be made as large as asked for.
    #[error("{effect} reaches only d = {reached:.2} on this rig, {asked} was asked for")]
    TooSmall {
        /// Effect.
        effect: String,
        /// Size reached at its largest plausible value.
        reached: f64,
        /// Size asked for.
        asked: f64,
    },
}

/// A bench robot: its files and the checked model.
#[derive(Clone, Debug)]
pub struct Rig {
    /// Name of the robot file.
    pub name: String,
    /// Text of the robot file.
    pub robot_toml: String,
    /// Text and name of its MJCF.
    pub mjcf: (String, String),
    /// The model.
    pub model: Arc<RobotModel>,
}

impl Rig {
    /// The rig called `pendulum` (one joint) or `arm` (two).
    ///
    /// # Errors
    /// [`GenerateError::Rig`].
    pub fn bench(name: &str) -> Result<Self, GenerateError> {
        let (robot_toml, xml) = match name {
            "arm" => (include_str!("../rigs/arm.robot.toml"), include_str!("../rigs/arm.xml")),
            _ => {
                (include_str!("../rigs/pendulum.robot.toml"), include_str!("../rigs/pendulum.xml"))
            }
        };
        let name = if name == "arm" { "arm" } else { "pendulum" };
        let model = RobotModel::from_bytes(name, robot_toml.as_bytes(), xml.as_bytes())
            .map_err(|e| GenerateError::Rig(name.to_owned(), e))?;
        Ok(Self {
            name: name.to_owned(),
            robot_toml: robot_toml.to_owned(),
            mjcf: (format!("{name}.xml"), xml.to_owned()),
            model: Arc::new(model),
        })
    }
}

/// Index of the first held-out run; the three repeats of a fit trial have indices from ten times its number
/// on.
pub(crate) const FIRST_HELD_OUT: u64 = 1000;

const JITTER: u64 = 1;
const READING: u64 = 2;
const PER_RUN: u64 = 3;
const ROBOT: u64 = 4;
pub(crate) const HELD_OUT: u64 = 5;
pub(crate) const SIGNS: u64 = 6;
pub(crate) const LAWS: u64 = 7;

pub(crate) fn stream(seed: u64, what: u64, run: u64) -> Stream {
    let key = Key { seed, actor: what, env: run, episode: 0 };
    Stream::new(key, Purpose::Excitation)
}

/// A careful lab's robot: nearly the model, with what no lab can help.
pub fn lab(model: &RobotModel, seed: u64) -> World {
    let mut s = stream(seed, ROBOT, 0);
    let mut spec = Spec::nominal(model);
    for p in &mut spec.joints {
        // a gear's ripple, well below its friction
        p.ripple_nm += s.uniform_f64(0.001, 0.003);
        p.ripple_per_turn = s.uniform_f64(20.0, 45.0).round();
        p.ripple_phase_rad = s.uniform_f64(0.0, std::f64::consts::TAU);
    }
    World {
        spec,
        sensing: Sensing::careful(model.actuated().len()),
        declared_supply_v: None,
        drained_v: 0.0,
    }
}

/// What changes from run to run.
fn of_the_day(world: &World, seed: u64, run: u64) -> (World, Vec<f64>) {
    let mut s = stream(seed, PER_RUN, run);
    let mut w = world.clone();
    // relative to 12 V nominal, so that an effect on the supply stays what it is
    let shift = s.uniform_f64(-0.4, 0.4);
    w.spec.supply_v += shift;
    // four trials to fit on, then the held-out ones
    let late = if run < FIRST_HELD_OUT { (run / 10) as f64 / 4.0 } else { 1.0 };
    w.spec.supply_v -= world.drained_v * late.min(1.0);
    if let Some(v) = &mut w.declared_supply_v {
        *v += shift;
    }
    let mut start = Vec::new();
    for p in &mut w.spec.joints {
        p.coulomb_nm *= s.uniform_f64(0.92, 1.08);
        p.drift = (0.03, s.uniform_f64(20.0, 60.0), s.uniform_f64(0.0, std::f64::consts::TAU));
        start.push(0.004 * s.normal_f64());
    }
    (w, start)
}

fn commands(trial: &Trial, sensing: &Sensing, seed: u64, run: u64, loss: (f64, f64)) -> Commands {
    let mut s = stream(seed, JITTER, run);
    let sent_s = sensors::row_times_s(trial.duration_s(), RATE_HZ, sensing, &mut s);
    let n = sent_s.len().min(trial.rows_rad.len());
    // every lab loses a frame in a thousand
    let share = 0.001 + loss.0;
    let mut on = false;
    let lost = (0..n)
        .map(|_| {
            let burst = if loss.0 > 0.0 { loss.1 } else { 1.0 };
            let chance = if on { 1.0 - 1.0 / burst } else { share / (burst * (1.0 - share)) };
            on = s.uniform_f64(0.0, 1.0) < chance;
            on
        })
        .collect();
    Commands { sent_s: sent_s[..n].to_vec(), rows_rad: trial.rows_rad[..n].to_vec(), lost }
}

/// One run of a trial: commands as sent, and rows of the log.
pub(crate) fn run(
    rig: &Rig,
    world: &World,
    trial: &Trial,
    seed: u64,
    index: u64,
    touch: Option<Touch>,
) -> Result<(Commands, Vec<Row>, World), GenerateError> {
    let (day, start) = of_the_day(world, seed, index);
    let commands = commands(trial, &day.sensing, seed, index, day.spec.command_loss);
    let dense =
        Sim::new(&rig.model, &day.spec).run(&commands, trial.duration_s() + 0.01, &start, touch);
    if !dense.sane {
        return Err(GenerateError::Diverged(trial.name.clone()));
    }
    let mut reading = stream(seed, READING, index);
    let rows =
        sensors::record(&rig.model, &day.spec, &day.sensing, &commands, &dense, &mut reading);
    Ok((commands, rows, day))
}
