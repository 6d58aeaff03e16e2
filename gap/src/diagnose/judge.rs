//! The metric: how far a prediction is from what was measured, in units of what cannot be held against a
//! model.
//!
//! A residual is divided by its noise ([`super::noise`]), and directions in which careful labs differ from
//! run to run (a little more friction, a little less voltage, half a step of time) are taken as random with
//! their tolerances: with N the traces of these nuisances at one tolerance each, the residual r is whitened
//! to (I + κ²·N·n⁻¹·Nᵀ)^(−½)·r, run by run, n the number of samples of those joints that a nuisance shows at.
//! The misfit is the mean square of that: 1 is the floor. What no nuisance explains stays. k tolerances of
//! one come to at most (k/κ)²: one tolerance is little, many are a gap although a nuisance explains them.
//! (With I + N·Nᵀ, which is what independent Gaussian noise would ask for, they come to k²/n: nothing,
//! whatever k.)

use std::ops::Range;

use caudata_model::RobotModel;
use caudata_runlog::BaseHold;

use super::metric::{Column, TrialMetric};
use super::noise::Noise;
use super::nuisances::nuisances;
use super::pipeline::add_own_misses;
use super::product::dot;
use crate::effects::{PASSED_STOP, Place};
use crate::error::GapError;
use crate::replay::{Data, Piece, Replayer, Segment, SegmentOptions, Term};

/// Mean square error of one channel in one run, in squared noises, that counts at most.
const MOST_MISFIT: f64 = 80.0;
/// With hinges that nobody drives, engines part by so many times (and not once) what halving the step changes: with
/// once both healthy days of a salamander on a stand are a gap. Chosen on these days, when steps were of the first
/// order.
const ENGINES_APART: f32 = 7.0;
/// Nobody has measured how hard the ground is: what one of a quarter of the file's time constant changes
/// belongs to the floor.
const HARDER_GROUND: f64 = 4.0;

/// See [`shown_in`].
const SHOWS: f64 = 0.01;

/// End stops farther out by what matters of one.
fn stops_elsewhere(model: &RobotModel) -> Vec<Term> {
    let farther = |a: usize| {
        let mut term = Term::nothing(model, &PASSED_STOP, Place::of_joint(model, a));
        term.values = vec![PASSED_STOP.parameters[0].scale * model.per_radian(a); 2];
        term
    };
    (0..model.actuated().len()).map(farther).collect()
}

/// Runs of one role with their metric.
pub struct Judge {
    /// The runs.
    pub data: Data,
    /// Their noise.
    pub noise: Noise,
    trials: Vec<TrialMetric>,
}

impl Judge {
    /// For `data`, which was cut with `options`, with nuisances around the robot as given.
    ///
    /// # Errors
    /// As [`Replayer::predict`].
    pub fn new(replayer: &Replayer, data: Data, options: SegmentOptions) -> Result<Self, GapError> {
        let mut noise = Noise::of(replayer.model(), &data);
        add_own_misses(replayer, &data, options, &mut noise)?;
        let mut judge = Self { data, noise, trials: Vec::new() };
        judge.cap(replayer)?;
        judge.set_base(replayer, &[])?;
        if judge.add_numerics(replayer)? {
            judge.set_base(replayer, &[])?;
        }
        Ok(judge)
    }

    /// Adds what the simulator's own settings do, beyond what nuisances explain, to the noise: of held runs
    /// what half its step does, of runs on the ground what harder ground does. Whether that is anything. No file has
    /// how hard stops are, and so how far a joint gets: what stops do that are elsewhere is added where they do it.
    fn add_numerics(&mut self, replayer: &Replayer) -> Result<bool, GapError> {
        if self.data.trials.iter().all(|t| t.base == BaseHold::Water) {
            return Ok(false);
        }
        let model = replayer.model();
        let apart = match model.joints().len() == model.actuated().len() {
            true => 1.0,
            false => ENGINES_APART,
        };
        let harder = replayer.on_harder_ground(HARDER_GROUND);
        let others = [(BaseHold::Fixed, replayer.finer(), apart), (BaseHold::Free, harder, 1.0)];
        let as_given = replayer.predict(&self.data, &[Vec::new()])?.swap_remove(0);
        let elsewhere = replayer.predict(&self.data, &[stops_elsewhere(model)])?.swap_remove(0);
        for (k, off) in self.change(&elsewhere, &as_given).iter().enumerate() {
            self.noise.grow(k..k + 1, 1.0_f32.hypot(*off));
        }
        for (base, other, times) in others {
            if self.data.trials.iter().all(|t| t.base != base) {
                continue;
            }
            let changed = other.predict(&self.data, &[Vec::new()])?.swap_remove(0);
            let off = self.change(&changed, &as_given);
            let here = |s: &Segment| self.data.trials[s.trial].base == base;
            for (_, piece) in self.data.parts().filter(|(s, _)| here(s)) {
                let of = &off[piece.range.clone()];
                let square = dot(of, of) / of.len().max(1) as f64;
                self.noise.grow(piece.range.clone(), 1.0_f32.hypot(times * square.sqrt() as f32));
            }
        }
        Ok(true)
    }

