//! Going on from a checkpoint, and what must not have changed.

use std::path::Path;

use serde::Deserialize;

use super::settings::{ACCOUNT_FILE, Resume, TrainSettings};
use crate::LearnerError;
use crate::checkpoint::{CheckpointState, CheckpointStore};
use crate::network::Layout;

/// The state to go on from, and the folder that it was in.
pub(super) fn load(
    settings: &TrainSettings,
    store: &CheckpointStore,
    layout: &Layout,
    contract_hash: &str,
) -> Result<Option<(String, CheckpointState)>, LearnerError> {
    let loaded = match &settings.resume {
        Resume::No => None,
        Resume::Latest => match store.load_latest()? {
            None if has_learnt(&settings.run_dir) => {
                let path = store.root().to_owned();
                return Err(LearnerError::CheckpointsGone { path });
            }
            loaded => loaded,
        },
        Resume::Named(name) if !store.names().contains(name) => {
            let (name, there) = (name.clone(), store.names());
            return Err(LearnerError::NoSuchCheckpoint { name, there });
        }
        Resume::Named(name) => Some(store.load(name)?),
    };
    let Some((folder, files)) = loaded else { return Ok(None) };
    let state = CheckpointState::from_files(&files, layout)
        .map_err(|reason| store.damaged(&folder, reason))?;
    let path = folder.display().to_string();
    if state.saved.contract_hash != contract_hash {
        return Err(LearnerError::CheckpointContract { path });
    }
    if state.saved.config_hash != settings.config.hash_hex() {
        return Err(LearnerError::CheckpointConfig { path });
    }
    Ok(Some((path, state)))
}

/// Whether a learner of this run has saved before: the account, which is written after each checkpoint, knows
/// of chunks that were learnt from. To begin anew would write over the policy that came of them.
fn has_learnt(run_dir: &Path) -> bool {
    #[derive(Deserialize)]
    struct Account {
        accepted: u64,
    }
    let account = std::fs::read(run_dir.join(ACCOUNT_FILE)).unwrap_or_default();
    serde_json::from_slice(&account).is_ok_and(|Account { accepted }| accepted > 0)
}
