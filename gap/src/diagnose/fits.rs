//! Fitting candidates, from several starts, on a scout first where there is one.

use super::gates;
use super::refine::{Race, refine};
use super::screen::Screened;
use super::state::{Context, State, builds_up};
use crate::error::GapError;
use crate::replay::{Term, Variant};

/// Candidates that were fitted to a scout and are fitted to everything as well.
const POLISHED: usize = 4;
/// Steps of that.
const POLISHING: usize = 2;
/// Steps of the last fit.
pub const LAST_STEPS: usize = 12;
/// What an additional parameter must earn: share of the misfit.
const PER_PARAMETER: f64 = 0.015;

/// A candidate with its predictions.
///
/// # Errors
/// As [`crate::replay::Replayer::predict`].
pub fn single(context: &Context, terms: Variant) -> Result<State, GapError> {
    let mut states = context.states(&[terms])?;
    Ok(states.swap_remove(0))
}

/// `terms` fitted to everything, in at most so many steps.
///
/// # Errors
/// As [`crate::replay::Replayer::predict`].
pub fn fitted(context: &Context, terms: Variant, steps: Option<usize>) -> Result<State, GapError> {
    let mut fitted = refine(context, &context.fit, vec![terms], steps, None)?;
    single(context, fitted.swap_remove(0).0)
}

/// Misfit with what its parameters must have earned. A parameter of one joint can only earn where that joint
/// is measured, so that it owes the less the more joints there are.
pub fn penalised(context: &Context, state: &State) -> f64 {
    let model = context.replayer.model();
    let joints = model.actuated().len().max(1);
    gates::misfit(context, state)
        * (1.0 + PER_PARAMETER * state.parameters(model) as f64 / joints as f64)
}

/// Misfit that fits begin with.
#[derive(Clone, Copy)]
pub struct Before {
    /// Where candidates are looked at first.
    pub look: f64,
    /// On all runs to fit to.
    pub fit: f64,
}

impl Before {
    /// As `state` has it.
    pub fn of(state: &State) -> Self {
        Self { look: state.on_scout().misfit, fit: state.fit.misfit }
    }
}

/// Fits and keeps the best of each group.
///
/// # Errors
/// As [`crate::replay::Replayer::predict`].
pub fn best_fits(
    context: &Context,
    variants: Vec<Variant>,
    of: &[usize],
    groups: usize,
    before: Before,
) -> Result<Vec<State>, GapError> {
    let mut best: Vec<Option<(Variant, f64)>> = vec![None; groups];
    for (whole, judge, from) in
        [(false, context.first_look(), before.look), (true, &context.fit, before.fit)]
    {
        let slow = |v: &Variant| context.scout.is_some() && v.iter().any(|t| builds_up(t.effect));
        let own: Vec<usize> =
            (0..variants.len()).filter(|&i| slow(&variants[i]) == whole).collect();
        if own.is_empty() {
            continue;
        }
        let of: Vec<usize> = own.iter().map(|&i| of[i]).collect();
        let own = own.iter().map(|&i| variants[i].clone()).collect();
        let fitted = refine(context, judge, own, None, Some(&Race { of: &of, from }))?;
        for ((terms, cost), &g) in fitted.into_iter().zip(&of) {
            if best[g].as_ref().is_none_or(|b| cost < b.1) {
                best[g] = Some((terms, cost));
            }
        }
    }
    let variants: Vec<Variant> = best.into_iter().flatten().map(|b| b.0).collect();
    let mut states = context.states(&variants)?;
    if context.scout.is_some() {
        polish(context, &mut states)?;
    }
    Ok(states)
}

/// Fits the best of those that were fitted to a scout to everything.
fn polish(context: &Context, states: &mut [State]) -> Result<(), GapError> {
    let mut order: Vec<usize> = (0..states.len()).collect();
    order.sort_by(|&a, &b| {
        let of = |i: usize| penalised(context, &states[i]);
        of(a).total_cmp(&of(b))
    });
    order.truncate(POLISHED);
    let variants: Vec<Variant> = order.iter().map(|&i| states[i].terms.clone()).collect();
    let fitted = refine(context, &context.fit, variants, Some(POLISHING), None)?;
    let variants: Vec<Variant> = fitted.into_iter().map(|f| f.0).collect();
    for (i, state) in order.into_iter().zip(context.states(&variants)?) {
        if state.fit.misfit < states[i].fit.misfit {
            states[i] = state;
        }
    }
    Ok(())
}

/// `state` fitted to everything by the present metric.
///
/// # Errors
/// As [`crate::replay::Replayer::predict`].
pub fn polished(context: &Context, state: State) -> Result<State, GapError> {
    let fitted = fitted(context, state.terms.clone(), Some(LAST_STEPS))?;
    Ok(if fitted.fit.misfit <= state.fit.misfit { fitted } else { state })
}

/// The model that `with` makes of each of the `chosen` at each of its starts, fitted; the best fit of each.
///
/// # Errors
/// As [`crate::replay::Replayer::predict`].
pub fn with_each(
    context: &Context,
    chosen: &[&Screened],
    before: Before,
    with: impl Fn(Term) -> Variant,
) -> Result<Vec<State>, GapError> {
    let (mut variants, mut of) = (Vec::new(), Vec::new());
    for (number, s) in chosen.iter().enumerate() {
        for start in &s.starts {
            let (place, values) = (s.place.clone(), start.clone());
            variants.push(with(Term { effect: s.effect, place, values }));
            of.push(number);
        }
    }
    best_fits(context, variants, &of, chosen.len(), before)
}
