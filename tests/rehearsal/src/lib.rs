//! A disk for tests: it does what it is told on a real folder, writes every step down, can fail at any of
//! them, and can afterwards show what a power cut at any point could have left.
//!
//! What a file system promises, and no more: bytes are on the disk once the file was synced, names once their
//! folder was. Before that each of them may be there or not, in any combination; bytes may be there by half.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, MutexGuard, PoisonError};

use caudata_durable::{Disk, Folder, OsDisk, WriteFault};

/// Combinations of unsynced steps that are shown for one cut at most.
const COMBINATIONS_MAX: usize = 1 << 12;

/// One step, the smallest that a cut can fall between.
#[derive(Clone, Debug)]
enum Step {
    /// A folder appears.
    Folder(PathBuf),
    /// Names change together: to a file (by number), or away.
    Names(Vec<(PathBuf, Option<usize>)>),
    /// A file's bytes from `at` on become these, and end there.
    Bytes { file: usize, at: usize, bytes: Vec<u8> },
    /// The file's bytes are on the disk.
    SyncedFile(usize),
    /// The folder's names are on the disk.
    SyncedFolder(PathBuf),
}

#[derive(Debug, Default)]
struct Notes {
    steps: Vec<Step>,
    /// Where each name leads, with everything applied.
    names: BTreeMap<PathBuf, usize>,
    files: usize,
    fail: Option<Failing>,
}

/// From which step on what fails.
#[derive(Clone, Copy, Debug)]
struct Failing {
    step: usize,
    /// Bytes and names are refused.
    writes: bool,
    /// Waiting for the disk is refused.
    syncs: bool,
    /// Opening is refused.
    opens: bool,
    /// A number of the system.
    error: i32,
}

/// See the module.
#[derive(Debug)]
pub struct Rehearsal {
    root: PathBuf,
    notes: Mutex<Notes>,
}

impl Rehearsal {
    /// Over `root`; what is there already counts as being on the disk.
    ///
    /// # Errors
    /// What the system says.
    pub fn new(root: &Path) -> io::Result<Self> {
        let mut notes = Notes::default();
        let mut folders = vec![root.to_owned()];
        while let Some(folder) = folders.pop() {
            notes.steps.push(Step::Folder(folder.clone()));
            for entry in fs::read_dir(&folder)? {
                let path = entry?.path();
                if path.is_dir() {
                    folders.push(path);
                    continue;
                }
                let file = notes.new_file();
                let bytes = fs::read(&path)?;
                notes.steps.push(Step::Bytes { file, at: 0, bytes });
                notes.steps.push(Step::SyncedFile(file));
                notes.name(vec![(path, Some(file))]);
            }
            notes.steps.push(Step::SyncedFolder(folder.clone()));
            if let Some(above) = folder.parent() {
                notes.steps.push(Step::SyncedFolder(above.to_owned()));
            }
        }
        Ok(Self { root: root.to_owned(), notes: Mutex::new(notes) })
    }

    fn notes(&self) -> MutexGuard<'_, Notes> {
        self.notes.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// How many steps were done.
    pub fn steps(&self) -> usize {
        self.notes().steps.len()
    }

    /// From step number `step` on (counted from the beginning, 0 the first) bytes and names are refused with
    /// `error`, a number of the system; half of the bytes of a write that is refused are there.
    pub fn fail_writes_at(&self, step: usize, error: i32) {
        self.fail(step, [true, false, false], error);
    }

    /// From step number `step` on every wait for the disk fails.
    pub fn fail_syncs_at(&self, step: usize, error: i32) {
        self.fail(step, [false, true, false], error);
    }

    /// From step number `step` on nothing can be opened, as in a process that has no file handle left.
    pub fn fail_opens_at(&self, step: usize, error: i32) {
        self.fail(step, [false, false, true], error);
    }

    fn fail(&self, step: usize, [writes, syncs, opens]: [bool; 3], error: i32) {
        self.notes().fail = Some(Failing { step, writes, syncs, opens, error });
    }

    /// Nothing fails any more.
    pub fn heal(&self) {
        self.notes().fail = None;
    }

