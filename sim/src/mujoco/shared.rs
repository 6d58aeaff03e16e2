//! What all lanes of an engine share.

use crate::stop::Stop;
use crate::{Rig, SimError};

/// What all lanes share.
pub(super) struct Shared {
    pub rig: Rig,
    /// The drive-line's bookkeeping asks for them; those that act are MuJoCo's.
    pub stops: Vec<Stop>,
}

/// Refuses what MuJoCo has no place for.
pub(super) fn cannot(what: &str) -> SimError {
    SimError::Mujoco(format!("it does not simulate {what}; the other engines do"))
}
