//! Who owns a run's files on this host: a directory per run, a lock that dies with its holder, and a note
//! that tells actors where the learner's services are.
//!
//! ```text
//! <root>/                      mode 0700, ours
//!   <hash of the run id>/
//!     lock                     held by the learner
//!     current                  the note, replaced by renaming
//!     <tag>/                   iceoryx2's bookkeeping files and sockets of one learner process
//! /dev/shm/cd<tag>_*           its shared-memory segments
//! ```

use std::fs::{self, DirBuilder, File, TryLockError};
use std::io::{self, ErrorKind};
use std::os::unix::fs::{DirBuilderExt, MetadataExt};
use std::path::{Path, PathBuf};

use nix::unistd::geteuid;
use serde::{Deserialize, Serialize};

use crate::{Iceoryx2Config, Limits, TransportError};

/// Where the system keeps POSIX shared memory; iceoryx2 has no other place for it on Linux.
pub(super) const SHM_DIR: &str = "/dev/shm";
/// What the note begins with; another version is refused.
const FORMAT: &str = "caudata-transport 3";
/// Longest path of a socket in bytes, less the terminating zero.
const MAX_SOCKET_PATH: usize = 107;
/// What iceoryx2 appends to the directory for a socket: `/`, prefix, a number of up to 39 digits, `.event`.
const SOCKET_NAME: usize = 1 + 11 + 39 + 6;
/// How often acquiring starts anew because a folder or the lock file was removed by a learner that was just
/// ending.
const LOCK_ATTEMPTS: usize = 256;

/// The note a learner posts for its actors.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Note {
    format: String,
    pub run_id: String,
    /// Eight hexadecimal digits that name this learner process's files.
    pub tag: String,
    pub limits: Limits,
}

impl Note {
    fn parse(text: &str) -> Option<Self> {
        let note: Self = serde_json::from_str(text).ok()?;
        (note.format == FORMAT && is_tag(&note.tag)).then_some(note)
    }
}

/// Where a run's files are.
#[derive(Debug, Clone)]
pub(super) struct RunPaths {
    root: PathBuf,
    run: PathBuf,
    run_id: String,
}

impl RunPaths {
    pub(super) fn new(config: &Iceoryx2Config, run_id: &str) -> Result<Self, TransportError> {
        let root = match &config.root {
            Some(root) => root.clone(),
            None => Path::new(SHM_DIR).join(format!("caudata-{}", geteuid())),
        };
        let run = root.join(format!("{:08x}", short_hash(run_id)));
        let longest = run.as_os_str().len() + 1 + 8 + SOCKET_NAME;
        if longest > MAX_SOCKET_PATH {
            return Err(TransportError::Config(format!(
                "iceoryx2.root {} is {} bytes too long for the sockets under it",
                root.display(),
                longest - MAX_SOCKET_PATH
            )));
        }
        Ok(Self { root, run, run_id: run_id.to_owned() })
    }

    /// Directory of one learner process's bookkeeping files.
    pub(super) fn tag_dir(&self, tag: &str) -> PathBuf {
        self.run.join(tag)
    }

    /// The note of the newest learner, `None` when there is none.
    pub(super) fn note(&self) -> Result<Option<Note>, TransportError> {
        if !check_ours(&self.root)? {
            return Ok(None);
        }
        let path = self.run.join("current");
        let text = match fs::read_to_string(&path) {
            Ok(text) => text,
            Err(e) if e.kind() == ErrorKind::NotFound => return Ok(None),
            Err(e) => return Err(io_error(&path, &e)),
        };
        let Some(note) = Note::parse(&text) else {
            return Err(stale(&path, "is not a note of this version"));
        };
        if note.run_id != self.run_id {
            return Err(stale(&path, &format!("belongs to run {}", note.run_id)));
        }
        Ok(Some(note))
    }
}

/// The learner's ownership of a run's files; removes them when dropped.
pub(super) struct RunDir {
    pub(super) paths: RunPaths,
    _lock: File,
}

impl RunDir {
    /// Takes the run over: refuses while another learner lives, removes what a killed one left.
    pub(super) fn acquire(config: &Iceoryx2Config, run_id: &str) -> Result<Self, TransportError> {
        let paths = RunPaths::new(config, run_id)?;
        for _ in 0..LOCK_ATTEMPTS {
            // Each may go again: a run that ends takes its folder away, and the root where it was the last
            // one.
            if !create_private(&paths.root)? {
                return Err(io_error(&paths.root, &ErrorKind::NotFound.into()));
            }
            let there =
                check_ours(&paths.root)? && create_private(&paths.run)? && check_ours(&paths.run)?;
            if there && let Some(lock) = lock(&paths.run.join("lock"), run_id)? {
                let run_dir = Self { paths, _lock: lock };
                run_dir.sweep()?;
                return Ok(run_dir);
            }
        }
        Err(TransportError::AlreadyRunning {
            run_id: run_id.to_owned(),
            detail: format!("{} changes hands", paths.run.display()),
        })
    }

