//! The operations that change a disk, one by one, so that a test can cut a sequence of them anywhere.

use std::fmt::Debug;
use std::fs::{self, File, OpenOptions};
use std::io::{self, Write};
use std::path::{Path, PathBuf};

/// What went wrong, and at which part of a write: "open", "write" or "sync".
pub type WriteFault = (&'static str, io::Error);

/// An open folder, whose names can be synced.
#[derive(Debug)]
pub struct Folder {
    path: PathBuf,
    handle: File,
}

impl Folder {
    /// Where it is.
    pub fn path(&self) -> &Path {
        &self.path
    }
}

/// What changes a disk. [`OsDisk`] is the real one, that of `tests/rehearsal` writes down what was done.
pub trait Disk: Debug + Send + Sync {
    /// Makes one folder; one that is there already is fine.
    fn make_folder(&self, path: &Path) -> io::Result<()>;

    /// Makes or empties a file, writes `bytes` and waits until they are on the disk. Its name need not be.
    ///
    /// # Errors
    /// Which part failed, and what the system says.
    fn write_synced(&self, path: &Path, bytes: &[u8]) -> Result<(), WriteFault>;

    /// Adds `bytes` to the end of a file, which is made where it is absent, and waits until they are on the
    /// disk.
    ///
    /// # Errors
    /// As [`Disk::write_synced`].
    fn append_synced(&self, path: &Path, bytes: &[u8]) -> Result<(), WriteFault>;

    /// Cuts a file to `length` bytes and waits until that is on the disk.
    ///
    /// # Errors
    /// As [`Disk::write_synced`].
    fn cut_synced(&self, path: &Path, length: u64) -> Result<(), WriteFault>;

    /// Opens a folder for [`Disk::sync_folder`]. Done before anything changes: a process that has no file
    /// handle left then fails harmlessly, and does not take that for a disk that lost something.
    fn open_folder(&self, folder: &Path) -> io::Result<Folder>;

    /// Waits until the names in a folder are on the disk.
    fn sync_folder(&self, folder: &Folder) -> io::Result<()>;

    /// Gives a file another name, in place of what has it.
    fn rename(&self, from: &Path, to: &Path) -> io::Result<()>;

    /// Gives a file a second name, which must be free.
    fn link(&self, from: &Path, to: &Path) -> io::Result<()>;

    /// Takes a name away.
    fn remove(&self, path: &Path) -> io::Result<()>;
}

/// The file system of the operating system.
#[derive(Clone, Copy, Debug, Default)]
pub struct OsDisk;

impl OsDisk {
    fn write(options: &mut OpenOptions, path: &Path, bytes: &[u8]) -> Result<(), WriteFault> {
        let mut file = options.open(path).map_err(|e| ("open", e))?;
        file.write_all(bytes).map_err(|e| ("write", e))?;
        // On the handle that wrote: another one need not hear of an error.
        file.sync_all().map_err(|e| ("sync", e))
    }
}

impl Disk for OsDisk {
    fn make_folder(&self, path: &Path) -> io::Result<()> {
        match fs::create_dir(path) {
            Err(error) if error.kind() == io::ErrorKind::AlreadyExists => Ok(()),
            other => other,
        }
    }

    fn write_synced(&self, path: &Path, bytes: &[u8]) -> Result<(), WriteFault> {
        let mut options = OpenOptions::new();
        Self::write(options.write(true).create(true).truncate(true), path, bytes)
    }

    fn append_synced(&self, path: &Path, bytes: &[u8]) -> Result<(), WriteFault> {
        Self::write(OpenOptions::new().append(true).create(true), path, bytes)
    }

    fn cut_synced(&self, path: &Path, length: u64) -> Result<(), WriteFault> {
        let opened = OpenOptions::new().write(true).open(path);
        let file = opened.map_err(|e| ("open", e))?;
        file.set_len(length).map_err(|e| ("write", e))?;
        file.sync_all().map_err(|e| ("sync", e))
    }

    fn open_folder(&self, folder: &Path) -> io::Result<Folder> {
        Ok(Folder { path: folder.to_owned(), handle: File::open(folder)? })
    }

    fn sync_folder(&self, folder: &Folder) -> io::Result<()> {
        folder.handle.sync_all()
    }

    fn rename(&self, from: &Path, to: &Path) -> io::Result<()> {
        fs::rename(from, to)
    }

    fn link(&self, from: &Path, to: &Path) -> io::Result<()> {
        fs::hard_link(from, to)
    }

    fn remove(&self, path: &Path) -> io::Result<()> {
        fs::remove_file(path)
    }
}
