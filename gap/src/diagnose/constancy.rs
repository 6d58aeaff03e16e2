//! Whether a cause has one size.
//!
//! A right law has the same size in every part of the data. One that stands in for another fits each part
//! with another size: the gain that is named in place of one that grows with the error is the larger the
//! larger the error. So the data are parted along what laws depend on, each part is asked for how much of the
//! cause it wants, and the scatter of these amounts is held against what was found. What more of the cause
//! does is told to first order, less what the parameters of all other causes can do in its place over all
//! runs.

use std::collections::BTreeMap;
use std::ops::Range;

use caudata_declare::named;
use nalgebra::{DMatrix, DVector};

use super::judge::Judge;
use super::motion::Motion;
use super::product::{dot, stiffen};
use super::state::{Context, Derivatives, On, State};
use crate::replay::Term;
use crate::trial::Kind;

/// Parts along each argument; each holds as much of what the cause does as any other.
const PARTS: usize = 4;
/// A part with less than this share of the information says nothing.
const LEAST_PART: f64 = 1e-3;
/// Share of what a cause does that must show in joints' channels for these to be parted by what joints do: of
/// a buoyancy the base's height tells most.
const IN_JOINTS: f64 = 0.5;

/// A trace of which the others can do all but this share says nothing by itself.
const LEAST_ALONE: f64 = 0.03;
/// Scatter that is no more than this, in floors, is too small to tell a law …
const LEAST_FLOORS: f64 = 0.01;
/// … and from run to run, where drag, friction and supply differ in any lab (one tolerance is 0.06 floors),
/// this.
const LEAST_FLOORS_RUNS: f64 = 0.1;

named! {
    /// What the data are parted along.
    #[derive(Debug, Clone, Copy, PartialEq, Eq)]
    pub enum Along {
        /// From run to run.
        Runs = "from run to run",
        /// |command − position|.
        Error = "from small errors to large ones",
        /// |speed|.
        Speed = "from slow to fast",
        /// |current|, where it is logged.
        Current = "from small currents to large ones",
        /// Current times speed, from braking to driving, where it is logged.
        Power = "from braking to driving",
        /// Position.
        Angle = "from one end of the range to the other",
        /// Speed, with its sign.
        Direction = "from one direction to the other",
    }
}

/// Arguments besides runs.
const ARGUMENT_COUNT: usize = Along::ALL.len() - 1;

/// How the size of a term differs between parts of the data.
#[derive(Debug, Clone)]
pub struct Scatter {
    /// Which term of the model.
    pub term: usize,
    /// Along what.
    pub along: Along,
    /// Root mean square of the differences, as a share of what was found; what noise does to it is taken off.
    pub share: f64,
    /// What each part asks for, as a share of what was found.
    pub sizes: Vec<f64>,
}

/// For each of the terms `which`, along what its size scatters most.
pub fn scatter(
    context: &Context,
    best: &State,
    derivatives: &Derivatives,
    which: &[usize],
) -> Vec<Scatter> {
    let amounts = amounts(context, best, &derivatives.steps);
    let mut sides = vec![Side::new(&context.fit, &best.fit, &derivatives.fit)];
    if !context.same_runs {
        sides.push(Side::new(&context.holdout, &best.holdout, &derivatives.holdout));
    }
    let mut out = Vec::new();
    for &term in which {
        let (own, amount) = &amounts[term];
        let Some(trace) = alone(&sides, own, amount) else {
            continue;
        };
        let arguments = match in_joints(&sides, &trace) > IN_JOINTS {
            true => &Along::ALL[..],
            false => &[Along::Runs],
        };
        let each = arguments.iter().filter_map(|&along| along_one(&sides, &trace, along, term));
        out.extend(each.max_by(|a, b| a.share.total_cmp(&b.share)));
    }
    out
}

