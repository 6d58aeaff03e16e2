//! Which models and effects say the same.

use nalgebra::DVector;

use super::product::{dot, gram, stiffen};
use super::state::{Context, On, State};
use crate::effects::Effect;
use crate::error::GapError;
use crate::replay::Term;

/// Whether two models predict the same, to a hundredth of what counts.
pub fn indistinguishable(a: &State, b: &State) -> bool {
    const SAME: f64 = 0.01;
    let apart = |a: &On, b: &On| -> f64 {
        let pairs = a.residual.iter().zip(&b.residual);
        let square: f64 = pairs.map(|(x, y)| f64::from(x - y).powi(2)).sum();
        square / a.residual.len().max(1) as f64
    };
    apart(&a.fit, &b.fit) < SAME
}

/// Whether `other` beside the effects of `model` would do nothing that other sizes of those do not do as well:
/// any share of them may be it, however well they fit alone. (All torques less and all weights, inertias and
/// friction more move a robot alike, and its currents.)
///
/// # Errors
/// As [`crate::replay::Replayer::predict`].
pub fn trades(context: &Context, model: &State, other: &Term) -> Result<bool, GapError> {
    let own: usize = model.terms.iter().map(|t| t.values.len()).sum();
    let mut terms = model.terms.clone();
    terms.push(Term::nothing(context.replayer.model(), other.effect, other.place.clone()));
    let (columns, _) = context.jacobian(&context.fit, &terms)?;
    let (own, others) = columns.split_at(own);
    Ok(spanned(own, others))
}

/// Whether what `own` spans holds each of `others` that is not nothing, but for a tenth of its mean square.
fn spanned(own: &[Vec<f32>], others: &[Vec<f32>]) -> bool {
    const LEFT: f64 = 0.1;
    let mut among = gram(own);
    stiffen(&mut among);
    let Some(among) = among.cholesky() else {
        return false;
    };
    let within = |c: &Vec<f32>| {
        let along = DVector::from_iterator(own.len(), own.iter().map(|o| dot(o, c)));
        let size = dot(c, c);
        size - along.dot(&among.solve(&along)) < LEFT * size
    };
    // where a mass is none, its lever does nothing
    let mut felt = others.iter().filter(|c| dot(c, c) > 0.0).peekable();
    felt.peek().is_some() && felt.all(within)
}

/// Effects that are special cases of others: the wider one says what the narrower one says, and more.
const WIDER: &[(&str, &str)] = &[
    ("load_dependent_friction", "drive_asymmetry"),
    ("load_dependent_friction", "load_stiction"),
    ("coulomb_friction", "stribeck_friction"),
    // friction that runs in for longer than a run lasts
    ("coulomb_friction", "friction_drift"),
    ("link_mass", "payload"),
    ("link_mass", "point_mass"),
    ("link_com", "point_mass"),
];

/// Whether the effect `one` is a special case of `other`.
pub fn wider(one: &Effect, other: &Effect) -> bool {
    WIDER.contains(&(one.id, other.id))
}

/// Whether either is declared to look like the other.
pub fn look_alike(one: &Effect, other: &Effect) -> bool {
    one.look_alikes().any(|id| id == other.id) || other.look_alikes().any(|id| id == one.id)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_others_span_but_for_a_tenth_trades_with_them() {
        let own = [vec![1.0, 0.0, 0.0], vec![1.0, 1.0, 0.0]];
        let spans = |other: [f32; 3]| spanned(&own, &[other.to_vec()]);
        assert!(spans([3.0, -2.0, 0.0]));
        // outside 0.3² of 1 + 0.3²: 8 %; 0.4² of 1 + 0.4²: 14 %
        assert!(spans([1.0, 0.0, 0.3]));
        assert!(!spans([1.0, 0.0, 0.4]));
        // of a mass and its lever both have to be
        assert!(!spanned(&own, &[vec![1.0, 0.0, 0.0], vec![0.0, 0.0, 1.0]]));
    }

    #[test]
    fn what_leaves_no_trace_trades_with_nothing() {
        let own = [vec![1.0, 0.0]];
        assert!(!spanned(&own, &[vec![0.0, 0.0]]));
        assert!(!spanned(&own, &[]));
        // and a lever that does nothing keeps no mass from it
        assert!(spanned(&own, &[vec![2.0, 0.0], vec![0.0, 0.0]]));
        // nothing spans nothing
        assert!(!spanned(&[], &[vec![1.0, 0.0]]));
    }
}