    /// Writes into new folders below `below` what a power cut after `step` steps could have left: each
    /// combination of what was not synced then. Answers the folders, at most [`COMBINATIONS_MAX`].
    ///
    /// # Errors
    /// What the system says.
    pub fn cut(&self, step: usize, below: &Path) -> io::Result<Vec<PathBuf>> {
        let notes = self.notes();
        let done = notes.steps.get(..step).unwrap_or(&notes.steps);
        let (mut settled, mut open) = (BTreeSet::new(), Vec::new());
        for (number, step) in done.iter().enumerate() {
            match step {
                Step::SyncedFile(file) => settle(
                    &mut open,
                    &mut settled,
                    |n| matches!(&done[n], Step::Bytes { file: f, .. } if f == file),
                ),
                Step::SyncedFolder(folder) => settle(&mut open, &mut settled, |n| match &done[n] {
                    Step::Names(names) => names.iter().any(|(p, _)| p.parent() == Some(folder)),
                    Step::Folder(path) => path.parent() == Some(folder),
                    _ => false,
                }),
                _ => open.push(number),
            }
        }
        // Each open step is there (2), by half where it is bytes (1), or not (0).
        let ways: Vec<usize> = open
            .iter()
            .map(|n| if matches!(done[*n], Step::Bytes { .. }) { 3 } else { 2 })
            .collect();
        let all = ways.iter().product::<usize>().min(COMBINATIONS_MAX);
        (0..all)
            .map(|mut choice| {
                let mut chosen = BTreeMap::new();
                for (number, ways) in open.iter().zip(&ways) {
                    let way = choice % ways;
                    choice /= ways;
                    chosen.insert(*number, if *ways == 2 { 2 * way } else { way });
                }
                let folder = below.join(format!("{step}-{}", chosen_name(&chosen)));
                let part = |n: usize| {
                    if settled.contains(&n) { 2 } else { chosen.get(&n).copied().unwrap_or(0) }
                };
                build(done, part, &self.root, &folder)?;
                Ok(folder)
            })
            .collect()
    }
}

fn chosen_name(chosen: &BTreeMap<usize, usize>) -> String {
    chosen.values().map(ToString::to_string).collect()
}

fn settle(open: &mut Vec<usize>, settled: &mut BTreeSet<usize>, of_it: impl Fn(usize) -> bool) {
    open.retain(|number| {
        let now = of_it(*number);
        if now {
            settled.insert(*number);
        }
        !now
    });
}

/// Applies the steps, each whole, by half or not, and writes the result below `folder`.
fn build(
    done: &[Step],
    part: impl Fn(usize) -> usize,
    root: &Path,
    folder: &Path,
) -> io::Result<()> {
    let mut names: BTreeMap<&Path, usize> = BTreeMap::new();
    let mut files: BTreeMap<usize, Vec<u8>> = BTreeMap::new();
    let mut folders: Vec<&Path> = Vec::new();
    for (number, step) in done.iter().enumerate() {
        match (step, part(number)) {
            (_, 0) | (Step::SyncedFile(_) | Step::SyncedFolder(_), _) => {}
            (Step::Folder(path), _) => folders.push(path),
            (Step::Names(changes), _) => {
                for (path, file) in changes {
                    match file {
                        Some(file) => names.insert(path, *file),
                        None => names.remove(path.as_path()),
                    };
                }
            }
            (Step::Bytes { file, at, bytes }, share) => {
                let content = files.entry(*file).or_default();
                content.resize(*at, 0);
                content.extend_from_slice(&bytes[..bytes.len() * share / 2]);
            }
        }
    }
    let place = |path: &Path| path.strip_prefix(root).map(|inner| folder.join(inner));
    fs::create_dir_all(folder)?;
    for path in folders {
        if let Ok(path) = place(path) {
            fs::create_dir_all(path)?;
        }
    }
    for (path, file) in names {
        // A file in a folder that is not there is not there either.
        if let Ok(path) = place(path)
            && path.parent().is_some_and(Path::is_dir)
        {
            fs::write(path, files.get(&file).map(Vec::as_slice).unwrap_or_default())?;
        }
    }
    Ok(())
}

impl Notes {
    fn new_file(&mut self) -> usize {
        self.files += 1;
        self.files
    }

