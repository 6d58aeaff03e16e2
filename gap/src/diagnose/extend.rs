//! What goes into the extended robot file.

use std::collections::BTreeMap;

use super::request::Request;
use super::state::Context;
use crate::extension::{self, Extension, ExtensionEffect, ExtensionParameter};
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
            .chain(effects.iter().cloned())
            .collect(),
        observation_noise: noise
            .into_iter()
            .map(|(k, (sum, n))| (k, (sum / n as f64).sqrt()))
            .collect(),
        lane: extension::lane(model, &context.replayer.with_given(terms)),
    }
}

/// A cause as a robot file has it.
pub fn entry(cause: &Cause) -> ExtensionEffect {
    let randomise = cause
        .parameters
        .iter()
        .map(|(name, p)| {
            // what the fit leaves open, and half as much again for what was not recorded
            let half = 0.75 * (p.ci_high - p.ci_low);
            (name.clone(), [p.value - half, p.value + half])
        })
        .collect();
    ExtensionEffect {
        id: cause.effect.clone(),
        location: cause.location.clone(),
        confidence: cause.confidence,
        alternatives: cause.alternatives.clone(),
        elsewhere: cause.elsewhere.clone(),
        evidence: cause.evidence.clone(),
        parameters: (cause.parameters.iter()).map(|(name, p)| (name.clone(), written(p))).collect(),
        randomise,
    }
}

fn written(p: &Parameter) -> ExtensionParameter {
    ExtensionParameter {
        value: p.value,
        unit: p.unit.clone(),
        ci_low: p.ci_low,
        ci_high: p.ci_high,
        at_bound: p.at_bound,
    }
}
