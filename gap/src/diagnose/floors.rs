//! Detection floors: the smallest size of each effect that these runs would have shown.

use std::collections::BTreeMap;

use super::gates::{ABSOLUTE_GAIN, RELATIVE_GAIN};
use super::screen::Screened;
use super::state::Context;
use crate::effects::{self, places};
use crate::report::Floor;

/// By `effect` or `effect@place`.
#[must_use]
pub fn floors(context: &Context, screened: &[Screened], misfit: f64) -> BTreeMap<String, Floor> {
    let model = context.replayer.model();
    let mut out = BTreeMap::new();
    let needed = ABSOLUTE_GAIN.max(RELATIVE_GAIN * misfit);
    for s in screened {
        let neutral = s.effect.neutral(model, &s.place);
        // the first size that is seen, shrunk in proportion: traces grow at least about linearly
        let seen = s.traces.iter().find(|(_, energy)| *energy >= needed);
        let (sizes, energy) = match (seen, s.traces.last()) {
            (Some(t), _) | (None, Some(t)) => t,
            _ => continue,
        };
        let share = (needed / energy.max(1e-12)).sqrt();
        let share = if s.effect.hinge {
            share.max(0.5)
        } else {
            share
        };
        let p = main_parameter(sizes, &neutral);
        let spec = &s.effect.parameters[p];
        let value = neutral[p] + share * (sizes[p] - neutral[p]);
        let (low, high) = s.effect.bounds(model, &s.place, p);
        let excited = (low..=high).contains(&value);
        out.insert(
            s.place.label(s.effect.id),
            Floor {
                parameter: spec.name.to_owned(),
                value: if excited {
                    value
                } else {
                    value.clamp(low, high)
                },
                unit: spec.unit.to_owned(),
                excited,
            },
        );
    }
    for &effect in &context.effects {
        for place in places(model, effect) {
            let key = place.label(effect.id);
            if out.contains_key(&key) || (effect.unseen)(&context.excitation, &place).is_none() {
                continue;
            }
            out.insert(
                key,
                Floor {
                    parameter: effect.parameters[0].name.to_owned(),
                    value: 0.0,
                    unit: effect.parameters[0].unit.to_owned(),
                    excited: false,
                },
            );
            break;
        }
    }
    debug_assert!(out.len() <= effects::ALL.len() * 1000);
    out
}

/// The parameter that a grid point moves.
fn main_parameter(sizes: &[f64], neutral: &[f64]) -> usize {
    (0..sizes.len())
        .max_by(|&a, &b| {
            let moved = |i: usize| (sizes[i] - neutral[i]).abs() / neutral[i].abs().max(1.0);
            moved(a).total_cmp(&moved(b)).then(b.cmp(&a))
        })
        .unwrap_or(0)
}
