//! Fitting all joints of a robot side by side to their measured angles.
//!
//! A joint of a held robot hardly moves the others. So one simulation in which a parameter of every joint is
//! changed gives the derivative by that parameter at every joint: a model with six parameters at each of six
//! joints costs twelve simulations a step, and not seventy-two. Least squares with a loss that is quadratic
//! for small residuals and linear for large ones (P. J. Huber, Robust statistics, 1981; here its smooth form
//! √(1 + x²) − 1), by damped Gauss–Newton. Terms of the whole robot are solved for with the joints' own
//! eliminated.

use std::ops::Range;

use nalgebra::{DMatrix, DVector};

use super::folds::{Folds, jackknife};
use super::product::dot;
use super::refine::{TRIES, moved};
use super::state::{Context, frees, up_and_down};
use crate::check::series::median;
use crate::effects::Domain;
use crate::error::GapError;
use crate::replay::{Data, Term, Variant};
use crate::trial::Kind;

/// Residuals from so many times the median on count linearly.
const LINEAR_FROM: f64 = 2.0;
/// Smallest residual that counts linearly, rad: an encoder's count.
const COUNT_RAD: f64 = 1e-3;
/// A fall of the loss by less than this share, at every joint, ends a fit.
const SETTLED: f64 = 2e-3;

/// A model of a robot, joint by joint.
#[derive(Debug, Clone, Default)]
pub struct Joints {
    /// Terms of each joint, each at that joint alone. `[A]`
    pub own: Vec<Variant>,
    /// Terms of the whole robot.
    pub shared: Variant,
    /// Terms that stay as they are.
    pub fixed: Variant,
}

impl Joints {
    /// As given, with so many joints.
    pub fn as_given(joints: usize) -> Self {
        Self { own: vec![Vec::new(); joints], ..Self::default() }
    }

    /// `terms` by the joint that each is at; those of several joints are shared. Those of `fixed` stay as they are.
    pub fn of(joints: usize, terms: &[Term], fixed: Variant) -> Self {
        let others = terms.iter().filter(|t| !fixed.iter().any(|f| f.same(t)));
        let mut model = Self { fixed: fixed.clone(), ..Self::as_given(joints) };
        for term in others {
            match (term.place.domain, term.place.items.as_slice()) {
                (Domain::Joints, [a]) => model.own[*a].push(term.clone()),
                _ => model.shared.push(term.clone()),
            }
        }
        model
    }

    /// As a candidate. Terms at different joints do not meet, so that their order says nothing.
    pub fn variant(&self) -> Variant {
        let first = self.fixed.iter().chain(&self.shared);
        first.chain(self.own.iter().flatten()).cloned().collect()
    }
}

/// Numbers of terms.
pub fn values(terms: &[Term]) -> usize {
    terms.iter().map(|t| t.values.len()).sum()
}

/// Term and parameter at a slot.
fn slot(terms: &[Term], slot: usize) -> Option<(usize, usize)> {
    let mut first = 0;
    for (i, t) in terms.iter().enumerate() {
        if slot < first + t.values.len() {
            return Some((i, slot - first));
        }
        first += t.values.len();
    }
    None
}

/// Angles of all joints in a set of runs.
pub struct Angles<'a> {
    context: &'a Context,
    data: &'a Data,
    of: Vec<OfJoint>,
}

/// Samples of one joint's angle.
struct OfJoint {
    ranges: Vec<Range<usize>>,
    folds: Folds,
    count: usize,
}

impl OfJoint {
    fn gather(&self, from: impl Fn(usize) -> f32) -> Vec<f32> {
        self.ranges.iter().cloned().flatten().map(from).collect()
    }
}

/// A model with what it leaves and what its parameters can do.
#[derive(Clone)]
pub struct Linear {
    /// Measured less predicted, rad. `[A][N]`
    pub residual: Vec<Vec<f32>>,
    /// Derivatives of each joint's own parameters, rad per step. `[A][P][N]`
    pub columns: Vec<Vec<Vec<f32>>>,
    /// Steps of those, SI. `[A][P]`
    pub steps: Vec<Vec<f64>>,
    /// Derivatives of the shared ones at each joint, rad per step. `[A][S][N]`
    shared: Vec<Vec<Vec<f32>>>,
    shared_steps: Vec<f64>,
}

