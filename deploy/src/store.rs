//! The robot's folder: `state.json`, and `blobs/<sha256>.onnx`. What is read from it is checked as if it came from outside.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use caudata_durable as durable;
use caudata_policy::MAX_FILE_BYTES;
use sha2::{Digest, Sha256};

use crate::DeployError;
use crate::state::{PolicyRef, RobotState, STATE_FORMAT, Sha256Digest};

/// Largest state file that is read, bytes.
const STATE_BYTES_MAX: u64 = 1 << 20;

/// The state and the policies on disk. Every change is on the disk before it counts.
#[derive(Debug)]
pub struct PolicyStore {
    folder: PathBuf,
    state: RobotState,
}

impl PolicyStore {
    /// Opens the folder, making it where it is absent.
    ///
    /// # Errors
    /// [`DeployError::StateDamaged`] where `state.json` cannot be understood (it then says nothing about what may run, so
    /// nothing does), [`DeployError::Folder`] and [`DeployError::Durable`] where the disk refuses.
    pub fn open(folder: &Path) -> Result<Self, DeployError> {
        let blobs = folder.join("blobs");
        fs::create_dir_all(&blobs).map_err(|source| DeployError::Folder {
            path: blobs.clone(),
            source,
        })?;
        durable::remove_leftovers(folder)?;
        durable::remove_leftovers(&blobs)?;
        Ok(Self {
            folder: folder.to_owned(),
            state: read_state(&folder.join("state.json"))?.unwrap_or_default(),
        })
    }

    /// Reads the state without changing anything; `None` where there is none.
    ///
    /// # Errors
    /// As [`PolicyStore::open`].
    pub fn peek(folder: &Path) -> Result<Option<RobotState>, DeployError> {
        read_state(&folder.join("state.json"))
    }

    /// What the robot knows.
    pub fn state(&self) -> &RobotState {
        &self.state
    }

    /// Changes the state and writes it; files that no policy needs any more are removed.
    ///
    /// # Errors
    /// [`DeployError::Durable`]; the state is then as it was, on disk and here.
    pub fn update(&mut self, change: impl FnOnce(&mut RobotState)) -> Result<(), DeployError> {
        let mut state = self.state.clone();
        change(&mut state);
        if state == self.state {
            return Ok(());
        }
        let text = serde_json::to_vec_pretty(&state).map_err(|e| DeployError::Internal {
            what: e.to_string(),
        })?;
        durable::replace(&self.folder.join("state.json"), &text)?;
        self.state = state;
        self.remove_unneeded();
        Ok(())
    }

    /// Keeps the bytes of a policy. Call before the state names it.
    ///
    /// # Errors
    /// [`DeployError::Durable`].
    pub fn put(&self, policy: &PolicyRef, bytes: &[u8]) -> Result<(), DeployError> {
        // Replaces a file of this name, which could only be a damaged one.
        Ok(durable::replace(&self.blob(policy.sha256), bytes)?)
    }

    /// The bytes of a policy, as they were put there.
    ///
    /// # Errors
    /// [`DeployError::BlobMissing`]; [`DeployError::BlobDamaged`] where the bytes have another hash.
    pub fn get(&self, policy: &PolicyRef) -> Result<Arc<[u8]>, DeployError> {
        let path = self.blob(policy.sha256);
        let damaged = || DeployError::BlobDamaged { path: path.clone() };
        let missing = |source| DeployError::BlobMissing {
            path: path.clone(),
            source,
        };
        if fs::metadata(&path).map_err(missing)?.len() > MAX_FILE_BYTES as u64 {
            return Err(damaged());
        }
        let bytes = fs::read(&path).map_err(missing)?;
        if Sha256Digest(Sha256::digest(&bytes).into()) != policy.sha256 {
            return Err(damaged());
        }
        Ok(bytes.into())
    }

    fn blob(&self, sha256: Sha256Digest) -> PathBuf {
        self.folder.join("blobs").join(format!("{sha256}.onnx"))
    }

