//! The metric: how far a prediction is from what was measured, in units of what cannot be held against a model.
//!
//! A residual is divided by its noise ([`super::noise`]), and directions in which careful labs differ from run to run (a little more friction, a
//! little less voltage, half a step of time) are taken as random with their tolerances: with N the traces of these nuisances at one tolerance
//! each, the residual r is whitened to (I + κ²·N·n⁻¹·Nᵀ)^(−½)·r, run by run, n the number of samples of those joints that a nuisance shows at. The misfit
//! is the mean square of that: 1 is the floor. What no nuisance explains stays. k tolerances of one come to at most (k/κ)²: one tolerance is little, many
//! are a gap although a nuisance explains them. (With I + N·Nᵀ, which is what independent Gaussian noise would ask for, they come to k²/n: nothing,
//! whatever k.)

use std::collections::BTreeMap;
use std::ops::Range;

use caudata_runlog::BaseHold;
use nalgebra::{DMatrix, DVector, SymmetricEigen};

use super::noise::Noise;
use super::pipeline::add_own_misses;
use super::product::dot;
use crate::effects::{self, Domain, Place};
use crate::error::GapError;
use crate::replay::{Data, Piece, Replayer, SegmentOptions, Term, Variant};
use crate::trial::Kind;

/// Mean square error of one channel in one run, in squared noises, that counts at most.
const MOST_MISFIT: f64 = 80.0;
/// Dry and viscous friction may differ by this share from run to run.
const FRICTION_TOLERANCE: f64 = 0.07;
/// Before friction slides, its law is a matter of taste: the way to it by this share.
const PRESLIDING_TOLERANCE: f64 = 0.3;
/// When in its tick a firmware acts, and its current loop, from joint to joint: s.
const LOOP_TOLERANCE_S: f64 = 0.000_12;
/// Rotor inertia by this share.
const ROTOR_TOLERANCE: f64 = 0.05;
/// Stamps, integration and bus: s.
const TIME_TOLERANCE_S: f64 = 0.0007;
/// Gains by this share (supply and temperature act on them).
const GAINS_TOLERANCE: f64 = 0.01;
/// Supply by this share.
const SUPPLY_TOLERANCE: f64 = 0.015;
/// When within its loop a servo reads its current, and over how long: s. Between two commands the torque falls as the joint follows, so that this is a current
/// in proportion to the speed.
const READING_TOLERANCE_S: f64 = 0.002;
/// With hinges that nobody drives, engines part by so many times (and not once) what halving the step changes: Rapier at 1 ms from the batch engine at
/// 2 ms by 1.2 to 4.5 times on one day and 5.2 on another, in the spine of a salamander on a stand in which nothing is hidden. With 5 the second day is a
/// gap.
const ENGINES_APART: f32 = 7.0;
/// Nobody has measured how hard the ground is: what one of a quarter of the file's time constant changes belongs to the floor.
const HARDER_GROUND: f64 = 4.0;
/// κ: a nuisance of so many tolerances is as large as the floor. Of a healthy salamander's on a stand one in ten is beyond 0.7
/// (current) to 3.9 (loop).
const TOLERANCES: f64 = 4.0;
/// Ground friction by this share.
const GROUND_TOLERANCE: f64 = 0.1;
/// A pool stirs for minutes after somebody has been in it: m/s, along and across.
const STIR_TOLERANCE_MPS: f64 = 0.005;
/// Drag by this share: a cable, a wall nearby, bubbles on the skin.
const DRAG_TOLERANCE: f64 = 0.05;
/// Buoyancy by this share: temperature, bubbles, what has leaked in.
const BUOYANCY_TOLERANCE: f64 = 0.005;

/// See [`shown_in`].
const SHOWS: f64 = 0.01;
/// A nuisance that does less than this (its share of the floor at κ tolerances) does nothing.
const LEAST_TRACE: f64 = 1e-5;

/// Runs of one role with their metric.
pub struct Judge {
    /// The runs.
    pub data: Data,
    /// Their noise.
    pub noise: Noise,
    trials: Vec<TrialMetric>,
}

