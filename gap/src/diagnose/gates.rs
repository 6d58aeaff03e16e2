//! The gates that a cause must pass in cross-validation on the runs that are fitted ([`super::folds`]):
//! significant, relevant, general. Held-out runs have no part in it.

use caudata_random::{Key, Purpose, Stream};

use super::judge::{Judge, group};
use super::levels::{CAREFUL_LAB, MANY_JOINTS, NOTHING_LEFT};
use super::product::dot;
use super::state::{Context, On, State};
use crate::effects::{Domain, Place};
use crate::replay::Term;

/// Resamplings.
const RESAMPLES: usize = 400;
/// Gain in cross-validation that counts, as a share of the misfit.
pub const RELATIVE_GAIN: f64 = 0.06;
/// The same in units of the floor.
pub const ABSOLUTE_GAIN: f64 = 0.12;
/// Gain on the runs it was fitted to that leaves no doubt there, if it is more than careful labs have to explain
/// ([`quiet`]), as a share of what there was: parts that hardly ask for an effect need only speak for it then, not
/// prove it by themselves once more.
const BEYOND_DOUBT_SHARE: f64 = 0.25;

/// What takes this share of what other causes leave beyond white noise belongs to them, however little it is.
const MOST_OF_REST: f64 = 0.5;

/// What a model must leave of the misfit of held-out runs to be nearer to them than the robot as given, over all …
const HELD_OUT: f64 = 0.98;
/// … or at one joint.
const HELD_OUT_JOINT: f64 = 0.9;

/// What a step is worth.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Worth {
    /// Fall of the misfit on fit runs.
    pub fit: f64,
    /// Misfit of fit runs before, on the same channels.
    pub fit_of: f64,
    /// In cross-validation.
    pub cross: f64,
    /// Misfit in cross-validation before, on the same channels.
    pub of: f64,
    /// 95 % interval of the fall in cross-validation.
    pub interval: (f64, f64),
    /// Whether the runs it was fitted to leave no doubt.
    pub beyond_doubt: bool,
    /// Whether it takes most of what other causes leave.
    pub rest: bool,
    /// Whether all gates are passed.
    pub passed: bool,
    /// Which gate failed first; empty if none.
    pub why: &'static str,
}

/// What going from `from` to `to` is worth, on the channels that `place` concerns: an effect of one joint is
/// judged by that joint.
pub fn worth(context: &Context, from: &State, to: &State, place: Option<&Place>) -> Worth {
    let joints = context.replayer.model().actuated().len();
    let own = masked(joints, &context.fit, &from.fit, place);
    let before = mean_of(&own, &from.fit);
    let fit = before - mean_of(&own, &to.fit);
    let judge = &context.fit;
    let mask = masked(joints, judge, &from.cross, place);
    let of = mean_of(&mask, &from.cross);
    let samples = mask.iter().filter(|m| **m).count().max(1);
    let gains = falls(judge, &mask, &from.cross, &to.cross);
    let cross = gains.iter().sum::<f64>() / samples as f64;
    let mean = |drawn: &[usize]| drawn.iter().map(|k| gains[*k]).sum::<f64>() / samples as f64;
    let sorted = resampled(gains.len(), context.seed, mean);
    let at = |share: f64| at(&sorted, share);
    let interval = (at(0.025), at(0.975));
    let beyond_doubt = fit > quiet(context) && fit > BEYOND_DOUBT_SHARE * before;
    let white = (mask.iter().enumerate()).filter(|(_, m)| **m).map(|(k, _)| white(judge, k));
    let beyond = of - white.sum::<f64>() / samples as f64;
    let rest = !from.terms.is_empty() && beyond > 0.0 && cross > MOST_OF_REST * beyond;
    let absolute = if beyond_doubt || rest { 0.5 } else { 1.0 } * ABSOLUTE_GAIN;
    let why = if fit <= 0.0 {
        "no gain on the runs it was fitted to"
    } else if cross <= 0.0 {
        "makes the parts that are left out in turn worse"
    } else if joints >= MANY_JOINTS
        && worst_within(joints, judge, &from.cross, &mask) < NOTHING_LEFT
    {
        "what it explains is within what careful labs differ by at one joint of so many"
    } else if interval.0 <= 0.0 && !rare(&gains) {
        "its gain in cross-validation is within what resampling gives by chance"
    } else if cross < RELATIVE_GAIN * of || cross < absolute {
        "its gain in cross-validation is too small to matter"
    } else {
        ""
    };
    Worth {
        fit,
        fit_of: before,
        cross,
        of,
        interval,
        beyond_doubt,
        rest,
        passed: why.is_empty(),
        why,
    }
}

/// An effect that acts rarely (a limit, a stop) gains in few blocks, which resampling may miss: it must gain in two
/// blocks or more (what is in one second is an incident) and lose nearly nowhere.
fn rare(gains: &[f64]) -> bool {
    let total: f64 = gains.iter().sum();
    let lost: f64 = gains.iter().filter(|g| **g < 0.0).map(|g| -g).sum();
    let many = gains.iter().filter(|g| **g > 0.1 * total).count();
    many >= 2 && lost < 0.15 * total
}

