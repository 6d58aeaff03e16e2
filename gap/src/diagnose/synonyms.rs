//! Which names of an answer set are one robot: no reading of any trial of the battery tells them apart.

use super::naming::Named;
use super::state::{Context, State};
use crate::error::GapError;
use crate::excite::{self, DEFAULT_RATE_HZ};
use crate::prospects::{as_run, measured, tolerance};
use crate::replay::{Data, SegmentOptions, Variant};
use crate::report::Cause;

/// Which of the alternatives of `cause`, which is `own` in `best`, are the very same robot.
///
/// # Errors
/// As [`crate::replay::Replayer::predict`].
pub fn synonyms(
    context: &Context,
    cause: &Cause,
    best: &State,
    own: &Named,
) -> Result<Vec<String>, GapError> {
    let mut out: Vec<String> = Vec::new();
    for rival in own.rivals.iter().filter(|r| r.in_set) {
        let id = rival.state.terms[rival.index].effect.id;
        let has = |of: &[String]| of.iter().any(|a| a == id);
        if has(&cause.alternatives) && !has(&out) {
            let robots = [best.without(own.index), best.terms.clone(), rival.state.terms.clone()];
            out.extend(one_robot(context, &robots)?.then(|| id.to_owned()));
        }
    }
    for pair in &own.pairs {
        let robots = [best.without(own.index), best.terms.clone(), pair.state.terms.clone()];
        if one_robot(context, &robots)? {
            out.extend(pair.terms().iter().map(|t| t.effect.id.to_owned()));
        }
    }
    out.sort();
    out.dedup();
    Ok(out)
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
        for piece in data.pieces() {
            let Some(tolerance) = tolerance(model, piece) else {
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