/// A nuisance's trace in a trial, where it is not zero.
struct Column {
    /// Places from the trial's first sample, and values: those of one tolerance times `unit`.
    parts: Vec<(usize, Vec<f32>)>,
    /// κ/√n.
    unit: f32,
    /// Which nuisance, and of which joint where each has its own: the same in all trials.
    of: (usize, usize),
}

impl Column {
    /// From the trace of one tolerance, which shows in `n` samples.
    fn new(mut parts: Vec<(usize, Vec<f32>)>, n: usize, of: (usize, usize)) -> Self {
        let unit = (TOLERANCES / (n.max(1) as f64).sqrt()) as f32;
        for x in parts.iter_mut().flat_map(|(_, v)| v) {
            *x *= unit;
        }
        Self { parts, unit, of }
    }

    /// Σ over its places of its values times `x`.
    fn dot(&self, x: &[f32]) -> f64 {
        self.parts
            .iter()
            .map(|(at, v)| dot(v, &x[*at..at + v.len()]))
            .sum()
    }

    /// Σ of products with another.
    fn times(&self, other: &Self) -> f64 {
        let mut sum = 0.0;
        for (a, x) in &self.parts {
            for (b, y) in &other.parts {
                let (low, high) = ((*a).max(*b), (a + x.len()).min(b + y.len()));
                if low < high {
                    sum += dot(&x[low - a..high - a], &y[low - b..high - b]);
                }
            }
        }
        sum
    }

    /// Takes `c` times itself off `x`.
    fn take_off(&self, c: f32, x: &mut [f32]) {
        for (at, v) in &self.parts {
            for (x, v) in x[*at..at + v.len()].iter_mut().zip(v) {
                *x -= c * v;
            }
        }
    }
}

/// Whitening of one trial.
struct TrialMetric {
    range: Range<usize>,
    /// Nuisance traces in units of noise. `[K]`
    columns: Vec<Column>,
    /// V·diag((1 − 1/√(1+s))/s)·Vᵀ of the Gram matrix V·S·Vᵀ. `[K, K]`
    shrink: DMatrix<f64>,
}

impl Judge {
    /// For `data`, which was cut with `options`, with nuisances around the robot as given.
    ///
    /// # Errors
    /// As [`Replayer::predict`].
    pub fn new(replayer: &Replayer, data: Data, options: SegmentOptions) -> Result<Self, GapError> {
        let mut noise = Noise::of(replayer.model(), &data);
        add_own_misses(replayer, &data, options, &mut noise)?;
        let mut judge = Self {
            data,
            noise,
            trials: Vec::new(),
        };
        judge.cap(replayer)?;
        judge.set_base(replayer, &[])?;
        if judge.add_numerics(replayer)? {
            judge.set_base(replayer, &[])?;
        }
        Ok(judge)
    }

    /// Adds what the simulator's own settings do, beyond what nuisances explain, to the noise: of held runs what half its step does, of runs on the ground what
    /// harder ground does. Whether that is anything.
    fn add_numerics(&mut self, replayer: &Replayer) -> Result<bool, GapError> {
        if self.data.trials.iter().all(|t| t.base == BaseHold::Water) {
            return Ok(false);
        }
        let model = replayer.model();
        let apart = if model.joints().len() == model.actuated().len() {
            1.0
        } else {
            ENGINES_APART
        };
        let others = [
            (BaseHold::Fixed, replayer.finer(), apart),
            (
                BaseHold::Free,
                replayer.on_harder_ground(HARDER_GROUND),
                1.0,
            ),
        ];
        let as_given = replayer.predict(&self.data, &[Vec::new()])?.swap_remove(0);
        for (base, other, times) in others {
            if self.data.trials.iter().all(|t| t.base != base) {
                continue;
            }
            let changed = other.predict(&self.data, &[Vec::new()])?.swap_remove(0);
            let off = self.change(&changed, &as_given);
            for segment in &self.data.segments {
                if self.data.trials[segment.trial].base != base {
                    continue;
                }
                for piece in &segment.pieces {
                    let of = &off[piece.range.clone()];
                    let square = dot(of, of) / of.len().max(1) as f64;
                    let grows = 1.0_f32.hypot(times * square.sqrt() as f32);
                    for k in piece.range.clone() {
                        self.noise.grow(k, grows);
                    }
                }
            }
        }
        Ok(true)
    }

