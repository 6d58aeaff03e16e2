//! How far angles are off over whole runs: of the robot as given, of standard models fitted to the same runs,
//! and of a model that takes from the catalogue whatever each joint's runs support.
//!
//! The standard models are what a laboratory fits first: a PD servo with free gain, rotor inertia and viscous
//! friction; with Coulomb friction; with a delay; with friction that grows with the load. The last model begins
//! with the best of them. For each joint the effects are ranked by what their traces take off what is left,
//! with all parameters that are free already projected out (orthogonal least squares: S. Chen, S. A. Billings
//! and W. Luo, International Journal of Control 50, 1989). The first few are fitted in earnest, and the one
//! stays that lowers the joint's error in cross-validation ([`super::folds`]) most, if any lowers it enough.
//! Held-out runs are not looked at.

use std::collections::{BTreeMap, BTreeSet};

use caudata_model::RobotModel;

use super::alike::look_alike;
use super::doubt::{meet, sizes};
use super::folds::falls;
use super::joints::{Angles, Cross, Joints, Linear, mean_abs, scale, weights};
use super::product::{dot, project, widen};
use super::request::{Progress, Stage};
use super::state::Context;
use crate::effects::{self, Domain, Effect, Place};
use crate::error::GapError;
use crate::replay::{Term, Variant};
use crate::report::PositionError;
use crate::trial::Kind;

/// Steps in which a standard model is fitted.
const ROUNDS: usize = 6;
/// Steps in which a model with one more effect is.
const ROUNDS_MORE: usize = 3;
/// Most effects that are added to a joint.
const MOST_ADDED: usize = 5;
/// Effects of a joint that are fitted in earnest, per effect that is added.
const TRIED: usize = 3;
/// Effects of a joint that are ranked again once the first was added.
const POOL: usize = 12;
/// What an effect must leave of a joint's error in cross-validation at most.
const EARNS: f64 = 0.97;
/// An error of less than so many counts of the encoder is none: rounding alone makes it a quarter of one.
const COUNTS: f64 = 0.5;

/// A standard model: its name, effects of each joint, effects of the whole robot, and the model whose fit it
/// begins with.
struct Standard {
    name: &'static str,
    own: &'static [&'static str],
    shared: &'static [&'static str],
    from: Option<usize>,
}

const STANDARD: [Standard; 4] = [
    Standard {
        name: "PD, rotor, viscous friction",
        own: &["kp_error", "armature", "viscous_friction"],
        shared: &[],
        from: None,
    },
    Standard {
        name: "PD, rotor, viscous, Coulomb friction",
        own: &["coulomb_friction"],
        shared: &[],
        from: Some(0),
    },
    Standard {
        name: "PD, rotor, viscous, Coulomb friction, delay",
        own: &[],
        shared: &["command_delay"],
        from: Some(1),
    },
    Standard {
        name: "PD, rotor, viscous, Coulomb, load friction",
        own: &["load_dependent_friction"],
        shared: &[],
        from: Some(1),
    },
];

/// A fitted model.
#[derive(Debug, Clone)]
pub struct Model {
    /// In a report.
    pub name: String,
    /// The model.
    pub joints: Joints,
    /// Mean absolute error in cross-validation, mean over joints, rad.
    pub cross_rad: f64,
    /// Standard deviations of the parameters of each joint, SI. `[A][P]`
    pub deviations: Vec<Vec<f64>>,
}

impl Model {
    /// The same around the terms `fixed`, which stay as they are, fitted again: without what they say, and from
    /// nothing of what looks like them.
    ///
    /// # Errors
    /// As [`crate::replay::Replayer::predict`].
    pub fn around(
        &self,
        context: &Context,
        angles: &Angles<'_>,
        fixed: Variant,
    ) -> Result<Self, GapError> {
        let said = |t: &Term, how: fn(&Effect, &Effect) -> bool| {
            let mut here = fixed.iter().filter(|f| meet(&f.place, &t.place));
            here.any(|f| how(f.effect, t.effect))
        };
        let mut joints = self.joints.clone();
        for terms in joints.own.iter_mut().chain([&mut joints.shared]) {
            terms.retain(|t| !said(t, |f, own| f == own));
            for t in terms.iter_mut().filter(|t| said(t, look_alike)) {
                t.values = t.neutral(context.replayer.model());
            }
        }
        joints.fixed = fixed;
        let linear = angles.fit(&mut joints, ROUNDS, None)?;
        Ok(judged(angles, &self.name, joints, &linear))
    }
}

