//! The search for causes: add the best, refit all, try to delete, try look-alikes.
//!
//! Which of several look-alikes it is may show only when the next cause, or the one after it, stands beside
//! it. So where much is left, look-alikes of what was found go on beside it as lines of their own, each in
//! the place of what it looks like; what a line adds must be worth it there, and a line takes over when it
//! has become better than the best so far by the same gates.
//!
//! Two causes that make up for each other (a motor that is stronger than its manual says, and saturates) each
//! do little alone. So where much is left, the candidate that explains most of those whose gain in
//! cross-validation is not certain yet goes on as a line too.

use std::collections::BTreeSet;

use super::fits::{Before, best_fits, penalised, polished, single};
use super::gates::{self, Worth};
use super::levels::NOTHING_LEFT;
use super::lines::{Child, Line, chosen_lines, look_alikes, promising};
use super::request::{Progress, Stage};
use super::screen::{Screened, screen};
use super::state::{Context, On, State};
use crate::effects::Place;
use crate::error::GapError;
use crate::replay::{Term, Variant};

/// Most effects at once.
pub const MOST_TERMS: usize = 8;
/// Screened candidates that are fitted in earnest, per state.
const FITTED: usize = 12;
/// The same once something was found.
const FITTED_LATER: usize = 6;
/// Places of one effect among them.
const PLACES: usize = 2;
/// A further effect must explain this share of what the robot as given fails to: what a model lacks in detail
/// grows with what it has (unless the misfit is still far from the floor).
const OF_ALL: f64 = 0.035;
/// … and where the misfit is above this many floors, which no detail of a law comes to, …
const MUCH: f64 = 2.5;
/// … this share of what is left.
const OF_REST: f64 = 0.12;

/// What the search found.
pub struct Found {
    /// The robot as given.
    pub base: State,
    /// The best that passed.
    pub best: State,
    /// The best before names were sought: what has no name is in it as well.
    pub supported: State,
    /// Screening on top of the robot as given.
    pub first: Vec<Screened>,
    /// Single effects that were fitted to what the robot as given leaves, best first, with what they are
    /// worth.
    pub singles: Vec<(State, Worth)>,
    /// Effects that some gate refused, on top of the best.
    pub refused: Vec<(State, Worth)>,
    /// Effects tried.
    pub tried: usize,
}

impl Found {
    /// Nothing but the robot as given.
    ///
    /// # Errors
    /// As [`crate::replay::Replayer::predict`].
    pub fn nothing(context: &Context) -> Result<Self, GapError> {
        let base = single(context, Vec::new())?;
        Ok(Self {
            best: base.clone(),
            supported: base.clone(),
            base,
            first: Vec::new(),
            singles: Vec::new(),
            refused: Vec::new(),
            tried: 0,
        })
    }
}

/// Searches. What was found so far stays in `found` where it ends early.
///
/// # Errors
/// As [`crate::replay::Replayer::predict`].
pub fn search(
    context: &mut Context,
    found: &mut Found,
    progress: &mut dyn FnMut(Progress),
) -> Result<(), GapError> {
    let mut search = Search { grows: true, lines: Vec::new(), found };
    for depth in 1..=MOST_TERMS {
        if depth > 1 {
            if gates::worst(context, &search.found.best) < gates::quiet(context) {
                break;
            }
            search.rebase(context)?;
        }
        let children = search.children(context, depth, progress)?;
        if search.step(context, depth, children)? {
            progress(Progress::new(Stage::Accepted, depth, &search.found.best.label()));
        } else if search.lines.is_empty() {
            break;
        }
    }
    let found = search.found;
    if !found.best.terms.is_empty() {
        let terms = found.best.terms.clone();
        let Found { base, best, .. } = &mut *found;
        rebase(context, &terms, &mut [base, best])?;
        // the metric has changed: what is deleted is compared with what is fitted by the new one, and must be
        // as well
        found.best = polished(context, found.best.clone())?;
        let count = found.best.terms.len();
        found.best = delete(context, &found.base, found.best.clone())?;
        if found.best.terms.len() < count {
            found.best = polished(context, found.best.clone())?;
        }
    }
    Ok(())
}

