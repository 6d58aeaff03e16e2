//! Which models and effects say the same.

use super::state::{On, State};
use crate::effects::Effect;

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