/// What was fitted to angles. Grows as it goes: where time ends, what is there is there.
#[derive(Debug, Clone, Default)]
pub struct Tracking {
    /// Standard models.
    pub standard: Vec<Model>,
    /// What each joint's runs support of the catalogue.
    pub built: Option<Model>,
}

impl Tracking {
    /// Fits the standard models.
    ///
    /// # Errors
    /// As [`crate::replay::Replayer::predict`].
    pub fn fit_standard(
        &mut self,
        context: &Context,
        progress: &mut dyn FnMut(Progress),
    ) -> Result<(), GapError> {
        let robot = context.replayer.model();
        let angles = Angles::of(context, &context.first_look().data);
        let joints = robot.actuated().len();
        for standard in &STANDARD {
            progress(Progress::new(Stage::Tracking, 0, standard.name));
            let mut model = match standard.from {
                Some(k) => self.standard[k].joints.clone(),
                None => Joints::as_given(joints),
            };
            for a in (0..joints).filter(|&a| angles.measured(a)) {
                let own = standard.own.iter().filter_map(|id| effects::find(id));
                model.own[a]
                    .extend(own.map(|e| Term::nothing(robot, e, Place::of_joint(robot, a))));
            }
            for effect in standard.shared.iter().filter_map(|id| effects::find(id)) {
                let place = effect.places(robot).swap_remove(0);
                model.shared.push(Term::nothing(robot, effect, place));
            }
            let linear = angles.fit(&mut model, ROUNDS, None)?;
            let fitted = judged(&angles, standard.name, model, &linear);
            self.standard.push(fitted);
        }
        Ok(())
    }

    /// Builds the model that each joint's runs support, if the robot as given has a `gap` or a standard model is
    /// nearer to the angles. Where the robot is not held that is the best standard model: there joints move each
    /// other through its body, and nothing is added joint by joint.
    ///
    /// # Errors
    /// As [`crate::replay::Replayer::predict`].
    pub fn build(
        &mut self,
        context: &Context,
        gap: bool,
        progress: &mut dyn FnMut(Progress),
    ) -> Result<(), GapError> {
        let Some(first) = self.best_standard().cloned() else {
            return Ok(());
        };
        let angles = Angles::of(context, &context.first_look().data);
        let off = angles.residuals(&[Variant::new()])?.swap_remove(0);
        let nearer = first.cross_rad < angles.mean(|a| mean_abs(&off[a]));
        let is_off = |a: usize| is_off(context, &angles, a, mean_abs(&off[a]));
        if !(gap || nearer && (0..off.len()).any(is_off)) {
            return Ok(());
        }
        self.grow(context, first.joints, progress)
    }

    /// What each joint's runs support beside the terms `fixed`, which stay as they are; built anew, with what they
    /// explain taken off. Nothing without standard models.
    ///
    /// # Errors
    /// As [`crate::replay::Replayer::predict`].
    pub fn anew(&self, context: &Context, fixed: Variant) -> Result<Option<Model>, GapError> {
        let Some(first) = self.best_standard() else {
            return Ok(None);
        };
        let angles = Angles::of(context, &context.first_look().data);
        let around = first.around(context, &angles, fixed)?;
        let mut built = Self::default();
        built.grow(context, around.joints, &mut |_| {})?;
        Ok(built.built)
    }

    fn best_standard(&self) -> Option<&Model> {
        self.standard.iter().min_by(|a, b| a.cross_rad.total_cmp(&b.cross_rad))
    }