    /// Tells actors where the services are.
    pub(super) fn post(&self, tag: &str, limits: &Limits) -> Result<(), TransportError> {
        let note = Note {
            format: FORMAT.to_owned(),
            run_id: self.paths.run_id.clone(),
            tag: tag.to_owned(),
            limits: limits.clone(),
        };
        let (new, path) = (self.paths.run.join("new"), self.paths.run.join("current"));
        let text = serde_json::to_vec(&note).map_err(|e| io_error(&new, &e.into()))?;
        fs::write(&new, text).map_err(|e| io_error(&new, &e))?;
        fs::rename(&new, &path).map_err(|e| io_error(&path, &e))
    }

    /// Removes everything but the lock: notes, bookkeeping directories, and the segments they name.
    fn sweep(&self) -> Result<(), TransportError> {
        // Refuses foreign notes before anything is removed.
        self.paths.note()?;
        let entries = fs::read_dir(&self.paths.run).map_err(|e| io_error(&self.paths.run, &e))?;
        for entry in entries {
            let path = entry.map_err(|e| io_error(&self.paths.run, &e))?.path();
            let name = path.file_name().and_then(|name| name.to_str());
            match name {
                Some("lock") => {}
                Some("new" | "current") => remove(fs::remove_file(&path), &path)?,
                Some(tag) if is_tag(tag) => {
                    remove(fs::remove_dir_all(&path), &path)?;
                    sweep_segments(tag)?;
                }
                _ => return Err(stale(&path, "is not of this version")),
            }
        }
        Ok(())
    }
}

impl Drop for RunDir {
    fn drop(&mut self) {
        let swept = self.sweep();
        if let Err(error) = swept {
            tracing::warn!(%error, "removing the run's shared-memory files");
            return;
        }
        // The lock goes last and by name while it is held: a learner that waits for it sees it vanish.
        let _ = fs::remove_file(self.paths.run.join("lock"));
        let _ = fs::remove_dir(&self.paths.run);
        // Other runs may still live there.
        let _ = fs::remove_dir(&self.paths.root);
    }
}

/// Removes what a killed learner of this run left. See [`clean_up`](crate::clean_up).
pub(crate) fn clean_up(config: &Iceoryx2Config, run_id: &str) -> Result<(), TransportError> {
    if RunPaths::new(config, run_id)?.run.exists() {
        drop(RunDir::acquire(config, run_id)?);
    }
    Ok(())
}

/// Removes the shared-memory segments of one learner process. Whoever still has them mapped keeps them.
pub(super) fn sweep_segments(tag: &str) -> Result<(), TransportError> {
    for path in segments(tag)? {
        remove(fs::remove_file(&path), &path)?;
    }
    Ok(())
}

/// The shared-memory segments of one learner process.
pub(super) fn segments(tag: &str) -> Result<Vec<PathBuf>, TransportError> {
    let directory = Path::new(SHM_DIR);
    let failed = |e: io::Error| io_error(directory, &e);
    let mut found = Vec::new();
    for entry in fs::read_dir(directory).map_err(failed)? {
        let path = entry.map_err(failed)?.path();
        let name = path.file_name().and_then(|name| name.to_str());
        if name.is_some_and(|name| name.starts_with(&prefix(tag))) {
            found.push(path);
        }
    }
    Ok(found)
}

/// How the names of one learner process's segments and sockets begin.
pub(super) fn prefix(tag: &str) -> String {
    format!("cd{tag}_")
}

pub(super) fn io_error(path: &Path, error: &io::Error) -> TransportError {
    if matches!(error.kind(), ErrorKind::PermissionDenied) {
        return stale(path, "is not accessible to this user");
    }
    TransportError::Backend(format!("{}: {error}", path.display()))
}

fn stale(path: &Path, reason: &str) -> TransportError {
    TransportError::Stale { path: path.to_owned(), reason: reason.to_owned() }
}

fn is_tag(name: &str) -> bool {
    name.len() == 8 && name.bytes().all(|b| b.is_ascii_hexdigit())
}

/// FNV-1a, 32 bits: names a directory; the note inside has the run id itself.
fn short_hash(text: &str) -> u32 {
    text.bytes().fold(0x811c_9dc5, |hash, byte| (hash ^ u32::from(byte)).wrapping_mul(0x0100_0193))
}

/// False where the folder above it is not there.
fn create_private(path: &Path) -> Result<bool, TransportError> {
    match DirBuilder::new().mode(0o700).create(path) {
        Err(e) if e.kind() == ErrorKind::NotFound => Ok(false),
        Err(e) if e.kind() != ErrorKind::AlreadyExists => Err(io_error(path, &e)),
        _ => Ok(true),
    }
}

/// A real directory, our own, closed to others: nobody else can have put anything into it. False where there
/// is none.
fn check_ours(path: &Path) -> Result<bool, TransportError> {
    let metadata = match fs::symlink_metadata(path) {
        Err(e) if e.kind() == ErrorKind::NotFound => return Ok(false),
        found => found.map_err(|e| io_error(path, &e))?,
    };
    if !metadata.is_dir() {
        return Err(stale(path, "is not a directory"));
    }
    let uid = metadata.uid();
    if uid != geteuid().as_raw() {
        return Err(stale(path, &format!("belongs to user {uid}")));
    }
    if metadata.mode() & 0o077 != 0 {
        return Err(stale(path, "is open to other users"));
    }
    Ok(true)
}

