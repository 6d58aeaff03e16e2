//! What to record next: the trial of the battery in which what is still possible differs most, by simulating
//! it; never one that is in the logs, never for what leaves no trace on this robot.

use super::naming::Named;
use super::request::Request;
use super::search::Found;
use super::state::Context;
use crate::effects::Effect;
use crate::error::GapError;
use crate::excitation::Excitation;
use crate::excite::{self, DEFAULT_RATE_HZ};
use crate::prospects::as_run;
use crate::replay::{Data, SegmentOptions, Term, Variant};
use crate::report::{Cause, LocalGap, NextExperiment, Verdict};
use crate::trial::Kind;

/// Longest trial that is proposed, s: longer ones are for what takes as long to build up.
const LONGEST_S: f64 = 60.0;
/// Root mean square difference of a joint's angle that tells two models apart, rad: several counts of an
/// encoder, and more than repeats of a careful lab differ by.
const TELLS_RAD: f64 = 0.003;

/// The trial that tells most, if any is needed and any tells something.
///
/// # Errors
/// As [`crate::replay::Replayer::predict`].
pub fn next(
    context: &Context,
    request: &Request,
    verdict: Verdict,
    causes: &[Cause],
    (found, named): (&Found, &[Named]),
    local: &[LocalGap],
) -> Result<Option<NextExperiment>, GapError> {
    match verdict {
        Verdict::NoGap | Verdict::Explained | Verdict::DataFault => Ok(None),
        Verdict::Ambiguous => {
            // names first, places after them
            let of_name = causes.iter().find(|c| !c.alternatives.is_empty());
            match of_name {
                Some(open) => between_names(context, request, open, found, named),
                None => Ok(causes.iter().find(|c| c.is_open()).map(between_places)),
            }
        }
        Verdict::InsufficientData | Verdict::Unexplained | Verdict::PartlyExplained => {
            if let Some(gap) = local.first().filter(|_| causes.is_empty()) {
                return Ok(Some(again(request, gap)));
            }
            in_the_dark(context, request, verdict, found)
        }
    }
}

/// The same run once more: what is in one run only may be the run.
fn again(request: &Request, gap: &LocalGap) -> NextExperiment {
    let run = request.runs.iter().find(|r| r.name == gap.run);
    let trial = run.and_then(|r| excite::names_in(&format!("{} {}", r.name, r.log.meta.notes)));
    NextExperiment {
        trial: trial.map_or_else(|| gap.run.clone(), str::to_owned),
        joints: vec![gap.joint.clone()],
        reason: format!(
            "only run {} shows it, from {:.1} s to {:.1} s: a second run under the same conditions tells whether it comes again",
            gap.run, gap.from_s, gap.to_s
        ),
        separates: Vec::new(),
    }
}

/// Where the sensors would have to be.
fn between_places(open: &Cause) -> NextExperiment {
    let trial = crate::effects::find(&open.effect).map_or("", |e| e.trial);
    NextExperiment {
        trial: trial.to_owned(),
        joints: open.location.clone(),
        reason: format!(
            "{} explain these runs alike; what moves between these places tells them apart: put a sensor there (an IMU, a marker) for this trial",
            open.rivals()
        ),
        separates: vec![open.effect.clone()],
    }
}

/// The trial in which a cause and its first alternative differ most.
fn between_names(
    context: &Context,
    request: &Request,
    open: &Cause,
    found: &Found,
    named: &[Named],
) -> Result<Option<NextExperiment>, GapError> {
    let own = named.iter().find(|n| {
        let term = &found.best.terms[n.index];
        term.effect.id == open.effect && term.place.names == open.location
    });
    let rival = own.and_then(|n| {
        let is = |id: &str| open.alternatives.iter().any(|a| a == id);
        n.rivals
            .iter()
            .find(|r| r.in_set && is(r.state.terms[r.index].effect.id))
    });
    let Some(rival) = rival else { return Ok(None) };
    let pair = [found.best.terms.clone(), rival.state.terms.clone()];
    let best = most_telling(context, request, &pair, |_| true)?;
    let mut separates = vec![open.effect.clone()];
    separates.extend(open.alternatives.iter().cloned());
    Ok(best.map(|(trial, apart_rad)| NextExperiment {
        trial,
        joints: open.location.clone(),
        reason: format!(
            "{} and {} explain these runs alike; in this trial they would differ by {:.1} mrad",
            open.effect,
            open.alternatives.join(", "),
            1e3 * apart_rad
        ),
        separates,
    }))
}