    /// Adds effects to each joint of `first` as long as one earns its place.
    fn grow(
        &mut self,
        context: &Context,
        mut first: Joints,
        progress: &mut dyn FnMut(Progress),
    ) -> Result<(), GapError> {
        let mut model = first.clone();
        let angles = Angles::of(context, &context.first_look().data);
        let is_off = |a: usize, error: f64| is_off(context, &angles, a, error);
        let mut linear = angles.linear(&model, None)?;
        let mut crossed = angles.cross(&model, &linear);
        self.keep(&angles, &model, &linear);
        let joints = crossed.len();
        let held = context.is_held();
        let mut open: Vec<bool> = (0..joints).map(|a| is_off(a, crossed[a].error)).collect();
        let mut pool: Option<Vec<BTreeSet<&str>>> = None;
        for depth in (1..=MOST_ADDED).take_while(|_| held) {
            progress(Progress::new(Stage::Tracking, depth, "joint by joint"));
            let ranked = ranked(context, &angles, (&model, &linear), &open, pool.as_deref())?;
            if pool.is_none() {
                let ids = |r: &Vec<Term>| r.iter().take(POOL).map(|t| t.effect.id).collect();
                pool = Some(ranked.iter().map(ids).collect());
            }
            let mut best: Vec<Option<(Cross, Variant)>> = vec![None; joints];
            for t in 0..TRIED {
                let mut with = model.clone();
                for a in (0..joints).filter(|&a| open[a]) {
                    with.own[a].extend(ranked[a].get(t).cloned());
                }
                // what the others can do hardly changes with one more, and is worked out once more for the
                // one that stays
                let fitted = angles.fit(&mut with, ROUNDS_MORE, Some(&linear))?;
                for (a, after) in angles.cross(&with, &fitted).into_iter().enumerate() {
                    let earns = earns(&crossed[a], &after);
                    if earns && best[a].as_ref().is_none_or(|b| after.error < b.0.error) {
                        best[a] = Some((after, with.own[a].clone()));
                    }
                }
            }
            for a in 0..joints {
                match best[a].take() {
                    Some((_, terms)) if open[a] => model.own[a] = terms,
                    _ => open[a] = false,
                }
            }
            if !open.contains(&true) {
                break;
            }
            linear = angles.fit(&mut model, 1, None)?;
            crossed = angles.cross(&model, &linear);
            for a in 0..joints {
                open[a] &= is_off(a, crossed[a].error);
            }
            self.keep(&angles, &model, &linear);
        }
        let whole = Angles::of(context, &context.fit.data);
        if (0..joints).any(|a| model.own[a].len() > first.own[a].len()) {
            // what was added looked at a part of the runs: where all of them do without it, it goes
            let grown = whole.fit(&mut model, ROUNDS_MORE, None)?;
            let begun = whole.fit(&mut first, ROUNDS_MORE, None)?;
            let (with, without) = (whole.cross(&model, &grown), whole.cross(&first, &begun));
            for a in (0..joints).filter(|&a| without[a].error <= with[a].error) {
                model.own[a].clone_from(&first.own[a]);
            }
        }
        let linear = whole.fit(&mut model, ROUNDS_MORE, None)?;
        self.keep(&whole, &model, &linear);
        Ok(())
    }

    /// The one that was built, where joints of it were looked at by themselves: of a held robot.
    pub fn joint_by_joint(&self, context: &Context) -> Option<&Joints> {
        self.built.as_ref().filter(|_| context.is_held()).map(|m| &m.joints)
    }

    /// Takes `model` for the one that was built.
    fn keep(&mut self, angles: &Angles<'_>, model: &Joints, linear: &Linear) {
        self.built = Some(judged(angles, "", model.clone(), linear));
    }

    /// Errors of the robot as given, the standard models and `extended` on held-out runs, and on the runs
    /// that were fitted.
    ///
    /// # Errors
    /// As [`crate::replay::Replayer::predict`].
    pub fn errors(
        &self,
        context: &Context,
        extended: &[Term],
    ) -> Result<Vec<PositionError>, GapError> {
        let names = context.replayer.model().actuated_names();
        let mut variants: Vec<Variant> = vec![Vec::new()];
        variants.extend(self.standard.iter().map(|m| m.joints.variant()));
        variants.push(extended.to_vec());
        let held = Angles::of(context, &context.holdout.data);
        let slides = names.iter().enumerate().filter(|(a, _)| {
            held.measured(*a) && Kind::Position.unit_at(context.replayer.model(), *a) == "m"
        });
        let slides: Vec<String> = slides.map(|(_, name)| (*name).to_owned()).collect();
        let fitted = Angles::of(context, &context.fit.data);
        let held_out = held.residuals(&variants)?;
        let on_fitted = fitted.residuals(&variants)?;
        let labels = ["as given"]
            .into_iter()
            .chain(self.standard.iter().map(|m| m.name.as_str()))
            .chain(["extended"]);
        Ok(labels
            .zip(held_out.iter().zip(&on_fitted))
            .map(|(name, (held_out, on_fitted))| PositionError {
                model: name.to_owned(),
                mean_rad: held.mean(|a| mean_abs(&held_out[a])),
                fitted_mean_rad: fitted.mean(|a| mean_abs(&on_fitted[a])),
                joints_rad: (0..names.len())
                    .filter(|&a| held.measured(a))
                    .map(|a| (names[a].to_owned(), mean_abs(&held_out[a])))
                    .collect::<BTreeMap<_, _>>(),
                slides: slides.clone(),
            })
            .collect())
    }
}

