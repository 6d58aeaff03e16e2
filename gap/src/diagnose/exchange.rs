//! Two effects in the place of one. The search takes the single effect that explains most, and what explains most
//! alone need not be there: gains of position and of speed that are off together look like a weaker motor.

use super::delete::delete;
use super::fits::{Before, best_fits, penalised};
use super::gates::{self, RELATIVE_GAIN, Worth};
use super::pairs::sums;
use super::product::dot;
use super::state::{Context, State};
use crate::error::GapError;
use crate::replay::{Term, Variant};

/// So many exchanges are fitted.
const EXCHANGES: usize = 4;

/// `best` with two of the `singles` in the place of an effect of its own, if something is left to explain and they
/// certainly explain more.
///
/// # Errors
/// As [`crate::replay::Replayer::predict`].
pub fn exchanged(
    context: &Context,
    base: &State,
    best: &State,
    singles: &[(State, Worth)],
) -> Result<Option<State>, GapError> {
    if gates::worst(context, best) < gates::least(context) {
        return Ok(None);
    }
    let mut promising: Vec<(f64, Variant)> = Vec::new();
    for index in 0..best.terms.len() {
        promising.extend(in_place_of(context, best, singles, index)?);
    }
    promising.sort_by(|a, b| a.0.total_cmp(&b.0));
    promising.truncate(EXCHANGES);
    let variants: Vec<Variant> = promising.into_iter().map(|p| p.1).collect();
    let of: Vec<usize> = (0..variants.len()).collect();
    let states = best_fits(context, variants, &of, of.len(), Before::of(best))?;
    let ahead = |s: &State| penalised(context, s) < penalised(context, best);
    let nearest = (states.into_iter().filter(ahead))
        .min_by(|a, b| penalised(context, a).total_cmp(&penalised(context, b)));
    let Some(nearest) = nearest else { return Ok(None) };
    let shorter = delete(context, base, nearest)?;
    let matter = shorter.terms.iter().all(|t| gates::matters(context, t));
    let worth = gates::worth(context, best, &shorter, None);
    // that there is something to explain is known: it need not gain as much as a further effect must
    let better =
        worth.fit > 0.0 && worth.interval.0 > 0.0 && worth.cross > RELATIVE_GAIN * worth.of;
    Ok((matter && better && ahead(&shorter)).then_some(shorter))
}

/// Models with two of the singles in the place of term `index` of `best`, with the square that each should leave by
/// its traces.
fn in_place_of(
    context: &Context,
    best: &State,
    singles: &[(State, Worth)],
    index: usize,
) -> Result<Vec<(f64, Variant)>, GapError> {
    let others = best.without(index);
    let singles = singles.iter().filter_map(|(s, _)| s.terms.last());
    let new = |t: &&Term| !best.terms.iter().any(|b| b.same(t));
    let pool: Vec<&Term> = singles.filter(new).collect();
    let bare = context.replayer.predict(&context.fit.data, std::slice::from_ref(&others))?;
    let asked = context.fit.residual(&bare.concat());
    let pairs = sums(context, &others, &pool, &asked)?;
    Ok(pairs.into_iter().map(|(left, terms)| (left * dot(&asked, &asked), terms)).collect())
}
