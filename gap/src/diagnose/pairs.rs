//! Two effects that together say what one says alone: of a hanging link a mass and a rotor say what a weight on
//! it does, since only its moment of gravity and its inertia show.

use nalgebra::{DMatrix, DVector};

use super::alike::indistinguishable;
use super::fits::penalised;
use super::product::{dot, gram, stiffen};
use super::refine::refine;
use super::state::{Context, On, State};
use crate::error::GapError;
use crate::replay::{Term, Variant};

/// So many pairs are fitted in a cause's place.
const PAIRS: usize = 8;
/// A pair whose traces leave more than this of the cause's (mean square) is no such pair.
const LEFT: f64 = 0.3;

/// A model with two effects in a cause's place, which are its last terms.
pub struct Pair {
    /// The model.
    pub state: State,
    /// Probability among the cause and its rivals.
    pub probability: f64,
}

impl Pair {
    /// The two.
    pub fn terms(&self) -> &[Term] {
        &self.state.terms[self.state.terms.len() - 2..]
    }
}

/// Models in which two say what term `index` of `best` says, or more, of those that will not do `alone`. A cause of
/// one size is simpler than any two.
///
/// # Errors
/// As [`crate::replay::Replayer::predict`].
pub fn pairs(
    context: &Context,
    best: &State,
    index: usize,
    alone: &[&Term],
) -> Result<Vec<State>, GapError> {
    if !several(context, best, index)? {
        return Ok(Vec::new());
    }
    let others = best.without(index);
    let bare = context.replayer.predict(&context.fit.data, std::slice::from_ref(&others))?;
    let asked = context.fit.change(&best.fit.prediction, &bare.concat());
    let mut found = sums(context, &others, alone, &asked)?;
    found.retain(|(left, _)| *left < LEFT);
    found.truncate(PAIRS);
    let variants = found.into_iter().map(|(_, terms)| terms).collect();
    let fitted = refine(context, &context.fit, variants, None, None)?;
    let variants: Vec<Variant> = fitted.into_iter().map(|f| f.0).collect();
    let mut states = context.states(&variants)?;
    let own = penalised(context, best);
    states.retain(|s| indistinguishable(best, s) || penalised(context, s) < own);
    states.sort_by(|a, b| penalised(context, a).total_cmp(&penalised(context, b)));
    Ok(states)
}

/// Every two of `tried` on top of `others`, at the sizes at which their traces come nearest to `asked`, with the share
/// of its square that they leave, least first.
///
/// # Errors
/// As [`crate::replay::Replayer::predict`].
pub fn sums(
    context: &Context,
    others: &[Term],
    tried: &[&Term],
    asked: &[f32],
) -> Result<Vec<(f64, Variant)>, GapError> {
    let model = context.replayer.model();
    let nothing = |t: &&Term| Term::nothing(model, t.effect, t.place.clone());
    let tried: Vec<Term> = tried.iter().map(nothing).collect();
    let (columns, steps) = context.jacobian(&context.fit, &[others, &tried[..]].concat())?;
    let span = Span::new(&columns, asked);
    let mut first: usize = others.iter().map(|t| t.values.len()).sum();
    let mut own: Vec<Vec<usize>> = Vec::new();
    for term in &tried {
        own.push((first..first + term.values.len()).collect());
        first += term.values.len();
    }
    let mut found: Vec<(f64, Variant)> = Vec::new();
    for (i, a) in tried.iter().enumerate() {
        for (j, b) in tried.iter().enumerate().skip(i + 1) {
            let Some((left, sizes)) = span.of(&[&own[i][..], &own[j][..]].concat()) else {
                continue;
            };
            let mut two = [a.clone(), b.clone()];
            let places = own[i].iter().map(|k| (0, k - own[i][0], *k));
            let places = places.chain(own[j].iter().map(|k| (1, k - own[j][0], *k)));
            for ((t, p, k), size) in places.zip(sizes) {
                let (low, high) = two[t].bounds(model, p);
                two[t].values[p] = (two[t].values[p] + size * steps[k]).clamp(low, high);
            }
            found.push((left, [others, &two[..]].concat()));
        }
    }
    found.sort_by(|a, b| a.0.total_cmp(&b.0));
    Ok(found)
}