/// For each term, how many steps each of its parameters is away from no effect. More or less of a term is all
/// of them in these proportions: the whole trace of a gap or a ripple would count every shift of it as
/// another size.
fn amounts(context: &Context, best: &State, steps: &[f64]) -> Vec<(Range<usize>, Vec<f64>)> {
    let model = context.replayer.model();
    let mut first = 0;
    let of = |t: &Term| {
        let own = first..first + t.values.len();
        first = own.end;
        let neutral = t.neutral(model);
        let moved = t.values.iter().zip(&neutral).map(|(v, z)| v - z);
        let amount = moved.zip(&steps[own.clone()]).map(|(m, step)| m / step);
        (own, amount.collect())
    };
    best.terms.iter().map(of).collect()
}

/// Runs of one role.
struct Side<'a> {
    judge: &'a Judge,
    on: &'a On,
    /// Derivatives by all parameters, whitened. `[P][N]`
    columns: &'a [Vec<f32>],
    /// Which run each sample is of. `[N]`
    run: Vec<usize>,
    /// Arguments of each sample, in the order of [`Along::ALL`] without runs; none for channels that belong
    /// to no joint. `[N]`
    arguments: Vec<Option<[f64; ARGUMENT_COUNT]>>,
}

impl<'a> Side<'a> {
    fn new(judge: &'a Judge, on: &'a On, columns: &'a [Vec<f32>]) -> Self {
        let data = &judge.data;
        let mut arguments = vec![None; data.len()];
        let mut run = vec![0; data.len()];
        for segment in &data.segments {
            run[segment.range.clone()].fill(segment.trial);
            let trial = &data.trials[segment.trial];
            for piece in segment.pieces.iter().filter(|p| p.kind.of_joint()) {
                let joint = piece.index;
                let Some(position) = trial.channel(Kind::Position, joint) else {
                    continue;
                };
                let current = trial.channel(Kind::Current, joint);
                let command = trial.commands.get(joint);
                for k in piece.range.clone() {
                    let t = data.time_s[k];
                    let motion = Motion::at(position, command, t);
                    let current_a = current.map_or(f64::NAN, |c| c.at(t));
                    arguments[k] = Some([
                        motion.error_rad.abs(),
                        motion.qd_radps.abs(),
                        current_a.abs(),
                        current_a * motion.qd_radps,
                        motion.q_rad,
                        motion.qd_radps,
                    ]);
                }
            }
        }
        Self { judge, on, columns, run, arguments }
    }
}

/// One sample of one side, by where it stands along an argument.
struct Sample {
    argument: f64,
    block: (usize, u32),
    score: f64,
    information: f64,
}

/// Sums over a part.
#[derive(Default, Clone)]
struct Part {
    score: f64,
    information: f64,
    /// Variance of the score, from blocks.
    variance: f64,
}

/// What more of a term does (its parameters `own` in proportion to `amount`), less what the parameters of
/// other terms can do in its place; none if that is nearly all of it. `[S][N]`
fn alone(sides: &[Side], own: &Range<usize>, amount: &[f64]) -> Option<Vec<Vec<f32>>> {
    let count = sides.first()?.columns.len();
    let of_side = |s: &Side| {
        let mut sum = vec![0.0; s.on.residual.len()];
        for (column, a) in s.columns[own.clone()].iter().zip(amount) {
            for (x, c) in sum.iter_mut().zip(column) {
                *x += *a as f32 * c;
            }
        }
        sum
    };
    let mut trace: Vec<Vec<f32>> = sides.iter().map(of_side).collect();
    let energy = |trace: &[Vec<f32>]| trace.iter().map(|t| dot(t, t)).sum::<f64>();
    let before = energy(&trace);
    let others: Vec<usize> = (0..count).filter(|i| !own.contains(i)).collect();
    let product = |a: usize, b: usize| -> f64 {
        let of_side = |s: &Side| dot(&s.columns[a], &s.columns[b]);
        sides.iter().map(of_side).sum()
    };
    let n = others.len();
    let mut gram = DMatrix::from_fn(n, n, |i, j| product(others[i], others[j]));
    stiffen(&mut gram);
    let along = |&a: &usize| -> f64 {
        let pairs = sides.iter().zip(&trace);
        pairs.map(|(s, d)| dot(&s.columns[a], d)).sum()
    };
    let along = DVector::from_iterator(n, others.iter().map(along));
    let weights = gram.cholesky()?.solve(&along);
    for (&weight, &other) in weights.iter().zip(&others) {
        for (s, d) in sides.iter().zip(&mut trace) {
            for (x, o) in d.iter_mut().zip(&s.columns[other]) {
                *x -= weight as f32 * o;
            }
        }
    }
    let left = energy(&trace);
    (left > 0.0 && left > LEAST_ALONE * before).then_some(trace)
}