impl Linear {
    /// Takes what `other` says of joint `a`.
    pub fn take(&mut self, other: &Self, a: usize) {
        self.residual[a].clone_from(&other.residual[a]);
        self.columns[a].clone_from(&other.columns[a]);
        self.steps[a].clone_from(&other.steps[a]);
        self.shared[a].clone_from(&other.shared[a]);
    }
}

impl<'a> Angles<'a> {
    /// The angles of the joints in `data`.
    pub fn of(context: &'a Context, data: &'a Data) -> Self {
        let joints = context.replayer.model().actuated().len();
        let of = |a: usize| {
            let (folds, ranges) =
                Folds::of_runs(data, |p| p.kind == Kind::Position && p.index == a);
            OfJoint { count: ranges.iter().map(Range::len).sum(), ranges, folds }
        };
        Self { context, data, of: (0..joints).map(of).collect() }
    }

    /// Whether joint `a` has an angle in these runs.
    pub fn measured(&self, a: usize) -> bool {
        self.of[a].count > 0
    }

    /// Mean over all joints that have an angle, of slides in what counts as a radian.
    pub fn mean(&self, of: impl Fn(usize) -> f64) -> f64 {
        let own = (0..self.of.len()).filter(|&a| self.measured(a));
        let (sum, n) =
            own.fold((0.0, 0.0), |(sum, n), a| (sum + of(a) / self.per_radian(a), n + 1.0));
        sum / f64::max(n, 1.0)
    }

    /// What each joint's angle is off by, rad. `[V][A][N]`
    ///
    /// # Errors
    /// As [`crate::replay::Replayer::predict`].
    pub fn residuals(&self, variants: &[Variant]) -> Result<Vec<Vec<Vec<f32>>>, GapError> {
        let predictions = self.context.replayer.predict(self.data, variants)?;
        Ok(predictions.iter().map(|p| self.residual(p)).collect())
    }

    fn residual(&self, prediction: &[f32]) -> Vec<Vec<f32>> {
        let off = |k: usize| {
            let off = (self.data.value[k] - f64::from(prediction[k])) as f32;
            // where a candidate cannot be simulated it is off by half a turn
            if off.is_finite() { off } else { 3.0 }
        };
        self.of.iter().map(|o| o.gather(off)).collect()
    }

    fn change(&self, up: &[f32], down: &[f32]) -> Vec<Vec<f32>> {
        let by = |k: usize| {
            let by = up[k] - down[k];
            if by.is_finite() { by } else { 0.0 }
        };
        self.of.iter().map(|o| o.gather(by)).collect()
    }

    /// What `variants` change at each joint of what `model` predicts, rad; with what that leaves. `[V][A][N]`
    ///
    /// # Errors
    /// As [`crate::replay::Replayer::predict`].
    pub fn changes(
        &self,
        model: &Joints,
        variants: &[Variant],
    ) -> Result<Vec<Vec<Vec<f32>>>, GapError> {
        let base = (self.context.replayer).predict(self.data, &[model.variant()])?.swap_remove(0);
        let mut out = Vec::with_capacity(variants.len());
        for batch in variants.chunks(64) {
            let predictions = self.context.replayer.predict(self.data, batch)?;
            out.extend(predictions.iter().map(|p| self.change(p, &base)));
        }
        Ok(out)
    }

