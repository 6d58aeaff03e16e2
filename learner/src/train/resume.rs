//! Going on from a checkpoint, and what must not have changed.

use caudata_config::Config;

use crate::LearnerError;
use crate::checkpoint::{CheckpointState, CheckpointStore};
use crate::network::Layout;

/// Whether a run starts anew or goes on.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub enum Resume {
    /// From the start.
    #[default]
    No,
    /// From the newest checkpoint; from the start when there is none yet.
    Latest,
    /// From the checkpoint with this name, for instance `iter_000100`.
    Named(String),
}

/// The state to go on from, and the folder that it was in.
pub(super) fn load(
    resume: &Resume,
    store: &CheckpointStore,
    layout: &Layout,
    config: &Config,
    contract_hash: &str,
) -> Result<Option<(String, CheckpointState)>, LearnerError> {
    let loaded = match resume {
        Resume::No => None,
        Resume::Latest => store.load_latest()?,
        Resume::Named(name) => Some(store.load(name)?),
    };
    let Some((folder, files)) = loaded else {
        return Ok(None);
    };
    let state = CheckpointState::from_files(&files, layout)
        .map_err(|reason| store.damaged(&folder, reason))?;
    let path = folder.display().to_string();
    if state.saved.contract_hash != contract_hash {
        return Err(LearnerError::CheckpointContract { path });
    }
    if state.saved.config_hash != config.hash_hex() {
        return Err(LearnerError::CheckpointConfig { path });
    }
    Ok(Some((path, state)))
}
