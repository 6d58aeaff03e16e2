//! Files that are whole or absent: write to a temporary file, sync, rename, sync the folder.
//!
//! Everything that must survive a crash or a power cut (policies, checkpoints, the robot's state) is written
//! through this crate, so that the order of operations is right in one place: the bytes reach the disk before
//! the name does, and the name reaches the disk before the caller goes on.

mod bounded;
mod disk;
mod owner;
mod shipped;

use std::fs;
use std::io;
use std::path::{Path, PathBuf};

pub use bounded::{read_at_most, read_text_at_most};
pub use disk::{Disk, Folder, OsDisk, WriteFault};
pub use owner::{Owner, OwnerError};
pub use shipped::{set_home, shipped, shipped_flag};

/// Why a durable write failed. The file's earlier content, if any, is untouched.
#[derive(Debug, thiserror::Error)]
#[expect(missing_docs, reason = "a message says what its fields are")]
pub enum DurableError {
    /// No space, or a quota or file-size limit was hit.
    #[error("disk full while writing {path}: free some space and try again")]
    DiskFull { path: PathBuf },
    /// Any other failure of the operating system.
    #[error("cannot {action} {path}: {source}")]
    Io {
        /// What was tried, as a verb: "open", "write", "sync", "rename", ….
        action: &'static str,
        /// File or folder that it was tried on.
        path: PathBuf,
        /// The operating system's answer.
        source: io::Error,
    },
    /// [`create_new`] found the name taken.
    #[error("{path} exists already")]
    Exists { path: PathBuf },
}

impl DurableError {
    /// Sorts an operating-system error into the cases that callers tell apart.
    pub fn from_io(action: &'static str, path: &Path, source: io::Error) -> Self {
        let path = path.to_path_buf();
        match source.kind() {
            io::ErrorKind::StorageFull
            | io::ErrorKind::QuotaExceeded
            | io::ErrorKind::FileTooLarge => Self::DiskFull { path },
            io::ErrorKind::AlreadyExists => Self::Exists { path },
            _ => Self::Io { action, path, source },
        }
    }

    /// True where the system would not say that the bytes are on the disk. What is on it then is not known:
    /// writing on could build on sand, so that whoever keeps a store stops changing it.
    pub fn is_sync_failure(&self) -> bool {
        matches!(self, Self::Io { action: "sync", .. })
    }

    /// True where the cause is missing space.
    pub fn is_disk_full(&self) -> bool {
        matches!(self, Self::DiskFull { .. })
    }
}

/// Suffix of temporary files; a crash can leave some behind, [`remove_leftovers`] clears them.
pub const TEMPORARY_SUFFIX: &str = ".partial";

/// Replaces `path` by `bytes`: after a crash at any point the file holds the old bytes or the new ones.
///
/// # Errors
/// [`DurableError::DiskFull`] or [`DurableError::Io`]; the temporary file is removed and `path` is as it was.
pub fn replace(path: &Path, bytes: &[u8]) -> Result<(), DurableError> {
    replace_on(&OsDisk, path, bytes)
}

/// [`replace`] on a disk that may be a rehearsed one.
///
/// # Errors
/// As [`replace`].
pub fn replace_on(disk: &dyn Disk, path: &Path, bytes: &[u8]) -> Result<(), DurableError> {
    let folder = folder_of(disk, path)?;
    let temporary = write_temporary(disk, path, bytes)?;
    disk.rename(&temporary, path).map_err(|source| {
        let _ = disk.remove(&temporary);
        DurableError::from_io("rename", path, source)
    })?;
    sync(disk, &folder)
}

/// Like [`replace`], but refuses to touch a file that exists.
///
/// # Errors
/// [`DurableError::Exists`] where the name is taken, else as [`replace`].
pub fn create_new(path: &Path, bytes: &[u8]) -> Result<(), DurableError> {
    create_new_on(&OsDisk, path, bytes)
}

/// [`create_new`] on a disk that may be a rehearsed one.
///
/// # Errors
/// As [`create_new`].
pub fn create_new_on(disk: &dyn Disk, path: &Path, bytes: &[u8]) -> Result<(), DurableError> {
    let folder = folder_of(disk, path)?;
    let temporary = write_temporary(disk, path, bytes)?;
    // A hard link fails where the name is taken; a rename would silently replace it.
    let linked =
        disk.link(&temporary, path).map_err(|source| DurableError::from_io("create", path, source));
    let _ = disk.remove(&temporary);
    linked?;
    sync(disk, &folder)
}

