//! What goes into the extended robot file.

use std::collections::BTreeMap;

use caudata_model::RobotModel;

use super::request::Request;
use super::state::Context;
use super::stops::Passed;
use crate::effects::ParameterSpec;
use crate::extension::{self, Extension, ExtensionEffect};
use crate::replay::Term;
use crate::report::{Cause, Parameter};

/// The extension that `terms` come to, with `effects` for what they say of themselves, and frames that are
/// lost.
pub fn extended(
    request: &Request,
    context: &Context,
    terms: &[Term],
    effects: &[ExtensionEffect],
    losses: Option<&Cause>,
) -> Extension {
    let model = context.replayer.model();
    let mut noise: BTreeMap<String, (f64, usize)> = BTreeMap::new();
    for ((_, kind, _), sd) in &context.fit.noise.repeat {
        let entry = noise.entry(kind.name().to_owned()).or_default();
        entry.0 += sd * sd;
        entry.1 += 1;
    }
    Extension {
        base: model.hash_hex(),
        logs: request.runs.iter().map(|r| r.sha256.clone()).collect(),
        effect: (model.extension().into_iter().flat_map(|e| e.effect.iter().cloned()))
            .chain(losses.map(entry))
            .chain(context.passed.iter().map(|p| no_stop(context, p)))
            .chain(effects.iter().cloned())
            .collect(),
        observation_noise: noise
            .into_iter()
            .map(|(k, (sum, n))| (k, (sum / n as f64).sqrt()))
            .collect(),
        lane: extension::lane(model, &context.replayer.with_given(terms)),
    }
}

/// Stops that are passed as a robot file has them.
fn no_stop(context: &Context, passed: &Passed) -> ExtensionEffect {
    let Passed { term, note } = passed;
    ExtensionEffect {
        id: term.effect.id.to_owned(),
        location: term.place.names.clone(),
        confidence: context.calibration.surest,
        alternatives: Vec::new(),
        elsewhere: Vec::new(),
        evidence: vec![note.detail.clone()],
        randomise: BTreeMap::new(),
        parameters: parameters(context.replayer.model(), term, |_| 0.0),
    }
}

/// A cause as a robot file has it.
pub fn entry(cause: &Cause) -> ExtensionEffect {
    let range = |(name, p): (&String, &Parameter)| {
        // what the fit leaves open, and half as much again for what was not recorded; what cannot be below zero stays
        let low = p.value - 1.5 * (p.value - p.ci_low);
        let high = p.value + 1.5 * (p.ci_high - p.value);
        (name.clone(), [if p.ci_low >= 0.0 { low.max(0.0) } else { low }, high])
    };
    ExtensionEffect {
        id: cause.effect.clone(),
        location: cause.location.clone(),
        confidence: cause.confidence,
        alternatives: cause.alternatives.clone(),
        elsewhere: cause.elsewhere.clone(),
        evidence: cause.evidence.clone(),
        randomise: cause.parameters.iter().map(range).collect(),
        parameters: cause.parameters.clone(),
    }
}

/// The parameters of a term, each with an interval of so much either way within its bounds.
pub fn parameters(
    model: &RobotModel,
    term: &Term,
    half: impl Fn(usize) -> f64,
) -> BTreeMap<String, Parameter> {
    let of = |(p, spec): (usize, &ParameterSpec)| {
        let (value, half) = (term.values[p], half(p));
        let (low, high) = term.bounds(model, p);
        let parameter = Parameter {
            value,
            unit: term.effect.unit(model, &term.place, p).to_owned(),
            ci_low: (value - half).max(low),
            ci_high: (value + half).min(high),
            at_bound: term.at_bound(model, p),
        };
        (spec.name.to_owned(), parameter)
    };
    term.effect.parameters.iter().enumerate().map(of).collect()
}
