//! The paper's pipeline on synthetic logs: play of 4° at the girdles, a low-pass on commands, a weaker servo
//! and noise are hidden in logs of another engine; how joints track, how high feet go and how fast the robot
//! is, measured, in the robot file's robot and in the extended one.

use std::path::Path;
use std::sync::Arc;

use caudata_gap::plots::Overlay;
use caudata_gap::replay::{Data, Replayer, Segment, SegmentOptions, Variant};
use caudata_gap::trial::Kind;
use caudata_gap::{GapError, GoOn, Run, excite};
use caudata_model::RobotModel;

use crate::battery::RATE_HZ;
use crate::generate::GenerateError;
use crate::hides::{self, Hides};
use crate::salamander::{self, LabFile};
use crate::simulated::{self, Robot};

/// The paper's robot, as far as the paper says: play of 4° each side, and the middle of what a servo's filter
/// and supply can do.
pub const HIDDEN: Hides = Hides::Paper { half_width_deg: 4.0, low_pass_s: 0.03, torque: 0.7 };
/// Trials of the battery that the lab records on a stand as well, and what they are for. Walking, rocking and
/// lifting hardly ever ask a servo for the 1.36 N·m that it has left, and at one tempo a filter is as good as
/// a delay: neither could be named from them. Weaker servos are 23 and 17 mrad in these fit trials and 81 in
/// the one that is held out; in `steps_medium` they are nothing, so that it could not speak for them.
const ON_STAND: [(&str, &str); 3] =
    [("fit", "chirp_medium"), ("fit", "steps_large"), ("holdout", "chirp_large")];
/// Repeats of each.
const STAND_REPEATS: u64 = 2;
/// Recordings of the stand are counted from here: each has its own friction and noise, and so do those of the
/// ground, from 0.
const STAND_RUNS: u64 = 1000;
/// Stretches that are simulated from what was measured at their start, s: two strides.
const STRETCH_S: f64 = 2.0;
/// What does not count at the beginning of a stretch, s: nobody measures where play hangs, so that a
/// simulated robot falls into it first.
const SETTLED_AFTER_S: f64 = 0.3;
/// Which stretch is drawn: the first one begins at rest.
const DRAWN_STRETCH: usize = 1;
/// Joints that are drawn: the paper draws two.
const DRAWN: [&str; 2] = ["FL_hip", "FL_knee"];

/// A figure of the runs, of the model as given, of the extended one.
#[derive(Clone, Debug, PartialEq)]
pub struct Row {
    /// What it is of.
    pub of: String,
    /// Measured; `None` for errors, which measured runs do not have.
    pub measured: Option<f64>,
    /// As given.
    pub before: f64,
    /// Extended.
    pub after: f64,
}

/// What the paper shows.
#[derive(Clone, Debug, Default)]
pub struct Pictures {
    /// Per joint: root mean square of simulated less measured position, rad.
    pub joints: Vec<Row>,
    /// Per foot: height between the lowest and the highest point of two strides, m.
    pub feet: Vec<Row>,
    /// Mean speed over ground, m/s.
    pub speed: Option<Row>,
    /// Curves of one stretch.
    pub overlays: Vec<Overlay>,
}

/// Records the trials on a stand beside the logs of the ground in `folder`, of the same robot on the same
/// day, as long as `go_on` says so, which is asked before each run.
pub fn on_stand(
    file: LabFile,
    seed: u64,
    folder: &Path,
    go_on: &dyn Fn() -> bool,
) -> Result<(), GenerateError> {
    let (_, _, model) = salamander::lab_file(file)?;
    let lane = hides::lane_of(&model, HIDDEN);
    let robot = Robot { lab: &model, model: &model, lane: &lane, seed, payload: &[] };
    for (i, (role, trial)) in ON_STAND.iter().enumerate() {
        for r in 0..STAND_REPEATS {
            if !go_on() {
                return Err(GenerateError::Stopped);
            }
            let dir = folder.join(format!("{role}_{trial}_{}", r + 1));
            let run = STAND_RUNS + 10 * i as u64 + r;
            let trial = excite::trial(&model, trial, None, RATE_HZ)?;
            simulated::record(&robot, &trial, run, &dir)?;
        }
    }
    Ok(())
}