/// The lock on `path`; `None` when the file was removed meanwhile and the caller must start anew.
fn lock(path: &Path, run_id: &str) -> Result<Option<File>, TransportError> {
    let failed = |e: io::Error| io_error(path, &e);
    let file = File::options().create(true).truncate(false).write(true).open(path);
    let file = match file {
        Err(e) if e.kind() == ErrorKind::NotFound => return Ok(None),
        file => file.map_err(failed)?,
    };
    match file.try_lock() {
        Ok(()) => {}
        Err(TryLockError::WouldBlock) => {
            return Err(TransportError::AlreadyRunning {
                run_id: run_id.to_owned(),
                detail: format!("it holds {}", path.display()),
            });
        }
        Err(TryLockError::Error(e)) => return Err(failed(e)),
    }
    let held = file.metadata().map_err(failed)?;
    match fs::metadata(path) {
        Ok(named) if named.ino() == held.ino() => Ok(Some(file)),
        _ => Ok(None),
    }
}

/// Gone is gone, whoever removed it.
fn remove(result: io::Result<()>, path: &Path) -> Result<(), TransportError> {
    match result {
        Err(e) if e.kind() != ErrorKind::NotFound => Err(io_error(path, &e)),
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::PermissionsExt;

    use super::*;

    fn config(root: &Path) -> Iceoryx2Config {
        Iceoryx2Config { root: Some(root.join("r")), ..Iceoryx2Config::default() }
    }

    #[test]
    fn one_learner_owns_a_run_and_leaves_nothing() {
        let temp = tempfile::tempdir().unwrap();
        let config = config(temp.path());
        let first = RunDir::acquire(&config, "run").unwrap();
        let second = RunDir::acquire(&config, "run").err().unwrap();
        assert!(matches!(second, TransportError::AlreadyRunning { .. }));
        let other = RunDir::acquire(&config, "other").unwrap();
        drop(first);
        let again = RunDir::acquire(&config, "run").unwrap();
        drop((other, again));
        assert!(!temp.path().join("r").exists());
    }

    #[test]
    fn runs_begin_while_others_take_the_common_root_away() {
        let temp = tempfile::tempdir().unwrap();
        let config = config(temp.path());
        std::thread::scope(|scope| {
            for thread in 0..4 {
                let config = &config;
                scope.spawn(move || {
                    for _ in 0..200 {
                        drop(RunDir::acquire(config, &format!("run-{thread}")).unwrap());
                    }
                });
            }
        });
        assert!(!temp.path().join("r").exists());
    }

    #[test]
    fn what_a_killed_learner_left_is_removed() {
        let temp = tempfile::tempdir().unwrap();
        let config = config(temp.path());
        let killed = RunDir::acquire(&config, "run").unwrap();
        killed.post("0123abcd", &config.limits).unwrap();
        let paths = killed.paths.clone();
        assert_eq!(paths.note().unwrap().unwrap().tag, "0123abcd");
        fs::create_dir(paths.tag_dir("0123abcd")).unwrap();
        // Killed: the lock goes with the process, the files stay.
        let RunDir { _lock, .. } = &killed;
        _lock.unlock().unwrap();
        std::mem::forget(killed);
        clean_up(&config, "run").unwrap();
        assert!(!temp.path().join("r").exists());
        assert_eq!(paths.note(), Ok(None));
    }

    #[test]
    fn foreign_files_are_named_and_left_alone() {
        let temp = tempfile::tempdir().unwrap();
        let config = config(temp.path());
        let run = RunPaths::new(&config, "run").unwrap().run;
        let refused = || match RunDir::acquire(&config, "run") {
            Err(TransportError::Stale { path, .. }) => path,
            Err(other) => panic!("{other}"),
            Ok(_) => panic!("taken over"),
        };
        // A note of another version.
        create_private(&temp.path().join("r")).unwrap();
        create_private(&run).unwrap();
        fs::write(run.join("current"), "caudata-transport 0\n").unwrap();
        assert_eq!(refused(), run.join("current"));
        fs::remove_file(run.join("current")).unwrap();
        // A file that is not ours.
        fs::write(run.join("mine"), "").unwrap();
        assert_eq!(refused(), run.join("mine"));
        assert!(run.join("mine").exists());
        fs::remove_file(run.join("mine")).unwrap();
        // A directory that others can write to.
        fs::set_permissions(&run, fs::Permissions::from_mode(0o777)).unwrap();
        assert_eq!(refused(), run);
    }

    #[test]
    fn a_root_too_long_for_sockets_is_refused_at_once() {
        let config = Iceoryx2Config {
            root: Some(PathBuf::from("/").join("x".repeat(40))),
            ..Iceoryx2Config::default()
        };
        let error = RunPaths::new(&config, "run").unwrap_err();
        // 1 + 40 root, 9 run, 9 tag, 57 socket name = 116 of 107 bytes.
        assert!(error.to_string().contains("9 bytes too long"), "{error}");
    }
}