    /// Only the stretches `keep` of `data`, which holds the same runs as `whole` cut otherwise, with the noise that they have there, around the robot
    /// as given.
    ///
    /// # Errors
    /// As [`Replayer::predict`].
    pub fn part_of(
        whole: &Self,
        replayer: &Replayer,
        data: &Data,
        keep: &[usize],
    ) -> Result<Self, GapError> {
        let data = data.only(keep);
        let mut noise = Noise {
            sigma: vec![1.0; data.len()],
            difference: vec![0.0; data.len()],
            white: whole.noise.white.clone(),
            repeat: whole.noise.repeat.clone(),
            repeated: false,
        };
        for segment in &data.segments {
            let middle_s = 0.5 * (segment.start_s + segment.end_s);
            let of =
                whole.data.segments.iter().find(|s| {
                    s.trial == segment.trial && (s.start_s..=s.end_s).contains(&middle_s)
                });
            for piece in &segment.pieces {
                let same = of.and_then(|s| s.pieces.iter().find(|p| p.channel == piece.channel));
                let Some(same) = same else { continue };
                let times = &whole.data.time_s[same.range.clone()];
                for k in piece.range.clone() {
                    let at = times.partition_point(|&t| t < data.time_s[k]);
                    let at = same.range.start + at.min(times.len() - 1);
                    noise.sigma[k] = whole.noise.sigma[at];
                }
            }
        }
        let mut judge = Self {
            data,
            noise,
            trials: Vec::new(),
        };
        judge.set_base(replayer, &[])?;
        Ok(judge)
    }

    /// What one tolerance of each nuisance does in each of `count` windows, sums of squares by nuisance and joint. `window`: that of each sample, or
    /// anything from `count` on. `[N]` to `[count]`
    #[must_use]
    pub fn sensitivities(
        &self,
        window: &[usize],
        count: usize,
    ) -> Vec<BTreeMap<(usize, usize), f64>> {
        let mut sums = vec![BTreeMap::new(); count];
        for trial in &self.trials {
            for column in &trial.columns {
                for (at, v) in &column.parts {
                    let from = trial.range.start + at;
                    for (w, x) in window[from..from + v.len()].iter().zip(v) {
                        if let Some(of) = sums.get_mut(*w) {
                            *of.entry(column.of).or_insert(0.0) +=
                                f64::from(*x / column.unit).powi(2);
                        }
                    }
                }
            }
        }
        sums
    }

    /// Raises the noise of channels in which the robot as given is hopelessly far off, so that no single one of them rules the fit.
    fn cap(&mut self, replayer: &Replayer) -> Result<(), GapError> {
        let base = replayer.predict(&self.data, &[Vec::new()])?.swap_remove(0);
        for piece in self.data.segments.iter().flat_map(|s| &s.pieces) {
            let square: f64 = piece
                .range
                .clone()
                .map(|k| {
                    let r =
                        (self.data.value[k] - f64::from(base[k])) / f64::from(self.noise.sigma[k]);
                    if r.is_finite() { r * r } else { 0.0 }
                })
                .sum();
            let misfit = square / piece.range.len().max(1) as f64;
            if misfit > MOST_MISFIT {
                let factor = (misfit / MOST_MISFIT).sqrt() as f32;
                for k in piece.range.clone() {
                    self.noise.grow(k, factor);
                }
            }
        }
        Ok(())
    }

