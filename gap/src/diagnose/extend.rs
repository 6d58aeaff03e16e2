//! What goes into the extended robot file.

use std::collections::BTreeMap;

use super::carried::{Model, entry};
use super::request::Request;
use super::state::Context;
use crate::extension::{self, Extension, ExtensionEffect};
use crate::report::Cause;

/// The extension that `carried` comes to, with `effects` for its terms, and frames that are lost.
pub fn extended(
    request: &Request,
    context: &Context,
    carried: &Model,
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
        effect: (model
            .extension()
            .into_iter()
            .flat_map(|e| e.effect.iter().cloned()))
        .chain(losses.map(entry))
        .chain(effects.iter().cloned())
        .collect(),
        observation_noise: noise
            .into_iter()
            .map(|(k, (sum, n))| (k, (sum / n as f64).sqrt()))
            .collect(),
        lane: extension::lane(model, &context.replayer.with_given(&carried.state.terms)),
    }
}
