//! Folders of files that are whole or absent.
//!
//! `checkpoints/iter_000123/` holds the files of one checkpoint and `SHA256SUMS` (as `sha256sum -c` reads
//! it), which names them all. A folder is filled under a temporary name, synced, renamed, and only then does
//! `checkpoints/latest` point to it; so after a crash at any point `latest` names a whole checkpoint.

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::{self, Write};
use std::path::{Path, PathBuf};

use caudata_durable::{DurableError, replace, sync_folder};
use caudata_proto::hex::hex;
use sha2::{Digest, Sha256};

use crate::LearnerError;

/// Version of the meaning of the files.
pub const FORMAT: u32 = 1;
const LATEST: &str = "latest";
const SUMS: &str = "SHA256SUMS";
const PREFIX: &str = "iter_";
/// Ending of folders that a crash may leave behind.
const PARTIAL: &str = ".partial";

/// File name and content.
pub type Files = BTreeMap<String, Vec<u8>>;

/// The checkpoints of one run.
#[derive(Clone, Debug)]
pub struct CheckpointStore {
    root: PathBuf,
    keep: usize,
    /// How a file is written; tests put failures here.
    write: fn(&Path, &[u8]) -> io::Result<()>,
}

impl CheckpointStore {
    /// The checkpoints under `root`, of which the newest `keep` stay.
    pub fn new(root: PathBuf, keep: usize) -> Self {
        Self { root, keep: keep.max(1), write: write_synced }
    }

    /// Where they lie.
    pub fn root(&self) -> &Path {
        &self.root
    }

    /// Saves `files` as the checkpoint of `iteration` and answers its folder. One of the same iteration is
    /// replaced.
    ///
    /// # Errors
    /// [`LearnerError::Durable`] when the disk is full or fails; what was saved before is untouched.
    pub fn save(&self, iteration: u64, files: &Files) -> Result<PathBuf, LearnerError> {
        fs::create_dir_all(&self.root).map_err(io_error("create", &self.root))?;
        self.remove_leftovers();
        let name = name_of(iteration);
        let partial = self.root.join(format!("{name}{PARTIAL}"));
        let result = self.fill(&partial, files).and_then(|()| self.install(&partial, &name));
        if result.is_err() {
            let _ = fs::remove_dir_all(&partial);
        }
        result?;
        self.prune(&name);
        Ok(self.root.join(name))
    }

    /// The checkpoint that `latest` points to, checked; its folder and its files. `None` when there is none.
    ///
    /// # Errors
    /// [`LearnerError::CheckpointDamaged`], which names the newest other one that is whole.
    pub fn load_latest(&self) -> Result<Option<(PathBuf, Files)>, LearnerError> {
        let pointer = self.root.join(LATEST);
        match fs::read(&pointer) {
            Ok(text) => self.load(String::from_utf8_lossy(&text).trim()).map(Some),
            Err(error) if error.kind() == io::ErrorKind::NotFound => {
                // The first save was cut off before it could point to its folder, or `latest` is gone.
                match self.names().last() {
                    None => Ok(None),
                    Some(name) => self.load(name).map(Some),
                }
            }
            Err(error) => {
                Err(LearnerError::Durable(DurableError::from_io("read", &pointer, error)))
            }
        }
    }

    /// The checkpoint called `name`, checked.
    ///
    /// # Errors
    /// [`LearnerError::CheckpointDamaged`], which names the newest other one that is whole.
    pub fn load(&self, name: &str) -> Result<(PathBuf, Files), LearnerError> {
        let folder = self.root.join(name);
        let checked = match iteration_of(name) {
            Some(_) => verified(&folder),
            None => Err("it is not called iter_ and a number".to_owned()),
        };
        match checked {
            Ok(files) => Ok((folder, files)),
            Err(reason) => Err(self.damaged(&folder, reason)),
        }
    }

    /// The error for a checkpoint in `folder` that cannot be used.
    pub fn damaged(&self, folder: &Path, reason: String) -> LearnerError {
        let whole = |name: &String| {
            let other = self.root.join(name);
            other != folder && verified(&other).is_ok()
        };
        let good = self.names().into_iter().rev().find(whole);
        LearnerError::CheckpointDamaged { path: folder.to_owned(), reason, good }
    }

    /// Names of all checkpoints, oldest first.
    pub fn names(&self) -> Vec<String> {
        let entries = fs::read_dir(&self.root).into_iter().flatten().flatten();
        let mut names: Vec<(u64, String)> = entries
            .filter_map(|entry| {
                let name = entry.file_name().into_string().ok()?;
                Some((iteration_of(&name)?, name))
            })
            .collect();
        names.sort_unstable();
        names.into_iter().map(|(_, name)| name).collect()
    }

