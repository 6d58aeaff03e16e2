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
    const LEFT: f64 = 0.1;
    let own: usize = model.terms.iter().map(|t| t.values.len()).sum();
    let mut terms = model.terms.clone();
    terms.push(Term {
        values: (other.effect).neutral(context.replayer.model(), &other.place),
        ..other.clone()
    });
    let (columns, _) = context.jacobian(&context.fit, &terms)?;
    let (own, others) = columns.split_at(own);
    let mut among = gram(own);
    stiffen(&mut among, 0.0);
    let Some(among) = among.cholesky() else {
        return Ok(false);
    };
    let within = |c: &Vec<f32>| {
        let along = DVector::from_iterator(own.len(), own.iter().map(|o| dot(o, c)));
        let size = dot(c, c);
        size - along.dot(&among.solve(&along)) < LEFT * size
    };
    // where a mass is none, its lever does nothing
    let mut felt = others.iter().filter(|c| dot(c, c) > 0.0).peekable();
    Ok(felt.peek().is_some() && felt.all(within))
}

/// Effects that are special cases of others: the wider one says what the narrower one says, and more.
const WIDER: &[(&str, &str)] = &[
    ("load_dependent_friction", "drive_asymmetry"),
    ("load_dependent_friction", "load_stiction"),
    ("coulomb_friction", "stribeck_friction"),
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