/// `joints` in cross-validation.
pub fn judged(angles: &Angles<'_>, name: &str, joints: Joints, linear: &Linear) -> Model {
    let crossed = angles.cross(&joints, linear);
    let cross_rad = angles.mean(|a| crossed[a].error);
    let deviations = crossed.into_iter().map(|c| c.deviations).collect();
    Model { name: name.to_owned(), joints, cross_rad, deviations }
}

/// Whether joint `a` has an angle and `error`, rad, is an error that counts.
fn is_off(context: &Context, angles: &Angles<'_>, a: usize, error: f64) -> bool {
    let lsb_rad = context.replayer.model().servo(a).encoder_lsb_rad();
    angles.measured(a) && error >= COUNTS * lsb_rad
}

/// Whether a joint's error falls by enough in cross-validation for one more effect.
fn earns(was: &Cross, is: &Cross) -> bool {
    is.error < EARNS * was.error && falls(&was.shares, &is.shares)
}

/// For each joint that is `open` the effects that its angle asks for, each with the size that promises most,
/// best first. Only those in `pool`, if there is one. `[A]`
fn ranked(
    context: &Context,
    angles: &Angles<'_>,
    (model, linear): (&Joints, &Linear),
    open: &[bool],
    pool: Option<&[BTreeSet<&str>]>,
) -> Result<Vec<Vec<Term>>, GapError> {
    let robot = context.replayer.model();
    let joints = open.len();
    let has = |terms: &[Term], effect: &Effect, a: usize| {
        terms.iter().any(|t| t.effect == effect && meet(&t.place, &Place::of_joint(robot, a)))
    };
    let may = |effect: &Effect, a: usize| {
        open[a]
            && !has(&model.fixed, effect, a)
            && !model.own[a].iter().any(|t| t.effect == effect)
            && effect.may_be(robot, &Place::of_joint(robot, a))
            && (effect.unseen)(&context.excitation, &Place::of_joint(robot, a)).is_none()
            && pool.is_none_or(|p| p[a].contains(effect.id))
    };
    let of_joints = || {
        let all = context.effects.iter().copied();
        all.filter(|e| e.domain == Domain::Joints && !e.drifts)
    };
    // each joint tries its own effects: joints hardly move each other
    let plan = |a: usize| -> Vec<(&'static Effect, usize)> {
        let own = of_joints().filter(|e| may(e, a));
        own.flat_map(|e| (0..e.grid.len()).map(move |k| (e, k))).collect()
    };
    let plans: Vec<_> = (0..joints).map(plan).collect();
    let most = plans.iter().map(Vec::len).max().unwrap_or(0);
    let at = |effect: &'static Effect, k: usize, a: usize| {
        let place = Place::of_joint(robot, a);
        let values = effect.sizes(robot, &place, k);
        Term { effect, place, values }
    };
    let tried = |n: usize| -> Variant {
        let mut with = model.clone();
        for (a, plan) in plans.iter().enumerate() {
            with.own[a].extend(plan.get(n).map(|&(effect, k)| at(effect, k, a)));
        }
        with.variant()
    };
    let variants: Vec<Variant> = (0..most).map(tried).collect();
    let changes = angles.changes(model, &variants)?;
    Ok((0..joints)
        .map(|a| {
            let rest = Rest::new(&linear.residual[a], &linear.columns[a], angles.per_radian(a));
            let mut best: BTreeMap<&str, (f64, Term)> = BTreeMap::new();
            for (&(effect, k), change) in plans[a].iter().zip(&changes) {
                let mut term = at(effect, k, a);
                let (gain, share) = rest.promises(&change[a], effect.hinge);
                scale_up(robot, &mut term, share);
                if gain > 0.0 && best.get(effect.id).is_none_or(|b| gain > b.0) {
                    best.insert(effect.id, (gain, term));
                }
            }
            let mut all: Vec<(f64, Term)> = best.into_values().collect();
            all.sort_by(|x, y| y.0.total_cmp(&x.0));
            all.into_iter().map(|(_, t)| t).collect()
        })
        .collect())
}

