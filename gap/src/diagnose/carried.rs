//! Which model goes into the extended file. The names of causes are one thing, the model another: it holds
//! whatever the runs that were fitted support, named or not.

use super::extend::{entry, parameters};
use super::fits::{fitted, penalised, single};
use super::folds::jackknife;
use super::gates::{self, Worth};
use super::joints::{Angles, Joints, mean_abs};
use super::levels::BUILT;
use super::naming::Named;
use super::search::Found;
use super::state::{Context, State};
use super::tracking::{Tracking, judged};
use crate::effects::Layer;
use crate::error::GapError;
use crate::extension::ExtensionEffect;
use crate::replay::{Term, Variant};
use crate::report::{Carried, Cause};

/// What each joint's error must at least be of that without small terms for these to be left out.
const HARDLY: f64 = 0.995;
/// Why a model is refused at last.
pub const NO_NEARER: &str = "held-out runs are no nearer with it than as given";

/// The model of the extended file.
pub struct Model {
    /// The model.
    pub state: State,
    /// Standard deviations of the parameters of each term, SI; empty where it is the one that causes were named in.
    deviations: Vec<Vec<f64>>,
}

/// Which model to carry: the one that causes were named in, the one before they were, or the one that was built
/// joint by joint; of these two what goes with the names. Where held-out runs are no nearer to it, it is the first.
///
/// # Errors
/// As [`crate::replay::Replayer::predict`].
pub fn choose(
    context: &mut Context,
    found: &mut Found,
    tracking: &Tracking,
) -> Result<Model, GapError> {
    let mut carried = supported_most(context, &found.best, &found.supported, tracking)?;
    keep_what_matters(context, &found.best, &mut carried)?;
    let terms = found.best.terms.clone();
    let Found { base, best, .. } = &mut *found;
    context.judge_held_out(&terms, &mut [base, best, &mut carried.state])?;
    if !nearer(context, base, &carried.state) {
        carried = Model { state: best.clone(), deviations: Vec::new() };
    }
    Ok(carried)
}

/// Leaves out of `model` what has no name in `named` and is so small that it does not matter, smallest first, as
/// long as the angles are hardly further off without: small sizes at many joints can make much together.
///
/// # Errors
/// As [`crate::replay::Replayer::predict`].
fn keep_what_matters(context: &Context, named: &State, model: &mut Model) -> Result<(), GapError> {
    let terms = &model.state.terms;
    let size = |k: usize| gates::size(context, &terms[k]);
    let is_small = |&k: &usize| !is_among(&terms[k], &named.terms) && size(k) < 1.0;
    let mut small: Vec<usize> = (0..terms.len()).filter(is_small).collect();
    small.sort_by(|&a, &b| size(a).total_cmp(&size(b)));
    let without =
        |n: usize| -> Vec<usize> { (0..terms.len()).filter(|k| !small[..n].contains(k)).collect() };
    let of = |kept: Vec<usize>| -> Variant { kept.iter().map(|&k| terms[k].clone()).collect() };
    let fewer: Vec<Variant> = (0..=small.len()).map(|n| of(without(n))).collect();
    let angles = Angles::of(context, &context.fit.data);
    let off = angles.residuals(&fewer)?;
    let errors = |off: &Vec<Vec<f32>>| -> Vec<f64> { off.iter().map(|r| mean_abs(r)).collect() };
    let errors: Vec<Vec<f64>> = off.iter().map(errors).collect();
    let hardly = |n: &usize| errors[*n].iter().zip(&errors[0]).all(|(is, was)| HARDLY * is <= *was);
    let left_out = (0..errors.len()).rev().find(hardly).unwrap_or(0);
    if left_out > 0 {
        let deviations = |k: &usize| model.deviations.get(*k).cloned();
        model.deviations = without(left_out).iter().filter_map(deviations).collect();
        model.state = single(context, fewer[left_out].clone())?;
    }
    Ok(())
}

/// What the runs that were fitted support most.
fn supported_most(
    context: &Context,
    named: &State,
    before: &State,
    tracking: &Tracking,
) -> Result<Model, GapError> {
    let of_search = supported(context, named, before)?;
    let Some(built) = &tracking.built else {
        return Ok(of_search);
    };
    let angles = Angles::of(context, &context.fit.data);
    // what has a name stays, and what angles do not show they have nothing to say of
    let unseen = |t: &Term| t.effect.layer == Layer::Sensing && !t.effect.id.starts_with("encoder");
    let terms = &of_search.state.terms;
    let those = |of: &dyn Fn(&Term) -> bool| -> Variant {
        terms.iter().filter(|&t| of(t)).cloned().collect()
    };
    let kept = those(&|t| unseen(t) || is_among(t, &named.terms));
    let judge = |kept: &Variant| -> Result<_, GapError> {
        let joints = Joints::of(context.replayer.model().actuated().len(), terms, kept.clone());
        let linear = angles.linear(&joints, None)?;
        Ok(judged(&angles, "", joints, &linear))
    };
    let mut search = judge(&kept)?;
    // what drifts is not built in: where it has a name, the others are asked for anew beside it
    let anew = match kept.iter().any(|t| t.effect.drifts) {
        true => tracking.anew(context, kept.clone())?,
        false => None,
    };
    let mut model = match anew {
        Some(model) => model,
        None => built.around(context, &angles, kept)?,
    };
    if model.cross_rad * BUILT >= built.cross_rad {
        // angles contradict the names: the model does without, and the summary says so; those of the search are
        // then fitted without each fold like all others
        let kept = those(&unseen);
        model = built.around(context, &angles, kept.clone())?;
        search = judge(&kept)?;
    }
    if model.cross_rad >= search.cross_rad {
        return Ok(of_search);
    }
    let built = model;
    let whole = built.joints.fixed.iter().chain(&built.joints.shared);
    let mut flat = vec![0.0; whole.map(|t| t.values.len()).sum()];
    flat.extend(built.deviations.iter().flatten());
    let state = single(context, built.joints.variant())?;
    Ok(Model { deviations: by_term(&state.terms, &flat), state })
}