    /// Takes the nuisances' traces anew, around `base`.
    ///
    /// # Errors
    /// As [`Replayer::predict`].
    pub fn set_base(&mut self, replayer: &Replayer, base: &[Term]) -> Result<(), GapError> {
        let model = replayer.model();
        let wet = (self.data.trials.iter()).any(|t| t.base == BaseHold::Water);
        let joint_effects = nuisances(replayer, base, wet);
        let mut variants = vec![base.to_vec()];
        variants.extend(joint_effects.iter().map(|n| n.variant.clone()));
        let mut predictions = replayer.predict(&self.data, &variants)?;
        let rest = predictions.split_off(1);
        let zero = predictions.swap_remove(0);
        let joints = model.actuated().len();
        self.trials = trial_ranges(&self.data)
            .into_iter()
            .map(|range| {
                let mut columns: Vec<Column> = Vec::new();
                for (number, (n, trace)) in joint_effects.iter().zip(&rest).enumerate() {
                    let delta = |k: usize| {
                        let d = (trace[k] - zero[k]) * n.share / self.noise.sigma[k];
                        if d.is_finite() { d } else { 0.0 }
                    };
                    if n.per_joint {
                        for joint in 0..joints {
                            let of = pieces(&self.data, &range)
                                .filter(|p| p.kind.of_joint() && p.index == joint)
                                .map(|p| {
                                    (
                                        p.range.start - range.start,
                                        p.range.clone().map(delta).collect(),
                                    )
                                });
                            let of: Vec<(usize, Vec<f32>)> = of.collect();
                            let n = of.iter().map(|(_, v)| v.len()).sum();
                            columns.push(Column::new(of, n, (number, joint)));
                        }
                    } else {
                        let n = shown_in(&self.data, &range, joints, delta);
                        let whole = vec![(0, range.clone().map(delta).collect())];
                        columns.push(Column::new(whole, n, (number, joints)));
                    }
                }
                columns.retain(|c| c.times(c) > LEAST_TRACE);
                TrialMetric::new(range, columns)
            })
            .collect();
        Ok(())
    }

    /// Measured less predicted, whitened. Samples without a prediction count as a hundred times their noise.
    #[must_use]
    pub fn residual(&self, prediction: &[f32]) -> Vec<f32> {
        let raw = (0..self.data.len())
            .map(|k| {
                let r =
                    (self.data.value[k] - f64::from(prediction[k])) as f32 / self.noise.sigma[k];
                if r.is_finite() {
                    r.clamp(-1e4, 1e4)
                } else {
                    100.0
                }
            })
            .collect();
        self.whiten(raw)
    }

    /// One prediction less another, whitened.
    #[must_use]
    pub fn change(&self, to: &[f32], from: &[f32]) -> Vec<f32> {
        let raw = (0..self.data.len())
            .map(|k| {
                let d = (to[k] - from[k]) / self.noise.sigma[k];
                if d.is_finite() {
                    d.clamp(-1e4, 1e4)
                } else {
                    0.0
                }
            })
            .collect();
        self.whiten(raw)
    }

    /// A change of the sensors' values, in their units, whitened. `[N]` to `[N]`
    #[must_use]
    pub fn whitened(&self, mut change: Vec<f32>) -> Vec<f32> {
        for (c, sigma) in change.iter_mut().zip(&self.noise.sigma) {
            *c /= sigma;
        }
        self.whiten(change)
    }

    fn whiten(&self, mut x: Vec<f32>) -> Vec<f32> {
        for trial in &self.trials {
            trial.apply(&mut x[trial.range.clone()]);
        }
        x
    }

    /// Noise as repeats show it, whitened; empty without repeats.
    #[must_use]
    pub fn repeat_noise(&self) -> Vec<f32> {
        if self.noise.repeated {
            self.whiten(self.noise.difference.clone())
        } else {
            Vec::new()
        }
    }

    /// Mean square of a whitened vector.
    #[must_use]
    pub fn misfit(&self, residual: &[f32]) -> f64 {
        dot(residual, residual) / residual.len().max(1) as f64
    }

    /// Per block: Σ of f over its samples. `[B]`
    #[must_use]
    pub fn by_block(&self, f: impl Fn(usize) -> f64) -> Vec<f64> {
        let mut sums = vec![0.0; self.data.blocks];
        for (k, b) in self.data.block.iter().enumerate() {
            sums[*b as usize] += f(k);
        }
        sums
    }