/// How the amount of a term scatters along one argument; none where there is only one part.
fn along_one(sides: &[Side], trace: &[Vec<f32>], along: Along, term: usize) -> Option<Scatter> {
    let samples = samples(sides, trace, along);
    let runs = sides.iter().map(|s| s.judge.data.trials.len()).sum();
    let parts = match along {
        Along::Runs => sums(&samples, runs, |s, _| s.argument as usize),
        _ => sums(&samples, PARTS, |_, before| (before * PARTS as f64) as usize),
    };
    let least = match along {
        Along::Runs => LEAST_FLOORS_RUNS,
        _ => LEAST_FLOORS,
    };
    let (share, sizes) = apart(&parts, least * samples.len() as f64)?;
    Some(Scatter { term, along, share, sizes })
}

/// Share of `trace` that shows in joints' channels.
fn in_joints(sides: &[Side], trace: &[Vec<f32>]) -> f64 {
    let (mut joints, mut all) = (0.0, 0.0);
    for (side, own) in sides.iter().zip(trace) {
        for (x, arguments) in own.iter().zip(&side.arguments) {
            let square = f64::from(*x).powi(2);
            all += square;
            if arguments.is_some() {
                joints += square;
            }
        }
    }
    joints / f64::max(all, f64::MIN_POSITIVE)
}

/// Every sample that has an argument, in its order.
fn samples(sides: &[Side], trace: &[Vec<f32>], along: Along) -> Vec<Sample> {
    let mut samples: Vec<Sample> = Vec::new();
    let mut runs_before = 0;
    for (which, (side, own)) in sides.iter().zip(trace).enumerate() {
        for (k, x) in own.iter().enumerate() {
            let argument = match along {
                Along::Runs => (runs_before + side.run[k]) as f64,
                _ => side.arguments[k].map_or(f64::NAN, |a| a[along as usize - 1]),
            };
            if argument.is_nan() {
                continue;
            }
            let x = f64::from(*x);
            samples.push(Sample {
                argument,
                block: (which, side.judge.data.block[k]),
                score: x * f64::from(side.on.residual[k]),
                information: x * x,
            });
        }
        runs_before += side.judge.data.trials.len();
    }
    samples.sort_by(|a, b| a.argument.total_cmp(&b.argument));
    samples
}

/// Sums over `count` parts. `part`: that of a sample, by itself and by the share of all information that
/// comes before it.
fn sums(samples: &[Sample], count: usize, part: impl Fn(&Sample, f64) -> usize) -> Vec<Part> {
    let total: f64 = samples.iter().map(|s| s.information).sum();
    let mut before = 0.0;
    let mut parts = vec![Part::default(); count];
    let mut blocks: BTreeMap<(usize, (usize, u32)), f64> = BTreeMap::new();
    for s in samples {
        let number = part(s, before / total.max(f64::MIN_POSITIVE)).min(count - 1);
        before += s.information;
        parts[number].score += s.score;
        parts[number].information += s.information;
        *blocks.entry((number, s.block)).or_insert(0.0) += s.score;
    }
    for ((number, _), score) in blocks {
        parts[number].variance += score * score;
    }
    parts
}

