//! What all lanes of an engine share.

use std::sync::Arc;

use caudata_model::RobotModel;

use crate::stop::Stop;
use crate::{EngineConfig, SimError, Terrain};

/// What all lanes share.
pub(super) struct Shared {
    pub model: Arc<RobotModel>,
    pub config: EngineConfig,
    pub terrain: Arc<Terrain>,
    /// The drive-line's bookkeeping asks for them; those that act are MuJoCo's.
    pub stops: Vec<Stop>,
}

/// Refuses what MuJoCo has no place for.
pub(super) fn cannot(what: &str) -> SimError {
    SimError::Mujoco(format!("it does not simulate {what}; the other engines do"))
}