/// Simulates `runs` of the robot `model` as it is and with `extended`, stretch by stretch.
///
/// # Errors
/// [`GapError`] where a run cannot be used, or `go_on` ends it.
pub fn pictures(
    model: &Arc<RobotModel>,
    extended: Variant,
    runs: &[Run],
    threads: usize,
    go_on: GoOn,
) -> Result<Pictures, GapError> {
    let trials = runs
        .iter()
        .map(|run| caudata_gap::reading::trial(model, run))
        .collect::<Result<Vec<_>, _>>()?;
    let options = SegmentOptions { free_s: STRETCH_S, ..SegmentOptions::default() };
    let data = Data::new(model, trials, options);
    let replayer = Replayer::new(Arc::clone(model), threads)?.with_go_on(go_on);
    let predictions = replayer.predict(&data, &[Vec::new(), extended])?;
    let (before, after) = (&predictions[0], &predictions[1]);
    let joints = model
        .actuated_names()
        .iter()
        .enumerate()
        .map(|(a, name)| {
            let error = |p: &[f32]| {
                let off = |k: usize| f64::from(p[k]) - data.value[k];
                let all = samples(&data, Kind::Position, a);
                let square: f64 = all.iter().map(|&k| off(k).powi(2)).sum();
                (square / all.len().max(1) as f64).sqrt()
            };
            Row {
                of: (*name).to_owned(),
                measured: None,
                before: error(before),
                after: error(after),
            }
        })
        .collect();
    let feet = model
        .feet()
        .iter()
        .enumerate()
        .map(|(f, foot)| {
            let height = |of: &dyn Fn(usize) -> f64| {
                mean_over(&data, Kind::Foot, 3 * f + 2, &|range| {
                    let all = range.map(of);
                    let ends = all
                        .fold((f64::INFINITY, f64::NEG_INFINITY), |e, z| (e.0.min(z), e.1.max(z)));
                    ends.1 - ends.0
                })
            };
            row(&foot.name, &data, before, after, &height)
        })
        .collect();
    let way = |of: &dyn Fn(usize) -> f64| {
        let along = |axis: usize| {
            mean_over(&data, Kind::BasePosition, axis, &|range| {
                let seconds = data.time_s[range.end - 1] - data.time_s[range.start];
                (of(range.end - 1) - of(range.start)) / seconds.max(1e-3)
            })
        };
        along(0).hypot(along(1))
    };
    let stretches = &data.segments;
    let overlays = (stretches.get(DRAWN_STRETCH).or(stretches.first()))
        .map_or_else(Vec::new, |s| drawn(model, &data, s, before, after));
    Ok(Pictures { joints, feet, speed: Some(row("trunk", &data, before, after, &way)), overlays })
}

/// The value of each sample of the flat vector.
type Samples<'a> = &'a dyn Fn(usize) -> f64;

/// The same figure of what was measured and of two predictions.
fn row(
    of: &str,
    data: &Data,
    before: &[f32],
    after: &[f32],
    figure: &dyn Fn(Samples<'_>) -> f64,
) -> Row {
    Row {
        of: of.to_owned(),
        measured: Some(figure(&|k| data.value[k])),
        before: figure(&|k| f64::from(before[k])),
        after: figure(&|k| f64::from(after[k])),
    }
}

/// Places of a channel's samples in the flat vector, stretch by stretch, without the beginnings that do not
/// count.
fn stretches(data: &Data, kind: Kind, index: usize) -> Vec<std::ops::Range<usize>> {
    let own = data.segments.iter().flat_map(|s| {
        let pieces = s.pieces.iter().map(move |p| (s.start_s + SETTLED_AFTER_S, p));
        pieces.filter(|(_, p)| p.kind == kind && p.index == index)
    });
    own.map(|(from_s, p)| {
        let early = data.time_s[p.range.clone()].partition_point(|&t| t < from_s);
        p.range.start + early..p.range.end
    })
    .filter(|range| !range.is_empty())
    .collect()
}

/// The same as one list.
fn samples(data: &Data, kind: Kind, index: usize) -> Vec<usize> {
    stretches(data, kind, index).into_iter().flatten().collect()
}

/// Mean over stretches of a figure of one channel.
fn mean_over(
    data: &Data,
    kind: Kind,
    index: usize,
    figure: &dyn Fn(std::ops::Range<usize>) -> f64,
) -> f64 {
    let all: Vec<f64> = stretches(data, kind, index).into_iter().map(figure).collect();
    all.iter().sum::<f64>() / all.len().max(1) as f64
}

/// Curves of a stretch: two joints, the height of every foot, the way of the trunk.
fn drawn(
    model: &RobotModel,
    data: &Data,
    segment: &Segment,
    before: &[f32],
    after: &[f32],
) -> Vec<Overlay> {
    let trial = &data.trials[segment.trial];
    let names = model.actuated_names();
    let mut wanted: Vec<(Kind, usize)> = DRAWN
        .iter()
        .filter_map(|d| Some((Kind::Position, names.iter().position(|n| n == d)?)))
        .collect();
    wanted.extend((0..model.feet().len()).map(|f| (Kind::Foot, 3 * f + 2)));
    wanted.push((Kind::BasePosition, 0));
    let piece = |(kind, index): (Kind, usize)| {
        let mut own = segment.pieces.iter();
        own.find(|p| p.kind == kind && p.index == index)
    };
    wanted
        .into_iter()
        .filter_map(piece)
        .map(|p| {
            let at = |x: &[f32]| p.range.clone().map(|k| f64::from(x[k])).collect();
            let measured: Vec<Option<f64>> = p.range.clone().map(|k| Some(data.value[k])).collect();
            let time = &data.time_s[p.range.clone()];
            Overlay {
                run: trial.name.clone(),
                signal: p.kind.name().to_owned(),
                joint: trial.channels[p.channel].name.clone(),
                unit: p.kind.unit().to_owned(),
                time_s: time.to_vec(),
                command: match p.kind {
                    Kind::Position => time.iter().map(|&t| trial.commands[p.index].at(t)).collect(),
                    _ => Vec::new(),
                },
                measured_low: measured.clone(),
                measured_high: measured.clone(),
                measured,
                before: at(before),
                after: at(after),
            }
        })
        .collect()
}
