//! Naming: which effects would explain as much in a cause's place. A cause is a set of names with probabilities, not a name.

use super::doubt::much_is_left;
use super::gates::{self, Worth};
use super::refine::refine;
use super::screen::{Screened, screen};
use super::search::{Found, penalised, single, swapped};
use super::state::{Context, State};
use crate::effects::Domain;
use crate::error::GapError;
use crate::replay::Variant;

/// Rivals that are fitted per cause, besides the declared look-alikes.
const RIVALS: usize = 8;
/// A rival within this share of the cause's own gain belongs to the answer set …
const MARGIN: f64 = 0.06;
/// … if its misfit is not higher by more than this share of the best's, …
const MARGIN_OF_REST: f64 = 0.25;
/// … and this many floors.
const MARGIN_FLOORS: f64 = 0.06;
/// A cause with less than this probability of its name is none …
const UNNAMED: f64 = 0.2;
/// … unless its layer (friction, motor, timing …) has this one.
const LAYER_KNOWN: f64 = 0.6;
/// Where much is left unexplained, a cause must take this share off the misfit of its joint.
const LEAST_SHARE_IN_PART: f64 = 0.08;
/// Temperature of the probabilities, as a share of the margin.
const TEMPERATURE: f64 = 0.6;

/// A rival of a cause.
pub struct Rival {
    /// The model with the rival in the cause's place.
    pub state: State,
    /// Which term it is there.
    pub index: usize,
    /// What it fails to explain, as a share of the cause's gain; 0: as good, negative: better.
    pub short: f64,
    /// Probability among the rivals and the cause.
    pub probability: f64,
    /// Whether it belongs to the answer set.
    pub in_set: bool,
}

/// A cause with its rivals.
pub struct Named {
    /// Term of the best model.
    pub index: usize,
    /// The model without it, refitted.
    pub without: State,
    /// What it is worth on top of that.
    pub worth: Worth,
    /// Rivals, best first.
    pub rivals: Vec<Rival>,
    /// Probability of its own name.
    pub probability: f64,
}

/// Finds the rivals of every cause.
///
/// # Errors
/// As [`crate::replay::Replayer::predict`].
pub fn name(context: &Context, found: &mut Found) -> Result<Vec<Named>, GapError> {
    let mut out = Vec::new();
    let size = |s: &State| s.parameters(context.replayer.model());
    for index in 0..found.best.terms.len() {
        let mut named = rivals_of(context, found, index)?;
        let simpler = named
            .rivals
            .iter()
            .filter(|r| r.in_set && size(&r.state) < size(&found.best))
            // what is clearly worse does not say the same
            .filter(|r| {
                let more = gates::worth(context, &r.state, &found.best, None);
                more.low <= 0.0 || more.fit <= 0.0
            })
            .min_by(|a, b| {
                let by_size = size(&a.state).cmp(&size(&b.state));
                by_size.then(a.short.total_cmp(&b.short))
            });
        if let Some(simpler) = simpler {
            // who says the same with less is the first to be believed
            found.best = simpler.state.clone();
            named = rivals_of(context, found, index)?;
        }
        // a cause of which nobody can tell the name, nor even the layer, is a leftover, not a cause
        let own = named.probability + same_name(found, &named);
        if own < UNNAMED && same_layer(found, &named) < LAYER_KNOWN {
            found.best = named.without;
            return name(context, found);
        }
        // and what takes little off where much is left stands in for what is not in the catalogue
        let share = named.worth.holdout / named.worth.of.max(1e-9);
        let too_little =
            much_is_left(context, &found.base, &found.best) && share < LEAST_SHARE_IN_PART;
        if too_little || named.worth.holdout <= 0.0 {
            found.best = named.without;
            return name(context, found);
        }
        out.push(named);
    }
    Ok(out)
}