/// Makes a folder and syncs the one above it, so that it survives a power cut. One that is there already is
/// fine.
pub fn make_folder_on(disk: &dyn Disk, path: &Path) -> Result<(), DurableError> {
    if path.is_dir() {
        return Ok(());
    }
    let above = folder_of(disk, path)?;
    disk.make_folder(path).map_err(|source| DurableError::from_io("make", path, source))?;
    sync(disk, &above)
}

/// Syncs a folder, so that names created or renamed in it survive a power cut.
///
/// # Errors
/// [`DurableError::Io`] where the folder cannot be opened or synced.
pub fn sync_folder(folder: &Path) -> Result<(), DurableError> {
    sync_folder_on(&OsDisk, folder)
}

/// [`sync_folder`] on a disk that may be a rehearsed one.
///
/// # Errors
/// As [`sync_folder`].
pub fn sync_folder_on(disk: &dyn Disk, folder: &Path) -> Result<(), DurableError> {
    let opened =
        disk.open_folder(folder).map_err(|source| DurableError::from_io("open", folder, source))?;
    sync(disk, &opened)
}

/// Removes what interrupted writes left in `folder`; answers how many files that were.
///
/// # Errors
/// [`DurableError::Io`] where the folder cannot be read.
pub fn remove_leftovers(folder: &Path) -> Result<usize, DurableError> {
    let entries =
        fs::read_dir(folder).map_err(|source| DurableError::from_io("read", folder, source))?;
    let mut removed = 0;
    for entry in entries.flatten() {
        let is_leftover = entry.file_name().to_string_lossy().ends_with(TEMPORARY_SUFFIX);
        if is_leftover && fs::remove_file(entry.path()).is_ok() {
            removed += 1;
        }
    }
    Ok(removed)
}

/// Writes and syncs the temporary file beside `path`; on failure nothing is left behind.
fn write_temporary(disk: &dyn Disk, path: &Path, bytes: &[u8]) -> Result<PathBuf, DurableError> {
    let temporary = temporary_path(path);
    disk.write_synced(&temporary, bytes).map_err(|(action, source)| {
        let _ = disk.remove(&temporary);
        DurableError::from_io(action, path, source)
    })?;
    Ok(temporary)
}

fn temporary_path(path: &Path) -> PathBuf {
    let mut name = path.file_name().unwrap_or_default().to_os_string();
    // The process id keeps two processes that write the same name from sharing a temporary file.
    name.push(format!(".{}{TEMPORARY_SUFFIX}", std::process::id()));
    path.with_file_name(name)
}

/// The folder that `path` lies in, open.
fn folder_of(disk: &dyn Disk, path: &Path) -> Result<Folder, DurableError> {
    let folder = match path.parent() {
        Some(folder) if !folder.as_os_str().is_empty() => folder,
        _ => Path::new("."),
    };
    disk.open_folder(folder).map_err(|source| DurableError::from_io("open", path, source))
}

fn sync(disk: &dyn Disk, folder: &Folder) -> Result<(), DurableError> {
    disk.sync_folder(folder).map_err(|source| DurableError::from_io("sync", folder.path(), source))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn replace_leaves_exactly_the_new_bytes() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("state");
        replace(&path, b"old and longer").unwrap();
        replace(&path, b"new").unwrap();
        assert_eq!(fs::read(&path).unwrap(), b"new");
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1);
    }

    #[test]
    fn create_new_refuses_a_taken_name_and_keeps_its_bytes() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("blob");
        create_new(&path, b"first").unwrap();
        let error = create_new(&path, b"second").unwrap_err();
        assert!(matches!(error, DurableError::Exists { .. }));
        assert_eq!(fs::read(&path).unwrap(), b"first");
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1);
    }

    #[test]
    fn a_missing_folder_is_an_error_that_names_the_file() {
        let folder = tempfile::tempdir().unwrap();
        let error = replace(&folder.path().join("none/state"), b"x").unwrap_err();
        assert!(error.to_string().contains("none/state"), "{error}");
    }

    #[test]
    fn out_of_space_is_told_apart() {
        let source = io::Error::from(io::ErrorKind::StorageFull);
        let error = DurableError::from_io("write", Path::new("blob"), source);
        assert!(error.is_disk_full());
        assert_eq!(
            error.to_string(),
            "disk full while writing blob: free some space and try again"
        );
    }

    #[test]
    fn leftovers_of_a_crash_are_removed_and_nothing_else() {
        let folder = tempfile::tempdir().unwrap();
        fs::write(folder.path().join("a.77.partial"), b"torn").unwrap();
        fs::write(folder.path().join("a"), b"whole").unwrap();
        assert_eq!(remove_leftovers(folder.path()).unwrap(), 1);
        assert!(folder.path().join("a").exists());
    }
}
