//! Effects that a model can do without.

use super::fits::{Before, best_fits, penalised, polished};
use super::gates::{self, Worth};
use super::state::{Context, State};
use crate::effects::Place;
use crate::error::GapError;

/// A further effect must explain this share of what the robot as given fails to: what a model lacks in detail
/// grows with what it has.
const OF_ALL: f64 = 0.035;

/// Deletes effects that the others make superfluous, one by one: those that would not be added now.
///
/// # Errors
/// As [`crate::replay::Replayer::predict`].
pub fn delete(context: &Context, base: &State, mut state: State) -> Result<State, GapError> {
    while state.terms.len() > 1 {
        let variants = (0..state.terms.len()).map(|i| state.without(i)).collect::<Vec<_>>();
        let of: Vec<usize> = (0..variants.len()).collect();
        let before = Before { look: f64::INFINITY, fit: f64::INFINITY };
        let without = best_fits(context, variants, &of, of.len(), before)?;
        // the one that is missed least
        let least = without
            .into_iter()
            .enumerate()
            .min_by(|a, b| penalised(context, &a.1).total_cmp(&penalised(context, &b.1)));
        let Some((index, mut shorter)) = least else {
            break;
        };
        if context.scout.is_some() {
            // fitted to a scout, it is not yet as good as it can be
            shorter = polished(context, shorter)?;
        }
        let place = Some(&state.terms[index].place);
        let worth = gates::worth(context, &shorter, &state, place);
        let kept = worth.passed && enough(context, &worth, base, place);
        if kept && penalised(context, &shorter) > penalised(context, &state) {
            break;
        }
        state = shorter;
    }
    Ok(state)
}

/// Whether a further effect at `place` explains enough to be one.
pub fn enough(context: &Context, worth: &Worth, base: &State, place: Option<&Place>) -> bool {
    let all = gates::part(&context.fit, &base.cross, place);
    worth.cross > OF_ALL * all || worth.rest || (worth.beyond_doubt && worth.fit > OF_ALL * all)
}