/// Fall of the sum of squares by block, on the samples in `mask`.
fn falls(judge: &Judge, mask: &[bool], from: &On, to: &On) -> Vec<f64> {
    judge.by_block(|k| {
        if mask[k] {
            f64::from(from.residual[k]).powi(2) - f64::from(to.residual[k]).powi(2)
        } else {
            0.0
        }
    })
}

/// Misfit from which on there is something to explain. Of many joints one is always a little off.
pub fn quiet(context: &Context) -> f64 {
    unless_many_joints(context, CAREFUL_LAB)
}

/// Misfit below which the search ends: no further effect can pass, or, of many joints, matters.
pub fn least(context: &Context) -> f64 {
    unless_many_joints(context, ABSOLUTE_GAIN)
}

fn unless_many_joints(context: &Context, few: f64) -> f64 {
    if context.replayer.model().actuated().len() < MANY_JOINTS { few } else { NOTHING_LEFT }
}

/// The greatest misfit of the joints, and of the body, that have a sample in `mask`.
fn worst_within(joints: usize, judge: &Judge, on: &On, mask: &[bool]) -> f64 {
    let mut within = vec![false; joints + 1];
    for piece in judge.data.pieces() {
        within[group(joints, piece)] |= mask[piece.range.clone()].contains(&true);
    }
    let named = means(joints, &[(judge, on)]).into_iter().zip(within).filter(|(_, w)| *w);
    named.map(|(mean, _)| mean).fold(0.0, f64::max)
}

/// Mean square on the channels that `place` concerns.
pub fn part(judge: &Judge, on: &On, place: Option<&Place>) -> f64 {
    mean_of(&mask(judge, place), on)
}

fn mean_of(mask: &[bool], on: &On) -> f64 {
    let (mut sum, mut n) = (0.0, 0.0);
    for (r, m) in on.residual.iter().zip(mask) {
        if *m {
            sum += f64::from(*r).powi(2);
            n += 1.0;
        }
    }
    sum / f64::max(n, 1.0)
}

/// Samples by which an effect at `place` is judged: those that it concerns. Of a robot with many joints, an
/// effect of all of it is judged where something is left to explain, if it is anywhere.
fn masked(joints: usize, judge: &Judge, from: &On, place: Option<&Place>) -> Vec<bool> {
    let mut mask = mask(judge, place);
    if joints < MANY_JOINTS || mask.contains(&false) {
        return mask;
    }
    let sums = groups(joints, &[(judge, from)]);
    let quiet: Vec<bool> = sums.iter().map(|(square, n)| *square <= CAREFUL_LAB * n).collect();
    if quiet.iter().all(|q| *q) {
        return mask;
    }
    for piece in judge.data.pieces() {
        if quiet[group(joints, piece)] {
            mask[piece.range.clone()].fill(false);
        }
    }
    mask
}

/// Sums of squares, beyond those of white noise, and samples of each joint's channels, and, in the last place, of
/// those of the body. No model foretells white noise: where a sensor has little else, what is left of it is no gap.
fn groups(joints: usize, parts: &[(&Judge, &On)]) -> Vec<(f64, f64)> {
    let mut sums = vec![(0.0, 0.0); joints + 1];
    for (judge, on) in parts {
        for piece in judge.data.pieces() {
            let group = group(joints, piece);
            let part = &on.residual[piece.range.clone()];
            let white = piece.range.clone().map(|k| white(judge, k));
            let beyond = dot(part, part) - white.sum::<f64>();
            sums[group].0 += beyond.max(0.0);
            sums[group].1 += part.len() as f64;
        }
    }
    sums
}

/// Mean squares of the same.
fn means(joints: usize, parts: &[(&Judge, &On)]) -> Vec<f64> {
    groups(joints, parts).iter().map(|(square, n)| square / f64::max(*n, 1.0)).collect()
}

/// What white noise adds to the square of sample `k`, floors.
fn white(judge: &Judge, k: usize) -> f64 {
    f64::from(judge.noise.left[k] / judge.noise.sigma[k]).powi(2)
}

/// Misfit in cross-validation. Of a robot with many joints, each joint counts as [`CAREFUL_LAB`] at
/// least: with one joint far off, a little of what every careful lab has in all the others must not weigh
/// more than that joint.
pub fn misfit(context: &Context, state: &State) -> f64 {
    let joints = context.replayer.model().actuated().len();
    if joints < MANY_JOINTS {
        return state.misfit();
    }
    let sums = groups(joints, &[(&context.fit, &state.cross)]);
    let samples: f64 = sums.iter().map(|s| s.1).sum();
    let clipped = sums.iter().map(|(square, n)| square.max(CAREFUL_LAB * n));
    clipped.sum::<f64>() / samples.max(1.0)
}

/// Misfit in cross-validation where it is greatest: of the channels of each joint by themselves, and of those
/// of the body. A single bad joint of many hardly shows in the mean over all.
pub fn worst(context: &Context, state: &State) -> f64 {
    worst_of(context, &[(&context.fit, &state.cross)])
}