    fn fill(&self, partial: &Path, files: &Files) -> Result<(), LearnerError> {
        fs::create_dir(partial).map_err(io_error("create", partial))?;
        let mut sums = String::new();
        for (name, bytes) in files {
            let path = partial.join(name);
            (self.write)(&path, bytes).map_err(io_error("write", &path))?;
            sums += &format!("{}  {name}\n", hex(&Sha256::digest(bytes)));
        }
        let path = partial.join(SUMS);
        (self.write)(&path, sums.as_bytes()).map_err(io_error("write", &path))?;
        Ok(sync_folder(partial)?)
    }

    /// Gives the folder its name, then points to it.
    fn install(&self, partial: &Path, name: &str) -> Result<(), LearnerError> {
        let folder = self.root.join(name);
        let replaced = self.root.join(format!("{name}.old{PARTIAL}"));
        if folder.exists() {
            fs::rename(&folder, &replaced).map_err(io_error("rename", &folder))?;
        }
        if let Err(error) = fs::rename(partial, &folder) {
            let _ = fs::rename(&replaced, &folder);
            return Err(io_error("rename", &folder)(error));
        }
        let _ = fs::remove_dir_all(&replaced);
        sync_folder(&self.root)?;
        Ok(replace(&self.root.join(LATEST), name.as_bytes())?)
    }

    /// Removes all but the newest. Failing to do so harms nobody and is tried again next time.
    fn prune(&self, newest: &str) {
        let names = self.names();
        let surplus = names.len().saturating_sub(self.keep);
        for name in names.iter().take(surplus).filter(|name| *name != newest) {
            // Renamed first, so that no half-removed folder looks like a checkpoint.
            let doomed = self.root.join(format!("{name}.old{PARTIAL}"));
            if fs::rename(self.root.join(name), &doomed).is_ok() {
                let _ = fs::remove_dir_all(doomed);
            }
        }
    }

    fn remove_leftovers(&self) {
        for entry in fs::read_dir(&self.root).into_iter().flatten().flatten() {
            let name = entry.file_name().to_string_lossy().into_owned();
            if name.starts_with(PREFIX) && name.ends_with(PARTIAL) {
                let _ = fs::remove_dir_all(entry.path());
            }
        }
    }
}

fn name_of(iteration: u64) -> String {
    format!("{PREFIX}{iteration:06}")
}

/// The iteration in a folder's name; `None` for anything that is not a checkpoint's name.
fn iteration_of(name: &str) -> Option<u64> {
    let digits = name.strip_prefix(PREFIX)?;
    let iteration = digits.parse().ok()?;
    (name_of(iteration) == name).then_some(iteration)
}

/// The files of a folder, each with the hash that `SHA256SUMS` says; or what is wrong.
fn verified(folder: &Path) -> Result<Files, String> {
    let read = |name: &str| {
        fs::read(folder.join(name)).map_err(|error| format!("{name} cannot be read: {error}"))
    };
    let sums = String::from_utf8(read(SUMS)?).map_err(|_| format!("{SUMS} is not text"))?;
    if !sums.ends_with('\n') {
        return Err(format!("{SUMS} is cut off"));
    }
    let mut files = Files::new();
    for line in sums.lines() {
        let (sum, name) = line.split_once("  ").ok_or(format!("{SUMS} is not a list of sums"))?;
        if name.contains('/') {
            return Err(format!("{SUMS} names a file outside the folder"));
        }
        let bytes = read(name)?;
        if hex(&Sha256::digest(&bytes)) != sum {
            return Err(format!(
                "{name} ({} bytes) does not have the SHA-256 in {SUMS}",
                bytes.len()
            ));
        }
        files.insert(name.to_owned(), bytes);
    }
    Ok(files)
}

fn write_synced(path: &Path, bytes: &[u8]) -> io::Result<()> {
    let mut file = File::create_new(path)?;
    file.write_all(bytes)?;
    file.sync_all()
}

