//! Making a case: a lab's robot with its nuisances, the effect at the size asked for, the runs, the folder.

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use caudata_model::RobotModel;
use caudata_random::{Key, Purpose, Stream};
use caudata_runlog::{BaseHold, LogError, LogMeta, LogWriter};

use crate::battery::{self, Amount, RATE_HZ, Trial};
use crate::case::{Answer, Block, TrueEffect, TrueValue};
use crate::decoy::Decoy;
use crate::hidden::{Hidden, Scope, World};
use crate::replay::{self, Prediction};
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
    /// The battery has no such trial.
    #[error("{0}")]
    Trial(#[from] caudata_gap::excite::ExciteError),
    /// The log could not be written.
    #[error("{0}")]
    Log(#[from] LogError),
    /// A file could not be written.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// The reason given by the system.
        source: std::io::Error,
    },
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
            "arm" => (
                include_str!("../rigs/arm.robot.toml"),
                include_str!("../rigs/arm.xml"),
            ),
            _ => (
                include_str!("../rigs/pendulum.robot.toml"),
                include_str!("../rigs/pendulum.xml"),
            ),
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

/// What is asked for.
pub struct Request<'a> {
    /// Folder name.
    pub name: String,
    /// Block.
    pub block: Block,
    /// Robot.
    pub rig: &'a Rig,
    /// Seed of everything random in it.
    pub seed: u64,
    /// How long the runs are.
    pub amount: Amount,
    /// Effects with the joint and the size in detectability units.
    pub effects: Vec<(&'static Hidden, usize, f64)>,
    /// Something unusual.
    pub decoy: Option<Decoy>,
    /// Ids that the diagnosis has to do without.
    pub without: Vec<String>,
}

/// One run before it is written.
struct Run {
    folder: String,
    rows: Vec<Row>,
    meta: LogMeta,
}

/// Index of the first held-out run; the three repeats of a fit trial have indices from ten times its number on.
const FIRST_HELD_OUT: u64 = 1000;

const JITTER: u64 = 1;
const READING: u64 = 2;
const PER_RUN: u64 = 3;
const ROBOT: u64 = 4;
const HOLDOUT: u64 = 5;
const SIGNS: u64 = 6;

fn stream(seed: u64, what: u64, run: u64) -> Stream {
    let key = Key {
        seed,
        actor: what,
        env: run,
        episode: 0,
    };
    Stream::new(key, Purpose::Excitation)
}

/// A careful lab's robot: nearly the model, with what no lab can help.
#[must_use]
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
    let late = if run < FIRST_HELD_OUT {
        (run / 10) as f64 / 4.0
    } else {
        1.0
    };
    w.spec.supply_v -= world.drained_v * late.min(1.0);
    if let Some(v) = &mut w.declared_supply_v {
        *v += shift;
    }
    let mut start = Vec::new();
    for p in &mut w.spec.joints {
        p.coulomb_nm *= s.uniform_f64(0.92, 1.08);
        p.drift = (
            0.03,
            s.uniform_f64(20.0, 60.0),
            s.uniform_f64(0.0, std::f64::consts::TAU),
        );
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
            let chance = if on {
                1.0 - 1.0 / burst
            } else {
                share / (burst * (1.0 - share))
            };
            on = s.uniform_f64(0.0, 1.0) < chance;
            on
        })
        .collect();
    Commands {
        sent_s: sent_s[..n].to_vec(),
        rows_rad: trial.rows_rad[..n].to_vec(),
        lost,
    }
}

/// One run of a trial: commands as sent, and rows of the log.
fn run(
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
    let rows = sensors::record(
        &rig.model,
        &day.spec,
        &day.sensing,
        &commands,
        &dense,
        &mut reading,
    );
    Ok((commands, rows, day))
}

/// Channels that differences are measured in: position, speed, current.
fn channels(rig: &Rig, world: &World) -> Vec<(usize, usize)> {
    let a = rig.model.actuated().len();
    let mut all: Vec<(usize, usize)> = (0..a).map(|i| (0, i)).collect();
    all.extend((0..a).map(|i| (1, i)));
    if world.sensing.log_current {
        all.extend((0..a).map(|i| (2, i)));
    }
    all
}

fn measured(
    rows: &[Row],
    servos: usize,
    kind: usize,
    a: usize,
) -> impl Iterator<Item = Option<f64>> + '_ {
    rows.iter()
        .map(move |(_, row)| row.get((1 + kind) * servos + a).copied().flatten())
}

fn predicted(p: &Prediction, kind: usize, a: usize) -> &[f64] {
    match kind {
        0 => &p.pos_rad[a],
        1 => &p.vel_radps[a],
        _ => &p.current_a[a],
    }
}

