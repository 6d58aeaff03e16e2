//! The verdict and the report.

use std::collections::BTreeMap;

use caudata_model::RobotModel;

use super::alike::{indistinguishable, wider};
use super::carried::Model;
use super::constancy::scatter;
use super::divergence::divergence;
use super::doubt::{Doubts, meet, sizes};
use super::extend::extended;
use super::fits::fitted;
use super::floors::floors;
use super::levels::NOTHING_LEFT;
use super::local::local_gaps;
use super::naming::{self, Named};
use super::request::{Diagnosis, Request, Split};
use super::search::Found;
use super::spread::{Spread, amounts, beside, correlation, intervals, spread, widen};
use super::state::{Context, On, State};
use super::synonyms::synonyms;
use super::tracking::Tracking;
use super::words::{self, evidence, summary};
use super::{gates, leftover, next, pictures};
use crate::effects::Place;
use crate::error::GapError;
use crate::extension::Extension;
use crate::plots::Plots;
use crate::replay::Term;
use crate::report::{Cause, Gain, Grounds, LocalGap, Parameter, Rejected, Report, RunUse, Verdict};
use crate::trial::Kind;

/// The report of a diagnosis that stops at its data.
pub fn data_fault(request: &Request, model: &RobotModel, runs: Vec<RunUse>) -> Diagnosis {
    let first = request.data_faults.iter().find(|f| f.fatal);
    let what =
        first.map_or_else(String::new, |f| format!("{} of {}: {}", f.kind, f.location, f.detail));
    Diagnosis {
        report: Report {
            verdict: Verdict::DataFault,
            summary: format!("The data contradict themselves before any physics: {what}"),
            data_faults: request.data_faults.clone(),
            runs,
            ..Report::default()
        },
        extension: Extension { base: model.hash_hex(), ..Extension::default() },
        plots: Plots::default(),
    }
}

/// What a conclusion is drawn from.
pub struct Evidence<'a> {
    /// What the search found.
    pub found: &'a Found,
    /// Its causes with their names.
    pub named: &'a [Named],
    /// The model of the extended file.
    pub carried: &'a Model,
    /// Models of angles alone.
    pub tracking: &'a Tracking,
    /// Whether time ended before everything was tried.
    pub unfinished: bool,
}

/// Causes and leads, strongest first, and what is doubtful about them.
struct Told {
    all: Vec<Cause>,
    are_leads: Vec<bool>,
    doubts: Doubts,
    spread: Spread,
}

fn told_of(context: &Context, found: &Found, named: &[Named]) -> Result<Told, GapError> {
    let (base, best) = (&found.base, &found.best);
    let derivatives = context.derivatives(&best.terms)?;
    let spread = spread(context, best, &derivatives);
    let indices: Vec<usize> = named.iter().map(|n| n.index).collect();
    let mut scatter = scatter(context, best, &derivatives, &indices);
    scatter.retain(|s| s.share > context.calibration.map.doubts.scatter);
    let inconstant: Vec<usize> = scatter.iter().map(|s| s.term).collect();
    let are_leads = naming::leads(context, best, named, &inconstant);
    let leads = indices.iter().zip(&are_leads).filter(|(_, lead)| **lead);
    let leads: Vec<usize> = leads.map(|(index, _)| *index).collect();
    let doubts = match leads.is_empty() {
        true => Doubts::about(context, base, best, (best, &derivatives))?,
        false => {
            let findings = without(context, best, &leads)?;
            let own = context.derivatives(&findings.terms)?;
            Doubts::about(context, base, best, (&findings, &own))?
        }
    };
    let lacks_size =
        |n: &Named| scatter.iter().find(|s| s.term == n.index).map_or(0.0, |s| s.share);
    let told = named.iter().zip(&are_leads).map(|(n, lead)| {
        let own = if *lead { lacks_size(n) } else { 0.0 };
        cause(context, best, n, &spread, (&doubts, own))
    });
    let mut all = told.collect::<Result<Vec<_>, _>>()?;
    for (cause, own) in all.iter_mut().zip(named) {
        widen(cause, &best.terms[own.index], best, named);
    }
    Ok(Told { all, are_leads, doubts, spread })
}