    fn name(&mut self, changes: Vec<(PathBuf, Option<usize>)>) {
        for (path, file) in &changes {
            match file {
                Some(file) => self.names.insert(path.clone(), *file),
                None => self.names.remove(path),
            };
        }
        self.steps.push(Step::Names(changes));
    }

    /// Whether the step that comes now fails.
    fn fails(&self, of_it: impl Fn(&Failing) -> bool) -> Option<io::Error> {
        let failing = self.fail.filter(|f| of_it(f) && self.steps.len() >= f.step)?;
        Some(io::Error::from_raw_os_error(failing.error))
    }

    fn check_write(&self) -> io::Result<()> {
        self.fails(|f| f.writes).map_or(Ok(()), Err)
    }

    fn check_sync(&self) -> io::Result<()> {
        self.fails(|f| f.syncs).map_or(Ok(()), Err)
    }

    fn check_open(&self) -> io::Result<()> {
        self.fails(|f| f.opens).map_or(Ok(()), Err)
    }

    /// The file of `path`, which is made where it is absent.
    fn file(&mut self, path: &Path) -> usize {
        if let Some(file) = self.names.get(path) {
            return *file;
        }
        let file = self.new_file();
        self.name(vec![(path.to_owned(), Some(file))]);
        file
    }

    /// Bytes of `path` from `at` on; a failing write leaves half of them.
    fn bytes(&mut self, path: &Path, at: usize, bytes: &[u8]) -> Result<(), WriteFault> {
        self.check_open().map_err(|e| ("open", e))?;
        // Cutting a file needs no space.
        let needs_space = !bytes.is_empty();
        if needs_space {
            self.check_write().map_err(|e| ("write", e))?;
        }
        let file = self.file(path);
        let failed = self.fails(|f| f.writes && needs_space);
        let got = if failed.is_some() { bytes.len() / 2 } else { bytes.len() };
        let mut whole = fs::read(path).unwrap_or_default();
        whole.truncate(at);
        whole.extend_from_slice(&bytes[..got]);
        fs::write(path, whole).map_err(|e| ("write", e))?;
        let bytes = bytes[..got].to_vec();
        self.steps.push(Step::Bytes { file, at, bytes });
        if let Some(error) = failed {
            return Err(("write", error));
        }
        self.check_sync().map_err(|e| ("sync", e))?;
        self.steps.push(Step::SyncedFile(file));
        Ok(())
    }
}

impl Disk for Rehearsal {
    fn make_folder(&self, path: &Path) -> io::Result<()> {
        let mut notes = self.notes();
        notes.check_write()?;
        OsDisk.make_folder(path)?;
        notes.steps.push(Step::Folder(path.to_owned()));
        Ok(())
    }

    fn write_synced(&self, path: &Path, bytes: &[u8]) -> Result<(), WriteFault> {
        self.notes().bytes(path, 0, bytes)
    }

    fn append_synced(&self, path: &Path, bytes: &[u8]) -> Result<(), WriteFault> {
        let at = fs::metadata(path).map_or(0, |meta| meta.len());
        self.notes().bytes(path, usize::try_from(at).unwrap_or(usize::MAX), bytes)
    }

    fn cut_synced(&self, path: &Path, length: u64) -> Result<(), WriteFault> {
        self.notes().bytes(path, usize::try_from(length).unwrap_or(usize::MAX), &[])
    }

    fn open_folder(&self, folder: &Path) -> io::Result<Folder> {
        self.notes().check_open()?;
        OsDisk.open_folder(folder)
    }

    fn sync_folder(&self, folder: &Folder) -> io::Result<()> {
        let mut notes = self.notes();
        notes.check_sync()?;
        notes.steps.push(Step::SyncedFolder(folder.path().to_owned()));
        Ok(())
    }

    fn rename(&self, from: &Path, to: &Path) -> io::Result<()> {
        let mut notes = self.notes();
        notes.check_write()?;
        OsDisk.rename(from, to)?;
        let file = notes.file(from);
        notes.name(vec![(from.to_owned(), None), (to.to_owned(), Some(file))]);
        Ok(())
    }

    fn link(&self, from: &Path, to: &Path) -> io::Result<()> {
        let mut notes = self.notes();
        notes.check_write()?;
        OsDisk.link(from, to)?;
        let file = notes.file(from);
        notes.name(vec![(to.to_owned(), Some(file))]);
        Ok(())
    }