/// A trial for what the runs leave in the dark and what would show on this robot: first what some gate
/// refused, then what nothing excited.
fn in_the_dark(
    context: &Context,
    request: &Request,
    verdict: Verdict,
    found: &Found,
) -> Result<Option<NextExperiment>, GapError> {
    let refused = (found.refused.first()).filter(|_| verdict == Verdict::InsufficientData);
    if let Some((state, worth)) = refused
        && let Some(term) = state.terms.last()
    {
        let pair = [found.best.terms.clone(), state.terms.clone()];
        let best = most_telling(context, request, &pair, |_| true)?;
        if let Some((trial, apart_rad)) = best {
            return Ok(Some(NextExperiment {
                trial,
                joints: term.place.names.clone(),
                reason: format!(
                    "{} fits, but {}; in this trial it would change angles by {:.1} mrad",
                    term.effect.id,
                    worth.why,
                    1e3 * apart_rad
                ),
                separates: vec![term.effect.id.to_owned()],
            }));
        }
    }
    let model = context.replayer.model();
    for &effect in &context.effects {
        let Some(place) = effect.places(model).into_iter().next() else {
            continue;
        };
        let Some(why) = (effect.unseen)(&context.excitation, &place) else {
            continue;
        };
        let middle = effect.grid.len() / 2;
        if middle >= effect.grid.len() {
            continue;
        }
        let mut with = found.best.terms.clone();
        with.push(Term {
            effect,
            values: effect.sizes(model, &place, middle),
            place: place.clone(),
        });
        let pair = [found.best.terms.clone(), with];
        // a trial after which it could not be seen either is no help
        let made_for = |trial: &excite::Trial| {
            let mut excited = Excitation::of(model, &[&as_run(trial, &[Kind::Position])]);
            excited.kinds.extend(&context.excitation.kinds);
            let seen = || (effect.unseen)(&excited, &place).is_none();
            trial.excites.iter().any(|e| e == effect.id) && seen()
        };
        if let Some((trial, apart_rad)) = most_telling(context, request, &pair, made_for)? {
            return Ok(Some(told(effect, why, trial, apart_rad)));
        }
    }
    Ok(None)
}

fn told(effect: &Effect, why: &str, trial: String, apart_rad: f64) -> NextExperiment {
    NextExperiment {
        trial,
        joints: Vec::new(),
        reason: format!(
            "{} could not be seen: {why}; in this trial one of middling size would change angles by {:.1} mrad",
            effect.id,
            1e3 * apart_rad
        ),
        separates: vec![effect.id.to_owned()],
    }
}

/// The trial that is not in the logs in which a joint's angle differs most between two models, and by how
/// much, rad. None where it does not in any.
fn most_telling(
    context: &Context,
    request: &Request,
    pair: &[Variant; 2],
    among: impl Fn(&excite::Trial) -> bool,
) -> Result<Option<(String, f64)>, GapError> {
    let model = context.replayer.model();
    let Ok(battery) = excite::battery(model, None, DEFAULT_RATE_HZ) else {
        return Ok(None);
    };
    let recorded = |trial: &excite::Trial| {
        (request.runs.iter()).any(|r| {
            excite::names_in(&format!("{} {}", r.name, r.log.meta.notes))
                == Some(trial.name.as_str())
        })
    };
    let mut best: Option<(String, f64)> = None;
    let can = |t: &&excite::Trial| t.duration_s <= LONGEST_S && !recorded(t);
    for trial in battery.iter().filter(can).filter(|t| among(t)) {
        let data = Data::new(
            model,
            vec![as_run(trial, &[Kind::Position])],
            SegmentOptions::default(),
        );
        let predictions = context.replayer.predict(&data, pair)?;
        for piece in data.segments.iter().flat_map(|s| &s.pieces) {
            let off = |k: usize| f64::from(predictions[0][k] - predictions[1][k]).powi(2);
            let square: f64 = piece.range.clone().map(off).sum();
            let apart_rad = (square / piece.range.len().max(1) as f64).sqrt();
            if apart_rad > best.as_ref().map_or(TELLS_RAD, |b| b.1) {
                best = Some((trial.name.clone(), apart_rad));
            }
        }
    }
    Ok(best)
}