    /// `model` with its derivatives. Those that are `known` are taken as they are: a joint's first parameters and
    /// the shared ones.
    ///
    /// # Errors
    /// As [`crate::replay::Replayer::predict`].
    pub fn linear(&self, model: &Joints, known: Option<&Linear>) -> Result<Linear, GapError> {
        let replayer = &self.context.replayer;
        let joints = self.of.len();
        let mut variants = vec![model.variant()];
        let mut steps = known.map_or(vec![Vec::new(); joints], |k| k.steps.clone());
        let first: Vec<usize> = steps.iter().map(Vec::len).collect();
        let new = |a: usize| values(&model.own[a]).saturating_sub(first[a]);
        let slots = (0..joints).map(new).max().unwrap_or(0);
        for k in 0..slots {
            let (mut up, mut down) = (model.clone(), model.clone());
            for a in 0..joints {
                let Some((i, p)) = slot(&model.own[a], first[a] + k) else {
                    continue;
                };
                let (high, low) = up_and_down(replayer, &model.own[a][i], p);
                up.own[a][i].values[p] = high;
                down.own[a][i].values[p] = low;
                steps[a].push((high - low).max(1e-12));
            }
            variants.extend([up.variant(), down.variant()]);
        }
        let mut shared_steps = known.map_or(Vec::new(), |k| k.shared_steps.clone());
        let shared_terms = model.shared.iter().enumerate();
        for (i, term) in shared_terms.filter(|_| known.is_none()) {
            for p in 0..term.values.len() {
                let (high, low) = up_and_down(replayer, term, p);
                for value in [high, low] {
                    let mut changed = model.clone();
                    changed.shared[i].values[p] = value;
                    variants.push(changed.variant());
                }
                shared_steps.push((high - low).max(1e-12));
            }
        }
        let predictions = replayer.predict(self.data, &variants)?;
        let mut columns = known.map_or(vec![Vec::new(); joints], |k| k.columns.clone());
        let mut shared = known.map_or(vec![Vec::new(); joints], |k| k.shared.clone());
        for (k, pair) in predictions[1..].chunks(2).enumerate() {
            for (a, column) in self.change(&pair[0], &pair[1]).into_iter().enumerate() {
                if k >= slots {
                    shared[a].push(column);
                } else if k < new(a) {
                    columns[a].push(column);
                }
            }
        }
        Ok(Linear {
            residual: self.residual(&predictions[0]),
            columns,
            steps,
            shared,
            shared_steps,
        })
    }

    /// Fits `model`, in at most `rounds` steps, with derivatives that are `known` as they are. Gives the fitted
    /// one's: each joint's where it was best, since joints hardly move each other.
    ///
    /// # Errors
    /// As [`crate::replay::Replayer::predict`].
    pub fn fit(
        &self,
        model: &mut Joints,
        rounds: usize,
        known: Option<&Linear>,
    ) -> Result<Linear, GapError> {
        let joints = self.of.len();
        let mut damping = vec![0.1_f64; joints];
        let mut linear = self.linear(model, known)?;
        let scales: Vec<f64> = (linear.residual.iter().enumerate())
            .map(|(a, r)| scale(r, self.per_radian(a)))
            .collect();
        let mut were = losses(&linear.residual, &scales);
        let (mut kept, mut best) = (model.clone(), linear.clone());
        for _ in 0..rounds {
            if values(&model.variant()) == values(&model.fixed) {
                break;
            }
            self.step(model, &linear, &scales, &mut damping)?;
            linear = self.linear(model, known)?;
            let costs = losses(&linear.residual, &scales);
            let fell = |(was, is): (&f64, &f64)| (was - is) / was.max(1e-12) < SETTLED;
            let settled = were.iter().zip(&costs).all(fell);
            // joints do move each other a little: what got worse together goes back
            let all = costs.iter().sum::<f64>() < were.iter().sum::<f64>();
            for a in 0..joints {
                let better = match model.shared.is_empty() {
                    true => costs[a] <= were[a],
                    false => all,
                };
                if better {
                    kept.own[a].clone_from(&model.own[a]);
                    were[a] = costs[a];
                    best.take(&linear, a);
                } else {
                    damping[a] *= 30.0;
                }
            }
            if all {
                kept.shared.clone_from(&model.shared);
                best.shared_steps.clone_from(&linear.shared_steps);
            }
            if settled {
                break;
            }
        }
        *model = kept;
        Ok(best)
    }