/// `best` without the terms `leads`, fitted again.
fn without(context: &Context, best: &State, leads: &[usize]) -> Result<State, GapError> {
    let kept = best.terms.iter().enumerate().filter(|(k, _)| !leads.contains(k));
    let mut state = fitted(context, kept.map(|(_, t)| t.clone()).collect(), None)?;
    let held_out = context.replayer.predict(&context.holdout.data, &[state.terms.clone()])?;
    state.holdout = On::new(&context.holdout, held_out.concat());
    Ok(state)
}

/// Draws the conclusion.
pub fn conclude(
    request: &Request,
    context: &Context,
    evidence: &Evidence<'_>,
    runs: Vec<RunUse>,
    split: Split,
) -> Result<Diagnosis, GapError> {
    let (found, named, carried) = (evidence.found, evidence.named, evidence.carried);
    let (base, best, model) = (&found.base, &found.best, &carried.state);
    let Told { all, are_leads, doubts, spread } = told_of(context, found, named)?;
    let losses = (context.losses.as_ref()).map(|l| l.cause(context.calibration.surest));
    let entries = carried.entries(context, &all);
    let extension = extended(request, context, &model.terms, &entries, losses.as_ref());
    let mut are_leads = are_leads.into_iter();
    let (leads, mut causes): (Vec<Cause>, Vec<Cause>) =
        all.into_iter().partition(|_| are_leads.next() == Some(true));
    causes.splice(0..0, losses); // first what is measured: the rest is found with it
    let mut unexplained = leftover::leftover(context, found);
    let local = local_gaps(context, &model.fit, &model.holdout);
    let verdict = verdict(context, found, &causes, &doubts, split, &local);
    if verdict == Verdict::Ambiguous && !evidence.unfinished {
        count_synonyms(context, &mut causes, best, named)?;
    }
    let next_experiment = next::next(
        context,
        request,
        verdict,
        &causes,
        (found, named),
        &local,
        evidence.unfinished,
    )?;
    let tells = words::what_tells(verdict, &causes, next_experiment.as_ref(), evidence.unfinished);
    let told = (&causes[..], &leads[..], tells);
    let known = (verdict, evidence.unfinished);
    let told = summary(context, known, told, &doubts, &unexplained, split, found);
    let errors = evidence.tracking.errors(context, &model.terms)?;
    let listed = carried.listed(&entries);
    let first = words::first(verdict, &carried.state, &errors, evidence.unfinished);
    let assumed = words::assumed(verdict, &request.data_faults);
    let last = words::last(verdict, &causes, &extension.effect, &listed, &local);
    let gain = gain(context, base, model);
    let summary = [first, told, assumed, words::farther(&gain), last].concat();
    let in_part = matches!(verdict, Verdict::PartlyExplained | Verdict::Unexplained);
    unexplained.retain(|_| in_part);
    let mut plots = pictures::plots(context, found, model, named);
    plots.correlation = correlation(best, &spread);
    Ok(Diagnosis {
        report: Report {
            verdict,
            summary,
            divergence: divergence(context, &base.holdout),
            divergence_after: match !model.terms.is_empty() || context.losses.is_some() {
                true => divergence(context, &model.holdout),
                false => Vec::new(),
            },
            doubts: match causes.is_empty() {
                true => Vec::new(),
                false => doubts.listed(),
            },
            gain,
            position_errors: errors,
            model: listed,
            unfinished: evidence.unfinished,
            unexplained,
            next_experiment,
            local_gaps: local,
            detection_floor: floors(context, &found.first, best.misfit()),
            causes,
            leads,
            runs,
            ..Report::default()
        },
        extension,
        plots,
    })
}