/// What a robot without effects looks like in this lab: its rows per trial, how far repeats are apart (noise), and how far the nominal
/// simulation is off (null discrepancy).
pub struct NullView {
    rows: Vec<Vec<Row>>,
    sigma: Vec<Vec<f64>>,
    /// Whitened norm of measured minus nominal simulation, per value.
    pub discrepancy: f64,
}

/// Runs the null of a lab on its fit trials.
///
/// # Errors
/// [`GenerateError`].
pub fn null_view(rig: &Rig, trials: &[Trial], seed: u64) -> Result<NullView, GenerateError> {
    let world = lab(&rig.model, seed);
    let servos = rig.model.actuated().len();
    let (mut all_rows, mut sigmas) = (Vec::new(), Vec::new());
    let (mut sum, mut count) = (0.0, 0.0);
    for (i, trial) in trials.iter().enumerate() {
        let (commands, rows, day) = run(rig, &world, trial, seed, 10 * i as u64, None)?;
        let (_, again, _) = run(rig, &world, trial, seed, 10 * i as u64 + 1, None)?;
        let mut params = caudata_sim::LaneParams::nominal(&rig.model);
        params.supply_v = day.spec.supply_v as f32;
        let nominal = replay::predict(&rig.model, &[params], &commands, &commands.sent_s)?;
        let mut sigma = Vec::new();
        for (kind, a) in channels(rig, &world) {
            let pairs = measured(&rows, servos, kind, a).zip(measured(&again, servos, kind, a));
            let (mut s, mut n) = (0.0, 0.0);
            for (x, y) in pairs {
                if let (Some(x), Some(y)) = (x, y) {
                    s += 0.5 * (x - y) * (x - y);
                    n += 1.0;
                }
            }
            let sd = f64::sqrt(s / f64::max(n, 1.0)).max(1e-6);
            sigma.push(sd);
            for (x, p) in measured(&rows, servos, kind, a).zip(predicted(&nominal[0], kind, a)) {
                if let Some(x) = x {
                    sum += ((x - p) / sd).powi(2);
                    count += 1.0;
                }
            }
        }
        all_rows.push(rows);
        sigmas.push(sigma);
    }
    Ok(NullView {
        rows: all_rows,
        sigma: sigmas,
        discrepancy: (sum / f64::max(count, 1.0)).sqrt(),
    })
}

/// Size of what `world` does beyond the null, in detectability units.
fn detectability(
    rig: &Rig,
    world: &World,
    trials: &[Trial],
    view: &NullView,
    seed: u64,
) -> Result<f64, GenerateError> {
    let servos = rig.model.actuated().len();
    let (mut sum, mut count) = (0.0, 0.0);
    for (i, trial) in trials.iter().enumerate() {
        let (_, rows, _) = run(rig, world, trial, seed, 10 * i as u64, None)?;
        for (c, (kind, a)) in channels(rig, world).into_iter().enumerate() {
            let sd = view.sigma[i][c];
            let pairs =
                measured(&rows, servos, kind, a).zip(measured(&view.rows[i], servos, kind, a));
            for (x, y) in pairs {
                if let (Some(x), Some(y)) = (x, y) {
                    sum += ((x - y) / sd).powi(2);
                    count += 1.0;
                }
            }
        }
    }
    Ok((sum / f64::max(count, 1.0)).sqrt() / view.discrepancy)
}

/// Finds the size at which the effect alone has `d` detectability units. Returns the size and the d reached.
fn size_for(
    rig: &Rig,
    hidden: &Hidden,
    joint: usize,
    sign: f64,
    d: f64,
    trials: &[Trial],
    view: &NullView,
    seed: u64,
) -> Result<(f64, f64), GenerateError> {
    let measure = |size: f64| -> Result<f64, GenerateError> {
        let mut world = lab(&rig.model, seed);
        hidden.apply(&mut world, &rig.model, joint, sign * size);
        detectability(rig, &world, trials, view, seed)
    };
    let (first, most) = hidden.sizes;
    let mut low: Option<(f64, f64)> = None;
    let mut high: Option<(f64, f64)> = None;
    let mut size = first;
    let mut best = (first, 0.0);
    for _ in 0..12 {
        let got = measure(size)?;
        if best.1 == 0.0 || (got / d).ln().abs() < (best.1 / d).ln().abs() {
            best = (size, got);
        }
        if (got / d).ln().abs() < 0.12 {
            return Ok((size, got));
        }
        if got < d {
            low = Some((size, got));
        } else {
            high = Some((size, got));
        }
        size = match (low, high) {
            (Some(l), Some(h)) => (l.0 * h.0).sqrt(),
            (Some(l), None) if l.0 >= most => {
                return Err(GenerateError::TooSmall {
                    effect: hidden.id.to_owned(),
                    reached: l.1,
                    asked: d,
                });
            }
            (Some(l), None) => (l.0 * (d / l.1.max(1e-3)).clamp(1.3, 4.0)).min(most),
            (None, Some(h)) => h.0 * (d / h.1).clamp(0.1, 0.8),
            (None, None) => size,
        };
    }
    // within a third is as asked; further off it would stand in the wrong column
    if (best.1 / d).ln().abs() < 0.3 {
        return Ok(best);
    }
    Err(GenerateError::TooSmall {
        effect: hidden.id.to_owned(),
        reached: best.1,
        asked: d,
    })
}