/// The joint at which it is greatest; none where that is the body.
pub fn worst_joint(context: &Context, state: &State) -> Option<usize> {
    let joints = context.replayer.model().actuated().len();
    let means = means(joints, &[(&context.fit, &state.cross)]);
    let worst = (0..=joints).max_by(|a, b| means[*a].total_cmp(&means[*b]));
    worst.filter(|a| *a < joints)
}

/// Whether the robot as given is as near to all runs as careful labs are, at each joint.
pub fn no_gap(context: &Context, base: &State) -> bool {
    let both = [(&context.fit, &base.fit), (&context.holdout, &base.holdout)];
    worst_of(context, &both) < NOTHING_LEFT
}

/// The same of any runs.
pub fn worst_of(context: &Context, parts: &[(&Judge, &On)]) -> f64 {
    means(context.replayer.model().actuated().len(), parts).into_iter().fold(0.0, f64::max)
}

/// Whether held-out runs are nearer to `to` than to `from`: in the mean, or at one joint and no further in the mean,
/// in which a joint of many hardly shows.
pub fn nearer(context: &Context, from: &State, to: &State) -> bool {
    let joints = context.replayer.model().actuated().len();
    let of = |state: &State| groups(joints, &[(&context.holdout, &state.holdout)]);
    let falls =
        |((before, _), (after, _)): (&(f64, f64), &(f64, f64))| *after < HELD_OUT_JOINT * before;
    let left = to.holdout.misfit / from.holdout.misfit;
    left < HELD_OUT || left <= 1.0 && of(from).iter().zip(&of(to)).any(falls)
}

/// Whether held-out runs say nothing of what `to` has beyond `from`: they predict the same of them, at every joint to a
/// hundredth of what counts.
pub fn silent(context: &Context, from: &State, to: &State) -> bool {
    const SAME: f64 = 0.01;
    let judge = &context.holdout;
    let joints = context.replayer.model().actuated().len();
    let mut sums = vec![(0.0, 0.0); joints + 1];
    for piece in judge.data.pieces() {
        let (square, n) = &mut sums[group(joints, piece)];
        let (one, other) = (&from.holdout.residual, &to.holdout.residual);
        let apart = one[piece.range.clone()].iter().zip(&other[piece.range.clone()]);
        *square += apart.map(|(x, y)| f64::from(x - y).powi(2)).sum::<f64>();
        *n += piece.range.len() as f64;
    }
    !judge.data.is_empty() && sums.iter().all(|(square, n)| *square < SAME * f64::max(*n, 1.0))
}

/// Samples that `place` concerns: channels of its joints, if it names joints; else all.
fn mask(judge: &Judge, place: Option<&Place>) -> Vec<bool> {
    let named = place.filter(|p| p.domain == Domain::Joints && !p.names.is_empty());
    let Some(place) = named else {
        return vec![true; judge.data.len()];
    };
    let mut mask = vec![false; judge.data.len()];
    for piece in judge.data.pieces() {
        if piece.kind.of_joint() && place.items.contains(&piece.index) {
            mask[piece.range.clone()].fill(true);
        }
    }
    mask
}

/// Whether a term is far enough from nothing to matter.
pub fn matters(context: &Context, term: &Term) -> bool {
    size(context, term) >= 1.0
}

/// What was taken in for more, and then left that to others, is no finding below this share of what matters least.
const TOO_LITTLE: f64 = 0.5;

/// Whether a term has become so small that nobody would act on it.
pub fn hardly_matters(context: &Context, term: &Term) -> bool {
    size(context, term) < TOO_LITTLE
}

/// How far a term is from nothing, in the least that matters.
pub fn size(context: &Context, term: &Term) -> f64 {
    let model = context.replayer.model();
    let neutral = term.neutral(model);
    let of = |p: usize| (term.values[p] - neutral[p]).abs() / term.scale(model, p).abs();
    (0..term.values.len()).map(of).fold(0.0, f64::max)
}

/// A statistic of `n` blocks that are drawn with replacement, over and over, sorted.
pub fn resampled(n: usize, seed: u64, statistic: impl Fn(&[usize]) -> f64) -> Vec<f64> {
    let mut stream = Stream::new(Key::for_run(seed), Purpose::Minibatch);
    let mut draw = || -> Vec<usize> { (0..n).map(|_| stream.below(n as u64) as usize).collect() };
    let mut out: Vec<f64> = (0..RESAMPLES).map(|_| statistic(&draw())).collect();
    out.sort_by(f64::total_cmp);
    out
}

/// The value below which this share of `sorted` lies.
pub fn at(sorted: &[f64], share: f64) -> f64 {
    sorted[((share * sorted.len() as f64) as usize).min(sorted.len() - 1)]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_acts_rarely_must_gain_in_two_seconds() {
        assert!(!rare(&[8.0, 0.1, 0.0, 0.0, -0.2]));
        assert!(rare(&[4.0, 4.0, 0.0, -0.2]));
        // too much is lost elsewhere
        assert!(!rare(&[4.0, 4.0, -2.0]));
    }
}
