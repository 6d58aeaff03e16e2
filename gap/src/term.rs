//! A hypothesis with numbers.

use caudata_model::RobotModel;

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

impl Term {
    /// `effect` at a place, with nothing of it.
    pub fn nothing(model: &RobotModel, effect: &'static Effect, place: Place) -> Self {
        Self { values: effect.neutral(model, &place), effect, place }
    }

    /// `effect@name`.
    pub fn label(&self) -> String {
        self.place.label(self.effect.id)
    }

    /// Whether it is the same effect at the same place.
    pub fn same(&self, other: &Self) -> bool {
        self.effect == other.effect && self.place == other.place
    }

    /// As [`Effect::neutral`].
    pub fn neutral(&self, model: &RobotModel) -> Vec<f64> {
        self.effect.neutral(model, &self.place)
    }

    /// As [`Effect::bounds`].
    pub fn bounds(&self, model: &RobotModel, index: usize) -> (f64, f64) {
        self.effect.bounds(model, &self.place, index)
    }

    /// As [`Effect::scale`].
    pub fn scale(&self, model: &RobotModel, index: usize) -> f64 {
        self.effect.scale(model, &self.place, index)
    }

    /// As [`Effect::at_bound`], of its own value.
    pub fn at_bound(&self, model: &RobotModel, index: usize) -> bool {
        self.effect.at_bound(model, &self.place, index, self.values[index])
    }
}

/// A candidate: the robot of the file with these effects, in this order.
pub type Variant = Vec<Term>;