    /// Per run: Σ of f over its samples. `[T]`
    #[must_use]
    pub fn by_trial(&self, f: impl Fn(usize) -> f64) -> Vec<f64> {
        self.trials
            .iter()
            .map(|t| t.range.clone().map(&f).sum())
            .collect()
    }

    /// Whether the candidate could be simulated at all.
    #[must_use]
    pub fn sound(prediction: &[f32]) -> bool {
        prediction.iter().all(|x| x.is_finite())
    }
}

impl TrialMetric {
    fn new(range: Range<usize>, columns: Vec<Column>) -> Self {
        let k = columns.len();
        let factor = |s: f64| match s > 1e-9 {
            true => (1.0 - 1.0 / (1.0 + s).sqrt()) / s,
            false => 0.5,
        };
        // of nothing there is no decomposition
        let shrink = if k == 0 {
            DMatrix::zeros(0, 0)
        } else {
            let gram = DMatrix::from_fn(k, k, |i, j| columns[i].times(&columns[j]));
            let eigen = SymmetricEigen::try_new(gram, f64::EPSILON, 100 * k);
            eigen.map_or_else(
                || DMatrix::zeros(k, k),
                |mut eigen| {
                    eigen.eigenvalues.apply(|s| *s = factor(*s));
                    eigen.recompose()
                },
            )
        };
        Self {
            range,
            columns,
            shrink,
        }
    }

    fn apply(&self, x: &mut [f32]) {
        let along = self.columns.iter().map(|c| c.dot(x));
        let along = DVector::from_iterator(self.columns.len(), along);
        let shares = &self.shrink * along;
        for (column, c) in self.columns.iter().zip(shares.iter()) {
            column.take_off(*c as f32, x);
        }
    }
}

/// A nuisance: a candidate, and which share of its trace is one tolerance.
struct Nuisance {
    variant: Variant,
    share: f32,
    /// Independent from joint to joint.
    per_joint: bool,
}

/// What differs from run to run in a careful lab, and in its pool (`wet`), as candidates on top of `base`.
fn nuisances(replayer: &Replayer, base: &[Term], wet: bool) -> Vec<Nuisance> {
    let model = replayer.model();
    let lane = crate::plant::Plant::nominal(model).lane;
    let mut plant = crate::plant::Plant::nominal(model);
    plant.session = 0.5;
    for term in base {
        (term.effect.apply)(&mut plant, &term.place, &term.values);
    }
    let mean = |x: &[f32]| x.iter().map(|v| f64::from(*v)).sum::<f64>() / x.len().max(1) as f64;
    let mut out = Vec::new();
    let mut one = |id: &str, parameter: usize, value: f64, share: f64, per_joint: bool| {
        let Some(effect) = effects::find(id) else {
            return;
        };
        let Some(place) = effect.places(model).into_iter().next() else {
            return;
        };
        let mut values = effect.neutral(model, &place);
        values[parameter] = value;
        let mut variant = base.to_vec();
        variant.push(Term {
            effect,
            place,
            values,
        });
        out.push(Nuisance {
            variant,
            share: share as f32,
            per_joint,
        });
    };
    // a few times the tolerance, scaled back: the trace of a tiny change drowns in rounding
    if wet {
        one("water_current", 0, 4.0 * STIR_TOLERANCE_MPS, 0.25, false);
        one("water_current", 1, 4.0 * STIR_TOLERANCE_MPS, 0.25, false);
        one(
            "quadratic_drag",
            1,
            1.0 + 3.0 * DRAG_TOLERANCE,
            1.0 / 3.0,
            false,
        );
        one("buoyancy", 0, 1.0 + 4.0 * BUOYANCY_TOLERANCE, 0.25, false);
    }
    let mut add = |id: &str, value: f64, share: f64, per_joint: bool| {
        one(id, 0, value, share, per_joint);
    };
    let friction = mean(&plant.lane.joint_friction_nm).max(0.003 * effective_torque(&lane, model));
    add(
        "coulomb_friction",
        3.0 * FRICTION_TOLERANCE * friction,
        1.0 / 3.0,
        true,
    );
    let damping = mean(&plant.lane.joint_damping_nms_per_rad);
    if damping > 0.0 {
        add(
            "viscous_friction",
            3.0 * FRICTION_TOLERANCE * damping,
            1.0 / 3.0,
            true,
        );
    }
    let way = mean(
        &plant
            .lane
            .joints
            .iter()
            .map(|j| j.presliding_rad)
            .collect::<Vec<_>>(),
    );
    add("pre_sliding", way * (1.0 + PRESLIDING_TOLERANCE), 1.0, true);
    add("kp_error", 1.0 + 3.0 * GAINS_TOLERANCE, 1.0 / 3.0, true);
    add("servo_loop_delay", 6.0 * LOOP_TOLERANCE_S, 1.0 / 6.0, true);
    add(
        "armature",
        ROTOR_TOLERANCE * mean(&plant.lane.joint_armature_kgm2).max(1e-4),
        1.0,
        true,
    );
    add("current_lag", READING_TOLERANCE_S, 1.0, true);
    add("command_delay", 3.0 * TIME_TOLERANCE_S, 1.0 / 3.0, false);
    add(
        "supply_level",
        1.0 + 3.0 * SUPPLY_TOLERANCE,
        1.0 / 3.0,
        false,
    );
    if !model.feet().is_empty() {
        add("contact_friction", 1.0 + GROUND_TOLERANCE, 1.0, false);
    }
    out
}

