//! What to record next: the trial of the battery in which what is still possible differs most, by simulating
//! it; never one that is in the logs, never for what leaves no trace on this robot. Where a weight is in
//! question, with a known one hung on as well: without one, all torques less and all weights more are alike.

use caudata_model::RobotModel;
use caudata_runlog::Payload;

use super::gates::{self, Worth};
use super::levels::NOTHING_LEFT;
use super::naming::{Named, Rival};
use super::request::Request;
use super::search::Found;
use super::state::{Context, State};
use crate::effects::{Domain, Layer};
use crate::error::GapError;
use crate::excitation::Excitation;
use crate::excite::{self, DEFAULT_RATE_HZ};
use crate::plant::{anchor_m, lever};
use crate::prospects::{LONGEST_S, as_run};
use crate::repeats;
use crate::replay::{Data, SegmentOptions, Term, Variant};
use crate::report::{Cause, LocalGap, NextExperiment, Verdict};
use crate::trial::{Kind, Trial};

/// Root mean square difference of a joint's angle that tells two models apart, rad: several counts of an
/// encoder, and more than repeats of a careful lab differ by.
const TELLS_RAD: f64 = 0.003;
/// A known weight, as a share of the link that it hangs on, …
const OF_LINK: f64 = 0.5;
/// … which may take this share of the joint's torque, …
const OF_TORQUE: f64 = 0.25;
/// … and is so far from the joint as the link's centre of mass, times this.
const BEYOND_CENTRE: f64 = 1.3;
/// m/s².
const GRAVITY: f64 = 9.81;

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
    unfinished: bool,
) -> Result<Option<NextExperiment>, GapError> {
    match verdict {
        // it asks for time, and not for motion
        _ if unfinished => Ok(None),
        Verdict::NoGap | Verdict::Explained | Verdict::DataFault => Ok(None),
        Verdict::Ambiguous => {
            // names first, places after them
            let of_name = causes.iter().find(|c| c.has_open_name());
            match of_name {
                Some(open) => between_names(context, open, found, named),
                None => {
                    let of_place = causes.iter().find(|c| !c.elsewhere.is_empty());
                    Ok(of_place.map(between_places))
                }
            }
        }
        Verdict::InsufficientData | Verdict::Unexplained | Verdict::PartlyExplained => {
            let elsewhere = || gates::worst(context, &found.best) >= NOTHING_LEFT;
            if let Some(gap) = local.first().filter(|_| causes.is_empty() && !elsewhere()) {
                return Ok(Some(again(request, gap)));
            }
            in_the_dark(context, verdict, found, named)
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
        ..NextExperiment::default()
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
        ..NextExperiment::default()
    }
}

/// The trial in which a cause and its first alternative differ most.
fn between_names(
    context: &Context,
    open: &Cause,
    found: &Found,
    named: &[Named],
) -> Result<Option<NextExperiment>, GapError> {
    let own = named.iter().find(|n| n.is(&found.best, open));
    let another = |t: &Term| {
        let has = |of: &[String]| of.iter().any(|a| a == t.effect.id);
        has(&open.alternatives) && !has(&open.synonyms)
    };
    let rival = own.and_then(|n| {
        let one = n.rivals.iter().find(|r| r.in_set && another(&r.state.terms[r.index]));
        let two = || n.pairs.iter().find(|p| p.terms().iter().any(another));
        one.map(|r| &r.state).or_else(|| two().map(|p| &p.state))
    });
    let Some(rival) = rival else { return Ok(None) };
    let pair = [found.best.terms.clone(), rival.terms.clone()];
    let bare = most_telling(context, &pair, |_| true, None)?;
    let mut separates = vec![open.effect.clone()];
    separates.extend(open.alternatives.iter().cloned());
    let told = |(trial, apart): (String, String), with: &str, payload| NextExperiment {
        trial,
        joints: open.location.clone(),
        reason: format!(
            "{} and {} explain these runs alike; {with}in this trial they would differ by {apart}",
            open.effect,
            open.as_good(&str::to_owned).join(", ")
        ),
        separates: separates.clone(),
        payload,
    };
    if let Some(weight) = known_weight(context.replayer.model(), &pair) {
        // a weight is not let fall
        let held = |t: &excite::Trial| t.on.is_empty();
        let weighted = most_telling(context, &pair, held, Some(&weight))?;
        if let Some(best) = weighted {
            let [x, y, z] = weight.at_m;
            let with = format!(
                "weigh `{0}`, or hang a known weight on it ({1:.0} g at [{x:.3}, {y:.3}, {z:.3}] m of its frame, say so in the map or log.toml: [[payload]]), and ",
                weight.link,
                1e3 * weight.mass_kg
            );
            return Ok(Some(told(best, &with, Some(weight))));
        }
    }
    Ok(bare.map(|best| told(best, "", None)))
}

/// The weight to hang on the link that one of two models makes heavier where the other changes something else.
fn known_weight(model: &RobotModel, pair: &[Variant; 2]) -> Option<Payload> {
    let weighs = |t: &&Term| t.effect.layer == Layer::Inertia && t.place.domain == Domain::Links;
    let not_in = |t: &&Term, other: &Variant| !other.iter().any(|o| o.effect == t.effect);
    let of = |a: usize| pair[a].iter().filter(weighs).find(|t| not_in(t, &pair[1 - a]));
    let l = match (of(0), of(1)) {
        (Some(one), None) | (None, Some(one)) => *one.place.items.first()?,
        _ => return None,
    };
    let link = &model.links()[l];
    let joint = *link.joints.last()?;
    let servo = model.servo(model.actuated().iter().position(|&j| j == joint)?);
    let (direction, far_m) = lever(model, l);
    let far_m = BEYOND_CENTRE * far_m;
    let most_kg = OF_TORQUE * servo.tau_max_nm / (GRAVITY * far_m);
    let mass_kg = 0.01 * (100.0 * most_kg.min(OF_LINK * link.mass_kg)).round().max(1.0);
    let anchor_m = anchor_m(model, l);
    Some(Payload {
        link: link.name.clone(),
        mass_kg,
        at_m: [0, 1, 2].map(|i| anchor_m[i] + far_m * direction[i]),
    })
}

/// A trial for what the runs leave in the dark and what would show on this robot: what some gate refused, where
/// the runs cannot decide; what nothing excited; last, what comes nearest to what was found and is not it.
fn in_the_dark<'a>(
    context: &Context,
    verdict: Verdict,
    found: &'a Found,
    named: &'a [Named],
) -> Result<Option<NextExperiment>, GapError> {
    let refused = |(state, worth): &'a (State, Worth)| {
        let term = state.terms.last()?;
        let why = format!("{} fits, but {}; in this trial", term.effect.id, worth.why);
        Some((&state.terms, term, why))
    };
    if verdict == Verdict::InsufficientData
        && let Some((terms, term, why)) = found.refused.first().and_then(refused)
        && let Some(told) = apart(context, found, terms, term, &why)?
    {
        return Ok(Some(told));
    }
    let model = context.replayer.model();
    for &effect in &context.effects {
        let place = effect.places(model).into_iter().next();
        let why = place.as_ref().and_then(|p| (effect.unseen)(&context.excitation, p));
        let (Some(place), Some(why)) = (place, why) else {
            continue;
        };
        let values = effect.sizes(model, &place, effect.grid.len() / 2);
        let mut with = found.best.terms.clone();
        with.push(Term { effect, values, place: place.clone() });
        let pair = [found.best.terms.clone(), with];
        // a trial after which it could not be seen either is no help
        let made_for = |trial: &excite::Trial| {
            let mut excited = Excitation::of(model, &[&as_run(trial, &[Kind::Position])]);
            excited.kinds.extend(&context.excitation.kinds);
            let seen = || (effect.unseen)(&excited, &place).is_none();
            trial.excites.iter().any(|e| e == effect.id) && seen()
        };
        if let Some((trial, apart)) = most_telling(context, &pair, made_for, None)? {
            return Ok(Some(NextExperiment {
                trial,
                reason: format!(
                    "{} could not be seen: {why}; in this trial one of middling size would change angles by {apart}",
                    effect.id
                ),
                separates: vec![effect.id.to_owned()],
                ..NextExperiment::default()
            }));
        }
    }
    let rivals = named.iter().flat_map(|n| &n.rivals);
    let nearest = rivals.min_by(|a, b| a.short.total_cmp(&b.short));
    let rival = |r: &'a Rival| {
        let term = &r.state.terms[r.index];
        let why = format!(
            "neither what was found nor {}, which comes nearest to it, explains these runs; in this trial",
            term.label()
        );
        (&r.state.terms, term, why)
    };
    let nearest = nearest.map(rival);
    match nearest.or_else(|| found.refused.iter().find_map(refused)) {
        Some((terms, term, why)) => apart(context, found, terms, term, &why),
        None => Ok(None),
    }
}