/// Makes a case under `parent/<name>` and returns its answer.
///
/// # Errors
/// [`GenerateError`].
pub fn make(request: &Request<'_>, parent: &Path) -> Result<Answer, GenerateError> {
    let rig = request.rig;
    let model = &rig.model;
    let seed = request.seed;
    let full_fit = battery::fit(model, request.amount);
    let trials = if request.block == Block::Starved {
        battery::starved(model)
    } else {
        full_fit.clone()
    };
    let mut world = lab(model, seed);
    let mut effects = Vec::new();
    let mut together_d = 0.0;
    if !request.effects.is_empty() {
        // d is measured on the whole battery also for starved cases: the effect is there, the data do not show it
        let view = null_view(rig, &full_fit, seed)?;
        let mut signs = stream(seed, SIGNS, 0);
        for &(hidden, joint, d) in &request.effects {
            let sign = if hidden.signed && signs.chance(0.5) {
                -1.0
            } else {
                1.0
            };
            let (size, reached) = size_for(rig, hidden, joint, sign, d, &full_fit, &view, seed)?;
            hidden.apply(&mut world, model, joint, sign * size);
            effects.push((hidden, joint, sign * size, reached));
        }
        together_d = match effects.as_slice() {
            [(_, _, _, d)] => *d,
            _ => detectability(rig, &world, &full_fit, &view, seed)?,
        };
    }
    let (fit, holdout) = runs(request, &world, &trials)?;
    write(rig, &world, &parent.join(&request.name), &fit, &holdout)?;
    let decoy = request.decoy;
    let ids: Vec<&str> = effects.iter().map(|e| e.0.id).collect();
    Ok(Answer {
        case: request.name.clone(),
        block: request.block,
        rig: rig.name.clone(),
        seed,
        target_d: request.effects.first().map_or(0.0, |e| e.2),
        together_d,
        effects: effects
            .iter()
            .map(|&(h, j, size, d)| true_effect(h, j, size, d, &world, model, &ids))
            .collect(),
        without: request.without.clone(),
        decoy: decoy.map_or(String::new(), |d| d.name().to_owned()),
        fault: decoy.is_some_and(Decoy::is_fault),
        fault_kinds: decoy.map_or(Vec::new(), |d| {
            d.kinds().iter().map(|k| (*k).to_owned()).collect()
        }),
    })
}

fn true_effect(
    h: &Hidden,
    joint: usize,
    size: f64,
    d: f64,
    world: &World,
    model: &RobotModel,
    hidden: &[&str],
) -> TrueEffect {
    let joints = model.actuated().len();
    let same = if joints == 1 {
        h.equivalent.0
    } else {
        h.equivalent.1
    };
    let beside = h.same_beside(joints, hidden).into_iter();
    TrueEffect {
        effect: h.id.to_owned(),
        layer: h.layer.to_owned(),
        joint: if h.scope == Scope::Joint {
            model.actuated_names()[joint].to_owned()
        } else {
            String::new()
        },
        size,
        d,
        equivalent: same.iter().map(|s| (*s).to_owned()).collect(),
        equivalent_beside: beside.map(|(a, b)| (a.to_owned(), b.to_owned())).collect(),
        parameters: h
            .truth(world, model, joint)
            .into_iter()
            .map(|p| TrueValue {
                names: p.names.iter().map(|s| (*s).to_owned()).collect(),
                unit: p.unit.to_owned(),
                value: p.value,
                nominal: p.nominal,
            })
            .collect(),
    }
}