/// Scatter of the amounts that `parts` ask for, less what noise makes of it; and each part's amount, 1 being
/// what was found. None where all information is in one part, or where what is scattered has a square of less
/// than `least`.
fn apart(parts: &[Part], least: f64) -> Option<(f64, Vec<f64>)> {
    let all: f64 = parts.iter().map(|p| p.information).sum();
    let parts: Vec<&Part> = (parts.iter()).filter(|p| p.information > LEAST_PART * all).collect();
    if parts.len() < 2 {
        return None;
    }
    let total: f64 = parts.iter().map(|p| p.information).sum();
    let mean = parts.iter().map(|p| p.score).sum::<f64>() / total;
    let off = |p: &Part| p.score / p.information - mean;
    let square: f64 = parts.iter().map(|p| p.information * off(p).powi(2)).sum();
    // of n parts that differ by noise alone, what their mean leaves
    let noise: f64 =
        (parts.iter()).map(|p| p.variance / p.information * (1.0 - p.information / total)).sum();
    let sizes = parts.iter().map(|p| 1.0 + p.score / p.information);
    let scattered = (square - noise).max(0.0);
    (scattered >= least).then(|| ((scattered / total).sqrt(), sizes.collect()))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sample(argument: f64, block: u32, residual: f64) -> Sample {
        // the whole effect does 20 everywhere: where a tenth of it is missing, 2 are left
        Sample { argument, block: (0, block), score: 20.0 * residual, information: 400.0 }
    }

    #[test]
    fn a_size_that_grows_along_an_argument_scatters_by_how_much() {
        // the lower half of the data asks for a fifth less, the upper for a fifth more
        let samples: Vec<Sample> = (0..80)
            .map(|k| sample(f64::from(k), k as u32, if k < 40 { -4.0 } else { 4.0 }))
            .collect();
        let parts = sums(&samples, 2, |_, before| (2.0 * before) as usize);
        let (share, sizes) = apart(&parts, 0.0).unwrap();
        assert_eq!(sizes, [0.8, 1.2]);
        // blocks of one sample do not know that they hang together: a score is 80, 40 of them have a variance
        // of 40·80² in an information of 16,000, that is 16, half of which the mean of two parts leaves of
        // either. The square of what is apart is 16,000·0.2² of either: (1280 − 16)/32,000 = 0.0395
        assert!((share - 0.0395_f64.sqrt()).abs() < 1e-12, "{share}");
    }

    #[test]
    fn what_noise_makes_of_a_size_is_no_scatter() {
        // two parts of 16 blocks of one sample each; in one nine ask for more and seven for less, in the
        // other the reverse
        let samples: Vec<Sample> = (0..32)
            .map(|k: u32| {
                let (part, number) = (k / 16, k % 16);
                let more = if part == 0 { number < 9 } else { number < 7 };
                sample(f64::from(part), k, if more { 3.0 } else { -3.0 })
            })
            .collect();
        let parts = sums(&samples, 2, |s, _| s.argument as usize);
        // a part's score is ±2·60 in an information of 6,400: 2.25 each. Its variance is 16·60², 9 in that
        // information, of which half
        let square: f64 = parts.iter().map(|p| p.score.powi(2) / p.information).sum();
        assert!((square - 4.5).abs() < 1e-12, "{square}");
        assert_eq!(apart(&parts, 0.0).unwrap().0, 0.0);
        // too little to tell a law, and one part alone, which cannot differ from itself
        assert!(apart(&parts, 1e-9).is_none());
        assert!(apart(&sums(&samples, 1, |_, _| 0), 0.0).is_none());
    }

    #[test]
    fn arguments_come_in_the_order_of_their_names() {
        for (n, along) in Along::ALL.into_iter().enumerate() {
            assert_eq!(along as usize, n);
        }
    }
}