/// The trial in which the model `terms`, for the sake of its `term`, differs most from what was found.
fn apart(
    context: &Context,
    found: &Found,
    terms: &Variant,
    term: &Term,
    why: &str,
) -> Result<Option<NextExperiment>, GapError> {
    let pair = [found.best.terms.clone(), terms.clone()];
    let best = most_telling(context, &pair, |_| true, None)?;
    Ok(best.map(|(trial, apart)| NextExperiment {
        trial,
        joints: term.place.names.clone(),
        reason: format!("{why} they would differ by {apart}"),
        separates: vec![term.effect.id.to_owned()],
        ..NextExperiment::default()
    }))
}

/// The trial that is not in the logs in which a joint's angle differs most between two models, and by how
/// much. None where it does not in any.
fn most_telling(
    context: &Context,
    pair: &[Variant; 2],
    among: impl Fn(&excite::Trial) -> bool,
    weight: Option<&Payload>,
) -> Result<Option<(String, String)>, GapError> {
    let model = context.replayer.model();
    let Ok(battery) = excite::battery(model, None, DEFAULT_RATE_HZ) else {
        return Ok(None);
    };
    let mut best: Option<(String, String, f64)> = None;
    for trial in battery.iter().filter(|t| t.duration_s <= LONGEST_S && among(t)) {
        let run = asked_for(context, trial, weight);
        let runs = context.fit.data.trials.iter().chain(&context.holdout.data.trials);
        if is_recorded(model, runs, trial, &run, weight.is_some()) {
            continue;
        }
        let data = Data::new(model, vec![run], SegmentOptions::default());
        let predictions = context.replayer.predict(&data, pair)?;
        for piece in data.pieces() {
            let off = |k: usize| f64::from(predictions[0][k] - predictions[1][k]).powi(2);
            let square: f64 = piece.range.clone().map(off).sum();
            let apart = (square / piece.range.len().max(1) as f64).sqrt();
            let per_radian = model.per_radian(piece.index);
            if apart / per_radian > best.as_ref().map_or(TELLS_RAD, |b| b.2) {
                let unit = model.joints()[model.actuated()[piece.index]].unit();
                let apart_told = format!("{:.1} m{unit}", 1e3 * apart);
                best = Some((trial.name.clone(), apart_told, apart / per_radian));
            }
        }
    }
    Ok(best.map(|(trial, apart, _)| (trial, apart)))
}