    /// Takes the best of a few damped steps, joint by joint, or for all together where they share a term.
    fn step(
        &self,
        model: &mut Joints,
        linear: &Linear,
        scales: &[f64],
        damping: &mut [f64],
    ) -> Result<(), GapError> {
        let tried: Vec<Joints> = (TRIES.iter())
            .map(|share| self.moved(model, linear, scales, damping, *share))
            .collect();
        let variants: Vec<Variant> = tried.iter().map(Joints::variant).collect();
        let costs: Vec<Vec<f64>> =
            (self.residuals(&variants)?.iter()).map(|r| losses(r, scales)).collect();
        let best_of = |cost: &dyn Fn(usize) -> f64| {
            (0..TRIES.len()).min_by(|&a, &b| cost(a).total_cmp(&cost(b))).unwrap_or(0)
        };
        let together = best_of(&|t| costs[t].iter().sum());
        for a in 0..self.of.len() {
            let t = match model.shared.is_empty() {
                true => best_of(&|t| costs[t][a]),
                false => together,
            };
            model.own[a].clone_from(&tried[t].own[a]);
            damping[a] = (damping[a] * TRIES[t] * 0.5).clamp(1e-6, 1e6);
        }
        model.shared.clone_from(&tried[together].shared);
        Ok(())
    }

    /// One damped step.
    fn moved(
        &self,
        model: &Joints,
        linear: &Linear,
        scales: &[f64],
        damping: &[f64],
        share: f64,
    ) -> Joints {
        let shared = linear.shared_steps.len();
        let mut left = DMatrix::<f64>::zeros(shared, shared);
        let mut right = DVector::<f64>::zeros(shared);
        let mut parts = Vec::new();
        for a in 0..self.of.len() {
            let weight = weights(&linear.residual[a], scales[a]);
            let weighted =
                |x: &[f32]| -> Vec<f32> { x.iter().zip(&weight).map(|(x, w)| x * w).collect() };
            let own: Vec<Vec<f32>> = linear.columns[a].iter().map(|c| weighted(c)).collect();
            let all: Vec<Vec<f32>> = linear.shared[a].iter().map(|c| weighted(c)).collect();
            let residual = weighted(&linear.residual[a]);
            let mut gram = super::product::gram(&own);
            let most = gram.diagonal().iter().copied().fold(0.0, f64::max);
            for i in 0..gram.nrows() {
                gram[(i, i)] += damping[a] * share * gram[(i, i)] + 1e-9 * most + 1e-30;
            }
            let slope = DVector::from_iterator(own.len(), own.iter().map(|c| dot(c, &residual)));
            let cross = DMatrix::from_fn(own.len(), shared, |i, s| dot(&own[i], &all[s]));
            let Some(inverse) = gram.cholesky().map(|c| c.inverse()) else {
                parts.push(None);
                continue;
            };
            for s in 0..shared {
                right[s] += dot(&all[s], &residual);
                for t in 0..shared {
                    left[(s, t)] += dot(&all[s], &all[t]);
                }
            }
            left -= cross.transpose() * &inverse * &cross;
            right -= cross.transpose() * &inverse * &slope;
            parts.push(Some((inverse, slope, cross)));
        }
        let mean = damping.iter().sum::<f64>() / damping.len().max(1) as f64;
        for s in 0..shared {
            left[(s, s)] *= 1.0 + mean * share;
            left[(s, s)] += 1e-30;
        }
        let of_all = left.cholesky().map_or_else(|| DVector::zeros(shared), |c| c.solve(&right));
        let mut out = model.clone();
        let robot = self.context.replayer.model();
        moved(robot, &mut out.shared, of_all.as_slice(), &linear.shared_steps);
        for (a, part) in parts.iter().enumerate() {
            if let Some((inverse, slope, cross)) = part {
                let by = inverse * (slope - cross * &of_all);
                moved(robot, &mut out.own[a], by.as_slice(), &linear.steps[a]);
            }
        }
        out
    }

