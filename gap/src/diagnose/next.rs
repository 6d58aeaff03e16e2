//! What to record next.

use super::search::Found;
use super::state::Context;
use crate::effects::{self, Domain};
use crate::report::{Cause, NextExperiment, Verdict};

/// The trial that tells most, if any is needed.
pub fn next(
    context: &Context,
    verdict: Verdict,
    causes: &[Cause],
    found: &Found,
) -> Option<NextExperiment> {
    match verdict {
        Verdict::NoGap | Verdict::Explained | Verdict::DataFault => None,
        Verdict::Ambiguous => {
            // names first, places after them
            let named = causes.iter().find(|c| !c.alternatives.is_empty());
            let open = named.or_else(|| causes.iter().find(|c| c.is_open()))?;
            let mut separates = vec![open.effect.clone()];
            separates.extend(open.alternatives.iter().cloned());
            let trial = separating(&open.effect, &open.alternatives)?;
            Some(NextExperiment {
                trial: trial.to_owned(),
                joints: open.location.clone(),
                reason: match open.alternatives.as_slice() {
                    [] => format!(
                        "{} explain these runs alike; what moves between these places tells them apart: put a sensor there (an IMU, a marker) for this trial",
                        open.rivals()
                    ),
                    _ => format!(
                        "{} and {} explain these runs alike; this trial makes their difference visible",
                        open.effect,
                        open.alternatives.join(", ")
                    ),
                },
                separates,
            })
        }
        Verdict::InsufficientData | Verdict::Unexplained | Verdict::PartlyExplained => {
            // what the runs leave in the dark comes first
            let refused = found
                .refused
                .first()
                .and_then(|(s, w)| s.terms.last().map(|t| (t, w.why)));
            if let Some((term, why)) = refused
                && verdict == Verdict::InsufficientData
            {
                return Some(NextExperiment {
                    trial: term.effect.trial.to_owned(),
                    joints: term.place.names.clone(),
                    reason: format!("{} fits, but {why}; hold this trial out", term.effect.id),
                    separates: vec![term.effect.id.to_owned()],
                });
            }
            let dark = context.effects.iter().find_map(|e| {
                let place = e.places(context.replayer.model()).into_iter().next()?;
                let alone = e.id == "bus_skew" && context.excitation.joints.len() < 2;
                let relevant = !alone
                    && !matches!(e.domain, Domain::AllLinks)
                    && e.layer != effects::Layer::Water;
                let why = (e.unseen)(&context.excitation, &place)?;
                (relevant && e.layer != effects::Layer::Sensing).then_some((e, why))
            })?;
            Some(NextExperiment {
                trial: dark.0.trial.to_owned(),
                joints: Vec::new(),
                reason: format!("{} could not be seen: {}", dark.0.id, dark.1),
                separates: vec![dark.0.id.to_owned()],
            })
        }
    }
}

/// The trial of whichever of two look-alikes has the more telling one.
fn separating(effect: &str, alternatives: &[String]) -> Option<&'static str> {
    let own = effects::find(effect)?;
    let other = alternatives.first().and_then(|id| effects::find(id));
    match other {
        // a trial that both have cannot tell them apart better than what was recorded
        Some(o) if o.trial == own.trial => Some(own.trial),
        Some(o) if own.trial == "chirp" => Some(o.trial),
        _ => Some(own.trial),
    }
}