/// Judges what an early end left by one metric: it may have come while tolerances were taken anew.
///
/// # Errors
/// As [`crate::replay::Replayer::predict`].
pub fn settle(context: &mut Context, found: &mut Found) -> Result<(), GapError> {
    let terms = found.best.terms.clone();
    let Found { base, best, supported, .. } = found;
    rebase(context, &terms, &mut [base, best, supported])
}

/// A search under way.
struct Search<'a> {
    /// Whether nothing was added yet to the best.
    grows: bool,
    lines: Vec<Line>,
    found: &'a mut Found,
}

impl Search<'_> {
    /// What runs differ by grows with what was found: more friction drifts by more.
    fn rebase(&mut self, context: &mut Context) -> Result<(), GapError> {
        let Found { base, best, .. } = &mut *self.found;
        rebase(context, &best.terms.clone(), &mut [base, best])?;
        let of_lines = self.lines.iter_mut().map(|l| &mut l.state);
        reread(context, &mut of_lines.collect::<Vec<_>>())
    }

    /// Everything that the best, if it is new, and the lines come to with one more effect, best first.
    fn children(
        &mut self,
        context: &Context,
        depth: usize,
        progress: &mut dyn FnMut(Progress),
    ) -> Result<Vec<Child>, GapError> {
        let mut children: Vec<Child> = Vec::new();
        let mut seen: BTreeSet<Vec<String>> = BTreeSet::new();
        let firsts = usize::from(self.grows);
        let best = &self.found.best;
        let of_lines = self.lines.iter().map(|l| &l.state);
        let parents: Vec<&State> = self.grows.then_some(best).into_iter().chain(of_lines).collect();
        progress(Progress::new(Stage::Screening, depth, &best.label()));
        let of_parents = screen(context, best, &parents)?;
        for (number, (parent, mut screened)) in parents.into_iter().zip(of_parents).enumerate() {
            if number >= firsts {
                screened.retain(|s| !self.lines[number - firsts].without.contains(&s.effect));
            }
            self.found.tried += screened.len();
            let chosen = choose(&screened, if depth == 1 { FITTED } else { FITTED_LATER });
            progress(Progress::new(Stage::Fitting, depth, &parent.label()));
            for child in expand(context, parent, &chosen, &mut seen)? {
                let place = last_place(&child);
                let worth = gates::worth(context, parent, &child, place);
                children.push((child, worth, number));
            }
            if depth == 1 {
                self.found.first = screened;
            }
        }
        children.sort_by(|a, b| penalised(context, &a.0).total_cmp(&penalised(context, &b.0)));
        if depth == 1 {
            self.found.singles = children.iter().map(|(s, w, _)| (s.clone(), *w)).collect();
        }
        Ok(children)
    }

    /// Takes the best of `children`. Whether there is a new best; without one, lines that may still overtake
    /// it go on.
    fn step(
        &mut self,
        context: &Context,
        depth: usize,
        children: Vec<Child>,
    ) -> Result<bool, GapError> {
        let firsts = usize::from(self.grows);
        let base = &self.found.base;
        let good = |(s, w, _): &&Child| {
            w.passed
                && enough(context, w, base, last_place(s))
                && s.terms.last().is_some_and(|t| gates::matters(context, t))
        };
        let passes = |c: &&Child| match c.2 < firsts {
            true => good(c),
            false => overtakes(context, base, &self.found.best, c, good(c)),
        };
        let leader = children.iter().find(passes).map(|(s, _, _)| s.clone());
        let mut going_on: Vec<Line> = Vec::new();
        for (k, line) in self.lines.drain(..).enumerate() {
            let mut own = children.iter().filter(|c| c.2 == firsts + k);
            if let Some((state, _, _)) = own.find(|c| good(c)) {
                going_on.push(Line { state: state.clone(), ..line });
            }
        }
        if gates::worst(context, &self.found.best) >= MUCH {
            going_on.extend(promising(&children, firsts));
        }
        if firsts > 0 {
            let refused = |(_, w, number): &Child| *number < firsts && !w.passed && w.fit > 0.0;
            let refused = children.into_iter().filter(refused).map(|(s, w, _)| (s, w));
            self.found.refused = refused.take(8).collect();
        }
        let ahead = |s: &State| penalised(context, s) < penalised(context, &self.found.best);
        let leader = leader.filter(ahead);
        self.grows = leader.is_some();
        match leader {
            Some(leader) => self.accept(context, depth, leader, going_on)?,
            None => self.lines = chosen_lines(context, &self.found.best, going_on)?,
        }
        Ok(self.grows)
    }

    /// Makes `leader` the best, and decides what goes on beside it.
    fn accept(
        &mut self,
        context: &Context,
        depth: usize,
        leader: State,
        mut going_on: Vec<Line>,
    ) -> Result<(), GapError> {
        let Found { base, first, .. } = &*self.found;
        let mut best = delete(context, base, leader)?;
        self.lines.clear();
        // where little is left, what is still to be found is small: one way is enough
        if gates::worst(context, &best) >= NOTHING_LEFT && depth < MOST_TERMS {
            let others = look_alikes(context, first, &best)?;
            if let Some(other) = others.first()
                && !other.says_more
                && penalised(context, &other.state) < penalised(context, &best)
                && gates::worth(context, &best, &other.state, None).low > 0.0
            {
                // it is the better name
                best = other.state.clone();
            }
            going_on.extend(others);
            self.lines = chosen_lines(context, &best, going_on)?;
        }
        context.find_basis(&mut best)?;
        self.found.best = best;
        Ok(())
    }
}

