//! The search for causes: add the best, refit all, try to delete, try look-alikes; a beam of candidates side by side.
//!
//! Which of several look-alikes it is may show only when the next cause, or the one after it, stands beside it. So where much is left, look-alikes of what
//! was found go on beside it as lines of their own, each in the place of what it looks like; what a line adds must be worth it there, and a line takes
//! over when it has become better than the best so far by the same gates.
//!
//! Two causes that make up for each other (a motor that is stronger than its manual says, and saturates) each do little alone. So where much is left, the
//! candidate that explains most of those whose gain on held-out runs is not certain yet goes on as a line too.

use std::collections::BTreeSet;

use super::alike::{look_alike, wider};
use super::gates::{self, Worth};
use super::levels::NOTHING_LEFT;
use super::refine::{Race, refine};
use super::request::{Progress, Stage};
use super::screen::{Screened, screen};
use super::state::{Context, State, builds_up};
use crate::effects::{Effect, Place};
use crate::error::GapError;
use crate::replay::{Term, Variant};

/// Most effects at once.
pub const MOST_TERMS: usize = 8;
/// Candidates that are kept side by side.
const BEAM: usize = 2;
/// Lines with a look-alike in the place of one effect that go on beside them where much is left.
const LOOK_ALIKES: usize = 3;
/// Most that a line's misfit may be, in that of the best.
const LINE_FAR_BEHIND: f64 = 2.5;
/// Candidates that were fitted to a scout and are fitted to everything as well.
const POLISHED: usize = 4;
/// Steps of that.
const POLISHING: usize = 2;
/// Steps of the last fit.
const LAST_STEPS: usize = 12;
/// Screened candidates that are fitted in earnest, per state.
const FITTED: usize = 12;
/// The same once something was found.
const FITTED_LATER: usize = 6;
/// Places of one effect among them.
const PLACES: usize = 2;
/// A candidate whose misfit is so many times that of the best is given up.
const FAR_BEHIND: f64 = 1.5;
/// A further effect must explain this share of what the robot as given fails to: what a model lacks in detail grows with what it has
/// (unless the misfit is still far from the floor).
const OF_ALL: f64 = 0.035;
/// … and where the misfit is above this many floors, which no detail of a law comes to, …
const MUCH: f64 = 2.5;
/// … this share of what is left.
const OF_REST: f64 = 0.12;
/// What an additional parameter must earn: share of the misfit.
pub const PER_PARAMETER: f64 = 0.015;

/// A model that goes on beside the best.
struct Line {
    state: State,
    /// What it does without: the effect that a look-alike stands for, and those that say the same and more.
    without: Vec<&'static Effect>,
    /// Whether the look-alike is one that says the same and more.
    says_more: bool,
}

/// What the search found.
pub struct Found {
    /// The robot as given.
    pub base: State,
    /// The best that passed.
    pub best: State,
    /// Screening on top of the robot as given.
    pub first: Vec<Screened>,
    /// Single effects that were fitted to what the robot as given leaves, best first, with what they are worth.
    pub singles: Vec<(State, Worth)>,
    /// Effects whose gates failed only on held-out runs, on top of the best.
    pub refused: Vec<(State, Worth)>,
    /// Effects tried.
    pub tried: usize,
}

