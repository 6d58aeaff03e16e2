//! What all lanes of an engine share.

use std::sync::Arc;

use caudata_model::RobotModel;
use rapier3d::prelude::SharedShape;

use super::friction::Grip;
use crate::stop::Stop;
use crate::{EngineConfig, Terrain};

/// What all lanes share.
pub(super) struct Shared {
    pub model: Arc<RobotModel>,
    pub config: EngineConfig,
    pub terrain: Arc<Terrain>,
    /// End stops, model order.
    pub stops: Vec<Stop>,
    /// The terrain's height field as Rapier has it, shared by all worlds.
    pub ground: Option<SharedShape>,
    /// Slippery places of the ground.
    pub grip: Grip,
    /// As in [`Mobility::links`](crate::mobility::Mobility). `[L]`
    pub mobility_per_kg: Vec<f64>,
}
