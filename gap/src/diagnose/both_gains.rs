//! Gains of position and of speed that are off by two factors. One factor on both gains and another on one of them is
//! the same robot in words that nobody can act on: the gains are told each by its own.

use super::fits::{LAST_STEPS, fitted, penalised};
use super::screen::Screened;
use super::state::{Context, State};
use crate::error::GapError;
use crate::place::Place;
use crate::replay::Term;

/// The factor on both gains.
const BOTH: &str = "stale_gains";
/// Those on one of them.
const EACH: [&str; 2] = ["kp_error", "kd_error"];
/// A model may leave so much more to be told so.
const NO_MORE: f64 = 1.01;

/// `best` with a factor of its own on each gain, where it has one on both and one on either at one place.
///
/// # Errors
/// As [`crate::replay::Replayer::predict`].
pub fn told_apart(context: &Context, best: &State) -> Result<Option<State>, GapError> {
    let model = context.replayer.model();
    for (index, both) in best.terms.iter().enumerate().filter(|(_, t)| t.effect.id == BOTH) {
        let on_one = |t: &&Term| EACH.contains(&t.effect.id) && t.place == both.place;
        let Some(one) = best.terms.iter().find(on_one) else { continue };
        let missing = |id: &str| EACH.contains(&id) && id != one.effect.id;
        let Some(&effect) = context.effects.iter().find(|e| missing(e.id)) else { continue };
        let other = Term::nothing(model, effect, both.place.clone());
        if best.terms.iter().any(|t| t.same(&other)) {
            continue;
        }
        let mut terms = best.terms.clone();
        terms[index] = other;
        let state = fitted(context, terms, Some(LAST_STEPS))?;
        if penalised(context, &state) <= NO_MORE * penalised(context, best) {
            return Ok(Some(state));
        }
    }
    Ok(None)
}

/// Whether `rival` in the place of term `index` of `terms` would be the factor on both gains beside one on either.
pub fn tangles(rival: &Screened, terms: &[Term], index: usize) -> bool {
    let meets = |place: &Place| place.items.iter().any(|a| rival.place.items.contains(a));
    let mut others = terms.iter().enumerate().filter(|(k, _)| *k != index);
    rival.effect.id == BOTH && others.any(|(_, t)| EACH.contains(&t.effect.id) && meets(&t.place))
}