fn verdict(
    context: &Context,
    found: &Found,
    causes: &[Cause],
    doubts: &Doubts,
    split: Split,
    local: &[LocalGap],
) -> Verdict {
    let base = &found.base;
    if causes.is_empty() {
        if gates::no_gap(context, base) {
            if !local.is_empty() {
                return Verdict::Unexplained;
            }
            let dark = context.excitation.joints.iter().all(|j| j.fastest_radps < 0.02);
            return if dark { Verdict::InsufficientData } else { Verdict::NoGap };
        }
        // something explains the runs it was fitted to, and held-out runs do not show it
        let unseen = found.refused.iter().any(|(s, w)| {
            w.fit > 0.5 * (base.fit.misfit - 1.0)
                && base.holdout.misfit < NOTHING_LEFT
                && s.fit.misfit < base.fit.misfit
        });
        return if unseen || split == Split::Same {
            Verdict::InsufficientData
        } else {
            Verdict::Unexplained
        };
    }
    if doubts.any() {
        return Verdict::PartlyExplained;
    }
    if causes.iter().any(Cause::is_open) { Verdict::Ambiguous } else { Verdict::Explained }
}

/// A law earns a parameter more where it is so many times as likely as its special case: the square root of how many
/// errors tell them apart ([`ERRORS_OF_LAW`]; Schwarz 1978, doi:10.1214/aos/1176344136).
const EARNS_A_PARAMETER: f64 = 3.6;

/// What the rivals of a cause come to.
#[derive(Default)]
struct Weighed<'a> {
    /// Names that are as good.
    alternatives: Vec<String>,
    /// Pairs of names that are together, and not alone.
    together: Vec<Vec<String>>,
    rejected: Vec<Rejected>,
    /// Probability of the name, wherever it is.
    same_name: f64,
    /// Probability of the names of its kind that these runs do not tell from it.
    alike: f64,
    /// Other places of the same name.
    elsewhere: Vec<Vec<String>>,
    /// Alternatives that may be there as well.
    open: Vec<&'a Term>,
}

impl Weighed<'_> {
    /// Probability of the name or one of its kind that these runs do not tell from it.
    fn of_one_kind(&self) -> f64 {
        self.same_name + self.alike
    }
}

/// What the rivals of the cause in `named` come to, of which `synonyms` are one robot with it.
fn weigh<'a>(best: &State, named: &'a Named, synonyms: &[String]) -> Weighed<'a> {
    let term = &best.terms[named.index];
    let mut out = Weighed { same_name: named.probability, ..Weighed::default() };
    for rival in &named.rivals {
        let other = &rival.state.terms[rival.index];
        if other.effect == term.effect {
            out.same_name += rival.probability;
            if rival.in_set && another(&term.place, &other.place) {
                out.elsewhere.push(other.place.names.clone());
            }
            continue;
        }
        let id = other.effect.id.to_owned();
        if wider(term.effect, other.effect) {
            // what speaks for the wider one there speaks for its special case, unless it earns what it has more
            let earns = rival.probability > EARNS_A_PARAMETER * named.probability;
            if meet(&term.place, &other.place) && !earns {
                out.same_name += rival.probability.min(named.probability);
            }
            let reason = format!(
                "says the same with more parameters, and nothing more: misfit {:.2} against {:.2}",
                rival.state.misfit(),
                best.misfit()
            );
            out.rejected.push(Rejected { effect: id, reason });
        } else if rival.in_set {
            // two names for the very same motions are one hypothesis, as far as these runs go, if they are of
            // one kind: a delay is a delay, and less torque is no more weight
            let same = indistinguishable(best, &rival.state);
            if synonyms.contains(&id) {
                out.same_name += rival.probability;
            } else if same && other.effect.layer == term.effect.layer {
                out.alike += rival.probability;
            }
            if !out.alternatives.contains(&id) {
                out.alternatives.push(id);
                if !same {
                    // it may be there as well; of two names for the same motions one is enough
                    out.open.push(other);
                }
            }
        } else if !out.alternatives.contains(&id) && !out.rejected.iter().any(|r| r.effect == id) {
            let reason = format!(
                "in its place, refitted, it {} of what {} explains (misfit {:.2} against {:.2})",
                words::leaves(rival.short),
                term.effect.id,
                rival.state.misfit(),
                best.misfit()
            );
            out.rejected.push(Rejected { effect: id, reason });
        }
    }
    for pair in &named.pairs {
        let two = pair.terms();
        let ids: Vec<String> = two.iter().map(|t| t.effect.id.to_owned()).collect();
        let of_layer = two.iter().all(|t| t.effect.layer == term.effect.layer);
        if ids.iter().all(|id| synonyms.contains(id)) {
            out.same_name += pair.probability;
        } else if of_layer {
            out.alike += pair.probability;
        }
        out.together.push(ids);
    }
    let mut of_pairs = out.together.concat();
    of_pairs.retain(|id| !out.alternatives.contains(id));
    of_pairs.sort();
    of_pairs.dedup();
    out.alternatives.extend(of_pairs);
    out.alternatives.extend(named.untried.iter().map(|id| (*id).to_owned()));
    out
}