/// Searches.
///
/// # Errors
/// As [`crate::replay::Replayer::predict`].
pub fn search(
    context: &mut Context,
    progress: &mut dyn FnMut(Progress),
) -> Result<Found, GapError> {
    let mut base = single(context, Vec::new())?;
    let mut beam = vec![base.clone()];
    let mut lines: Vec<Line> = Vec::new();
    let mut best = base.clone();
    let mut first = Vec::new();
    let mut singles: Vec<(State, Worth)> = Vec::new();
    let mut refused: Vec<(State, Worth)> = Vec::new();
    let mut tried = 0;
    for depth in 1..=MOST_TERMS {
        if depth > 1 {
            if gates::worst(context, &best) < gates::quiet(context) {
                break;
            }
            // what runs differ by grows with what was found: more friction drifts by more
            rebase(context, &best.terms.clone(), &mut [&mut base, &mut best])?;
            let of_lines = lines.iter_mut().map(|l| &mut l.state);
            let mut all: Vec<&mut State> = beam.iter_mut().chain(of_lines).collect();
            reread(context, &mut all)?;
        }
        let mut children: Vec<(State, Worth, usize)> = Vec::new();
        let mut seen: BTreeSet<Vec<String>> = BTreeSet::new();
        let firsts = beam.len();
        let parents = beam.iter().chain(lines.iter().map(|l| &l.state));
        for (number, parent) in parents.enumerate() {
            progress(Progress::new(Stage::Screening, depth, &parent.label()));
            let mut screened = screen(context, parent)?;
            if number >= firsts {
                screened.retain(|s| !lines[number - firsts].without.contains(&s.effect));
            }
            tried += screened.len();
            let chosen = choose(&screened, if depth == 1 { FITTED } else { FITTED_LATER });
            progress(Progress::new(Stage::Fitting, depth, &parent.label()));
            for child in expand(context, parent, &chosen, &mut seen)? {
                let place = last_place(&child);
                let worth = gates::worth(context, parent, &child, place);
                children.push((child, worth, number));
            }
            if depth == 1 {
                first = screened;
            }
        }
        children.sort_by(|a, b| penalised(context, &a.0).total_cmp(&penalised(context, &b.0)));
        if depth == 1 {
            singles = children.iter().map(|(s, w, _)| (s.clone(), *w)).collect();
        }
        let good = |(s, w, _): &&(State, Worth, usize)| {
            w.passed
                && enough(context, w, &base, last_place(s))
                && s.terms.last().is_some_and(|t| gates::matters(context, t))
        };
        let passed: Vec<State> = children
            .iter()
            .filter(|c| match c.2 < firsts {
                true => good(c),
                false => overtakes(context, &base, &best, c, good(c)),
            })
            .map(|(s, _, _)| s.clone())
            .collect();
        let mut going_on: Vec<Line> = Vec::new();
        for (k, line) in lines.drain(..).enumerate() {
            let mut own = children.iter().filter(|c| c.2 == firsts + k);
            if let Some((state, _, _)) = own.find(|c| good(c)) {
                going_on.push(Line {
                    state: state.clone(),
                    ..line
                });
            }
        }
        if gates::worst(context, &best) >= MUCH {
            going_on.extend(promising(&children, firsts));
        }
        if firsts > 0 {
            refused = children
                .into_iter()
                .filter(|(_, w, number)| *number < firsts && !w.passed && w.fit > 0.0)
                .map(|(s, w, _)| (s, w))
                .take(8)
                .collect();
        }
        let leader = passed
            .first()
            .filter(|s| penalised(context, s) < penalised(context, &best));
        let Some(leader) = leader else {
            // the best stays; lines may still overtake it
            beam.clear();
            lines = chosen_lines(context, &best, &[], going_on)?;
            if lines.is_empty() {
                break;
            }
            continue;
        };
        best = leader.clone();
        best = delete(context, &base, best)?;
        let mut next = passed;
        next.truncate(BEAM);
        if best.key() != next[0].key() {
            next.insert(0, best.clone());
            next.truncate(BEAM);
        }
        for state in &mut next {
            context.find_basis(state)?;
        }
        if depth > 1 || next.len() > 1 {
            // one that is far behind cannot catch up by a single effect more often than it costs
            let lead = next[0].misfit();
            next.retain(|s| s.misfit() < FAR_BEHIND * lead);
        }
        if gates::worst(context, &best) < NOTHING_LEFT {
            // what is still to be found is small: one way is enough
            next.truncate(1);
        }
        if gates::worst(context, &best) >= NOTHING_LEFT && depth < MOST_TERMS {
            let others = look_alikes(context, &base, &first, &best)?;
            if let Some(other) = others.first()
                && !other.says_more
                && penalised(context, &other.state) < penalised(context, &best)
                && gates::worth(context, &best, &other.state, None).low > 0.0
            {
                // it is the better name: the one that was found first is the look-alike
                let earlier = std::mem::replace(&mut best, other.state.clone());
                next.retain(|s| s.key() != earlier.key());
                next.insert(0, best.clone());
                context.find_basis(&mut next[0])?;
            }
            going_on.extend(others);
            lines = chosen_lines(context, &best, &next, going_on)?;
        }
        beam = next;
        progress(Progress::new(Stage::Accepted, depth, &best.label()));
    }
    if !best.terms.is_empty() {
        rebase(context, &best.terms.clone(), &mut [&mut base, &mut best])?;
        // the metric has changed: what is deleted is compared with what is fitted by the new one, and must be as well
        best = polished(context, best)?;
        let terms = best.terms.len();
        best = delete(context, &base, best)?;
        if best.terms.len() < terms {
            best = polished(context, best)?;
        }
    }
    Ok(Found {
        base,
        best,
        first,
        singles,
        refused,
        tried,
    })
}