/// Probability of the same effect at other places.
fn same_name(found: &Found, named: &Named) -> f64 {
    let effect = found.best.terms[named.index].effect;
    named
        .rivals
        .iter()
        .filter(|r| r.state.terms[r.index].effect == effect)
        .map(|r| r.probability)
        .sum()
}

/// Probability of all effects of the same layer.
fn same_layer(found: &Found, named: &Named) -> f64 {
    let layer = found.best.terms[named.index].effect.layer;
    let rivals = named.rivals.iter();
    let of_layer = rivals.filter(|r| r.state.terms[r.index].effect.layer == layer);
    named.probability + of_layer.map(|r| r.probability).sum::<f64>()
}

/// Everything that could stand in the place of term `index` of the best model, fitted.
fn rivals_of(context: &Context, found: &Found, index: usize) -> Result<Named, GapError> {
    let best = &found.best;
    let mut terms: Variant = best.terms.clone();
    let term = terms.remove(index);
    let terms = refine(context, &context.fit, vec![terms], None, None)?
        .swap_remove(0)
        .0;
    let mut without = single(context, terms)?;
    context.find_basis(&mut without)?;
    let screened = if without.terms.is_empty() && !found.first.is_empty() {
        found.first.clone()
    } else {
        screen(context, &without)?
    };
    let chosen = rivals(&term, &screened);
    let states = swapped(context, best, index, &chosen, &without)?;
    let gain = penalised(context, &without) - penalised(context, best);
    let mut rivals: Vec<Rival> = states
        .into_iter()
        .map(|state| Rival {
            short: (penalised(context, &state) - penalised(context, best)) / gain.max(1e-9),
            state,
            index,
            probability: 0.0,
            in_set: false,
        })
        .collect();
    rivals.sort_by(|a, b| a.short.total_cmp(&b.short));
    // what is left at the joints that it concerns, as a part of the whole
    let joints = context.replayer.model().actuated().len().max(1);
    let concerned = match term.place.domain {
        Domain::Joints => term.place.items.len().clamp(1, joints) as f64 / joints as f64,
        _ => 1.0,
    };
    let rest = (MARGIN_OF_REST * penalised(context, best) + MARGIN_FLOORS) * concerned;
    let margin = MARGIN.min(rest / gain.max(1e-9));
    // places of one effect are one name
    let weight = |short: f64| (-short.max(-margin) / (TEMPERATURE * margin)).exp();
    let total = weight(0.0) + rivals.iter().map(|r| weight(r.short)).sum::<f64>();
    for r in &mut rivals {
        r.probability = weight(r.short) / total;
        r.in_set = r.short < margin;
    }
    Ok(Named {
        index,
        worth: gates::worth(context, &without, best, Some(&best.terms[index].place)),
        without,
        probability: weight(0.0) / total,
        rivals,
    })
}

/// Declared look-alikes at their best place, and whatever screening likes.
fn rivals<'a>(term: &crate::replay::Term, screened: &'a [Screened]) -> Vec<&'a Screened> {
    let mut chosen: Vec<&Screened> = Vec::new();
    let own = |s: &Screened| s.effect == term.effect;
    for id in term.effect.look_alikes {
        let near = screened.iter().filter(|s| s.effect.id == *id);
        // at the same place if it can be there, else wherever it does best
        let mut near: Vec<&Screened> = near.collect();
        near.sort_by_key(|s| s.place != term.place);
        chosen.extend(near.first());
    }
    let mut more = 0;
    for s in screened.iter().filter(|s| s.gain > 0.0 && !own(s)) {
        if chosen
            .iter()
            .any(|c| c.effect == s.effect && c.place == s.place)
        {
            continue;
        }
        chosen.push(s);
        more += 1;
        if more == RIVALS {
            break;
        }
    }
    // the same effect at other places: where it is belongs to the name
    for s in screened
        .iter()
        .filter(|s| own(s) && s.place != term.place && s.gain > 0.0)
        .take(3)
    {
        chosen.push(s);
    }
    chosen
}
