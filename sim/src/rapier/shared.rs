//! What all lanes of an engine share.

use rapier3d::prelude::SharedShape;

use super::friction::Grip;
use crate::Rig;
use crate::stop::Stop;

/// What all lanes share.
pub(super) struct Shared {
    pub rig: Rig,
    /// End stops, model order.
    pub stops: Vec<Stop>,
    /// The terrain's height field as Rapier has it, shared by all worlds.
    pub ground: Option<SharedShape>,
    /// Slippery places of the ground.
    pub grip: Grip,
    /// As in [`Mobility::links`](crate::mobility::Mobility). `[L]`
    pub mobility_per_kg: Vec<f64>,
}
