//! The state on the disk: twice, each with the SHA-256 of what it says.

use std::fs;
use std::io::{self, Read};
use std::path::Path;

use sha2::{Digest, Sha256};

use crate::DeployError;
use crate::state::{RobotState, STATE_FORMAT, Sha256Digest};

/// Largest state file that is read, bytes.
const STATE_BYTES_MAX: u64 = 1 << 20;
/// The state, twice.
pub(super) const COPIES: [&str; 2] = ["state.json", "state.copy.json"];

/// A state file: the state, and the SHA-256 of its compact JSON, so that a flipped bit is noticed.
#[derive(serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields)]
struct StateFile {
    sha256: Sha256Digest,
    state: RobotState,
}

fn digest(state: &RobotState) -> Result<Sha256Digest, String> {
    let text = serde_json::to_vec(state).map_err(|e| e.to_string())?;
    Ok(Sha256Digest(Sha256::digest(text).into()))
}

pub(super) fn encode(state: &RobotState) -> Result<Vec<u8>, DeployError> {
    let file = digest(state).map(|sha256| StateFile { sha256, state: state.clone() });
    file.and_then(|file| serde_json::to_vec_pretty(&file).map_err(|e| e.to_string()))
        .map_err(|what| DeployError::Internal { what })
}

/// The newest state that can be read; `None` where there never was one.
pub(super) fn read_state(folder: &Path) -> Result<Option<RobotState>, DeployError> {
    let mut newest: Option<RobotState> = None;
    let mut damage = None;
    for name in COPIES {
        let path = folder.join(name);
        match read_copy(&path) {
            Ok(None) => {}
            Ok(Some(state)) => {
                if newest.as_ref().is_none_or(|n| n.generation < state.generation) {
                    newest = Some(state);
                }
            }
            Err(DeployError::StateDamaged { path, reason }) => {
                damage.get_or_insert((path, reason));
            }
            Err(error) => return Err(error),
        }
    }
    match (newest, damage) {
        (None, Some((path, reason))) => Err(DeployError::StateDamaged { path, reason }),
        (Some(state), Some((path, reason))) => {
            tracing::error!(path = %path.display(), reason, "one copy of the state is damaged; the other is used");
            Ok(Some(state))
        }
        (newest, None) => Ok(newest),
    }
}

pub(super) fn read_copy(path: &Path) -> Result<Option<RobotState>, DeployError> {
    let damaged = |reason: String| DeployError::StateDamaged { path: path.to_owned(), reason };
    match fs::metadata(path) {
        Err(e) if e.kind() == io::ErrorKind::NotFound => return Ok(None),
        Ok(meta) if meta.len() > STATE_BYTES_MAX => return Err(damaged("it is too large".into())),
        _ => {}
    }
    let bytes = fs::read(path).map_err(DeployError::folder(path))?;
    let file: StateFile = serde_json::from_slice(&bytes).map_err(|e| damaged(e.to_string()))?;
    if file.state.format != STATE_FORMAT {
        return Err(damaged(format!("its format is `{}`", file.state.format)));
    }
    if digest(&file.state).map_err(damaged)? != file.sha256 {
        return Err(damaged("it is not what was written".to_owned()));
    }
    Ok(Some(file.state))
}

/// As much of a file as a state may be long.
pub(super) fn read_beginning(path: &Path) -> Result<Vec<u8>, DeployError> {
    let mut bytes = Vec::new();
    fs::File::open(path)
        .and_then(|file| file.take(STATE_BYTES_MAX).read_to_end(&mut bytes))
        .map_err(DeployError::folder(path))?;
    Ok(bytes)
}
