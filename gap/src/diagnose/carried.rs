//! Which model goes into the extended file. The names of causes are one thing, the model another: it holds
//! whatever the runs that were fitted support, named or not.

use super::fits::penalised;
use super::gates::{self, Worth};
use super::joints::{Angles, mean_abs};
use super::levels::NOTHING_LEFT;
use super::naming::Named;
use super::search::Found;
use super::state::{Context, State};
use super::tracking::Tracking;
use crate::effects::Layer;
use crate::error::GapError;
use crate::extension::{ExtensionEffect, ExtensionParameter};
use crate::replay::Term;
use crate::report::{Carried, Cause};

/// What the model before names were sought must leave of the misfit that is left without what got no name.
const SUPPORTED: f64 = 0.95;
/// What a model that was built joint by joint must leave of the error of angles that the others leave.
pub const BUILT: f64 = 0.95;

/// Why a model is refused at last.
pub const NO_NEARER: &str = "held-out runs are no nearer with it than as given";

/// The model of the extended file.
pub struct Model {
    /// The model.
    pub state: State,
    /// Standard deviations of all its parameters, SI; empty where it is the one that causes were named in.
    deviations: Vec<f64>,
}

/// Which model to carry: the one that causes were named in, the one `before` they were, or the one that was
/// built joint by joint.
///
/// # Errors
/// As [`crate::replay::Replayer::predict`].
pub fn choose(
    context: &Context,
    named: &State,
    before: &State,
    tracking: &Tracking,
) -> Result<Model, GapError> {
    let supported = penalised(context, before) < SUPPORTED * penalised(context, named);
    let of_search = if supported { before } else { named };
    if let Some(built) = &tracking.built {
        let angles = Angles::of(context, &context.fit.data);
        let off = angles
            .residuals(std::slice::from_ref(&of_search.terms))?
            .swap_remove(0);
        let own: Vec<f64> = (0..off.len())
            .filter(|&a| angles.measured(a))
            .map(|a| mean_abs(&off[a]))
            .collect();
        let mean_rad = own.iter().sum::<f64>() / own.len().max(1) as f64;
        // a few causes that explain the runs are carried as they are, unless a standard model does better
        let better = |m: &super::tracking::Model| m.cross_rad < mean_rad;
        let wanted = gates::worst(context, of_search) >= NOTHING_LEFT
            || tracking.standard.iter().any(better);
        if wanted && built.cross_rad < BUILT * mean_rad {
            let mut variant = built.joints.variant();
            // what angles do not show they have nothing to say of
            let unseen =
                |t: &&Term| t.effect.layer == Layer::Sensing && !t.effect.id.starts_with("encoder");
            variant.extend(of_search.terms.iter().filter(unseen).cloned());
            let shared: usize = built.joints.shared.iter().map(|t| t.values.len()).sum();
            let mut deviations = vec![0.0; shared];
            deviations.extend(built.deviations.iter().flatten());
            return Ok(Model {
                state: context.states(&[variant])?.swap_remove(0),
                deviations,
            });
        }
    }
    Ok(Model {
        deviations: match supported {
            true => deviations(context, before)?,
            false => Vec::new(),
        },
        state: of_search.clone(),
    })
}

/// The last gate: what is no nearer to held-out runs than the robot as given is not carried, and its causes are
/// none.
pub fn refuse(context: &Context, found: &mut Found, named: &mut Vec<Named>, carried: &mut Model) {
    let base = &found.base;
    let nearer = |s: &State| s.terms.is_empty() || gates::nearer(context, base, s);
    let best_is = nearer(&found.best);
    if !nearer(&carried.state) {
        let state = if best_is { &found.best } else { base };
        *carried = Model {
            state: state.clone(),
            deviations: Vec::new(),
        };
    }
    if !best_is {
        let worth = Worth {
            passed: false,
            why: NO_NEARER,
            ..gates::worth(context, base, &found.best, None)
        };
        let refused = std::mem::replace(&mut found.best, base.clone());
        found.refused.insert(0, (refused, worth));
        named.clear();
    }
}

/// Standard deviations of the parameters of `state` by the jackknife over the parts of the runs, SI.
fn deviations(context: &Context, state: &State) -> Result<Vec<f64>, GapError> {
    let (columns, steps) = context.jacobian(&context.fit, &state.terms)?;
    let free = super::state::frees(&context.replayer, &state.terms, &steps);
    let (_, shifts) = (context.folds).left_out_with(&columns, &state.fit.residual, &free);
    let folds = shifts.len().max(1) as f64;
    let deviation = |(p, step): (usize, &f64)| {
        let mean = shifts.iter().map(|s| s[p]).sum::<f64>() / folds;
        let square: f64 = shifts.iter().map(|s| (s[p] - mean).powi(2)).sum();
        step * (square * (folds - 1.0) / folds).sqrt()
    };
    Ok(steps.iter().enumerate().map(deviation).collect())
}

impl Model {
    /// Each term as the extended file has it: as a cause of `causes` says where there is one of that effect
    /// and place with that size, else without a name that anybody vouches for.
    #[must_use]
    pub fn entries(&self, context: &Context, causes: &[Cause]) -> Vec<ExtensionEffect> {
        let mut first = 0;
        self.state
            .terms
            .iter()
            .map(|term| {
                let own = first..first + term.values.len();
                first = own.end;
                match cause_of(term, causes) {
                    Some(cause) if self.deviations.is_empty() => super::extend::entry(cause),
                    cause => unnamed(context, term, self.deviations.get(own), cause),
                }
            })
            .collect()
    }

    /// The same for the report.
    #[must_use]
    pub fn listed(&self, entries: &[ExtensionEffect]) -> Vec<Carried> {
        let of = |e: &ExtensionEffect| Carried {
            effect: e.id.clone(),
            location: e.location.clone(),
            named: e.confidence > 0.0,
            parameters: (e.parameters.iter())
                .map(|(name, p)| (name.clone(), p.value))
                .collect(),
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
    deviations: Option<&[f64]>,
    cause: Option<&Cause>,
) -> ExtensionEffect {
    let model = context.replayer.model();
    let parameter = |p: usize| {
        let spec = &term.effect.parameters[p];
        let (low, high) = term.effect.bounds(model, &term.place, p);
        let half = 1.96 * deviations.and_then(|d| d.get(p)).copied().unwrap_or(0.0);
        let value = term.values[p];
        let parameter = ExtensionParameter {
            value,
            unit: spec.unit.to_owned(),
            ci_low: (value - half).max(low),
            ci_high: (value + half).min(high),
            at_bound: term.effect.at_bound(model, &term.place, p, value),
        };
        (spec.name.to_owned(), parameter)
    };
    let parameters: std::collections::BTreeMap<_, _> =
        (0..term.values.len()).map(parameter).collect();
    let range = |p: &ExtensionParameter| {
        // as of a cause: half as much again for what was not recorded
        let half = 0.75 * (p.ci_high - p.ci_low);
        [p.value - half, p.value + half]
    };
    ExtensionEffect {
        id: term.effect.id.to_owned(),
        location: term.place.names.clone(),
        confidence: cause.map_or(0.0, |c| c.confidence),
        alternatives: cause.map_or_else(Vec::new, |c| c.alternatives.clone()),
        elsewhere: Vec::new(),
        evidence: vec![
            "in the model because the runs that were fitted support it in cross-validation; its name is no finding"
                .to_owned(),
        ],
        randomise: (parameters.iter())
            .map(|(name, p)| (name.clone(), range(p)))
            .collect(),
        parameters,
    }
}