/// `state` fitted to everything by the present metric.
fn polished(context: &Context, state: State) -> Result<State, GapError> {
    let terms = vec![state.terms.clone()];
    let mut fitted = refine(context, &context.fit, terms, Some(LAST_STEPS), None)?;
    let fitted = single(context, fitted.swap_remove(0).0)?;
    Ok(if fitted.fit.misfit <= state.fit.misfit {
        fitted
    } else {
        state
    })
}

/// Where the effect that was added last is.
fn last_place(state: &State) -> Option<&Place> {
    state.terms.last().map(|t| &t.place)
}

/// Whether the child of a line, whose parent was not better than `best`, is: by what it adds to its parent (`good`) and certainly ahead of the best, or by
/// all gates between the best and itself, whatever its steps were worth one by one.
fn overtakes(
    context: &Context,
    base: &State,
    best: &State,
    child: &(State, Worth, usize),
    good: bool,
) -> bool {
    let state = &child.0;
    if penalised(context, state) >= penalised(context, best) {
        return false;
    }
    let ahead = gates::worth(context, best, state, None);
    let new = |t: &&Term| {
        !best
            .terms
            .iter()
            .any(|b| b.effect == t.effect && b.place == t.place)
    };
    let mut added = state.terms.iter().filter(new);
    let mut whole = || {
        ahead.passed
            && enough(context, &ahead, base, None)
            && added.all(|t| gates::matters(context, t))
    };
    ahead.low > 0.0 && (good || whole())
}

/// Whether a further effect at `place` explains enough to be one.
fn enough(context: &Context, worth: &Worth, base: &State, place: Option<&Place>) -> bool {
    let all = gates::part(&context.holdout, &base.holdout, place);
    let fitted = || gates::part(&context.fit, &base.fit, place);
    worth.holdout > OF_ALL * all
        || (worth.beyond_doubt && worth.fit > OF_ALL * fitted())
        || worth.of > gates::FAR
        || (worth.of > MUCH && worth.holdout > OF_REST * worth.of)
}

/// The first of `children`, which come best first with their worth and the number of their parent, that gains on all runs and is not sure to on held-out
/// ones, if it is ahead of every child of the first `firsts` parents that is sure to.
fn promising(children: &[(State, Worth, usize)], firsts: usize) -> Option<Line> {
    let (state, _, _) = (children.iter())
        .take_while(|(_, w, number)| *number >= firsts || !w.passed)
        .find(|(_, w, _)| !w.passed && w.fit > 0.0 && w.holdout > 0.0)?;
    Some(Line {
        state: state.clone(),
        without: Vec::new(),
        says_more: false,
    })
}

/// Takes the tolerances around `terms`, and judges `states` by them.
fn rebase(
    context: &mut Context,
    terms: &[Term],
    states: &mut [&mut State],
) -> Result<(), GapError> {
    context.fit.set_base(&context.replayer, terms)?;
    context.holdout.set_base(&context.replayer, terms)?;
    if let Some(scout) = &mut context.scout {
        scout.judge.set_base(&context.replayer, terms)?;
    }
    reread(context, states)
}

/// Judges states again by the present metric.
fn reread(context: &Context, states: &mut [&mut State]) -> Result<(), GapError> {
    for state in states {
        let had_basis = !state.basis.is_empty();
        state.fit = super::state::On::new(&context.fit, std::mem::take(&mut state.fit.prediction));
        state.holdout = super::state::On::new(
            &context.holdout,
            std::mem::take(&mut state.holdout.prediction),
        );
        if let (Some(scout), Some(on)) = (&context.scout, &mut state.scout) {
            *on = super::state::On::new(&scout.judge, std::mem::take(&mut on.prediction));
        }
        if had_basis {
            context.find_basis(state)?;
        }
    }
    Ok(())
}