fn io_error(action: &'static str, path: &Path) -> impl FnOnce(io::Error) -> LearnerError {
    move |error| LearnerError::Durable(DurableError::from_io(action, path, error))
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::cell::Cell;

    fn files(text: &str) -> Files {
        let named = |name: &str| (name.to_owned(), format!("{text} {name}").into_bytes());
        Files::from([named("meta.json"), named("state.safetensors")])
    }

    fn store(keep: usize) -> (tempfile::TempDir, CheckpointStore) {
        let dir = tempfile::tempdir().unwrap();
        let store = CheckpointStore::new(dir.path().join("checkpoints"), keep);
        (dir, store)
    }

    #[test]
    fn the_newest_is_found_and_only_some_are_kept() {
        let (_dir, store) = store(2);
        assert!(store.load_latest().unwrap().is_none());
        for iteration in [5, 10, 15] {
            store.save(iteration, &files(&iteration.to_string())).unwrap();
        }
        let (folder, loaded) = store.load_latest().unwrap().unwrap();
        assert!(folder.ends_with("iter_000015"));
        assert_eq!(loaded, files("15"));
        assert_eq!(store.names(), ["iter_000010", "iter_000015"]);
        store.save(15, &files("again")).unwrap();
        assert_eq!(store.load_latest().unwrap().unwrap().1, files("again"));
        let left: Vec<_> = fs::read_dir(store.root()).unwrap().collect();
        assert_eq!(left.len(), 3, "two checkpoints and the pointer: {left:?}");
    }

    #[test]
    fn a_pointer_with_any_bit_flipped_names_a_whole_one_or_is_refused() {
        let (_dir, store) = store(3);
        store.save(1, &files("1")).unwrap();
        store.save(2, &files("2")).unwrap();
        let pointer = store.root.join(LATEST);
        let whole = fs::read(&pointer).unwrap();
        for bit in 0..8 * whole.len() {
            let mut flipped = whole.clone();
            flipped[bit / 8] ^= 1 << (bit % 8);
            fs::write(&pointer, &flipped).unwrap();
            match store.load_latest() {
                Ok(loaded) => assert!([files("1"), files("2")].contains(&loaded.unwrap().1)),
                Err(LearnerError::CheckpointDamaged { good, .. }) => {
                    assert_eq!(good.as_deref(), Some("iter_000002"), "bit {bit}");
                }
                Err(error) => panic!("bit {bit}: {error}"),
            }
        }
    }

    #[test]
    fn damage_is_noticed_and_the_good_one_named() {
        let (_dir, store) = store(3);
        store.save(1, &files("1")).unwrap();
        let folder = store.save(2, &files("2")).unwrap();
        let state = folder.join("state.safetensors");
        let whole = fs::read(&state).unwrap();
        let refused = |what: &str| {
            let error = store.load_latest().unwrap_err();
            assert_eq!(error.exit_code().number(), 78);
            let LearnerError::CheckpointDamaged { path, reason, good } = error else {
                panic!("{error}")
            };
            assert_eq!((path.as_path(), good.as_deref()), (folder.as_path(), Some("iter_000001")));
            assert!(reason.contains(what), "{reason}");
        };
        for cut in [0, 1, whole.len() - 1] {
            fs::write(&state, &whole[..cut]).unwrap();
            refused("state.safetensors");
        }
        let mut flipped = whole.clone();
        flipped[3] ^= 1;
        fs::write(&state, flipped).unwrap();
        refused("does not have the SHA-256");
        fs::remove_file(&state).unwrap();
        refused("cannot be read");
        fs::write(&state, &whole).unwrap();
        let sums = fs::read(folder.join(SUMS)).unwrap();
        fs::write(folder.join(SUMS), &sums[..sums.len() - 1]).unwrap();
        refused("cut off");
        assert_eq!(store.load("iter_000001").unwrap().1, files("1"));
        assert!(store.load("../iter_000001").is_err());
    }

    thread_local! {
        /// Writes that succeed before the disk is full.
        static ROOM: Cell<usize> = const { Cell::new(0) };
    }

    fn write_until_full(path: &Path, bytes: &[u8]) -> io::Result<()> {
        let room = ROOM.get();
        ROOM.set(room.saturating_sub(1));
        if room == 0 {
            // Half of the file gets through, as on a real disk.
            let _ = fs::write(path, &bytes[..bytes.len() / 2]);
            return Err(io::ErrorKind::StorageFull.into());
        }
        write_synced(path, bytes)
    }

    #[test]
    fn a_full_disk_costs_nothing_that_was_saved() {
        let (_dir, mut store) = store(3);
        store.save(1, &files("1")).unwrap();
        store.write = write_until_full;
        // Two files and the sums: each write fails once.
        for room in 0..3 {
            ROOM.set(room);
            let error = store.save(2, &files("2")).unwrap_err();
            assert_eq!(error.exit_code().number(), 74);
            assert!(error.to_string().contains("disk full"), "{error}");
            assert_eq!(store.load_latest().unwrap().unwrap().1, files("1"));
            assert_eq!(store.names(), ["iter_000001"]);
        }
        ROOM.set(3);
        store.save(2, &files("2")).unwrap();
        assert_eq!(store.load_latest().unwrap().unwrap().1, files("2"));
    }

    #[test]
    fn what_a_crash_leaves_behind_is_no_checkpoint() {
        let (_dir, store) = store(3);
        store.save(1, &files("1")).unwrap();
        let partial = store.root().join("iter_000002.partial");
        fs::create_dir(&partial).unwrap();
        fs::write(partial.join("meta.json"), "half").unwrap();
        assert!(store.load_latest().unwrap().unwrap().0.ends_with("iter_000001"));
        store.save(2, &files("2")).unwrap();
        assert!(!partial.exists());
        // Without the pointer the newest whole one is taken.
        fs::remove_file(store.root().join(LATEST)).unwrap();
        assert!(store.load_latest().unwrap().unwrap().0.ends_with("iter_000002"));
    }
}
