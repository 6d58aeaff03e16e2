//! Who may write into a folder: one process, for as long as it lives.

use std::fs::{File, TryLockError};
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// A lock file that this process holds. The operating system lets go of it when the process ends, however it
/// ends.
#[derive(Debug)]
pub struct Owner {
    lock: File,
}

/// Why a folder is not this process's own.
#[derive(Debug, thiserror::Error)]
#[expect(missing_docs, reason = "a message says what its fields are")]
pub enum OwnerError {
    /// Another process holds the lock.
    #[error("process {process} holds {path} and is at work in this folder")]
    Taken { path: PathBuf, process: String },
    /// The lock file cannot be used.
    #[error("cannot lock {path}: {source}")]
    Io { path: PathBuf, source: io::Error },
}

/// The lock goes with the open file, not with this handle: a child process that is just being started shares
/// it until it runs its own program, and would keep the folder for that long.
impl Drop for Owner {
    fn drop(&mut self) {
        let _ = self.lock.unlock();
    }
}

impl Owner {
    /// Takes the lock file `path`. While another process holds it `wait` is called, which waits a moment and
    /// answers whether to try again, until `patience` is used up.
    pub fn take(
        path: &Path,
        patience: Duration,
        mut wait: impl FnMut(&OwnerError) -> bool,
    ) -> Result<Self, OwnerError> {
        let until = Instant::now() + patience;
        loop {
            match Self::now(path) {
                Err(taken @ OwnerError::Taken { .. }) if Instant::now() < until && wait(&taken) => {
                }
                other => return other,
            }
        }
    }

    /// Takes the lock file `path`, which is made where it is absent, or refuses at once.
    pub fn now(path: &Path) -> Result<Self, OwnerError> {
        let failed = |source| OwnerError::Io { path: path.to_owned(), source };
        // Not truncated: the number in it is the other one's.
        let mut options = File::options();
        options.create(true).truncate(false).read(true).write(true);
        let owner = Self::of(options.open(path).map_err(failed)?, path)?;
        // Only for people: a full disk does not keep a process from its own folder.
        let _ = (owner.lock.set_len(0))
            .and_then(|()| writeln!(&mut &owner.lock, "{}", std::process::id()));
        Ok(owner)
    }

    /// Locks what is open already, a file or a folder, and writes nothing into it.
    ///
    /// # Errors
    /// [`OwnerError`], with `path` as its name.
    pub fn of(lock: File, path: &Path) -> Result<Self, OwnerError> {
        let path = path.to_owned();
        match lock.try_lock() {
            Ok(()) => Ok(Self { lock }),
            Err(TryLockError::WouldBlock) => {
                let number = std::fs::read_to_string(&path).unwrap_or_default();
                let process = number.trim().to_owned();
                Err(OwnerError::Taken { path, process })
            }
            Err(TryLockError::Error(source)) => Err(OwnerError::Io { path, source }),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_folder_has_one_owner_until_that_lets_go() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("lock");
        let first = Owner::take(&path, Duration::ZERO, |_| true).unwrap();
        let refused = Owner::take(&path, Duration::ZERO, |_| true).unwrap_err();
        let own = format!("process {} holds", std::process::id());
        assert!(refused.to_string().starts_with(&own), "{refused}");

        // Asked again until it is free, or until the caller has enough.
        let mut held = Some(first);
        let patience = Duration::from_secs(600);
        let second = Owner::take(&path, patience, |_| held.take().is_some()).unwrap();
        Owner::take(&path, patience, |_| false).unwrap_err();
        drop(second);
    }

    #[test]
    fn a_shared_handle_does_not_keep_the_folder() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("lock");
        let owner = Owner::take(&path, Duration::ZERO, |_| true).unwrap();
        // What a child process has between its start and its program.
        let shared = owner.lock.try_clone().unwrap();
        drop(owner);
        Owner::take(&path, Duration::ZERO, |_| true).unwrap();
        drop(shared);
    }
}