/// `trial` under the conditions of the first run that was held as it is, of those without a weight if there are any,
/// with this weight.
fn asked_for(context: &Context, trial: &excite::Trial, weight: Option<&Payload>) -> Trial {
    let mut own = as_run(trial, &[Kind::Position]);
    let held = || context.fit.data.trials.iter().filter(|r| r.base == own.base);
    if let Some(first) = held().find(|r| r.meta.payload.is_empty()).or_else(|| held().next()) {
        (own.meta, own.supply_v) = (first.meta.clone(), first.supply_v);
    }
    if let Some(weight) = weight {
        own.meta.payload = vec![weight.clone()];
    }
    own
}

/// Whether one of `runs` is `trial` by its name, or by the commands that it was sent, under the conditions of
/// `own`; of a known weight (`weighted`) any will do.
fn is_recorded<'a>(
    model: &RobotModel,
    runs: impl Iterator<Item = &'a Trial>,
    trial: &excite::Trial,
    own: &Trial,
    weighted: bool,
) -> bool {
    let small_rad = small(model, trial);
    let within = |a: usize| small_rad * model.per_radian(a);
    let mut runs = runs.flat_map(|r| std::iter::once(r).chain(&r.members));
    runs.any(|r| {
        let mut meta = r.meta.clone();
        if weighted && !meta.payload.is_empty() {
            meta.payload.clone_from(&own.meta.payload);
        }
        let named = || {
            let of = excite::names_in(&format!("{} {}", r.name, r.meta.notes));
            of == Some(trial.name.as_str())
        };
        let longer = r.duration_s() > own.duration_s() - 0.1;
        repeats::same_conditions(model, &meta, &own.meta)
            && (named() || longer && repeats::same_commands(own, r, within))
    })
}

