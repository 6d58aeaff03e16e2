//! Which names of an answer set are one robot: no reading of any trial of the battery tells them apart.

use super::naming::Named;
use super::state::{Context, State};
use crate::error::GapError;
use crate::excite::{self, DEFAULT_RATE_HZ};
use crate::prospects::{as_run, measured, tolerance};
use crate::replay::{Data, SegmentOptions, Variant};
use crate::report::Cause;

/// Says of `causes`, which are in `best`, which of their alternatives are the very same robot.
///
/// # Errors
/// As [`crate::replay::Replayer::predict`].
pub fn find_synonyms(
    context: &Context,
    causes: &mut [Cause],
    best: &State,
    named: &[Named],
) -> Result<(), GapError> {
    for cause in causes.iter_mut().filter(|c| !c.alternatives.is_empty()) {
        let Some(own) = named.iter().find(|n| n.is(best, cause)) else {
            continue;
        };
        let mut without = best.terms.clone();
        without.remove(own.index);
        for rival in own.rivals.iter().filter(|r| r.in_set) {
            let id = rival.state.terms[rival.index].effect.id;
            let has = |of: &[String]| of.iter().any(|a| a == id);
            if !has(&cause.alternatives) || has(&cause.synonyms) {
                continue;
            }
            let robots = [without.clone(), best.terms.clone(), rival.state.terms.clone()];
            if one_robot(context, &robots)? {
                cause.synonyms.push(id.to_owned());
            }
        }
    }
    Ok(())
}

/// Whether no channel of any trial of the battery tells the last two of `robots` apart by more than three
/// hundredths of what the second has beyond the first, or of a tolerance where that is less.
fn one_robot(context: &Context, robots: &[Variant; 3]) -> Result<bool, GapError> {
    const TELLS_FROM: f64 = 0.03;
    let model = context.replayer.model();
    let mut shows = false;
    for trial in excite::battery(model, None, DEFAULT_RATE_HZ).unwrap_or_default() {
        let run = as_run(&trial, &measured(model, &trial, true));
        let data = Data::new(model, vec![run], SegmentOptions::default());
        let predictions = context.replayer.predict(&data, robots)?;
        for piece in data.segments.iter().flat_map(|s| &s.pieces) {
            let Some(tolerance) = tolerance(piece.kind) else {
                continue;
            };
            let off = |a: usize, b: usize| {
                let off = |k: usize| f64::from(predictions[a][k] - predictions[b][k]).powi(2);
                let square: f64 = piece.range.clone().map(off).sum();
                (square / piece.range.len().max(1) as f64).sqrt() / tolerance
            };
            let size = off(0, 1);
            shows |= size >= 1.0;
            // what cannot be simulated is not the same either
            let same = off(1, 2) <= TELLS_FROM * size.max(1.0);
            if !same {
                return Ok(false);
            }
        }
    }
    Ok(shows)
}