/// So many of `flat` to each of `terms` as it has parameters.
fn by_term(terms: &[Term], flat: &[f64]) -> Vec<Vec<f64>> {
    let mut flat = flat.iter().copied();
    terms.iter().map(|t| flat.by_ref().take(t.values.len()).collect()).collect()
}

/// The model that causes were `named` in, or, if that leaves much more, what was found `before` with it.
fn supported(context: &Context, named: &State, before: &State) -> Result<Model, GapError> {
    let much = |state: &State| penalised(context, state) < BUILT * penalised(context, named);
    let mut state = before.clone();
    if much(&state) && !named.terms.iter().all(|t| is_among(t, &before.terms)) {
        let others = (before.terms.iter()).filter(|t| !is_among(t, &named.terms));
        let together = named.terms.iter().chain(others).cloned().collect();
        state = fitted(context, together, None)?;
    }
    Ok(match much(&state) {
        true => Model { deviations: by_term(&state.terms, &deviations(context, &state)?), state },
        false => Model { state: named.clone(), deviations: Vec::new() },
    })
}

/// Whether `terms` have this effect at this place.
fn is_among(term: &Term, terms: &[Term]) -> bool {
    terms.iter().any(|t| t.same(term))
}

/// The last gate: what is no nearer to held-out runs than the robot as given is not named, and not carried.
///
/// # Errors
/// As [`crate::replay::Replayer::predict`].
pub fn refuse(
    context: &mut Context,
    found: &mut Found,
    named: &mut Vec<Named>,
) -> Result<(), GapError> {
    let terms = found.best.terms.clone();
    let Found { base, best, .. } = &mut *found;
    context.judge_held_out(&terms, &mut [base, best])?;
    if nearer(context, base, best) {
        return Ok(());
    }
    let worth = Worth { passed: false, why: NO_NEARER, ..gates::worth(context, base, best, None) };
    found.refused.insert(0, (found.best.clone(), worth));
    context.judge_held_out(&[], &mut [&mut found.base])?;
    found.best = found.base.clone();
    named.clear();
    Ok(())
}

/// Whether a model may be carried, by held-out runs: also where none of them shows what it has, so that they say
/// nothing against it.
fn nearer(context: &Context, base: &State, state: &State) -> bool {
    state.terms.is_empty()
        || gates::nearer(context, base, state)
        || gates::silent(context, base, state)
}

/// Standard deviations of the parameters of `state` by the jackknife over the parts of the runs, SI.
fn deviations(context: &Context, state: &State) -> Result<Vec<f64>, GapError> {
    let (columns, steps) = context.jacobian(&context.fit, &state.terms)?;
    let free = super::state::frees(&context.replayer, &state.terms, &steps);
    let (_, shifts) = (context.folds).left_out_with(&columns, &state.fit.residual, &free);
    Ok(jackknife(&shifts, &steps))
}

impl Model {
    /// Each term as the extended file has it: as a cause of `causes` says where there is one of that effect
    /// and place with that size, else without a name that anybody vouches for.
    pub fn entries(&self, context: &Context, causes: &[Cause]) -> Vec<ExtensionEffect> {
        let terms = self.state.terms.iter().enumerate();
        terms
            .map(|(k, term)| {
                let same = |c: &&Cause| {
                    let names = term.effect.parameters.iter().zip(&term.values);
                    names
                        .into_iter()
                        .all(|(p, v)| c.parameters.get(p.name).is_some_and(|own| own.value == *v))
                };
                let cause = cause_of(term, causes);
                match cause.filter(same) {
                    Some(cause) => entry(cause),
                    None => unnamed(context, term, self.deviations.get(k), cause),
                }
            })
            .collect()
    }

    /// The same for the report.
    pub fn listed(&self, entries: &[ExtensionEffect]) -> Vec<Carried> {
        let of = |e: &ExtensionEffect| Carried {
            effect: e.id.clone(),
            location: e.location.clone(),
            named: e.confidence > 0.0,
            parameters: (e.parameters.iter()).map(|(name, p)| (name.clone(), p.value)).collect(),
        };
        entries.iter().map(of).collect()
    }
}

fn cause_of<'a>(term: &Term, causes: &'a [Cause]) -> Option<&'a Cause> {
    let same = |c: &&Cause| c.effect == term.effect.id && c.location == term.place.names;
    causes.iter().find(same)
}

/// A term that is in the model because the runs support it.
fn unnamed(
    context: &Context,
    term: &Term,
    deviations: Option<&Vec<f64>>,
    cause: Option<&Cause>,
) -> ExtensionEffect {
    let model = context.replayer.model();
    let half = |p: usize| deviations.and_then(|own| own.get(p)).map_or(0.0, |d| 1.96 * d);
    entry(&Cause {
        effect: term.effect.id.to_owned(),
        location: term.place.names.clone(),
        parameters: parameters(model, term, half),
        confidence: cause.map_or(0.0, |c| c.confidence),
        alternatives: cause.map_or_else(Vec::new, |c| c.alternatives.clone()),
        evidence: match cause {
            Some(_) => vec!["a cause of the report, of the size that it has beside all effects of this file".to_owned()],
            None => vec![
                "in the model because the runs that were fitted support it in cross-validation; its name is no finding"
                    .to_owned(),
            ],
        },
        ..Cause::default()
    })
}