/// What makes no difference to the commands of `trial`, rad (of a slide, of what counts as one): a twentieth
/// of what its joint that moves least does, and no more than repeats are allowed.
fn small(model: &RobotModel, trial: &excite::Trial) -> f64 {
    const MOST_RAD: f64 = 0.008;
    let span = |a: usize| {
        let sent = || trial.commands_rad.iter().map(|row| row[a]);
        let span = sent().fold(f64::NEG_INFINITY, f64::max) - sent().fold(f64::INFINITY, f64::min);
        span / model.per_radian(a)
    };
    let moves = (0..trial.columns.len()).map(span).filter(|span| *span > 0.0);
    moves.map(|span| 0.05 * span).fold(MOST_RAD, f64::min)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use super::*;
    use crate::place::places;

    #[test]
    fn a_trial_is_known_by_its_commands_whatever_the_run_is_called() {
        let file = concat!(env!("CARGO_MANIFEST_DIR"), "/../robots/xl330_pendulum.robot.toml");
        let model = RobotModel::load(file.as_ref()).unwrap();
        let battery = excite::battery(&model, None, DEFAULT_RATE_HZ).unwrap();
        for trial in &battery {
            let mut run = as_run(trial, &[]);
            let known = |run: &Trial, weighted| {
                let is = |t: &&excite::Trial| {
                    let own = &as_run(t, &[]);
                    is_recorded(&model, std::iter::once(run), t, own, weighted)
                };
                battery.iter().filter(is).map(|t| t.name.clone()).collect::<Vec<_>>()
            };
            assert_eq!(known(&run, false), [trial.name.as_str()]);
            // under another gain, or with a weight, it is another trial
            run.meta.kp = Some(0.5);
            assert!(known(&run, false).is_empty());
            run.meta.kp = None;
            run.meta.payload.push(Payload { link: "arm".to_owned(), mass_kg: 0.1, at_m: [0.0; 3] });
            assert!(known(&run, false).is_empty());
            assert_eq!(known(&run, true), [trial.name.as_str()]);
        }
    }

    #[test]
    fn a_known_weight_is_hung_where_a_mass_is_in_question_and_nothing_else_that_weighs() {
        let file = concat!(env!("CARGO_MANIFEST_DIR"), "/../robots/xl330_pendulum.robot.toml");
        let model = RobotModel::load(file.as_ref()).unwrap();
        let one = |id: &str| {
            let effect = crate::effects::find(id).unwrap();
            vec![Term::nothing(&model, effect, places(&model, effect.domain).pop().unwrap())]
        };
        let hung = |a: &str, b: &str| known_weight(&model, &[one(a), one(b)]);
        let weight = hung("point_mass", "torque_constant").unwrap();
        // 0.1 m to the centre, 1.3 of that to the weight; a quarter of 0.77 N·m carries 0.1925/(9.81·0.13)
        // = 0.151 kg there, less than half of 0.49 kg
        assert_eq!((weight.link.as_str(), weight.mass_kg), ("arm", 0.15));
        assert!((weight.at_m[2] + 0.13).abs() < 1e-9, "{weight:?}");
        assert_eq!(hung("torque_constant", "point_mass"), Some(weight));
        // two masses, and none
        assert_eq!(hung("point_mass", "link_mass"), None);
        assert_eq!(hung("kp_error", "torque_constant"), None);
    }
}