fn effective_torque(lane: &caudata_sim::LaneParams, model: &caudata_model::RobotModel) -> f64 {
    let n = lane.torque_scale.len().max(1);
    (0..n).map(|a| model.servo(a).tau_max_nm).sum::<f64>() / n as f64
}

fn trial_ranges(data: &Data) -> Vec<Range<usize>> {
    let mut ranges: Vec<(usize, Range<usize>)> = Vec::new();
    for segment in &data.segments {
        match ranges.last_mut() {
            Some((trial, range)) if *trial == segment.trial => range.end = segment.range.end,
            _ => ranges.push((segment.trial, segment.range.clone())),
        }
    }
    ranges.into_iter().map(|(_, r)| r).collect()
}

fn pieces<'a>(data: &'a Data, range: &'a Range<usize>) -> impl Iterator<Item = &'a Piece> {
    data.segments
        .iter()
        .filter(move |s| s.range.start >= range.start && s.range.end <= range.end)
        .flat_map(|s| &s.pieces)
}

/// Samples of those joints, and of the body, at which `trace` shows: whose mean square of it is at least [`SHOWS`] times the greatest. Misfits are judged
/// joint by joint, and a delay of all commands must not count the more the fewer joints move.
fn shown_in(
    data: &Data,
    range: &Range<usize>,
    joints: usize,
    trace: impl Fn(usize) -> f32,
) -> usize {
    let mut sums = vec![(0.0, 0_usize); joints + 1];
    for piece in pieces(data, range) {
        let group = group(joints, piece);
        for k in piece.range.clone() {
            sums[group].0 += f64::from(trace(k)).powi(2);
        }
        sums[group].1 += piece.range.len();
    }
    let mean = |&(sum, n): &(f64, usize)| sum / n.max(1) as f64;
    let most = sums.iter().map(mean).fold(0.0, f64::max);
    let shown = sums.iter().filter(|s| mean(s) >= SHOWS * most);
    shown.map(|s| s.1).sum()
}

/// Whose misfit a piece belongs to: that of its joint, or, in the place after the last joint, that of the body.
#[must_use]
pub fn group(joints: usize, piece: &Piece) -> usize {
    if piece.kind.of_joint() {
        piece.index
    } else {
        joints
    }
}

/// Whether a sample's channel belongs to a place: its joints' channels for joints, everything else otherwise.
#[must_use]
pub fn concerns(place: &Place, kind: Kind, index: usize) -> bool {
    place.domain != Domain::Joints || !kind.of_joint() || place.items.contains(&index)
}