/// A candidate with its predictions.
///
/// # Errors
/// As [`crate::replay::Replayer::predict`].
pub fn single(context: &Context, terms: Variant) -> Result<State, GapError> {
    let mut states = context.states(&[terms])?;
    Ok(states.swap_remove(0))
}

/// Misfit with what its parameters must have earned. A parameter of one joint can only earn where that joint is measured, so that it owes
/// the less the more joints there are.
#[must_use]
pub fn penalised(context: &Context, state: &State) -> f64 {
    let model = context.replayer.model();
    let joints = model.actuated().len().max(1);
    gates::misfit(context, state)
        * (1.0 + PER_PARAMETER * state.parameters(model) as f64 / joints as f64)
}

/// The most promising, not more than a few places of one effect.
fn choose(screened: &[Screened], most: usize) -> Vec<&Screened> {
    let mut chosen: Vec<&Screened> = Vec::new();
    for s in screened.iter().filter(|s| s.gain > 0.0) {
        let same = chosen.iter().filter(|c| c.effect == s.effect).count();
        if same < PLACES {
            chosen.push(s);
        }
        if chosen.len() == most {
            break;
        }
    }
    chosen
}

/// Fits `parent` with each of the chosen added, from several starts; the best fit of each.
fn expand(
    context: &Context,
    parent: &State,
    chosen: &[&Screened],
    seen: &mut BTreeSet<Vec<String>>,
) -> Result<Vec<State>, GapError> {
    let mut variants: Vec<Variant> = Vec::new();
    let mut of: Vec<usize> = Vec::new();
    let mut number = 0;
    for s in chosen {
        let mut key = parent.key();
        key.push(s.place.label(s.effect.id));
        key.sort();
        if !seen.insert(key) {
            continue;
        }
        for start in &s.starts {
            let mut terms = parent.terms.clone();
            terms.push(Term {
                effect: s.effect,
                place: s.place.clone(),
                values: start.clone(),
            });
            variants.push(terms);
            of.push(number);
        }
        number += 1;
    }
    best_fits(context, variants, &of, number, Before::of(parent))
}

/// Misfit that fits begin with.
#[derive(Clone, Copy)]
struct Before {
    /// Where candidates are looked at first.
    look: f64,
    /// On all runs to fit to.
    fit: f64,
}

impl Before {
    fn of(state: &State) -> Self {
        Self {
            look: state.on_scout().misfit,
            fit: state.fit.misfit,
        }
    }
}

/// Fits and keeps the best of each group.
fn best_fits(
    context: &Context,
    variants: Vec<Variant>,
    of: &[usize],
    groups: usize,
    before: Before,
) -> Result<Vec<State>, GapError> {
    let mut best: Vec<Option<(Variant, f64)>> = vec![None; groups];
    for (whole, judge, from) in [
        (false, context.first_look(), before.look),
        (true, &context.fit, before.fit),
    ] {
        let slow = |v: &Variant| context.scout.is_some() && v.iter().any(|t| builds_up(t.effect));
        let own: Vec<usize> = (0..variants.len())
            .filter(|&i| slow(&variants[i]) == whole)
            .collect();
        if own.is_empty() {
            continue;
        }
        let of: Vec<usize> = own.iter().map(|&i| of[i]).collect();
        let own = own.iter().map(|&i| variants[i].clone()).collect();
        let fitted = refine(context, judge, own, None, Some(&Race { of: &of, from }))?;
        for ((terms, cost), &g) in fitted.into_iter().zip(&of) {
            if best[g].as_ref().is_none_or(|b| cost < b.1) {
                best[g] = Some((terms, cost));
            }
        }
    }
    let variants: Vec<Variant> = best.into_iter().flatten().map(|b| b.0).collect();
    let mut states = context.states(&variants)?;
    if context.scout.is_some() {
        polish(context, &mut states)?;
    }
    Ok(states)
}

/// Fits the best of those that were fitted to a scout to everything.
fn polish(context: &Context, states: &mut [State]) -> Result<(), GapError> {
    let mut order: Vec<usize> = (0..states.len()).collect();
    order.sort_by(|&a, &b| {
        let of = |i: usize| penalised(context, &states[i]);
        of(a).total_cmp(&of(b))
    });
    order.truncate(POLISHED);
    let variants: Vec<Variant> = order.iter().map(|&i| states[i].terms.clone()).collect();
    let fitted = refine(context, &context.fit, variants, Some(POLISHING), None)?;
    let variants: Vec<Variant> = fitted.into_iter().map(|f| f.0).collect();
    for (i, state) in order.into_iter().zip(context.states(&variants)?) {
        if state.fit.misfit < states[i].fit.misfit {
            states[i] = state;
        }
    }
    Ok(())
}