    fn remove(&self, path: &Path) -> io::Result<()> {
        let mut notes = self.notes();
        OsDisk.remove(path)?;
        notes.name(vec![(path.to_owned(), None)]);
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Every content that a cut anywhere in a replacement can leave.
    fn left_by(write: impl Fn(&dyn Disk, &Path)) -> BTreeSet<Option<Vec<u8>>> {
        let folder = tempfile::tempdir().unwrap();
        let (root, cuts) = (folder.path().join("root"), folder.path().join("cuts"));
        fs::create_dir(&root).unwrap();
        fs::write(root.join("state"), b"old").unwrap();
        let disk = Rehearsal::new(&root).unwrap();
        let before = disk.steps();
        write(&disk, &root.join("state"));
        let cut = |step| disk.cut(step, &cuts).unwrap();
        (before..=disk.steps())
            .flat_map(cut)
            .map(|left| fs::read(left.join("state")).ok())
            .collect()
    }

    #[test]
    fn a_replaced_file_is_the_old_one_or_the_new_one_whenever_power_goes() {
        let left = left_by(|disk, path| caudata_durable::replace_on(disk, path, b"fresh").unwrap());
        let whole = [b"old".to_vec(), b"fresh".to_vec()];
        assert_eq!(left, whole.map(Some).into_iter().collect());
    }

    #[test]
    fn a_file_written_in_place_is_seen_to_be_torn() {
        let left = left_by(|disk, path| disk.write_synced(path, b"fresh").unwrap());
        assert!(left.contains(&Some(b"fr".to_vec())), "{left:?}");
        assert!(left.contains(&Some(b"old".to_vec())), "{left:?}");
    }

    #[test]
    fn a_rename_without_a_sync_of_its_bytes_is_seen_to_lose_them() {
        let folder = tempfile::tempdir().unwrap();
        let root = folder.path().join("root");
        fs::create_dir(&root).unwrap();
        let disk = Rehearsal::new(&root).unwrap();
        disk.write_synced(&root.join("a"), b"bytes").unwrap();
        disk.rename(&root.join("a"), &root.join("b")).unwrap();
        let left = disk.cut(disk.steps(), &folder.path().join("cuts")).unwrap();
        let seen = left.iter().map(|f| (f.join("a").exists(), f.join("b").exists()));
        let seen: BTreeSet<_> = seen.collect();
        // Neither name was synced: none, the first, or the second, but never both.
        assert_eq!(seen, [(false, false), (true, false), (false, true)].into());
    }

    #[test]
    fn a_failing_write_leaves_half_and_a_failing_sync_says_so() {
        let folder = tempfile::tempdir().unwrap();
        let disk = Rehearsal::new(folder.path()).unwrap();
        let path = folder.path().join("a");
        // The name is one step, the bytes the next, the sync the one after.
        disk.fail_writes_at(disk.steps() + 1, 28);
        let (action, error) = disk.write_synced(&path, b"12345678").unwrap_err();
        assert_eq!((action, error.kind()), ("write", io::ErrorKind::StorageFull));
        assert_eq!(fs::read(&path).unwrap(), b"1234");
        disk.fail_syncs_at(disk.steps(), 5);
        let (action, _) = disk.write_synced(&path, b"12").unwrap_err();
        assert_eq!(action, "sync");
    }

    #[test]
    fn a_process_without_file_handles_changes_nothing_and_is_no_failed_sync() {
        const EMFILE: i32 = 24;
        let folder = tempfile::tempdir().unwrap();
        let disk = Rehearsal::new(folder.path()).unwrap();
        let path = folder.path().join("a");
        disk.fail_opens_at(0, EMFILE);
        let before = disk.steps();
        for error in [
            caudata_durable::replace_on(&disk, &path, b"1").unwrap_err(),
            caudata_durable::create_new_on(&disk, &path, b"1").unwrap_err(),
            caudata_durable::make_folder_on(&disk, &path).unwrap_err(),
            caudata_durable::sync_folder_on(&disk, folder.path()).unwrap_err(),
        ] {
            assert!(!error.is_sync_failure(), "{error}");
        }
        assert_eq!(disk.steps(), before);
        assert!(!path.exists());
    }
}
