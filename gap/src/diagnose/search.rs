//! The search for causes, from both ends.
//!
//! From nothing: add the best, refit all, try to delete. What is added second leans on what was added first. So
//! where much is left the search begins at the other end too: with what the angles of the worst joint ask for
//! ([`super::tracking`]), all of it fitted at once, from which is deleted what it can do without.

use super::delete::{delete, enough};
use super::exchange::exchanged;
use super::fits::{Before, LAST_STEPS, fitted, penalised, polished, single, with_each};
use super::gates::{self, Worth};
use super::joints::Joints;
use super::levels::{MANY_JOINTS, NOTHING_LEFT};
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
/// For so many of them one more is fitted of a robot with many joints, of those that promise most where they show: what
/// a single bad joint asks for is little beside what a whole robot on the ground is off by.
const A_LOCAL_ONE: usize = 3;

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

/// Searches. What was found so far stays in `found` where it ends early. `built`: what the angles of each joint ask
/// for.
///
/// # Errors
/// As [`crate::replay::Replayer::predict`].
pub fn search(
    context: &mut Context,
    found: &mut Found,
    built: Option<&Joints>,
    progress: &mut dyn FnMut(Progress),
) -> Result<(), GapError> {
    grow(context, found, 1, progress)?;
    let room = found.best.terms.len() < MOST_TERMS;
    if room && let Some(other) = exchanged(context, &found.base, &found.best, &found.singles)? {
        found.best = other;
        context.find_basis(&mut found.best)?;
        forget_refusals(found);
        let depth = found.best.terms.len();
        progress(Progress::new(Stage::Accepted, depth, &found.best.label()));
        grow(context, found, depth + 1, progress)?;
    }
    if let Some(built) = built {
        from_built(context, found, built)?;
    }
    if !found.best.terms.is_empty() {
        take_anew(context, found)?;
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

/// Adds the best of what passes, one by one, from the effect with number `first` on.
fn grow(
    context: &mut Context,
    found: &mut Found,
    first: usize,
    progress: &mut dyn FnMut(Progress),
) -> Result<(), GapError> {
    for depth in first..=MOST_TERMS {
        if depth > 1 {
            if gates::worst(context, &found.best) < gates::least(context) {
                break;
            }
            take_anew(context, found)?;
        }
        let children = children(context, found, depth, progress)?;
        if !step(context, found, children)? {
            break;
        }
        progress(Progress::new(Stage::Accepted, depth, &found.best.label()));
    }
    Ok(())
}

/// What runs differ by grows with what was found: more friction drifts by more.
fn take_anew(context: &mut Context, found: &mut Found) -> Result<(), GapError> {
    let Found { base, best, .. } = found;
    rebase(context, &best.terms.clone(), &mut [base, best])
}

/// Takes what the angles of the joint ask for that is off most, beside what was found, for the best if it is by all
/// gates once what it can do without is deleted.
fn from_built(context: &mut Context, found: &mut Found, built: &Joints) -> Result<(), GapError> {
    if gates::worst(context, &found.best) < NOTHING_LEFT {
        return Ok(());
    }
    let rich = rich(context, &found.best, built);
    if rich.len() == found.best.terms.len() {
        return Ok(());
    }
    // by tolerances around itself: whether play hunts hangs on what stands beside it
    let Found { base, best, .. } = &mut *found;
    rebase(context, &rich, &mut [base, best])?;
    let all = fitted(context, rich, Some(LAST_STEPS))?;
    let shorter = delete(context, &found.base, all)?;
    let worth = gates::worth(context, &found.best, &shorter, None);
    if worth.passed && penalised(context, &shorter) < penalised(context, &found.best) {
        found.best = shorter;
        forget_refusals(found);
    }
    take_anew(context, found)
}

/// What was refused beside an older best may be a cause now.
fn forget_refusals(found: &mut Found) {
    let Found { best, refused, .. } = found;
    let new = |t: &Term| !best.terms.iter().any(|b| b.same(t));
    refused.retain(|(s, _)| s.terms.last().is_none_or(new));
}

/// The terms of `best` and, of the joint that it leaves most at, those of `built` that matter.
fn rich(context: &Context, best: &State, built: &Joints) -> Variant {
    let mut terms = best.terms.clone();
    let own = gates::worst_joint(context, best).and_then(|a| built.own.get(a));
    // what was asked for beyond a standard model comes last there
    let asked = own.into_iter().flatten().rev().chain(&built.shared);
    // standard models hold effects that are left out, or that these runs cannot show
    let open = |t: &&Term| {
        context.effects.iter().any(|e| e.id == t.effect.id)
            && (t.effect.unseen)(&context.excitation, &t.place).is_none()
    };
    for term in asked.filter(open).filter(|t| gates::matters(context, t)) {
        if terms.len() < MOST_TERMS && !terms.iter().any(|t| t.same(term)) {
            terms.push(term.clone());
        }
    }
    terms
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

/// Everything that the best comes to with one more effect, with what that is worth, best first.
fn children(
    context: &Context,
    found: &mut Found,
    depth: usize,
    progress: &mut dyn FnMut(Progress),
) -> Result<Vec<(State, Worth)>, GapError> {
    let best = &found.best;
    progress(Progress::new(Stage::Screening, depth, &best.label()));
    let screened = screen(context, best, &[best])?.swap_remove(0);
    found.tried += screened.len();
    let most = if depth == 1 { FITTED } else { FITTED_LATER };
    let mut chosen = choose(screened.iter(), most);
    if context.replayer.model().actuated().len() >= MANY_JOINTS {
        chosen.extend(locally(&screened, &chosen, most / A_LOCAL_ONE));
    }
    progress(Progress::new(Stage::Fitting, depth, &best.label()));
    let fitted =
        with_each(context, &chosen, Before::of(best), |t| [&best.terms[..], &[t]].concat())?;
    let mut children: Vec<(State, Worth)> = (fitted.into_iter())
        .map(|child| {
            let worth = gates::worth(context, best, &child, last_place(&child));
            (child, worth)
        })
        .collect();
    children.sort_by(|a, b| penalised(context, &a.0).total_cmp(&penalised(context, &b.0)));
    if depth == 1 {
        found.first = screened;
        found.singles.clone_from(&children);
    }
    Ok(children)
}

/// Takes the best of `children` that passes all gates. Whether there is one.
fn step(
    context: &Context,
    found: &mut Found,
    children: Vec<(State, Worth)>,
) -> Result<bool, GapError> {
    let base = &found.base;
    let good = |(s, w): &&(State, Worth)| {
        w.passed
            && enough(context, w, base, last_place(s))
            && s.terms.last().is_some_and(|t| gates::matters(context, t))
    };
    let leader = children.iter().find(good).map(|(s, _)| s.clone());
    let refused = children.into_iter().filter(|(_, w)| !w.passed && w.fit > 0.0);
    found.refused = refused.take(8).collect();
    let ahead = |s: &State| penalised(context, s) < penalised(context, &found.best);
    let Some(leader) = leader.filter(ahead) else {
        return Ok(false);
    };
    found.best = delete(context, base, leader)?;
    context.find_basis(&mut found.best)?;
    Ok(true)
}

/// Where the effect that was added last is.
fn last_place(state: &State) -> Option<&Place> {
    state.terms.last().map(|t| &t.place)
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
fn choose<'a>(screened: impl Iterator<Item = &'a Screened>, most: usize) -> Vec<&'a Screened> {
    let mut chosen: Vec<&Screened> = Vec::new();
    for s in screened.filter(|s| s.gain > 0.0) {
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

/// Those beyond `chosen` that promise most on the channels that show them.
fn locally<'a>(screened: &'a [Screened], chosen: &[&Screened], most: usize) -> Vec<&'a Screened> {
    let is_new = |s: &&Screened| !chosen.iter().any(|c| std::ptr::eq(*c, *s));
    let mut ranked: Vec<&Screened> = screened.iter().filter(is_new).collect();
    ranked.sort_by(|a, b| (b.gain / b.shown).total_cmp(&(a.gain / a.shown)));
    choose(ranked.into_iter(), most)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use super::*;
    use crate::effects;

    fn screened(id: &str, joint: usize, gain: f64, shown: f64) -> Screened {
        Screened {
            effect: effects::find(id).unwrap(),
            place: Place {
                domain: effects::Domain::Joints,
                items: vec![joint],
                names: vec![joint.to_string()],
            },
            gain,
            shown,
            starts: Vec::new(),
            traces: Vec::new(),
        }
    }

    /// A bad knee takes 0.5 off all channels, of which its own are a fiftieth: 25 off those.
    #[test]
    fn what_one_joint_asks_for_most_is_fitted_beside_what_the_whole_robot_asks_for() {
        let all = [
            screened("link_mass", 1, 4.6, 1.0),
            screened("link_mass", 2, 4.5, 1.0),
            screened("armature", 3, 0.6, 0.1),
            screened("kp_error", 7, 0.5, 0.02),
        ];
        let chosen = choose(all.iter(), 2);
        assert_eq!(chosen.iter().map(|s| s.place.items[0]).collect::<Vec<_>>(), [1, 2]);
        let local = locally(&all, &chosen, 1);
        assert_eq!(local.iter().map(|s| s.effect.id).collect::<Vec<_>>(), ["kp_error"]);
    }
}
