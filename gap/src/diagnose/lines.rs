//! Models that go on beside the best.

use std::collections::BTreeSet;

use super::alike::wider;
use super::fits::{penalised, single, swapped};
use super::gates::Worth;
use super::screen::{self, Screened, screen};
use super::state::{Context, State};
use crate::effects::Effect;
use crate::error::GapError;

/// Lines with a look-alike in the place of one effect that go on beside them where much is left.
const LOOK_ALIKES: usize = 3;
/// Most that a line's misfit may be, in that of the best.
const LINE_FAR_BEHIND: f64 = 2.5;

/// A model with one more effect: what that is worth, and the number of its parent: of the best, then of the
/// lines.
pub type Child = (State, Worth, usize);

/// A model that goes on beside the best.
pub struct Line {
    /// The model.
    pub state: State,
    /// What it does without: the effect that a look-alike stands for, and those that say the same and more.
    pub without: Vec<&'static Effect>,
    /// Whether the look-alike is one that says the same and more.
    pub says_more: bool,
}

/// The first of `children`, which come best first with their worth and the number of their parent, that gains
/// on all runs and is not sure to in cross-validation, if it is ahead of every child of the first `firsts`
/// parents that is sure to.
pub fn promising(children: &[(State, Worth, usize)], firsts: usize) -> Option<Line> {
    let (state, _, _) = (children.iter())
        .take_while(|(_, w, number)| *number >= firsts || !w.passed)
        .find(|(_, w, _)| !w.passed && w.fit > 0.0 && w.cross > 0.0)?;
    Some(Line { state: state.clone(), without: Vec::new(), says_more: false })
}

/// `best` with a look-alike in the place of one of its effects, refitted, best first.
///
/// # Errors
/// As [`crate::replay::Replayer::predict`].
pub fn look_alikes(
    context: &Context,
    first: &[Screened],
    best: &State,
) -> Result<Vec<Line>, GapError> {
    let mut withouts: Vec<State> = Vec::new();
    for index in 0..best.terms.len() {
        let mut without = single(context, best.without(index))?;
        context.find_basis(&mut without)?;
        withouts.push(without);
    }
    let screened = match &withouts[..] {
        [_] => vec![first.to_vec()],
        several => screen(context, best, &several.iter().collect::<Vec<_>>())?,
    };
    let mut all: Vec<Line> = Vec::new();
    for (index, (without, screened)) in withouts.iter().zip(&screened).enumerate() {
        let term = &best.terms[index];
        let rivals = screen::look_alikes(term, screened);
        let states = swapped(context, best, index, &rivals, without)?;
        for (state, rival) in states.into_iter().zip(&rivals) {
            let mut without = vec![term.effect];
            let others = rivals.iter().map(|r| r.effect);
            without.extend(others.filter(|e| *e != rival.effect && wider(term.effect, e)));
            all.push(Line { state, without, says_more: wider(term.effect, rival.effect) });
        }
    }
    sort_lines(context, &mut all);
    Ok(all)
}

/// Best first.
fn sort_lines(context: &Context, lines: &mut [Line]) {
    let of = |l: &Line| penalised(context, &l.state);
    lines.sort_by(|a, b| of(a).total_cmp(&of(b)));
}

/// The best of `lines` that are not too far behind `best`.
///
/// # Errors
/// As [`crate::replay::Replayer::predict`].
pub fn chosen_lines(
    context: &Context,
    best: &State,
    mut lines: Vec<Line>,
) -> Result<Vec<Line>, GapError> {
    sort_lines(context, &mut lines);
    let mut seen = BTreeSet::from([best.key()]);
    lines.retain(|l| {
        l.state.misfit() < LINE_FAR_BEHIND * best.misfit() && seen.insert(l.state.key())
    });
    lines.truncate(LOOK_ALIKES);
    for line in &mut lines {
        context.find_basis(&mut line.state)?;
    }
    Ok(lines)
}