    /// Failing here costs nothing but space.
    fn remove_unneeded(&self) {
        let Ok(entries) = fs::read_dir(self.folder.join("blobs")) else {
            return;
        };
        for entry in entries.flatten() {
            let name = entry.file_name();
            let digest = name.to_str().and_then(|n| n.strip_suffix(".onnx"));
            let digest = digest.and_then(|d| d.parse::<Sha256Digest>().ok());
            if digest.is_some_and(|d| !self.state.needs(d)) {
                let _ = fs::remove_file(entry.path());
            }
        }
    }
}

fn read_state(path: &Path) -> Result<Option<RobotState>, DeployError> {
    let damaged = |reason: String| DeployError::StateDamaged {
        path: path.to_owned(),
        reason,
    };
    match fs::metadata(path) {
        Err(e) if e.kind() == io::ErrorKind::NotFound => return Ok(None),
        Ok(meta) if meta.len() > STATE_BYTES_MAX => return Err(damaged("it is too large".into())),
        _ => {}
    }
    let bytes = fs::read(path).map_err(|source| DeployError::Folder {
        path: path.to_owned(),
        source,
    })?;
    let state: RobotState = serde_json::from_slice(&bytes).map_err(|e| damaged(e.to_string()))?;
    if state.format != STATE_FORMAT {
        return Err(damaged(format!("its format is `{}`", state.format)));
    }
    Ok(Some(state))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn policy(bytes: &[u8]) -> PolicyRef {
        PolicyRef {
            stream: "s".to_owned(),
            version: 1,
            sha256: Sha256Digest(Sha256::digest(bytes).into()),
        }
    }

    #[test]
    fn what_was_adopted_is_there_after_a_restart() {
        let folder = tempfile::tempdir().unwrap();
        let one = policy(b"one");
        let mut store = PolicyStore::open(folder.path()).unwrap();
        store.put(&one, b"one").unwrap();
        store.update(|s| s.adopt(one.clone())).unwrap();
        let store = PolicyStore::open(folder.path()).unwrap();
        assert_eq!(store.state().active, Some(one.clone()));
        assert_eq!(*store.get(&one).unwrap(), *b"one");
    }

    #[test]
    fn a_truncated_or_missing_file_is_noticed() {
        let folder = tempfile::tempdir().unwrap();
        let one = policy(b"one");
        let store = PolicyStore::open(folder.path()).unwrap();
        let missing = store.get(&one).unwrap_err();
        assert!(
            matches!(missing, DeployError::BlobMissing { .. }),
            "{missing}"
        );
        store.put(&one, b"one").unwrap();
        let path = store.blob(one.sha256);
        fs::write(&path, b"on").unwrap();
        let damaged = store.get(&one).unwrap_err();
        assert!(
            matches!(damaged, DeployError::BlobDamaged { .. }),
            "{damaged}"
        );
        assert!(damaged.to_string().contains(&one.sha256.to_string()));
    }

    #[test]
    fn a_state_that_cannot_be_read_stops_everything() {
        let folder = tempfile::tempdir().unwrap();
        for text in ["", "{", "{\"format\":\"x\"}"] {
            fs::write(folder.path().join("state.json"), text).unwrap();
            let error = PolicyStore::open(folder.path()).unwrap_err();
            assert!(matches!(error, DeployError::StateDamaged { .. }), "{error}");
        }
    }

    #[test]
    fn files_that_no_policy_needs_are_removed() {
        let folder = tempfile::tempdir().unwrap();
        let mut store = PolicyStore::open(folder.path()).unwrap();
        for bytes in [b"one", b"two", b"six"] {
            let policy = policy(bytes);
            store.put(&policy, bytes).unwrap();
            store.update(|s| s.adopt(policy.clone())).unwrap();
            if bytes == b"one" {
                store.update(|s| s.confirm(policy.sha256)).unwrap();
            }
        }
        assert!(store.get(&policy(b"one")).is_ok(), "last good");
        assert!(
            store.get(&policy(b"two")).is_err(),
            "neither active nor good"
        );
        assert!(store.get(&policy(b"six")).is_ok(), "active");
    }
}