/// `best` with a look-alike in the place of one of its effects, refitted, best first.
fn look_alikes(
    context: &Context,
    base: &State,
    first: &[Screened],
    best: &State,
) -> Result<Vec<Line>, GapError> {
    let mut all: Vec<Line> = Vec::new();
    for (index, term) in best.terms.iter().enumerate() {
        let mut terms = best.terms.clone();
        terms.remove(index);
        let screened;
        let (screened, without) = if terms.is_empty() {
            (first, base.clone())
        } else {
            let mut without = single(context, terms)?;
            context.find_basis(&mut without)?;
            screened = screen(context, &without)?;
            (screened.as_slice(), without)
        };
        let alike = |s: &&Screened| look_alike(term.effect, s.effect);
        let here =
            |s: &Screened| s.place.domain == term.place.domain && s.place.items == term.place.items;
        let mut rivals: Vec<&Screened> = Vec::new();
        for s in screened.iter().filter(alike) {
            // at the same place if it can be there, else where it does best
            match rivals.iter().position(|r| r.effect == s.effect) {
                Some(k) if here(s) && !here(rivals[k]) => rivals[k] = s,
                Some(_) => {}
                None => rivals.push(s),
            }
        }
        let states = swapped(context, best, index, &rivals, &without)?;
        for (state, rival) in states.into_iter().zip(&rivals) {
            let mut without = vec![term.effect];
            let others = rivals.iter().map(|r| r.effect);
            without.extend(others.filter(|e| *e != rival.effect && wider(term.effect, e)));
            all.push(Line {
                state,
                without,
                says_more: wider(term.effect, rival.effect),
            });
        }
    }
    sort_lines(context, &mut all);
    Ok(all)
}

fn sort_lines(context: &Context, lines: &mut [Line]) {
    let of = |l: &Line| penalised(context, &l.state);
    lines.sort_by(|a, b| of(a).total_cmp(&of(b)));
}

/// The best of `lines` that are not too far behind `best` and not in the beam.
fn chosen_lines(
    context: &Context,
    best: &State,
    beam: &[State],
    mut lines: Vec<Line>,
) -> Result<Vec<Line>, GapError> {
    sort_lines(context, &mut lines);
    let mut seen: BTreeSet<Vec<String>> = beam.iter().map(State::key).collect();
    lines.retain(|l| {
        l.state.misfit() < LINE_FAR_BEHIND * best.misfit() && seen.insert(l.state.key())
    });
    lines.truncate(LOOK_ALIKES);
    for line in &mut lines {
        context.find_basis(&mut line.state)?;
    }
    Ok(lines)
}

/// Deletes effects that the others make superfluous, one by one: those that would not be added now.
fn delete(context: &Context, base: &State, mut state: State) -> Result<State, GapError> {
    while state.terms.len() > 1 {
        let variants: Vec<Variant> = (0..state.terms.len())
            .map(|i| {
                let mut terms = state.terms.clone();
                terms.remove(i);
                terms
            })
            .collect();
        let of: Vec<usize> = (0..variants.len()).collect();
        let before = Before {
            look: f64::INFINITY,
            fit: f64::INFINITY,
        };
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

/// `state` with its term `index` replaced by each of `rivals`, refitted; the best fit of each. `without`: the model without the term.
///
/// # Errors
/// As [`crate::replay::Replayer::predict`].
pub fn swapped(
    context: &Context,
    state: &State,
    index: usize,
    rivals: &[&Screened],
    without: &State,
) -> Result<Vec<State>, GapError> {
    let mut variants = Vec::new();
    let mut of = Vec::new();
    for (number, rival) in rivals.iter().enumerate() {
        for start in &rival.starts {
            let mut terms = state.terms.clone();
            terms[index] = Term {
                effect: rival.effect,
                place: rival.place.clone(),
                values: start.clone(),
            };
            variants.push(terms);
            of.push(number);
        }
    }
    best_fits(context, variants, &of, rivals.len(), Before::of(without))
}
