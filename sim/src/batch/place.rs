//! Places on the frames of a compiled robot.

use crate::simd::Lanes;

/// What a contact point belongs to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Part {
    /// A foot, by index.
    Foot(usize),
    /// Anything else of what carries the feet.
    Trunk,
    /// What hangs behind without carrying feet.
    Tail,
}

/// A place on a node.
#[derive(Debug, Clone)]
pub(super) struct Place<R: Lanes> {
    pub node: usize,
    pub at: [R::Elem; 3],
    /// Columns: node from place.
    pub columns: [[R::Elem; 3]; 3],
}
