//! What to record next: the trial of the battery in which what is still possible differs most in what the runs
//! have, by simulating it; never one that is in the logs, never for what leaves no trace on this robot. Where a
//! weight is in question, with a known one hung on as well: without one, all torques less and all weights more
//! are alike.

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
use crate::prospects::{LONGEST_S, as_run, measured, tolerance};
use crate::repeats;
use crate::replay::{Data, SegmentOptions, Term, Variant};
use crate::report::{Cause, LocalGap, NextExperiment, Verdict};
use crate::trial::{Kind, Trial};

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
    of: (&Found, &[Named]),
    local: &[LocalGap],
    unfinished: bool,
) -> Result<Option<NextExperiment>, GapError> {
    let told = telling(context, request, verdict, causes, of, local, unfinished)?;
    let joints = context.replayer.model().actuated_names();
    Ok(told.map(|mut told| {
        let one = excite::moves_one_joint(&told.trial);
        told.joints.retain(|j| one && joints.contains(&j.as_str()));
        told
    }))
}

/// The same, with the places that it is about.
fn telling(
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
            for open in causes.iter().filter(|c| c.has_open_name()) {
                if let Some(told) = between_names(context, open, found, named)? {
                    return Ok(Some(told));
                }
            }
            let of_place = causes.iter().find(|c| !c.elsewhere.is_empty());
            Ok(of_place.map(between_places))
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

/// The trial that tells a cause from most of its alternatives.
fn between_names(
    context: &Context,
    open: &Cause,
    found: &Found,
    named: &[Named],
) -> Result<Option<NextExperiment>, GapError> {
    let Some(own) = named.iter().find(|n| n.is(&found.best, open)) else { return Ok(None) };
    let another = |t: &Term| {
        let has = |of: &[String]| of.iter().any(|a| a == t.effect.id);
        has(&open.alternatives) && !has(&open.synonyms)
    };
    let mut names: Vec<Vec<&str>> = Vec::new();
    let mut models = vec![found.best.terms.clone()];
    let alone = own.rivals.iter().filter(|r| r.in_set);
    let alone = alone.map(|r| (&r.state, vec![&r.state.terms[r.index]]));
    let together = own.pairs.iter().map(|p| (&p.state, p.terms().iter().collect::<Vec<_>>()));
    for (state, terms) in alone.chain(together).filter(|(_, t)| t.iter().any(|t| another(t))) {
        let ids: Vec<&str> = terms.iter().map(|t| t.effect.id).collect();
        if !names.contains(&ids) {
            names.push(ids);
            models.push(state.terms.clone());
        }
    }
    let weights = known_weights(context.replayer.model(), &models);
    let best = most_telling(context, &models, |_| true, &weights)?;
    Ok(best.map(|best| {
        let others: Vec<String> = best.from.iter().map(|&k| names[k].join(" with ")).collect();
        let mut separates = vec![open.effect.clone()];
        for id in best.from.iter().flat_map(|&k| &names[k]) {
            if !separates.iter().any(|s| s == id) {
                separates.push((*id).to_owned());
            }
        }
        NextExperiment {
            trial: best.trial,
            joints: open.location.clone(),
            reason: format!(
                "{} and {} explain these runs alike; {}in this trial they would differ by {}",
                open.effect,
                others.join(", "),
                best.weight.as_ref().map_or_else(String::new, hang),
                best.apart
            ),
            separates,
            payload: best.weight,
        }
    }))
}

fn hang(weight: &Payload) -> String {
    let [x, y, z] = weight.at_m;
    format!(
        "weigh `{0}`, or hang a known weight on it ({1:.0} g at [{x:.3}, {y:.3}, {z:.3}] m of its frame, say so in the map or log.toml: [[payload]]), and ",
        weight.link,
        1e3 * weight.mass_kg
    )
}

/// Weights to hang on the links that the first model or another one makes heavier where the other of the two changes
/// something else.
fn known_weights(model: &RobotModel, models: &[Variant]) -> Vec<Payload> {
    let Some((own, others)) = models.split_first() else { return Vec::new() };
    let weighs = |t: &&Term| t.effect.layer == Layer::Inertia && t.place.domain == Domain::Links;
    let of = |a: &Variant, b: &Variant| {
        let not_in = |t: &&Term| !b.iter().any(|o| o.effect == t.effect);
        a.iter().filter(weighs).find(not_in).and_then(|t| t.place.items.first().copied())
    };
    let mut links: Vec<usize> = (others.iter())
        .filter_map(|other| match (of(own, other), of(other, own)) {
            (Some(l), None) | (None, Some(l)) => Some(l),
            _ => None,
        })
        .collect();
    links.sort_unstable();
    links.dedup();
    links.into_iter().filter_map(|l| weight_on(model, l)).collect()
}

/// The weight to hang on link `l`.
fn weight_on(model: &RobotModel, l: usize) -> Option<Payload> {
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
            // the gain is the one that is noted, not the file's
            for (joint, noted) in excited.joints.iter_mut().zip(&context.excitation.joints) {
                joint.kd_nms_per_rad = noted.kd_nms_per_rad;
            }
            let seen = || (effect.unseen)(&excited, &place).is_none();
            trial.excites.iter().any(|e| e == effect.id) && seen()
        };
        if let Some(told) = most_telling(context, &pair, made_for, &[])? {
            return Ok(Some(NextExperiment {
                trial: told.trial,
                reason: format!(
                    "{} could not be seen: {why}; in this trial one of middling size would show by {}",
                    effect.id, told.apart
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
    let best = most_telling(context, &pair, |_| true, &[])?;
    Ok(best.map(|told| NextExperiment {
        trial: told.trial,
        joints: term.place.names.clone(),
        reason: format!("{why} they would differ by {}", told.apart),
        separates: vec![term.effect.id.to_owned()],
        ..NextExperiment::default()
    }))
}

/// A trial and what it tells.
struct Telling {
    trial: String,
    /// With this weight.
    weight: Option<Payload>,
    /// Which of the other models it tells from the first one.
    from: Vec<usize>,
    /// By how much the one of these that it tells least.
    apart: String,
}

/// The trial that is not in the logs, as the robot is or with one of `weights`, that tells most of `models` from the
/// first of them, by a tolerance or more in a channel that the runs have; of such trials one without a weight, and of
/// these the one that does it best. None where none tells any.
fn most_telling(
    context: &Context,
    models: &[Variant],
    among: impl Fn(&excite::Trial) -> bool,
    weights: &[Payload],
) -> Result<Option<Telling>, GapError> {
    let model = context.replayer.model();
    let Ok(battery) = excite::battery(model, None, DEFAULT_RATE_HZ) else {
        return Ok(None);
    };
    let mut best: Option<((usize, bool, f64), Telling)> = None;
    let trials = battery.iter().filter(|t| t.duration_s <= LONGEST_S && among(t));
    // a weight is not let fall
    let hung = |t: &&excite::Trial| if t.on.is_empty() { weights } else { &[] };
    let recipes = trials.flat_map(|t| {
        std::iter::once((t, None)).chain(hung(&t).iter().map(move |weight| (t, Some(weight))))
    });
    for (trial, weight) in recipes {
        let run = asked_for(context, trial, weight);
        let runs = context.fit.data.trials.iter().chain(&context.holdout.data.trials);
        if is_recorded(model, runs, trial, &run, weight.is_some()) {
            continue;
        }
        let data = Data::new(model, vec![run], SegmentOptions::default());
        let predictions = context.replayer.predict(&data, models)?;
        let mut from = Vec::new();
        let mut least = (f64::INFINITY, String::new());
        for (other, prediction) in predictions[1..].iter().enumerate() {
            let (tolerances, apart) = differ(context, &data, &predictions[0], prediction);
            if tolerances >= 1.0 {
                from.push(other);
                if tolerances < least.0 {
                    least = (tolerances, apart);
                }
            }
        }
        let score = (from.len(), weight.is_none(), least.0);
        if !from.is_empty() && best.as_ref().is_none_or(|b| score > b.0) {
            let (trial, weight) = (trial.name.clone(), weight.cloned());
            best = Some((score, Telling { trial, weight, from, apart: least.1 }));
        }
    }
    Ok(best.map(|(_, told)| told))
}

/// By how many tolerances two predictions of `data` differ in the channel in which they differ most (root mean square),
/// and by how much in words.
fn differ(context: &Context, data: &Data, one: &[f32], other: &[f32]) -> (f64, String) {
    let model = context.replayer.model();
    let mut most = (0.0, String::new());
    for piece in data.pieces() {
        let Some(tolerance) = tolerance(model, piece) else { continue };
        let off = |k: usize| f64::from(one[k] - other[k]).powi(2);
        let square: f64 = piece.range.clone().map(off).sum();
        let apart = (square / piece.range.len().max(1) as f64).sqrt();
        if apart / tolerance > most.0 {
            let unit = piece.kind.unit_at(model, piece.index);
            let joint = match piece.kind.of_joint() {
                true => format!(".{}", model.actuated_names()[piece.index]),
                false => String::new(),
            };
            let told = format!("{:.1} m{unit} ({}{joint})", 1e3 * apart, piece.kind.name());
            most = (apart / tolerance, told);
        }
    }
    most
}

/// `trial` under the conditions of the first run that was held as it is, of those without a weight if there are any,
/// with this weight.
fn asked_for(context: &Context, trial: &excite::Trial, weight: Option<&Payload>) -> Trial {
    let mut kinds = measured(context.replayer.model(), trial, true);
    kinds.retain(|kind| context.excitation.has(*kind));
    let mut own = as_run(trial, &kinds);
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
        let hung = |a: &str, b: &str| known_weights(&model, &[one(a), one(b)]);
        let weight = hung("point_mass", "torque_constant").pop().unwrap();
        // 0.1 m to the centre, 1.3 of that to the weight; a quarter of 0.77 N·m carries 0.1925/(9.81·0.13)
        // = 0.151 kg there, less than half of 0.49 kg
        assert_eq!((weight.link.as_str(), weight.mass_kg), ("arm", 0.15));
        assert!((weight.at_m[2] + 0.13).abs() < 1e-9, "{weight:?}");
        assert_eq!(hung("torque_constant", "point_mass"), std::slice::from_ref(&weight));
        // whichever of the alternatives it is
        let among = ["torque_constant", "kp_error", "point_mass", "link_mass"].map(one);
        assert_eq!(known_weights(&model, &among), [weight]);
        // two masses, and none
        assert!(hung("point_mass", "link_mass").is_empty());
        assert!(hung("kp_error", "torque_constant").is_empty());
    }
}