fn cause(
    context: &Context,
    best: &State,
    named: &Named,
    spread: &Spread,
    (doubts, own_scatter): (&Doubts, f64),
) -> Result<Cause, GapError> {
    let term = &best.terms[named.index];
    let weighed = weigh(best, named, &[]);
    let wider = match weighed.open.is_empty() {
        true => Vec::new(),
        false => beside(context, best, named.index, &weighed.open, spread)?,
    };
    let amounts = amounts(context, best, named.index)?;
    let parameters = intervals(context, best, named.index, spread, (&wider, &amounts));
    let sizes = (&parameters, &amounts[..]);
    let mut grounds = grounds(context, named, term, weighed.of_one_kind(), sizes, doubts);
    grounds.scatter = grounds.scatter.max(own_scatter);
    let confidence = confidence(context, &grounds, &weighed);
    Ok(Cause {
        effect: term.effect.id.to_owned(),
        layer: term.effect.layer.name().to_owned(),
        location: term.place.names.clone(),
        parameters,
        confidence: confidence.name,
        confidence_of_kind: confidence.kind,
        alternatives: weighed.alternatives,
        together: weighed.together,
        synonyms: Vec::new(),
        elsewhere: weighed.elsewhere,
        evidence: evidence(context, term, named),
        rejected: weighed.rejected,
        assumed: (term.effect).assumed(context.replayer.model(), &term.place),
        grounds,
    })
}

/// Finds what is one robot with each of `causes`, which counts for its name.
fn count_synonyms(
    context: &Context,
    causes: &mut [Cause],
    best: &State,
    named: &[Named],
) -> Result<(), GapError> {
    for cause in causes {
        if let Some(own) = named.iter().find(|n| n.is(best, cause)) {
            cause.synonyms = synonyms(context, cause, best, own)?;
            let weighed = weigh(best, own, &cause.synonyms);
            let confidence = confidence(context, &cause.grounds, &weighed);
            cause.confidence = confidence.name;
            cause.confidence_of_kind = confidence.kind;
        }
    }
    Ok(())
}

/// Confidence in a name, and that it or one of its kind that the runs do not tell from it is right.
struct Confidence {
    name: f64,
    kind: f64,
}

/// No more than the share among those that say the same.
fn confidence(context: &Context, grounds: &Grounds, weighed: &Weighed<'_>) -> Confidence {
    let kind = context.calibration.confidence(grounds).min(weighed.of_one_kind());
    Confidence { name: kind * weighed.same_name / weighed.of_one_kind().max(1e-9), kind }
}

/// What the confidence in a name of `term`, of probability `among` among its look-alikes, rests on.
fn grounds(
    context: &Context,
    named: &Named,
    term: &Term,
    among: f64,
    sizes: (&BTreeMap<String, Parameter>, &[f64]),
    doubts: &Doubts,
) -> Grounds {
    let near = doubts.grounds(context, &term.place);
    Grounds {
        among_look_alikes: among,
        gain: named.worth.cross / named.worth.of.max(1e-9),
        distance: distance(context, term, sizes),
        at_bound: near.at_bound
            || sizes.0.values().any(|p| p.at_bound)
            || doubts.is_taken_back(term),
        ..near
    }
}