    /// Only the stretches `keep` of `data`, which holds the same runs as `whole` cut otherwise, with the
    /// noise that they have there, around the robot as given.
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
            left: vec![0.0; data.len()],
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
                    noise.left[k] = whole.noise.left[at];
                }
            }
        }
        let mut judge = Self { data, noise, trials: Vec::new() };
        judge.set_base(replayer, &[])?;
        Ok(judge)
    }

    /// What one tolerance of each nuisance does at each of so many joints and at the body in each of `count` windows,
    /// sums of squares. `window`: that of each sample, or anything from `count` on. `[N]` to `[count][F]`
    pub fn sensitivities(&self, window: &[usize], count: usize, joints: usize) -> Vec<Vec<f64>> {
        let of_trial = |t: &'_ TrialMetric| t.columns.iter().map(|c| c.of.0 + 1).max();
        let nuisances = self.trials.iter().filter_map(of_trial).max().unwrap_or(0);
        let mut sums = vec![vec![0.0; nuisances * (joints + 1)]; count];
        for trial in &self.trials {
            for column in &trial.columns {
                let feature = column.of.0 * (joints + 1) + column.of.1;
                for (at, v) in &column.parts {
                    for (w, x) in window[trial.range.start + at..].iter().zip(v) {
                        if let Some(of) = sums.get_mut(*w) {
                            of[feature] += f64::from(*x / column.unit).powi(2);
                        }
                    }
                }
            }
        }
        sums
    }

    /// Raises the noise of channels in which the robot as given is hopelessly far off, so that no single one
    /// of them rules the fit.
    fn cap(&mut self, replayer: &Replayer) -> Result<(), GapError> {
        let base = replayer.predict(&self.data, &[Vec::new()])?.swap_remove(0);
        for piece in self.data.pieces() {
            let sigma = &self.noise.sigma;
            let off = |k: usize| (self.data.value[k] - f64::from(base[k])) / f64::from(sigma[k]);
            let squares = piece.range.clone().map(|k| off(k).powi(2));
            let square: f64 = squares.filter(|x| x.is_finite()).sum();
            let misfit = square / piece.range.len().max(1) as f64;
            self.noise.grow(piece.range.clone(), (misfit / MOST_MISFIT).max(1.0).sqrt() as f32);
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
                    if !n.joints.is_empty() {
                        for &joint in &n.joints {
                            let own = pieces(&self.data, &range)
                                .filter(|p| p.kind.of_joint() && p.index == joint);
                            let at = |p: &Piece| p.range.start - range.start;
                            let of: Vec<(usize, Vec<f32>)> = own
                                .map(|p| (at(p), p.range.clone().map(delta).collect()))
                                .collect();
                            let n = of.iter().map(|(_, v)| v.len()).sum();
                            columns.push(Column::new(of, n, (number, joint)));
                        }
                    } else {
                        let n = shown_in(&self.data, &range, joints, delta);
                        let whole = vec![(0, range.clone().map(delta).collect())];
                        columns.push(Column::new(whole, n, (number, joints)));
                    }
                }
                TrialMetric::new(range, columns)
            })
            .collect();
        Ok(())
    }

    /// Measured less predicted, whitened. Samples without a prediction count as a hundred times their noise.
    pub fn residual(&self, prediction: &[f32]) -> Vec<f32> {
        self.in_noise(100.0, |k| (self.data.value[k] - f64::from(prediction[k])) as f32)
    }

    /// One prediction less another, whitened.
    pub fn change(&self, to: &[f32], from: &[f32]) -> Vec<f32> {
        self.in_noise(0.0, |k| to[k] - from[k])
    }

    fn in_noise(&self, broken: f32, raw: impl Fn(usize) -> f32) -> Vec<f32> {
        let of = |(k, sigma): (usize, &f32)| match raw(k) / sigma {
            x if x.is_finite() => x.clamp(-1e4, 1e4),
            _ => broken,
        };
        self.whiten(self.noise.sigma.iter().enumerate().map(of).collect())
    }

    fn whiten(&self, mut x: Vec<f32>) -> Vec<f32> {
        for trial in &self.trials {
            trial.apply(&mut x[trial.range.clone()]);
        }
        x
    }

    /// Noise as repeats show it, whitened; empty without repeats.
    pub fn repeat_noise(&self) -> Vec<f32> {
        if self.noise.repeated { self.whiten(self.noise.difference.clone()) } else { Vec::new() }
    }

    /// Mean square of a whitened vector.
    pub fn misfit(&self, residual: &[f32]) -> f64 {
        dot(residual, residual) / residual.len().max(1) as f64
    }

    /// Per block: Σ of f over its samples. `[B]`
    pub fn by_block(&self, f: impl Fn(usize) -> f64) -> Vec<f64> {
        let mut sums = vec![0.0; self.data.blocks];
        for (k, b) in self.data.block.iter().enumerate() {
            sums[*b as usize] += f(k);
        }
        sums
    }

    /// Per run: Σ of f over its samples. `[T]`
    pub fn by_trial(&self, f: impl Fn(usize) -> f64) -> Vec<f64> {
        self.trials.iter().map(|t| t.range.clone().map(&f).sum()).collect()
    }

    /// Whether the candidate could be simulated at all.
    pub fn sound(prediction: &[f32]) -> bool {
        prediction.iter().all(|x| x.is_finite())
    }
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

/// Samples of those joints, and of the body, at which `trace` shows: whose mean square of it is at least
/// [`SHOWS`] times the greatest. Misfits are judged joint by joint, and a delay of all commands must not
/// count the more the fewer joints move.
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

/// Whose misfit a piece belongs to: that of its joint, or, in the place after the last joint, that of the
/// body.
pub fn group(joints: usize, piece: &Piece) -> usize {
    if piece.kind.of_joint() { piece.index } else { joints }
}