/// All runs of a case: fit with repeats, hold-out with repeats.
fn runs(
    request: &Request<'_>,
    world: &World,
    trials: &[Trial],
) -> Result<(Vec<Run>, Vec<Run>), GenerateError> {
    let (rig, seed) = (request.rig, request.seed);
    let repeats = match request.amount {
        Amount::Short => 2,
        Amount::Full => 3,
    };
    let plain = lab(&rig.model, seed);
    let fit_world = if request.block == Block::HoldoutChange {
        &plain
    } else {
        world
    };
    let mut fit = Vec::new();
    for (i, trial) in trials.iter().enumerate() {
        for r in 0..repeats {
            let index = 10 * i as u64 + r;
            fit.push(one_run(request, fit_world, trial, index, "fit", r)?);
        }
    }
    let mut s = stream(seed, HOLDOUT, 0);
    let mut holdout = Vec::new();
    for (i, trial) in battery::holdout(&rig.model, request.amount, &mut s)
        .iter()
        .enumerate()
    {
        for r in 0..2 {
            let index = FIRST_HELD_OUT + 10 * i as u64 + r;
            holdout.push(one_run(request, world, trial, index, "holdout", r)?);
        }
    }
    Ok((fit, holdout))
}

fn one_run(
    request: &Request<'_>,
    world: &World,
    trial: &Trial,
    index: u64,
    role: &str,
    repeat: u64,
) -> Result<Run, GenerateError> {
    let (rig, decoy) = (request.rig, request.decoy);
    let mut world = world.clone();
    if let Some(d) = decoy {
        d.change_world(&mut world);
    }
    let touch = decoy.and_then(|d| d.touch(role, trial, repeat));
    let (_, mut rows, day) = run(rig, &world, trial, request.seed, index, touch)?;
    if let Some(d) = decoy {
        d.change_rows(&mut rows, rig.model.actuated().len());
    }
    let mut meta = LogMeta::new(rig.name.clone(), BaseHold::Fixed, RATE_HZ);
    meta.terrain = "stand".to_owned();
    meta.kp = Some(
        decoy
            .and_then(Decoy::declared_kp)
            .unwrap_or(rig.model.kp_nm_per_rad()),
    );
    meta.kd = Some(rig.model.kd_nm_s_per_rad());
    let supply = day.declared_supply_v.unwrap_or(day.spec.supply_v);
    meta.supply_v = Some((supply * 10.0).round() / 10.0);
    meta.notes = format!("{} {}", trial.name, repeat + 1);
    Ok(Run {
        folder: format!("{role}_{}_{}", trial.name, repeat + 1),
        rows,
        meta,
    })
}

fn write(
    rig: &Rig,
    world: &World,
    folder: &Path,
    fit: &[Run],
    holdout: &[Run],
) -> Result<(), GenerateError> {
    let io = |path: &Path| {
        let path = path.to_owned();
        move |source| GenerateError::Io { path, source }
    };
    fs::create_dir_all(folder).map_err(io(folder))?;
    let robot = folder.join(format!("{}.robot.toml", rig.name));
    fs::write(&robot, &rig.robot_toml).map_err(io(&robot))?;
    let mjcf = folder.join(&rig.mjcf.0);
    fs::write(&mjcf, &rig.mjcf.1).map_err(io(&mjcf))?;
    let signals = world.sensing.signals(&rig.model);
    for run in fit.iter().chain(holdout) {
        let mut log = LogWriter::create(&folder.join(&run.folder), &signals, &run.meta)?;
        for (t, row) in &run.rows {
            log.row(*t, row)?;
        }
        log.finish()?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use super::*;

    #[test]
    fn gains_that_follow_the_supply_are_no_other_gains_once_it_changes() {
        let rig = Rig::bench("pendulum").unwrap();
        let trials = battery::fit(&rig.model, Amount::Short);
        let mut view = null_view(&rig, &trials, 3).unwrap();
        let mut follows = lab(&rig.model, 3);
        follows.spec.gain_follows_supply = true;
        follows.spec.supply_v = 10.0;
        let mut fixed = lab(&rig.model, 3);
        fixed.spec.supply_v = 10.0;
        let mut apart = |drained_v: f64| {
            follows.drained_v = drained_v;
            fixed.drained_v = drained_v;
            // four runs at 0, 1, 2 and 3 fourths of what is drained
            let share = (10.0 - 0.375 * drained_v) / fixed.spec.reference_v;
            let nominal = Spec::nominal(&rig.model);
            for (p, n) in fixed.spec.joints.iter_mut().zip(&nominal.joints) {
                p.kp_nm_per_rad = share * n.kp_nm_per_rad;
                p.kd_nms_per_rad = share * n.kd_nms_per_rad;
                p.feed_forward_vs_per_rad = share * n.feed_forward_vs_per_rad;
            }
            view.rows = (trials.iter().enumerate())
                .map(|(i, t)| run(&rig, &follows, t, 3, 10 * i as u64, None).unwrap().1)
                .collect();
            detectability(&rig, &fixed, &trials, &view, 3).unwrap()
        };
        // ± 0.4 V from run to run are there in any case
        let (steady, drained) = (apart(0.0), apart(4.0));
        assert!(
            steady < 0.8 && drained > 1.0 && drained > 2.0 * steady,
            "{steady} {drained}"
        );
    }
}