    /// What counts as a radian at joint `a`.
    pub fn per_radian(&self, a: usize) -> f64 {
        self.context.replayer.model().per_radian(a)
    }

    /// Each joint in cross-validation: its own terms are left out with each fold, shared and fixed ones stay. `[A]`
    pub fn cross(&self, model: &Joints, linear: &Linear) -> Vec<Cross> {
        let joint = |(a, of): (usize, &OfJoint)| {
            let free = frees(&self.context.replayer, &model.own[a], &linear.steps[a]);
            // in units of about the noise, so that the prior weighs what it should
            let noise = scale(&linear.residual[a], self.per_radian(a)) as f32;
            let scaled = |x: &[f32]| -> Vec<f32> { x.iter().map(|v| v / noise).collect() };
            let columns: Vec<Vec<f32>> = linear.columns[a].iter().map(|c| scaled(c)).collect();
            let (left, shifts) =
                (of.folds).left_out_with(&columns, &scaled(&linear.residual[a]), &free);
            let left: Vec<f32> = left.iter().map(|v| v * noise).collect();
            Cross {
                error: mean_abs(&left),
                shares: of.folds.shares(&left),
                deviations: jackknife(&shifts, &linear.steps[a]),
            }
        };
        self.of.iter().enumerate().map(joint).collect()
    }
}

/// A joint's angle in cross-validation.
#[derive(Debug, Clone)]
pub struct Cross {
    /// Mean absolute error, rad.
    pub error: f64,
    /// What each fold adds to it. `[F]`
    pub shares: Vec<f64>,
    /// Standard deviation of each of the joint's parameters by the jackknife over the folds, SI. `[P]`
    pub deviations: Vec<f64>,
}

/// Mean absolute value.
pub fn mean_abs(x: &[f32]) -> f64 {
    x.iter().map(|v| f64::from(v.abs())).sum::<f64>() / x.len().max(1) as f64
}

/// From which residual on the loss is linear, rad; or m, so many for a radian.
pub fn scale(residual: &[f32], per_radian: f64) -> f64 {
    let sizes = residual.iter().map(|r| f64::from(r.abs())).collect();
    (LINEAR_FROM * median(sizes).unwrap_or(0.0)).max(COUNT_RAD * per_radian)
}

/// Σ 2·s²·(√(1 + (r/s)²) − 1) of each joint: r² for small r, 2·s·|r| for large ones. `[A]`
fn losses(residual: &[Vec<f32>], scales: &[f64]) -> Vec<f64> {
    let of = |(r, s): (&Vec<f32>, &f64)| {
        let loss = |x: &f32| 2.0 * s * s * ((f64::from(*x) / s).hypot(1.0) - 1.0);
        r.iter().map(loss).sum()
    };
    residual.iter().zip(scales).map(of).collect()
}

/// Square roots of the weights that make least squares of that loss.
pub fn weights(residual: &[f32], scale: f64) -> Vec<f32> {
    let weight = |r: &f32| (1.0 / (f64::from(*r) / scale).hypot(1.0).sqrt()) as f32;
    residual.iter().map(weight).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn large_residuals_count_linearly() {
        let scales = [0.1];
        // 2·0.01·(√(1 + 0.01) − 1) ≈ 1e-4 = 0.01²
        let small = losses(&[vec![0.01]], &scales)[0];
        assert!((small - 1e-4).abs() < 1e-6, "{small}");
        // twice as far, about twice the loss
        let (one, two) = (losses(&[vec![10.0]], &scales)[0], losses(&[vec![20.0]], &scales)[0]);
        assert!((two / one - 2.0).abs() < 0.02, "{one} {two}");
        // the weight of a residual that is √3 scales is 1/√(√(1 + 3))
        let w = weights(&[3.0_f32.sqrt() * 0.1], 0.1)[0];
        assert!((w - 0.5_f32.sqrt()).abs() < 1e-6, "{w}");
    }
}