/// How far the size of `term` is from no effect, in halves of its 95 % interval: `amounts` of its parameters.
fn distance(
    context: &Context,
    term: &Term,
    (parameters, amounts): (&BTreeMap<String, Parameter>, &[f64]),
) -> f64 {
    let neutral = term.neutral(context.replayer.model());
    let of = |p: usize| {
        let of = &parameters[term.effect.parameters[p].name];
        let end = if of.value < neutral[p] { of.ci_high } else { of.ci_low };
        amounts[p] / (of.value - end).abs().max(f64::MIN_POSITIVE)
    };
    sizes(term.effect).map(of).fold(0.0, f64::max).min(1e3)
}

/// Whether two places of one effect are alike and have nothing in common: one hinge and another one, not one
/// and all.
fn another(one: &Place, other: &Place) -> bool {
    one.domain == other.domain
        && one.items.len() == other.items.len()
        && one.items.iter().all(|i| !other.items.contains(i))
}

/// Error of each kind of channel on held-out runs before and after.
fn gain(context: &Context, base: &State, best: &State) -> BTreeMap<String, Gain> {
    let data = &context.holdout.data;
    // sums of squares by block, and samples
    let mut of: BTreeMap<Kind, (Vec<[f64; 2]>, f64)> = BTreeMap::new();
    for piece in data.pieces() {
        let (squares, n) =
            of.entry(piece.kind).or_insert_with(|| (vec![[0.0; 2]; data.blocks], 0.0));
        for k in piece.range.clone() {
            for (sum, on) in squares[data.block[k] as usize].iter_mut().zip([base, best]) {
                *sum += (data.value[k] - f64::from(on.holdout.prediction[k])).powi(2);
            }
            *n += 1.0;
        }
    }
    let of_kind = |(kind, (squares, n)): (Kind, (Vec<[f64; 2]>, f64))| {
        let rms = |i: usize| (squares.iter().map(|s| s[i]).sum::<f64>() / n).sqrt();
        let (before, after) = (rms(0), rms(1));
        let ratios = gates::resampled(squares.len(), context.seed, |drawn| {
            let sum = |i: usize| drawn.iter().map(|k| squares[*k][i]).sum::<f64>();
            (sum(1) / sum(0).max(1e-300)).sqrt()
        });
        let [ci_low, ci_high] = [0.025, 0.975].map(|share| gates::at(&ratios, share));
        let ratio = after / before.max(1e-12);
        (kind.name().to_owned(), Gain { before, after, ratio, ci_low, ci_high })
    };
    of.into_iter().map(of_kind).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::effects::Domain;

    fn at(items: &[usize]) -> Place {
        Place {
            domain: Domain::Joints,
            items: items.to_vec(),
            names: items.iter().map(usize::to_string).collect(),
        }
    }

    #[test]
    fn one_hinge_and_another_are_two_places_and_one_of_all_is_not() {
        assert!(another(&at(&[1]), &at(&[2])));
        assert!(!another(&at(&[1]), &at(&[1])));
        assert!(!another(&at(&[1]), &at(&[0, 1, 2])));
        assert!(!another(&at(&[0, 1]), &at(&[1, 2])));
    }

    #[test]
    fn rivals_are_told_with_their_places() {
        let mut cause = Cause {
            effect: "girdle_play".to_owned(),
            location: vec!["hind".to_owned()],
            ..Cause::default()
        };
        assert!(!cause.is_open());
        cause.elsewhere = vec![vec!["front".to_owned()]];
        assert!(cause.is_open());
        assert_eq!(cause.rivals(), "girdle_play at hind or at front");
        cause.alternatives = vec!["payload".to_owned()];
        assert_eq!(cause.rivals(), "girdle_play at hind or at front or payload");
        cause.elsewhere.clear();
        assert_eq!(cause.rivals(), "girdle_play or payload");
        cause.alternatives = ["payload", "armature", "link_mass"].map(str::to_owned).to_vec();
        cause.together = vec![["link_mass", "armature"].map(str::to_owned).to_vec()];
        assert_eq!(cause.rivals(), "girdle_play or payload or link_mass with armature");
    }
}