/// Where the effect that was added last is.
fn last_place(state: &State) -> Option<&Place> {
    state.terms.last().map(|t| &t.place)
}

/// Whether the child of a line, whose parent was not better than `best`, is: by what it adds to its parent
/// (`good`) and certainly ahead of the best, or by all gates between the best and itself, whatever its steps
/// were worth one by one.
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
    let new = |t: &&Term| !best.terms.iter().any(|b| b.same(t));
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
    let all = gates::part(&context.fit, &base.cross, place);
    worth.cross > OF_ALL * all
        || (worth.beyond_doubt && worth.fit > OF_ALL * all)
        || worth.of > gates::FAR
        || (worth.of > MUCH && worth.cross > OF_REST * worth.of)
}

/// Takes the tolerances around `terms`, and judges `states` by them.
fn rebase(
    context: &mut Context,
    terms: &[Term],
    states: &mut [&mut State],
) -> Result<(), GapError> {
    context.fit.set_base(&context.replayer, terms)?;
    if let Some(scout) = &mut context.scout {
        scout.judge.set_base(&context.replayer, terms)?;
    }
    reread(context, states)
}

/// Judges states again by the present metric.
fn reread(context: &Context, states: &mut [&mut State]) -> Result<(), GapError> {
    for state in states.iter_mut() {
        state.fit = On::new(&context.fit, std::mem::take(&mut state.fit.prediction));
        if let (Some(scout), Some(on)) = (&context.scout, &mut state.scout) {
            *on = On::new(&scout.judge, std::mem::take(&mut on.prediction));
        }
        if !state.basis.is_empty() {
            context.find_basis(state)?;
        }
    }
    context.cross_validate(states)
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
            terms.push(Term { effect: s.effect, place: s.place.clone(), values: start.clone() });
            variants.push(terms);
            of.push(number);
        }
        number += 1;
    }
    best_fits(context, variants, &of, number, Before::of(parent))
}

/// Deletes effects that the others make superfluous, one by one: those that would not be added now.
fn delete(context: &Context, base: &State, mut state: State) -> Result<State, GapError> {
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