/// Makes a term that is not a threshold `share` times as large.
pub fn scale_up(model: &RobotModel, term: &mut Term, share: f64) {
    if term.effect.hinge {
        return;
    }
    let neutral = term.neutral(model);
    for p in scaling(term.effect) {
        let (low, high) = term.bounds(model, p);
        term.values[p] = (neutral[p] + share * (term.values[p] - neutral[p])).clamp(low, high);
    }
}

/// Parameters of an effect that grow with it: those that say how large it is, and others that are nothing
/// without it. How many ripples there are in a turn does not.
pub fn scaling(effect: &Effect) -> impl Iterator<Item = usize> + '_ {
    let own: Vec<usize> = sizes(effect).collect();
    (0..effect.parameters.len())
        .filter(move |p| own.contains(p) || effect.parameters[*p].neutral == 0.0)
}

/// What a model leaves at a joint, less what its parameters could still do.
struct Rest {
    weight: Vec<f32>,
    basis: Vec<Vec<f32>>,
    left: Vec<f32>,
}

impl Rest {
    fn new(residual: &[f32], columns: &[Vec<f32>], per_radian: f64) -> Self {
        let weight = weights(residual, scale(residual, per_radian));
        let weighted = |x: &[f32]| x.iter().zip(&weight).map(|(x, w)| x * w).collect::<Vec<f32>>();
        let mut basis = Vec::new();
        columns.iter().for_each(|c| widen(&mut basis, weighted(c), 0.0));
        let mut left = weighted(residual);
        project(&basis, &mut left);
        Self { weight, basis, left }
    }

    /// What a trace promises to take off the sum of squares, and at which share of its size.
    fn promises(&self, trace: &[f32], hinge: bool) -> (f64, f64) {
        let weighted = trace.iter().zip(&self.weight).map(|(c, w)| c * w);
        let mut own: Vec<f32> = weighted.collect();
        let before = dot(&own, &own);
        project(&self.basis, &mut own);
        let square = dot(&own, &own);
        // what other parameters can do nearly as well promises nothing
        if square < 1e-3 * before || square <= 0.0 {
            return (0.0, 1.0);
        }
        let along = dot(&own, &self.left);
        let (low, high) = if hinge { (0.4, 1.6) } else { (-3.0, 3.0) };
        let share = (along / square).clamp(low, high);
        (2.0 * share * along - share * share * square, share)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use super::*;

    #[test]
    fn what_parameters_can_do_already_promises_nothing() {
        let residual = [1.0_f32, 1.0, 1.0, -1.0];
        let rest = Rest::new(&residual, &[vec![1.0, 1.0, 0.0, 0.0]], 1.0);
        // the first two samples are explained: (0, 0, 1, −1) is left
        assert_eq!(rest.promises(&[2.0, 2.0, 0.0, 0.0], false).0, 0.0);
        // a trace in the other direction is as good, with the other sign
        let (gain, share) = rest.promises(&[0.0, 0.0, -1.0, 1.0], false);
        let w = f64::from(rest.weight[2]);
        assert!((share + 1.0).abs() < 1e-6, "{share}");
        assert!((gain - 2.0 * w * w).abs() < 1e-6, "{gain}");
        // … unless it is a threshold, which has no other sign
        assert!(rest.promises(&[0.0, 0.0, -1.0, 1.0], true).0 < 0.0);
    }

    #[test]
    fn what_an_effect_counts_does_not_grow_with_it() {
        let of = |id: &str| scaling(effects::find(id).unwrap()).collect::<Vec<_>>();
        // two amplitudes, and how many ripples there are in a turn
        assert_eq!(of("cogging"), [0, 1]);
        // lateness, heading, height
        assert_eq!(of("mocap_frame"), [0, 1, 2]);
        assert_eq!(of("friction_drift"), [0, 1]);
        assert_eq!(of("kp_error"), [0]);
    }
}