/// Whether term `index` of `best` needs more than one size.
fn several(context: &Context, best: &State, index: usize) -> Result<bool, GapError> {
    let alone = State { terms: vec![best.terms[index].clone()], ..State::default() };
    let others =
        best.parameters(context.replayer.model()) - alone.parameters(context.replayer.model());
    Ok(parameters(context, best, index)? > others + 1)
}

/// Number of parameters of `state` without those sizes of its term `index` without which it is the same model.
///
/// # Errors
/// As [`crate::replay::Replayer::predict`].
pub fn parameters(context: &Context, state: &State, index: usize) -> Result<usize, GapError> {
    let less = with_one_size_less(context, state, index)?;
    let same = less.iter().filter(|s| indistinguishable(state, s)).count();
    let all = state.parameters(context.replayer.model());
    Ok(all - same.min(less.len().saturating_sub(1)))
}

/// Misfit of the runs that are fitted, without `most` parameters being more: those of term `index` that are missed
/// least are as without the effect. None where the term has no more to do without.
///
/// # Errors
/// As [`crate::replay::Replayer::predict`].
pub fn misfit_with(
    context: &Context,
    state: &State,
    index: usize,
    most: usize,
) -> Result<Option<f64>, GapError> {
    let model = context.replayer.model();
    let mut state = state.clone();
    while state.parameters(model) > most {
        let less = with_one_size_less(context, &state, index)?;
        let least = less.into_iter().min_by(|a, b| a.fit.misfit.total_cmp(&b.fit.misfit));
        let Some(least) = least else { return Ok(None) };
        state = least;
    }
    Ok(Some(state.fit.misfit))
}

/// `state` with each size of its term `index`, if there are several, in turn as it is without the effect, on the
/// runs that are fitted.
fn with_one_size_less(
    context: &Context,
    state: &State,
    index: usize,
) -> Result<Vec<State>, GapError> {
    let term = &state.terms[index];
    let neutral = term.neutral(context.replayer.model());
    let moved = (0..neutral.len()).filter(|&p| term.values[p] != neutral[p]);
    let less = |p: usize| {
        let mut terms = state.terms.clone();
        terms[index].values[p] = neutral[p];
        terms
    };
    let variants: Vec<Variant> = moved.map(less).collect();
    if variants.len() < 2 {
        return Ok(Vec::new());
    }
    let predictions = context.replayer.predict(&context.fit.data, &variants)?;
    let on = |(terms, prediction)| State {
        terms,
        fit: On::new(&context.fit, prediction),
        ..State::default()
    };
    Ok(variants.into_iter().zip(predictions).map(on).collect())
}

/// What sums of traces can do of one that is asked for.
struct Span {
    among: DMatrix<f64>,
    along: Vec<f64>,
    size: f64,
}

impl Span {
    fn new(columns: &[Vec<f32>], asked: &[f32]) -> Self {
        let along = columns.iter().map(|c| dot(c, asked)).collect();
        Self { among: gram(columns), along, size: dot(asked, asked).max(1e-12) }
    }

    /// What the best sum of these columns leaves, as a share of the square, and their sizes in it.
    fn of(&self, columns: &[usize]) -> Option<(f64, Vec<f64>)> {
        let n = columns.len();
        let mut among = DMatrix::from_fn(n, n, |i, j| self.among[(columns[i], columns[j])]);
        stiffen(&mut among);
        let along = DVector::from_iterator(n, columns.iter().map(|k| self.along[*k]));
        let sizes = among.cholesky()?.solve(&along);
        Some((1.0 - along.dot(&sizes) / self.size, sizes.iter().copied().collect()))
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use super::*;

    #[test]
    fn two_traces_span_what_lies_in_their_plane() {
        let columns = [vec![9.0, 9.0, 9.0], vec![1.0, 0.0, 0.0], vec![1.0, 1.0, 0.0]];
        let (left, sizes) = Span::new(&columns, &[3.0, -2.0, 0.0]).of(&[1, 2]).unwrap();
        assert!(left.abs() < 1e-6 && (sizes[0] - 5.0).abs() < 1e-6, "{left} {sizes:?}");
        assert!((sizes[1] + 2.0).abs() < 1e-6);
        let (left, _) = Span::new(&columns, &[0.0, 1.0, 1.0]).of(&[1, 2]).unwrap();
        assert!((left - 0.5).abs() < 1e-6, "{left}");
    }
}
