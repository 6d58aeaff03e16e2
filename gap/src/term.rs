//! A hypothesis with numbers.

use crate::effects::{Effect, Place};

/// A hypothesis with its numbers: an effect at a place.
#[derive(Debug, Clone, PartialEq)]
pub struct Term {
    /// Which effect.
    pub effect: &'static Effect,
    /// Where.
    pub place: Place,
    /// SI, one per parameter of the effect.
    pub values: Vec<f64>,
}

/// A candidate: the robot of the file with these effects, in this order.
pub type Variant = Vec<Term>;
