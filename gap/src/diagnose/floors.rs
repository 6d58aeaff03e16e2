//! Detection floors: the smallest size of each effect that these runs would have shown.

use std::collections::BTreeMap;

use super::doubt::sizes;
use super::gates::{ABSOLUTE_GAIN, RELATIVE_GAIN};
use super::screen::Screened;
use super::state::Context;
use crate::effects::Effect;
use crate::report::Floor;

/// By `effect` or `effect@place`.
pub fn floors(context: &Context, screened: &[Screened], misfit: f64) -> BTreeMap<String, Floor> {
    let model = context.replayer.model();
    let mut out = BTreeMap::new();
    let needed = ABSOLUTE_GAIN.max(RELATIVE_GAIN * misfit);
    for s in screened {
        let neutral = s.effect.neutral(model, &s.place);
        // the first size that is seen, shrunk in proportion: traces grow at least about linearly
        let seen = s.traces.iter().find(|(_, energy)| *energy >= needed);
        let (point, energy) = match (seen, s.traces.last()) {
            (Some(t), _) | (None, Some(t)) => t,
            _ => continue,
        };
        let share = (needed / energy.max(1e-12)).sqrt();
        let share = if s.effect.hinge { share.max(0.5) } else { share };
        let p = main_parameter(s.effect, point, &neutral);
        let spec = &s.effect.parameters[p];
        let value = neutral[p] + share * (point[p] - neutral[p]);
        let (low, high) = s.effect.bounds(model, &s.place, p);
        let excited = (low..=high).contains(&value);
        out.insert(
            s.place.label(s.effect.id),
            Floor {
                parameter: spec.name.to_owned(),
                value: if excited { value } else { value.clamp(low, high) },
                unit: s.effect.unit(model, &s.place, p).to_owned(),
                excited,
            },
        );
    }
    for &effect in &context.effects {
        for place in effect.places(model) {
            let key = place.label(effect.id);
            if out.contains_key(&key) || (effect.unseen)(&context.excitation, &place).is_none() {
                continue;
            }
            out.insert(
                key,
                Floor {
                    parameter: effect.parameters[0].name.to_owned(),
                    value: 0.0,
                    unit: effect.unit(model, &place, 0).to_owned(),
                    excited: false,
                },
            );
            break;
        }
    }
    out
}

/// The parameter that a grid point moves: of those that say how large the effect is, or, where none of them
/// moves, of all.
fn main_parameter(effect: &Effect, point: &[f64], neutral: &[f64]) -> usize {
    let moved = |i: usize| (point[i] - neutral[i]).abs() / neutral[i].abs().max(1.0);
    let most = |of: &mut dyn Iterator<Item = usize>| {
        of.filter(|&i| moved(i) > 0.0)
            .max_by(|&a, &b| moved(a).total_cmp(&moved(b)).then(b.cmp(&a)))
    };
    most(&mut sizes(effect)).or_else(|| most(&mut (0..point.len()))).unwrap_or(0)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use super::*;
    use crate::effects;

    #[test]
    fn a_floor_is_that_of_what_says_how_large_an_effect_is() {
        let main = |id: &str, point: &[f64], neutral: &[f64]| {
            let effect = effects::find(id).unwrap();
            effect.parameters[main_parameter(effect, point, neutral)].name
        };
        // a share that moves by one beside a width that moves by 0.02
        let width = main("controller_dead_band", &[0.02, 1.0], &[0.0, 0.0]);
        assert_eq!(width, "half_width_rad");
        assert_eq!(main("torque_limit", &[0.3, 1.0], &[1.1, 0.0]), "limit_nm");
        let compliance = main("gear_compliance", &[0.15, 0.1], &[0.0, 0.3]);
        assert_eq!(compliance, "compliance_rad_per_nm");
        assert_eq!(main("friction_drift", &[0.0, 0.1, 4.0], &[0.0, 0.0, 4.0]), "run_in_nm");
        // where the size stays
        let ratio = main("braking_asymmetry", &[1.0, 0.5], &[1.0, 1.0]);
        assert_eq!(ratio, "back_drive_kp_ratio");
    }
}
